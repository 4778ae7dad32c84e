"""Histories: the modal estimates of one stage put in order."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.logs import Metadata, Refusal
from lmshealth.results import Modes
from lmshealth.stage import Stage
from lmshealth.tracks import History

# Between two logs ln f moves by temperature and wear, but not by more than this.
_JUMP = 0.02
_JUMP_SIGMAS = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What one log said.

    Attributes
    ----------
    log : str
        Its name.
    digest : str
        SHA-256 of its content.
    metadata : Metadata
        With identity, moment and odometer.
    modes : Modes
        Its modal estimates.
    loop_error : float or None
        RMS of the following error from 1 to 40 Hz in m, see `loop_error` of `following`; None
        where it was not measured.
    """

    log: str
    digest: str
    metadata: Metadata
    modes: Modes
    loop_error: float | None = None


def in_order(readings: Sequence[Reading]) -> tuple[Reading, ...]:
    """Sort readings by the moment of recording, then by name."""
    return tuple(sorted(readings, key=lambda r: (r.metadata.recorded_at, r.log)))


def build_history(readings: Sequence[Reading], stage: Stage) -> tuple[History, list[Refusal]]:
    """Line up the tracked modes of one machine.

    Parameters
    ----------
    readings : sequence of Reading
        Logs of one machine in any order, with identity, moment and odometer.
    stage : Stage
        Says which modes are tracked.

    Returns
    -------
    history : History
        In the order of recording. Its baseline is the first log that the manifest declares one,
        else the first log.
    refused : list of Refusal
        Logs whose odometer contradicts the others, which are left out, and jumps of a frequency
        that no second log confirms, which are missing.

    Raises
    ------
    NotEnoughData
        If there is no reading.
    """
    if not readings:
        raise NotEnoughData(f"{stage.name}: no usable log")
    ordered, refused = _without_contradictions(in_order(readings))
    tracked = [mode.name for mode in stage.modes if mode.tracked]
    found = {name for reading in ordered for name in reading.modes.names}
    modes = tuple(name for name in tracked if name in found)
    estimates = _estimates(ordered, modes)
    refused += _refuse_unconfirmed(ordered, modes, estimates)
    declared = [k for k, reading in enumerate(ordered) if reading.metadata.baseline]
    history = History(
        stage=str(ordered[0].metadata.stage),
        logs=tuple(reading.log for reading in ordered),
        recorded_at=tuple(r.metadata.recorded_at for r in ordered if r.metadata.recorded_at),
        travel=np.array([reading.metadata.travel for reading in ordered], dtype=float),
        covariates=_covariates(ordered),
        modes=modes,
        **estimates,
        baseline=declared[0] if declared else 0,
    )
    return history, refused


def _without_contradictions(
    ordered: tuple[Reading, ...],
) -> tuple[tuple[Reading, ...], list[Refusal]]:
    """Keep the longest run of logs whose odometer never runs backwards.

    One mistyped odometer contradicts all logs after or before it; it is the odd one out that goes.
    """
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
            "it: an odometer never runs backwards; correct it in manifest.csv",
        )
        for k, reading in enumerate(ordered)
        if k not in kept
    ]
    return tuple(ordered[k] for k in sorted(kept)), refused


def _refuse_unconfirmed(
    ordered: Sequence[Reading], modes: tuple[str, ...], estimates: dict[str, FloatArray]
) -> list[Refusal]:
    """Take out jumps of a frequency that no second log confirms.

    A peak under a wrong name looks like a sudden loss. A real one is there in the next log too, so
    that a jump costs one log and no more. Only earlier logs are looked at.
    """
    ln_f, m = estimates["ln_frequency"], len(modes)
    variance = np.einsum("kii->ki", estimates["cov"])[:, :m]
    refused: list[Refusal] = []
    places: list[tuple[int, int]] = []
    for i, mode in enumerate(modes):
        accepted: list[int] = []
        doubted: int | None = None
        for k in np.flatnonzero(np.isfinite(ln_f[:, i])).tolist():
            recent = accepted[-3:]
            near = not recent or _agree(ln_f[k, i], variance[k, i], ln_f[recent, i])
            confirmed = doubted is not None and _agree(
                ln_f[k, i], variance[k, i] + variance[doubted, i], ln_f[[doubted], i]
            )
            if near or confirmed:
                # A confirmed jump begins a new level: the logs before it are no measure any more.
                accepted = [*(accepted if near else []), k]
                doubted = None
                continue
            doubted = k
            expected = float(np.exp(ln_f[recent[-1], i]))
            detail = (
                f"{np.exp(ln_f[k, i]):.5g} Hz after {expected:.5g} Hz: a jump that the log before "
                "does not show; it is believed once the next log confirms it"
            )
            refused.append(Refusal(log=ordered[k].log, mode=mode, reason="jump", detail=detail))
            places.append((k, i))
    # Only now, because a doubted value is what the next log is compared with.
    for k, i in places:
        ln_f[k, i] = estimates["ln_damping"][k, i] = np.nan
        for row in (i, m + i):
            estimates["cov"][k, row], estimates["cov"][k, :, row] = np.nan, np.nan
    return refused


def _agree(value: float, variance: float, others: FloatArray) -> bool:
    reach = max(_JUMP_SIGMAS * float(np.sqrt(variance)), _JUMP)
    return bool(np.min(np.abs(value - others)) <= reach)


def _covariates(ordered: Sequence[Reading]) -> dict[str, FloatArray]:
    names = sorted({name for reading in ordered for name in reading.metadata.covariates})
    return {
        name: np.array([r.metadata.covariates.get(name, np.nan) for r in ordered], dtype=float)
        for name in names
    }


def _estimates(ordered: Sequence[Reading], modes: tuple[str, ...]) -> dict[str, FloatArray]:
    n, m = len(ordered), len(modes)
    ln_f, ln_zeta = np.full((n, m), np.nan), np.full((n, m), np.nan)
    cov = np.full((n, 2 * m, 2 * m), np.nan)
    for k, reading in enumerate(ordered):
        own = reading.modes
        pairs = [(modes.index(name), i) for i, name in enumerate(own.names) if name in modes]
        if not pairs:
            continue
        to, of = (np.array(side) for side in zip(*pairs, strict=True))
        ln_f[k, to], ln_zeta[k, to] = own.ln_frequency[of], own.ln_damping[of]
        to, of = np.concatenate([to, to + m]), np.concatenate([of, of + len(own.names)])
        cov[k][np.ix_(to, to)] = own.cov[np.ix_(of, of)]
    return {"ln_frequency": ln_f, "ln_damping": ln_zeta, "cov": cov}
