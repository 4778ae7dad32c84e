"""Cramér-Rao bound of one mode identified from ambient accelerations in noise."""

import numpy as np

from lmshealth._private.arrays import FloatArray

# Prior standard deviation of the logarithm of the noise level. Without it an ever smaller noise
# would still cost what an unknown part of its spectrum does.
NOISE_STD = 3.0


def ambient_bound(
    frequency: float,
    damping_ratio: float,
    snr: float,
    duration: float,
    *,
    band: tuple[float, float],
    n_channels: int = 1,
) -> FloatArray:
    """Bound the covariance of [ln f, ln ζ], ``(2, 2)``, by ambient accelerations in white noise.

    Of the channels' covariance S D φφᵀ + S_e I one eigenvalue is S D + S_e and all others are S_e:
    further channels inform about the noise, and about the mode only by the sum of their SNR. See
    [Au2014].

    The natural frequency is in Hz, the modal signal-to-noise ratio S / (4 ζ² S_e) summed over the
    channels, the duration of the record in s: for n records of one length divide the result by n.
    In the band (Hz) the noise is white, with one unknown level in all channels.
    """
    f = fourier_frequencies(duration, band)
    beta2 = (frequency / f) ** 2
    damped = 4 * damping_ratio**2 * beta2
    under = (1 - beta2) ** 2 + damped
    modal = 4 * damping_ratio**2 * snr / under
    share = modal / (modal + 1)
    # Derivatives of ln(S D + S_e) by ln f, ln ζ, ln S and ln S_e.
    by_frequency = share * (4 * beta2 * (1 - beta2) - 2 * damped) / under
    slopes = np.stack([by_frequency, -2 * share * damped / under, share, 1 - share])
    fisher = slopes @ slopes.T
    fisher[3, 3] += (n_channels - 1) * f.size + NOISE_STD**-2
    return marginal_covariance(fisher, 2)


def fourier_frequencies(duration: float, band: tuple[float, float]) -> FloatArray:
    """List the Fourier frequencies in Hz within a band, zero excluded."""
    low, high = band
    return np.arange(max(1.0, np.ceil(low * duration)), np.floor(high * duration) + 1) / duration


def marginal_covariance(fisher: FloatArray, n: int) -> FloatArray:
    """Invert an information matrix for its first ``n`` parameters, the others unknown."""
    scale = np.sqrt(np.diag(fisher))
    inverse = np.linalg.inv(fisher / np.outer(scale, scale))
    return np.asarray((inverse / np.outer(scale, scale))[:n, :n])
