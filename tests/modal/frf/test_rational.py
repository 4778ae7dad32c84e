"""Rational transfer functions: exact data are matched exactly, derivatives and information too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth._private.arrays import stack
from lmshealth.modal.frf.rational import (
    ModelOrder,
    Ordinates,
    best_place,
    refine,
    slopes,
    solve,
    vector_fit,
)

F, ZETA = np.array([62.0, 90.0]), np.array([0.015, 0.02])
ORDER = ModelOrder(np.log(np.concatenate([F, ZETA])), -2, 2)


def make(*, periodic: bool = True, noise: float = 1e-6, seed: int = 1) -> Ordinates:
    """Make ordinates of two modes, a rigid motion, and a transient where they are not periodic."""
    rng = np.random.default_rng(seed)
    f = np.linspace(40.0, 120.0, 161)
    s, pole = 2j * np.pi * f[:, None], 2 * np.pi * F * (-ZETA + 1j * np.sqrt(1 - ZETA**2))
    residue = np.array([3 - 1j, -2 - 2j])
    modes = (residue / (s - pole) + residue.conj() / (s - pole.conj())).sum(axis=1)
    response = modes + 300 / s[:, 0] ** 2 + 0.001
    given = rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)
    answer = response * given
    if not periodic:
        swing = np.array([0.1 + 0.2j, -0.1])
        answer = answer + (swing / (s - pole) + swing.conj() / (s - pole.conj())).sum(axis=1) + 0.01
    variance = np.full(f.size, noise)
    scatter = rng.standard_normal((2, f.size)) * np.sqrt(noise / 2)
    return Ordinates(f, given, answer + scatter[0] + 1j * scatter[1], variance, 16.0, periodic)


@pytest.mark.parametrize("periodic", [True, False])
def test_exact_data_are_matched_exactly(periodic: bool) -> None:
    """Residues, rigid motion and transient are linear: at the true poles no error is left."""
    ordinates = make(periodic=periodic, noise=1e-30)
    solution = solve(ordinates, ORDER, np.ones(161))
    assert np.abs(solution.error).max() < 1e-12
    centre = 2 * np.pi * np.sqrt(40 * 120)
    np.testing.assert_allclose(solution.residues * centre, [3 - 1j, -2 - 2j], rtol=1e-8)
    assert solution.swing.any() != periodic


@pytest.mark.parametrize("periodic", [True, False])
def test_slopes_are_derivatives_of_the_error(periodic: bool) -> None:
    """Against central differences, where the error vanishes and Kaufman's form is exact."""
    ordinates = make(periodic=periodic, noise=1e-30)
    variance = np.linspace(1, 2, 161)

    def error(theta: np.ndarray) -> np.ndarray:
        solution = solve(ordinates, replace(ORDER, theta=theta), variance)
        return stack(solution.error * np.sqrt(2 / variance))

    found = slopes(ordinates, ORDER, variance, solve(ordinates, ORDER, variance))
    for i in range(4):
        step = 1e-6 * np.eye(4)[i]
        difference = (error(ORDER.theta + step) - error(ORDER.theta - step)) / 2e-6
        np.testing.assert_allclose(found[:, i], difference, atol=1e-5 * np.abs(found[:, i]).max())


def test_information_is_that_of_all_unknowns_with_the_linear_ones_marginalised() -> None:
    """Against the inverse of the Fisher information of poles, residues and powers together."""
    ordinates = make()
    solution = solve(ordinates, ORDER, ordinates.noise)
    slope = slopes(ordinates, ORDER, ordinates.noise, solution)
    # Solved for at fixed poles, columns of what is linear follow from answers that they make.
    whiten = np.sqrt(2 / ordinates.noise)
    m, s = 2, 1j * ordinates.frequency / np.sqrt(40 * 120)
    pole = F / np.sqrt(40 * 120) * (-ZETA + 1j * np.sqrt(1 - ZETA**2))

    def answer(unknowns: np.ndarray) -> np.ndarray:
        f, zeta = np.exp(unknowns[:m]), np.exp(unknowns[m : 2 * m])
        at = f / np.sqrt(40 * 120) * (-zeta + 1j * np.sqrt(1 - zeta**2))
        residue = unknowns[4:6] + 1j * unknowns[6:8]
        modal = residue / (s[:, None] - at) + residue.conj() / (s[:, None] - at.conj())
        powers = s[:, None] ** np.arange(-2, 3) * unknowns[8:]
        return stack(ordinates.given * (modal.sum(axis=1) + powers.sum(axis=1)) * whiten)

    residues = solution.residues
    rest = solution.response - (
        residues / (s[:, None] - pole) + residues.conj() / (s[:, None] - pole.conj())
    ).sum(axis=1)
    powers = np.linalg.lstsq(
        np.concatenate(
            [(s[:, None] ** np.arange(-2, 3)).real, (s[:, None] ** np.arange(-2, 3)).imag]
        ),
        stack(rest),
        rcond=None,
    )[0]
    truth = np.concatenate([ORDER.theta, residues.real, residues.imag, powers])
    steps = 1e-6 * np.eye(truth.size) * np.maximum(np.abs(truth), 1e-2)
    jacobian = np.array([(answer(truth + d) - answer(truth - d)) / (2 * d.sum()) for d in steps]).T
    expected = np.linalg.inv(jacobian.T @ jacobian)[:4, :4]
    np.testing.assert_allclose(np.linalg.inv(slope.T @ slope), expected, rtol=1e-4)


@pytest.mark.parametrize("periodic", [True, False])
def test_poles_are_found_from_a_start_beside_them(periodic: bool) -> None:
    """From half a bandwidth off and twice the damping, to a small part of the scatter."""
    ordinates = make(periodic=periodic, noise=1e-12)
    start = replace(ORDER, theta=np.log(np.concatenate([F * 1.007, 2 * ZETA])))
    found = refine(ordinates, start, ordinates.noise)
    np.testing.assert_allclose(found.theta, ORDER.theta, atol=1e-5)


@pytest.mark.parametrize(("step", "n_modes"), [(1, 2), (4, 2), (8, 3), (12, 2)])
def test_vector_fits_find_poles_at_any_distance_of_the_lines(step: int, n_modes: int) -> None:
    """Lines up to 6 Hz apart for modes 1.9 and 3.6 Hz wide; a pole too many changes nothing."""
    ordinates = make(noise=1e-12)
    found = vector_fit(ordinates.only(np.arange(161) % step == 0), ORDER, n_modes)
    f, zeta = found.modes
    at = [int(np.argmin(np.abs(f - one))) for one in F]
    np.testing.assert_allclose(f[at], F, rtol=1e-4)
    np.testing.assert_allclose(zeta[at], ZETA, rtol=1e-2)


def test_the_best_place_is_where_a_mode_is_missing() -> None:
    """Of a model with one of two modes the other is found, within its half-power bandwidth."""
    ordinates = make()
    known = ORDER.without_mode(0)
    f, zeta, gain = best_place(ordinates, ordinates.noise, solve(ordinates, known, ordinates.noise))
    assert f == pytest.approx(62, abs=2)
    assert 0.005 < zeta < 0.05
    assert gain > 1000
    both = known.with_mode(f, zeta)
    left = solve(ordinates, both, ordinates.noise).error
    before = solve(ordinates, known, ordinates.noise).error
    lost = 2 * np.sum((np.abs(before) ** 2 - np.abs(left) ** 2) / ordinates.noise)
    assert gain == pytest.approx(lost, rel=1e-6)


def test_orders_count_their_unknowns() -> None:
    """A mode has four, six where it has a transient; a power one; the transient itself three."""
    assert ORDER.unknowns(transient=False) == 2 * 4 + 5
    assert ORDER.unknowns(transient=True) == 2 * 6 + 5 + 3
    assert ORDER.without_mode(0).modes[0] == pytest.approx(90)
    assert ORDER.with_mode(100.0, 0.1).modes[1] == pytest.approx([0.015, 0.02, 0.1])
