"""Start values for the identification: where the modes of a cluster stand, seen by all channels.

Wear moves all modes of a guide together, so that one mode may come to stand where another began.
The start is therefore a common shift first, then a small one per mode, judged on all channels at
once by an incoherent sum of resonances on a coarsely binned spectrum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.modal.targets import Target
from lmshealth.signal.spectra import Spectrum, median_ordinate

_COMMON_STEPS = 41
_OWN_STEPS = 15
# Multiplicative updates that converge, and that suffice to tell candidates apart; their exponent
# over the one that is proved to be monotone.
_UPDATES, _FEW_UPDATES = 25, 10
_STRIDE = 1.8


@dataclass(frozen=True, slots=True, eq=False)
class Coarse:
    """A binned spectrum, robust against lines.

    Attributes
    ----------
    frequency, level, count : ndarray
        Mean frequency in Hz, density from the median, and number of ordinates of single segments,
        ``(n_bins,)``.
    neighbours : tuple of Target
        Modes beside the band whose flanks reach into it.
    """

    frequency: FloatArray
    level: FloatArray
    count: FloatArray
    neighbours: tuple[Target, ...] = ()


def coarsen(spectra: tuple[Spectrum, ...], low: float, high: float, width: float) -> Coarse:
    """Bin the ordinates of all spectra of a channel.

    Parameters
    ----------
    spectra : tuple of Spectrum
        Of segments, or means over several.
    low, high : float
        Band in Hz.
    width : float
        Bin width in Hz; widened until a bin holds at least four ordinates.
    """
    cut = [spectrum.band(low, high) for spectrum in spectra]
    frequency = np.concatenate([s.frequency for s in cut])
    ordinates = np.concatenate([s.periodogram / median_ordinate(s.count) for s in cut])
    count = np.concatenate([np.full(s.frequency.size, float(s.count)) for s in cut])
    order = np.argsort(frequency, kind="stable")
    n_bins = max(3, min(int((high - low) / width), frequency.size // 4))
    # The first bins hold one ordinate more than the others.
    size, n_larger = divmod(frequency.size, n_bins)
    larger, smaller = np.split(order, [n_larger * (size + 1)])
    parts = [larger.reshape(n_larger, size + 1), smaller.reshape(n_bins - n_larger, size)]
    return Coarse(
        frequency=np.concatenate([frequency[part].mean(axis=1) for part in parts]),
        level=np.concatenate([np.median(ordinates[part], axis=1) for part in parts]).clip(1e-300),
        count=np.concatenate([count[part].sum(axis=1) for part in parts]),
    )


def misfits(coarse: Sequence[Coarse], targets: tuple[Target, ...]) -> FloatArray:
    """Whittle misfit of these targets, the neighbours and a white noise, ``(n_channels,)``."""
    return _fit_targets(coarse, targets)[1]


def strengths(
    coarse: Sequence[Coarse], targets: tuple[Target, ...]
) -> tuple[FloatArray, FloatArray]:
    """Modal PSD of each target, ``(n_channels, n_targets)``, and noise PSD, ``(n_channels,)``."""
    strength, _ = _fit_targets(coarse, targets)
    return strength[:, : len(targets)], strength[:, -1]


def _fit_targets(
    coarse: Sequence[Coarse], targets: tuple[Target, ...]
) -> tuple[FloatArray, FloatArray]:
    everything = (*targets, *coarse[0].neighbours)
    return incoherent_fit(
        coarse,
        np.array([target.frequency for target in everything]),
        np.array([target.damping_ratio for target in everything]),
    )


def incoherent_fit(
    coarse: Sequence[Coarse], f: FloatArray, zeta: FloatArray, *, updates: int = _UPDATES
) -> tuple[FloatArray, FloatArray]:
    """Fit strengths of resonances and white noises to binned spectra, for many candidates.

    The strengths maximise the Whittle likelihood by multiplicative updates, which keep them
    positive; least squares would be ruled by the bins that happen to be low.

    Parameters
    ----------
    coarse : sequence of Coarse
        Binned spectrum of each channel; all have the same bins.
    f, zeta : ndarray
        Natural frequencies in Hz and damping ratios, shape ``(..., n_modes)``.
    updates : int
        Number of updates.

    Returns
    -------
    strength : ndarray
        Modal PSD of each mode, then the noise PSD, shape ``(n_channels, ..., n_modes + 1)``.
    misfit : ndarray
        Whittle misfit of the binned spectra, shape ``(n_channels, ...)``.

    References
    ----------
    Fevotte2009
    """
    frequency, count = coarse[0].frequency, coarse[0].count
    beta = f[..., None, :] / frequency[:, None]
    shapes = 1 / ((1 - beta**2) ** 2 + (2 * zeta[..., None, :] * beta) ** 2)
    design = np.concatenate([shapes, np.ones((*shapes.shape[:-1], 1))], axis=-1)
    unit = design.mean(axis=-2)
    design = design / unit[..., None, :]
    levels = np.stack([channel.level for channel in coarse])
    levels = levels.reshape(len(coarse), *[1] * (f.ndim - 1), count.size)
    # Every part starts with an equal share of the mean level.
    weight = np.average(levels, axis=-1, weights=count)[..., None] / unit.shape[-1]
    weight = weight * np.ones(unit.shape)
    turned = np.swapaxes(design, -1, -2)
    for _ in range(updates):
        model = (design @ weight[..., None])[..., 0]
        share = count / model
        pull = turned @ (share * levels / model)[..., None]
        push = turned @ share[..., None]
        weight = weight * np.sqrt(pull / push)[..., 0] ** _STRIDE
    model = (design @ weight[..., None])[..., 0]
    misfit = np.sum(count * (np.log(model) + levels / model), axis=-1)
    return weight / unit, np.asarray(misfit)


def shift_cost(shifts: FloatArray, search: FloatArray, own: int) -> FloatArray:
    """Negative log prior of shifts: half the search together, a sixth of it apart.

    Parameters
    ----------
    shifts : ndarray
        Of ln frequency, shape ``(n_candidates, n_modes)``.
    search : ndarray
        Half widths of the searches, shape ``(n_modes,)``.
    own : int
        The common shift is the mean of this many first ones.

    Returns
    -------
    ndarray
        Shape ``(n_candidates,)``.
    """
    common = shifts[:, :own].mean(axis=1, keepdims=True)
    cost = 0.5 * (common[:, 0] / (search.mean() / 2)) ** 2
    return np.asarray(cost + 0.5 * np.sum(((shifts - common) / (search / 6)) ** 2, axis=1))


def locate(
    coarse: tuple[Coarse, ...], targets: tuple[Target, ...]
) -> tuple[tuple[Target, ...], tuple[Coarse, ...]]:
    """Find where the targets stand, by all channels together.

    Parameters
    ----------
    coarse : tuple of Coarse
        Binned spectrum of each channel; all have the same bins and neighbours.
    targets : tuple of Target
        A cluster of modes.

    Returns
    -------
    targets : tuple of Target
        Placed where they stand.
    coarse : tuple of Coarse
        With the neighbours placed by the common shift.
    """
    own = len(targets)
    everything = (*targets, *coarse[0].neighbours)
    nominal = np.array([target.frequency for target in everything])
    zeta = np.array([target.damping_ratio for target in everything])
    search = np.array([target.search for target in everything])

    def best(shifts: FloatArray) -> FloatArray:
        cost = shift_cost(shifts, search, own)
        f = nominal * np.exp(shifts)
        every = np.broadcast_to(zeta, f.shape)
        cost += incoherent_fit(coarse, f, every, updates=_FEW_UPDATES)[1].sum(axis=0)
        return np.asarray(shifts[int(np.argmin(cost))])

    reach = float(np.log1p(search.min()))
    shift = best(np.linspace(-reach, reach, _COMMON_STEPS)[:, None] * np.ones(nominal.size))
    for width in (3.0, 1.0):
        for i in range(own):
            moved = np.tile(shift, (_OWN_STEPS, 1))
            moved[:, i] += width * zeta[i] * np.linspace(-1, 1, _OWN_STEPS)
            shift = best(moved[np.abs(moved[:, i]) <= np.log1p(search[i])])
    placed = tuple(
        replace(target, frequency=float(f), nominal=target.frequency)
        for target, f in zip(everything, nominal * np.exp(shift), strict=True)
    )
    return placed[:own], tuple(replace(channel, neighbours=placed[own:]) for channel in coarse)
