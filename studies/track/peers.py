"""Is ln f tracked as well, and stated as rightly, as by other filters that find their own noise?

Method
    Lives of three modes of `drift`, which are not drawn from a state space, without temperature:
    four courses of wear, quiet and wandering machines, and linear wear with 5 % of the estimates
    (of no first or last log) too high by eight standard deviations, or with stated errors of half
    their size. Every program gets ln f and its stated standard deviations, log by log, and is asked
    for ln f without wander at the last log. Peers: statsmodels, local linear trend and local level,
    variances by maximum likelihood for each mode; simdkalman, local linear trend, variances by 50
    steps of expectation maximisation; filterpy, local linear trend with the stated errors and a
    slope that changes by a twentieth of one from log to log, as its user would choose it. Errors
    are in units of the true standard deviation of one log; modes are taken for independent.
    Controls: the last estimate alone, which must be worse where nothing moves, and intervals of the
    program half as wide, which must hold too little.
Run time
    Six minutes on two processors. statsmodels and simdkalman come with the extra ``peers``.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from importlib.util import find_spec

import numpy as np
from filterpy.common import Q_discrete_white_noise
from filterpy.kalman import KalmanFilter
from scipy import stats

from lmshealth._private.arrays import FloatArray
from lmshealth.calibration.ranks import share_row
from lmshealth.stage.description import load_stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import track
from studies.harness.claims import Claim, number
from studies.harness.metrics import mean
from studies.harness.study import Row, Study
from studies.track.drift import LN_F, draw

OURS, CONTROL, NARROW = "lmshealth", "the last estimate alone", "lmshealth, half as wide"
OUTLIERS, UNDERSTATED = "linear, outliers", "linear, errors understated"
KINDS = ("linear", "power", "exponential", "late", "quiet", "wandering", OUTLIERS, UNDERSTATED)
LIVES, REACH = 40, stats.norm.ppf(0.95)
SHARE_OFF, OFF_BY, FACTOR = 0.05, 8.0, 2.0
STEPS, SLOPE = 50, 0.05
# Level and its slope, from log to log, in standard deviations of a log; variances at the first.
TREND, SEEN = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
FIRST = 1.0, 100.0
AS_GOOD, HOLD = "no peer has smaller errors in any kind", "90 % intervals hold in every kind"
WORSE = "the last estimate is worse where nothing moves (control)"
TOO_FEW = "half the width does not hold (control)"
NOT_MET = {
    AS_GOOD: (
        "a machine that stays is tracked best by a filter that takes it to stay (local level), "
        "whose intervals hold in no other kind"
    )
}

# Ln f of the modes at the last log, and its standard deviation; of one mode in its own units.
Answer = tuple[FloatArray, FloatArray]
Filter = Callable[[FloatArray], tuple[float, float]]


def main() -> None:
    """Run the study; ``--quick`` does four lives of two kinds and records nothing."""
    study = Study(__file__, __doc__)
    if not study.quick and not all(map(find_spec, ("statsmodels", "simdkalman"))):
        raise SystemExit("statsmodels or simdkalman not installed: pip install '.[peers]'")
    n, kinds = (4, ("quiet", OUTLIERS)) if study.quick else (LIVES, KINDS)
    tasks = [(kind, seed) for kind in kinds for seed in range(0, 2 * n, 2)]
    with study.pool() as pool:
        rows = study.trials.collect(one_life, tasks, pool=pool)
    found = {kind: compare([row for row in rows if row["kind"] == kind]) for kind in kinds}
    answer = {"kinds": found, "passed": verdicts(found)}
    study.conclude(answer, not_met=NOT_MET, quick_may_fail=True)


def one_life(kind: str, seed: int) -> Row:
    """Return what each program makes of a life: errors and standard deviations, and its time."""
    base = kind.split(",")[0]
    life, rng = draw(base, seed), np.random.default_rng([seed, sum(kind.encode()), 1])
    std = float(stated(life.history)[0])
    history = life.history
    if kind == OUTLIERS:
        off = rng.random(history.ln_frequency.shape) < SHARE_OFF
        off[[0, -1]] = False
        history = replace(history, ln_frequency=history.ln_frequency + OFF_BY * std * off)
    elif kind == UNDERSTATED:
        history = replace(history, cov=history.cov / FACTOR**2)
    truth, row = LN_F + life.drift[-1], {"kind": kind, "seed": seed}
    for name, program in PROGRAMS.items():
        start = time.process_time()
        answer, own_std = program(history)
        seconds = time.process_time() - start
        row[name] = {"off": ((answer - truth) / std).tolist(),
                     "std": (own_std / std).tolist(), "cpu_s": seconds}  # fmt: skip
    return row


def by_lmshealth(history: History) -> Answer:
    """Track by the program."""
    found = track(history, load_stage("lms-y"))
    return found.ln_frequency[-1], found.ln_frequency_std[-1]


def mode_by_mode(one: Filter, history: History) -> Answer:
    """Filter each mode alone, in its stated standard deviations from the first log on."""
    noise = stated(history)
    scaled = (history.ln_frequency - history.ln_frequency[0]) / noise
    level, std = np.array([one(column) for column in scaled.T]).T
    return history.ln_frequency[0] + noise * level, noise * std


def by_filterpy(column: FloatArray) -> tuple[float, float]:
    """Filter with stated errors, and a slope that a user chose."""
    kalman = KalmanFilter(dim_x=2, dim_z=1)
    kalman.x, kalman.P = np.zeros(2), np.diag(FIRST)
    kalman.F, kalman.H = TREND, SEEN
    kalman.R, kalman.Q = 1.0, Q_discrete_white_noise(2, 1.0, SLOPE**2)
    for value in column[1:]:
        kalman.predict()
        kalman.update(value)
    return kalman.x[0], kalman.P[0, 0] ** 0.5


def by_simdkalman(column: FloatArray) -> tuple[float, float]:
    """Filter with variances by expectation maximisation."""
    import simdkalman

    kalman = simdkalman.KalmanFilter(TREND, np.diag([0.01, SLOPE**2]), SEEN, 1.0)
    states = kalman.em(column[None], n_iter=STEPS).compute(
        column[None], 0, initial_value=np.zeros(2), initial_covariance=np.diag(FIRST),
        filtered=True, smoothed=False,
    ).filtered.states  # fmt: skip
    return states.mean[0, -1, 0], states.cov[0, -1, 0, 0] ** 0.5


def by_statsmodels(level: str, column: FloatArray) -> tuple[float, float]:
    """Filter with variances by maximum likelihood."""
    from statsmodels.tsa.statespace.structural import UnobservedComponents

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = UnobservedComponents(column, level=level).fit(disp=0, maxiter=200)
    return found.filtered_state[0, -1], found.filtered_state_cov[0, 0, -1] ** 0.5


def stated(history: History) -> FloatArray:
    """Return the stated standard deviations of ln f, which are those of all logs."""
    return np.sqrt(history.cov[-1].diagonal()[: len(history.modes)])


def last_estimate(history: History) -> Answer:
    """Take the last log as it is (control)."""
    return history.ln_frequency[-1], stated(history)


PROGRAMS: dict[str, Callable[[History], Answer]] = {
    OURS: by_lmshealth,
    "filterpy": partial(mode_by_mode, by_filterpy),
    "simdkalman": partial(mode_by_mode, by_simdkalman),
    "statsmodels, local linear trend": partial(mode_by_mode, partial(by_statsmodels, "lltrend")),
    "statsmodels, local level": partial(mode_by_mode, partial(by_statsmodels, "llevel")),
    CONTROL: last_estimate,
}


def compare(rows: list[Row]) -> Row:
    """Compare the programs on the same lives: mean square of errors, coverage, and time."""
    found: Row = {}
    square = {name: np.square([row[name]["off"] for row in rows]).mean(axis=1)
              for name in PROGRAMS}  # fmt: skip
    for name in (*PROGRAMS, NARROW):
        source, width = (OURS, 0.5) if name == NARROW else (name, 1.0)
        off, std = (np.array([row[source][key] for row in rows]) for key in ("off", "std"))
        found[name] = {
            "rms": float(np.sqrt(square[source].mean())),
            "worse_by": mean((square[source] - square[OURS]).tolist()),
            "held": share_row(int(np.sum(np.abs(off) <= REACH * width * std)), off.size),
            "cpu_s": float(np.median([row[source]["cpu_s"] for row in rows])),
        }
    return {"lives": len(rows), "programs": found}


def verdicts(found: dict[str, Row]) -> dict[str, bool]:
    """Return what is asked, by name."""
    kinds = [one["programs"] for one in found.values()]
    peers = [name for name in PROGRAMS if name not in (OURS, CONTROL)]
    gains = [one[name]["worse_by"] for one in kinds for name in peers]
    quiet = found["quiet"]["programs"]
    return {
        AS_GOOD: all(gain > -2 * error for gain, error in gains),
        HOLD: all(one[OURS]["held"]["low"] <= 0.9 <= one[OURS]["held"]["high"] for one in kinds),
        WORSE: quiet[CONTROL]["rms"] > quiet[OURS]["rms"],
        TOO_FEW: all(one[NARROW]["held"]["high"] < 0.9 for one in kinds),
    }


def claims(record: Row) -> Iterator[Claim]:
    """Claim errors and coverage by kind, beside the peers."""
    for kind, one in record["kinds"].items():
        rows = dict(one["programs"])
        ours, narrow = rows.pop(OURS), rows.pop(NARROW)
        held = ours["held"]
        beside = "; ".join(
            f"{name} {number(row['rms'])}, {row['held']['hits']}" for name, row in rows.items()
        )
        yield Claim(
            f"root mean square error of ln f at the last log, {kind}",
            f"{number(ours['rms'])} of a log's; 90 % intervals hold {held['hits']} of {held['n']}",
            f"{100 * held['low']:.1f} to {100 * held['high']:.1f} % (99.9 %)",
            f"{beside}; half as wide {narrow['held']['hits']}",
            all(row["worse_by"][0] > -2 * row["worse_by"][1] for row in rows.values())
            and held["low"] <= 0.9 <= held["high"],
        )


if __name__ == "__main__":
    main()
