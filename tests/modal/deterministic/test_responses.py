"""Frequency responses over periods and blocks, and the noise of their lines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from lmshealth.errors import BadLog
from lmshealth.modal.deterministic.responses import (
    Frf,
    Ordinates,
    Pair,
    from_periods,
    from_record,
    smooth_noise,
)
from studies.modes.frf.records import RATE, Machine, at_random, multisine, periodic
from tests.signals import make_log

BAND = (42.0, 118.0)
QUIET = Machine(white=0.0, process=0.0)
SIZE = 1600


def pair(given: np.ndarray, answer: np.ndarray, lag: int = 0) -> Pair:
    """Pair an input and an output."""
    log = make_log({"current": given, "acc_x": answer}, RATE)
    return Pair(log, ("current", "acc_x"), (given, answer), lag)


def over_periods(machine: Machine, periods: int = 8, seed: int = 1) -> tuple[Frf, Ordinates]:
    """Measure a machine under a multisine."""
    rng = np.random.default_rng(seed)
    return from_periods(pair(*periodic(rng, machine, SIZE, periods)), BAND, SIZE)


def test_without_noise_all_estimates_are_the_response() -> None:
    """Over whole periods H1, H2, Hv and the mean ratio are exact, the coherence is one."""
    frf, ordinates = over_periods(QUIET)
    truth = QUIET.response(frf.frequency)
    for name in ("response", "h1", "h2", "hv"):
        np.testing.assert_allclose(getattr(frf, name), truth, rtol=1e-6)
    np.testing.assert_allclose(frf.coherence, 1, atol=1e-9)
    np.testing.assert_allclose(ordinates.answer / ordinates.given, truth, rtol=1e-6)
    assert frf.period == pytest.approx(SIZE / RATE)
    assert frf.n_averages == 8


def test_only_excited_harmonics_are_used() -> None:
    """Those of the band that the multisine holds, and of a sparse one every third."""
    frf, _ = over_periods(QUIET)
    np.testing.assert_allclose(frf.frequency, np.arange(42.0, 118.1, 0.25))
    rng = np.random.default_rng(2)
    spectrum = np.fft.rfft(multisine(rng, SIZE))
    spectrum[np.arange(spectrum.size) % 3 > 0] = 0
    given = np.fft.irfft(spectrum)
    answer = QUIET.answer(given)
    noisy = QUIET.noise(rng, np.tile(given, 4), np.tile(answer, 4))
    sparse, _ = from_periods(pair(*noisy), BAND, SIZE)
    assert np.diff(sparse.frequency) == pytest.approx(0.75)


def test_noise_of_the_input_biases_h1_and_no_mean_of_periods() -> None:
    """A tenth of noise power draws H1 down by as much, leaves H2 and the mean ratio alone."""
    frf, _ = over_periods(Machine(white=0.0, process=0.0, input_noise=2.0), periods=400)
    truth = Machine().response(frf.frequency)

    def gain(response: np.ndarray) -> float:
        return float(np.mean((response / truth).real))

    # Noise has 4 times the multisine's power, spread over 2.6 times as many lines.
    share = 1 / (1 + 4 * 321 / 800)
    assert gain(frf.h1) == pytest.approx(share, abs=0.02)
    assert gain(frf.h2) == pytest.approx(1, abs=0.02)
    assert gain(frf.response) == pytest.approx(1, abs=0.02)
    assert gain(frf.h1) < gain(frf.hv) < gain(frf.h2)
    assert frf.coherence.mean() == pytest.approx(share, abs=0.02)


def test_noise_of_the_output_biases_h2() -> None:
    """H2 is off by many of the standard deviations that H1 keeps to."""
    frf, _ = over_periods(Machine(white=1.0, process=0.0), periods=200)
    truth = Machine().response(frf.frequency)
    assert np.mean(np.abs(frf.h1 - truth) ** 2 / frf.std**2) == pytest.approx(1, abs=0.25)
    assert np.mean(np.abs(frf.h2 - truth) ** 2 / frf.std**2) > 10


def test_the_stated_scatter_is_the_scatter() -> None:
    """Squared errors over the stated variance have mean one, also where both signals are noisy."""
    machine = Machine(white=0.2, process=0.3, input_noise=0.1)
    ratio = []
    for seed in range(10):
        frf, _ = over_periods(machine, periods=6, seed=seed)
        error = np.abs(frf.response - machine.response(frf.frequency)) ** 2
        ratio.append(np.mean(error / frf.std**2))
    assert np.mean(ratio) == pytest.approx(1, abs=4 * np.std(ratio) / 3)
    assert 0.9 < np.mean(ratio) < 1.15


def test_noise_that_both_signals_share_by_the_response_is_none() -> None:
    """What the machine truly answers is no error, however it scatters from period to period."""
    rng = np.random.default_rng(3)
    given = rng.standard_normal(SIZE) + np.zeros((6, 1)) + multisine(rng, SIZE) * 5
    wild = given + multisine(rng, SIZE) * rng.standard_normal((6, 1))
    answer = np.array([QUIET.answer(row) for row in wild])
    _, ordinates = from_periods(pair(wild.ravel(), answer.ravel()), BAND, SIZE)
    assert ordinates.noise.max() < 1e-12 * np.abs(ordinates.answer).max() ** 2


def test_of_few_periods_neighbours_help_out() -> None:
    """Variances have at least 16 degrees of freedom, from three periods or from thirty."""
    for periods, freedom in ((3, 18), (9, 24), (30, 29)):
        _, ordinates = over_periods(Machine(), periods)
        assert ordinates.freedom == freedom


def test_a_transient_in_the_first_period_is_left_out() -> None:
    """A machine that starts from rest has one period less; one in steady state keeps all."""
    rng = np.random.default_rng(4)
    given, answer = periodic(rng, Machine(white=0.01, process=0.0), SIZE, 6)
    assert from_periods(pair(given, answer), BAND, SIZE)[0].n_averages == 6
    decay = np.exp(-np.arange(given.size) / 400) * np.sin(
        2 * np.pi * 62 / RATE * np.arange(given.size)
    )
    answer = answer + 2 * answer.std() * decay
    assert from_periods(pair(given, answer), BAND, SIZE)[0].n_averages == 5


def test_an_input_that_does_not_repeat_has_no_periods() -> None:
    """White noise with a stated period is refused for its period, not for lack of excitation."""
    given, answer = at_random(np.random.default_rng(9), Machine(), 6 * SIZE)
    with pytest.raises(BadLog, match=r"period.* current does not repeat after 4 s"):
        from_periods(pair(given, answer), BAND, SIZE)


def test_two_periods_are_enough_and_less_are_not() -> None:
    """Two of 1600 samples, though one was taken to be a little longer; not of 1600.3 in 3201."""
    given, answer = periodic(np.random.default_rng(10), Machine(), SIZE, 2)
    assert from_periods(pair(given, answer), BAND, SIZE + 1e-3)[0].n_averages == 2
    more, longer = (np.append(x, x[:1]) for x in (given, answer))
    with pytest.raises(BadLog, match="less than two whole periods"):
        from_periods(pair(more, longer), BAND, SIZE + 0.3)


def test_too_few_lines_and_too_many_are_refused() -> None:
    """A refusal quotes the lines of a narrow band; a wide one of a long record needs a band."""
    with pytest.raises(BadLog, match=r"band-too-narrow.* 9 lines"):
        from_periods(pair(*periodic(np.random.default_rng(5), QUIET, SIZE, 4)), (60.0, 62.0), SIZE)
    with pytest.raises(BadLog, match=r"not-excited.* 0 lines"):
        from_periods(pair(*periodic(np.random.default_rng(5), QUIET, SIZE, 4)), (150, 160), SIZE)
    with pytest.raises(BadLog, match=r"period.*less than two whole periods of 8.75 s"):
        from_periods(pair(*periodic(np.random.default_rng(5), QUIET, SIZE, 4)), BAND, 3500.0)
    long = np.random.default_rng(5).standard_normal(60_000)
    with pytest.raises(BadLog, match="band-too-wide"):
        from_record(pair(long, long), (0.0, 180.0))


def test_a_record_has_the_coherence_of_its_noise() -> None:
    """White input and noise: coherence by their powers, H1 right away from resonances."""
    machine = Machine(((20.0, 0.5, 1.0),), white=1.0, process=0.0)
    given, answer = at_random(np.random.default_rng(6), machine, 80_000)
    frf, ordinates = from_record(pair(given, answer), BAND)
    truth = machine.response(frf.frequency)
    noise = np.var(answer) / 2
    expected = np.abs(truth) ** 2 / (np.abs(truth) ** 2 + noise)
    # A mean over n blocks makes it larger by (1 - γ²)²/n.
    bias = np.mean((1 - expected) ** 2) / frf.n_averages
    assert frf.coherence.mean() == pytest.approx(expected.mean() + bias, abs=0.02)
    error = np.abs(frf.h1 - truth) ** 2 / frf.std**2
    assert np.mean(error) == pytest.approx(1, abs=0.1)
    assert np.mean(ordinates.noise) == pytest.approx(noise * 4 / given.size, rel=0.1)
    assert np.isnan(frf.period)


def test_the_difference_is_undone() -> None:
    """Signals that were differenced give the amplitudes of those that were not."""
    given, answer = periodic(np.random.default_rng(7), QUIET, SIZE, 5)
    changes, moved = (np.roll(x, 1) - 2 * x + np.roll(x, -1) for x in (given, answer))
    _, plain = from_periods(pair(given, answer), BAND, SIZE)
    _, undone = from_periods(pair(changes, moved, lag=1), BAND, SIZE)
    np.testing.assert_allclose(np.abs(undone.answer), np.abs(plain.answer), rtol=1e-6)


F = np.arange(40.0, 120.0, 0.25)
RESONANCE = 1 / np.abs(62**2 - F**2 + 2j * 0.01 * 62 * F) ** 2


def test_one_line_is_not_averaged() -> None:
    """A width of one gives back what it was given."""
    power = np.random.default_rng(1).exponential(size=F.size)
    np.testing.assert_allclose(smooth_noise(power, RESONANCE, 1), power)


def test_a_resonance_narrower_than_the_average_is_kept() -> None:
    """Noise of sensor and force: within a quarter at the peak, where a plain average loses half."""
    rng = np.random.default_rng(2)
    truth = 1 + 100 * RESONANCE / RESONANCE.max()
    power = truth * rng.exponential(size=(50, F.size))
    peak = int(np.argmax(RESONANCE))
    found = np.mean([smooth_noise(row, RESONANCE, 41)[peak] for row in power])
    assert found == pytest.approx(truth[peak], rel=0.25)
    assert uniform_filter1d(truth, 41)[peak] < 0.5 * truth[peak]


def test_noise_of_the_sensor_alone_stays_flat() -> None:
    """Where no force shakes the machine its resonance leaves no trace in the noise."""
    power = np.random.default_rng(3).exponential(size=F.size)
    found = smooth_noise(power, RESONANCE, 41)
    assert found[int(np.argmax(RESONANCE))] == pytest.approx(1, abs=0.5)


def test_more_lines_than_there_are_is_all_of_them() -> None:
    """A width beyond the band averages over the band; zeros do no harm."""
    found = smooth_noise(np.array([0.0, 1.0, 2.0]), np.ones(3), 41)
    np.testing.assert_allclose(found, 1.0, atol=0.7)
    assert (found > 0).all()
