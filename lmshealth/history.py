"""Histories: the modal estimates of one stage put in order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.logs import Metadata, Refusal
from lmshealth.results import History, Modes
from lmshealth.stage import Stage


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
    """

    log: str
    digest: str
    metadata: Metadata
    modes: Modes


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
        Odometers that ran backwards; their logs stay in the history, the clock stands still.

    Raises
    ------
    NotEnoughData
        If there is no reading.
    """
    if not readings:
        raise NotEnoughData(f"{stage.name}: no usable log")
    ordered = in_order(readings)
    travel = np.array([reading.metadata.travel for reading in ordered], dtype=float)
    highest = np.maximum.accumulate(travel)
    refused = [
        Refusal(
            log=reading.log,
            reason="odometer-backwards",
            detail=f"travel_km is {own / 1000:g} after {so_far / 1000:g} before; "
            "the log is used at the higher one",
        )
        for reading, own, so_far in zip(ordered, travel, highest, strict=True)
        if own < so_far
    ]
    tracked = [mode.name for mode in stage.modes if mode.tracked]
    found = {name for reading in ordered for name in reading.modes.names}
    modes = tuple(name for name in tracked if name in found)
    declared = [k for k, reading in enumerate(ordered) if reading.metadata.baseline]
    history = History(
        stage=str(ordered[0].metadata.stage),
        logs=tuple(reading.log for reading in ordered),
        recorded_at=tuple(r.metadata.recorded_at for r in ordered if r.metadata.recorded_at),
        travel=highest,
        covariates=_covariates(ordered),
        modes=modes,
        **_estimates(ordered, modes),
        baseline=declared[0] if declared else 0,
    )
    return history, refused


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
