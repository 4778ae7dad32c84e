"""Restricted likelihood of decays: its gradient, and what it must not depend on."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal.free_decay.transient_likelihood import (
    Block,
    TransientLikelihood,
    make_block,
    unit_level,
)
from tests.stops import ring

RATE = 400.0


def two_modes(rng: np.random.Generator, n_segments: int, n: int) -> np.ndarray:
    """Decays of two modes in two channels with white noise, ``(n_segments, n, 2)``."""
    shapes = np.array([[1.0, 0.6], [1.0, -0.6]])
    x = 0.02 * rng.standard_normal((n_segments, n, 2))
    for s in range(n_segments):
        for shape, f, zeta in zip(shapes, (60.0, 67.3), (0.01, 0.02), strict=True):
            x[s] += np.outer(ring(f, zeta, 1.0, rng.uniform(0, 2 * np.pi), n, RATE), shape)
    return x


def likelihood_of(blocks: tuple[Block, ...], *, displacement: bool = False) -> TransientLikelihood:
    """Make the likelihood of two modes in two channels."""
    levels = np.full(2, np.log(0.02**2 * 2 / RATE))
    units = np.array([unit_level(f, z, 1.0) for f, z in ((60.0, 0.01), (67.3, 0.02))])
    shapes = np.exp(levels[0] / 2) * np.array([[1.0, 0.6], [1.0, -0.6]])
    return TransientLikelihood(blocks, shapes, units, levels, displacement)


@pytest.mark.parametrize("displacement", [False, True])
def test_gradient_and_fisher_information_are_those_of_the_value(displacement: bool) -> None:
    """The gradient agrees with differences of the value, blocks of two lengths together."""
    rng = np.random.default_rng(5)
    blocks = (
        make_block(two_modes(rng, 3, 400), RATE, 40, 90),
        make_block(two_modes(rng, 1, 330), RATE, 40, 90),
    )
    likelihood = likelihood_of(blocks, displacement=displacement)
    p = np.concatenate(
        [np.log([60.02, 67.2]), np.log([0.011, 0.018]), [0.5, 1.5], likelihood.levels + 0.2,
         [0.1, -0.2]]
    )  # fmt: skip
    at = likelihood.evaluate(p)
    for j in range(p.size):
        step = np.zeros(p.size)
        step[j] = 1e-6
        slope = (likelihood.evaluate(p + step).value - likelihood.evaluate(p - step).value) / 2e-6
        assert at.gradient[j] == pytest.approx(slope, rel=1e-5, abs=1e-4)
    assert np.linalg.eigvalsh(at.fisher).min() > 0


def test_the_restricted_likelihood_does_not_depend_on_the_unit_of_the_sizes() -> None:
    """Signals a thousand times larger, and noise with them, move the likelihood by a constant."""
    x = two_modes(np.random.default_rng(6), 2, 400)
    values = []
    for scale in (1.0, 1e3):
        likelihood = likelihood_of((make_block(scale * x, RATE, 40, 90),))
        shift = 2 * np.log(scale)
        likelihood = TransientLikelihood(
            likelihood.blocks,
            likelihood.shapes * scale,
            likelihood.units,
            likelihood.levels + shift,
        )
        at = [
            likelihood.evaluate(
                np.concatenate([np.log([60, 67.3, 0.01, z]), [1, 1], likelihood.levels, [0, 0]])
            ).value
            for z in (0.02, 0.03)
        ]
        values.append(at[1] - at[0])
    assert values[1] == pytest.approx(values[0], rel=1e-8)
