"""Poles of responses: exact data are matched, information is right, further poles are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth._private.arrays import ComplexArray, stack
from lmshealth.modal.deterministic.likelihood import (
    BandSpectra,
    ModalLikelihood,
    transform_decays,
    unit_level,
)
from lmshealth.modal.deterministic.poles import (
    PoleFit,
    best_pole,
    evidence_needed,
    maximise,
    vector_fit,
)

F, ZETA = np.array([62.0, 90.0]), np.array([0.015, 0.02])
POLES = np.log(np.concatenate([F, ZETA]))
LINES = np.linspace(40.0, 120.0, 161)
POWERS = (LINES[:, None] * 1j / np.sqrt(40 * 120)) ** np.arange(-2, 3)


def make(*, transient: bool = False, noise: float = 1e-6, seed: int = 1) -> BandSpectra:
    """Make ordinates of two modes, a rigid motion, and a transient where there is one."""
    rng = np.random.default_rng(seed)
    s, pole = 2j * np.pi * LINES[:, None], 2 * np.pi * F * (-ZETA + 1j * np.sqrt(1 - ZETA**2))
    residue = np.array([3 - 1j, -2 - 2j])
    modes = (residue / (s - pole) + residue.conj() / (s - pole.conj())).sum(axis=1)
    response = modes + 300 / s[:, 0] ** 2 + 0.001
    given = rng.standard_normal(LINES.size) + 1j * rng.standard_normal(LINES.size)
    answer, base = response * given, given[:, None] * POWERS
    if transient:
        swing = np.array([0.1 + 0.2j, -0.1])
        answer = answer + (swing / (s - pole) + swing.conj() / (s - pole.conj())).sum(axis=1) + 0.01
        base = np.hstack([base, POWERS[:, 1:4]])
    scatter = rng.standard_normal((2, LINES.size)) * np.sqrt(noise / 2)
    answer = answer + scatter[0] + 1j * scatter[1]
    return BandSpectra(
        LINES, answer[None, :, None], 2.0, np.inf, stack(base),
        force=given, transient=transient, noise=np.full(LINES.size, noise),
    )  # fmt: skip


def fit(block: BandSpectra, p: np.ndarray) -> PoleFit:
    """Evaluate the likelihood of poles."""
    likelihood = ModalLikelihood.of_known_noise(block, p.size // 2)
    return PoleFit(likelihood, p, likelihood.evaluate(p))


@pytest.mark.parametrize("transient", [False, True])
def test_exact_data_are_matched_exactly(transient: bool) -> None:
    """Residues, rigid motion and transient are linear: at the true poles no error is left."""
    block = make(transient=transient, noise=1e-30)
    found = fit(replace(block, noise=np.ones(LINES.size)), POLES)
    assert np.abs(found.at.fits[0].residual).max() < 1e-12
    residues = [found.sizes(i)[0][0, 0] / block.duration for i in range(2)]
    np.testing.assert_allclose(residues, [3 - 1j, -2 - 2j], rtol=1e-8)


@pytest.mark.parametrize("transient", [False, True])
def test_gradient_and_tangent_are_those_of_the_value(transient: bool) -> None:
    """The gradient agrees with differences, and half of the information is the tangent's."""
    block = replace(make(transient=transient, noise=0.01), noise=np.linspace(0.01, 0.02, 161))
    found = fit(block, POLES + np.array([0.01, -0.003, 0.3, -0.2]))
    for i in range(4):
        step = 1e-6 * np.eye(4)[i]
        up, down = (fit(block, found.p + way * step).at.value for way in (1, -1))
        assert found.at.gradient[i] == pytest.approx((up - down) / 2e-6, rel=1e-4, abs=1e-2)
    tangent = found.at.fits[0].tangent[:, :, 0]
    np.testing.assert_allclose(found.at.fisher, 2 * tangent @ tangent.T)


def test_information_is_that_of_all_unknowns_with_the_linear_ones_marginalised() -> None:
    """Against the inverse of the Fisher information of poles, residues and powers together."""
    block = make()
    found = fit(block, POLES)
    sizes = found.at.fits[0].sizes[0, :, 0]
    s = 2j * np.pi * LINES[:, None]
    assert block.force is not None and block.noise is not None
    whiten = np.sqrt(2 / block.noise)

    def answer(unknowns: np.ndarray) -> np.ndarray:
        f, zeta = np.exp(unknowns[:2]), np.exp(unknowns[2:4])
        at = 2 * np.pi * f * (-zeta + 1j * np.sqrt(1 - zeta**2))
        residue = (unknowns[9::2] + 1j * unknowns[10::2]) / block.duration
        modal = residue / (s - at) + residue.conj() / (s - at.conj())
        background = POWERS @ unknowns[4:9]
        return stack(block.force * (modal.sum(axis=1) + background) * whiten)

    truth = np.concatenate([POLES, sizes])
    steps = 1e-6 * np.eye(truth.size) * np.maximum(np.abs(truth), 1e-2)
    jacobian = np.array([(answer(truth + d) - answer(truth - d)) / (2 * d.sum()) for d in steps]).T
    expected = np.linalg.inv(jacobian.T @ jacobian)[:4, :4]
    np.testing.assert_allclose(np.linalg.inv(found.at.fisher), expected, rtol=1e-4)


@pytest.mark.parametrize("transient", [False, True])
def test_poles_are_found_from_a_start_beside_them(transient: bool) -> None:
    """From half a bandwidth off and twice the damping, to a small part of the scatter."""
    likelihood = ModalLikelihood.of_known_noise(make(transient=transient, noise=1e-12), 2)
    start = np.log(np.concatenate([F * 1.007, 2 * ZETA]))
    found = maximise(likelihood, start, np.arange(4))
    np.testing.assert_allclose(found.p, POLES, atol=1e-5)


@pytest.mark.parametrize(("step", "n_modes"), [(1, 2), (4, 2), (8, 3), (12, 2)])
def test_vector_fits_find_poles_at_any_distance_of_the_lines(step: int, n_modes: int) -> None:
    """Lines up to 6 Hz apart for modes 1.9 and 3.6 Hz wide; a pole too many changes nothing."""
    block = make(noise=1e-12)
    assert block.force is not None and block.noise is not None
    kept = np.arange(161) % step == 0
    some = replace(
        block, frequency=LINES[kept], ordinates=block.ordinates[:, kept], force=block.force[kept],
        noise=block.noise[kept],
    )  # fmt: skip
    background: ComplexArray = POWERS[kept]
    f, zeta = vector_fit(some, background, n_modes)
    at = [int(np.argmin(np.abs(f - one))) for one in F]
    np.testing.assert_allclose(f[at], F, rtol=1e-4)
    np.testing.assert_allclose(zeta[at], ZETA, rtol=1e-2)


def test_the_best_place_is_where_a_mode_is_missing() -> None:
    """Of a model with one of two modes the other is found, within its half-power bandwidth."""
    block = make()
    known = fit(block, POLES[[1, 3]])
    grid, dampings = np.geomspace(40, 120, 200), np.array([0.003, 0.01, 0.03, 0.1])
    f, zeta, gain = best_pole(known, np.tile(grid, 4), np.repeat(dampings, 200))
    assert f == pytest.approx(62, abs=2)
    assert 0.005 < zeta < 0.05
    assert gain > 500
    both = fit(block, np.log([f, 90.0, zeta, 0.02]))
    assert gain == pytest.approx(known.at.profile - both.at.profile, rel=1e-6)


def test_evidence_counts_what_a_pole_adds() -> None:
    """A pole of a response has four unknowns; of decays three, and two per stop and channel."""
    forced = ModalLikelihood.of_known_noise(make(), 1)
    assert evidence_needed(forced) == pytest.approx(2 * np.log(322) + 5)
    driven = ModalLikelihood.of_known_noise(make(transient=True), 1)
    assert evidence_needed(driven) == pytest.approx(3 * np.log(322) + 5)
    block = transform_decays(np.zeros((3, 400, 2)), 400.0, 40, 90)
    n, unit = block.frequency.size, np.array([unit_level(60.0, 0.01, 1.0)])
    decays = ModalLikelihood((block,), np.ones((1, 2)), unit, np.zeros(2))
    expected = 1.5 * np.log(12 * n) + 6 * np.log(2 * n) + 5
    assert evidence_needed(decays) == pytest.approx(expected)
