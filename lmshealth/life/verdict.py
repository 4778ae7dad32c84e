"""Verdict on a stage: its most probable state at the last epoch."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import compress
from typing import Literal

import numpy as np
from scipy.special import expit, logit

from lmshealth._private.arrays import BoolArray
from lmshealth._private.tables import fact, spell
from lmshealth.io.log import utc_day
from lmshealth.life import constants
from lmshealth.life.health import Health
from lmshealth.life.posterior.fit import LoneMode
from lmshealth.life.posterior.likelihood import NO_MODE
from lmshealth.modal.constants import OFF_DAMPING, OFF_FREQUENCY
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.naming import off_description
from lmshealth.stage.description import ParameterSpec, Stage
from lmshealth.tracking.filters.track_state import Event
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track, accepted_estimates

# Of descriptions without parameters ``alarm`` and ``no-alarm`` are all that can be found.
NO_HEALTH = ("alarm", "no-alarm", "not-enough-data")
OUTSIDE_MAP = "outside-map"
"""Verdict on a mode that moved alone, or a parameter above its baseline: no wear does either."""
_WITHOUT_LOSS = ("healthy", "step", OUTSIDE_MAP, *NO_HEALTH)


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
    """State of a stage at its last log with its probability, and sentences that explain it.

    The verdict is ``healthy``, ``step``, `OUTSIDE_MAP`, one of `NO_HEALTH`, whose probability is
    NaN, or what `verdict_of` returns for the degraded parameters.
    """

    stage: str
    recorded_at: datetime
    verdict: str
    probability: float
    why: str


def degraded_below(parameter: ParameterSpec) -> float:
    """Return the value below which a parameter is degraded."""
    own, without = parameter.limit, parameter.baseline * (1 - constants.LOSS_WITHOUT_LIMIT)
    limit = own.below if own else without
    return parameter.baseline - constants.DEGRADED_SHARE * (parameter.baseline - limit)


def judge(
    stage: Stage,
    history: History,
    health: Health | None,
    track: Track | None = None,
    *,
    doubt: str = "",
) -> Verdict:
    """Return the most probable state of the stage at the last epoch, with its probability.

    Parameters
    ----------
    stage, history : Stage, History
        Parameters with their limits and words, and all logs.
    health, track : Health or None, Track, optional
        Posterior of the parameters, None if they could not be inferred; steps and alarms.
    doubt : str
        Why there must be no health, from `doubt_of_names` or `doubt_of_clock`.

    Returns
    -------
    Verdict
        ``step`` after an undeclared step of the modes since the baseline. ``not-enough-data``
        if there are fewer logs than a baseline needs, if no life of the parameters explains the
        logs, or if no parameter is informed; ``why`` then reports alarms. ``alarm`` or ``no-alarm``
        of tracked modes if the description has no parameter. Otherwise the state of most draws: a
        set of degraded parameters; without any, ``outside-map`` if a mode moved alone or a
        parameter is above its baseline, or ``healthy``.

    Examples
    --------
    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage, history = lmshealth.load_stage("lms-y"), examples.history()
    >>> health = lmshealth.infer(history, stage, seed=1, chains=False)
    >>> judgement = lmshealth.judge(stage, history, health)
    >>> print(f"{judgement.verdict}, {judgement.probability:.0%}")
    both, 95%
    >>> judgement.why.split(".")[0]
    'Guide preload is at 71 % of its baseline value (90 %: 64 to 76 %)'
    >>> lmshealth.judge(stage, history, None).why
    'The logs do not contain enough information for the health parameters.'
    """
    jumps = undeclared_events(track, history.baseline, "step")
    if jumps:
        found = _judge_step(stage, history, health, jumps)
        return replace(found, why=f"{found.why} {doubt}".rstrip())
    reason = doubt or _reason_for_no_verdict(stage, history, health)
    if reason or health is None:
        alarms = [*_alarm_sentences(track, history.baseline)]
        word, why = "not-enough-data", " ".join((*alarms, reason))
        enough = len(history.logs) - history.baseline >= stage.description.baseline.logs
        if track is not None and not stage.parameters and (alarms or (enough and not doubt)):
            word = "alarm" if alarms else "no-alarm"
        return Verdict(history.stage, history.recorded_at[-1], word, float("nan"), why)
    return _judge_posterior(stage, history, health)


def _reason_for_no_verdict(stage: Stage, history: History, health: Health | None) -> str:
    n_logs, needed = len(history.logs) - history.baseline, stage.description.baseline.logs
    values = {"n": n_logs, "needed": needed}
    if 1 == n_logs < needed:
        return fact("1 usable log since the baseline began; it needs {needed}.", **values)
    if n_logs < needed:
        return fact("{n} usable logs since the baseline began; it needs {needed}.", **values)
    if not stage.parameters:
        return fact(
            "The stage description has no [[parameter]]: the modes are tracked, and no health "
            "parameter is inferred."
        )
    if health is None:
        return fact("The logs do not contain enough information for the health parameters.")
    if not health.explained:
        return fact(
            "No life of the parameters on the map explains the logs (p = {p:.1g}): something else "
            "moved the modes, or the map is wrong.",
            p=health.fit[-1],
        )
    if not health.publishable_parameters().any():
        return fact("The data do not constrain any health parameter.")
    return ""


def doubt_of_names(
    stage: Stage, history: History, track: Track, readings: Sequence[LogEstimates] = ()
) -> str:
    """Return why health that depends on the names of modes is not published; empty if it may be.

    Names are in doubt, or no log shows the modes of the map any more.
    Modes move with wear, and a repair need not restore them: those of the first baseline are
    compared with the description, as all logs until the next baseline estimate it.
    ``readings`` are the estimates of the logs of the history, in its order, for their flags.
    """
    specs = {mode.name: mode for mode in stage.modes}
    last = [*history.baselines[1:], len(history.logs)][0] - 1
    early = min(history.baselines[0] + stage.description.baseline.logs - 1, last)
    ln_f = track.ln_frequency[last] - track.drift[last]
    estimate = np.array([ln_f, track.ln_damping[early]])
    std = np.array([track.ln_frequency_std[last], track.ln_damping_std[early]])
    known = [k for k, m in enumerate(track.modes) if m in specs and np.isfinite(ln_f[k])]
    names = [track.modes[k] for k in known]
    off = off_description(stage, names, estimate[:, known], std[:, known])
    if off:
        values = "; ".join(
            fact(
                "{mode} {declared:.5g} Hz and {found:.5g} Hz, damping {zeta:.2g} % and "
                "{other:.2g} %",
                mode=one.mode,
                declared=one.declared_hz,
                found=one.found_hz,
                zeta=100 * one.declared_damping_ratio,
                other=100 * one.found_damping_ratio,
            )
            for one in off
        )
        return fact(
            "The names of the modes are in doubt, so that no health is published. Declared and "
            "found at the baseline: {values}. Plausible are differences up to {most:.0f} % "
            "(damping: a factor of {factor:g}): correct the description, or describe the modes "
            "that it lacks.",
            values=values,
            most=100 * OFF_FREQUENCY,
            factor=OFF_DAMPING,
        )
    flags = Counter(
        name
        for reading in readings[history.baseline :]
        for name, own in zip(reading.modes.names, reading.modes.flags, strict=True)
        if "doubtful-name" in own.split()
    )
    n_logs = len(readings) - history.baseline
    often = [
        fact("{name} in {k} of {n} logs", name=name, k=k, n=n_logs)
        for name, k in flags.items()
        if 2 * k > n_logs
    ]
    if not often:
        return _nothing_seen(stage, history, track)
    return fact(
        "The names of the modes are in doubt, so that no health is published: another mode may "
        "have the name {names} since the baseline (flag doubtful-name). Describe the modes that "
        "refused.csv lists as undescribed.",
        names=", ".join(often),
    )


def _nothing_seen(stage: Stage, history: History, track: Track) -> str:
    """Return that no mode of the map is where it is searched for any more; empty if one is.

    Without a map all tracked modes count. A mode that has left its search, or whose sensor is dead,
    is not found, so that the logs before would give the state, or other resonances that take its
    name after a gap: they jump.
    """
    columns = [k for name in stage.informative or history.modes for k in history.columns(name)]
    found = np.isfinite(accepted_estimates(history, track).ln_frequency)
    for k, mode in track.unconfirmed:
        found[k, [*history.columns(mode)]] = False
    found = found[history.baseline :]
    last = int(np.flatnonzero(found[:, columns].any(axis=1)).max(initial=-1))
    missed = len(found) - 1 - last
    if not columns or missed < stage.description.baseline.logs:
        return ""
    names = ", ".join(dict.fromkeys(history.series[k].mode for k in columns))
    return fact(
        "None of the modes {names} was found in the last {missed} logs, or none agreed with the "
        "logs before, so that the present state is unknown: check the sensors, and look into the "
        "spectra for where the modes are now; search there, or excite more.",
        names=names,
        missed=missed,
    )


def undeclared_events(
    track: Track | None, baseline: int, kind: Literal["step", "alarm"]
) -> list[Event]:
    """Return the events of a kind after a log that no maintenance declares, one per mode."""
    events = () if track is None else track.events
    undeclared = (one for one in events if one.kind == kind and not one.declared)
    return [one for one in undeclared if one.epoch > baseline]


def _alarm_sentences(track: Track | None, baseline: int) -> Iterator[str]:
    """Yield a sentence per mode with an alarm: its drift by now."""
    if track is None:
        return
    alarms = {event.mode: event for event in undeclared_events(track, baseline, "alarm")}
    for mode, event in alarms.items():
        k = track.modes.index(mode)
        moved, std = track.drift[-1, k], np.sqrt(track.drift_cov[-1, k, k])
        size = f"{100 * np.expm1(moved):+.2f} ± {100 * np.exp(moved) * std:.2f} %"
        when, name = utc_day(track.recorded_at[event.epoch]).isoformat(), spell(mode)
        size = size.replace("-", "−")
        yield fact(
            "Alarm since {day}: {name} has moved by {size} since the baseline.",
            day=when,
            name=name,
            size=size,
        )


def _judge_step(
    stage: Stage, history: History, health: Health | None, jumps: list[Event]
) -> Verdict:
    sentences = []
    for epoch in sorted({event.epoch for event in jumps}):
        own = (event for event in jumps if event.epoch == epoch)
        sizes = ", ".join(f"{one.mode} {100 * np.expm1(one.size):+.1f} %" for one in own)
        when, moved = utc_day(history.recorded_at[epoch]).isoformat(), sizes.replace("-", "−")
        sentences.append(
            fact(
                "The frequencies jumped before the log of {day} ({sizes}), and no declared "
                "maintenance explains it.",
                day=when,
                sizes=moved,
            )
        )
    sentences.append(
        fact("A payload or another condition that no log states would move the modes likewise.")
    )
    if health is not None and health.publishable_parameters().any():
        sentences.append(_parameter_sentences(stage, health))
    # The evidence is against all that is harmless: wander, outliers, running-in.
    evidence = max(event.evidence for event in jumps) + logit(constants.STEP_PROBABILITY)
    probability, why = float(expit(evidence)), " ".join(sentences)
    return Verdict(history.stage, history.recorded_at[-1], "step", probability, why)


def _judge_posterior(stage: Stage, history: History, health: Health) -> Verdict:
    lost: dict[str, BoolArray] = {}
    for j in np.flatnonzero(health.publishable_parameters()).tolist():
        parameter = stage.parameters[j]
        below = health.samples[-1, :, j] < degraded_below(parameter)
        lost[parameter.word] = lost.get(parameter.word, False) | below
    # A mode that moved alone counts in draws without a loss.
    lone = health.lone.ravel() if lost else np.empty(0, dtype=int)
    degraded = np.column_stack(list(lost.values()))
    modes = np.where(degraded.any(axis=1), NO_MODE, lone)
    draws = Counter(zip(map(tuple, degraded.tolist()), (modes != NO_MODE).tolist(), strict=True))
    # Of equally probable verdicts the one with more degraded parameters: it allows for more.
    chosen = max(draws, key=lambda one: (draws[one], sum(one[0]), one))
    verdict = verdict_of(tuple(compress(lost, chosen[0])))
    why = _parameter_sentences(stage, health)
    if chosen[1]:
        verdict = OUTSIDE_MAP
        [(mode, _)] = Counter(modes[modes != NO_MODE].tolist()).most_common(1)
        name = health.modes[mode]
        why = f"{lone_sentence(next(m for m in health.lone_modes if m.mode == name), stage)} {why}"
    probability = draws[chosen] / draws.total()
    baselines = np.array([one.baseline for one in stage.parameters])
    if verdict == "healthy" and (risen := health.risen(baselines)).any():
        verdict = OUTSIDE_MAP
        above = (health.samples[-1] > constants.RISEN * baselines)[:, risen].all(axis=1)
        probability = float(np.mean((above | (modes != NO_MODE)) & ~degraded.any(axis=1)))
        why = f"{_risen_sentence(compress(health.parameters, risen))} {why}"
    return Verdict(history.stage, history.recorded_at[-1], verdict, probability, why)


def lone_sentence(lone: LoneMode, stage: Stage) -> str:
    """Return a sentence about a mode that moved alone, and what to check."""
    moved, std = 100 * np.expm1(lone.size), 100 * np.exp(lone.size) * lone.std
    name = spell(lone.mode).capitalize()
    states = " and ".join(spell(one.name) for one in stage.parameters)
    size = f"{moved:+.1f}".replace("-", "−")
    return fact(
        "{name} has moved by {size} ± {std:.1f} % alone; no state of {states} does this. Check "
        "its sensor and cables, and what the platform carries.",
        name=name,
        size=size,
        std=std,
        states=states,
    )


def _risen_sentence(names: Iterable[str]) -> str:
    return fact(
        "{names} is above its baseline value, which no wear does: work was not entered, or "
        "something else moved the modes, or other resonances have their names.",
        names=" and ".join(map(spell, names)).capitalize(),
    )


def _parameter_sentences(stage: Stage, health: Health) -> str:
    quantiles = health.latest(np.array([0.05, 0.5, 0.95]))
    informed = health.publishable_parameters()
    sentences = []
    for j, parameter in enumerate(stage.parameters):
        name = spell(parameter.name).capitalize()
        low, middle, high = quantiles[:, j]
        if not health.identifiable[-1, j]:
            text = fact("{name}: not identifiable from the tracked modes.", name=name)
        elif not informed[j]:
            text = fact("{name}: not constrained by these logs.", name=name)
        elif parameter.unit:
            text = fact(
                "{name} is {middle:.4g} {unit} (90 %: {low:.4g} to {high:.4g}).",
                name=name,
                unit=parameter.unit,
                low=low,
                middle=middle,
                high=high,
            )
        else:
            low, middle, high = (100 * q / parameter.baseline for q in (low, middle, high))
            text = fact(
                "{name} is at {middle:.0f} % of its baseline value (90 %: {low:.0f} to "
                "{high:.0f} %).",
                name=name,
                low=low,
                middle=middle,
                high=high,
            )
        sentences.append(text)
    return " ".join(sentences)
