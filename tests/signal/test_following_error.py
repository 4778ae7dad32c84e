"""Following error: statistics, harmonics and bandwidth of known sums, and of the paper's moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lmshealth.errors import BadLog, BadQuestion
from lmshealth.io.reading import read_log
from lmshealth.signal.readings import loop_error, read_error
from models.dynamics.stages import STAGES
from models.recordings.strokes import record_strokes
from models.recordings.velocities import Experiment, drive_velocities
from studies.paper.tables.tables import error_reading
from tests.harmonics import rebuild
from tests.signals import make_log, sine

RATE = 2000.0
N = 8000
# Hz, m, rad: three above 30 nm, two below.
SINES = (
    (12.5, 2e-6, 0.3), (50.0, 4e-8, -1.0), (137.0, 3e-7, 2.0), (400.0, 2e-8, 0.0),
    (610.0, 1e-8, 1.0),
)  # fmt: skip


def known(n: int = N) -> np.ndarray:
    """Sum the sines, whole periods each, about a mean of 0.1 µm."""
    t = np.arange(n) / RATE
    return np.asarray(1e-7 + sum(a * np.cos(2 * np.pi * f * t + p) for f, a, p in SINES))


def test_known_sines_are_read_to_a_billionth() -> None:
    """Statistics, harmonics, bandwidths and shares of a sum of sines are those of the sum."""
    x = known()
    (found,) = read_error(make_log({"delta_e": x}, RATE), count=5)
    assert (found.lowest, found.highest) == (x.min(), x.max())
    assert found.std == pytest.approx(np.sqrt(sum(a * a / 2 for _, a, _ in SINES)), rel=1e-9)
    assert found.mean == pytest.approx(1e-7, rel=1e-9)
    for i, (f, a, p) in zip(found.kept, sorted(SINES, key=lambda s: -s[1]), strict=True):
        assert found.harmonics.frequency[i] == pytest.approx(f, rel=1e-9)
        assert found.harmonics.amplitude[i] == pytest.approx(a, rel=1e-9)
        assert found.harmonics.phase[i] == pytest.approx(p, abs=1e-9)
    assert found.max_magnitude == pytest.approx(2e-6, rel=1e-9)
    assert found.harmonics.span(found.kept) == pytest.approx((12.5, 610.0), rel=1e-9)
    assert found.harmonics.span(found.above) == pytest.approx((12.5, 137.0), rel=1e-9)
    assert found.harmonics.share(found.kept) == pytest.approx(1.0, rel=1e-9)
    power = [a * a for _, a, _ in SINES]
    assert found.harmonics.share(found.above) == pytest.approx(
        sum(power[:3]) / sum(power), rel=1e-9
    )


def test_the_rebuilt_error_leaves_the_share_that_is_not_explained() -> None:
    """The variance of what the rebuilt record misses is one minus the share, to rounding."""
    x = known() + np.random.default_rng(1).normal(0, 3e-7, N)
    (found,) = read_error(make_log({"delta_e": x}, RATE))
    left = np.var(x - rebuild(found.harmonics, found.above)) / np.var(x)
    assert 0.01 < left < 0.9
    assert left == pytest.approx(1 - found.harmonics.share(found.above), rel=1e-9)
    assert found.harmonics.share(found.kept) > found.harmonics.share(found.above)


def test_nothing_above_the_floor_has_no_bandwidth() -> None:
    """A floor above every harmonic leaves none: no band, no share, and the mean rebuilt."""
    (found,) = read_error(make_log({"delta_e": known()}, RATE), count=5, floor=1e-5)
    assert found.above.size == 0
    assert np.isnan(found.harmonics.span(found.above)).all()
    assert found.harmonics.share(found.above) == 0
    np.testing.assert_allclose(rebuild(found.harmonics, found.above), found.mean, rtol=1e-9)


def test_gaps_leave_the_longest_piece_to_the_harmonics() -> None:
    """Statistics are those of all samples that are there, harmonics of the longest segment."""
    x = known(12_000)
    x[8000:8100] = np.nan
    log = replace(make_log({"delta_e": x}, RATE), pieces=((0, 8000), (8100, 12_000)))
    (found,) = read_error(log, count=5)
    assert found.duration == pytest.approx(11_900 / RATE)
    assert found.std == pytest.approx(np.nanstd(x), rel=1e-12)
    assert found.harmonics.amplitude[found.kept[0]] == pytest.approx(2e-6, rel=1e-9)


def test_a_part_of_the_log_can_be_read() -> None:
    """What happens in the move is not in the reading of the rest."""
    velocity = np.concatenate([np.zeros(4000), np.full(4000, 0.1)])
    x = np.where(velocity > 0, 1e-5, 1e-8) * np.random.default_rng(2).normal(size=8000)
    log = make_log({"delta_e": x}, RATE, velocity=velocity)
    assert read_error(log, part="idle")[0].std == pytest.approx(1e-8, rel=0.1)
    assert read_error(log, part="constant")[0].std == pytest.approx(1e-5, rel=0.1)


def test_statistics_and_duration_are_of_all_samples() -> None:
    """A record of more than a minute is cut into parts for the spectra, not for its extremes."""
    values = np.random.default_rng(2).normal(0, 1e-6, 1_300_019)
    values[-300:] += 5e-4
    (reading,) = read_error(make_log({"delta_e": values}, 20_000.0))
    assert reading.duration == values.size / 20_000
    assert reading.highest == values.max()
    assert reading.mean == pytest.approx(values.mean())
    assert reading.std == pytest.approx(values.std())


def test_without_a_harmonic_there_is_no_reading() -> None:
    """A count below one is an error that states what is needed."""
    with pytest.raises(BadQuestion, match="at least 1"):
        read_error(make_log({"delta_e": np.ones(100)}, RATE), count=0)


def test_a_log_without_following_error_is_refused() -> None:
    """The reason names what is there and what is needed."""
    with pytest.raises(BadLog, match=r"acc_a.*delta_e_um") as caught:
        read_error(make_log({"acc_a": known()}, RATE))
    assert caught.value.reason == "no-delta-e"


def test_a_record_too_short_names_the_seconds_needed() -> None:
    """A hundred harmonics need 201 samples; fewer harmonics need fewer."""
    log = make_log({"delta_e": known(200)}, RATE)
    with pytest.raises(BadLog, match=r"0\.1 s.*0\.101 s") as caught:
        read_error(log)
    assert caught.value.reason == "too-short"
    assert read_error(log, count=50)[0].kept.size == 50


def sines(n: int, *given: tuple[float, float]) -> np.ndarray:
    """Sum sines of frequencies in Hz and amplitudes in m."""
    return sum((sine(n, RATE, f, a) for f, a in given), np.zeros(n))


def test_the_loop_error_is_the_rms_of_what_lies_in_its_band() -> None:
    """Of sines only those from 1 to 40 Hz count, nor do an offset and a slope."""
    inside = ((3.0, 2e-6), (25.0, 1e-6))
    outside = ((0.2, 1e-6), (50.0, 5e-6), (126.4, 1e-5))
    slope = 1e-4 + np.linspace(0, 1e-5, 10 * N)
    expected = np.sqrt((2e-6**2 + 1e-6**2) / 2)
    for given in (inside, inside + outside):
        found = loop_error(make_log({"delta_e": sines(10 * N, *given) + slope}, RATE))
        assert found == pytest.approx(expected, rel=1e-3)
    alone = loop_error(make_log({"delta_e": sines(10 * N, *outside) + slope}, RATE))
    assert alone is not None
    assert alone < 0.01 * expected


def test_segments_count_by_their_durations_and_moves_do_not() -> None:
    """Of 4 s at 1 µm and 8 s at 3 µm the mean square is (1 + 2 · 9)/3; ramps are left out."""
    n = round(4 * RATE)
    ramp = np.linspace(0.1, 0.2, N // 4)
    velocity = np.concatenate([np.full(n, 0.1), ramp, np.full(2 * n, 0.2)])
    amplitude = np.concatenate([np.full(n, 1e-6), np.full(ramp.size, 1e-3), np.full(2 * n, 3e-6)])
    log = make_log({"delta_e": amplitude * sine(velocity.size, RATE, 10.0, 1.0)}, RATE,
                   velocity=velocity)  # fmt: skip
    # Some samples of the ramp's ends look constant, and the window keeps them small.
    assert loop_error(log) == pytest.approx(1e-6 * np.sqrt(19 / 3 / 2), rel=0.01)


def test_channels_of_following_error_count_alike() -> None:
    """Two of 1 and 3 µm have the mean of their squares; an accelerometer does not count."""
    signals = {"delta_e_a": sines(N, (10.0, 1e-6)), "delta_e_b": sines(N, (10.0, 3e-6))}
    log = make_log({**signals, "acc_a": sines(N, (10.0, 1.0))}, RATE)
    assert loop_error(log) == pytest.approx(1e-6 * np.sqrt(5 / 2), rel=1e-3)


def test_a_log_that_does_not_show_the_loops_band_has_no_loop_error() -> None:
    """Without following error, in less than two seconds, below 80 Hz: None, never a zero."""
    x = sines(N, (10.0, 1e-6))
    assert loop_error(make_log({"delta_e": x}, RATE)) is not None
    assert loop_error(make_log({"acc_a": x}, RATE)) is None
    assert loop_error(make_log({"delta_e": x[: round(1.9 * RATE)]}, RATE)) is None
    assert loop_error(make_log({"delta_e": x}, 80.0)) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lms-x", "lms-y"])
def test_the_papers_moves_read_as_its_tables_do(name: str, tmp_path: Path) -> None:
    """Tables 3 and 4 of simulated strokes agree with an independent reading to rounding."""
    experiment = Experiment(STAGES[name])
    velocities = (0.001, 0.1, 0.4)
    drive_velocities(experiment, tmp_path, "hdf5", velocities=velocities)
    for velocity in velocities:
        move = experiment.move(velocity)
        recording = record_strokes(
            experiment.stage, profile=move, seconds=4.0, rng=experiment.rng(velocity)
        )
        oracle = error_reading(recording)
        (found,) = read_error(read_log(tmp_path / f"velocity-{1e3 * velocity:08.3f}.h5"))
        whole, above = (np.ptp(found.harmonics.span(own)) for own in (found.kept, found.above))
        ours = {
            "min_um": 1e6 * found.lowest,
            "max_um": 1e6 * found.highest,
            "std_um": 1e6 * found.std,
            "mean_um": 1e6 * found.mean,
            "bandwidth_hz": whole,
            "bandwidth_above_30nm_hz": 0.0 if np.isnan(above) else above,
            "max_magnitude_um": 1e6 * found.max_magnitude,
        }
        assert ours == pytest.approx(oracle, rel=1e-9)
        assert found.velocity == pytest.approx(velocity, rel=1e-6)
