"""Start values: binned levels that lines do not move, and modes that are found shifted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from lmshealth.modal.ambient.cluster_fit import (
    BinnedSpectra,
    bin_spectra,
    fit_strengths,
    incoherent_fit,
)
from lmshealth.modal.ambient.hints import locate
from lmshealth.modal.targets import Target
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra
from tests.bands import with_mean
from tests.signals import (
    Mode,
    Spectrum,
    accelerations,
    cut_band,
    density,
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


def joined(*channels: BinnedSpectra) -> BinnedSpectra:
    """Join the levels of several channels."""
    return replace(channels[0], level=np.concatenate([one.level for one in channels]))


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
    return bin_spectra(LogSpectra(("acc_a",), ("acc",), spectra), low, high, width)


def scatter_free(modes: list[Mode], noise: float) -> BinnedSpectra:
    """Return a binned spectrum that is its own expectation."""
    frequency = np.arange(80.0, 180.0, 0.5)
    level = density(modes, frequency, noise)[None]
    return BinnedSpectra(frequency, level, np.full(frequency.size, 10.0))


def misfit(bins: BinnedSpectra, modes: Sequence[Target]) -> float:
    """Return the misfit of modes to the bins of one channel."""
    return float(fit_strengths(bins, modes)[1].item())


def test_bins_read_the_density_of_white_noise() -> None:
    """The level from medians is the density within 4.5 standard errors of their mean."""
    level = 2.5e-3
    bins = binned(spectra(white(np.random.default_rng(1), level, 40_000, RATE)), 100, 200, 1.0)
    assert bins.count.sum() == 4000
    # A median of 40 exponentials scatters by 1/√40 of its mean over ln 2.
    off = (bins.level.mean() / level - 1) * np.log(2) * np.sqrt(bins.count.sum())
    assert abs(off) < 4.5


@pytest.mark.parametrize("count", [2, 10])
def test_bins_read_the_density_from_means_too(count: int) -> None:
    """Bins of single segments and means over parts estimate the density, each with its weight."""
    rng, n = np.random.default_rng(3), 40_000
    frequency = np.arange(1, n + 1) / n * 500.0
    single = Spectrum(frequency, 3.0 * rng.exponential(size=n), n / 500.0)
    mean = Spectrum(frequency, 3.0 * rng.gamma(count, 1 / count, size=n), n / 500.0, count)
    for spectra_, weight in (((mean,), count), ((single, mean), count + 1)):
        bins = binned(spectra_, 0.0, 600.0, 1.0)
        assert bins.count.sum() == weight * n
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
    assert bins.count.min() >= 4


def test_a_target_has_a_band_about_it() -> None:
    """The band reaches so many damping ratios up and down, down never below half."""
    target = Target("roll", 100.0, 0.02, 0.15)
    assert target.band(8.0) == pytest.approx((84.0, 116.0))
    assert target.band(100.0)[0] == pytest.approx(50.0)


def test_strengths_of_a_scatter_free_binsare_found() -> None:
    """Two resonances and noise of very different size are given back within 10 %."""
    modes = [Mode(105.0, 0.015, 2e-4), Mode(140.0, 0.02, 5e-2)]
    (strength,), _ = incoherent_fit(
        scatter_free(modes, 3e-2), np.array([105.0, 140.0]), np.array([0.015, 0.02])
    )
    np.testing.assert_allclose(strength, [2e-4, 5e-2, 3e-2], rtol=0.1)


def test_strengths_are_positive_and_scale_with_the_data() -> None:
    """Data a million times larger have strengths a million times larger, none of them negative."""
    bins = scatter_free([Mode(105.0, 0.015)], 0.01)
    loud = replace(bins, level=1e6 * bins.level)
    f, zeta = np.array([105.0, 150.0]), np.array([0.02, 0.02])
    quiet, other = incoherent_fit(joined(bins, loud), f, zeta)[0]
    assert (quiet >= 0).all()
    np.testing.assert_allclose(other, 1e6 * quiet, rtol=1e-9)


def test_many_candidates_are_fitted_as_each_alone() -> None:
    """One call for a stack of frequencies gives the misfits of single calls."""
    bins = scatter_free([Mode(105.0, 0.015), Mode(140.0, 0.02)], 0.01)
    f = np.array([[105.0, 140.0], [100.0, 140.0], [110.0, 150.0]])
    zeta = np.broadcast_to([0.015, 0.02], f.shape)
    (together,) = incoherent_fit(bins, f, zeta)[1]
    np.testing.assert_allclose(
        together, [incoherent_fit(bins, row, zeta[0])[1][0] for row in f], rtol=1e-12
    )
    assert int(np.argmin(together)) == 0


def test_a_missing_mode_costs_and_a_needless_one_does_not() -> None:
    """The misfit grows when a mode is left out, and not when one without strength is added."""
    bins = scatter_free([Mode(105.0, 0.015)], 0.01)
    mode, ghost = (Target(name, f, 0.015, 0.1) for name, f in (("a", 105.0), ("b", 140.0)))
    assert misfit(bins, (mode, ghost)) == pytest.approx(misfit(bins, (mode,)), abs=1.0)
    assert misfit(bins, (ghost,)) > misfit(bins, (mode,)) + 100


def test_a_neighbour_takes_its_own_flank() -> None:
    """An absent mode gains nothing with its neighbour; without, it explains the flank."""
    bins = scatter_free([Mode(105.0, 0.02)], 0.01)
    neighbour = Target("neighbour", 105.0, 0.02, 0.1)
    absent = (Target("absent", 112.0, 0.02, 0.1),)
    helped = replace(bins, neighbours=(neighbour,))
    assert misfit(helped, ()) - misfit(helped, absent) < 1.0
    assert misfit(bins, ()) - misfit(bins, absent) > 50


@pytest.mark.parametrize("shift", [-0.12, -0.05, 0.0, 0.07, 0.13])
def test_modes_are_located_where_a_common_shift_took_them(shift: float) -> None:
    """Three modes moved together, and by a percent apart, are found within a damping ratio."""
    targets = tuple(
        Target(name, f, 0.018, 0.15)
        for name, f in (("roll", 126.4), ("pitch", 136.6), ("yaw", 155.0))
    )
    own = np.array([0.01, -0.005, 0.0])
    truth = np.array([126.4, 136.6, 155.0]) * np.exp(shift + own)
    rng = np.random.default_rng(9)
    modes = [Mode(f, 0.018, 1.0, (1.0, 0.3)) for f in truth]
    values = accelerations(rng, modes, 30_000, RATE, 0.5)
    bins = joined(*(binned(spectra(row), 85.0, 205.0, 1.0) for row in values))
    _, placed = locate(bins, targets)
    np.testing.assert_allclose([t.frequency for t in placed], truth, rtol=0.018)


def test_a_mode_standing_where_its_neighbour_began_keeps_its_name() -> None:
    """Pitch worn down to roll's nominal frequency is not taken for roll."""
    targets = (Target("roll", 126.4, 0.018, 0.15), Target("pitch", 136.6, 0.015, 0.15))
    factor = 126.4 / 136.6
    truth = np.array([126.4, 136.6]) * factor
    modes = [Mode(truth[0], 0.018), Mode(truth[1], 0.015)]
    values = accelerations(np.random.default_rng(10), modes, 30_000, RATE, 0.5)
    _, placed = locate(binned(spectra(values[0]), 85.0, 190.0, 1.0), targets)
    assert [target.name for target in placed] == ["roll", "pitch"]
    np.testing.assert_allclose([t.frequency for t in placed], truth, rtol=0.015)
