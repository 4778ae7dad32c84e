"""Start values for the identification: where the modes of a cluster stand, seen by all channels.

Wear moves all modes of a guide together, so that one mode may come to stand where another began.
The start is therefore a common shift first, then a small one per mode, judged on all channels at
once by an incoherent sum of resonances on a coarsely binned spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from lmshealth.results import FloatArray
from lmshealth.spectra import Spectrum

_COMMON_STEPS = 41
_OWN_STEPS = 15


@dataclass(frozen=True, slots=True)
class Target:
    """A mode to look for.

    Attributes
    ----------
    name : str
        Of the mode.
    frequency : float
        Where to look, in Hz.
    damping_ratio : float
        Start value.
    search : float
        Half width of the search, as a fraction of the frequency.
    """

    name: str
    frequency: float
    damping_ratio: float
    search: float

    def band(self, widths: float) -> tuple[float, float]:
        """Frequencies within so many damping ratios of the target."""
        half = widths * self.damping_ratio
        return self.frequency * (1 - min(half, 0.5)), self.frequency * (1 + half)


@dataclass(frozen=True, slots=True, eq=False)
class Coarse:
    """A binned spectrum, robust against lines.

    Attributes
    ----------
    frequency, level, count : ndarray
        Mean frequency in Hz, density from the median, and number of ordinates, ``(n_bins,)``.
    """

    frequency: FloatArray
    level: FloatArray
    count: FloatArray


def coarsen(spectra: tuple[Spectrum, ...], low: float, high: float, width: float) -> Coarse:
    """Bin the ordinates of all segments of a channel.

    Parameters
    ----------
    spectra : tuple of Spectrum
        One per segment.
    low, high : float
        Band in Hz.
    width : float
        Bin width in Hz; widened until a bin holds at least four ordinates.
    """
    cut = [spectrum.band(low, high) for spectrum in spectra]
    frequency = np.concatenate([s.frequency for s in cut])
    ordinates = np.concatenate([s.periodogram for s in cut])
    order = np.argsort(frequency, kind="stable")
    n_bins = max(3, min(int((high - low) / width), frequency.size // 4))
    parts = np.array_split(order, n_bins)
    return Coarse(
        frequency=np.array([frequency[part].mean() for part in parts]),
        level=np.array([max(np.median(ordinates[part]), 1e-300) for part in parts]) / np.log(2),
        count=np.array([part.size for part in parts], dtype=float),
    )


def resonances(frequency: FloatArray, f: FloatArray, zeta: FloatArray) -> FloatArray:
    """Acceleration resonances 1 / ((1 - β²)² + (2ζβ)²), shape ``(n_frequency, n_modes)``."""
    beta = f / frequency[:, None]
    return np.asarray(1 / ((1 - beta**2) ** 2 + (2 * zeta * beta) ** 2))


def incoherent_fit(coarse: Coarse, f: FloatArray, zeta: FloatArray) -> tuple[FloatArray, float]:
    """Fit strengths of resonances and a white noise to a binned spectrum.

    Parameters
    ----------
    coarse : Coarse
        Binned spectrum.
    f, zeta : ndarray
        Natural frequencies in Hz and damping ratios, shape ``(n_modes,)``.

    Returns
    -------
    strength : ndarray
        Modal PSD of each mode, then the noise PSD, shape ``(n_modes + 1,)``.
    misfit : float
        Whittle misfit of the binned spectrum.
    """
    design = np.column_stack([resonances(coarse.frequency, f, zeta), np.ones(coarse.level.size)])
    # Columns differ by orders of magnitude; NNLS stops on absolute tolerances.
    unit = design.max(axis=0)
    model = coarse.level
    strength = np.zeros(unit.size)
    for _ in range(2):
        weight = np.sqrt(coarse.count) / model
        strength = nnls(design / unit * weight[:, None], coarse.level * weight)[0]
        model = np.maximum(design / unit @ strength, 1e-3 * coarse.level)
    misfit = float(np.sum(coarse.count * (np.log(model) + coarse.level / model)))
    return strength / unit, misfit


def locate(coarse: tuple[Coarse, ...], targets: tuple[Target, ...]) -> FloatArray:
    """Find where the targets stand, by all channels together.

    Parameters
    ----------
    coarse : tuple of Coarse
        Binned spectrum of each channel.
    targets : tuple of Target
        A cluster of modes.

    Returns
    -------
    ndarray
        Frequencies in Hz, shape ``(n_modes,)``.
    """
    nominal = np.array([target.frequency for target in targets])
    zeta = np.array([target.damping_ratio for target in targets])
    search = np.array([target.search for target in targets])

    def cost(shift: FloatArray) -> float:
        # Shifts are a priori half the search together and a sixth of it apart.
        common = shift.mean()
        prior = 0.5 * (common / (search.mean() / 2)) ** 2
        prior += 0.5 * float(np.sum(((shift - common) / (search / 6)) ** 2))
        f = nominal * np.exp(shift)
        return float(prior) + sum(incoherent_fit(channel, f, zeta)[1] for channel in coarse)

    grid = np.linspace(-1, 1, _COMMON_STEPS)
    reach = float(np.log1p(search.min()))
    shift = min((np.full(nominal.size, reach * g) for g in grid), key=cost)
    own = np.linspace(-1, 1, _OWN_STEPS)
    for width in (3.0, 1.0):
        for i in range(nominal.size):
            moved = [shift + width * zeta[i] * g * np.eye(nominal.size)[i] for g in own]
            shift = min([m for m in moved if abs(m[i]) <= np.log1p(search[i])] or [shift], key=cost)
    return np.asarray(nominal * np.exp(shift))
