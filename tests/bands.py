"""Bands with known truth.

Likelihoods of three modes in up to four channels with white floors; records of two modes and their
fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from lmshealth.modal.ambient.cluster_fit import fit_modes
from lmshealth.modal.ambient.cluster_modes import ClusterModes
from lmshealth.modal.ambient.excitation import Colour
from lmshealth.modal.ambient.expected_periodogram import MeanOrdinates, average_ordinates
from lmshealth.modal.ambient.whittle import Likelihood, Marginal, lay_out
from lmshealth.modal.modes import Rejection
from lmshealth.modal.targets import Target
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra, cross_spectra
from lmshealth.stage.constants import BAND_HALF_WIDTH
from tests.oracles import channel_covariance
from tests.signals import Mode, accelerations, make_log

SHAPES = ((1.0, 0.4, -0.3, 0.2), (0.3, 1.0, 0.5, -0.6), (-0.4, 0.2, 1.0, 0.3))
MODES = tuple(
    Mode(f, zeta, psd, shape)
    for (f, zeta, psd), shape in zip(
        [(105.0, 0.015, 1.0), (120.0, 0.02, 2.0), (135.0, 0.025, 1.5)], SHAPES, strict=True
    )
)
NOISE = 0.5
BAND = (80.0, 170.0)
# Of records of two modes, and what is sought in them.
RATE = 1000.0
ROLL, PITCH = Target("roll", 105.0, 0.015, 0.15), Target("pitch", 125.0, 0.02, 0.15)


def flat_point(modes: Sequence[Mode], n_channels: int, noise: float = NOISE) -> np.ndarray:
    """Return the unknowns of independent forces and white floors."""
    layout = lay_out([i % n_channels for i in range(len(modes))], n_channels)
    return np.concatenate(
        [
            np.log([mode.frequency for mode in modes]),
            np.log([mode.damping for mode in modes]),
            np.zeros(len(modes)),
            np.tile([np.log(noise), 0.0, 0.0], n_channels),
            [float(i == j) for i, j in layout.force],
            [modes[i].shape[c] / modes[i].shape[i % n_channels] for c, i in layout.shape],
        ]
    )


def likelihood(
    modes: Sequence[Mode], n_channels: int, blocks: Sequence[MeanOrdinates], noise: float = NOISE
) -> Likelihood:
    """Build a likelihood that starts at the truth; mode i is one in channel i."""
    reference = [i % n_channels for i in range(len(modes))]
    size = [m.shape[c] * np.sqrt(m.psd) for m, c in zip(modes, reference, strict=True)]
    return Likelihood(
        blocks=tuple(blocks),
        layout=lay_out(reference, n_channels),
        start=flat_point(modes, n_channels, noise),
        scale=np.concatenate([size, np.ones(n_channels)]),
        centre=float(np.sqrt(BAND[0] * BAND[1])),
        spread=float(np.log(BAND[1] / BAND[0]) / 2),
    )


def other_point(target: Likelihood, seed: int = 0) -> np.ndarray:
    """Return a point with coherent forces and bent floors."""
    rng = np.random.default_rng(seed)
    m = target.layout.n_modes
    p = target.start + rng.normal(0, 0.3, target.layout.size)
    p[:m] = target.start[:m] + rng.normal(0, 0.02, m)
    return p


def covariance(target: Likelihood, p: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """Read the unknowns as documented, and let the oracle turn them into a covariance."""
    m, n = target.layout.n_modes, target.layout.n_channels
    e, d, b = p[3 * m : 3 * (m + n)].reshape(n, 3).T
    u = np.log(frequency / target.centre) / target.spread
    root, at = np.eye(m + n, dtype=complex), 3 * (m + n)
    turned = bool(target.layout.quadrature)
    for i in range(m + n):
        for j in range(i + 1 if i < m else i):
            if n == 1 and i < m and i - j > 1:  # one channel: neighbours alone share forces
                continue
            root[i, j] = target.scale[i] * p[at]
            at += 1
    for i, j in product(range(m), range(m)):
        if turned and j < i and (n > 1 or i - j == 1):
            root[i, j] += 1j * target.scale[i] * p[at]
            at += 1
    shapes = np.ones((n, m), dtype=complex)
    for i, c in product(range(m), range(n)):
        if c != i % n:
            shapes[c, i] = p[at]
            at += 1
    for i, c in product(range(m), range(n)):
        if turned and c != i % n:
            shapes[c, i] += 1j * p[at]
            at += 1
    assert at == p.size
    return channel_covariance(
        frequency,
        resonances=np.vstack([np.exp(p[: 2 * m].reshape(2, m)), p[2 * m : 3 * m]]).T,
        floors=[np.exp((e[c] + d[c] * u + b[c] * u**2) / 2) for c in range(n)],
        root=root,
        shapes=shapes,
    )


def frequencies(duration: float) -> np.ndarray:
    """Fourier frequencies of the band."""
    return np.arange(np.ceil(BAND[0] * duration), BAND[1] * duration) / duration


def spectrum_of(matrix: np.ndarray, duration: float, count: int = 1) -> CrossSpectrum:
    """Wrap matrices of all frequencies of the band."""
    f = frequencies(duration)
    free = np.ones(f.size, dtype=bool)
    return CrossSpectrum(f, with_mean(matrix, count), duration, float("nan"), free)


def with_mean(matrix: np.ndarray, count: int = 1) -> np.ndarray:
    """Return transforms of segments whose mean F F* is a matrix; of one, if that has rank one.

    Their phases are random, as those of a steady force.
    """
    n, size = len(matrix), max(count, 1)
    value, vector = np.linalg.eigh(matrix)
    columns = np.sqrt(value.clip(0) * size)[:, None, :] * vector
    shown = columns[:, :, ::-1][:, :, :size]  # the strongest
    transforms = np.zeros((size, n, matrix.shape[1]), dtype=complex)
    transforms[: shown.shape[2]] = np.moveaxis(shown, 2, 0)
    turn = np.random.default_rng(n).uniform(0, 2 * np.pi, (size, n, 1))
    return transforms * np.exp(1j * turn)


def block_of(spectra: Sequence[CrossSpectrum], *, merge: bool = False) -> MeanOrdinates:
    """Keep all ordinates; the bandwidth is that of the lightest mode of these tests."""
    keep = [np.ones(s.frequency.size, dtype=bool) for s in spectra]
    near = [mode.frequency for mode in MODES] if merge else None
    return average_ordinates(spectra, keep, 2 * 105.0 * 0.015, near=near)


def drawn(cov: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw complex normal vectors, shape ``(n, n_channels)``."""
    white = rng.standard_normal((2, *cov.shape[:2])) / np.sqrt(2)
    return np.einsum("kcd,kd->kc", np.linalg.cholesky(cov), white[0] + 1j * white[1])


def noisy(m: int, n: int, duration: float, count: int = 1) -> Likelihood:
    """Draw data from m modes in n channels under independent forces."""
    truth = likelihood(MODES[:m], n, [])
    cov = covariance(truth, truth.start, frequencies(duration))
    rng = np.random.default_rng([m, n])
    parts = [drawn(cov, rng) for _ in range(count)]
    mean = sum(x[:, :, None] * x[:, None].conj() for x in parts) / count
    return replace(truth, blocks=(block_of([spectrum_of(mean, duration, count)]),))


def scatter_free(
    modes: Sequence[Mode], n: int, duration: float, noise: float = NOISE, count: int = 1
) -> Likelihood:
    """Return a likelihood whose data are their own expectation."""
    truth = likelihood(modes, n, [], noise)
    f = frequencies(duration)
    empty = block_of([spectrum_of(np.tile(np.eye(n) + 0j, (f.size, 1, 1)), duration, count)])
    (expected,) = replace(truth, blocks=(empty,)).expected(truth.start)
    return replace(truth, blocks=(replace(empty, matrix=expected),))


def spectra_of(channels: np.ndarray) -> LogSpectra:
    """Transform accelerometers."""
    rows = np.atleast_2d(channels)
    made = make_log({f"acc_{k}": row for k, row in enumerate(rows)}, RATE).channels
    return LogSpectra(
        tuple(channel.name for channel in made),
        ("acc",) * len(made),
        cross_spectra(made, [Segment(0, rows.shape[1], float("nan"))], RATE, 200.0),
    )


def started(
    spectra: LogSpectra, targets: Sequence[Target], noise: np.ndarray
) -> tuple[Target, ...]:
    """Start targets with the strengths of the levels, and the signs of the cross spectra."""
    found = []
    for target in targets:
        low, high = target.band(1.0)
        near = spectra.longest.band(low, high).matrix.real.mean(axis=0)
        size = np.sqrt((np.diag(near) - noise).clip(1e-9 * noise)) * 2 * target.damping_ratio
        sign = np.where(near[size.argmax()] < 0, -1.0, 1.0)
        found.append(replace(target, amplitude=size * sign + 0j))
    return tuple(found)


def fit_spectra(
    spectra: LogSpectra, targets: Sequence[Target]
) -> tuple[ClusterModes | None, dict[str, Rejection]]:
    """Return credible modes and rejections."""
    low = min(target.band(BAND_HALF_WIDTH)[0] for target in targets)
    high = max(target.band(BAND_HALF_WIDTH)[1] for target in targets)
    # Far below resonances accelerations show the noise alone.
    powers = spectra.longest.powers()
    noise = powers[: len(powers) // 20].mean(axis=0)
    result = fit_modes(spectra, started(spectra, targets, noise), (low, high), noise)
    return result.credible, result.rejected


def fit(
    channels: np.ndarray, targets: Sequence[Target]
) -> tuple[ClusterModes | None, dict[str, Rejection]]:
    """Fit targets to the samples of accelerometers."""
    return fit_spectra(spectra_of(channels), targets)


def found(channels: np.ndarray, targets: Sequence[Target] = (ROLL, PITCH)) -> ClusterModes:
    """Fit targets of which all must be found."""
    modes, rejected = fit(channels, targets)
    assert modes is not None
    assert rejected == {}
    return modes


def both(seed: int = 1, n: int = 60_000, noise: float = 0.5, psd: float = 1.0) -> np.ndarray:
    """Return two channels that show both modes, each of them one better."""
    modes = [Mode(105.0, 0.015, psd, (1.0, -0.3)), Mode(125.0, 0.02, psd, (0.4, 1.0))]
    return accelerations(np.random.default_rng(seed), modes, n, RATE, noise)


def as_if_white(_: Likelihood, __: np.ndarray, white: Marginal, *___: float) -> Colour:
    """Leave the posterior as it is for a white force."""
    return Colour(white.mean, white.cov, np.zeros_like(white.cov), 0.0)
