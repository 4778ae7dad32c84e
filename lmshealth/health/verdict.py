"""Verdict on a stage: its most probable state at the last epoch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import compress
from typing import Literal

import numpy as np
from scipy.special import expit

from lmshealth._arrays import BoolArray
from lmshealth.health import constants
from lmshealth.health.results import Health
from lmshealth.stage.description import ParameterSpec, Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Event, Track

_WITHOUT_LOSS = ("healthy", "step", "not-enough-data")


def verdict_of(words: tuple[str, ...]) -> str:
    """Return the verdict for the words of the degraded parameters.

    ``healthy`` without any, ``both`` for preload and mount, else the words joined by ``+``.
    """
    if set(words) == {"preload", "mount"}:
        return "both"
    return "+".join(words) or "healthy"


def degraded_words(verdict: str) -> tuple[str, ...]:
    """Return the words of the parameters that a verdict reports as degraded."""
    if verdict == "both":
        return "preload", "mount"
    return () if verdict in _WITHOUT_LOSS else tuple(verdict.split("+"))


@dataclass(frozen=True, slots=True)
class Verdict:
    """State of a stage with its probability.

    Attributes
    ----------
    stage : str
        Identity of the machine.
    recorded_at : datetime
        The last log.
    verdict : str
        ``healthy``, ``step``, ``not-enough-data``, or what `verdict_of` returns for the degraded
        parameters.
    probability : float
        Posterior probability of that state; NaN for ``not-enough-data``.
    why : str
        Sentences for the reader of the report.
    """

    stage: str
    recorded_at: datetime
    verdict: str
    probability: float
    why: str


def degraded_below(parameter: ParameterSpec) -> float:
    """Return the value below which a parameter is degraded."""
    limit = parameter.baseline * (1 - constants.LOSS_WITHOUT_LIMIT)
    if parameter.limit:
        limit = parameter.limit.below
    return parameter.baseline - constants.DEGRADED_SHARE * (parameter.baseline - limit)


def judge(
    stage: Stage, history: History, health: Health | None, track: Track | None = None
) -> Verdict:
    """Return the most probable state of the stage at the last epoch, with its probability.

    Parameters
    ----------
    stage : Stage
        Parameters with their limits and words.
    history : History
        All logs.
    health : Health or None
        Posterior of the parameters; None if they could not be inferred.
    track : Track, optional
        Steps and alarms.

    Returns
    -------
    Verdict
        ``step`` after an undeclared step of the modes since the baseline. ``not-enough-data``
        if there are fewer logs than a baseline needs, if the sampler did not converge, if no state
        of the parameters explains the drifts, or if no parameter is informed; ``why`` then reports
        alarms. Otherwise the most probable set of degraded parameters.

    Examples
    --------
    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage, history = lmshealth.load_stage("lms-y"), examples.history()
    >>> track = lmshealth.track(history, stage)
    >>> health = lmshealth.infer(track, stage, seed=0, epochs=[len(track.recorded_at) - 1])
    >>> judgement = lmshealth.judge(stage, history, health, track)
    >>> print(f"{judgement.verdict}, {judgement.probability:.1%}")
    both, 99.9%
    >>> judgement.why.split(".")[0]
    'Guide preload is at 72 % of its baseline value (90 %: 70 to 75 %)'
    >>> lmshealth.judge(stage, history, None).why
    'The logs do not contain enough information for the health parameters.'
    """
    jumps = undeclared_events(track, history.baseline, "step")
    if jumps:
        return _judge_step(stage, history, health, jumps)
    reason = _reason_for_no_verdict(stage, history, health)
    if reason or health is None:
        why = " ".join((*_alarm_sentences(track, history.baseline), reason))
        return Verdict(history.stage, history.recorded_at[-1], "not-enough-data", float("nan"), why)
    return _judge_posterior(stage, history, health)


def _reason_for_no_verdict(stage: Stage, history: History, health: Health | None) -> str:
    n_logs, needed = len(history.logs) - history.baseline, stage.description.baseline.logs
    if not stage.parameters:
        return (
            "The stage description has no [[parameter]]: the modes are tracked, and no health "
            "parameter is inferred."
        )
    if n_logs < needed:
        return f"{n_logs} usable logs since the baseline began; it needs {needed}."
    if health is None:
        return "The logs do not contain enough information for the health parameters."
    if not health.converged[-1]:
        return "The sampler did not converge, so no value is published."
    if not health.explained:
        return (
            "No state of the parameters on the map explains the drifts "
            f"(p = {health.fit[-1]:.1g}): something else moved the modes, or the map is wrong."
        )
    if not health.informed_parameters().any():
        return "The data do not constrain any health parameter."
    return ""


def undeclared_events(
    track: Track | None, baseline: int, kind: Literal["step", "alarm"]
) -> list[Event]:
    """Return the events of a kind after a log that no maintenance declares, one per mode."""
    return [
        event
        for event in (() if track is None else track.events)
        if event.kind == kind and not event.declared and event.epoch > baseline
    ]


def _alarm_sentences(track: Track | None, baseline: int) -> Iterator[str]:
    """Yield a sentence per mode with an alarm: its drift by now."""
    if track is None:
        return
    alarms = {event.mode: event for event in undeclared_events(track, baseline, "alarm")}
    for mode, event in alarms.items():
        k = track.modes.index(mode)
        moved, std = track.drift[-1, k], np.sqrt(track.drift_cov[-1, k, k])
        size = f"{100 * np.expm1(moved):+.2f} ± {100 * np.exp(moved) * std:.2f} %"
        yield (
            f"Alarm since {track.recorded_at[event.epoch].date().isoformat()}: "
            f"{mode.replace('_', ' ')} has moved by {size.replace('-', '−')} since the baseline."
        )


def _judge_step(
    stage: Stage, history: History, health: Health | None, jumps: list[Event]
) -> Verdict:
    last = max(event.epoch for event in jumps)
    sizes = ", ".join(
        f"{event.mode} {100 * np.expm1(event.size):+.1f} %".replace("-", "−")
        for event in jumps
        if event.epoch == last
    )
    when = history.recorded_at[last].date().isoformat()
    why = (
        f"The frequencies jumped before the log of {when} ({sizes}), and no declared maintenance "
        "explains it."
    )
    if health is not None and health.informed_parameters().any():
        why += " " + _parameter_sentences(stage, health)
    evidence = max(event.evidence for event in jumps)
    return Verdict(history.stage, history.recorded_at[-1], "step", float(expit(evidence)), why)


def _judge_posterior(stage: Stage, history: History, health: Health) -> Verdict:
    lost: dict[str, BoolArray] = {}
    for j in np.flatnonzero(health.informed_parameters()).tolist():
        parameter = stage.parameters[j]
        below = health.samples[-1, :, j] < degraded_below(parameter)
        lost[parameter.word] = lost.get(parameter.word, False) | below
    draws = Counter(map(tuple, np.column_stack(list(lost.values())).tolist()))
    # Of equally probable verdicts the one with fewer degraded parameters.
    degraded, count = max(draws.items(), key=lambda one: (one[1], -sum(one[0]), one[0]))
    return Verdict(
        stage=history.stage,
        recorded_at=history.recorded_at[-1],
        verdict=verdict_of(tuple(compress(lost, degraded))),
        probability=count / health.samples.shape[1],
        why=_parameter_sentences(stage, health),
    )


def _parameter_sentences(stage: Stage, health: Health) -> str:
    low, middle, high = health.latest(np.array([0.05, 0.5, 0.95]))
    informed = health.informed_parameters()
    sentences = []
    for j, parameter in enumerate(stage.parameters):
        name = parameter.name.replace("_", " ").capitalize()
        if not health.identifiable[-1, j]:
            sentences.append(f"{name}: not identifiable from the tracked modes.")
        elif not informed[j]:
            sentences.append(f"{name}: not constrained by these logs.")
        elif parameter.unit:
            sentences.append(
                f"{name} is {middle[j]:.4g} {parameter.unit} (90 %: {low[j]:.4g} to {high[j]:.4g})."
            )
        else:
            low_j, middle_j, high_j = (100 * q[j] / parameter.baseline for q in (low, middle, high))
            sentences.append(
                f"{name} is at {middle_j:.0f} % of its baseline value "
                f"(90 %: {low_j:.0f} to {high_j:.0f} %)."
            )
    return " ".join(sentences)
