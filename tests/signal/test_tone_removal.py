"""Removal of sinusoids: estimates, residuals, and resonances that are not removed."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal import identification
from lmshealth.modal.identification import identify
from lmshealth.modal.modes import Modes
from lmshealth.signal import spectra
from lmshealth.signal.spectra import Sinusoid, remove_sinusoids
from tests.signals import (
    Mode,
    acceleration_log,
    accelerations,
    deviations,
    make_log,
    make_stage,
    sine,
    white,
)

RATE, N = 1000.0, 20_000
SECONDS = N / RATE
PROTECTED = np.zeros(N // 2, dtype=bool)
ROLL = (("roll", 105.0, 0.015),)


def rng(seed: int) -> np.random.Generator:
    """Give a generator."""
    return np.random.default_rng(seed)


def transform(*channels: np.ndarray) -> np.ndarray:
    """Transform channels so that |F|² is their one-sided periodogram."""
    values = np.fft.rfft(np.array(channels))[:, 1 : len(channels[0]) // 2]
    return (values * np.sqrt(2 / (len(channels[0]) * RATE))).T


def noise(seed: int, psd: float = 1.0) -> np.ndarray:
    """White noise of the length of these tests."""
    return white(rng(seed), psd, N, RATE)


def wandering(frequency: float, amplitude: float, by: float, seed: int = 0) -> np.ndarray:
    """Make a line whose frequency wanders by some Hz about its mean, once over the segment."""
    t = np.arange(N) / RATE
    turn = rng(seed).random(2) * 2 * np.pi
    off = by * np.sin(2 * np.pi * t / SECONDS + turn[0])
    return amplitude * np.sin(2 * np.pi * np.cumsum(frequency + off) / RATE + turn[1])


def at(frequency: float) -> int:
    """Index of the ordinate nearest to a frequency."""
    return round(frequency * SECONDS) - 1


def around(frequency: float, reach: int = 100) -> np.ndarray:
    """Mask the ordinates about a frequency."""
    mask = np.zeros(N // 2 - 1, dtype=bool)
    mask[max(0, at(frequency) - reach) : at(frequency) + reach + 1] = True
    return mask


def read(sinusoid: Sinusoid) -> tuple[float, float]:
    """Frequency in Hz and amplitude of a sinusoid."""
    return (sinusoid.ordinate + 1) / SECONDS, float(np.sqrt(2 * sinusoid.power / SECONDS))


# What is taken out


@pytest.mark.parametrize("by", [0.0, 0.01])
@pytest.mark.parametrize("amplitude", [10.0, 100.0, 1e3])
def test_a_tone_is_taken_out_down_to_the_noise(amplitude: float, by: float) -> None:
    """On ordinates, between them and wandering by 10 mHz, 30 to 70 dB above.

    Over ten lines the 200 ordinates about each have the noise's mean within 4.5 standard errors,
    but for a tenth; amplitude and frequency are read within what noise allows.
    """
    left, readings = [], []
    for seed in range(10):
        frequency = 150 + 0.005 * seed
        x = noise(seed) + wandering(frequency, amplitude, by, seed)
        rest, free, sinusoids = remove_sinusoids(transform(x), SECONDS, PROTECTED)
        near = around(frequency) & free
        assert near.sum() >= 201 - 27
        left.append(np.abs(rest[near, 0]) ** 2)
        (sinusoid,) = sinusoids
        readings.append(np.subtract(read(sinusoid), (frequency, amplitude)))
    mean = np.mean(np.concatenate(left))
    assert abs(mean - 1) < 0.1 + 4.5 / np.sqrt(sum(part.size for part in left))
    # Noise in the sixteen ordinates or fewer of the fit adds to the amplitude.
    snr = amplitude**2 * SECONDS / 2
    off = np.array(readings)
    assert np.abs(off[:, 0]).max() < 0.5 / SECONDS
    assert np.abs(off[:, 1] / amplitude).max() < 4 / np.sqrt(2 * snr) + 8 / snr + 2e-4


def test_masking_the_peak_alone_leaves_the_skirt() -> None:
    """Negative control: masking its peak alone leaves a pedestal of the sinusoid."""
    raw = transform(noise(1) + wandering(150.02, 100.0, 0.0))
    near = around(150.02) & ~around(150.02, 2)
    assert np.mean(np.abs(raw[near, 0]) ** 2) > 30
    rest, free, _ = remove_sinusoids(raw, SECONDS, PROTECTED)
    assert np.mean(np.abs(rest[near & free, 0]) ** 2) < 1.5


def test_other_ordinates_and_channels_keep_what_they_have() -> None:
    """A sinusoid in one channel takes less than 1 % of the noise of another, and none far away."""
    quiet, loud = noise(2), noise(3) + sine(N, RATE, 150.02, 100.0)
    raw = transform(quiet, loud)
    rest, free, sinusoids = remove_sinusoids(raw, SECONDS, PROTECTED)
    assert [sinusoid.channel for sinusoid in sinusoids] == [1]
    near = around(150.02, 300) & free
    lost = np.abs(rest - raw)[:, 0] ** 2
    assert lost[near].sum() < 0.01 * np.sum(np.abs(raw[near, 0]) ** 2)
    # Further away goes what leaks there, and no more: less than 1 % of the noise.
    far = ~around(150.02, 402)
    np.testing.assert_allclose(rest[far, 0], raw[far, 0], atol=0.1)


def test_a_tone_seen_by_two_channels_leaves_both() -> None:
    """Taken out of all channels, and reported once, in the one that shows it most clearly."""
    sinusoid = sine(N, RATE, 150.02, 100.0)
    rest, free, sinusoids = remove_sinusoids(
        transform(noise(4) + 0.3 * sinusoid, noise(5) + sinusoid), SECONDS, PROTECTED
    )
    assert [t.channel for t in sinusoids] == [1]
    near = around(150.02) & free
    mean = np.mean(np.abs(rest[near]) ** 2, axis=0)
    np.testing.assert_allclose(mean, 1.0, atol=0.1 + 4.5 / np.sqrt(near.sum()))


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_the_unit_of_a_channel_makes_no_tones(factor: float) -> None:
    """A sinusoid of two channels is one, with the same ordinates, whatever the units."""
    sinusoid = sine(N, RATE, 150.02, 100.0)
    for seed in range(3):
        one, other = noise(seed) + sinusoid, noise(10 + seed) + 0.3 * sinusoid
        _, free, sinusoids = remove_sinusoids(transform(one, other), SECONDS, PROTECTED)
        _, same, scaled = remove_sinusoids(transform(one, factor * other), SECONDS, PROTECTED)
        assert [t.channel for t in scaled] == [t.channel for t in sinusoids] == [0]
        np.testing.assert_array_equal(same, free)


@pytest.mark.parametrize("apart", [0.6, 1.0, 3.0, 10.0])
@pytest.mark.parametrize("amplitude", [20.0, 60.0])
def test_neighbouring_tones_are_both_taken_out(apart: float, amplitude: float) -> None:
    """Two sinusoids of different strength, twelve ordinates apart and more, leave the noise."""
    values = noise(6) + sine(N, RATE, 150.02, 100.0) + sine(N, RATE, 150.02 + apart, amplitude)
    rest, free, sinusoids = remove_sinusoids(transform(values), SECONDS, PROTECTED)
    found = sorted(read(sinusoid) for sinusoid in sinusoids)
    np.testing.assert_allclose([f for f, _ in found], [150.02, 150.02 + apart], atol=0.03)
    np.testing.assert_allclose([a for _, a in found], [100.0, amplitude], rtol=0.05)
    near = around(150.0, 300) & free
    assert np.mean(np.abs(rest[near, 0]) ** 2) == pytest.approx(1, abs=0.1 + 4.5 / np.sqrt(500))


# What is let alone


def test_noise_has_no_tones() -> None:
    """Of 40 transforms of noise, white and rising with f⁴, none loses an ordinate."""
    f = np.arange(1, N // 2) / SECONDS
    for seed in range(20):
        white_noise = transform(noise(seed))
        rising: np.ndarray = white_noise * f[:, None] ** 2
        for raw in (white_noise, rising):
            rest, free, sinusoids = remove_sinusoids(raw, SECONDS, PROTECTED)
            assert not sinusoids
            assert free.all()
            np.testing.assert_array_equal(rest, raw)


@pytest.mark.parametrize(("width", "most"), [(2, 12), (5, 2), (12, 2), (30, 2)])
def test_narrow_modes_are_seldom_taken_for_tones(width: float, most: int) -> None:
    """Of 40 records of a resonance 2ζfT ordinates wide few lose it: of the narrowest a sixth."""
    damping = width / (2 * 120.0 * SECONDS)
    mode = Mode(120.0, damping, 4 * damping**2 * 1e3)
    taken = 0
    for seed in range(40):
        values = accelerations(rng(seed), [mode], N, RATE, 1.0)[0]
        _, free, _ = remove_sinusoids(transform(values), SECONDS, PROTECTED)
        taken += not free[around(120.0, round(width))].all()
    assert taken <= most


@pytest.mark.parametrize("n", [3, 100])
def test_too_few_ordinates_are_left_as_they_are(n: int) -> None:
    """Transforms too short to separate a sinusoid from its surroundings come back untouched."""
    raw = transform(sine(N, RATE, 2.5, 100.0) + noise(1))[:n]
    rest, free, sinusoids = remove_sinusoids(raw, SECONDS, PROTECTED)
    assert (free.all(), sinusoids) == (True, ())
    np.testing.assert_array_equal(rest, raw)


def test_what_is_protected_is_left_and_the_rest_is_not() -> None:
    """Of two sinusoids the one that may be a resonance stays; both go where none may stand."""
    raw = transform(noise(8) + sine(N, RATE, 150.02, 100.0) + sine(N, RATE, 300.02, 100.0))
    protected = PROTECTED.copy()
    protected[at(140.0) : at(160.0)] = True
    rest, free, sinusoids = remove_sinusoids(raw, SECONDS, protected)
    assert [read(sinusoid)[0] for sinusoid in sinusoids] == [pytest.approx(300.02, abs=0.02)]
    assert free[around(150.0)].all()
    peak = around(150.02, 2)
    np.testing.assert_allclose(rest[peak], raw[peak], rtol=0.01)
    assert len(remove_sinusoids(raw, SECONDS, PROTECTED)[2]) == 2


@pytest.mark.slow
def test_a_comb_too_close_to_be_told_apart_does_not_grow() -> None:
    """Of an excitation that repeats, every third ordinate towers: nothing is put in there."""
    raw = transform(np.tile(noise(9)[: N // 3], 3)[: N - 2] + 0.01 * noise(10)[: N - 2])[:600]
    rest, _, _ = remove_sinusoids(raw, SECONDS, PROTECTED[:600])
    assert np.isfinite(rest).all()
    assert np.sum(np.abs(rest) ** 2) < np.sum(np.abs(raw) ** 2)


# Close to a mode


@pytest.mark.parametrize("frequency", [150.0, 150.02])
@pytest.mark.parametrize("amplitude", [300.0, 1000.0])
@pytest.mark.slow
def test_a_strong_line_beside_a_mode_moves_it_less_than_its_uncertainty(
    monkeypatch: pytest.MonkeyPatch, amplitude: float, frequency: float
) -> None:
    """Mains, 55 dB and more above a weak mode at 155 Hz, leave f and ζ within 1σ of without."""
    stage = make_stage([("yaw", 155.0, 0.01)])
    line = wandering(frequency, amplitude, 0.01)

    def find(values: np.ndarray) -> Modes:
        return identify(make_log({"acc_a": values}, RATE), stage)

    def moved(found: Modes, clean: Modes) -> float:
        off = [found.ln_frequency - clean.ln_frequency, found.ln_damping - clean.ln_damping]
        return float(np.abs(np.concatenate(off) / np.sqrt(np.diag(clean.cov))).max())

    for seed in (1, 2, 7):
        values = accelerations(rng(seed), [Mode(155.0, 0.01, 0.04)], N, RATE, 0.5)[0]
        clean, dirty = find(values), find(values + line)
        assert moved(dirty, clean) < 1
        (found,) = dirty.lines
        assert (found.kind, found.frequency) == ("mains", pytest.approx(frequency, abs=0.02))
        assert found.amplitude == pytest.approx(amplitude, rel=0.01)
        if frequency == 150.0:  # on an ordinate nothing leaks
            continue
        with monkeypatch.context() as patch:
            # Negative control: with the sinusoid left in, the mode moves, is lost, or its force
            # counts as unsteady, which more than doubles its uncertainty.
            patch.setattr(
                spectra,
                "remove_sinusoids",
                lambda raw, *_: (raw, np.ones(len(raw), dtype=bool), ()),
            )
            patch.setattr(identification, "find_lines", lambda *_: np.empty((0, 2)))
            left_in = find(values + line)
        wider = left_in.frequency_std > 2 * clean.frequency_std if left_in.names else [True]
        assert all(wider) or moved(left_in, clean) > 1


@pytest.mark.parametrize("line", [104.0, 104.908, 105.0, 106.2])
def test_a_line_crossing_a_mode_moves_it_less_than_its_uncertainty(line: float) -> None:
    """A line 100 times above the peak moves f by less than 1σ and ζ by less than 2σ."""
    stage, log = (make_stage(ROLL), acceleration_log(rng(14), [Mode(105.0, 0.015)], 60, RATE, 0.5))
    clean = identify(log, stage)
    values = log.channels[0].values + sine(60_000, RATE, line, 60.0)
    dirty = identify(make_log({"acc_0": values}, RATE), stage)
    std = np.sqrt(np.diag(clean.cov))
    assert abs(dirty.ln_frequency[0] - clean.ln_frequency[0]) < std[0]
    assert abs(dirty.ln_damping[0] - clean.ln_damping[0]) < 2 * std[1]
    assert [round(found.frequency, 1) for found in dirty.lines] == [pytest.approx(line, abs=0.06)]


@pytest.mark.parametrize("seed", range(4))
def test_an_order_sweeping_through_a_mode_moves_it_less_than_its_uncertainty(seed: int) -> None:
    """Seven moves whose ball pass crosses roll from 95 to 115 Hz leave f within 1σ, ζ within 2σ."""
    n, speeds = 9000, np.linspace(0.380, 0.460, 7).tolist()
    values = accelerations(rng(40 + seed), [Mode(105.0, 0.015)], 7 * n, RATE, 0.5)[0]
    order = np.concatenate([sine(n, RATE, speed / 4e-3, 60.0) for speed in speeds])
    velocity = np.repeat(speeds, n)
    clean, dirty = (
        identify(make_log({"acc_0": signal}, RATE, velocity=velocity), make_stage(ROLL, order_mm=4))
        for signal in (values, values + order)
    )
    std = np.sqrt(np.diag(clean.cov))
    assert abs(dirty.ln_frequency[0] - clean.ln_frequency[0]) < std[0]
    assert abs(dirty.ln_damping[0] - clean.ln_damping[0]) < 2 * std[1]
    kinds = [line.kind for line in dirty.lines]
    assert "ball pass" in kinds
    # Thomson's test may find one by chance.
    assert kinds.count("ball pass") >= len(kinds) - 1


def test_mains_inside_the_band_of_a_mode_are_named() -> None:
    """A 50 Hz line on the flank of a mode is listed as mains, in the channel it was seen in."""
    values = accelerations(rng(13), [Mode(52.0, 0.02)], 60_000, RATE, 0.5)[0]
    log = make_log({"acc_a": values + sine(60_000, RATE, 50.0, 20.0)}, RATE)
    found = identify(log, make_stage([("roll", 52.0, 0.02)]))
    assert np.abs(deviations(found, "roll", 52.0, 0.02)).max() < 4
    (line,) = found.lines
    assert (line.kind, line.channel, line.unit) == ("mains", "acc_a", "m/s²")
    assert line.frequency == pytest.approx(50.0, abs=0.02)
    assert line.amplitude == pytest.approx(20.0, rel=0.1)


def test_an_order_of_the_velocity_is_named() -> None:
    """A line at velocity over wavelength carries the name of the order."""
    velocity = 0.4  # ball pass of 4 mm: 100 Hz
    values = accelerations(rng(15), [Mode(105.0, 0.015)], 60_000, RATE, 0.5)[0]
    log = make_log(
        {"acc_a": values + sine(60_000, RATE, 100.0, 30.0)},
        RATE,
        velocity=np.full(60_000, velocity),
    )
    found = identify(log, make_stage(ROLL, order_mm=4.0))
    assert [line.kind for line in found.lines] == ["ball pass"]
