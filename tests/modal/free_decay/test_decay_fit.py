"""Modes of a band of decays: how many, how well known, and whether the rest is stationary."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal.free_decay.decay_fit import (
    Ringing,
    estimate,
    find_ringing,
    stationarity,
)
from lmshealth.modal.free_decay.transient_likelihood import make_block
from tests.stops import Ring, stop

RATE = 400.0


def ringing(x: np.ndarray, low: float = 35.0, high: float = 90.0) -> Ringing:
    """Fit decays of shape ``(n_segments, n_channels, n_samples)`` in a band."""
    return find_ringing((make_block(np.swapaxes(x, 1, 2), RATE, low, high),))


def stops(seed: int, rings: list[Ring], n_stops: int = 3, noise: float = 0.02) -> np.ndarray:
    """Make decays of a second."""
    rng = np.random.default_rng(seed)
    return np.array([stop(rng, rings, 400, RATE, noise) for _ in range(n_stops)])


def test_as_many_modes_are_found_as_there_are() -> None:
    """Two modes 4 Hz apart that ring differently in two channels are found, and no third."""
    rings = [Ring(60.0, 0.005, (1.0, 0.6), 0.02), Ring(64.0, 0.01, (0.8, -0.7), 0.02)]
    found = ringing(stops(1, rings))
    np.testing.assert_allclose(np.sort(found.frequency), [60.0, 64.0], rtol=1e-3)
    np.testing.assert_allclose(np.sort(found.damping_ratio), [0.005, 0.01], rtol=0.2)


@pytest.mark.slow
def test_noise_does_not_ring() -> None:
    """White noise in two channels has no mode, in any of thirty logs."""
    rng = np.random.default_rng(2)
    found = [ringing(rng.standard_normal((2, 2, 400))) for _ in range(30)]
    assert sum(fit.likelihood.n_modes for fit in found) == 0


def test_signal_to_noise_ratio_is_that_of_the_largest_ordinate() -> None:
    """A loud decay's snr is the top of its periodogram over the noise's density."""
    x = stops(3, [Ring(60.37, 0.002)], noise=1e-3)
    found = ringing(x)
    block = found.likelihood.blocks[0]
    top = np.mean(np.abs(block.ordinates[..., 0]) ** 2, axis=0).max()
    assert found.snr(0)[0] == pytest.approx(top / (1e-6 * 2 / RATE), rel=0.2)


def test_excitation_compares_a_stop_with_the_ambient_response() -> None:
    """A stop of ten times the ambient standard deviation has an excitation near 50."""
    x = stops(4, [Ring(60.37, 0.01, ambient=0.1)], n_stops=20, noise=1e-3)
    found = ringing(x)
    result = estimate(found)
    assert result.excitation[0] == pytest.approx(50, rel=0.5)


@pytest.mark.slow
def test_two_channels_know_more_than_one() -> None:
    """A second channel with the same noise shrinks the standard deviation by about √2."""
    x = stops(5, [Ring(60.0, 0.01, (1.0, 1.0))], n_stops=8)
    std = [np.sqrt(np.diag(estimate(ringing(part)).cov))[0] for part in (x, x[:, :1])]
    assert 1.2 < std[1] / std[0] < 1.65


@pytest.mark.slow
def test_the_order_of_the_modes_changes_nothing() -> None:
    """Estimates have a joint covariance that is positive definite, with each mode's own block."""
    rings = [Ring(60.0, 0.01, ambient=0.05), Ring(63.0, 0.01, ambient=0.05)]
    result = estimate(ringing(stops(6, rings, n_stops=4)))
    assert result.mean.shape == (4,)
    assert np.linalg.eigvalsh(result.cov).min() > 0


@pytest.mark.slow
def test_stationary_noise_beside_a_decay_passes_as_such() -> None:
    """The p-values of thirty fits to decays in stationary noise spread over the unit interval."""
    p = [stationarity(ringing(stops(s, [Ring(60.0, 0.01, ambient=0.02)], 2))) for s in range(30)]
    assert min(p) > 1e-4
    assert 0.25 < np.median(p) < 0.75


def test_noise_that_dies_away_is_found_out() -> None:
    """Noise that is loud in the first half of the record only is not stationary."""
    x = stops(8, [Ring(60.0, 0.01)], 2)
    x[..., :200] += 0.3 * np.random.default_rng(9).standard_normal((2, 1, 200))
    assert stationarity(ringing(x)) < 1e-6
