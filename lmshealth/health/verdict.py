"""The verdict: what the last epoch of a stage shows, in one word."""

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
    """What is said about a stage in one word, with its probability.

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
        Posterior probability of that word; NaN for ``not-enough-data``.
    why : str
        One sentence for the reader of the report.
    """

    stage: str
    recorded_at: datetime
    verdict: str
    probability: float
    why: str


# A parameter counts as degraded once this share of what it may lose is gone.
DEGRADED_SHARE = 0.25
_LOSS_WITHOUT_LIMIT = 0.4


def degraded_below(parameter: ParameterSpec) -> float:
    """Value of a parameter below which it counts as degraded."""
    limit = (
        parameter.limit.below
        if parameter.limit
        else (parameter.baseline * (1 - _LOSS_WITHOUT_LIMIT))
    )
    return parameter.baseline - DEGRADED_SHARE * (parameter.baseline - limit)


def judge(
    stage: Stage, history: History, health: Health | None, track: Track | None = None
) -> Verdict:
    """Say in one word what the last epoch shows, with its posterior probability.

    Parameters
    ----------
    stage : Stage
        Says what counts as degraded and which word tells it.
    history : History
        All logs.
    health : Health or None
        Posterior of the parameters; None when they could not be inferred.
    track : Track, optional
        Says whether something happened at once since the baseline.

    Returns
    -------
    Verdict
        ``not-enough-data`` when there are fewer logs than make a baseline, when the sampler did
        not converge, when no state of the parameters explains the drifts, when the data say nothing
        about any parameter, or when there is none; alarms are then told in ``why``. ``step`` when
        the modes jumped since the baseline and nobody said why.

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
    'The logs do not carry the health parameters.'
    """
    jumps = undeclared_events(track, history.baseline, "step")
    if jumps:
        return _judge_step(stage, history, health, jumps)
    needed = stage.description.baseline.logs
    reason = ""
    since = len(history.logs) - history.baseline
    if not stage.parameters:
        reason = (
            "The stage description has no [[parameter]]: its modes are followed, and nothing is "
            "said of the parts."
        )
    elif since < needed:
        reason = f"{since} usable logs since the baseline began; it needs {needed}."
    elif health is None:
        reason = "The logs do not carry the health parameters."
    elif not health.converged[-1]:
        reason = "The sampler did not converge, so nothing is claimed."
    elif not health.explained:
        reason = (
            "No state of the parameters on the map explains the drifts "
            f"(p = {health.fit[-1]:.1g}): something else moved the modes, or the map is wrong."
        )
    elif not health.informed_parameters().any():
        reason = "These logs move the prior of no parameter: the stage looks the same either way."
    if reason or health is None:
        why = " ".join((*_alarmed(track, history.baseline), reason))
        return Verdict(history.stage, history.recorded_at[-1], "not-enough-data", float("nan"), why)
    return _judge_posterior(stage, history, health)


def undeclared_events(
    track: Track | None, baseline: int, kind: Literal["step", "alarm"]
) -> list[Event]:
    """Give the events of a kind since a log that no maintenance declares, one per mode."""
    return [
        event
        for event in (() if track is None else track.events)
        if event.kind == kind and not event.declared and event.epoch > baseline
    ]


def _alarmed(track: Track | None, baseline: int) -> Iterator[str]:
    """Say of every mode with an alarm how far it has moved by now."""
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
        f"The frequencies jumped before the log of {when} ({sizes}), and no maintenance tells why."
    )
    if health is not None and health.converged[-1] and health.informed_parameters().any():
        why += " " + _why(stage, health, np.flatnonzero(health.informed_parameters()).tolist())
    evidence = max(event.evidence for event in jumps)
    return Verdict(history.stage, history.recorded_at[-1], "step", float(expit(evidence)), why)


def _judge_posterior(stage: Stage, history: History, health: Health) -> Verdict:
    told = np.flatnonzero(health.informed_parameters()).tolist()
    lost: dict[str, BoolArray] = {}
    for j in told:
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
        why=_why(stage, health, told),
    )


def _why(stage: Stage, health: Health, told: list[int]) -> str:
    low, middle, high = health.latest(np.array([0.05, 0.5, 0.95]))
    sentences = []
    for j, parameter in enumerate(stage.parameters):
        name = parameter.name.replace("_", " ").capitalize()
        if not health.identifiable[-1, j]:
            sentences.append(f"{name}: the tracked modes cannot tell.")
        elif j not in told:
            sentences.append(f"{name}: these logs do not tell.")
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
