"""What is asked of one life, and how the answers of many are summed up."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lmshealth.stage import Stage
from lmshealth.tracking import track
from lmshealth.tracks import History, Track
from studies.health_robustness.posteriors import epoch_draws, life_draws
from studies.health_robustness.worlds import PARAMETERS, Case, alone
from studies.importance import Draws, place, quantiles
from studies.lives import Array, history_of
from studies.record import judge_coverage

NOMINALS = (0.9, 0.5)
_LEVELS = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
ENDS = (*PARAMETERS, "any")


@dataclass(frozen=True, slots=True)
class Answer:
    """One posterior against its truth: one parameter of one life.

    Attributes
    ----------
    place : float
        Posterior probability below the truth.
    error : float
        Posterior median minus truth, of ln health, or of the travel left in km.
    z : float
        The same over the posterior standard deviation.
    width : float
        Of the 90 % interval, in the same unit.
    third : bool
        Whether the truth lies inside that interval shrunk to a third about the median.
    """

    place: float
    error: float
    z: float
    width: float
    third: bool


@dataclass(frozen=True, slots=True)
class Arm:
    """What the estimator believes.

    Attributes
    ----------
    name : str
        Of the arm.
    model_std : float
        Relative error of the map's sensitivities that it believes in.
    shrink : float
        Factor on the covariance of what it is given, which it is not allowed to find out.
    independent : float
        Relative error of the map that it believes in as if it were new at every log.
    """

    name: str
    model_std: float
    shrink: float = 1.0
    independent: float = 0.0


def histories(cases: Iterable[Case]) -> list[tuple[Case, History]]:
    """Make what the estimator is given."""
    return [(case, history_of(case.life, case.estimates)) for case in cases]


def tracked(pairs: list[tuple[Case, History]], stage: Stage) -> list[tuple[Case, Track]]:
    """Track lives."""
    return [(case, track(history, stage)) for case, history in pairs]


def at_epoch(
    case: Case, followed: Track, stage: Stage, epoch: int, rng: np.random.Generator,
    shrink: float = 1.0,
) -> list[Answer]:  # fmt: skip
    """Ask for health at one epoch, without a law."""
    draws = epoch_draws(followed, stage, epoch, rng, shrink)
    return _health_answers(draws, case.health[epoch], rng)


def by_laws(
    case: Case, history: History, stage: Stage, arm: Arm, rng: np.random.Generator
) -> tuple[list[Answer], list[Answer]]:
    """Ask for health now and for the travel left, by the laws, of the whole life."""
    given = replace(history, cov=arm.shrink * history.cov)
    if arm.independent:
        # As noise of each log, of the size that the error has where the truth is.
        parts = alone(stage, case.health)
        cov = given.cov.copy()
        at = np.arange(parts.shape[2])
        cov[:, at, at] += arm.independent**2 * np.sum(parts**2, axis=0)
        given = replace(given, cov=cov)
    now, left = life_draws(given, stage, rng, noise_known=arm.shrink != 1)
    ends = case.passage - (case.life.travel[-1] - case.life.travel[0])
    truth = np.append(ends, ends.min())
    return _health_answers(now, case.health[-1], rng), _left_answers(left, truth, rng)


def _health_answers(draws: Draws, truth: Array, rng: np.random.Generator) -> list[Answer]:
    logs = Draws(np.log(draws.points), draws.weight)
    return _answers(logs, np.log(truth), rng)


def _left_answers(draws: Draws, truth: Array, rng: np.random.Generator) -> list[Answer]:
    return _answers(Draws(draws.points / 1000, draws.weight), truth / 1000, rng)


def _answers(draws: Draws, truth: Array, rng: np.random.Generator) -> list[Answer]:
    places, cuts = place(draws, truth, rng), quantiles(draws, _LEVELS)
    answers = []
    for j, (own, value) in enumerate(zip(places, truth, strict=True)):
        low, _, middle, _, high = cuts[:, j]
        with np.errstate(invalid="ignore"):  # lives that never end
            mean = draws.weight @ draws.points[:, j]
            std = np.sqrt(draws.weight @ (draws.points[:, j] - mean) ** 2)
            error = middle - value
            third = (low - middle) / 3 <= value - middle <= (high - middle) / 3
            answers.append(
                Answer(float(own), float(error), float(error / std), high - low, bool(third))
            )
    return answers


def summed(answers: list[Answer]) -> dict[str, Any]:
    """Sum up the answers of many lives: coverage and bias, each with its Monte-Carlo error."""
    places = np.array([one.place for one in answers])
    row: dict[str, Any] = {"n": len(answers)}
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
    row["width"] = float(np.median(widths)) if np.isfinite(np.median(widths)) else None
    return row
