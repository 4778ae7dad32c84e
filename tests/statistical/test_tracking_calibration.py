"""Calibration of the tracker, on lives drawn from its own model and on those of `models`.

Where one log of a life is judged it is tracked up to that log: later ones change nothing of it, as
`tests.tracking.test_track` has it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy import stats

from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.track import track
from studies.harness.data.lives import (
    DAMAGED,
    HEALTHY,
    Estimates,
    Life,
    drawn,
    history_of,
    life_of,
    measured,
    plan_of,
)
from studies.track.crossings.lives import KINDS, judge, make_life, nearest
from studies.track.crossings.run import labels_of
from studies.track.filter.lives import QUANTITIES, alone, draw, mixture, stage
from studies.track.filter.trials import errors, known_setting
from tests.claims import Claims
from tests.statistical.evidence import all_of, as_often, at_least, at_most, sum_of_squares, uniform

DECLARED_RATE = 0.01


@pytest.fixture(scope="module")
def machine() -> Stage:
    """Two modes, temperature, a life of 20,000 km."""
    return stage()


@pytest.fixture(scope="module")
def sizes() -> tuple[Estimates, Life]:
    """Covariances of logs that were simulated and identified, by which lives are drawn."""
    return measured("lms-y", 8)


def test_errors_of_the_true_setting_are_as_large_as_it_says(
    rng: np.random.Generator, claims: Claims, machine: Stage
) -> None:
    """NEES of ln f, ln ζ and drift, and NIS, are χ²; with half the covariance none is."""
    found = known_setting(rng, claims.trials, machine)
    for name in claims.part.claims:
        for kind, state in (("as reported", claims.claim), ("halved", claims.control)):
            row = found[kind][name]
            state(name, sum_of_squares(row["mean"] * row["dof"], row["dof"]))


def test_intervals_of_the_tracker_cover(
    rng: np.random.Generator, claims: Claims, machine: Stage
) -> None:
    """Not knowing the setting, the average over settings is calibrated, one mode and log a life.

    Its mean and standard deviation, as of a normal distribution, cover no less than they say.
    Controls have half the width.
    """
    rows: dict[str, list[tuple[float, float]]] = {name: [] for name in QUANTITIES}
    for _ in range(claims.trials):
        life = draw(rng)
        k, i = int(rng.integers(1, len(life.history.logs))), int(rng.integers(2))
        seen = life.history.first_logs(k + 1)
        off, below = errors(life, seen, k, machine), mixture(life, machine, k, i)
        for name in QUANTITIES:
            rows[name].append((float(off[name][i]), float(stats.norm.ppf(below[name]))))
    for name, values in rows.items():
        published, average = np.array(values).T
        for factor, state in ((1.0, claims.claim), (2.0, claims.control)):
            state(f"{name}, average of settings", uniform(stats.norm.cdf(factor * average)))
            state(f"{name}, as published", not_less(factor * published))


def not_less(off: np.ndarray) -> float:
    """P value of 50 and 90 % intervals that cover at least as often as they say."""
    reach = {share: stats.norm.ppf((1 + share) / 2) for share in (0.5, 0.9)}
    return all_of(at_least(np.sum(np.abs(off) < z), off.size, share) for share, z in reach.items())


def test_a_second_source_does_no_harm(
    rng: np.random.Generator, claims: Claims, machine: Stage
) -> None:
    """Two sources whose errors are nine tenths common cover no less, and are not wider.

    Control: a third of the width.
    """
    off, ratio = [], []
    for _ in range(claims.trials):
        life = draw(rng, ("acc", "delta_e"))
        k, i = int(rng.integers(1, len(life.history.logs))), int(rng.integers(2))
        seen = life.history.first_logs(k + 1)
        both = errors(life, seen, k, machine)
        one = errors(life, alone(seen, "acc"), k, machine)
        off.append(both["drift"][i])
        ratio.append(both["width"][i] / one["width"][i])
    claims.claim("drift, two sources", not_less(np.array(off)))
    claims.control("drift, two sources", not_less(3 * np.array(off)))
    assert np.median(ratio) < 1.05


def test_modes_that_cross_are_not_swapped(rng: np.random.Generator, claims: Claims) -> None:
    """A label is given where it is 95 % sure: one life in twenty at most is swapped unseen.

    Control: each estimate to the mode that was last seen nearest.
    """
    for name in claims.part.claims:
        kind = KINDS["crossing, named by order" if "order" in name else "crossing, unnamed"]
        swapped: Counter[str] = Counter()
        for _ in range(claims.trials):
            life = make_life(kind, rng)
            swapped["ours"] += judge(life, labels_of(life).assigned)["lives_swapped"]
            swapped["nearest"] += judge(life, nearest(life))["lives_swapped"]
        claims.claim(name, at_most(swapped["ours"], claims.trials, 0.05))
        claims.control(name, at_most(swapped["nearest"], claims.trials, 0.05))


def lives(
    rng: np.random.Generator, kinds: Sequence[str], n: int, sizes: tuple[Estimates, Life]
) -> list[tuple[Life, Estimates]]:
    """Draw lives of the Y stage, of all kinds in turn, and estimates of them."""
    found = []
    for k in range(n):
        life = life_of(plan_of("lms-y", kinds[k % len(kinds)], int(rng.integers(1 << 31))))
        found.append((life, drawn(life, *sizes, rng)))
    return found


def alarmed(pairs: Sequence[tuple[Life, Estimates]], machine: Stage, **known: Any) -> int:
    """Count the lives with an alarm; what is known of them goes to `history_of`."""
    return sum(bool(track(history_of(life, seen, **known), machine).alarms) for life, seen in pairs)


def test_healthy_lives_raise_no_alarms(
    rng: np.random.Generator, claims: Claims, sizes: tuple[Estimates, Life]
) -> None:
    """At most one in a hundred; nearly all do where nobody knows the temperature."""
    healthy, machine = lives(rng, HEALTHY, claims.trials, sizes), load_stage("lms-y")
    claims.claim("alarms", at_most(alarmed(healthy, machine), len(healthy), DECLARED_RATE))
    warm = lives(rng, ["temperature-only"], claims.part.control, sizes)
    hits = alarmed(warm, machine, covariates=("payload_kg",))
    claims.control("alarms", at_most(hits, len(warm), DECLARED_RATE))


def test_drifts_of_damaged_lives_cover(
    rng: np.random.Generator, claims: Claims, sizes: tuple[Estimates, Life]
) -> None:
    """90 % intervals of one mode after one log a life, at which it has moved; not at half width."""
    errors_in_std, machine = [], load_stage("lms-y")
    for life, seen in lives(rng, DAMAGED, claims.trials, sizes):
        mode = int(rng.integers(life.drift.shape[1]))
        moved = 1 + np.flatnonzero(life.drift[1:, mode])
        if moved.size:
            k = int(rng.choice(moved))
            found = track(history_of(life, seen).first_logs(k + 1), machine)
            error, var = found.drift[k, mode] - life.drift[k, mode], found.drift_cov[k, mode, mode]
            # A log at the baseline's own odometer has no drift and no error.
            errors_in_std.append(abs(error) / np.sqrt(var) if var > 0 else 0.0)
    off = np.array(errors_in_std)
    reach = stats.norm.ppf(0.95)
    claims.claim("drift, damaged lives", as_often(int(np.sum(off < reach)), off.size, 0.9))
    claims.control("drift, damaged lives", as_often(int(np.sum(2 * off < reach)), off.size, 0.9))
