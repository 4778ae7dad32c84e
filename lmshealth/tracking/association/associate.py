"""Who is who: estimates of many logs given to the modes of one machine.

Names are strong evidence and not infallible: a finder that names its peaks by frequency gives wrong
names once two modes have crossed. What frequencies, dampings and shapes did before then decides,
and where it does not, the estimate is given to nobody.

Where one explanation of a log is possible, it is taken. Where modes come near each other, all
explanations that are not hopeless are followed [Reid1979]_, and an estimate gets a label once that
label has nearly all of their weight. No label uses later logs.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.errors import BadTable, NotEnoughData
from lmshealth.tracking.association.estimates import Estimates, Table
from lmshealth.tracking.association.identities import SURE, Identities, Log, Verdict
from lmshealth.tracking.association.mode_filters import LEAST_LOGS

Reason = Literal["ambiguous", "jump", "unconfirmed"]


@dataclass(frozen=True, slots=True)
class Doubt:
    """An estimate that is given to no mode.

    Attributes
    ----------
    epoch, estimate : int
        Which it is.
    reason : str
        ``ambiguous``, ``jump`` or ``unconfirmed``.
    detail : str
        What is known, in a sentence.
    """

    epoch: int
    estimate: int
    reason: Reason
    detail: str


@dataclass(frozen=True, slots=True)
class Association:
    """Which mode each estimate is of.

    Attributes
    ----------
    modes : tuple of str
        Ascending in first frequency; those without a name are named by frequency.
    assigned : tuple
        For each log and each of its estimates the mode, or None.
    doubts : tuple of Doubt
        One for each None, in order.
    """

    modes: tuple[str, ...]
    assigned: tuple[tuple[str | None, ...], ...]
    doubts: tuple[Doubt, ...]


def associate(
    epochs: Sequence[Estimates],
    clock: FloatArray,
    *,
    offsets: FloatArray,
    prior_std: FloatArray,
    jumps: Collection[int] = (),
) -> Association:
    """Give the estimates of all logs to modes.

    Parameters
    ----------
    epochs : sequence of Estimates
        One for each log, with equally many channels of shapes.
    clock : ndarray
        Ascending odometer or time in any unit, shape ``(n_epochs,)``.
    offsets : ndarray
        Covariates about their references, ``(n_epochs, n_covariates)``; 0 where unknown.
    prior_std : ndarray
        Prior standard deviation of d ln f per unit of each covariate, ``(n_covariates,)``.
    jumps : collection of int
        Epochs at which frequencies may step, as after declared maintenance.

    Returns
    -------
    Association
        The labels of a log rest on it and on earlier logs.

    Raises
    ------
    NotEnoughData
        If there is no log.
    BadTable
        If an estimate is not finite or has no positive variance, logs differ in the number of
        channels, the clock descends, or covariates, their prior or jumps do not fit the logs.

    References
    ----------
    [BarShalom1988]_, [Reid1979]_, [Murty1968]_, [Allemang2003]_
    """
    clock, offsets, prior_std = (np.asarray(a, float) for a in (clock, offsets, prior_std))
    _check(epochs, clock, offsets, prior_std, jumps)
    table = Table(epochs, offsets, prior_std)
    identities = Identities(prior_std, epochs[0].shapes.shape[1])
    scales, declared = _scales(clock), frozenset(jumps)
    assigned: list[tuple[str | None, ...]] = []
    doubts: list[Doubt] = []
    for k, estimates in enumerate(epochs):
        names, opened = estimates.names, k in declared
        log = Log(k, float(clock[k]), scales[k], offsets[k], opened, names, estimates.sources)
        if table.plain[k] and not opened and identities.settled and assigned[-1] == names:
            identities.defer(log, table)
            assigned.append(names)
            continue
        labels: list[str | None] = [None] * len(names)
        for verdict in identities.see(log, table):
            for i, (row, mode) in enumerate(zip(verdict.scan.rows, verdict.modes, strict=True)):
                if mode >= 0:
                    labels[row] = identities.names[mode]
                else:
                    doubts.append(_doubt(verdict, i, names[row], identities.names))
        assigned.append(tuple(labels))
    order = np.argsort(identities.first, kind="stable")
    doubts.sort(key=lambda doubt: (doubt.epoch, doubt.estimate))
    return Association(tuple(identities.names[i] for i in order), tuple(assigned), tuple(doubts))


def _doubt(verdict: Verdict, i: int, name: str, modes: list[str]) -> Doubt:
    """Say why an estimate is given to no mode."""
    scan, chances = verdict.scan, verdict.chances[i]
    frequency = float(np.exp(scan.readings.ln_f[i]))
    reason: Reason
    if i in verdict.jumps:
        reason = "jump"
        expected = float(np.exp(verdict.expected[scan.names[i]]))
        detail = (
            f"{frequency:.5g} Hz named {name}, expected at {expected:.5g} Hz: a jump that the log "
            "before does not show; it is believed once the next log confirms it"
        )
    elif chances[-1] < SURE:
        reason = "ambiguous"
        told = [*modes[: chances.size - 1], "no known mode"]
        parts = [f"{told[j]} {chances[j]:.0%}" for j in np.argsort(-chances) if chances[j] > 0.005]
        detail = f"{frequency:.5g} Hz may be of {' or '.join(parts)}: the logs so far do not tell"
    else:
        reason = "unconfirmed"
        detail = (
            f"{frequency:.5g} Hz is of no known mode; it is believed to be one once three logs "
            "show it"
        )
    return Doubt(scan.epoch, int(scan.rows[i]), reason, detail)


def _check(
    epochs: Sequence[Estimates],
    clock: FloatArray,
    offsets: FloatArray,
    prior_std: FloatArray,
    jumps: Collection[int],
) -> None:
    n = len(epochs)
    if not n:
        raise NotEnoughData("no log to associate: give at least one")
    if clock.shape != (n,) or not np.isfinite(clock).all():
        raise BadTable(f"clock has shape {clock.shape}: needed one finite value for each of {n}")
    back = np.flatnonzero(np.diff(clock) < 0)
    if back.size:
        k = int(back[0]) + 1
        raise BadTable(f"clock descends to {clock[k]:g} at epoch {k}: put the logs in order")
    if prior_std.ndim != 1 or not (np.isfinite(prior_std) & (prior_std >= 0)).all():
        raise BadTable(f"prior_std is {prior_std}: needed one finite value ≥ 0 per covariate")
    if offsets.shape != (n, prior_std.size) or not np.isfinite(offsets).all():
        raise BadTable(
            f"offsets have shape {offsets.shape}: needed finite values of shape "
            f"{(n, prior_std.size)}, 0 where a covariate is unknown"
        )
    channels = {e.shapes.shape[1] for e in epochs}
    if len(channels) > 1:
        raise BadTable(
            f"shapes have {sorted(channels)} channels in different logs: give all logs the "
            "same channels, NaN where one is absent"
        )
    wrong = sorted(k for k in jumps if not 0 <= k < n)
    if wrong:
        raise BadTable(f"jumps at epochs {wrong}: there are epochs 0 to {n - 1}")


def _scales(clock: FloatArray) -> list[float]:
    """Length of a life at each log as it is known then: what has passed, or a number of logs."""
    passed = clock - clock[0]
    count = np.maximum(np.arange(clock.size), 1)
    return [float(s) for s in passed * np.maximum(1.0, LEAST_LOGS / count)]
