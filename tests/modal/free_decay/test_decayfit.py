"""Maximum of the likelihood of decays, and its average against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal.free_decay.decay_fit import average_ambient, invert, maximise
from lmshealth.modal.free_decay.transient_likelihood import (
    TransientLikelihood,
    make_block,
    unit_level,
)
from tests.signals import sine
from tests.stops import Ring, stop

RATE = 400.0
LEVEL = float(np.log(0.02**2 * 2 / RATE))


def one_mode(x: np.ndarray, zeta: float = 0.01) -> tuple[TransientLikelihood, np.ndarray]:
    """Make the likelihood of one mode near 60 Hz from ``(n_segments, n_samples)``, and a start."""
    block = make_block(x[:, :, None], RATE, 42, 80)
    unit = unit_level(60.37, zeta, 1.0)
    likelihood = TransientLikelihood(
        (block,), np.full((1, 1), np.exp(LEVEL / 2)), np.array([unit]), np.array([LEVEL])
    )
    return likelihood, np.array([np.log(60.37), np.log(zeta), 1.0, LEVEL, 0.0])


def test_the_ascent_ends_where_a_damping_stands_at_its_bound() -> None:
    """A sine does not fade: its damping goes to the least there is, and nothing is left to gain."""
    rng = np.random.default_rng(3)
    x = sine(400, RATE, 60.37, 1.0) + 0.02 * rng.standard_normal(400)
    likelihood, start = one_mode(x[None])
    optimum = maximise(likelihood, start, np.arange(5))
    assert optimum.p[1] == pytest.approx(likelihood.least_damping(optimum.p)[0], abs=1e-6)
    assert optimum.decrement < 1e-5


def test_a_level_that_is_well_known_is_averaged_in_fine_steps() -> None:
    """Sixty stops tell the level: the average is then the normal approximation of all at once."""
    rng = np.random.default_rng(12)
    rings = [Ring(60.37, 0.01, ambient=0.1)]
    x = np.array([stop(rng, rings, 400, RATE, 0.02)[0] for _ in range(60)])
    likelihood, start = one_mode(x)
    optimum = maximise(likelihood, start, np.arange(5))
    found = average_ambient(likelihood, optimum.p, 0, np.array([0, 1, 3, 4]))
    normal = invert(likelihood, optimum, np.arange(5))
    assert normal[2, 2] < (0.2 * optimum.p[2]) ** 2
    own = slice(0, 3)  # the level of white noise below a loud response is not normal
    np.testing.assert_allclose(np.diag(found.cov)[own], np.diag(normal)[own], rtol=0.1)
    off = (found.mean - optimum.p) / np.sqrt(np.diag(normal))
    assert (np.abs(off[:2]) < 0.2).all()


@pytest.mark.slow
def test_the_average_over_the_ambient_response_is_the_posterior_s_moments() -> None:
    """Mean and covariance agree with importance sampling of all parameters at once."""
    rng = np.random.default_rng(11)
    rings = [Ring(60.37, 0.01, ambient=0.04)]
    x = stop(rng, rings, 400, RATE, 0.02)
    likelihood, start = one_mode(x)
    optimum = maximise(likelihood, start, np.arange(5))
    found = average_ambient(likelihood, optimum.p, 0, np.array([0, 1, 3, 4]))

    centre = optimum.p.copy()
    centre[2] = np.log(found.mean[2])
    cov = found.cov.copy()
    cov[2] /= found.mean[2]
    cov[:, 2] /= found.mean[2]
    normal = rng.standard_normal((3000, 5)) / np.sqrt(rng.chisquare(5, 3000) / 5)[:, None]
    points = centre + normal @ np.linalg.cholesky(1.3 * cov).T
    weights = 5 * np.log1p(np.sum(normal**2, axis=1) / 5)
    for k, point in enumerate(points):
        p = point.copy()
        p[2] = np.exp(point[2])
        at = likelihood.evaluate(p)
        weights[k] += 0.5 * np.log(at.fisher[2, 2]) + point[2] - at.value
    weights = np.exp(weights - weights.max())
    weights /= weights.sum()
    mean = weights @ points
    std = np.sqrt(weights @ (points - mean) ** 2)
    effective = 1 / np.sum(weights**2)
    assert effective > 200
    own = np.sqrt(np.diag(found.cov))
    for j in (0, 1):
        # A standard deviation from n samples with a heavy tail is off by about √(κ/4n).
        assert own[j] == pytest.approx(std[j], rel=4 / np.sqrt(effective))
        assert abs(found.mean[j] - mean[j]) < 4 / np.sqrt(effective) * std[j]
    held = np.sqrt(np.diag(invert(likelihood, optimum, np.array([0, 1, 3, 4]))))
    assert own[0] > 1.05 * held[0]
