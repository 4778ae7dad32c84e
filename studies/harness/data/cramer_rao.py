"""Bounds on how well modes can be identified: laws of long records, and Cramér-Rao bounds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lmshealth._private.arrays import ComplexArray, FloatArray, freeze
from lmshealth.modal.deterministic.likelihood import (
    BandSpectra,
    ModalLikelihood,
    pole_columns,
    unit_level,
)
from lmshealth.stage.identifiability import NOISE_STD, fourier_frequencies, marginal_covariance

# Steps of the differences by which several modes' densities are differentiated, in ln.
_STEP = 1e-5


def band_factors(kappa: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """Return how much of the information about a mode lies in a band around it.

    With x = (f_k − f)/(ζ f) the resonance is 1/(1 + x²), its derivatives by ln f and ln ζ are
    2x/(1 + x²)/ζ and −2/(1 + x²); integrated from −κ to κ, and less what the unknown strength
    takes of the damping,

        B_f = 2/π (arctan κ − κ/(κ² + 1)),
        B_ζ = 2/π (arctan κ + κ/(κ² + 1) − 2 (arctan κ)²/κ),

    for a band from f (1 − κ ζ) to f (1 + κ ζ) (Au2014).
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
    N_c = f T cycles, f is in Hz, T in s, and κ as in `band_factors` (Au2014).
    """
    zeta = np.asarray(damping_ratio, dtype=np.float64)
    cycles = np.asarray(frequency, dtype=np.float64) * duration
    # The factors approach 1 as 1 - 2/κ and so on: for an infinite band as for a huge one.
    b_f, b_zeta = band_factors(np.minimum(kappa, 1e12))
    std_ln_f = np.sqrt(zeta / (2 * np.pi * cycles * b_f))
    return np.asarray(std_ln_f), np.asarray(1 / np.sqrt(2 * np.pi * zeta * cycles * b_zeta))


@dataclass(frozen=True, slots=True, eq=False)
class Vibration:
    """Modes as channels see them."""

    frequency: FloatArray  # in Hz, (n_modes,)
    damping_ratio: FloatArray  # (n_modes,)
    shapes: FloatArray  # Φ, real, (n_channels, n_modes)

    def __post_init__(self) -> None:
        n_modes = self.frequency.size
        freeze(self, ("damping_ratio", n_modes), ("shapes", len(self.shapes), n_modes))


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """What is recorded of them."""

    noise: FloatArray  # one-sided density of each channel's white noise, (m/s²)²/Hz, (n_channels,)
    duration: float  # in s
    band: tuple[float, float]  # that is evaluated, in Hz


def joint_bound(modes: Vibration, force: FloatArray, recording: Recording) -> FloatArray:
    """Bound the joint covariance of several, possibly close, modes from ambient accelerations.

    The channels have the power spectral density matrix Φ D Φᵀ + diag(S_e) with D = H S Hᴴ, where S
    in (m/s²)²/Hz is the ``force``, Hermitian, ``(n_modes, n_modes)``; where it is 0 off the
    diagonal, forces are known to be independent. Unknown besides frequencies and dampings are
    shapes, strengths, the coherence of coherent forces, and each channel's noise. Returns the
    covariance of ``[ln f, ln ζ]`` from one record; of several it is this over their number.
    """
    n, m = modes.shapes.shape
    f = fourier_frequencies(recording.duration, recording.band)
    pairs = [(i, j) for i in range(m) for j in range(i) if force[i, j] != 0]
    levels = slice(2 * m + n * m, 2 * m + n * m + n)

    def density(p: FloatArray) -> ComplexArray:
        beta = np.exp(p[:m]) / f[:, None]
        response = 1 / (1 - beta**2 - 2j * np.exp(p[m : 2 * m]) * beta)
        forces = np.array(force, dtype=complex)
        coherence = p[levels.stop :].reshape(-1, 2) @ [1, 1j]
        for (i, j), change in zip(pairs, coherence, strict=True):
            forces[i, j] += np.sqrt((force[i, i] * force[j, j]).real) * change
            forces[j, i] = forces[i, j].conj()
        # The norm of a shape is the strength of its force.
        paths = response[:, None, :] * p[2 * m : levels.start].reshape(n, m)
        seen = paths @ forces @ np.swapaxes(paths.conj(), 1, 2)
        return np.asarray(seen + np.diag(np.exp(p[levels])))

    ends = [np.log(modes.frequency), np.log(modes.damping_ratio), np.ravel(modes.shapes)]
    start = np.concatenate([*ends, np.log(recording.noise), np.zeros(2 * len(pairs))])
    scale = np.ones(start.size)
    scale[2 * m : levels.start] = np.abs(modes.shapes).max()
    inverse = np.linalg.inv(density(start))
    slopes = np.array(
        [
            inverse @ (density(start + step) - density(start - step)) / (2 * _STEP)
            for step in _STEP * np.diag(scale)
        ]
    )
    fisher = np.einsum("qkab,rkba->qr", slopes, slopes, optimize=True).real
    place = np.arange(levels.start, levels.stop)
    fisher[place, place] += NOISE_STD**-2
    return marginal_covariance(fisher, 2 * m)


def decay_bound(
    modes: Vibration, amplitude: ComplexArray, ambient: FloatArray, recording: Recording
) -> FloatArray:
    """Bound the joint covariance of modes from free decays in noise and their own response.

    Unknown besides frequencies and dampings are amplitude and phase of every decay in every
    channel, and the levels of all noises; what leaks into the band is known to be nothing.
    ``amplitude`` is that of each mode's acceleration at the beginning of each decay, m/s²,
    ``(n_decays, n_modes)``; ``ambient`` the one-sided density of each mode's force, (m/s²)²/Hz,
    known to be 0 where it is. Returns the covariance of ``[ln f, ln ζ]``.
    """
    n, m = modes.shapes.shape
    f, zeta, duration = modes.frequency, modes.damping_ratio, recording.duration
    # So fast that nothing aliases; the band alone counts.
    n_samples = int(np.ceil(20 * recording.band[1] * duration))
    fourier = fourier_frequencies(duration, recording.band)
    empty = np.empty((fourier.size, 0), dtype=complex)
    rate, base = n_samples / duration, np.empty((2 * fourier.size, 0))
    block = BandSpectra(fourier, empty, duration, rate, base)
    columns, _ = pole_columns(block, f, zeta)
    exponent = 2 * np.pi * f * (-zeta + 1j * np.sqrt(1 - zeta**2))
    sizes = amplitude * (1 - np.exp(exponent * duration)) * np.sqrt(duration / 2)
    stacked = np.einsum("mrp,psm,cm->src", columns, [sizes.real, sizes.imag], modes.shapes)
    block = replace(block, ordinates=stacked[:, : fourier.size] + 1j * stacked[:, fourier.size :])
    units = np.array([unit_level(*pair, duration) for pair in zip(f, zeta, strict=True)])
    levels = np.log(recording.noise)
    likelihood = ModalLikelihood((block,), modes.shapes.T, units, levels)
    p = np.concatenate([np.log(f), np.log(zeta), np.sqrt(ambient * units), levels, np.zeros(n)])
    unknown = np.delete(np.arange(3 * m + n), 2 * m + np.flatnonzero(ambient == 0))
    return marginal_covariance(likelihood.evaluate(p).fisher[np.ix_(unknown, unknown)], 2 * m)
