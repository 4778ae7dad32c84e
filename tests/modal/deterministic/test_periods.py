"""Periods: found to a fraction of a sample, cut whole, and free of drift."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal.deterministic.periods import cut_periods, find_period

PERIOD, N = 1234.567, 20_000
LOW, HIGH = 5, 200


def multisine(
    rng: np.random.Generator, period: float = PERIOD, n: int = N, high: int = HIGH
) -> np.ndarray:
    """Make harmonics of amplitude one with random phases, also where the period is fractional."""
    t, harmonic = np.arange(n) / period, np.arange(LOW, high)
    phase = rng.uniform(0, 2 * np.pi, harmonic.size)
    return np.cos(2 * np.pi * np.outer(t, harmonic) + phase).sum(axis=1)


@pytest.mark.parametrize("period", [1000.0, PERIOD])
@pytest.mark.parametrize("stated", [None, 1.005])
def test_the_period_is_found_to_a_fraction_of_a_sample(period: float, stated: float | None) -> None:
    """Whole or not, stated to half a percent or not at all."""
    values = multisine(np.random.default_rng(1), period)
    found = find_period(values, None if stated is None else stated * period)
    assert found == pytest.approx(period, abs=1e-3)


def test_noise_as_strong_as_the_signal_leaves_the_period() -> None:
    """Two thirds signal: correlation of all multiples keeps the period apart from chance."""
    rng = np.random.default_rng(2)
    values = multisine(rng)
    noisy = values + 0.7 * values.std() * rng.standard_normal(N)
    assert find_period(noisy) == pytest.approx(PERIOD, abs=0.05)


def test_odd_harmonics_do_not_repeat_after_half_a_period() -> None:
    """A multisine of odd harmonics turns its sign after half a period."""
    t = np.arange(N) / 1000
    values = sum(np.cos(2 * np.pi * k * t + k**2) for k in range(5, 101, 2))
    assert find_period(np.asarray(values)) == pytest.approx(1000, abs=1e-3)


def test_what_does_not_repeat_has_no_period() -> None:
    """White noise, a band of noise, and one sweep."""
    rng = np.random.default_rng(3)
    white = rng.standard_normal(N)
    narrow = np.fft.rfft(white)
    narrow[:1000] = narrow[1100:] = 0
    t = np.arange(N) / N
    for values in (white, np.fft.irfft(narrow), np.sin(2 * np.pi * 500 * t**2)):
        assert find_period(values) is None


def test_a_stated_period_stands_where_the_signal_shows_none() -> None:
    """A period hidden in noise is the one that the user states."""
    assert find_period(np.random.default_rng(4).standard_normal(N), 1000.3) == 1000.3


def test_harmonics_of_a_fractional_period_read_their_amplitude() -> None:
    """Interpolation leaves a thousandth; cut at whole samples they leak ten times that."""
    values = multisine(np.random.default_rng(5))
    (spectra,), period = cut_periods([values], PERIOD)
    assert (period, spectra.shape[0]) == (PERIOD, 16)
    assert np.abs(np.abs(spectra[:, LOW:HIGH]) - 1).max() < 1e-3
    assert np.abs(spectra[:, 1:LOW]).max() < 1e-3
    (cut,), _ = cut_periods([values], 1235.0)
    assert np.abs(np.abs(cut[:, LOW:HIGH]) - 1).max() > 1e-2


def test_the_last_period_ends_with_the_record() -> None:
    """What is left over stands at the beginning, where transients are."""
    values = np.tile(np.arange(100.0), 4)[30:]
    (spectra,), period = cut_periods([values], 100.0)
    (whole,), _ = cut_periods([np.tile(np.arange(100.0), 3)], 100.0)
    assert period == 100.0
    np.testing.assert_allclose(spectra, whole, atol=1e-12)


def test_a_drift_leaves_the_harmonics_alone() -> None:
    """A straight drift a thousand times larger than the signal changes nothing."""
    values = multisine(np.random.default_rng(6), 1000.0)
    drift = 1e3 * values.std() * np.arange(N) / N
    (clean,), _ = cut_periods([values], 1000.0)
    (drifting,), _ = cut_periods([values + drift], 1000.0)
    np.testing.assert_allclose(drifting[:, 1:], clean[:, 1:], atol=1e-8)


def test_signals_are_cut_alike() -> None:
    """A delay by one sample turns every harmonic by its phase, in every period."""
    values = multisine(np.random.default_rng(7))
    (late, early), period = cut_periods([values[:-1], values[1:]], PERIOD)
    turn = np.exp(2j * np.pi * np.arange(LOW, HIGH) / period)
    ratio = early[:, LOW:HIGH] / late[:, LOW:HIGH]
    np.testing.assert_allclose(ratio, np.broadcast_to(turn, ratio.shape), atol=1e-3)
