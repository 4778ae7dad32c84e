"""Lines: frequency and amplitude of sines, and names by their sources."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmshealth.io.log import Channel, Log
from lmshealth.io.reading import read_log
from lmshealth.signal.segments import Segment, find_segments
from lmshealth.signal.spectral_lines import (
    Line,
    detect_sinusoids,
    find_lines,
    find_lines_by_velocity,
    name_lines,
)
from tests.signals import (
    Mode,
    accelerations,
    density,
    displacements,
    make_log,
    make_stage,
    sine,
    white,
)

RATE = 1000.0
BAND = (20.0, 450.0)


def lines(values: np.ndarray, kind: str = "acceleration", alarm: float = 0.01) -> np.ndarray:
    """Test a whole record."""
    channel = Channel("acc_a", kind, values)  # type: ignore[arg-type]
    return find_lines(channel, (Segment(0, values.size, np.nan),), RATE, BAND, alarm)


@pytest.mark.parametrize("n", [4000, 3997])
@pytest.mark.parametrize("off", [0.0, 0.11, 0.25, 0.37, 0.5])
def test_a_line_is_found_where_it_stands(n: int, off: float) -> None:
    """Also between ordinates: frequency within a fiftieth of one, amplitude within 2 %."""
    frequency = (400 + off) * RATE / n
    noise = white(np.random.default_rng(1), 1e-4, n, RATE)
    ((found, amplitude),) = lines(sine(n, RATE, frequency, 2.0) + noise, alarm=1e-4)
    assert found == pytest.approx(frequency, abs=0.02 * RATE / n)
    assert amplitude == pytest.approx(2.0, rel=0.02)


def test_a_strong_line_has_no_companions() -> None:
    """A million times above the noise its foot makes no further line, wherever it falls."""
    rng = np.random.default_rng(2)
    for frequency in rng.uniform(100, 101, 30).tolist():
        values = sine(4000, RATE, frequency, 1e4) + white(rng, 1e-2, 4000, RATE)
        assert len(lines(values, alarm=1e-4)) == 1


def test_two_lines_beside_each_other_are_two() -> None:
    """Sixteen ordinates apart, one ten times the other, both are found."""
    noise = white(np.random.default_rng(3), 1e-5, 4000, RATE)
    values = sine(4000, RATE, 100.0, 1.0) + sine(4000, RATE, 104.0, 0.1) + noise
    found = lines(values, alarm=1e-4)
    np.testing.assert_allclose(found[:, 0], [100.0, 104.0], atol=0.01)
    np.testing.assert_allclose(found[:, 1], [1.0, 0.1], rtol=0.05)


def test_a_line_on_a_resonance_is_found_and_the_resonance_is_not() -> None:
    """On the flank of a mode the line is found; without it there is none."""
    rng = np.random.default_rng(4)
    for damping in (0.002, 0.015):
        mode = Mode(120.0, damping)
        values = accelerations(rng, [mode], 8000, RATE, 0.01)[0]
        assert lines(values, alarm=1e-3).size == 0
        ordinate = np.sqrt(2 * density([mode], np.array([121.0]))[0] * RATE / 8000)
        ((found, _),) = lines(values + sine(8000, RATE, 121.0, 20 * ordinate), alarm=1e-3)
        assert found == pytest.approx(121.0, abs=0.02)


def test_a_displacement_line_reads_its_acceleration() -> None:
    """Of Δe the amplitude is ω² times that of the displacement."""
    values = displacements(np.random.default_rng(5), [Mode(120.0, 0.02)], 8000, RATE, 1e-18)[0]
    amplitude = 40.0 / (2 * np.pi * 50) ** 2
    found = lines(values + sine(8000, RATE, 50.0, amplitude), "displacement")
    row = found[np.argmin(np.abs(found[:, 0] - 50))]
    assert row[0] == pytest.approx(50.0, abs=0.02)
    assert row[1] == pytest.approx(40.0, rel=0.02)


def test_a_line_must_stand_out_of_its_noise() -> None:
    """Of sines over noise the test finds all at 26 dB over an ordinate and none at 0 dB."""
    rng = np.random.default_rng(6)
    n, level = 4000, 1e-2
    ordinate = np.sqrt(2 * level * RATE / n)  # amplitude whose ordinate equals the density
    for factor, share in ((20.0, 1.0), (1.0, 0.0)):
        line = sine(n, RATE, 100.0, factor * ordinate)
        found = [lines(white(rng, level, n, RATE) + line, alarm=1e-3).size > 0 for _ in range(20)]
        assert np.mean(found) == share


def test_records_too_short_have_no_lines() -> None:
    """Where no ordinate of the band has four others on either side nothing is tested."""
    for n in (0, 2, 20):
        assert lines(sine(n, RATE, 100.0, 1.0)).shape == (0, 2)
    assert lines(np.zeros(4000)).shape == (0, 2)


# Names


def named(frequency: float, velocity: float, order_mm: float = 4.0) -> str:
    """Name a line in a log of one velocity."""
    seen, stage = [("acc_a", frequency, 1.0)], make_stage([("r", 105.0, 0.02)], order_mm=order_mm)
    (line,) = name_lines(seen, [velocity], stage, 0.2)
    return line.kind


def test_a_line_is_named_by_its_lowest_harmonic() -> None:
    """50 Hz is mains and not the tenth harmonic of a slow order; 100 Hz may be the ball pass."""
    assert named(50.0, 0.02) == "mains"
    assert named(100.0, 0.4) == "ball pass"
    assert named(150.0, 0.3) == "ball pass"
    assert named(150.0, 0.01) == "mains"
    assert named(77.0, 0.4) == "unknown"


def sweeping(rng: np.random.Generator, wavelength: float, velocities: tuple[float, ...]) -> Log:
    """Make moves at several velocities with a line of one wavelength, rests between them."""
    values, speeds = [], []
    for velocity in velocities:
        n = 6000
        values += [
            sine(n, RATE, velocity / wavelength, 1.0) + white(rng, 1e-3, n, RATE),
            white(rng, 1e-3, 500, RATE),
        ]
        speeds += [np.full(n, velocity), np.zeros(500)]
    fixed = sine(sum(v.size for v in values), RATE, 333.0, 0.5)
    return make_log(
        {"acc_a": np.concatenate(values) + fixed}, RATE, velocity=np.concatenate(speeds)
    )


def test_lines_that_follow_the_velocity_are_orders() -> None:
    """At three velocities an order is found three times and named, known or not; others stay."""
    log = sweeping(np.random.default_rng(7), 0.004, (0.30, 0.36, 0.43))
    known = find_lines_by_velocity(
        log, log.channels, make_stage([("r", 105.0, 0.02)], order_mm=4.0), BAND
    )
    unknown = find_lines_by_velocity(log, log.channels, None, BAND)
    for found, kind in ((known, "ball pass"), (unknown, "order of 4 mm")):
        assert [line.kind for line in found] == [kind] * 3 + ["unknown"]
        np.testing.assert_allclose([f.frequency for f in found], [75, 90, 107.5, 333], atol=0.05)
        np.testing.assert_allclose([f.amplitude for f in found], [1, 1, 1, 0.5], rtol=0.1)


def stroking(rng: np.random.Generator, velocities: Sequence[float], amplitude: float) -> Log:
    """Make strokes of half a second to and fro, at rest between, with an order of 4 mm."""
    values, speeds = [white(rng, 1e-2, 300, RATE)], [np.zeros(300)]
    for k, velocity in enumerate(velocities):
        phase = rng.uniform(0, 2 * np.pi)
        line = sine(500, RATE, velocity / 0.004, amplitude, phase)
        values += [line + white(rng, 1e-2, 500, RATE), white(rng, 1e-2, 300, RATE)]
        speeds += [np.full(500, velocity * (-1) ** k), np.zeros(300)]
    return make_log({"acc_a": np.concatenate(values)}, RATE, velocity=np.concatenate(speeds))


def test_short_strokes_show_their_order_together() -> None:
    """Of twelve strokes to and fro none shows the order; together they do within 0.2 ordinates."""
    log = stroking(np.random.default_rng(10), [0.41] * 12, 0.6)
    (line,) = find_lines_by_velocity(
        log, log.channels, make_stage([("r", 105.0, 0.02)], order_mm=4.0), BAND
    )
    assert line.kind == "ball pass"
    assert line.frequency == pytest.approx(102.5, abs=0.4)
    assert line.amplitude == pytest.approx(0.6, rel=0.25)
    channel, segments = log.channels[0], find_segments(log, 0.2)
    assert len(segments) == 12
    alone = [find_lines(channel, (segment,), RATE, BAND, 0.01 / 12) for segment in segments]
    assert not any(found.size for found in alone)


def test_strokes_of_different_velocities_stay_apart() -> None:
    """Twelve strokes at twelve velocities have no line in common, two times twelve have two."""
    rng = np.random.default_rng(11)
    log = stroking(rng, np.linspace(0.2, 0.6, 12).tolist(), 0.6)
    assert find_lines_by_velocity(log, log.channels, None, BAND) == ()
    log = stroking(rng, [0.41, 0.41, 0.55, 0.55] * 6, 0.6)
    found = find_lines_by_velocity(log, log.channels, None, BAND)
    assert [line.kind for line in found] == ["order of 4 mm"] * 2
    np.testing.assert_allclose([line.frequency for line in found], [102.5, 137.5], atol=0.4)


def test_pieces_of_a_log_without_set_point_are_searched_together() -> None:
    """Ten pieces between gaps show a line that none of them shows."""
    rng = np.random.default_rng(12)
    values = white(rng, 1e-2, 6000, RATE) + sine(6000, RATE, 141.0, 0.6)
    pieces = [(k, k + 500) for k in range(0, 6000, 600)]
    log = make_log({"acc_a": values}, RATE, pieces=pieces)
    (line,) = find_lines_by_velocity(log, log.channels, None, BAND)
    assert line.frequency == pytest.approx(141.0, abs=0.4)
    whole = make_log({"acc_a": values}, RATE, pieces=pieces[:1])
    assert find_lines_by_velocity(whole, whole.channels, None, BAND) == ()


def test_every_sample_of_a_displacement_is_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lengths that are announced are those of the second differences, of each segment."""
    pairs: list[tuple[int, int]] = []

    def spy(lengths: Sequence[int], read: Callable[[int], np.ndarray], *rest: Any) -> np.ndarray:
        pairs.extend((length, read(number).size) for number, length in enumerate(lengths))
        return detect_sinusoids(lengths, read, *rest)

    monkeypatch.setattr("lmshealth.signal.spectral_lines.detect_sinusoids", spy)
    values = displacements(np.random.default_rng(13), [Mode(60.0, 0.02)], 5000, RATE, 1e-18)[0]
    log = make_log({"delta_e": values}, RATE, pieces=[(0, 3000), (3100, 5000)])
    find_lines_by_velocity(log, log.channels, None, (5.0, 30.0))
    assert [length for length, _ in pairs] == [size for _, size in pairs]
    # The difference reaches over four samples to either side.
    assert [length for length, _ in pairs] == [2992, 1892]


def test_a_line_that_stands_still_is_no_order() -> None:
    """One frequency at all velocities is one line, listed once."""
    log = sweeping(np.random.default_rng(8), 1e9, (0.30, 0.36, 0.43))
    (line,) = find_lines_by_velocity(log, log.channels, None, BAND)
    assert isinstance(line, Line)
    assert (line.kind, line.channel) == ("unknown", "acc_a")
    assert line.frequency == pytest.approx(333.0, abs=0.02)


def test_mains_that_wander_are_found_and_named() -> None:
    """A minute of 100 Hz whose frequency wanders by 20 mHz is one line and called mains."""
    rng = np.random.default_rng(9)
    n = 60_000
    wander = 0.02 * np.sin(2 * np.pi * np.arange(n) / RATE / 25) + 100
    values = np.sin(2 * np.pi * np.cumsum(wander) / RATE) + white(rng, 0.05, n, RATE)
    (line,) = find_lines_by_velocity(
        make_log({"acc_a": values}, RATE), _channels(values), None, BAND
    )
    assert line.kind == "mains"
    assert line.frequency == pytest.approx(100.0, abs=0.05)
    assert line.amplitude == pytest.approx(1.0, rel=0.1)


def _channels(values: np.ndarray) -> tuple[Channel, ...]:
    return make_log({"acc_a": values}, RATE).channels


@pytest.mark.slow
def test_a_measured_machine_shows_its_mains(needs: Callable[[str], None]) -> None:
    """Harmonics of wandering mains in 70 s of a vibrating machine are found and named."""
    needs("data")
    (path,) = (Path(os.environ["LMSHEALTH_DATA"]) / "uff58_samples").glob("MPSTD*.uff")
    log = read_log(path)
    found = find_lines_by_velocity(log, log.channels, None, (20.0, 350.0))
    mains = {round(line.frequency) for line in found if line.kind == "mains"}
    assert mains == {50, 100, 200, 300}
    # The motor's own line is none.
    assert max(found, key=lambda line: line.amplitude).kind == "unknown"
