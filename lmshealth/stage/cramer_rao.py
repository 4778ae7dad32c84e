"""Cramér-Rao bound of one mode identified from ambient accelerations with noise."""

from __future__ import annotations

import numpy as np

from lmshealth._arrays import FloatArray

# Of the logarithm of the noise's level beforehand: without it an ever smaller noise would still
# cost what an unknown part of its shape does.
_NOISE_STD = 3.0


def ambient_bound(
    frequency: float,
    damping_ratio: float,
    snr: float,
    duration: float,
    *,
    band: tuple[float, float],
    n_channels: int = 1,
) -> FloatArray:
    """Bound the covariance of one mode's estimate from ambient accelerations with noise.

    Of the channels' covariance S D φφᵀ + S_e I one eigenvalue is S D + S_e and all others are
    S_e: further channels tell the noise, and the mode only through the sum of their SNR.

    Parameters
    ----------
    frequency, damping_ratio : float
        Natural frequency in Hz and damping ratio.
    snr : float
        Modal signal-to-noise ratio S / (4 ζ² S_e), summed over the channels.
    duration : float
        Of the record in s. Several records of one length: multiply the result by 1/their number.
    band : (float, float)
        Band in Hz in which the noise is white with an unknown level.
    n_channels : int
        Number of channels with that noise.

    Returns
    -------
    ndarray
        Covariance of ``[ln f, ln ζ]``, shape ``(2, 2)``.
    """
    f = _fourier(duration, band)
    beta2 = (frequency / f) ** 2
    damped = 4 * damping_ratio**2 * beta2
    under = (1 - beta2) ** 2 + damped
    modal = 4 * damping_ratio**2 * snr / under
    share = modal / (modal + 1)
    slopes = np.stack(
        [
            share * (4 * beta2 * (1 - beta2) - 2 * damped) / under,
            -2 * share * damped / under,
            share,
            1 - share,
        ]
    )
    fisher = slopes @ slopes.T
    fisher[3, 3] += (n_channels - 1) * f.size + _NOISE_STD**-2
    return _marginal(fisher, 2)


def _fourier(duration: float, band: tuple[float, float]) -> FloatArray:
    low, high = band
    return np.arange(max(1.0, np.ceil(low * duration)), np.floor(high * duration) + 1) / duration


def _marginal(fisher: FloatArray, n: int) -> FloatArray:
    """Invert an information matrix for its first ``n`` parameters, the others unknown."""
    scale = np.sqrt(np.diag(fisher))
    inverse = np.linalg.inv(fisher / np.outer(scale, scale))
    return np.asarray((inverse / np.outer(scale, scale))[:n, :n])
