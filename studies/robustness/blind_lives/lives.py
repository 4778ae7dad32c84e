"""Blind lives: plans and truth, reading the report of an archive, scores and coverages."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from lmshealth.health.verdict import degraded_below
from numpy.typing import NDArray
from scipy.stats import bernoulli

from lmshealth.stage.constants import INFORMED
from lmshealth.stage.description import load_stage
from models.dynamics.stages import stage_named
from models.lives.degradation import LIVES, Delayed, Law, Steady, Stepped
from models.lives.simulation import Plan, schedule
from models.recordings.machines import machine_identity
from studies.harness.command_line import call
from studies.harness.metrics import clopper_pearson
from studies.harness.study import LEVEL, Row

EPOCHS = 3
QUANTILES = ("q05", "q25", "q50", "q75", "q95")
_UNEXPLAINED = 1e-4  # of `fit`, as documented
# What the front page writes for each word of verdict.csv.
SHOWN = {
    "healthy": "Healthy",
    "preload": "Loss of guide preload",
    "mount": "Loss of mount stiffness",
    "both": "Loss of guide preload and mount stiffness",
    "step": "Sudden change without a known cause",
    "not-enough-data": "Not enough data for a verdict",
}
# Instead of the last where modes have moved.
ALARM = "Alarm: "
_INDEX_ROW = re.compile(
    r'<tr role="row" data-state.*?<a href="([^"]+)">([^<]+)</a>.*?'
    r'<span class="mark \w+"><span[^>]*>.</span>([^<]*)</span>',
    re.S,
)
SEED = 20261123
STAGES = ("lms-x", "lms-y")
# Parameters that the modes of a stage constrain; in X the mount moves none of them.
SEEN = {"lms-x": ("guide_preload",), "lms-y": ("guide_preload", "mount_stiffness")}
WORDS = ("healthy", "preload", "mount", "both", "step", "not-enough-data")
# Of logs: of most lives, and of the share that have too few; and seconds of each.
N_LOGS, N_FEW, FEW, SECONDS = (18, 28), (2, 4), 0.1, (8.0, 12.0)
# Every third life that ends is drawn past its end, and every life is cut on the way.
TO_FAILURE, SEEN_PART = 1 / 3, (0.3, 1.0)
# A life is near the border if a parameter is as near to where it counts as degraded, or if so few
# logs have seen its step: a jump counts once the next log confirms it.
NEAR, CONFIRMED = 0.02, 2


@dataclass(frozen=True, slots=True)
class BlindPlan(Plan):
    """A life whose logs are spread over a part of the way to where they would end."""

    part: float = 1.0

    def end_km(self, now_km: float) -> float:
        """Return the odometer (km) of the last log."""
        return self.part * Plan.end_km(self, now_km)

    @property
    def identity(self) -> str:
        """The name that the machine has in its logs."""
        return machine_identity(stage_named(self.stage), self.seed)


LEVELS = {0.5: ("q25", "q75"), 0.9: ("q05", "q95")}
_BINS = (0.0, 0.5, 0.8, 0.95, 0.99, 1.0)
# Smallest doubt in scores: a posterior has some thousand draws.
_SUREST = 1e-3
_SHRUNK = 3.0
# Largest deficit of right verdicts, in standard deviations: exceeded once in a thousand runs.
_SHORT = -3.09


def confusion(rows: Iterable[Row]) -> dict[str, dict[str, int]]:
    """Count reported by true verdicts, each in the order of `WORDS`."""
    seen = Counter((row["truth"]["verdict"], row["reported"]["verdict"]) for row in rows)
    return {true: {reported: seen[true, reported] for reported in WORDS} for true in WORDS}


def share(hits: Iterable[bool]) -> Row:
    """Count hits, with the 95 % Clopper-Pearson interval of their share."""
    found = list(hits)
    low, high = clopper_pearson(sum(found), len(found)) if found else (0.0, 1.0)
    return {"hits": sum(found), "n": len(found), "low": low, "high": high}


def of_others(rows: Sequence[Row]) -> list[Row]:
    """Return every answer the truth of another life of the same stage: a control."""
    rng = np.random.default_rng([SEED, 0, 1])
    mixed: list[Row] = []
    for stage in sorted({row["stage"] for row in rows}):
        own = [row for row in rows if row["stage"] == stage]
        order = rng.permutation(len(own))
        other = np.roll(order, 1)
        mixed += [own[i] | {"truth": own[j]["truth"]} for i, j in zip(order, other, strict=True)]
    return mixed


def sureness(rows: Iterable[Row]) -> Row:
    """Return whether verdicts are right as often as stated, with scores of their probabilities.

    ``z`` is by how many standard deviations (of so many independent trials) the number of right
    verdicts exceeds what their probabilities promise. Brier and logarithmic scores are followed by
    those of a constant probability.
    """
    pairs = [
        (row["reported"]["probability"], row["reported"]["verdict"] == row["truth"]["verdict"])
        for row in rows
        if row["reported"]["probability"] is not None
    ]
    if not pairs:
        return {"n": 0}
    reported, right = np.array(pairs, dtype=float).T
    base = np.full(reported.size, right.mean())
    spread = np.sqrt(np.sum(reported * (1 - reported)))
    # With hardly any doubt the spread is at least that of one trial.
    z = float((right.sum() - reported.sum()) / max(spread, 0.5))
    places = np.clip(np.searchsorted(_BINS, reported, side="left") - 1, 0, len(_BINS) - 2)
    return {
        "n": reported.size,
        "right": int(right.sum()),
        "promised": round(float(reported.sum()), 2),
        "z": round(z, 2),
        "holds": z > _SHORT,
        "brier": [round(float(np.mean((p - right) ** 2)), 4) for p in (reported, base)],
        "log_score": [
            round(-float(np.mean(bernoulli.logpmf(right, np.clip(p, _SUREST, 1 - _SUREST)))), 4)
            for p in (reported, base)
        ],
        "bins": [
            {
                "from": _BINS[k],
                "to": _BINS[k + 1],
                "reported": round(float(reported[own].mean()), 4),
            }
            | share(map(bool, right[own]))
            | {"holds": _as_often(reported[own], int(right[own].sum()))}
            for k in range(len(_BINS) - 1)
            if (own := places == k).any()
        ],
    }


def _as_often(reported: NDArray[np.float64], right: int) -> bool:
    """Return whether so many right verdicts are compatible with their probabilities, two-sided."""
    counts = np.ones(1)  # distribution of the number of right ones
    for p in reported:
        counts = np.convolve(counts, [1 - p, p])
    tail = min(counts[: right + 1].sum(), counts[right:].sum())
    return bool(tail >= (1 - LEVEL) / 2)


def coverages(rows: Iterable[Row], what: str, names: Iterable[str]) -> dict[str, dict[str, Row]]:
    """Count intervals of ``health`` or what is ``left`` that hold the truth, and those shrunk."""
    found = list(rows)
    reported: dict[str, dict[str, Row]] = {}
    for name in names:
        pairs = [(row["reported"][what][name], row["truth"][what][name]) for row in found
                 if name in row["reported"][what] and name in row["truth"][what]]  # fmt: skip
        reported[name] = {
            f"{100 * level:.0f}{way}": _at_least(
                level, [_holds(*pair, ends, times) for pair in pairs]
            )
            for level, ends in LEVELS.items()
            for way, times in (("", 1.0), (" shrunk", _SHRUNK))
        }
    return reported


def _at_least(level: float, held: Sequence[bool]) -> Row:
    """Judge a coverage that must not be less than stated: the map's error is in every interval."""
    high = clopper_pearson(sum(held), len(held), LEVEL)[1] if held else 1.0
    return share(held) | {"holds": high >= level}


def _holds(interval: Row, truth: float | None, ends: tuple[str, str], times: float) -> bool:
    """Return whether an interval, shrunk so many times about its median, holds the truth."""
    # None is past the horizon.
    low, middle, high, true = (
        np.inf if value is None else value
        for value in (interval[ends[0]], interval["q50"], interval[ends[1]], truth)
    )
    if times == 1.0:
        return bool(low <= true <= high)
    if not np.isfinite(middle):  # most of it lies past the horizon, and so must the truth
        return not np.isfinite(true)
    return bool(middle - (middle - low) / times <= true <= middle + (high - middle) / times)


def analyse(logs: Path, out: Path, *, quick: bool = False) -> dict[str, Row]:
    """Run the command line over an archive of both stages, and read its results for each machine.

    These are the ``verdict``, its ``probability``, what the front page has ``shown``, quantiles of
    ``health`` where it is claimed and of what is ``left`` in km (None past the horizon), counts of
    ``events`` that are no declared work, and of ``refused`` by reason. Quick calls infer health at
    the last log alone.
    """
    stages = [word for name in STAGES for word in ("--stage", name)]
    call("lmshealth", "run", logs, *stages, "--out", out, "--allow-future",
         "--epochs", 1 if quick else EPOCHS, "--workers", 1,
         quick=quick, some_refused=True)  # fmt: skip
    shown = front_page(out / "index.html")
    verdicts = pd.read_csv(out / "verdict.csv")
    health, left = _read_health(out / "health.csv"), _read_left(out / "prognosis.csv")
    events = pd.read_csv(out / "events.csv")
    events = events[~events["declared"].astype(bool)]
    refused = pd.read_csv(out / "refused.csv")
    refused["stage"] = refused["log"].str.split("/").str[0]  # logs are in folders of machines
    answers = {}
    for row in verdicts.to_dict("records"):
        name, reported = row["stage"], float(row["probability"])
        answers[name] = {
            "verdict": row["verdict"],
            "probability": reported if np.isfinite(reported) else None,
            "shown": shown.get(name),
            "health": health.get(name, {}),
            "left": left.get(name, {}),
            "events": _counts(events[events["stage"] == name].drop_duplicates("kind")["kind"]),
            "refused": _counts(refused[refused["stage"] == name]["reason"]),
        }
    return answers


def agrees(reported: Row) -> bool:
    """Return whether the front page agrees with the table of verdicts."""
    alarm = reported["verdict"] == "not-enough-data" and (reported["shown"] or "").startswith(ALARM)
    return alarm or reported["shown"] == SHOWN[reported["verdict"]]


def front_page(path: Path) -> dict[str, str]:
    """Read the rows of the front page: the verdict in words, of each machine that has a page."""
    rows = _INDEX_ROW.findall(path.read_text(encoding="utf-8"))
    return {name: words.strip() for file, name, words in rows if (path.parent / file).exists()}


def _counts(values: pd.Series) -> dict[str, int]:
    return {str(name): int(count) for name, count in values.value_counts().items()}


def _read_health(path: Path) -> dict[str, dict[str, Row]]:
    """Read the last epoch of every machine, of parameters that the data constrain."""
    found: dict[str, dict[str, Row]] = {}
    table = pd.read_csv(path)
    for (stage, name), rows in table.groupby(["stage", "parameter"]):
        row = rows.iloc[-1]
        claimed = row["converged"] and row["identifiable"] and not row["fit"] < _UNEXPLAINED
        if claimed and row["informed"] >= INFORMED:
            own = {"q50" if k == "median" else k: float(row[k])
                   for k in ("q05", "q25", "median", "q75", "q95")}  # fmt: skip
            found.setdefault(str(stage), {})[str(name)] = own
    return found


def _read_left(path: Path) -> dict[str, dict[str, Row]]:
    """Read the quantiles of the remaining travel; an empty one lies past the horizon."""
    found: dict[str, dict[str, Row]] = {}
    for row in pd.read_csv(path).to_dict("records"):
        values = {level: float(row[f"rul_km_{level}"]) for level in QUANTILES}
        own = {level: None if np.isnan(km) else km for level, km in values.items()}
        own["past"] = float(row["probability_already_past"])
        own["beyond"] = float(row["probability_beyond_horizon"])
        found.setdefault(str(row["stage"]), {})[str(row["parameter"])] = own
    return found


def plan_of(number: int) -> BlindPlan:
    """Draw a life: its kind, stage, seed, count and length of logs, and where it is cut."""
    rng = np.random.default_rng([SEED, number])
    kind, stage = str(rng.choice(list(LIVES))), str(rng.choice(STAGES))
    seed, few, failing = int(rng.integers(10**8)), rng.random() < FEW, rng.random() < TO_FAILURE
    logs = int(rng.integers(*(N_FEW if few else N_LOGS), endpoint=True))
    seconds, part = round(float(rng.uniform(*SECONDS)), 1), float(rng.uniform(*SEEN_PART))
    plan = BlindPlan(stage, kind, logs, seconds, seed, part=part)
    if failing and plan.draw_life().failure_km() is not None:
        return BlindPlan(stage, kind, logs, seconds, seed, until="failure", part=part)
    return plan


def truth_of(plan: Plan, table: pd.DataFrame) -> Row:
    """Return what is true at the last log, from a plan and its ``truth.csv``.

    This is the right ``verdict``, whether it is ``clear`` of every border, ``health`` as a fraction
    of the first log, and what is ``left`` until each limit and any, in km: 0 where it is past, None
    where no limit is reached. A step ``to_come`` is in no law: what is left is that of a machine
    without it.
    """
    stage = load_stage(plan.stage)
    limits = {p.name: p for p in stage.parameters if p.name in SEEN[plan.stage]}
    first, last = table.iloc[0], table.iloc[-1]
    health = {name: float(last[name] / first[name]) for name in limits}
    borders = {name: degraded_below(spec) for name, spec in limits.items()}
    since = _logs_since_step(plan)
    few = len(table) < stage.description.baseline.logs
    lost = [spec.word for name, spec in limits.items() if health[name] < borders[name]]
    worn = "both" if len(lost) == 2 else lost[0] if lost else "healthy"
    word = "not-enough-data" if few else "step" if since else worn
    if few or since:
        clear = not since if few else since >= CONFIRMED
    else:
        clear = all(abs(health[name] - borders[name]) > NEAR for name in limits)
    left, to_come = _left(plan, {n: p.limit.below for n, p in limits.items() if p.limit}, table)
    return {"verdict": word, "clear": clear, "health": health, "left": left,
            "to_come": to_come}  # fmt: skip


def _logs_since_step(plan: Plan) -> int:
    """Count the logs after the step of a part that the modes show; 0 without a step."""
    life, visits = plan.draw_life(), schedule(plan)
    laws = {"guide_preload": life.preload, "mount_stiffness": life.mount}
    steps = [
        law.step_km
        for name, law in laws.items()
        if name in SEEN[plan.stage] and isinstance(law, Stepped) and law.left < 1.0
    ]
    return sum(visit.travel_km >= min(steps) for visit in visits) if steps else 0


def _left(
    plan: Plan, limits: dict[str, float], table: pd.DataFrame
) -> tuple[dict[str, float | None], bool]:
    """Tell the travel left until each limit and any, and whether a step is still to come."""
    life, now_km = plan.draw_life(), float(table.iloc[-1]["travel_km"])
    laws: dict[str, Law] = {"guide_preload": life.preload, "mount_stiffness": life.mount}
    left: dict[str, float | None] = {}
    to_come = False
    for name, below in limits.items():
        law = _without_what_comes(laws[name], now_km)
        to_come |= law is not laws[name]
        reached = law.reaches_km(below * float(table.iloc[0][name]))
        left[name] = None if reached is None else max(reached - now_km, 0.0)
    left["any"] = min((km for km in left.values() if km is not None), default=None)
    return left, to_come


def _without_what_comes(law: Law, now_km: float) -> Law:
    """Return a law as it continues without a further jump."""
    if isinstance(law, Stepped) and law.step_km > now_km:
        return _without_what_comes(law.law, now_km)
    return Steady() if isinstance(law, Delayed) and law.start_km > now_km else law
