"""Errors of the filter and of the tracker, in units of what they claim."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import track
from studies.common.metrics import clopper_pearson
from studies.harness.study import LEVEL, Row
from studies.tracking_filter.lives import (
    Array,
    Life,
    alone,
    draw,
    filtered,
    mixture,
    without_common_errors,
)

QUANTITIES = ("ln f", "ln ζ", "drift")
NOMINAL = (0.5, 0.9)


def band(total: float, dof: float) -> Row:
    """Judge a sum of squares by its 99.9 % band; numbers are per degree of freedom."""
    low, high = stats.chi2.interval(LEVEL, dof)
    return {
        "mean": total / dof,
        "low": float(low / dof),
        "high": float(high / dof),
        "dof": int(dof),
        "holds": bool(low <= total <= high),
    }


def halved(history: History) -> History:
    """Return the same history with half the reported covariance."""
    return replace(history, cov=history.cov / 2)


def known_setting(rng: np.random.Generator, n: int, machine: Stage) -> Row:
    """Sum the squares of errors and innovations of the filter of the right setting.

    The errors of a life are those at one of its logs; the control has half the covariance.
    """
    sums: dict[str, dict[str, list[float]]] = {
        kind: {name: [0.0, 0.0] for name in (*QUANTITIES, "innovations")}
        for kind in ("as reported", "halved")
    }
    for _ in range(n):
        life = draw(rng)
        k = int(rng.integers(1, len(life.history.logs)))
        for kind, history in (("as reported", life.history), ("halved", halved(life.history))):
            found = filtered(replace(life, history=history), machine)
            for name, truth in life.truth().items():
                off = found.mean[name][k] - truth[k]
                sums[kind][name][0] += float(off @ np.linalg.solve(found.cov[name][k], off))
                sums[kind][name][1] += off.size
            sums[kind]["innovations"][0] += float(found.nis.sum())
            sums[kind]["innovations"][1] += float(found.dof.sum())
    return {"lives": n} | {
        kind: {name: band(*both) for name, both in rows.items()} for kind, rows in sums.items()
    }


def errors(life: Life, history: History, k: int, machine: Stage) -> dict[str, Array]:
    """Errors of the tracker at one log in its standard deviations, and these, mode by mode."""
    found = track(history, machine)
    std = {
        "ln f": found.ln_frequency_std[k],
        "ln ζ": found.ln_damping_std[k],
        "drift": np.sqrt(np.diag(found.drift_cov[k])),
    }
    mean = {"ln f": found.ln_frequency[k], "ln ζ": found.ln_damping[k], "drift": found.drift[k]}
    off = {name: (mean[name] - life.truth()[name][k]) / std[name] for name in QUANTITIES}
    return off | {"width": std["drift"]}


def coverage(z: Array) -> list[Row]:
    """Return how often intervals of both levels hold the truth."""
    rows = []
    for level in NOMINAL:
        hits = int(np.sum(np.abs(z) < stats.norm.ppf((1 + level) / 2)))
        low, high = clopper_pearson(hits, z.size, LEVEL)
        rows.append({"nominal": level, "hits": hits, "n": z.size, "share": hits / z.size,
                     "low": low, "high": high, "holds": low <= level <= high,
                     "not_less": high >= level})  # fmt: skip
    return rows


def moment(z: Array) -> Row:
    """Judge the mean square of errors by its own scatter, because their tails are heavy."""
    square = np.square(z)
    error = float(stats.norm.isf((1 - LEVEL) / 2) * square.std(ddof=1) / np.sqrt(z.size))
    return {"mean": float(square.mean()), "error": error,
            "holds": bool(abs(square.mean() - 1) <= error)}  # fmt: skip


def averaged(rng: np.random.Generator, n: int, n_halved: int, machine: Stage) -> Row:
    """Cover the truth by the tracker, which knows nothing of the setting.

    What is published is a mean and a standard deviation. The average over settings they belong to
    has heavier tails than a normal distribution, so that its own quantiles are judged as well.

    One mode at one log of each life counts, so that all are independent. The control has intervals
    of half the width; half the reported covariance is no control, as the tracker finds it out:
    some lives show that.
    """
    rows: dict[str, list[float]] = {name: [] for name in (*QUANTITIES, "drift, R halved")}
    tails: dict[str, list[float]] = {name: [] for name in QUANTITIES}
    for j in range(n):
        life = draw(rng)
        k, i = int(rng.integers(1, len(life.history.logs))), int(rng.integers(2))
        found = errors(life, life.history, k, machine)
        below = mixture(life, machine, k, i)
        for name in QUANTITIES:
            rows[name].append(float(found[name][i]))
            # As the error of a normal distribution that has as much below it.
            tails[name].append(float(stats.norm.ppf(below[name])))
        if j < n_halved:
            halves = errors(life, halved(life.history), k, machine)
            rows["drift, R halved"].append(float(halves["drift"][i]))
    z = {name: np.array(values) for name, values in rows.items()}
    return {
        "lives": n,
        "coverage": {name: coverage(values) for name, values in z.items()},
        "mixture": {name: coverage(np.array(values)) for name, values in tails.items()},
        "mean_square": {name: moment(z[name]) for name in QUANTITIES},
        "control": coverage(2 * z["drift"]),
    }


def two_sources(rng: np.random.Generator, n: int, machine: Stage) -> Row:
    """Cover the drifts of lives that two sources see, by both and by one alone.

    The control takes errors that are common to both sources for independent ones.
    """
    kinds = ("both", "accelerometers alone", "common errors ignored")
    rows: dict[str, list[float]] = {kind: [] for kind in kinds}
    widths: dict[str, list[float]] = {kind: [] for kind in kinds}
    for _ in range(n):
        life = draw(rng, ("acc", "delta_e"))
        k, i = int(rng.integers(1, len(life.history.logs))), int(rng.integers(2))
        histories = (life.history, alone(life.history, "acc"), without_common_errors(life.history))
        for kind, history in zip(kinds, histories, strict=True):
            found = errors(life, history, k, machine)
            rows[kind].append(float(found["drift"][i]))
            widths[kind].append(float(found["width"][i]))
    reference = np.array(widths["accelerometers alone"])
    return {"lives": n} | {
        kind: {
            "coverage": coverage(np.array(rows[kind])),
            "median_width_ratio": float(np.median(np.array(widths[kind]) / reference)),
        }
        for kind in kinds
    }
