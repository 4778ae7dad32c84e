"""Tables of tracks, ours or another program's, read as drifts that health is inferred from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd

from lmshealth.arrays import FloatArray, expect_shape, freeze
from lmshealth.errors import BadTable
from lmshealth.rowfile import lines, name_machine, read_rows, to_moments, to_numbers

_KM = 1000.0
# A factor of 20 in frequency; and what drowns in the rounding of ln frequency.
_WIDEST, _FINEST = 3.0, 1e-9
_NEEDED = ("recorded_at", "mode", "drift", "drift_std")
_TERMS = ("recorded_at", "mode_a", "mode_b", "cov_drift")


@dataclass(frozen=True, slots=True, eq=False)
class Drifts:
    """What health is inferred from: a track without the rest of it.

    Attributes
    ----------
    stage, recorded_at, travel, modes, drift, drift_cov
        As in `tracks.Track`.
    """

    stage: str
    recorded_at: tuple[datetime, ...]
    travel: FloatArray
    modes: tuple[str, ...]
    drift: FloatArray
    drift_cov: FloatArray

    def __post_init__(self) -> None:
        n, m = len(self.recorded_at), len(self.modes)
        expect_shape("travel", self.travel, (n,))
        expect_shape("drift", self.drift, (n, m))
        expect_shape("drift_cov", self.drift_cov, (n, m, m))
        freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class DriftTable:
    """What a table says.

    Attributes
    ----------
    machines : tuple of Drifts
        In the order in which they come.
    notes : tuple of str
        What its reader must know: what was missing, and what is assumed instead.
    """

    machines: tuple[Drifts, ...]
    notes: tuple[str, ...]


def read_drifts(path: Path, *, cross_terms: Path | None = None) -> DriftTable:
    """Read a table in the columns of ``track.csv``.

    Needed are ``recorded_at``, ``mode``, ``drift`` (of ln frequency against baseline) and
    ``drift_std``. Without ``stage`` all rows are of one machine.

    Parameters
    ----------
    path : Path
        The table.
    cross_terms : Path, optional
        Covariances between drifts of one epoch, in the columns of ``track_cov.csv``.

    Raises
    ------
    BadTable
        If a table cannot be read, a column is missing, or a value makes no sense.
    """
    table = read_rows(path, _NEEDED)
    if table.empty:
        raise BadTable(f"{path}: no row; needed is at least one drift")
    notes = []
    notes += name_machine(path, table)
    to_numbers(path, table, ("drift", "drift_std", "travel_km"))
    to_moments(path, table)
    std = table["drift_std"]
    _refuse(path, table, "drift", table["drift"].abs() > _WIDEST, "a change of ln frequency")
    wrong = (std < 0) | (std > _WIDEST) | ((std > 0) & (std < _FINEST))
    _refuse(path, table, "drift_std", wrong, "a standard deviation of ln frequency, 0 at baseline")
    nameless = table["stage"].str.strip() == ""
    if nameless.any():
        raise BadTable(f"{path}, {lines(table, nameless)}: stage is empty; needed is a name")
    terms = None
    if cross_terms is not None:
        terms = _read_terms(cross_terms, str(table["stage"].iloc[0]))
    elif table["mode"].nunique() > 1:
        notes.append(
            "no covariances between the drifts of modes: they are taken for independent, though "
            "baseline and temperature are common to them; give track_cov.csv"
        )
    machines = tuple(
        _drifts(path, str(stage), rows, None if terms is None else terms[terms["stage"] == stage])
        for stage, rows in table.groupby("stage", sort=False)
    )
    return DriftTable(machines, tuple(notes))


def _refuse(path: Path, table: pd.DataFrame, name: str, wrong: pd.Series[bool], what: str) -> None:
    if wrong.any():
        got = table.loc[wrong, name].iloc[0]
        raise BadTable(f"{path}, {lines(table, wrong)}: {name} is {got:g}; needed is {what}")


def _read_terms(path: Path, only_machine: str) -> pd.DataFrame:
    terms = read_rows(path, _TERMS)
    if "stage" not in terms.columns:
        terms["stage"] = only_machine
    to_numbers(path, terms, ("cov_drift",))
    to_moments(path, terms)
    return terms


def _drifts(path: Path, stage: str, rows: pd.DataFrame, terms: pd.DataFrame | None) -> Drifts:
    # Logs of one moment are epochs of their own, told apart by their order.
    turn = rows.groupby(["recorded_at", "mode"], sort=False).cumcount()
    epochs = sorted(set(zip(rows["recorded_at"], turn, strict=True)))
    modes = tuple(dict.fromkeys(rows["mode"]))
    place = {epoch: k for k, epoch in enumerate(epochs)}
    column = {mode: i for i, mode in enumerate(modes)}
    k = np.array([place[epoch] for epoch in zip(rows["recorded_at"], turn, strict=True)])
    i = rows["mode"].map(column).to_numpy()
    shape = (len(epochs), len(modes))
    drift, cov = np.full(shape, np.nan), np.full((*shape, shape[1]), np.nan)
    drift[k, i] = rows["drift"]
    known = np.isfinite(drift)
    # What is not told of two drifts that are there is taken for zero.
    cov[known[:, :, None] & known[:, None, :]] = 0.0
    cov[k, i, i] = np.where(known[k, i], rows["drift_std"].to_numpy(dtype=float) ** 2, np.nan)
    if terms is not None:
        _put_terms(cov, terms, place, column)
    _expect_covariances(path, stage, cov, epochs)
    travel = np.full(shape[0], np.nan)
    if "travel_km" in rows.columns:
        travel[k] = rows["travel_km"].to_numpy(dtype=float) * _KM
    return Drifts(stage, tuple(moment for moment, _ in epochs), travel, modes, drift, cov)


def _put_terms(
    cov: FloatArray,
    terms: pd.DataFrame,
    place: dict[tuple[object, int], int],
    column: dict[str, int],
) -> None:
    """Fill in the covariances between modes; terms of epochs or modes not in the table are idle."""
    turn = terms.groupby(["recorded_at", "mode_a", "mode_b"], sort=False).cumcount()
    for moment, count, a, b, value in zip(
        terms["recorded_at"],
        turn,
        terms["mode_a"].map(column),
        terms["mode_b"].map(column),
        terms["cov_drift"],
        strict=True,
    ):
        k = place.get((moment, count))
        if k is not None and np.isfinite([a, b, value]).all() and a != b:
            cov[k, int(a), int(b)] = cov[k, int(b), int(a)] = value


def _expect_covariances(
    path: Path, stage: str, cov: FloatArray, epochs: Sequence[tuple[datetime, int]]
) -> None:
    """Insist on covariances that can be; zero ones are those of the baseline itself."""
    there = np.isfinite(np.einsum("kii->ki", cov))
    full = np.where(there[:, :, None] & there[:, None, :], np.nan_to_num(cov), 0.0)
    scale = np.einsum("kii->k", full)
    wrong = np.linalg.eigvalsh(full)[:, 0] < -1e-9 * scale
    if wrong.any():
        moment = epochs[int(np.flatnonzero(wrong)[0])][0].isoformat()
        raise BadTable(
            f"{path}: {stage}: drift_std and cross terms of {moment} are no covariance; "
            "its least eigenvalue is negative"
        )
