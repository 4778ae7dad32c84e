"""Assignments are the best ones; shapes and names have the likelihoods of their distributions.

Candidates become modes by their odds and jumps by a second log, or are deleted.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from unittest.mock import patch

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.special import logsumexp

from lmshealth.tracking import constants
from lmshealth.tracking.association.hypotheses import (
    Candidates,
    Hypotheses,
    Scan,
    best_assignments,
    clutter_gains,
    extend,
    follow,
    name_gains,
    normalised,
    order_gains,
    prune,
    reduce_hypotheses,
    shape_gains,
)
from lmshealth.tracking.association.mode_filters import Measurements, ModeFilters, predict

ROW = np.array([1.0, 0.0])
NO_CANDIDATES = Candidates.empty(0, 0)


def measured(ln_f: list[float]) -> Measurements:
    """Make estimates without damping and shape."""
    n = len(ln_f)
    return Measurements(
        np.array(ln_f), np.full(n, 1e-6), np.zeros(n), np.full(n, np.inf), np.empty((n, 0))
    )


def hypotheses(levels: list[list[float]], weights: list[float]) -> Hypotheses:
    """Make hypotheses of two modes that differ in levels."""
    filters = ModeFilters.empty(0, 0).start(measured([4.6, 4.8]), ROW, np.zeros(0), 50.0)
    filters = filters[np.zeros(len(levels), dtype=int)]
    filters.mean[:, :, 0] = levels
    log_weights = np.log(np.array(weights))[:, None] + np.log([0.5, 0.5])
    return Hypotheses(filters, log_weights, np.zeros((len(levels), 1), dtype=int))


@pytest.mark.parametrize("seed", range(10))
def test_assignments_are_the_best_in_order(seed: int) -> None:
    """Enumeration of all assignments of a small table finds the same ones in the same order."""
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 4, 2)
    score = rng.normal(1.0, 3.0, (n, m))
    score[rng.random((n, m)) < 0.2] = -np.inf
    every = []
    for columns in product(range(-1, m), repeat=n):
        used = [c for c in columns if c >= 0]
        total = sum(score[i, c] for i, c in enumerate(columns) if c >= 0)
        if len(set(used)) == len(used) and total > -np.inf:
            every.append((total, columns))
    every.sort(reverse=True)
    found = best_assignments(score, -1e9, 10_000)
    assert len(found) == len(every)
    np.testing.assert_allclose([t for t, _ in found], [t for t, _ in every])
    assert {columns for _, columns in found} == {columns for _, columns in every}
    assert best_assignments(score, -1e9, 2) == found[:2]
    near = best_assignments(score, -3.0, 10_000)
    assert [t for t, _ in near] == [t for t, _ in found if t >= found[0][0] - 3.0]


@pytest.mark.parametrize("n", [2, 3, 5])
def test_shape_likelihood_is_a_distribution(n: int) -> None:
    """The likelihood ratio averages to one over random directions."""
    rng = np.random.default_rng(n)
    draws = rng.standard_normal((400_000, n))
    gains = shape_gains(draws, np.eye(n)[None, :1])[0, :, 0]
    values = np.exp(gains)
    assert values.mean() == pytest.approx(1.0, abs=4 * values.std() / np.sqrt(len(values)))
    assert gains.max() > 1
    assert gains.min() == pytest.approx(np.log(0.05), abs=0.01)


def test_shapes_without_common_channels_have_no_weight() -> None:
    """Shapes with one common channel have a ratio of zero."""
    shapes = np.array([[1.0, 1.0, np.nan], [np.nan, 1.0, 1.0]])
    modes = np.array([[[np.nan, 1.0, 1.0], [np.nan, np.nan, np.nan]]])
    gains = shape_gains(shapes, modes)
    assert gains[0, 0].tolist() == [0.0, 0.0]
    assert gains[0, 1, 0] > 0 == gains[0, 1, 1]


def test_names_by_order_follow_the_estimates() -> None:
    """Two estimates in order have the first and second name, for any pair of modes."""
    scan = Scan(0, np.arange(2), np.array([0, 1]), measured([4.6, 4.8]), ROW)
    labels, order = np.array([[0, 1], [1, 0], [1, -1]]), np.array([0, 1])
    seen = (np.tile([4.6, 4.7], (3, 1)), np.full((3, 2), 1e-8))
    by_order = order_gains(scan, labels, order, seen)
    np.testing.assert_allclose(by_order[:2], np.log(2 * 0.98), rtol=1e-6)
    # The missed mode is predicted at the estimate: below or above with equal probability.
    np.testing.assert_allclose(by_order[2], [0.0, 0.0], atol=1e-12)
    by_mode = name_gains(scan.names, labels, order)
    np.testing.assert_allclose(by_mode[0], np.log(2 * 0.98))
    np.testing.assert_allclose(by_mode[1], np.log(2 * 0.02))


def test_estimates_without_a_name_are_of_any_mode() -> None:
    """Estimates without a name or without a mode change no weight."""
    labels = np.array([[0, 1], [1, -1]])
    gains = name_gains(np.array([-1, 1]), labels, np.array([0, 1]))
    assert (gains[:, 0] == 0).all()
    assert gains[0, 1] > 0 == gains[1, 1]


def test_an_unknown_damping_is_averaged_over() -> None:
    """Odds without ln ζ are the mean of the odds with it over the ln ζ of clutter."""
    damping = np.linspace(-30.0, 30.0, 6001)
    n = damping.size
    first = replace(measured([4.6]), var_zeta=np.array([0.005]))
    filters = ModeFilters.empty(0, 0).start(first, ROW, np.zeros(0), 50.0)
    many = Scan(0, np.arange(n), np.full(n, -1), measured([4.601] * n), ROW)
    known = replace(many.measurements, ln_zeta=damping, var_zeta=np.full(n, 0.005))
    with_damping = clutter_gains(filters, replace(many, measurements=known))[0, :, 0]
    without = clutter_gains(filters, many)[0, 0, 0]
    mean = trapezoid(constants.CLUTTER_LN_ZETA_DENSITY * np.exp(with_damping), damping)
    assert mean == pytest.approx(np.exp(without), rel=1e-6)


@pytest.mark.parametrize(("opened", "chance"), [(False, 0.01), (True, 1.0)])
def test_a_mode_seldom_takes_the_place_of_another(opened: bool, chance: float) -> None:
    """An estimate at one mode is of another that strays with 1 % of the odds, unless logs open."""
    filters = ModeFilters.empty(0, 0).start(measured([4.6, 4.608]), ROW, np.zeros(0), 50.0)
    now = Hypotheses(filters, normalised(np.zeros((1, 2))), np.empty((1, 0), dtype=int))
    scan = Scan(0, np.arange(1), np.array([-1]), measured([4.6]), ROW)
    odds = []
    for value in (constants.TAKING_PROBABILITY, 1.0):
        with patch.object(constants, "TAKING_PROBABILITY", value):
            found = extend(now, scan, np.empty(0, dtype=int), opened=opened).probabilities(2)[0]
        odds.append(found[1] / found[2])
    assert odds[0] / odds[1] == pytest.approx(chance)


def test_far_dampings_are_not_merged() -> None:
    """Hypotheses of equal frequencies and different dampings are not merged."""
    kept = hypotheses([[4.6, 4.8], [4.6, 4.8]], [0.6, 0.4])
    kept.filters.var_zeta[:] = 0.01
    kept.filters.ln_zeta[:] = [[-4.0, -4.0], [-4.0, -3.0]]
    assert len(reduce_hypotheses(kept).log_weights) == 2
    kept.filters.ln_zeta[:] = -4.0
    assert len(reduce_hypotheses(kept).log_weights) == 1


def test_equal_hypotheses_become_one_and_keep_their_weight() -> None:
    """Near hypotheses are merged with the mean of the mixture, far ones are not."""
    near, far = 4.8 + 2e-4, 4.9
    kept = reduce_hypotheses(hypotheses([[4.6, 4.8], [4.6, near], [4.6, far]], [0.6, 0.3, 0.1]))
    weights = np.exp(logsumexp(kept.log_weights, axis=1))
    np.testing.assert_allclose(weights, [0.9, 0.1])
    assert kept.filters.mean[0, 1, 0] == pytest.approx((2 * 4.8 + near) / 3)
    assert kept.filters.cov[0, 1, 0, 0] == pytest.approx(1e-6 + 2 / 9 * 2e-4**2)


def test_hypotheses_without_weight_are_pruned() -> None:
    """Hypotheses with less than 1e-7 of the best are pruned."""
    kept = reduce_hypotheses(hypotheses([[4.6, 4.8], [4.6, 4.9]], [1.0, 1e-8]))
    assert len(kept.log_weights) == 1
    assert np.exp(kept.log_weights).sum() == pytest.approx(1.0)


def lone_scan(epoch: int, ln_f: float, name: int = -1) -> Scan:
    """Make a log with one estimate of no mode."""
    own = Measurements(
        np.array([ln_f]), np.array([1e-6]), np.array([-4.0]), np.array([0.01]), np.empty((1, 0))
    )
    return Scan(epoch, np.arange(1), np.array([name]), own, np.array([1.0, 0.0]))


def followed(estimates: list[tuple[float, int] | None]) -> tuple[Candidates, list[int | None]]:
    """Process one estimate or none per log; return the candidates and what each log confirms."""
    candidates, confirmed = NO_CANDIDATES, []
    for epoch, one in enumerate(estimates):
        candidates = replace(candidates, filters=predict(candidates.filters, 1.0, 50.0))
        own: list[int | None] = [None]
        if one:
            candidates, own = follow(candidates, lone_scan(epoch, *one), np.zeros(0), 50.0)
        confirmed += own
        candidates = prune(candidates, epoch, set(), set())
    return candidates, confirmed


def test_three_logs_make_a_mode() -> None:
    """The third consistent estimate confirms a mode, also after a log without it."""
    assert followed([(4.8, -1)] * 3)[1] == [None, None, 0]
    assert followed([(4.8, -1), None, (4.8, -1), (4.8, -1)])[1][-1] == 0


def test_two_logs_make_a_jump() -> None:
    """The second estimate with the name of a mode confirms; another name does not."""
    assert followed([(4.8, 1), (4.8, 1)])[1] == [None, 0]
    assert followed([(4.8, 1), (4.8, 0)])[1] == [None, None]


def test_scattered_estimates_make_no_mode() -> None:
    """Scattered estimates confirm nothing; candidates without detections are deleted."""
    candidates, confirmed = followed([(4.0 + 0.3 * k, -1) for k in range(6)])
    assert confirmed == [None] * 6
    before = len(candidates)
    for epoch in range(6, 12):
        candidates = prune(candidates, epoch, set(), set())
    assert len(candidates) < before


def test_a_mode_detected_at_its_old_level_has_not_jumped() -> None:
    """The candidate for a new level is deleted once the mode is detected at the old one."""
    candidates, _ = followed([(4.8, 1)])
    assert len(candidates) == 1
    assert len(prune(candidates, 1, set(), {1})) == 0


def test_following_changes_no_candidates_given() -> None:
    """`follow` and `prune` leave the candidates that they are given unchanged."""
    before, _ = followed([(4.8, -1)])
    odds, mean = before.log_odds.copy(), before.filters.mean.copy()
    follow(before, lone_scan(1, 4.8), np.zeros(0), 50.0)
    assert np.array_equal(before.log_odds, odds)
    assert np.array_equal(before.filters.mean, mean)
