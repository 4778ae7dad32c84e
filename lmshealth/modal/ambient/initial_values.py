"""Start values of a cluster: frequencies and strengths of its modes from binned spectra.

Wear moves all modes of a guide together, so that one mode may reach the described frequency of
another. `locate` therefore searches a common shift first, then a small one of each mode, by the
likelihood of all channels under an incoherent sum of resonances and white noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.log_spectra import BinnedSpectrum, ClusterData, LogSpectra
from lmshealth.modal.naming import shift_cost
from lmshealth.modal.targets import Target

_COMMON_STEPS = 41
_OWN_STEPS = 15
# Multiplicative updates to convergence, and enough to rank candidates; their exponent over that
# for which monotonicity is proved.
_UPDATES, _FEW_UPDATES = 25, 10
_STRIDE = 1.8


def misfits(binned: Sequence[BinnedSpectrum], targets: Sequence[Target]) -> FloatArray:
    """Return the Whittle misfit of targets, neighbours and white noise, shape ``(n_channels,)``."""
    return _fit_targets(binned, targets)[1]


def strengths(
    binned: Sequence[BinnedSpectrum], targets: Sequence[Target]
) -> tuple[FloatArray, FloatArray]:
    """Return modal PSD, ``(n_channels, n_targets)``, and noise PSD, ``(n_channels,)``."""
    strength, _ = _fit_targets(binned, targets)
    return strength[:, : len(targets)], strength[:, -1]


def _fit_targets(
    binned: Sequence[BinnedSpectrum], targets: Sequence[Target]
) -> tuple[FloatArray, FloatArray]:
    modes = (*targets, *binned[0].neighbours)
    return incoherent_fit(
        binned,
        np.array([mode.frequency for mode in modes]),
        np.array([mode.damping_ratio for mode in modes]),
    )


def incoherent_fit(
    binned: Sequence[BinnedSpectrum], f: FloatArray, zeta: FloatArray, *, updates: int = _UPDATES
) -> tuple[FloatArray, FloatArray]:
    """Fit strengths of resonances and white noise to binned spectra, for many candidates.

    Multiplicative updates maximise the Whittle likelihood and keep the strengths positive; least
    squares would depend on the bins that happen to be low.

    Parameters
    ----------
    binned : sequence of BinnedSpectrum
        Of each channel, with the same bins.
    f, zeta : ndarray
        Natural frequencies in Hz and damping ratios, shape ``(..., n_modes)``.
    updates : int
        Number of updates.

    Returns
    -------
    strength : ndarray
        Modal PSD of each mode, then the noise PSD, shape ``(n_channels, ..., n_modes + 1)``.
    misfit : ndarray
        Whittle misfit, shape ``(n_channels, ...)``.

    References
    ----------
    Fevotte2009
    """
    frequency, count = binned[0].frequency, binned[0].count
    beta = f[..., None, :] / frequency[:, None]
    shapes = 1 / ((1 - beta**2) ** 2 + (2 * zeta[..., None, :] * beta) ** 2)
    design = np.concatenate([shapes, np.ones((*shapes.shape[:-1], 1))], axis=-1)
    unit = design.mean(axis=-2)
    design = design / unit[..., None, :]
    levels = np.stack([channel.level for channel in binned])
    levels = levels.reshape(len(binned), *[1] * (f.ndim - 1), count.size)
    # Every part starts with an equal share of the mean level.
    weight = np.average(levels, axis=-1, weights=count)[..., None] / unit.shape[-1]
    weight = weight * np.ones(unit.shape)
    transposed = np.swapaxes(design, -1, -2)
    for _ in range(updates):
        model = (design @ weight[..., None])[..., 0]
        share = count / model
        numerator = transposed @ (share * levels / model)[..., None]
        denominator = transposed @ share[..., None]
        weight = weight * np.sqrt(numerator / denominator)[..., 0] ** _STRIDE
    model = (design @ weight[..., None])[..., 0]
    misfit = np.sum(count * (np.log(model) + levels / model), axis=-1)
    return weight / unit, np.asarray(misfit)


def locate(
    binned: tuple[BinnedSpectrum, ...], targets: tuple[Target, ...]
) -> tuple[tuple[BinnedSpectrum, ...], tuple[Target, ...]]:
    """Shift the targets to where all channels show them.

    Parameters
    ----------
    binned : tuple of BinnedSpectrum
        Of each channel, with the same bins and neighbours.
    targets : tuple of Target
        A cluster of modes.

    Returns
    -------
    binned : tuple of BinnedSpectrum
        With the neighbours moved by the common shift.
    targets : tuple of Target
        At their start values; ``nominal`` holds the described frequency.
    """
    own = len(targets)
    modes = (*targets, *binned[0].neighbours)
    nominal = np.array([mode.frequency for mode in modes])
    zeta = np.array([mode.damping_ratio for mode in modes])
    search = np.array([mode.search for mode in modes])

    def best(shifts: FloatArray) -> FloatArray:
        cost = shift_cost(shifts, search, own)
        f = nominal * np.exp(shifts)
        dampings = np.broadcast_to(zeta, f.shape)
        cost += incoherent_fit(binned, f, dampings, updates=_FEW_UPDATES)[1].sum(axis=0)
        return np.asarray(shifts[int(np.argmin(cost))])

    reach = float(np.log1p(search.min()))
    shift = best(np.linspace(-reach, reach, _COMMON_STEPS)[:, None] * np.ones(nominal.size))
    for width in (3.0, 1.0):
        for i in range(own):
            moved = np.tile(shift, (_OWN_STEPS, 1))
            moved[:, i] += width * zeta[i] * np.linspace(-1, 1, _OWN_STEPS)
            shift = best(moved[np.abs(moved[:, i]) <= np.log1p(search[i])])
    located = tuple(
        replace(mode, frequency=float(f), nominal=mode.frequency)
        for mode, f in zip(modes, nominal * np.exp(shift), strict=True)
    )
    return tuple(replace(one, neighbours=located[own:]) for one in binned), located[:own]


def screen(
    binned: tuple[BinnedSpectrum, ...], targets: tuple[Target, ...]
) -> tuple[tuple[Target, ...], dict[str, float]]:
    """Drop modes that the binned spectra do not need.

    Returns those that remain, with refined start dampings, and the gain in log likelihood by each
    mode, by name.
    """

    def misfit(some: tuple[Target, ...]) -> float:
        return float(misfits(binned, some).sum())

    scaled = (
        tuple(replace(t, damping_ratio=t.damping_ratio * factor) for t in targets)
        for factor in (0.5, 1.0, 2.0)
    )
    kept = min(scaled, key=misfit)
    gains: dict[str, float] = {}
    while kept:
        full = misfit(kept)
        losses = [misfit(kept[:i] + kept[i + 1 :]) - full for i in range(len(kept))]
        gains |= {t.name: loss for t, loss in zip(kept, losses, strict=True)}
        worst = int(np.argmin(losses))
        if losses[worst] >= constants.ABSENT:
            break
        kept = kept[:worst] + kept[worst + 1 :]
    return kept, gains


def prepare(
    spectra: LogSpectra, binned: tuple[BinnedSpectrum, ...], present: tuple[Target, ...]
) -> ClusterData:
    """Select the channels that show any of the modes, and scale each by its noise."""
    gains = misfits(binned, ()) - misfits(binned, present)
    index = [c for c, gain in enumerate(gains) if gain >= constants.ABSENT]
    index = index or [int(np.argmax(gains))]
    used = [binned[c] for c in index]
    noise = np.maximum(strengths(used, present)[1], [1e-2 * one.level.min() for one in used])
    unit = np.sqrt(noise)
    chosen = spectra.select(index)
    scaled = tuple(replace(s, matrix=s.matrix / np.outer(unit, unit)) for s in chosen.spectra)
    return ClusterData(
        replace(chosen, spectra=scaled),
        unit,
        tuple(replace(one, level=one.level / n) for one, n in zip(used, noise, strict=True)),
        tuple(s.free for s in scaled),
    )
