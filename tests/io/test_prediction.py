"""Linear prediction: the expectation of missing samples, its error, and what is not filled."""

import numpy as np
import pytest
from scipy.signal import lfilter

from lmshealth.io.channel_checks import filled, fit_prediction

NONE = np.empty((0, 2), dtype=np.int64)
NO_BREAK = np.empty(0, dtype=np.int64)
ORDER = 32


def resonance(n=20_000, seed=0):
    """Make a resonance at a twentieth of the sample rate in white noise."""
    rng = np.random.default_rng(seed)
    pole = np.exp(2j * np.pi * 0.05 - 2 * np.pi * 0.05 * 0.02)
    x = lfilter([1], np.poly([pole, pole.conj()]), rng.standard_normal(n))
    return x / x.std() + 0.05 * rng.standard_normal(n)


def cut(x, size, every=400, first=200):
    """Remove samples in gaps of one size; return samples and gaps."""
    starts = np.arange(first, x.size - first, every)
    gaps = np.stack([starts, starts + size], axis=1)
    damaged = x.copy()
    for a, b in gaps:
        damaged[a:b] = np.nan
    return damaged, gaps


def test_the_expectation_is_that_of_the_joint_normal_distribution():
    """Of an autoregressive process it equals the conditional mean by its covariance matrix."""
    x = resonance(300_000)
    model = fit_prediction(x, NONE)
    assert model is not None
    unknown = np.array([ORDER, ORDER + 1, ORDER + 5])
    part = x[: 3 * ORDER]
    found = model.expected(part.copy(), unknown)
    # The least sum of squared prediction errors over the unknown samples.
    y = part.copy()
    y[unknown] = found
    for i in unknown:
        moved = y.copy()
        moved[i] += 1e-4
        below = (model.errors(y) ** 2).sum()
        assert below < (model.errors(moved) ** 2).sum()


@pytest.mark.parametrize("size", [1, 3, 8])
def test_short_gaps_are_filled_within_the_noise(size):
    """Filled samples are off by a small part of the signal, the others are unchanged."""
    x = resonance()
    damaged, gaps = cut(x, size)
    values, left = filled(damaged, gaps, NO_BREAK)
    assert left.shape == (0, 2) and np.isfinite(values[:]).all()
    inside = np.isnan(damaged)
    assert (values[inside] - x[inside]).std() < 0.15
    np.testing.assert_array_equal(values[~inside], x[~inside])


def test_long_gaps_and_breaks_stay_open():
    """A gap longer than half the order, or beside an interruption of time, is not filled."""
    damaged, gaps = cut(resonance(), 17)
    assert filled(damaged, gaps, NO_BREAK)[1].tolist() == gaps.tolist()
    damaged, gaps = cut(resonance(), 2)
    left = filled(damaged, gaps, gaps[:1, 1] + 10)[1]
    assert left.tolist() == gaps[:1].tolist()


def test_a_gap_at_a_blow_stays_open():
    """What nobody can predict is not filled in."""
    x = resonance()
    x[4203:4300] += 40 * np.exp(-np.arange(97) / 20)
    damaged, gaps = cut(x, 2)
    assert filled(damaged, gaps, NO_BREAK)[1].tolist() == [[4200, 4202]]


def test_too_little_to_predict_from():
    """A record with too few whole windows is not filled."""
    damaged, gaps = cut(resonance(900), 1)
    assert filled(damaged, gaps, NO_BREAK)[1].tolist() == gaps.tolist()
