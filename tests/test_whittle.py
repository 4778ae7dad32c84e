"""The likelihood of a band: its density, derivatives, averages, invariances and maximum."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from lmshealth.blocks import Block, _bins_per_bandwidth, make_block
from lmshealth.layout import lay_out
from lmshealth.segments import Segment
from lmshealth.spectra import CrossSpectrum, cross_spectra
from lmshealth.whittle import Likelihood
from tests.oracles import channel_covariance, complex_normal_log_density
from tests.signals import Mode, accelerations, density, make_log

SHAPES = ((1.0, 0.4, -0.3, 0.2), (0.3, 1.0, 0.5, -0.6), (-0.4, 0.2, 1.0, 0.3))
MODES = tuple(
    Mode(f, zeta, psd, shape)
    for (f, zeta, psd), shape in zip(
        [(105.0, 0.015, 1.0), (120.0, 0.02, 2.0), (135.0, 0.025, 1.5)], SHAPES, strict=True
    )
)
NOISE = 0.5
BAND = (80.0, 170.0)
LAYOUTS = list(product(range(4), range(1, 5)))


def flat_point(modes: Sequence[Mode], n_channels: int, noise: float = NOISE) -> np.ndarray:
    """Give the unknowns of independent forces and white floors."""
    layout = lay_out([i % n_channels for i in range(len(modes))], n_channels)
    return np.concatenate(
        [
            np.log([mode.frequency for mode in modes]),
            np.log([mode.damping for mode in modes]),
            np.tile([np.log(noise), 0.0, 0.0], n_channels),
            [float(i == j) for i, j in layout.force],
            [modes[i].shape[c] / modes[i].shape[i % n_channels] for c, i in layout.shape],
        ]
    )


def likelihood(
    modes: Sequence[Mode], n_channels: int, blocks: Sequence[Block], noise: float = NOISE
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
    """Give a point with coherent forces and bent floors."""
    rng = np.random.default_rng(seed)
    m = target.layout.n_modes
    p = target.start + rng.normal(0, 0.3, target.layout.size)
    p[:m] = target.start[:m] + rng.normal(0, 0.02, m)
    return p


def covariance(target: Likelihood, p: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """Read the unknowns as documented, and let the oracle turn them into a covariance."""
    m, n = target.layout.n_modes, target.layout.n_channels
    e, d, b = p[2 * m : 2 * m + 3 * n].reshape(n, 3).T
    u = np.log(frequency / target.centre) / target.spread
    root, at = np.eye(m + n), 2 * m + 3 * n
    for i in range(m + n):
        for j in range(i + 1 if i < m else i):
            if n == 1 and i < m and i - j > 1:  # one channel: neighbours alone share forces
                continue
            root[i, j] = target.scale[i] * p[at]
            at += 1
    shapes = np.ones((n, m))
    for i, c in product(range(m), range(n)):
        if c != i % n:
            shapes[c, i] = p[at]
            at += 1
    assert at == p.size
    return channel_covariance(
        frequency,
        resonances=np.exp(p[: 2 * m].reshape(2, m).T),
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
    return CrossSpectrum(f, matrix, duration, float("nan"), np.ones(f.size, dtype=bool), (), count)


def block_of(spectra: Sequence[CrossSpectrum], *, merge: bool = False) -> Block:
    """Keep all ordinates; the bandwidth is that of the lightest mode of these tests."""
    keep = [np.ones(s.frequency.size, dtype=bool) for s in spectra]
    return make_block(spectra, keep, 2 * 105.0 * 0.015, merge=merge)


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


def scatter_free(modes: Sequence[Mode], n: int, duration: float, noise: float = NOISE, count=1):
    """Give a likelihood whose data are their own expectation."""
    truth = likelihood(modes, n, [], noise)
    f = frequencies(duration)
    empty = block_of([spectrum_of(np.tile(np.eye(n) + 0j, (f.size, 1, 1)), duration, count)])
    (expected,) = replace(truth, blocks=(empty,)).expected(truth.start)
    return replace(truth, blocks=(replace(empty, matrix=expected),))


# What is expected of the ordinates


@pytest.mark.parametrize(("m", "n"), LAYOUTS)
def test_covariance_is_that_of_forces_through_resonances_and_floors(m: int, n: int) -> None:
    """E is what the equation of motion makes of white forces, in phase and size, entry by entry."""
    target = noisy(m, n, 8.0)
    p = other_point(target)
    (found,) = target.expected(p)
    truth = covariance(target, p, frequencies(8.0))
    np.testing.assert_allclose(found, truth, rtol=1e-10, atol=1e-10 * np.abs(truth).max())


def test_channels_follow_a_common_force_as_they_do_in_time() -> None:
    """Records of two channels moved by one force through two modes prefer E to its conjugate."""
    modes = [replace(MODES[0], shape=(1.0, 0.3)), replace(MODES[1], shape=(0.4, -1.0))]
    # The same seed makes the same force.
    x = sum(accelerations(np.random.default_rng(1), [m], 60_000, 1000.0, 0.0) for m in modes)
    x = x + accelerations(np.random.default_rng(2), [Mode(1.0, 1.0, 1e-9, (1, 1))], 60_000, 1e3, 1)
    log = make_log({"acc_a": x[0], "acc_b": x[1]}, 1000.0)
    (spectrum,) = cross_spectra(log.channels, [Segment(0, 60_000, 0.0)], 1000.0, 200.0)
    cut = spectrum.band(*BAND)
    target = likelihood(modes, 2, [block_of([cut])], 1.0)
    p = target.start.copy()
    p[target.layout.forces][:] = [1.0, 1.0, 0.0, *[0.0] * 5]  # the second force drives nothing
    p[target.layout.forces.start + 2] = 1e-3
    right = target.data_value(p)
    mirrored = replace(target, blocks=(block_of([replace(cut, matrix=cut.matrix.conj())]),))
    assert mirrored.data_value(p) - right > 1000
    # Each ordinate of each channel adds one, give or take its scatter.
    (expected,) = target.expected(p)
    n_free = cut.frequency.size * 2
    quadratic = right - np.linalg.slogdet(expected)[1].sum()
    assert abs(quadratic - n_free) < 4.5 * np.sqrt(n_free)


@pytest.mark.parametrize(("m", "n"), [(0, 2), (1, 1), (1, 3), (2, 2), (3, 4)])
def test_value_is_the_log_density_of_the_raw_ordinates(m: int, n: int) -> None:
    """The misfit is minus the log density of complex normal ordinates, but for a constant."""
    truth = likelihood(MODES[:m], n, [])
    p = other_point(truth)
    f = frequencies(8.0)
    x = drawn(covariance(truth, truth.start, f), np.random.default_rng(5))
    block = block_of([spectrum_of(x[:, :, None] * x[:, None].conj(), 8.0)])
    target = replace(truth, blocks=(block,))
    naive = -complex_normal_log_density(x, covariance(target, p, f))
    # Re and Im have half the variance each: no other constant is left than the power of π.
    assert target.data_value(p) == pytest.approx(naive - n * f.size * np.log(np.pi), rel=1e-11)
    prior = 0.5 * np.sum(((p - target.start) / target.prior_std) ** 2)
    assert target.value(p) == pytest.approx(target.data_value(p) + prior, rel=1e-13)


def test_one_mode_in_equal_noise_is_the_eigenvalue_form() -> None:
    """With the best shape of one mode the value is the textbook form with the largest eigenvalue.

    (n - 1) N ln S_e + Σ ln(S D + S_e) + (Σ|F|² - λ_max(A)) / S_e, A = Σ Re(F F*) / (1 + S_e/(S D)).
    """
    target = noisy(1, 3, 30.0)
    (block,) = target.blocks
    f, zeta, noise, s = 104.6, 0.017, 0.6, 1.3
    beta = f / block.frequency
    d = s / ((1 - beta**2) ** 2 + (2 * zeta * beta) ** 2)
    a = np.sum(block.matrix.real / (1 + noise / d)[:, None, None], axis=0)
    largest, vectors = np.linalg.eigh(a)
    power = np.trace(block.matrix, axis1=1, axis2=2).real.sum()
    au = 2 * f_size(block) * np.log(noise) + np.sum(np.log(d + noise))
    au += (power - largest[-1]) / noise
    p = flat_point(MODES[:1], 3, noise)
    shape = vectors[:, -1]
    p[:2] = np.log([f, zeta])
    p[target.layout.forces.start] = np.sqrt(s) * shape[0]  # the scale is one
    p[target.layout.shapes] = shape[1:] / shape[0]
    assert target.data_value(p) == pytest.approx(au, rel=1e-11)
    p[target.layout.shapes.start] += 0.01
    assert target.data_value(p) > au


def f_size(block: Block) -> int:
    """Count the ordinates of a block."""
    return int(block.count.sum())


def test_signal_to_noise_is_that_of_the_modes_in_each_channel() -> None:
    """S φ² / (4 ζ² N) at the truth, N being a floor's own noise without what a mode drives."""
    target = noisy(2, 3, 8.0)
    p = target.start.copy()
    p[target.layout.shared] = 0.7
    found = target.signal_to_noise(p)
    for c, i in product(range(3), range(2)):
        mode = MODES[i]
        assert found[c, i] == pytest.approx(mode.snr(NOISE) * mode.shape[c] ** 2, rel=1e-10)


# Derivatives


@pytest.mark.parametrize("duration", [1.0, 20.0])
@pytest.mark.parametrize(("m", "n"), LAYOUTS)
def test_derivatives_are_those_of_the_value(m: int, n: int, duration: float) -> None:
    """Gradient and Hessian agree with central differences, with the kernel and without."""
    target = noisy(m, n, duration, count=3)
    (block,) = target.blocks
    assert (block.kernel is not None) == (duration < 5)
    if block.kernel is None:
        cut = slice(200, 1400, 13)
        block = Block(block.frequency[cut], block.matrix[cut], 1.0 + block.count[cut], None)
        target = replace(target, blocks=(block,))
    p = other_point(target, m + 1)
    gradient, hessian = target.derivatives(p)
    # In units in which all unknowns weigh alike, along some directions that mix them all.
    unit = 1 / np.sqrt(np.abs(hessian).max(axis=0))
    along = np.random.default_rng(n).normal(size=(p.size, 4))

    def slope(f: Callable[[np.ndarray], np.ndarray | float]) -> np.ndarray:
        """Differentiate along the directions to the fourth order."""
        near, far = (
            np.array([(f(p + h * unit * v) - f(p - h * unit * v)) / (2 * h) for v in along.T])
            for h in (2e-3, 4e-3)
        )
        return np.asarray((4 * near - far).T / 3)

    expected = unit * gradient @ along
    np.testing.assert_allclose(slope(target.value), expected, atol=1e-6 * np.abs(expected).max())
    ours = unit[:, None] * hessian * unit
    by_gradient = slope(lambda q: unit * target.derivatives(q)[0])
    np.testing.assert_allclose(ours @ along, by_gradient, atol=5e-6)
    np.testing.assert_allclose(ours, ours.T, atol=1e-8)
    # Negative control: the comparison notices one entry that is off by a thousandth.
    ours[np.unravel_index(np.argmax(np.abs(ours)), ours.shape)] *= 1.001
    assert not np.allclose(ours @ along, by_gradient, rtol=0, atol=5e-5)


# Averages


def test_a_mean_over_segments_says_what_they_say_apart() -> None:
    """One block of means has the value and derivatives of the sum over single segments."""
    for duration in (1.0, 8.0):
        truth = likelihood(MODES[:2], 2, [])
        cov, rng = covariance(truth, truth.start, frequencies(duration)), np.random.default_rng(3)
        parts = [drawn(cov, rng) for _ in range(5)]
        matrices = [x[:, :, None] * x[:, None].conj() for x in parts]
        apart = [block_of([spectrum_of(w, duration)]) for w in matrices]
        pooled = block_of([spectrum_of(w, duration) for w in matrices])
        counted = block_of([spectrum_of(np.mean(matrices, axis=0), duration, 5)])
        assert set(counted.count) == {5.0}
        p = other_point(truth)
        one, *others = (replace(truth, blocks=b) for b in (tuple(apart), (pooled,), (counted,)))
        for other in others:
            assert other.data_value(p) == pytest.approx(one.data_value(p), rel=1e-12)
            for a, b in zip(other.derivatives(p), one.derivatives(p), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9 * np.abs(b).max())


def test_averaged_neighbours_say_what_they_say_apart_where_nothing_changes() -> None:
    """Of channels that show white floors alone the mean of neighbours loses nothing."""
    one, merged = (
        replace(noisy(0, 2, 60.0), blocks=(block_of([s], merge=merge),))
        for merge in (False, True)
        for s in [spectrum_of(noisy(0, 2, 60.0).blocks[0].matrix, 60.0)]
    )
    (few,), (many,) = merged.blocks, one.blocks
    assert few.frequency.size < many.frequency.size / 5
    assert few.count.sum() == many.count.sum()
    p = one.start.copy()
    p[0] += 0.3
    p[one.layout.common] = 0.4
    assert merged.data_value(p) == pytest.approx(one.data_value(p), rel=1e-12)
    p[1] = 1.0
    assert merged.data_value(p) != pytest.approx(one.data_value(p), rel=1e-9)


@pytest.mark.parametrize(("duration", "n_segments"), [(40.0, 1), (300.0, 1), (60.0, 30)])
def test_averaging_neighbours_moves_nothing_by_a_twentieth_of_its_uncertainty(
    duration: float, n_segments: int
) -> None:
    """On data without scatter the shift of ln f and ln ζ by averaging is below σ / 20."""
    exact = scatter_free(MODES[:1], 2, duration, count=n_segments)
    (block,) = exact.blocks
    merged = block_of([spectrum_of(block.matrix, duration, n_segments)], merge=True)
    assert merged.count[0] >= 2 * n_segments
    target = replace(exact, blocks=(merged,))
    p = target.minimise(target.start)
    std = np.sqrt(np.diag(np.linalg.inv(target.derivatives(p)[1])))
    off = ((p - target.start) / std)[:2]
    assert np.abs(off).max() < 0.05
    # Negative control: with a quarter of the bins the damping moves by more.
    coarse = duration * 2 * 105.0 * 0.015 / (_bins_per_bandwidth(1e3 * duration) / 4)
    assert coarse > 2


def test_a_block_forgets_what_is_masked_in_all_segments() -> None:
    """Ordinates count as often as they are kept; a short record still expects them smeared."""
    for duration in (2.0, 8.0):
        one, other = (
            spectrum_of(noisy(1, 2, duration, count).blocks[0].matrix, duration, count)
            for count in (1, 3)
        )
        keep = np.ones((2, one.frequency.size), dtype=bool)
        keep[0, 3:9] = False
        keep[1, 6:12] = False
        block = make_block([one, other], list(keep), 3.15, merge=False)
        kept = keep.any(axis=0)
        np.testing.assert_array_equal(block.frequency, one.frequency[kept])
        np.testing.assert_array_equal(block.count, (keep[0] + 3 * keep[1])[kept])
        np.testing.assert_allclose(block.matrix[4], other.matrix[4], rtol=1e-14)
        mean = (one.matrix[0] + 3 * other.matrix[0]) / 4
        np.testing.assert_allclose(block.matrix[0], mean, rtol=1e-12)
        assert (block.kernel is None) == (duration > 5)
        if block.kernel is not None:
            full = block_of([one])
            p = other_point(likelihood(MODES[:1], 2, []))
            some, every = (likelihood(MODES[:1], 2, [b]).expected(p)[0] for b in (block, full))
            np.testing.assert_allclose(some, every[kept], rtol=1e-9)


# Invariances


def posterior(target: Likelihood) -> tuple[np.ndarray, np.ndarray]:
    """Mode and covariance of ln f and ln ζ."""
    p = target.minimise(target.start)
    m = 2 * target.layout.n_modes
    return p[:m], np.linalg.inv(target.derivatives(p)[1])[:m, :m]


def assert_same(one: Likelihood, other: Likelihood) -> None:
    """Both give the same ln f and ln ζ, to a hundredth of their uncertainty, and covariance."""
    (a, cov), (b, other_cov) = posterior(one), posterior(other)
    std = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(a / std, b / std, atol=1e-2)
    np.testing.assert_allclose(cov / np.outer(std, std), other_cov / np.outer(std, std), atol=1e-2)


def test_the_unit_of_a_channel_and_the_phase_of_all_do_not_matter() -> None:
    """A channel a thousand times louder and phases turned at random leave modes as they are."""
    one = noisy(2, 3, 7.0)
    truth = covariance(one, one.start, frequencies(7.0))
    x = drawn(truth, np.random.default_rng(8))
    unit = np.array([1.0, 1.0, 1e3])
    phase = np.exp(2j * np.pi * np.random.default_rng(9).random((len(x), 1)))
    one, other = (
        replace(one, blocks=(block_of([spectrum_of(v[:, :, None] * v[:, None].conj(), 7.0)]),))
        for v in (x, x * unit * phase)
    )
    start = other.start.copy()
    m = 2
    start[2 * m + 6] += 2 * np.log(1e3)
    shapes = start[other.layout.shapes]
    for at, (c, _) in enumerate(other.layout.shape):
        shapes[at] *= unit[c]
    assert_same(one, replace(other, start=start))


def test_the_order_of_channels_does_not_matter() -> None:
    """Permuted channels give the same f, ζ and covariance."""
    one = noisy(2, 3, 7.0)
    order = [2, 0, 1]
    modes = [replace(m, shape=tuple(np.array(m.shape)[order])) for m in MODES[:2]]
    (block,) = one.blocks
    turned = replace(block, matrix=block.matrix[:, order][:, :, order])
    assert_same(one, likelihood(modes, 3, [turned]))


def test_the_order_of_blocks_does_not_matter() -> None:
    """Permuted blocks of different lengths have the same value and derivatives."""
    blocks = [noisy(1, 2, t).blocks[0] for t in (2.0, 8.0)]
    one, other = (likelihood(MODES[:1], 2, b) for b in (blocks, blocks[::-1]))
    p = other_point(one)
    assert one.value(p) == pytest.approx(other.value(p), rel=1e-14)
    np.testing.assert_allclose(one.derivatives(p)[1], other.derivatives(p)[1], rtol=1e-12)


@pytest.mark.parametrize("n", [2, 4])
def test_copies_of_a_channel_say_as_much_as_one_with_less_noise(n: int) -> None:
    """With n channels of one mode f, ζ and S are as sure as with one of an n-th of the noise."""
    mode = replace(MODES[0], shape=(1.0,) * n)
    many = scatter_free([mode], n, 7.0)
    one = scatter_free([mode], 1, 7.0, NOISE / n)
    plain = scatter_free([mode], 1, 7.0)
    # The floors known, so that priors play no part.
    about = [
        t.derivatives(t.start)[1][np.ix_(index, index)]
        for t in (many, one, plain)
        for index in [[0, 1, t.layout.forces.start]]
    ]
    np.testing.assert_allclose(about[0], about[1], rtol=1e-6, atol=1e-3)
    # The noise is far below the mode: n channels are hardly surer than one. Counted as if they
    # were independent, each would add as much as the first.
    assert about[0][0, 0] / about[2][0, 0] < 1.1


def test_priors_are_too_weak_to_matter() -> None:
    """In 7 s priors but those of what floors share are worth less than 1 % of any deviation."""
    target = noisy(2, 3, 7.0)
    p = target.minimise(target.start)
    layout, hessian = target.layout, target.derivatives(p)[1]
    own = np.diag(1 / target.prior_std**2)
    kept = [*layout.shared, *layout.common, *layout.bends]
    own[kept, kept] = 0.0
    with_priors, without = (np.sqrt(np.diag(np.linalg.inv(h))) for h in (hessian, hessian - own))
    np.testing.assert_allclose(with_priors[:4], without[:4], rtol=0.01)


# The maximum


@pytest.mark.parametrize("duration", [1.5, 7.0])
@pytest.mark.parametrize(("m", "n"), [(1, 1), (2, 1), (1, 3), (2, 3), (3, 3), (3, 4)])
def test_the_maximum_on_scatter_free_data_is_the_truth(m: int, n: int, duration: float) -> None:
    """On expected data the search comes back to f and ζ from starts 1 % and 30 % off."""
    exact = scatter_free(MODES[:m], n, duration, count=20)
    start = exact.start.copy()
    start[:m] += 0.01
    start[m : 2 * m] += 0.3
    start[2 * m : exact.layout.n_poles : 3] += 0.5
    target = replace(exact, start=start, scale=1.2 * exact.scale)
    p = target.minimise(start)
    hessian = target.derivatives(p)[1]
    gradient = target.derivatives(p)[0]
    assert gradient @ np.linalg.solve(hessian, gradient) < 1e-4
    std = np.sqrt(np.diag(np.linalg.inv(hessian)))[: 2 * m]
    assert (np.abs(p - exact.start)[: 2 * m] / std).max() < 0.2


def test_without_the_kernel_a_short_record_reads_too_much_damping() -> None:
    """Negative control: plain Whittle on smeared data is off by more than 5 % in ζ."""
    exact = scatter_free(MODES[:1], 2, 1.5, count=8)
    assert exact.blocks[0].kernel is not None
    plain = replace(exact, blocks=(replace(exact.blocks[0], kernel=None),))
    assert np.exp(plain.minimise(plain.start)[1]) > 1.05 * 0.015


def test_nonsense_is_infinitely_unlikely_not_an_error() -> None:
    """Unknowns that overflow have the value inf, so that a search turns back."""
    target = noisy(1, 2, 8.0)
    p = target.start.copy()
    p[2] = 2000.0
    assert target.value(p) == np.inf
