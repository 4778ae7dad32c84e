"""How well modes can be known: the laws of long records and the Cramér-Rao bounds.

No unbiased estimator does better than its bound, whatever it is made of: what a plan may count
on, and what an identification is measured by.
"""

from __future__ import annotations

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.restricted import TransientLikelihood, unit_level
from lmshealth.transient import Block, pole_columns

# Steps of the differences by which several modes' densities are differentiated, in ln.
_STEP = 1e-5
# Of the logarithm of the noise's level beforehand: without it an ever smaller noise would still
# cost what an unknown part of its shape does.
_NOISE_STD = 3.0


def band_factors(kappa: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """Tell how much of the information about a mode lies in a band around it.

    With x = (f_k − f)/(ζ f) the resonance is 1/(1 + x²), its derivatives by ln f and ln ζ are
    2x/(1 + x²)/ζ and −2/(1 + x²); integrated from −κ to κ, and less what the unknown strength
    takes of the damping,

        B_f = 2/π (arctan κ − κ/(κ² + 1)),
        B_ζ = 2/π (arctan κ + κ/(κ² + 1) − 2 (arctan κ)²/κ).

    Parameters
    ----------
    kappa : ndarray or float
        The band reaches from f (1 − κ ζ) to f (1 + κ ζ).

    Returns
    -------
    b_f, b_zeta : ndarray
        Of the shape of ``kappa``; both rise to 1 for a wide band.

    References
    ----------
    Au2014
    """
    kappa = np.asarray(kappa, dtype=np.float64)
    arc, fraction = np.arctan(kappa), kappa / (kappa**2 + 1)
    b_f = 2 / np.pi * (arc - fraction)
    b_zeta = 2 / np.pi * (arc + fraction - 2 * arc**2 / kappa)
    return np.asarray(b_f), np.asarray(b_zeta)


def long_record_law(
    frequency: FloatArray | float,
    damping_ratio: FloatArray | float,
    duration: FloatArray | float,
    kappa: FloatArray | float = np.inf,
) -> tuple[FloatArray, FloatArray]:
    """Predict standard deviations from a long, noise-free ambient record of a single mode.

    std(ln f) = √(ζ/(2π N_c B_f)) and std(ln ζ) = 1/√(2π ζ N_c B_ζ), where the record holds
    N_c = f T cycles. It says nothing of noise, of which `ambient_bound` knows.

    Parameters
    ----------
    frequency, damping_ratio, duration, kappa : ndarray or float
        Natural frequency in Hz, damping ratio, total length of the records in s, and half width
        of the band as of `band_factors`; broadcast against each other.

    Returns
    -------
    std_ln_f, std_ln_zeta : ndarray
        Coefficients of variation, of the broadcast shape.

    References
    ----------
    Au2014
    """
    zeta = np.asarray(damping_ratio, dtype=np.float64)
    cycles = np.asarray(frequency, dtype=np.float64) * duration
    # The factors approach 1 as 1 - 2/κ and so on: for an infinite band as for a huge one.
    b_f, b_zeta = band_factors(np.minimum(kappa, 1e12))
    std_ln_f = np.sqrt(zeta / (2 * np.pi * cycles * b_f))
    return np.asarray(std_ln_f), np.asarray(1 / np.sqrt(2 * np.pi * zeta * cycles * b_zeta))


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


def joint_bound(
    frequency: FloatArray,
    damping_ratio: FloatArray,
    shapes: FloatArray,
    force: FloatArray,
    noise: float,
    duration: float,
    *,
    band: tuple[float, float],
) -> FloatArray:
    """Bound the joint covariance of several, possibly close, modes from ambient accelerations.

    The channels have the power spectral density matrix Φ D Φᵀ + S_e I with D = H S Hᴴ, where S is
    that of the modal forces. Unknown besides frequencies and dampings are shapes, strengths,
    the coherence of forces that are coherent, and the noise's level.

    Parameters
    ----------
    frequency, damping_ratio : ndarray
        Natural frequencies in Hz and damping ratios, shape ``(n_modes,)``.
    shapes : ndarray
        Φ, shape ``(n_channels, n_modes)``.
    force : ndarray
        S, Hermitian, (m/s²)²/Hz, shape ``(n_modes, n_modes)``. Where it is diagonal the forces
        are taken to be known as independent.
    noise : float
        S_e, (m/s²)²/Hz, the same in every channel.
    duration : float
        Of the record in s.
    band : (float, float)
        Band in Hz.

    Returns
    -------
    ndarray
        Covariance of ``[ln f, ln ζ]``, shape ``(2 n_modes, 2 n_modes)``.
    """
    m, n = len(frequency), shapes.shape[0]
    f = _fourier(duration, band)
    pairs = [(i, j) for i in range(m) for j in range(i) if force[i, j] != 0]
    force = np.asarray(force, dtype=complex)

    def density(p: FloatArray) -> np.ndarray:
        beta = np.exp(p[:m]) / f[:, None]
        response = 1 / (1 - beta**2 - 2j * np.exp(p[m : 2 * m]) * beta)
        forces = force.copy()
        for k, (i, j) in enumerate(pairs):
            size = np.sqrt((force[i, i] * force[j, j]).real)
            forces[i, j] += size * (p[-2 * k - 2] + 1j * p[-2 * k - 1])
            forces[j, i] = forces[i, j].conj()
        # A shape's length stands for the strength of its force.
        paths = response[:, None, :] * p[2 * m : 2 * m + n * m].reshape(n, m)
        noisy = np.exp(p[2 * m + n * m]) * np.eye(n)
        return np.asarray(paths @ forces @ np.swapaxes(paths.conj(), 1, 2) + noisy)

    start = np.concatenate(
        [np.log(frequency), np.log(damping_ratio), np.ravel(shapes), [np.log(noise)],
         np.zeros(2 * len(pairs))]
    )  # fmt: skip
    inverse = np.linalg.inv(density(start))
    scale = np.ones(start.size)
    scale[2 * m : 2 * m + n * m] = np.abs(shapes).max()
    slopes = [
        inverse @ (density(start + step) - density(start - step)) / (2 * _STEP)
        for step in _STEP * np.diag(scale)
    ]
    stacked = np.array(slopes)
    fisher = np.einsum("qkab,rkba->qr", stacked, stacked, optimize=True).real
    level = 2 * m + n * m
    fisher[level, level] += _NOISE_STD**-2
    return _marginal(fisher, 2 * m)


def decay_bound(
    frequency: float,
    damping_ratio: float,
    amplitude: FloatArray,
    noise: FloatArray,
    ambient: float,
    *,
    duration: float,
    band: tuple[float, float],
) -> FloatArray:
    """Bound the covariance of one mode's estimate from free decays in noise and its own response.

    Unknown besides frequency and damping are amplitude and phase of every decay in every channel,
    and the levels of both noises; what leaks into the band is known to be nothing.

    Parameters
    ----------
    frequency, damping_ratio : float
        Natural frequency in Hz and damping ratio.
    amplitude : ndarray of complex
        Of the acceleration at the beginning of each decay, shape ``(n_decays, n_channels)``; its
        real parts' ratios between channels are those of the ambient response too.
    noise : ndarray
        White noise's one-sided power spectral density of each channel, shape ``(n_channels,)``.
    ambient : float
        One-sided power spectral density S of the modal force per mass in the first channel.
    duration : float
        Of each decay in s.
    band : (float, float)
        Band in Hz.

    Returns
    -------
    ndarray
        Covariance of ``[ln f, ln ζ]``, shape ``(2, 2)``.
    """
    amplitude = np.atleast_2d(amplitude)
    n_decays, n = amplitude.shape
    # So fast that nothing aliases; the band alone counts.
    size = int(np.ceil(20 * band[1] * duration))
    rate = size / duration
    k = np.arange(np.ceil(band[0] * duration), np.floor(band[1] * duration) + 1)
    block = Block(
        k / duration, np.empty((n_decays, k.size, n)), duration, rate, np.empty((k.size, 0))
    )
    columns, _ = pole_columns(block, np.array([frequency]), np.array([damping_ratio]))
    exponent = 2 * np.pi * frequency * (-damping_ratio + 1j * np.sqrt(1 - damping_ratio**2))
    size = amplitude * (1 - np.exp(exponent * duration)) / 2 * np.sqrt(2 * duration)
    stacked = np.einsum("rp,psc->src", columns[0], np.stack([size.real, size.imag]))
    ordinates = stacked[:, : k.size] + 1j * stacked[:, k.size :]
    shape = (amplitude[0] / amplitude[0, 0]).real
    block = Block(block.frequency, ordinates, duration, rate, block.base)
    unit = unit_level(frequency, damping_ratio, duration)
    likelihood = TransientLikelihood((block,), shape[None], np.array([unit]), np.log(noise))
    level = np.sqrt(ambient * unit)
    p = np.concatenate([np.log([frequency, damping_ratio]), [level], np.log(noise), np.zeros(n)])
    fisher = likelihood.evaluate(p).fisher
    known = np.arange(3 + n) if level > 0 else np.delete(np.arange(3 + n), 2)
    return _marginal(fisher[np.ix_(known, known)], 2)


def _fourier(duration: float, band: tuple[float, float]) -> FloatArray:
    low, high = band
    return np.arange(max(1.0, np.ceil(low * duration)), np.floor(high * duration) + 1) / duration


def _marginal(fisher: FloatArray, n: int) -> FloatArray:
    """Invert an information matrix for its first ``n`` parameters, the others unknown."""
    scale = np.sqrt(np.diag(fisher))
    inverse = np.linalg.inv(fisher / np.outer(scale, scale))
    return np.asarray((inverse / np.outer(scale, scale))[:n, :n])
