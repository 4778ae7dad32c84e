"""Factors on standard deviations: what they are from, and their product."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import invgamma

from lmshealth._private.serialize import pack, unpack
from lmshealth.modal.credibility import (
    Credibility,
    Factor,
    dependence,
    inverse_bias,
    neighbour_correlation,
    small_sample,
    widened,
)
from lmshealth.modal.modes import Modes, estimates_only, merge, numbered


def modes(f: float, factor: float) -> Modes:
    """Return one mode whose standard deviations were widened."""
    plain = estimates_only(np.log([f, 0.01]), 1e-6 * np.eye(2), np.ones(1), "acc", ["acc_x"])
    return plain.widened("unsteady", factor**2 * plain.cov)


def test_the_total_is_the_product_and_unknown_without_factors() -> None:
    """Two factors multiply; an estimate of another program has none."""
    assert Credibility((Factor("a", 1.5), Factor("b", 2.0))).total == 3.0
    assert np.isnan(Credibility().total)


def test_a_factor_is_the_ratio_of_standard_deviations_of_ln_f() -> None:
    """Each mode has its own; what ln ζ gains is not in it."""
    before = np.diag([1.0, 4.0, 9.0, 16.0])
    after = np.diag([4.0, 4.0, 90.0, 160.0])
    first, second = widened((Credibility(),) * 2, "coloured", before, after)
    assert first.factors == (Factor("coloured", 2.0),)
    assert second.factors == (Factor("coloured", 1.0),)


def test_modes_keep_their_factors_when_they_are_joined_and_sorted() -> None:
    """The factor of each mode follows it, also into the table and through the store."""
    joined = numbered(merge([modes(90.0, 3.0), modes(60.0, 2.0)], (), ()))
    assert joined.to_columns()["std_factor"] == pytest.approx([2.0, 3.0])
    assert joined.select([1]).to_frame()["std_factor"].tolist() == pytest.approx([3.0])
    again = unpack(pack(joined), Modes)
    assert again.credibility == joined.credibility


def test_only_a_clear_correlation_of_neighbours_counts() -> None:
    """Independent errors have none; an autoregressive sequence has its own."""
    rng = np.random.default_rng(1)
    white = rng.standard_normal((2000, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    assert neighbour_correlation(white) == 0
    coloured = white.copy()
    for k in range(1, white.size):
        coloured[k] = 0.6 * coloured[k - 1] + white[k]
    assert neighbour_correlation(coloured) == pytest.approx(0.6, abs=0.05)


def test_dependence_is_the_factor_on_the_variance_of_a_mean() -> None:
    """The sum over all lags of a correlation 0.6^|k|."""
    assert dependence(0.6) == pytest.approx(np.sum(0.6 ** np.abs(np.arange(-200, 201.0))))


@pytest.mark.parametrize("freedom", [4.0, 16.0, 41.0])
def test_weights_from_few_values_cost_what_is_stated(freedom: float) -> None:
    """By the moments of an inverse gamma: σ²/s² has a biased mean, weighting by it costs variance.

    An estimate weighted by w = 1/s² has the variance E w² / (E w)² over that of known weights.
    """
    weight = invgamma(freedom, scale=freedom)
    mean, square = weight.mean(), weight.moment(2)
    assert inverse_bias(freedom) == pytest.approx(mean)
    assert small_sample(freedom, unbiased=True) == pytest.approx(square / mean**2)
    assert small_sample(freedom) == pytest.approx(square / mean)
