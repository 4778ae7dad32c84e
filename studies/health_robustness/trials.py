"""What is asked of one life, and how the answers of many are summed up."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track, accepted_estimates, track
from studies.common.lives import Array, history_of
from studies.common.metrics import place
from studies.harness.study import Row, judge_coverage
from studies.health_robustness.posteriors import claimed, epoch_draws, life_draws
from studies.health_robustness.worlds import PARAMETERS, Case, alone

NOMINALS = (0.9, 0.5)
_LEVELS = (0.05, 0.5, 0.95)
ENDS = (*PARAMETERS, "any")


@dataclass(frozen=True, slots=True)
class Answer:
    """One posterior against its truth: one parameter of one life."""

    place: float  # Posterior probability below the truth
    error: float  # Posterior median minus truth, of ln health, or of the travel left in km
    z: float  # The same over the posterior standard deviation
    width: float  # Of the 90 % interval, in the same unit
    third: bool  # Whether the truth lies inside that interval shrunk to a third about the median


@dataclass(frozen=True, slots=True)
class Arm:
    """What the estimator believes."""

    name: str  # Of the arm
    model_std: float  # Relative error of the map's sensitivities that it believes in
    # Factor on the covariance of what it is given, which it is not allowed to find out
    shrink: float = 1.0
    # Relative error of the map that it believes in as if it were new at every log
    independent: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """A life as the estimator has it: its track, and the history as the track takes it.

    That has the steps that the tracker found beside those declared, and no outliers.
    """

    case: Case
    track: Track
    history: History


def followed(cases: Iterable[Case], stage: Stage) -> list[Followed]:
    """Track lives."""
    found = []
    for case in cases:
        history = history_of(case.life, case.estimates)
        own = track(history, stage)
        found.append(Followed(case, own, accepted_estimates(history, own)))
    return found


def at_epoch(
    one: Followed, stage: Stage, epoch: int, rng: np.random.Generator, shrink: float = 1.0
) -> list[Answer]:
    """Ask for health at one epoch, without a law."""
    draws = epoch_draws(one.track, stage, epoch, rng, shrink)
    return _answers(np.log(draws), np.log(one.case.health[epoch]), rng)


def by_laws(
    one: Followed, stage: Stage, arm: Arm, rng: np.random.Generator
) -> tuple[list[Answer], list[Answer]]:
    """Ask for health now and for the travel left, by the laws, of the whole life."""
    case, cov = one.case, arm.shrink * one.history.cov
    if arm.independent:
        # As noise of each log, of the size that the error has where the truth is.
        parts = alone(stage, case.health)
        at = np.arange(parts.shape[2])
        cov[:, at, at] += arm.independent**2 * np.sum(parts**2, axis=0)
    given = replace(one.history, cov=cov)
    now, left = life_draws(given, stage, rng, noise_known=arm.shrink != 1)
    ends = case.passage - (case.life.travel[-1] - case.life.travel[0])
    truth = claimed(np.append(ends, ends.min()), stage)
    return (
        _answers(np.log(now), np.log(case.health[-1]), rng),
        _answers(left / 1000, truth / 1000, rng),
    )


def _answers(draws: Array, truth: Array, rng: np.random.Generator) -> list[Answer]:
    places = place(draws, truth, rng)
    cuts = np.quantile(draws, _LEVELS, axis=0, method="inverted_cdf")
    answers = []
    for own, value, column, (low, middle, high) in zip(places, truth, draws.T, cuts.T, strict=True):
        # Lives that never end, and health that is surely as it was.
        with np.errstate(invalid="ignore", divide="ignore"):
            error, width = middle - value, high - low
            third = (low - middle) / 3 <= value - middle <= (high - middle) / 3
            z = error / column.std()
        answers.append(Answer(float(own), float(error), float(z), float(width), bool(third)))
    return answers


def summed(answers: list[Answer]) -> Row:
    """Sum up the answers of many lives: coverage and bias, each with its Monte-Carlo error."""
    places = np.array([one.place for one in answers])
    row: Row = {"n": len(answers)}
    for nominal in NOMINALS:
        hits = int(np.sum(np.abs(places - 0.5) <= nominal / 2))
        row[f"{100 * nominal:g}"] = judge_coverage(hits, places.size, nominal)
    row["third"] = float(np.mean([one.third for one in answers]))
    for name in ("z", "error"):
        values = np.array([getattr(one, name) for one in answers])
        values = values[np.isfinite(values)]
        n = values.size
        row[name] = {
            "n": n,
            "mean": float(values.mean()) if n else None,
            "se": float(values.std(ddof=1) / np.sqrt(n)) if n > 1 else None,
            "rms": float(np.sqrt(np.mean(values**2))) if n else None,
        }
    widths = np.array([one.width for one in answers])
    # Ends that are not in sight are as far apart as can be.
    width = np.median(np.where(np.isnan(widths), np.inf, widths))
    row["width"] = float(width) if np.isfinite(width) else None
    return row
