"""How steady the excitation of a mode is over time (README.md of this folder, "Unsteady force")."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lmshealth._arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.whittle import response
from lmshealth.signal.spectra import CrossSpectrum

# Half width of the band whose envelope is read, in damping ratios. The products of its ordinates
# then count over the same lags as those of the scores of ln f and ln ζ, whose correlation falls to
# one half at a lag of the half-power bandwidth.
_BAND = 3.4


class Unsteadiness(NamedTuple):
    """Mean square of the intensity over the square of its mean, and the ordinates it is from."""

    ratio: float
    n: int

    @property
    def is_clear(self) -> bool:
        """Whether a steady force would not show this ratio: its standard deviation is n^-½."""
        least = 1 + constants.UNSTEADY_SIGMAS / np.sqrt(max(self.n, 1))
        return bool(self.ratio > max(constants.UNSTEADY, least))


def unsteadiness(
    spectra: Sequence[CrossSpectrum],
    masks: Sequence[BoolArray],
    expected: Sequence[ComplexArray],
    f: float,
    zeta: float,
    shape: FloatArray,
) -> Unsteadiness:
    """Compute the unsteadiness of the force of a mode from its kurtosis; 1 for a steady force.

    ``masks`` hold the ordinates without lines, ``expected`` the expectation of each spectrum, and
    ``shape`` the mode, ``(n_channels,)``. Without transforms the ratio is 1.
    """
    fourth = square = total = 0.0
    n = 0
    for spectrum, mask, e in zip(spectra, masks, expected, strict=True):
        near = mask & (np.abs(spectrum.frequency - f) < _BAND * zeta * f)
        if spectrum.transforms is None or not near.any():
            continue
        place = np.flatnonzero(near)
        # The force as the channels show it best, h* φᵀ E⁻¹ F, at twice the rate of its band.
        weight = (
            response(np.asarray(f), np.asarray(zeta), spectrum.frequency[near])[:, None]
            * np.linalg.solve(
                e[near], np.broadcast_to(shape[:, None], (place.size, shape.size, 1))
            )[:, :, 0]
        )
        size = 2 * (place[-1] + 1 - place[0])
        force = np.zeros((len(spectrum.transforms), size), dtype=complex)
        force[:, place - place[0]] = np.sum(spectrum.transforms[:, near] * weight.conj(), axis=2)
        intensity = np.abs(np.fft.ifft(force, axis=1) * size) ** 2 / spectrum.duration
        fourth += spectrum.observed * float(np.mean(intensity**2))
        square += spectrum.observed * float(np.mean(intensity))
        total += spectrum.observed
        n += spectrum.count * place.size
    return Unsteadiness(total * fourth / (2 * square**2) if n else 1.0, n)
