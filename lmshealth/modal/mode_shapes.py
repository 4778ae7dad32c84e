"""Complex mode shapes from the spectra at each resonance, modal assurance criterion, complexity.

The fit of a cluster publishes the part of its shapes in phase. Here the shape of a mode is φ = R v,
v the eigenvector of the largest λ in A v = λ R v: A is the sum of the cross spectra over the
half-power band, R that of the noise and of the other modes by the fit. Without other modes it is
the first singular vector at the peak, as in frequency domain decomposition.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from lmshealth._private.arrays import ComplexArray, FloatArray, freeze
from lmshealth.modal.ambient.cluster_modes import FittedSpectrum
from lmshealth.modal.modes import Modes
from lmshealth.modal.naming import assurance

# Ordinates near the resonance that are averaged at least; passes, as shapes of neighbours change.
_LEAST_ORDINATES, _ROUNDS = 3, 2


@dataclass(frozen=True, slots=True, eq=False)
class ModeShapes:
    """Complex shapes of the modes of a log, of accelerations (see `Modes.shapes`)."""

    names: tuple[str, ...]  # of the modes
    channels: tuple[str, ...]
    # Scaled so that the largest component is 1, shape ``(n_modes, n_channels)``; NaN in channels
    # that do not show the mode.
    shapes: ComplexArray

    def __post_init__(self) -> None:
        freeze(self, ("shapes", len(self.names), len(self.channels)))

    @property
    def complexity(self) -> FloatArray:
        """Modal phase collinearity, shape ``(n_modes,)``: 1 for real shapes [Pappa1993].

        NaN for a shape of one channel.
        """
        x, y = np.nan_to_num(self.shapes.real), np.nan_to_num(self.shapes.imag)
        xx, yy, xy = (x * x).sum(axis=1), (y * y).sum(axis=1), (x * y).sum(axis=1)
        several = np.isfinite(self.shapes).sum(axis=1) > 1
        total = np.where(several, xx + yy, np.nan)
        return np.asarray(((xx - yy) ** 2 + 4 * xy**2) / total**2)

    @property
    def mac(self) -> FloatArray:
        """Modal assurance criterion of each pair over their common channels [Allemang2003].

        Shape ``(n_modes, n_modes)``; NaN for pairs with less than two common channels.
        """
        return assurance(self.shapes, self.shapes)

    def mac_with(self, other: "ModeShapes") -> FloatArray:
        """MAC of each mode with the mode of its name in another log, shape ``(n_modes,)``.

        NaN where the other log lacks the mode, or has less than two channels of it in common.
        """
        common = [name for name in self.channels if name in other.channels]
        own, others = (
            one.shapes[:, [one.channels.index(name) for name in common]] for one in (self, other)
        )
        named = np.array(self.names)[:, None] == np.array(other.names)
        pairs = np.where(named, assurance(own, others), np.nan)
        found = np.fmax.reduce(pairs, axis=1, initial=-1.0)
        return np.where(found < 0, np.nan, found)


def mode_shapes(modes: Modes, fitted: Sequence[FittedSpectrum]) -> ModeShapes:
    """Estimate the complex shapes of modes from the spectra that they were fitted to."""
    shapes = np.where(np.isfinite(modes.shapes), modes.shapes, np.nan) + 0j
    for _ in range(_ROUNDS):
        before = shapes.copy()
        for i, f in enumerate(modes.frequency.tolist()):
            there = np.flatnonzero(np.isfinite(modes.shapes[i]))
            names = tuple(modes.shape_channels[c] for c in there)
            own = [fit for fit in fitted if fit.channels == names]
            fit = max(own, key=lambda fit: _distance_from_ends(fit, f), default=None)
            if fit is not None:
                shapes[i, there] = _direction(fit, modes, i, before[:, there])
    if shapes.size:
        largest = np.nan_to_num(np.abs(shapes)).argmax(axis=1)[:, None]
        shapes = shapes / np.take_along_axis(shapes, largest, axis=1)
    return ModeShapes(modes.names, modes.shape_channels, shapes)


def _distance_from_ends(fit: FittedSpectrum, f: float) -> float:
    return float(min(f - fit.spectrum.frequency[0], fit.spectrum.frequency[-1] - f))


def _direction(fit: FittedSpectrum, modes: Modes, i: int, shapes: ComplexArray) -> ComplexArray:
    """Return the shape of mode i, given shapes of all modes, ``(n_modes, n_channels)``."""
    from lmshealth.modal.ambient.whittle import response  # late: reading a result needs none of it

    frequency, f, zeta = fit.spectrum.frequency, modes.frequency, modes.damping_ratio
    known = np.flatnonzero(np.isfinite(fit.density[:, 0]))  # no line
    off = np.abs(frequency[known] - f[i])
    reach = max(zeta[i] * f[i], np.sort(off)[:_LEAST_ORDINATES][-1])
    near = known[off <= reach]
    rest = near.size * np.eye(len(fit.channels), dtype=complex)
    if fit.spectrum.foreign is not None:
        foreign = np.moveaxis(fit.spectrum.foreign[near], 1, 0).reshape(len(rest), -1)
        rest += foreign @ foreign.conj().T
    for j in np.flatnonzero(np.isfinite(shapes).all(axis=1)):
        if j != i:
            psi = shapes[j] / fit.unit
            psi = psi / np.linalg.norm(psi)
            gain = np.abs(response(f[j], zeta[j], frequency[near])) ** 2
            power = 4 * zeta[j] ** 2 * modes.snr[j] * float(gain.sum())
            rest += power * np.outer(psi, psi.conj())
    _, vectors = eigh(fit.spectrum.sums([near])[0] / fit.spectrum.count, rest)
    return np.asarray(rest @ vectors[:, -1] * fit.unit, dtype=np.complex128)
