"""Errors of the filter and of the tracker over their standard deviations."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
from scipy import stats

from lmshealth.calibration.ranks import LEVEL
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import track
from studies.harness.study import Row, judge_scores
from studies.track.filter import lives


def band(total: float, dof: float) -> Row:
    """Judge a sum of squares by its 99.9 % band; numbers are per degree of freedom."""
    low, high = (float(end / dof) for end in stats.chi2.interval(LEVEL, dof))
    holds = bool(low <= total / dof <= high)
    return {"mean": total / dof, "low": low, "high": high, "dof": int(dof), "holds": holds}


def halved(history: History) -> History:
    """Return the same history with half the reported covariance."""
    return replace(history, cov=history.cov / 2)


def known_setting(rng: np.random.Generator, n: int, machine: Stage) -> Row:
    """Sum the squares of errors and innovations of the filter of the right setting.

    The errors of a life are those at one of its logs; the control has half the covariance.
    """
    sums: dict[str, dict[str, lives.Array]] = {
        kind: {name: np.zeros(2) for name in (*lives.QUANTITIES, "innovations")}
        for kind in ("as reported", "halved")
    }
    for _ in range(n):
        life = lives.draw(rng)
        k, _ = one_log(rng, life)
        for kind, history in (("as reported", life.history), ("halved", halved(life.history))):
            found = lives.filtered(replace(life, history=history), machine)
            for name, truth in life.truth().items():
                off = found.mean[name][k] - truth[k]
                sums[kind][name] += off @ np.linalg.solve(found.cov[name][k], off), off.size
            sums[kind]["innovations"] += found.nis.sum(), found.dof.sum()
    return {"lives": n} | {
        kind: {name: band(*both.tolist()) for name, both in rows.items()}
        for kind, rows in sums.items()
    }


def errors(life: lives.Life, history: History, k: int, machine: Stage) -> dict[str, lives.Array]:
    """Return errors of the tracker at one log over their standard deviations, mode by mode.

    ``width`` is the standard deviation of the drift.
    """
    found = track(history, machine)
    std = {
        "ln f": found.ln_frequency_std[k],
        "ln ζ": found.ln_damping_std[k],
        "drift": np.sqrt(np.diag(found.drift_cov[k])),
    }
    mean = {"ln f": found.ln_frequency[k], "ln ζ": found.ln_damping[k], "drift": found.drift[k]}
    off = {name: (mean[name] - life.truth()[name][k]) / std[name] for name in lives.QUANTITIES}
    return off | {"width": std["drift"]}


def coverage(z: list[float] | lives.Array) -> list[Row]:
    """Judge intervals of both levels by errors in standard deviations."""
    return [{"nominal": p} | judge_scores(np.asarray(z), p) for p in (0.5, 0.9)]


def moment(z: list[float]) -> Row:
    """Judge the mean square of errors by its own scatter, because their tails are heavy."""
    square = np.square(z)
    mean = float(square.mean())
    error = float(stats.norm.isf((1 - LEVEL) / 2) * square.std(ddof=1) / np.sqrt(square.size))
    return {"mean": mean, "error": error, "holds": abs(mean - 1) <= error}


def one_log(rng: np.random.Generator, life: lives.Life) -> tuple[int, int]:
    """Choose the log and the mode of a life that are judged: one, so that all are independent.

    A log without estimates is no choice: none since the baseline leaves a drift of exactly 0.
    """
    seen = np.flatnonzero(np.isfinite(life.history.ln_frequency).any(axis=1))
    return int(rng.choice(seen[1:])), int(rng.integers(2))


def averaged(rng: np.random.Generator, n: int, n_halved: int, machine: Stage) -> Row:
    """Judge intervals of the tracker, which does not know the setting.

    Published are a mean and a standard deviation; the average over settings has heavier tails than
    a normal distribution, so that its quantiles are judged as well. The control has intervals of
    half the width. Half the reported covariance is no control, as the tracker estimates its size:
    some lives show that.
    """
    z: dict[str, list[float]] = defaultdict(list)
    tails: dict[str, list[float]] = defaultdict(list)
    for j in range(n):
        life = lives.draw(rng)
        k, i = one_log(rng, life)
        found, below = errors(life, life.history, k, machine), lives.mixture(life, machine, k, i)
        for name in lives.QUANTITIES:
            z[name].append(float(found[name][i]))
            # As the error of a normal distribution that has as much below it.
            tails[name].append(float(stats.norm.ppf(below[name])))
        if j < n_halved:
            halves = errors(life, halved(life.history), k, machine)
            z["drift, R halved"].append(float(halves["drift"][i]))
    return {
        "lives": n,
        "coverage": {name: coverage(values) for name, values in z.items()},
        "mixture": {name: coverage(values) for name, values in tails.items()},
        "mean_square": {name: moment(z[name]) for name in lives.QUANTITIES},
        "control": coverage(2 * np.array(z["drift"])),
    }


def two_sources(rng: np.random.Generator, n: int, machine: Stage) -> Row:
    """Judge the drifts of lives that two sources see, by both and by one alone.

    The control takes errors that are common to both sources for independent ones.
    """
    ways = {
        "both": lambda history: history,
        "accelerometers alone": lambda history: lives.alone(history, "acc"),
        "common errors ignored": lives.without_common_errors,
    }
    z: dict[str, list[float]] = defaultdict(list)
    widths: dict[str, list[float]] = defaultdict(list)
    for _ in range(n):
        life = lives.draw(rng, ("acc", "delta_e"))
        k, i = one_log(rng, life)
        for kind, seen in ways.items():
            found = errors(life, seen(life.history), k, machine)
            z[kind].append(float(found["drift"][i]))
            widths[kind].append(float(found["width"][i]))
    ratios = {kind: np.divide(own, widths["accelerometers alone"]) for kind, own in widths.items()}
    return {"lives": n} | {
        kind: {"coverage": coverage(z[kind]), "median_width_ratio": float(np.median(ratios[kind]))}
        for kind in ways
    }
