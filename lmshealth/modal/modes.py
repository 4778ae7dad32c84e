"""Result of the identification: modal estimates of one log with their joint covariance.

Arrays are read-only, time (or log) axis first, mode axis last, NaN where a value is missing.
SI units throughout: s, m, m/s, Hz, m/s²; temperatures are in °C because only their differences
are used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lmshealth._arrays import FloatArray, expect_shape, freeze
from lmshealth.io.log import Refusal
from lmshealth.signal.spectral_lines import Line


@dataclass(frozen=True, slots=True, eq=False)
class Modes:
    """Modal estimates of one log with their joint covariance.

    Attributes
    ----------
    names : tuple of str
        Mode names, unique per source; empty where another program gave none.
    sources : tuple of str
        ``acc``, ``delta_e``, ``frf`` or ``joint`` per mode.
    channels : tuple of str
        The channel each estimate comes from.
    ln_frequency : ndarray
        Natural logarithm of the natural frequency in Hz, shape ``(n_modes,)``.
    ln_damping : ndarray
        Natural logarithm of the damping ratio, shape ``(n_modes,)``.
    cov : ndarray
        Covariance of ``[ln_frequency, ln_damping]``, shape ``(2 n_modes, 2 n_modes)``.
    snr : ndarray
        Modal signal-to-noise ratio S / (4 ζ² S_e), shape ``(n_modes,)``.
    dispersion : ndarray
        Variance of what the fit leaves about each mode over what noise has: about one where the
        model is right, more where lines, other modes or changing conditions are in the data; NaN
        where it was not measured. Shape ``(n_modes,)``.
    flags : tuple of str
        What to bear in mind of each mode, separated by blanks: ``resolution-limited`` where the
        half-power bandwidth spans few Fourier frequencies, ``at-bound`` where frequency or
        damping is at the end of what was searched, ``loose-fit`` where the dispersion is clearly
        more than one, ``cluster`` where one stands for two that cannot be told apart.
    shape_channels : tuple of str
        The channels that shapes tell of; none where shapes were not identified.
    shapes : ndarray
        Acceleration of each channel in each mode, the following error's as its second derivative,
        shape ``(n_modes, n_shape_channels)``. Of each mode they have unit Euclidean norm, and the
        largest is positive; NaN in channels that did not see it.
    lines : tuple of Line
        Spectral lines that were kept out of the likelihood.
    refused : tuple of Refusal
        Modes that were looked for and not found, with the reason.
    """

    names: tuple[str, ...]
    sources: tuple[str, ...]
    channels: tuple[str, ...]
    ln_frequency: FloatArray
    ln_damping: FloatArray
    cov: FloatArray
    snr: FloatArray
    dispersion: FloatArray
    flags: tuple[str, ...]
    shape_channels: tuple[str, ...]
    shapes: FloatArray
    lines: tuple[Line, ...]
    refused: tuple[Refusal, ...]

    def __post_init__(self) -> None:
        n = len(self.names)
        named = [pair for pair in zip(self.names, self.sources, strict=True) if pair[0]]
        if len(set(named)) != len(named):
            raise ValueError(f"mode names are not unique per source: {self.names}")
        for name in ("ln_frequency", "ln_damping", "snr", "dispersion"):
            expect_shape(name, getattr(self, name), (n,))
        expect_shape("cov", self.cov, (2 * n, 2 * n))
        expect_shape("shapes", self.shapes, (n, len(self.shape_channels)))
        freeze(self)

    @property
    def frequency(self) -> FloatArray:
        """Natural frequency in Hz, shape ``(n_modes,)``."""
        return np.exp(self.ln_frequency)

    @property
    def frequency_std(self) -> FloatArray:
        """Standard deviation of the natural frequency in Hz, shape ``(n_modes,)``."""
        n = len(self.names)
        return self.frequency * np.sqrt(np.diag(self.cov)[:n])

    @property
    def damping_ratio(self) -> FloatArray:
        """Damping ratio, shape ``(n_modes,)``."""
        return np.exp(self.ln_damping)

    @property
    def damping_ratio_std(self) -> FloatArray:
        """Standard deviation of the damping ratio, shape ``(n_modes,)``."""
        n = len(self.names)
        return self.damping_ratio * np.sqrt(np.diag(self.cov)[n:])

    @property
    def correlation(self) -> FloatArray:
        """Correlation between frequency and damping ratio of each mode, shape ``(n_modes,)``."""
        n = len(self.names)
        std = np.sqrt(np.diag(self.cov))
        index = np.arange(n)
        return np.asarray(self.cov[index, index + n] / (std[:n] * std[n:]))
