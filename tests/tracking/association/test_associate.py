"""Estimates get the labels of their modes without later logs; doubtful ones are refused."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from lmshealth.errors import BadTable
from lmshealth.tracking import constants
from lmshealth.tracking.association import associate as module
from lmshealth.tracking.association.associate import (
    Association,
    Estimates,
    LogMeasurements,
    State,
    associate,
    associate_log,
    measurements_of,
)
from lmshealth.tracking.association.hypotheses import Hypotheses, extend

Array = NDArray[np.float64]
STD_F, STD_ZETA = 1e-3, 0.1
N = 60
CLOCK = np.arange(N) / (N - 1)


@pytest.fixture
def rng() -> np.random.Generator:
    """Return the generator of a test."""
    return np.random.default_rng(20261121)


def say(
    ln_f: Sequence[float] | Array,
    names: Sequence[str] | None = None,
    *,
    ln_zeta: Sequence[float] | Array | None = None,
    shapes: Array | None = None,
    sources: Sequence[str] | None = None,
) -> Estimates:
    """Make the estimates of a log."""
    n = len(ln_f)
    zeta = np.full(n, -4.0) if ln_zeta is None else np.array(ln_zeta, dtype=float)
    return Estimates(
        names=tuple(names) if names is not None else ("",) * n,
        sources=tuple(sources) if sources is not None else ("acc",) * n,
        ln_frequency=np.array(ln_f, dtype=float),
        ln_damping=zeta,
        cov=np.diag(np.where(np.isfinite(np.tile(zeta, 2)), np.repeat([1e-6, 1e-2], n), 1e-6)),
        shapes=np.empty((n, 0)) if shapes is None else np.array(shapes, dtype=float),
    )


def run(epochs: Sequence[Estimates], **options: Any) -> Association:
    """Associate logs at even places of the clock, without covariates."""
    n = len(epochs)
    options = {"offsets": np.zeros((n, 0)), "prior_std": np.zeros(0)} | options
    return associate(epochs, np.arange(float(n)), **options)


def crossing(rng: np.random.Generator, *, named: bool = True) -> list[Estimates]:
    """Two modes that cross at mid-life, named by the order of their frequencies."""
    rows = []
    for t in CLOCK:
        centre = np.log(120.0) + np.array([0.08, -0.08]) * (t - 0.51)
        rows.append(say(sorted(centre + STD_F * rng.standard_normal(2)), "ab" if named else None))
    return rows


def steady(rng: np.random.Generator, n: int, f: Sequence[float] = (100.0, 126.0)) -> Array:
    """Noisy ln frequencies of modes that stay where they are."""
    return np.log(f) + STD_F * rng.standard_normal((n, len(f)))


def test_identity_survives_a_crossing_though_names_go_by_order(rng: np.random.Generator) -> None:
    """After the crossing the lower estimate, still named a, is of b."""
    found = run(crossing(rng))
    assert found.modes == ("a", "b")
    assert set(found.assigned[:20]) == {("a", "b")}
    assert set(found.assigned[-10:]) == {("b", "a")}


def test_identity_survives_a_crossing_without_names(rng: np.random.Generator) -> None:
    """Tracks are confirmed by their third log, named by frequency, and keep their names."""
    found = run(crossing(rng, named=False))
    low, high = found.modes
    assert low.endswith("_hz")
    assert set(found.assigned[:2]) == {(None, None)}
    assert set(found.assigned[3:20]) == {(low, high)}
    assert set(found.assigned[-10:]) == {(high, low)}


def test_names_that_follow_the_mode_are_accepted(rng: np.random.Generator) -> None:
    """Labels follow the names where names follow straight lines through a crossing."""
    rows = crossing(rng)
    swapped = [
        replace(e, names=("b", "a")) if t > 0.51 else e for t, e in zip(CLOCK, rows, strict=True)
    ]
    found = run(swapped)
    assert set(found.assigned[-10:]) == {("b", "a")}


@pytest.mark.slow
def test_damping_decides_where_frequency_does_not(rng: np.random.Generator) -> None:
    """Two modes merge and part; the label of the one with three times the damping is kept."""
    gap = np.concatenate([np.linspace(0.02, 0, 20), np.zeros(15), np.linspace(0, 0.02, 25)])
    rows = []
    for k, g in enumerate(gap):
        side = -0.5 if k < 27 else 0.5
        values = 4.8 + g * np.array([side, -side]) + STD_F * rng.standard_normal(2)
        dampings = np.array([-4.5, -3.4]) + STD_ZETA * rng.standard_normal(2)
        order = np.argsort(values)
        rows.append(say(values[order], "ab", ln_zeta=dampings[order]))
    assert set(run(rows).assigned[-15:]) == {("b", "a")}


@pytest.mark.slow
def test_estimates_that_nothing_distinguishes_are_ambiguous(rng: np.random.Generator) -> None:
    """Equal modes that merge and part get no labels afterwards; the reason names both."""
    gap = np.concatenate([np.linspace(0.02, 0, 20), np.zeros(15), np.linspace(0, 0.02, 25)])
    rows = [
        say(np.sort(4.8 + g * np.array([-0.5, 0.5]) + STD_F * rng.standard_normal(2)), "ab")
        for g in gap
    ]
    found = run(rows)
    assert set(found.assigned[:10]) == {("a", "b")}
    assert set(found.assigned[-20:]) == {(None, None)}
    epoch, estimate, last = found.unassigned[-1]
    assert (last.reason, epoch, estimate) == ("ambiguous", N - 1, 1)
    assert "a " in last.detail and "b " in last.detail
    told = [int(share) for share in re.findall(r"(\d+)%", last.detail)]
    assert len(told) >= 2 and told == sorted(told, reverse=True)


@pytest.mark.slow
def test_shapes_decide_where_frequencies_merge(rng: np.random.Generator) -> None:
    """With shapes at right angles the same modes keep their labels throughout."""
    gap = np.concatenate([np.linspace(0.02, 0, 20), np.zeros(15), np.linspace(0, 0.02, 25)])
    rows = []
    for k, g in enumerate(gap):
        side = -0.5 if k < 27 else 0.5
        shapes = np.eye(3)[:2] + 0.05 * rng.standard_normal((2, 3))
        values = 4.8 + g * np.array([side, -side]) + STD_F * rng.standard_normal(2)
        order = np.argsort(values)
        rows.append((say(values[order], "ab", shapes=shapes[order]), order))
    found = run([e for e, _ in rows])
    for label, (_, order) in zip(found.assigned, rows, strict=True):
        assert label == tuple("ab"[i] for i in order)


@pytest.mark.parametrize(("gap", "first", "last"), [(0.003, 20, 20), (0.01, 15, 10)])
def test_modes_that_veer_are_labelled_by_their_shapes(gap: float, first: int, last: int) -> None:
    """Frequencies veer and shapes are exchanged, at once or over half of the life."""
    half = np.linspace(-0.03, 0.03, N)
    reach, angle = np.hypot(half, gap), 0.5 * np.arctan2(gap, half)
    rows = [
        say(4.8 + np.array([-r, r]), "ab",
            shapes=np.array([[-np.sin(t), np.cos(t), 0], [np.cos(t), np.sin(t), 0]]))
        for r, t in zip(reach, angle, strict=True)
    ]  # fmt: skip
    found = run(rows)
    assert set(found.assigned[:first]) == {("a", "b")}
    assert set(found.assigned[-last:]) == {("b", "a")}


def test_sensors_that_are_moved_cost_no_label(rng: np.random.Generator) -> None:
    """All shapes change at once: from then on the labels follow the frequencies."""
    rows = []
    for k, row in enumerate(steady(rng, 30)):
        shapes = np.eye(4)[2 * (k >= 15) :][:2] + 0.05 * rng.standard_normal((2, 4))
        rows.append(say(row, "ab", shapes=shapes))
    assert run(rows).assigned == (("a", "b"),) * 30


@pytest.mark.slow
def test_sparse_logs_after_a_burst_keep_their_modes(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Modes 7 % apart keep their labels over gaps longer than the whole history before them."""
    clock = np.r_[0.3 * np.arange(50), 15 + 400.0 * np.arange(1, 13)]
    drift = np.array([-0.015, -0.03]) * clock[:, None] / clock[-1]
    rows = [say(f, "ab") for f in steady(rng, clock.size, (126.4, 136.6)) + drift]

    def found() -> Association:
        return associate(rows, clock, offsets=np.zeros((clock.size, 0)), prior_std=np.zeros(0))

    assert set(found().assigned) == {("a", "b")}
    # With the mean distance of the logs alone, a gap is a whole life.
    monkeypatch.setattr(constants, "LEAST_LIFE_GAPS", 0)
    assert found().assigned[50] == (None, None)


def test_modes_that_cross_after_a_burst_are_not_swapped(rng: np.random.Generator) -> None:
    """They are named by order: after the crossing no label is that of the name."""
    clock = np.r_[1e-3 * np.arange(30), 1.0 + np.arange(30)]
    apart = np.array([0.08, -0.08]) * (clock[:, None] / clock[-1] - 0.51)
    rows = [say(np.sort(f), "ab") for f in apart + steady(rng, clock.size, (120.0, 120.0))]
    found = associate(rows, clock, offsets=np.zeros((clock.size, 0)), prior_std=np.zeros(0))
    assert set(found.assigned[:40]) == {("a", "b")}
    assert set(found.assigned[-10:]) <= {("b", "a"), (None, None)}


def test_labels_use_no_later_log(rng: np.random.Generator) -> None:
    """The labels of a truncated life equal those of the whole life."""
    rows = crossing(rng)
    whole = run(rows)
    for n in (1, 2, 25, 31, 34, 50):
        part = run(rows[:n])
        assert part.assigned == whole.assigned[:n]
        assert part.unassigned == [one for one in whole.unassigned if one[0] < n]


def test_a_jump_is_accepted_once_the_next_log_confirms_it(rng: np.random.Generator) -> None:
    """A step costs the label of one estimate; the mode continues at its new level."""
    ln_f = steady(rng, 30)
    ln_f[15:, 1] -= 0.08
    found = run([say(row, "ab") for row in ln_f])
    assert [(k, i, d.reason) for k, i, d in found.unassigned] == [(15, 1, "jump")]
    assert found.assigned[16:] == (("a", "b"),) * 14
    assert "named b" in found.unassigned[0][2].detail


@pytest.mark.parametrize("step", [0.01, 0.04, 0.06])
def test_jumps_of_any_size_cost_at_most_one_estimate(rng: np.random.Generator, step: float) -> None:
    """A step of 1 % is labelled at once; a larger one is a jump until the next log."""
    ln_f = steady(rng, 30)
    ln_f[15:, 1] -= step
    doubts = run([say(row, "ab") for row in ln_f]).unassigned
    assert [(k, d.reason) for k, _, d in doubts] == ([(15, "jump")] if step > 0.03 else [])


def test_a_single_outlier_stays_refused(rng: np.random.Generator) -> None:
    """A peak with a wrong name moves no level."""
    ln_f = steady(rng, 30)
    ln_f[15, 1] -= 0.08
    found = run([say(row, "ab") for row in ln_f])
    assert [(k, d.reason) for k, _, d in found.unassigned] == [(15, "jump")]
    assert found.assigned[16] == ("a", "b")


def test_declared_jumps_need_no_confirmation(rng: np.random.Generator) -> None:
    """A step at declared maintenance is labelled at once."""
    ln_f = steady(rng, 30)
    ln_f[15:, 1] -= 0.08
    rows = [say(row, "ab") for row in ln_f]
    assert run(rows, jumps=[15]).assigned == (("a", "b"),) * 30
    assert run(rows).assigned[15] == ("a", None)


def test_modes_that_jump_together_keep_their_names(rng: np.random.Generator) -> None:
    """A crash moves all modes: names at places where no mode was are accepted at once."""
    ln_f = steady(rng, 30)
    ln_f[15:] -= 0.08
    assert run([say(row, "ab") for row in ln_f]).assigned == (("a", "b"),) * 30


def test_a_name_that_is_wrong_once_is_overruled(rng: np.random.Generator) -> None:
    """Names that change places for one log do not change the labels."""
    rows = [say(row, "ba" if k == 20 else "ab") for k, row in enumerate(steady(rng, 30))]
    assert run(rows).assigned == (("a", "b"),) * 30


def test_modes_vanish_and_return(rng: np.random.Generator) -> None:
    """A mode without a name is recognised after ten logs without it."""
    rows = [say(row[:1] if 20 <= k < 30 else row) for k, row in enumerate(steady(rng, 50))]
    found = run(rows)
    assert found.modes == ("100_hz", "126_hz")
    assert set(found.assigned[20:30]) == {("100_hz",)}
    assert set(found.assigned[30:]) == {("100_hz", "126_hz")}


def test_spurious_estimates_found_no_tracks(rng: np.random.Generator) -> None:
    """Estimates at random frequencies are refused as spurious, with the reason."""
    rows = []
    for row in steady(rng, 50):
        extra = [float(rng.uniform(4.9, 5.5))] if rng.random() < 0.3 else []
        rows.append(say([*row, *extra], ["a", "b", *("" for _ in extra)]))
    found = run(rows)
    assert found.modes == ("a", "b")
    assert {label.reason for _, _, label in found.unassigned} == {"unconfirmed"}
    assert "three logs" in found.unassigned[0][2].detail


def test_births_near_each_other_have_names_of_their_own(rng: np.random.Generator) -> None:
    """Two modes that round to one frequency are named with more digits."""
    ln_f = np.log([120.2, 119.7]) + 2e-4 * rng.standard_normal((10, 2))
    rows = []
    for row in ln_f:
        one = say(row)
        rows.append(replace(one, cov=np.diag([4e-8, 4e-8, 1e-2, 1e-2])))
    names = run(rows).modes
    assert len(set(names)) == 2
    assert {"120_hz"} < set(names)


def test_sources_share_a_mode(rng: np.random.Generator) -> None:
    """Each source has one estimate of each mode, and two of one source are never of one."""
    rows = [
        say([*row, *(row + STD_F)], ["a", "b", "a", "b"], sources=["acc"] * 2 + ["delta_e"] * 2)
        for row in steady(rng, 20)
    ]
    assert run(rows).assigned == (("a", "b", "a", "b"),) * 20


@pytest.mark.slow
def test_covariates_are_regressed(rng: np.random.Generator) -> None:
    """Changes of temperature that move modes by 1 % cost no label, unless they are not given."""
    warm = 10 * np.sign(np.sin(np.arange(N))) + rng.standard_normal(N)
    ln_f = np.log([120.0, 122.0]) + 1e-3 * warm[:, None] + 2e-4 * rng.standard_normal((N, 2))
    rows = [replace(say(row), cov=np.diag([4e-8, 4e-8, 1e-2, 1e-2])) for row in ln_f]
    told = run(rows, offsets=warm[:, None], prior_std=np.array([1e-3]))
    assert set(told.assigned[10:]) == {told.modes}
    assert {label for row in run(rows).assigned[10:] for label in row} != set(told.modes)


def test_unknown_dampings_do_no_harm(rng: np.random.Generator) -> None:
    """Estimates without damping are assigned by frequency alone."""
    rows = [
        say(row, "ab", ln_zeta=[np.nan, -4.0] if k % 2 else [-4.0, np.nan])
        for k, row in enumerate(steady(rng, 20))
    ]
    assert run(rows).assigned == (("a", "b"),) * 20


def random_life(seed: int) -> tuple[list[Estimates], dict[str, Any]]:
    """Simulate a life of mostly steady logs: jumps, outliers, gaps, modes that meet, shapes."""
    rng = np.random.default_rng(seed)
    n, m = 120, 4
    warm = rng.uniform(-10, 10, n)
    walk = np.cumsum(3e-4 * rng.standard_normal((n, m)), axis=0)
    ln_f = np.log([45.0, 89.0, 126.0, 136.6]) + walk - 4e-4 * warm[:, None]
    ln_f[:, 2] += np.linspace(0, rng.choice([0.0, 0.12]), n)
    ln_f += STD_F * rng.standard_normal((n, m))
    ln_f[rng.integers(20, n, 4), rng.integers(0, m, 4)] += 0.07
    ln_f[60:, : rng.integers(1, m)] -= rng.choice([0.004, 0.05])
    zeta = -4 + STD_ZETA * rng.standard_normal((n, m))
    rows = []
    for k in range(n):
        kept = np.flatnonzero(rng.random(m) > 0.004)
        shapes = np.eye(m)[kept] + 0.1 * rng.standard_normal((kept.size, m))
        rows.append(
            say(
                ln_f[k, kept],
                ["abcd"[i] for i in kept],
                ln_zeta=zeta[k, kept],
                shapes=shapes if seed % 2 else None,
                sources=["acc" if i % 2 or seed % 3 else "frf" for i in kept],
            )
        )
    return rows, {"offsets": warm[:, None], "prior_std": np.array([1e-3])}


@pytest.mark.parametrize(
    "seed", [1, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 11))]
)
def test_unique_assignments_have_the_labels_of_hypotheses(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """The gates, which take most logs, change no label and no reason."""
    rows, options = random_life(seed)
    unique, taken = module._unique_assignment, []

    def counted(*given: Any) -> Any:
        found = unique(*given)
        taken.append(found is not None)
        return found

    monkeypatch.setattr(module, "_unique_assignment", counted)
    fast = run(rows, **options)
    assert sum(taken) > 10
    monkeypatch.setattr(module, "_unique_assignment", lambda *given: None)
    slow = run(rows, **options)
    assert fast.assigned == slow.assigned
    assert [(k, i, d.reason) for k, i, d in fast.unassigned] == [
        (k, i, d.reason) for k, i, d in slow.unassigned
    ]


def logs_of(rows: Sequence[Estimates], life: float = 50.0) -> list[LogMeasurements]:
    """Make logs at even places of the clock."""
    none = np.zeros(0)
    return [
        LogMeasurements(k, float(k), life if k else 0.0, none, False, one.names, one.sources, own)
        for k, (one, own) in enumerate(zip(rows, measurements_of(rows), strict=True))
    ]


def test_the_step_is_pure(rng: np.random.Generator) -> None:
    """A state may be continued twice, with the same result."""
    state = State.start(np.zeros(0), 0)
    for log in logs_of(crossing(rng)[:29]):
        state, _ = associate_log(state, log)
    mean = state.hypotheses.filters.mean.copy()
    (last,) = logs_of([say([4.6, 4.8], "ab")])
    last = replace(last, epoch=29, clock=29.0)
    first, again = associate_log(state, last), associate_log(state, last)
    assert first[1] == again[1]
    assert np.array_equal(first[0].hypotheses.filters.mean, again[0].hypotheses.filters.mean)
    assert np.array_equal(state.hypotheses.filters.mean, mean)


def test_shapes_are_made_of_unit_length() -> None:
    """Lengths of shapes have no meaning; a shape of zeros is unknown."""
    (own,) = measurements_of([say([4.6, 4.8], shapes=np.array([[3.0, 4.0], [0.0, 0.0]]))])
    np.testing.assert_allclose(own.shapes[0], [0.6, 0.8])
    assert np.isnan(own.shapes[1]).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"cov": np.diag([1e-6, 0.0, 1e-2, 1e-2])},
        {"cov": np.diag([1e-6, -1e-6, 1e-2, 1e-2])},
        {"cov": np.diag([1e-6, np.nan, 1e-2, 1e-2])},
        {"cov": np.diag([1e-6, 1e-6, 1e-2, np.nan])},
        {"ln_frequency": np.array([4.6, np.nan])},
    ],
)
def test_estimates_without_a_value_or_std_are_refused(changes: dict[str, Any]) -> None:
    """The error names the log, the estimate and its mode."""
    good = say([4.6, 4.8], "ab")
    with pytest.raises(BadTable, match=r"epoch 1, estimate 1 \(b\).*positive variances"):
        run([good, replace(good, **changes)])


@pytest.mark.parametrize("name", ["ln_damping", "cov", "shapes"])
def test_fields_that_do_not_fit_are_refused(name: str) -> None:
    """The error names the field."""
    wrong: dict[str, Any] = {
        "ln_damping": np.zeros(3),
        "cov": np.eye(2),
        "shapes": np.eye(3),
    }
    with pytest.raises(ValueError, match=name):
        replace(say([4.6, 4.8]), **{name: wrong[name]})


class Plain:
    """One mode of the oracle: its filter, written as in a textbook."""

    def __init__(self, y: float, z: float) -> None:
        self.x, self.p = np.array([y, 0.0]), np.diag([STD_F**2, 0.0])
        self.z, self.q, self.fresh = z, STD_ZETA**2, True

    def predict(self, step: float, scale: float) -> None:
        """Predict; the rate has its prior from the second log on."""
        rate = 0.3 / scale
        if self.fresh:
            self.p[1, 1], self.fresh = rate**2, False
        elif self.p[1, 1] > rate**2:
            d = np.diag([1.0, rate / np.sqrt(self.p[1, 1])])
            self.x, self.p = d @ self.x, d @ self.p @ d
        f = np.array([[1.0, step], [0.0, 1.0]])
        share, white = step / scale, 0.1**2 / scale**3
        noise = white * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        noise[0, 0] += 3e-3**2 * share
        self.x, self.p = f @ self.x, f @ self.p @ f.T + noise
        self.q += 0.3**2 * share

    def absorb(self, y: float, z: float) -> float:
        """Update with an estimate; return its density."""
        s, t = self.p[0, 0] + STD_F**2, self.q + STD_ZETA**2
        dy, dz = y - self.x[0], z - self.z
        in_f = 0.95 * norm.pdf(dy, 0, s**0.5), 0.05 * norm.pdf(dy, 0, (s + 1e-4) ** 0.5)
        in_z = 0.95 * norm.pdf(dz, 0, t**0.5), 0.05 * norm.pdf(dz, 0, (t + 0.49) ** 0.5)
        if in_f[1] > in_f[0]:
            self.p[0, 0] += 1e-4
        if in_z[1] > in_z[0]:
            self.q += 0.49
        gain = self.p[:, 0] / (self.p[0, 0] + STD_F**2)
        self.x, self.p = self.x + gain * dy, self.p - np.outer(gain, self.p[0])
        k = self.q / (self.q + STD_ZETA**2)
        self.z, self.q = self.z + k * dz, (1 - k) * self.q
        return float(sum(in_f) * sum(in_z))


def likelihood_of_order(labels: Sequence[int], values: Array, modes: Sequence[Plain]) -> float:
    """Return the probability of names 0 and 1 by order of frequency, relative to a half each."""
    total = 1.0
    for i, mode in enumerate(labels):
        if mode >= 0:
            other = 1 - mode
            if labels[1 - i] == other:
                below = float(values[1 - i] < values[i])
            else:
                s = (modes[other].p[0, 0] + STD_F**2) ** 0.5
                below = float(norm.cdf((values[i] - modes[other].x[0]) / s))
            right = below if i else 1 - below
            total *= 2 * (0.02 + 0.96 * right)
    return total


def enumerated(ln_f: Array, ln_zeta: Array) -> list[Array]:
    """Return label probabilities of each log after the first, over all assignment sequences."""
    n = len(ln_f)
    ways = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if a != b or a < 0]
    weights: dict[tuple[tuple[int, int], ...], float] = {}
    for length in range(1, n):
        for path in product(ways, repeat=length):
            modes = [Plain(y, z) for y, z in zip(ln_f[0], ln_zeta[0], strict=True)]
            weight, by_mode, by_order = 1.0, 0.5, 0.5
            for k, labels in enumerate(path, start=1):
                for mode in modes:
                    mode.predict(1.0, 50.0)
                by_order *= likelihood_of_order(labels, ln_f[k], modes)
                for i, t in enumerate(labels):
                    if t >= 0:
                        # Seen against missed, over the density of a stranger.
                        density = modes[t].absorb(ln_f[k, i], ln_zeta[k, i])
                        weight *= density * 0.8 / 0.2 / (0.1 * 0.3)
                        by_mode *= 2 * (0.98 if i == t else 0.02)
            weights[path] = weight * (by_mode + by_order)
    chances = []
    for length in range(1, n):
        own = {path: w for path, w in weights.items() if len(path) == length}
        each = np.zeros((2, 3))
        for path, w in own.items():
            for i, t in enumerate(path[-1]):
                each[i, t] += w
        chances.append(each / sum(own.values()))
    return chances


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_chances_are_those_of_all_sequences_of_assignments(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Enumerate four logs of two near modes with textbook filters: the probabilities agree."""
    monkeypatch.setattr(constants, "MERGING_DISTANCE", -1.0)
    monkeypatch.setattr(constants, "PRUNING_LOG_ODDS", -60.0)
    monkeypatch.setattr(constants, "MOST_HYPOTHESES", 10_000)
    seen: list[Array] = []

    def watched(*given: Any, **options: Any) -> Hypotheses:
        extended = extend(*given, **options)
        seen.append(extended.probabilities(2))
        return extended

    monkeypatch.setattr(module, "extend", watched)
    rng = np.random.default_rng(seed)
    ln_f = 4.8 + np.array([-1e-3, 1e-3]) * rng.uniform(0.5, 2) + STD_F * rng.standard_normal((4, 2))
    ln_zeta = -4 + 2 * STD_ZETA * rng.standard_normal((4, 2))
    rows = [say(y, "ab", ln_zeta=z) for y, z in zip(ln_f, ln_zeta, strict=True)]
    state = State.start(np.zeros(0), 0)
    for log in logs_of(rows):
        state, _ = associate_log(state, log)
    for found, wanted in zip(seen[1:], enumerated(ln_f, ln_zeta), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-12)


def test_one_log_alone() -> None:
    """A single log gives the labels of its names, and none without names."""
    assert run([say([4.6, 4.8], "ab")]).assigned == (("a", "b"),)
    assert run([say([4.6, 4.8])]).modes == ()


def test_logs_without_estimates(rng: np.random.Generator) -> None:
    """A log without estimates changes nothing."""
    rows = [say(row, "ab") if k % 3 else say([], []) for k, row in enumerate(steady(rng, 20))]
    assert set(run(rows).assigned) == {(), ("a", "b")}


def test_equal_clocks_are_one_moment(rng: np.random.Generator) -> None:
    """Logs at one place of the odometer are associated like others."""
    rows = [say(row, "ab") for row in steady(rng, 10)]
    found = associate(rows, np.zeros(10), offsets=np.zeros((10, 0)), prior_std=np.zeros(0))
    assert found.assigned == (("a", "b"),) * 10
