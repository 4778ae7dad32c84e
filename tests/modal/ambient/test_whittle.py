"""Whittle likelihood: density, derivatives, invariances, maximum, and marginalisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from lmshealth.modal.ambient.expected_periodogram import MeanOrdinates
from lmshealth.modal.ambient.whittle import (
    SECOND,
    Likelihood,
    _step_to,
    floors,
    lay_out,
    marginalise,
    receptance,
    response,
)
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectra import cross_spectra
from tests.bands import (
    BAND,
    MODES,
    NOISE,
    block_of,
    covariance,
    drawn,
    flat_point,
    frequencies,
    likelihood,
    noisy,
    other_point,
    scatter_free,
    spectrum_of,
)
from tests.oracles import complex_normal_log_density
from tests.signals import Mode, accelerations, make_log

LAYOUTS = list(product(range(4), range(1, 5)))

# What is expected of the ordinates


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(("m", "n"), LAYOUTS)
def test_covariance_is_that_of_forces_through_resonances_and_floors(
    m: int, n: int, turned: bool
) -> None:
    """E is what the equation of motion makes of white forces, in phase and size, entry by entry."""
    target = noisy(m, n, 8.0)
    target = target.with_quadrature() if turned else target
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
    mirrored = replace(target, blocks=(block_of([replace(cut, transforms=cut.transforms.conj())]),))
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


def f_size(block: MeanOrdinates) -> int:
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


def test_heights_multiply_the_forces_of_modes_and_not_the_floors() -> None:
    """A bump as wide as all frequencies is a factor of the forces, shared with floors or not."""
    target = noisy(2, 3, 8.0)
    p, height = other_point(target), 0.7
    wide = target.coloured(np.array([[120.0], [1e6]]), 0.5)
    stronger = p.copy()
    own = [target.layout.forces.start + a for a, (i, _) in enumerate(target.layout.force) if i < 2]
    stronger[own] *= np.exp(height / 2)
    np.testing.assert_allclose(
        wide.expected(np.append(p, height)), target.expected(stronger), rtol=1e-8
    )


# Derivatives


BUMPS = np.array([[95.0, 104.0, 118.0], [5.0, 5.0, 9.0]])


@pytest.mark.slow
@pytest.mark.parametrize("duration", [1.0, 20.0])
@pytest.mark.parametrize(("m", "n"), LAYOUTS)
def test_derivatives_are_those_of_the_value(m: int, n: int, duration: float) -> None:
    """Gradient and Hessian agree with central differences, with the kernel and without."""
    check_derivatives(m, n, duration, BUMPS[:, :0])


@pytest.mark.parametrize("duration", [1.0, 20.0])
@pytest.mark.parametrize(("m", "n"), [(1, 1), (2, 3)])
def test_derivatives_by_heights_are_those_of_the_value(m: int, n: int, duration: float) -> None:
    """The same with a coloured force."""
    check_derivatives(m, n, duration, BUMPS)


@pytest.mark.parametrize("duration", [1.0, 20.0])
@pytest.mark.parametrize(("m", "n"), [(2, 1), (1, 3), (3, 2)])
def test_derivatives_by_parts_in_quadrature_are_those_of_the_value(
    m: int, n: int, duration: float
) -> None:
    """The same with forces that reach modes with a delay, and shapes out of phase."""
    check_derivatives(m, n, duration, BUMPS, turned=True)


def check_derivatives(
    m: int, n: int, duration: float, bumps: np.ndarray, *, turned: bool = False
) -> None:
    """Compare with central differences."""
    target = noisy(m, n, duration, count=3)
    (block,) = target.blocks
    assert (block.kernel is not None) == (duration < 5)
    if block.kernel is None:
        cut = slice(200, 1400, 13)
        block = MeanOrdinates(block.frequency[cut], block.matrix[cut], 1.0 + block.count[cut], None)
        target = replace(target, blocks=(block,))
    target = (target.with_quadrature() if turned else target).coloured(bumps, 0.5)
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


@pytest.mark.slow
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
    start[3 * m + 6] += 2 * np.log(1e3)
    shapes = start[other.layout.shapes]
    for at, (c, _) in enumerate(other.layout.shape):
        shapes[at] *= unit[c]
    assert_same(one, replace(other, start=start))


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("duration", [1.5, 7.0])
@pytest.mark.parametrize(("m", "n"), [(1, 1), (2, 1), (1, 3), (2, 3), (3, 3), (3, 4)])
def test_the_maximum_on_scatter_free_data_is_the_truth(m: int, n: int, duration: float) -> None:
    """On expected data the search comes back to f and ζ from starts 1 % and 30 % off."""
    exact = scatter_free(MODES[:m], n, duration, count=20)
    start = exact.start.copy()
    start[:m] += 0.01
    start[m : 2 * m] += 0.3
    start[3 * m : exact.layout.n_poles : 3] += 0.5
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
    p[3] = 2000.0
    assert target.value(p) == np.inf


@pytest.mark.parametrize("beyond", [np.nan, np.inf, None])
def test_a_search_turns_back_where_derivatives_overflow(
    beyond: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A first step to where there are no derivatives is shortened; the end is the same."""
    target = noisy(1, 2, 8.0)
    start = target.start + 0.1
    free = target.minimise(start)
    plain, turned = Likelihood.derivatives, 0

    def derivatives(self: Likelihood, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal turned
        if np.linalg.norm(p - start) <= 0.1 or turned >= 2:
            return plain(self, p)
        turned += 1
        if beyond is None:
            raise np.linalg.LinAlgError
        return np.full(p.size, beyond), np.full((p.size, p.size), beyond)

    monkeypatch.setattr(Likelihood, "derivatives", derivatives)
    held = target.minimise(start)
    assert turned == 2
    assert target.value(held) == pytest.approx(target.value(free), abs=1e-3)


F = np.linspace(80.0, 160.0, 41)
U = np.linspace(-1.2, 1.2, 41)


def test_a_mode_moves_as_the_equation_of_motion_has_it() -> None:
    """The response is that of -ω² / (ω_n² - ω² + 2iζω_nω), in size and phase."""
    mode = Mode(120.0, 0.02)
    expected, found = mode.response(F), response(np.array(120.0), np.array(0.02), F)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    # The mirrored phase is another machine.
    assert np.abs(found - expected.conj()).max() > 1


def test_floors_are_exponentials_of_parabolas() -> None:
    """Half the logarithm of the density: at the middle e/2, at the ends with tilt and bend."""
    found = floors(np.array([[0.4, 0.6, -0.2]]), np.array([-1.0, 0.0, 1.0]))
    np.testing.assert_allclose(np.log(found[0, 0].real), [-0.2, 0.2, 0.4], atol=1e-15)


def test_derivatives_of_modes_are_those_of_their_response() -> None:
    """First and second derivatives by ln f and ln ζ agree with central differences."""
    at, h = np.log([120.0, 0.02]), 1e-5

    def moved(*step: float) -> np.ndarray:
        frequency, zeta = np.exp(at + step)
        return response(frequency, zeta, F)

    found = receptance(np.array([[120.0]]), np.array([[0.02]]), F)[:, 0]
    np.testing.assert_allclose(found[0], moved(0, 0), rtol=1e-12)
    for q, step in enumerate(np.eye(2) * h):
        first = (moved(*step) - moved(*-step)) / (2 * h)
        np.testing.assert_allclose(found[1 + q], first, atol=1e-6 * np.abs(first).max())
        for r, other in enumerate(np.eye(2) * h):
            second = moved(*(step + other)) - moved(*(step - other))
            second = (second - moved(*(other - step)) + moved(*(-step - other))) / (4 * h**2)
            np.testing.assert_allclose(
                found[SECOND[q, r]], second, atol=1e-4 * np.abs(second).max()
            )
    assert not found[[3, 6, 8, 9]].any()


def test_derivatives_of_floors_are_those_of_their_response() -> None:
    """First and second derivatives by e, d and b agree with central differences."""
    at, h = np.array([0.4, 0.6, -0.2]), 1e-4

    def moved(step: np.ndarray) -> np.ndarray:
        return np.asarray(floors((at + step)[None], U)[0, 0].real)

    found = floors(at[None], U)[:, 0].real
    for q, step in enumerate(np.eye(3) * h):
        np.testing.assert_allclose(found[1 + q], (moved(step) - moved(-step)) / (2 * h), atol=1e-7)
        for r, other in enumerate(np.eye(3) * h):
            second = moved(step + other) - moved(step - other) - moved(other - step)
            second = (second + moved(-step - other)) / (4 * h**2)
            np.testing.assert_allclose(found[SECOND[q, r]], second, atol=1e-6)


@pytest.mark.parametrize(("m", "n"), list(product(range(4), range(1, 5))))
def test_every_unknown_has_one_place(m: int, n: int) -> None:
    """Poles, forces and shapes follow each other without gap, and fill all places."""
    layout = lay_out([i % n for i in range(m)], n)
    assert len(layout.pole) == layout.n_poles == layout.forces.start
    assert layout.forces.stop == layout.shapes.start
    assert layout.shapes.stop == layout.size == 3 * (m + n) + len(layout.force) + m * (n - 1)
    assert len(set(layout.pole)) == layout.n_poles
    assert len(set(layout.force)) == len(layout.force)
    assert all(j < i or (j == i < m) for i, j in layout.force)


def test_parts_that_floors_share_are_those_of_their_rows() -> None:
    """Of two modes and three channels: six shared with modes, three with other floors."""
    layout = lay_out([0, 1], 3)
    pairs = {k: layout.force[k - layout.forces.start] for k in (*layout.shared, *layout.common)}
    assert {pairs[k] for k in layout.shared} == set(product((2, 3, 4), (0, 1)))
    assert {pairs[k] for k in layout.common} == {(3, 2), (4, 2), (4, 3)}
    assert [layout.pole[k] for k in layout.bends] == [(2, 3), (3, 3), (4, 3)]


def test_a_single_channel_tells_what_neighbours_share_and_no_more() -> None:
    """Of three modes in one channel the first and the last have no force in common."""
    layout = lay_out([0, 0, 0], 1)
    assert (2, 0) not in layout.force
    assert {(1, 0), (2, 1)} <= set(layout.force)
    assert layout.shape == ()
    assert np.array(layout.force).max() == 3


def fitted(target: Likelihood) -> np.ndarray:
    """Find the posterior mode."""
    return target.minimise(target.start)


@pytest.mark.parametrize(("m", "n"), [(1, 1), (1, 3), (2, 2)])
def test_it_lies_between_nothing_shared_and_anything_shared(m: int, n: int) -> None:
    """Deviations are at least those with the shared parts known, at most those with wide priors."""
    target = noisy(m, n, 7.0)
    p = fitted(target)
    mean, cov, decrement, _ = marginalise(target, p)
    assert decrement < 1e-2
    hessian = target.derivatives(p)[1]
    layout = target.layout
    loose = [*layout.shared, *layout.common, *layout.bends]
    known = np.setdiff1d(np.arange(layout.size), loose)
    size = 2 * m
    narrow = np.diag(np.linalg.inv(hessian[np.ix_(known, known)]))[:size]
    wide = np.diag(np.linalg.inv(hessian))[:size]
    spread = np.diag(cov)
    assert (spread > 0.99 * narrow).all()
    # What the means of different widths differ by adds to the variance.
    assert (spread < wide + (mean - p[:size]) ** 2 + 0.5 * wide).all()
    assert np.linalg.eigvalsh(cov).min() > 0


def test_without_anything_shared_the_narrow_priors_win() -> None:
    """Without shared forces the truth is the mean, and half the information at most is lost."""
    target = scatter_free(MODES[:1], 2, 30.0)
    mean, cov, *_ = marginalise(target, fitted(target))
    std = np.sqrt(np.diag(cov))
    assert np.abs((mean - target.start[:2]) / std).max() < 0.1
    known = np.linalg.inv(target.derivatives(target.start)[1][:2, :2])
    assert (std < 2 * np.sqrt(np.diag(known))).all()


def test_floors_that_share_much_pull_the_wide_priors_in() -> None:
    """Where a floor is driven by the mode's force the mean stays near the free optimum."""
    truth = noisy(1, 2, 30.0)
    p = truth.start.copy()
    p[truth.layout.shared] = 1.0, -1.0
    x = drawn(covariance(truth, p, frequencies(30.0)), np.random.default_rng(4))
    block = block_of([spectrum_of(x[:, :, None] * x[:, None].conj(), 30.0)])
    target = replace(truth, blocks=(block,))
    optimum = fitted(target)
    mean, cov, *_ = marginalise(target, optimum)
    std = np.sqrt(np.diag(cov))
    assert np.abs((mean - optimum[:2]) / std).max() < 0.3
    assert np.abs((mean - truth.start[:2]) / std).max() < 4


def test_where_there_is_no_maximum_it_says_so() -> None:
    """Off the maximum the decrement is large, and infinite where the Hessian has no root."""
    target = noisy(1, 2, 7.0)
    p = fitted(target)
    off = p.copy()
    off[0] += 1e-2
    assert marginalise(target, off)[2] > 1
    saddle = p.copy()
    saddle[0] += 0.15
    _, cov, decrement, evidence = marginalise(target, saddle)
    assert decrement == np.inf
    assert np.isnan(cov).all()
    assert evidence == -np.inf


def test_evidence_is_the_integral_over_a_height() -> None:
    """Of one height, all else at its conditional maximum and Laplace's normal about it."""
    target = noisy(1, 1, 7.0)
    coloured = target.coloured(np.array([[107.0], [6.0]]), 0.2)
    p = coloured.minimise(coloured.start)
    found = marginalise(coloured, p)
    heights = np.linspace(-0.8, 0.8, 17)
    logs = []
    for height in heights:
        # A prior as narrow as this holds the height.
        held = target.coloured(coloured.bumps, 1e-4)
        held = replace(held, start=np.append(held.start[:-1], height))
        q = held.minimise(np.append(p[:-1], height))
        logs.append(marginalise(held, q).log_evidence - 0.5 * (height / 0.2) ** 2)
    grid = np.exp(np.array(logs) - max(logs)).sum() * (heights[1] - heights[0])
    # Of a normal that is as narrow, the integral is one.
    integral = max(logs) + np.log(grid / (0.2 * np.sqrt(2 * np.pi)))
    assert found.log_evidence == pytest.approx(integral, abs=0.1)


def test_a_step_has_the_length_of_its_radius() -> None:
    """Identity, nearly: also where the radius is far below the rounding of the curvature."""
    rng = np.random.default_rng(1)
    for radius in 0.3 / 4.0 ** np.arange(0, 50, 7):
        for _ in range(20):
            half = rng.standard_normal((6, 6))
            curvature, slope = half + half.T, 1e-3 * rng.standard_normal(6)
            step = _step_to(radius, slope, curvature)
            assert np.linalg.norm(step) == pytest.approx(radius, rel=0.05)
            assert slope @ step + 0.5 * step @ curvature @ step < 0


def test_a_start_whose_derivatives_overflow_is_returned() -> None:
    """Refusal: its value is infinite, and it is no mode."""
    target = noisy(1, 2, 7.0)
    start = target.start + 1000.0
    assert target.minimise(start) is start
