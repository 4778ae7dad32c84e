"""Logs that contradict the others of their machine: by odometer, date or sample rate."""

from bisect import bisect_right
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import groupby

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.io.constants import AGREEMENT
from lmshealth.io.log import Refusal
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.modes import Modes
from lmshealth.tracking import constants

LEFT_OUT = ("odometer", "date", "odd-rate")
"""Reasons for which a log as a whole is left out of a history."""
BY_CLOCK = LEFT_OUT[:2]
"""Those of its odometer or date."""
NO_MOMENT = datetime.max.replace(tzinfo=UTC)
"""In place of the moment of a log that states none."""


def sort_by_time(readings: Sequence[LogEstimates]) -> tuple[LogEstimates, ...]:
    """Sort the estimates of logs by the moment of recording, then by name."""
    return tuple(sorted(readings, key=lambda r: (r.metadata.recorded_at or NO_MOMENT, r.log)))


def without_contradictions(
    readings: Sequence[LogEstimates],
) -> tuple[tuple[LogEstimates, ...], list[Refusal], int]:
    """Sort logs by time; refuse those whose odometer, date or sample rate contradicts others.

    Also returned is how many in a row are refused for their odometer or date, at most.
    """
    every, refused = sort_by_time(readings), list[Refusal]()
    ordered = every
    for check in (_without_odometer_errors, _without_lone_dates, _without_odd_rates):
        ordered, found = check(ordered)
        refused += found
    out = {one.log for one in refused if one.reason in BY_CLOCK}
    rows = groupby(every, lambda one: one.log in out)
    in_a_row = max((len([*own]) for is_out, own in rows if is_out), default=0)
    return ordered, refused, in_a_row


def are_many(n: int, total: int) -> bool:
    """Return whether so many of all logs are no slips of single ones."""
    return n > max(constants.FEW_CONTRADICTIONS, constants.CONTRADICTING_SHARE * total)


def _without_odometer_errors(
    ordered: tuple[LogEstimates, ...],
) -> tuple[tuple[LogEstimates, ...], list[Refusal]]:
    """Keep the longest run of logs whose odometer never decreases; refuse the others.

    One mistyped odometer contradicts all logs after or before it, and is the one that is refused.
    """
    if any(reading.metadata.travel is None for reading in ordered):
        return ordered, []
    travel = [float(reading.metadata.travel or 0.0) for reading in ordered]
    # Longest non-decreasing subsequence: the lowest end of a run of each length, and its log.
    ends: list[float] = []
    logs: list[int] = []
    before = [-1] * len(travel)
    for k, own in enumerate(travel):
        place = bisect_right(ends, own)
        before[k] = logs[place - 1] if place else -1
        ends[place : place + 1], logs[place : place + 1] = [own], [k]
    kept: set[int] = set()
    at = logs[-1] if logs else -1
    while at >= 0:
        kept.add(at)
        at = before[at]
    refused = [
        Refusal(
            log=reading.log,
            reason="odometer",
            detail=f"travel_km {travel[k] / 1000:g} contradicts the logs recorded before or after "
            "it: an odometer never runs backwards; correct it in manifest.csv (after a "
            "replaced or reset odometer add its last reading to all later rows)",
        )
        for k, reading in enumerate(ordered)
        if k not in kept
    ]
    return tuple(ordered[k] for k in sorted(kept)), refused


def _without_lone_dates(
    ordered: tuple[LogEstimates, ...],
) -> tuple[tuple[LogEstimates, ...], list[Refusal]]:
    """Refuse few logs at either end whose dates lie years away, which the odometer contradicts.

    Of a wrong date in between the odometer is contradictory, or the order of the logs is unharmed.
    """
    moments = [reading.metadata.recorded_at for reading in ordered]
    if None in moments or any(reading.metadata.travel is None for reading in ordered):
        return ordered, []
    refused: list[Refusal] = []
    travel = np.array([reading.metadata.travel for reading in ordered], dtype=float)
    seconds = np.array([moment.timestamp() for moment in moments if moment])
    while (n := len(ordered)) > constants.DATED_LOGS:
        first = int(np.argmax(np.diff(seconds))) + 1  # log after the longest gap
        gap, gained = (float(own[first] - own[first - 1]) for own in (seconds, travel))
        few, rest = slice(0, first), slice(first, n)
        if first > n - first:
            few, rest = rest, few
        n_few, span = min(first, n - first), float(seconds[rest][-1] - seconds[rest][0])
        usual = gap / max(span, 1.0) * float(travel[rest][-1] - travel[rest][0])
        is_long = gap > (constants.IDLE_S if n_few == 1 else constants.LONGEST_IDLE_S)
        enough = n - n_few >= constants.DATED_LOGS and n_few <= max(1, n // 10)
        if not (is_long and enough and gained < constants.IDLE_SHARE * usual):
            break
        detail = (
            f"is {gap / constants.IDLE_S:.3g} years away from the other logs, in which the "
            f"odometer gained {gained / 1000:.4g} km, against {usual / 1000:.4g} km at their rate: "
            "a clock that was not set; correct it in manifest.csv (if it is right, further logs of "
            "that time confirm it)"
        )
        refused += [
            Refusal(reading.log, "date", f"recorded_at {reading.metadata.recorded_at} {detail}")
            for reading in ordered[few]
        ]
        ordered, seconds, travel = ordered[rest], seconds[rest], travel[rest]
    return ordered, refused


def _without_odd_rates(
    ordered: tuple[LogEstimates, ...],
) -> tuple[tuple[LogEstimates, ...], list[Refusal]]:
    """Keep the logs of the usual sample rate, and those whose frequencies do not follow another.

    A wrong rate changes all frequencies by its ratio to the right one; another setting does not.
    """
    rates = np.array([reading.sample_rate or np.nan for reading in ordered])
    usual = _usual_rate(rates)
    if usual is None or usual.sum() < constants.FEWEST_RATE_LOGS:
        return ordered, []
    ticks = np.array([(r.metadata.recorded_at or NO_MOMENT).timestamp() for r in ordered])
    others, is_usual = np.flatnonzero(usual), usual.mean() >= constants.RATE_SHARE
    found = []
    for k in np.flatnonzero(np.isfinite(rates) & ~usual).tolist():
        at = int(np.searchsorted(others, k))
        near = others[max(0, at - constants.RATE_LOGS) : at + constants.RATE_LOGS]
        near = near[np.argsort(np.abs(near - k), kind="stable")[: constants.RATE_LOGS]]
        right = float(np.median(rates[near]))
        own, ratio = ordered[k].modes, float(np.log(rates[k] / right))
        share = _share(own, [ordered[i].modes for i in near], ticks[near] - ticks[k], ratio)
        rest = f"the sample rate is {rates[k]:.8g} Hz, that of {usual.sum()} logs {right:.8g} Hz"
        if share is not None and 2 / 3 < share < 4 / 3:
            rest += ", and the frequencies are off by this ratio: one of the two rates is wrong"
            rest += "; correct sample_rate_hz in manifest.csv"
            found.append(Refusal(ordered[k].log, "odd-rate", rest))
        elif (
            (share is None or 1 / 3 < share <= 2 / 3)
            and abs(ratio) < constants.RATE_NEAR
            and is_usual
        ):
            rest += ", too little for the frequencies to decide which is right; check both"
            found.append(Refusal(ordered[k].log, "rate", rest, channel="sample_rate_hz"))
    left_out = {one.log for one in found if one.reason in LEFT_OUT}
    return tuple(one for one in ordered if one.log not in left_out), found


def _usual_rate(rates: FloatArray) -> BoolArray | None:
    """Return which logs have the most frequent rate, at a tie the first; None if all have one."""
    known = np.sort(rates[np.isfinite(rates)])
    low, high = (np.searchsorted(known, rates * (1 + sign * 2 * AGREEMENT)) for sign in (-1, 1))
    n = np.where(np.isfinite(rates), high - low, 0)
    if n.max() == known.size:
        return None
    found: BoolArray = np.abs(rates / rates[int(np.argmax(n))] - 1) < 2 * AGREEMENT
    return found


def _share(own: Modes, others: Sequence[Modes], ticks: FloatArray, ratio: float) -> float | None:
    """Return the share of ln of the ratio of two rates by which ln f of a log is off from others.

    From what a line through the other logs (``ticks`` in s before or after, ``(n_others,)``)
    predicts of the median mode: wear moves modes steadily, and some more. None where the ratio does
    not exceed the error of that.
    """
    first, *rest = (
        dict(zip(zip(one.names, one.sources, strict=True), one.ln_frequency, strict=True))
        for one in (own, *others)
    )
    common = [mode for mode in first if mode[0] and all(mode in one for one in rest)]
    if not common:
        return None
    moved = np.median([[first[mode] - one[mode] for one in rest] for mode in common], axis=0)
    line = np.stack([np.ones(ticks.size), ticks / np.abs(ticks).max()], axis=1)
    inverse = np.linalg.pinv(line.T @ line)
    trend = inverse @ line.T @ moved
    scatter = float(np.sum((moved - line @ trend) ** 2)) / max(1, ticks.size - 2)
    std = max(float(np.median(own.frequency_std / own.frequency)), constants.RATE_SPREAD)
    spread = float(np.sqrt(max(scatter, std**2) * (1 + inverse[0, 0])))
    return float(trend[0]) / ratio if abs(ratio) > constants.RATE_GATE * spread else None
