"""Binned levels, which lines do not move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from lmshealth.modal.ambient.cluster_fit import BinnedSpectra, bin_spectra
from lmshealth.modal.targets import Target
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra
from tests.bands import with_mean
from tests.signals import (
    Spectrum,
    cut_band,
    make_log,
    periodogram,
    sine,
    white,
)

RATE = 1000.0


def spectra(values: np.ndarray) -> tuple:
    """Transform a channel."""
    (channel,) = make_log({"acc_a": values}, RATE).channels
    return (periodogram(channel, RATE),)


def binned(parts: Sequence[Spectrum], low: float, high: float, width: float) -> BinnedSpectra:
    """Bin one channel."""
    spectra = tuple(
        CrossSpectrum(
            s.frequency,
            with_mean(s.periodogram[:, None, None] + 0j, s.count),
            s.duration,
            float("nan"),
            np.ones(s.frequency.size, dtype=bool),
        )
        for s in parts
    )
    cut = tuple(spectrum.band(low, high) for spectrum in spectra)
    return bin_spectra(LogSpectra(("acc_a",), ("acc",), cut), width)


def test_bins_read_the_density_of_white_noise() -> None:
    """The level from medians is the density within 4.5 standard errors of their mean."""
    level = 2.5e-3
    bins = binned(spectra(white(np.random.default_rng(1), level, 40_000, RATE)), 100, 200, 1.0)
    # A median of 40 exponentials scatters by 1/√40 of its mean over ln 2.
    off = (bins.level.mean() / level - 1) * np.log(2) * np.sqrt(4000)
    assert abs(off) < 4.5


@pytest.mark.parametrize("count", [2, 10])
def test_bins_read_the_density_from_means_too(count: int) -> None:
    """Bins of single segments and means over parts estimate the density, each with its weight."""
    rng, n = np.random.default_rng(3), 40_000
    frequency = np.arange(1, n + 1) / n * 500.0
    single = Spectrum(frequency, 3.0 * rng.exponential(size=n), n / 500.0)
    mean = Spectrum(frequency, 3.0 * rng.gamma(count, 1 / count, size=n), n / 500.0, count)
    for spectra_ in ((mean,), (single, mean)):
        bins = binned(spectra_, 0.0, 600.0, 1.0)
        assert abs(bins.level.mean() / 3.0 - 1) < 4.5 / np.log(2) / np.sqrt(n)
    # Negative control: the median of exponentials would read too much.
    once = binned((replace(mean, count=1),), 0.0, 600.0, 1.0)
    assert once.level.mean() / 3.0 - 1 > 0.15


def test_a_line_does_not_move_the_bins() -> None:
    """A line 2000 times above the noise leaves the level of its bin below twice the noise."""
    values = white(np.random.default_rng(1), 1.0, 40_000, RATE)
    lined = values + sine(values.size, RATE, 150.013, 10.0)
    clean, dirty = (binned(spectra(v), 100, 200, 2.0) for v in (values, lined))
    assert (dirty.level / clean.level).max() < 2
    # Negative control: a mean would be moved tenfold.
    ordinates = cut_band(spectra(lined)[0], 149, 151).periodogram
    assert ordinates.mean() > 10


def test_bins_are_widened_until_they_hold_four_ordinates() -> None:
    """A bin width below the resolution still gives bins of at least four ordinates."""
    bins = binned(spectra(white(np.random.default_rng(2), 1.0, 2000, RATE)), 100, 200, 0.01)
    assert bins.frequency.size == 50  # of 200 ordinates


def test_a_target_has_a_band_about_it() -> None:
    """The band reaches so many damping ratios up and down, down never below half."""
    target = Target("roll", 100.0, 0.02, 0.15)
    assert target.band(8.0) == pytest.approx((84.0, 116.0))
    assert target.band(100.0)[0] == pytest.approx(50.0)
