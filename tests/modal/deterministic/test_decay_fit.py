"""Fit of decays: poles, estimates, and averages over the ambient response."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal.deterministic.decay_fit import (
    average_ambient,
    estimate,
    fit_decays,
    peak_snr,
    stationarity,
)
from lmshealth.modal.deterministic.likelihood import (
    ModalLikelihood,
    transform_decays,
    unit_level,
)
from lmshealth.modal.deterministic.poles import PoleFit, maximise
from tests.signals import sine
from tests.stops import Ring, stop

RATE = 400.0


def fitted(x: np.ndarray, low: float = 35.0, high: float = 90.0) -> PoleFit:
    """Fit decays of shape ``(n_segments, n_channels, n_samples)`` in a band."""
    return fit_decays((transform_decays(np.swapaxes(x, 1, 2), RATE, low, high),))


def stops(seed: int, rings: list[Ring], n_stops: int = 3, noise: float = 0.02) -> np.ndarray:
    """Make decays of a second."""
    rng = np.random.default_rng(seed)
    return np.array([stop(rng, rings, 400, RATE, noise) for _ in range(n_stops)])


def test_as_many_modes_are_found_as_there_are() -> None:
    """Two modes 4 Hz apart that ring differently in two channels are found, and no third."""
    rings = [Ring(60.0, 0.005, (1.0, 0.6), 0.02), Ring(64.0, 0.01, (0.8, -0.7), 0.02)]
    found = fitted(stops(1, rings))
    np.testing.assert_allclose(np.sort(found.frequency), [60.0, 64.0], rtol=1e-3)
    np.testing.assert_allclose(np.sort(found.damping_ratio), [0.005, 0.01], rtol=0.2)


@pytest.mark.slow
def test_noise_does_not_ring() -> None:
    """White noise in two channels has no mode, in any of thirty logs."""
    rng = np.random.default_rng(2)
    found = [fitted(rng.standard_normal((2, 2, 400))) for _ in range(30)]
    assert sum(fit.likelihood.n_modes for fit in found) == 0


def test_signal_to_noise_ratio_is_that_of_the_largest_ordinate() -> None:
    """A loud decay's snr is the top of its periodogram over the noise's density."""
    x = stops(3, [Ring(60.37, 0.002)], noise=1e-3)
    found = fitted(x)
    block = found.likelihood.blocks[0]
    top = np.mean(np.abs(block.ordinates[..., 0]) ** 2, axis=0).max()
    assert peak_snr(found, 0)[0] == pytest.approx(top / (1e-6 * 2 / RATE), rel=0.2)


def test_excitation_compares_a_stop_with_the_ambient_response() -> None:
    """A stop of ten times the ambient standard deviation has an excitation near 50."""
    x = stops(4, [Ring(60.37, 0.01, ambient=0.1)], n_stops=20, noise=1e-3)
    found = fitted(x)
    result = estimate(found)
    assert result.excitation[0] == pytest.approx(50, rel=0.5)


def inverse(found: PoleFit, free: np.ndarray) -> np.ndarray:
    """Return the inverse of the Fisher information of the free parameters."""
    return np.linalg.inv(found.at.fisher[np.ix_(free, free)])


def test_the_average_over_ambient_levels_is_a_factor() -> None:
    """It leads from the standard deviation at the mean level to the published one."""
    found = fitted(stops(4, [Ring(60.37, 0.01, ambient=0.1)], n_stops=3, noise=1e-3))
    result = estimate(found)
    (factor,) = result.credibility[0].factors
    free = np.array([0, 1, 3, 4])
    mean, _ = average_ambient(found.likelihood, found.p, 0, free)
    held = found.p.copy()
    held[2] = mean[2]
    at_level = inverse(maximise(found.likelihood, held, free), free)
    assert factor.cause == "ambient-level"
    assert factor.value == pytest.approx(np.sqrt(result.cov[0, 0] / at_level[0, 0]))


@pytest.mark.slow
def test_two_channels_know_more_than_one() -> None:
    """A second channel with the same noise shrinks the standard deviation by about √2."""
    x = stops(5, [Ring(60.0, 0.01, (1.0, 1.0))], n_stops=8)
    std = [np.sqrt(np.diag(estimate(fitted(part)).cov))[0] for part in (x, x[:, :1])]
    assert 1.2 < std[1] / std[0] < 1.65


@pytest.mark.slow
def test_the_order_of_the_modes_changes_nothing() -> None:
    """Estimates have a joint covariance that is positive definite, with each mode's own block."""
    rings = [Ring(60.0, 0.01, ambient=0.05), Ring(63.0, 0.01, ambient=0.05)]
    result = estimate(fitted(stops(6, rings, n_stops=4)))
    assert result.mean.shape == (4,)
    assert np.linalg.eigvalsh(result.cov).min() > 0


@pytest.mark.slow
def test_stationary_noise_beside_a_decay_passes_as_such() -> None:
    """The p-values of thirty fits to decays in stationary noise spread over the unit interval."""
    p = [stationarity(fitted(stops(s, [Ring(60.0, 0.01, ambient=0.02)], 2))) for s in range(30)]
    assert min(p) > 1e-4
    assert 0.25 < np.median(p) < 0.75


def test_noise_that_dies_away_is_found_out() -> None:
    """Noise that is loud in the first half of the record only is not stationary."""
    x = stops(8, [Ring(60.0, 0.01)], 2)
    x[..., :200] += 0.3 * np.random.default_rng(9).standard_normal((2, 1, 200))
    assert stationarity(fitted(x)) < 1e-6


LEVEL = float(np.log(0.02**2 * 2 / RATE))


def one_mode(x: np.ndarray, zeta: float = 0.01) -> tuple[ModalLikelihood, np.ndarray]:
    """Make the likelihood of one mode near 60 Hz from ``(n_segments, n_samples)``, and a start."""
    block = transform_decays(x[:, :, None], RATE, 42, 80)
    unit = unit_level(60.37, zeta, 1.0)
    likelihood = ModalLikelihood(
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
    free = likelihood.movable(optimum.p, optimum.at.gradient, np.arange(5))
    slope = optimum.at.gradient[free]
    metric = likelihood.metric(optimum.at)[np.ix_(free, free)]
    assert slope @ np.linalg.solve(metric, slope) / 2 < 1e-4


def test_a_level_that_is_well_known_is_averaged_in_fine_steps() -> None:
    """Sixty stops determine the level: the average is the normal approximation of all."""
    rng = np.random.default_rng(12)
    rings = [Ring(60.37, 0.01, ambient=0.1)]
    x = np.array([stop(rng, rings, 400, RATE, 0.02)[0] for _ in range(60)])
    likelihood, start = one_mode(x)
    optimum = maximise(likelihood, start, np.arange(5))
    mean, cov = average_ambient(likelihood, optimum.p, 0, np.array([0, 1, 3, 4]))
    normal = inverse(optimum, np.arange(5))
    assert normal[2, 2] < (0.2 * optimum.p[2]) ** 2
    own = slice(0, 2)  # levels are not normal
    np.testing.assert_allclose(np.diag(cov)[own], np.diag(normal)[own], rtol=0.1)
    off = (mean - optimum.p) / np.sqrt(np.diag(normal))
    assert (np.abs(off[:2]) < 0.2).all()


@pytest.mark.slow
def test_the_average_over_the_ambient_response_is_the_posterior_s_moments() -> None:
    """Mean and covariance agree with importance sampling of all parameters at once."""
    rng = np.random.default_rng(11)
    rings = [Ring(60.37, 0.01, ambient=0.04)]
    x = stop(rng, rings, 400, RATE, 0.02)
    likelihood, start = one_mode(x)
    optimum = maximise(likelihood, start, np.arange(5))
    mean, cov = average_ambient(likelihood, optimum.p, 0, np.array([0, 1, 3, 4]))

    centre = optimum.p.copy()
    centre[2] = np.log(mean[2])
    scaled = cov.copy()
    scaled[2] /= mean[2]
    scaled[:, 2] /= mean[2]
    normal = rng.standard_normal((4000, 5)) / np.sqrt(rng.chisquare(5, 4000) / 5)[:, None]
    points = centre + normal @ np.linalg.cholesky(1.3 * scaled).T
    weights = 5 * np.log1p(np.sum(normal**2, axis=1) / 5)
    for k, point in enumerate(points):
        p = point.copy()
        p[2] = np.exp(point[2])
        at = likelihood.evaluate(p)
        weights[k] += 0.5 * np.log(at.fisher[2, 2]) + point[2] - at.value
    weights = np.exp(weights - weights.max())
    weights /= weights.sum()
    sampled = weights @ points
    std = np.sqrt(weights @ (points - sampled) ** 2)
    effective = 1 / np.sum(weights**2)
    assert effective > 200
    own = np.sqrt(np.diag(cov))
    for j in (0, 1):
        # A standard deviation from n samples with a heavy tail is off by about √(κ/4n).
        assert own[j] == pytest.approx(std[j], rel=4 / np.sqrt(effective))
        assert abs(mean[j] - sampled[j]) < 4 / np.sqrt(effective) * std[j]
    held = np.sqrt(np.diag(inverse(optimum, np.array([0, 1, 3, 4]))))
    assert own[0] > 1.05 * held[0]
