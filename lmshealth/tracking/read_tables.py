"""Tables of modal estimates, ours or another program's, read as what logs said.

Tables of tracks, ours or another program's, read as drifts that health is inferred from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd

from lmshealth._arrays import FloatArray, expect_shape, freeze
from lmshealth.errors import BadTable
from lmshealth.io.log import Metadata, Refusal
from lmshealth.io.metadata import COVARIATES
from lmshealth.io.tables import lines, name_machine, read_rows, to_moments, to_numbers
from lmshealth.modal.modes import Modes
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History, LogEstimates, build_history
from lmshealth.tracking.maintenance import read_actions

_KM, _MICRO = 1000.0, 1e-6
_NEEDED = ("recorded_at", "frequency_hz", "frequency_std_hz")
_DAMPING = ("damping_ratio", "damping_ratio_std")
_NUMBERS = (
    *_NEEDED[1:],
    *_DAMPING,
    "travel_km",
    "correlation_f_zeta",
    "snr",
    "delta_e_below_40hz_um",
)
# What belongs to a log and not to one of its estimates.
_OF_LOG = ("stage", "recorded_at", "travel_km", "servo_id", "delta_e_below_40hz_um", "baseline")
_SHAPE = "shape_"
# Relative standard deviations below drown in the rounding of variances.
_FINEST = 1e-7
_UNKNOWN_SOURCE = "unknown"


@dataclass(frozen=True, slots=True, eq=False)
class EstimateTable:
    """What a table says.

    Attributes
    ----------
    readings : tuple of LogEstimates
        One per log, in the order of the table.
    notes : tuple of str
        What its reader must know: what was missing, and what is assumed instead.
    """

    readings: tuple[LogEstimates, ...]
    notes: tuple[str, ...]


def read_estimates(
    path: Path, *, cross_terms: Path | None = None, stage: Stage | None = None
) -> EstimateTable:
    """Read a table in the columns of ``modes.csv``.

    Needed are ``recorded_at``, ``frequency_hz`` and ``frequency_std_hz``; a row is one estimate.
    Without ``log`` the rows of one moment are one log, without ``stage`` all are of one machine.

    Parameters
    ----------
    path : Path
        The table.
    cross_terms : Path, optional
        Covariances between estimates of one log, in the columns of ``modes_cov.csv``.
    stage : Stage, optional
        Its covariates are read too, and other mode names than its own are refused.

    Raises
    ------
    BadTable
        If a table cannot be read, a column is missing, a value makes no sense, an estimate stands
        there twice, or rows of one log contradict each other.
    """
    table = read_rows(path, _NEEDED)
    if table.empty:
        raise BadTable(f"{path}: no row; needed is at least one estimate")
    covariates = [*COVARIATES]
    if stage is not None:
        covariates += [c.name for c in stage.description.covariate if c.name not in covariates]
    notes: list[str] = []
    _tidy(path, table, covariates, notes)
    _drop_bad_damping(table, notes)
    _check(path, table, stage)
    terms = None if cross_terms is None else _read_terms(cross_terms)
    shapes = [name for name in table.columns if name.startswith(_SHAPE)]
    readings = tuple(
        _reading(path, str(log), rows, [c for c in covariates if c in table.columns], shapes, terms)
        for (_, log), rows in table.groupby(["stage", "log"], sort=False)
    )
    return EstimateTable(readings, (*notes, *_order_notes(readings), *_term_notes(table, terms)))


@dataclass(frozen=True, slots=True, eq=False)
class MachineHistories:
    """What a table says, machine by machine.

    Attributes
    ----------
    machines : tuple of History and list of Refusal
        Each with what was not used of it, in the order of the table.
    notes : tuple of str
        What its reader must know.
    """

    machines: tuple[tuple[History, list[Refusal]], ...]
    notes: tuple[str, ...]


def read_machines(
    path: Path,
    stage: Stage | None = None,
    *,
    cross_terms: Path | None = None,
    maintenance: Path | None = None,
) -> MachineHistories:
    """Read a table in the columns of ``modes.csv`` into a history per machine.

    Parameters
    ----------
    path : Path
        The table, see `read_estimates`.
    stage : Stage, optional
        What the machines are.
    cross_terms : Path, optional
        Without it those of a ``modes_cov.csv`` beside the table are used.
    maintenance : Path, optional
        What was done, in the columns of ``maintenance.csv``.

    Raises
    ------
    BadTable
        As `read_estimates` does.
    """
    beside = path.with_name("modes_cov.csv")
    terms = cross_terms or (beside if beside.exists() else None)
    read = read_estimates(path, cross_terms=terms, stage=stage)
    actions = read_actions(maintenance) if maintenance else ()
    own: dict[str, list[LogEstimates]] = {}
    for reading in read.readings:
        own.setdefault(str(reading.metadata.stage), []).append(reading)
    notes = [
        f"maintenance of {name} is not used: the table has {', '.join(own)}"
        for name in dict.fromkeys(action.stage for action in actions if action.stage not in own)
    ]
    machines = tuple(
        build_history(readings, stage, [action for action in actions if action.stage == name])
        for name, readings in own.items()
    )
    return MachineHistories(machines, (*read.notes, *notes))


def _order_notes(readings: Sequence[LogEstimates]) -> list[str]:
    """Say which machines' logs are sorted."""
    machines: dict[str, list[datetime]] = {}
    for reading in readings:
        if reading.metadata.recorded_at is not None:
            machines.setdefault(str(reading.metadata.stage), []).append(
                reading.metadata.recorded_at
            )
    return [
        f"{machine}: the logs are not in the order of time; they are put in it"
        for machine, moments in machines.items()
        if any(a > b for a, b in pairwise(moments))
    ]


def _term_notes(table: pd.DataFrame, terms: pd.DataFrame | None) -> list[str]:
    """Say which cross terms are of no use, and which are missing."""
    notes, told = [], set()
    if terms is not None:
        known = set(zip(table["log"], table["mode"], table["source"], strict=True))
        ends = [
            list(zip(terms["log"], terms[f"mode_{end}"], terms[f"source_{end}"], strict=True))
            for end in ("a", "b")
        ]
        used = np.array([a in known and b in known for a, b in zip(*ends, strict=True)], dtype=bool)
        if not used.all():
            notes.append(
                f"{int((~used).sum())} of {used.size} cross terms are of estimates that the table "
                f"does not have ({lines(terms, pd.Series(~used, terms.index))}); they are not used"
            )
        told = set(terms["log"][used & (terms["source_a"] != terms["source_b"])])
    several = table.groupby("log")["source"].nunique() > 1
    lone = [str(log) for log in several.index[several] if log not in told]
    if lone:
        notes.append(
            f"{len(lone)} logs with several sources, but no covariances between them "
            f"({lone[0]}): their errors are taken for independent, which overstates what they "
            "know together; give modes_cov.csv"
        )
    return notes


def _tidy(path: Path, table: pd.DataFrame, covariates: list[str], notes: list[str]) -> None:
    """Turn text into numbers and moments, and fill in what may be missing, in place."""
    shapes = [name for name in table.columns if name.startswith(_SHAPE)]
    to_numbers(path, table, (*_NUMBERS, *covariates, *shapes))
    for name, fallback in (("mode", ""), ("source", _UNKNOWN_SOURCE), ("servo_id", "")):
        if name not in table.columns:
            table[name] = fallback
    notes += name_machine(path, table)
    if "log" not in table.columns:
        table["log"] = table["recorded_at"]
    for name in _DAMPING:
        if name not in table.columns:
            table[name] = np.nan
    to_moments(path, table)


def _drop_bad_damping(table: pd.DataFrame, notes: list[str]) -> None:
    """Forget dampings that are no estimates; the frequencies beside them are."""
    bad = (table["damping_ratio"].notna() & ~(table["damping_ratio"] > 0)) | (
        table["damping_ratio"].notna() & ~(table["damping_ratio_std"] > 0)
    )
    if bad.any():
        table.loc[bad, list(_DAMPING)] = np.nan
        notes.append(
            f"{int(bad.sum())} damping ratios without a positive value and standard deviation "
            f"({lines(table, bad)}) are not used; the frequencies beside them are"
        )


def _check(path: Path, table: pd.DataFrame, stage: Stage | None) -> None:
    """Refuse what would be wrong all the way to the report."""
    for name, what in (
        ("frequency_hz", "a frequency"),
        (
            "frequency_std_hz",
            "the standard deviation of a frequency, without which nothing is known",
        ),
    ):
        wrong = ~(table[name] > 0)
        if wrong.any():
            got = table.loc[wrong, name].iloc[0]
            told = "missing" if np.isnan(got) else f"{got:g}"
            raise BadTable(
                f"{path}, {lines(table, wrong)}: {name} is {told}; needed is {what}, a positive "
                "number; leave rows out that have none"
            )
    named = table[table["mode"] != ""]
    twice = named.duplicated(["stage", "log", "mode", "source"], keep=False)
    if twice.any():
        first = named[twice].iloc[0]
        raise BadTable(
            f"{path}, {lines(named, twice)}: {first['mode']} by {first['source']} stands there "
            f"twice for log {first['log']}; leave the column mode empty where names are not unique"
        )
    fine = table["frequency_std_hz"] < _FINEST * table["frequency_hz"]
    if fine.any():
        raise BadTable(
            f"{path}, {lines(table, fine)}: frequency_std_hz is "
            f"{table.loc[fine, 'frequency_std_hz'].iloc[0]:g}, below {_FINEST:g} of the frequency; "
            "needed is one that a measurement can have, in Hz"
        )
    if stage is not None:
        known = [mode.name for mode in stage.modes]
        strange = sorted(set(named["mode"]) - set(known))
        if strange:
            raise BadTable(
                f"{path}: modes {strange} are none of {stage.name}, which has {known}; rename "
                "them, or leave the column mode empty to let them be found by their frequency"
            )


def _read_terms(path: Path) -> pd.DataFrame:
    table = read_rows(path, ("log", "source_a", "mode_a", "source_b", "mode_b", "cov_ln_f"))
    to_numbers(path, table, ("cov_ln_f",))
    if table["cov_ln_f"].isna().any():
        raise BadTable(f"{path}, {lines(table, table['cov_ln_f'].isna())}: cov_ln_f is empty")
    return table


def _reading(
    path: Path,
    log: str,
    rows: pd.DataFrame,
    covariates: Sequence[str],
    shapes: Sequence[str],
    terms: pd.DataFrame | None,
) -> LogEstimates:
    """Make the reading of one log from its rows."""
    for name in (*_OF_LOG, *covariates):
        if name in rows.columns and rows[name].nunique(dropna=False) > 1:
            values = list(dict.fromkeys(rows[name]))[:2]
            raise BadTable(f"{path}: log {log} has {name} {values[0]} and {values[1]}; needed: one")
    first = rows.iloc[0]
    loop = first.get("delta_e_below_40hz_um", np.nan)
    travel = first.get("travel_km", np.nan)
    flag = str(first.get("baseline", "")).strip().lower()
    metadata = Metadata(
        stage=str(first["stage"]),
        recorded_at=first["recorded_at"],
        travel=None if np.isnan(travel) else float(travel) * _KM,
        covariates={c: float(first[c]) for c in covariates if np.isfinite(first[c])},
        servo_id=str(first["servo_id"]) or None,
        baseline=flag in ("true", "1", "yes") if flag else None,
    )
    frequency = rows["frequency_hz"].to_numpy(float)
    damping = rows["damping_ratio"].to_numpy(float)
    n = frequency.size
    modes = Modes(
        names=tuple(rows["mode"]),
        sources=tuple(rows["source"]),
        channels=tuple(rows["channel"]) if "channel" in rows.columns else ("",) * n,
        ln_frequency=np.log(frequency),
        ln_damping=np.log(damping),
        cov=_covariance(path, log, rows, terms),
        snr=rows["snr"].to_numpy(float) if "snr" in rows.columns else np.full(n, np.nan),
        dispersion=np.full(n, np.nan),
        flags=("",) * n,
        shape_channels=tuple(name[len(_SHAPE) :] for name in shapes),
        shapes=rows[list(shapes)].to_numpy(float),
        lines=(),
        refused=(),
    )
    loop_error = float(loop) * _MICRO if np.isfinite(loop) and loop > 0 else None
    return LogEstimates(log, "", metadata, modes, loop_error)


def _covariance(path: Path, log: str, rows: pd.DataFrame, terms: pd.DataFrame | None) -> FloatArray:
    """Covariance of ``[ln f, ln ζ]`` of one log, ``(2 n, 2 n)``, NaN where ln ζ is unknown."""
    n = len(rows)
    std_f = (rows["frequency_std_hz"] / rows["frequency_hz"]).to_numpy(float)
    std_z = (rows["damping_ratio_std"] / rows["damping_ratio"]).to_numpy(float)
    cov = np.diag(np.concatenate([std_f, std_z]) ** 2)
    if "correlation_f_zeta" in rows.columns:
        rho = rows["correlation_f_zeta"].fillna(0.0).to_numpy(float)
        if (np.abs(rho) >= 1).any():
            raise BadTable(f"{path}: log {log}: correlation_f_zeta reaches 1; needed is less")
        i = np.arange(n)
        cov[i, n + i] = cov[n + i, i] = rho * std_f * std_z
    if terms is not None:
        place = {key: i for i, key in enumerate(zip(rows["mode"], rows["source"], strict=True))}
        for term in terms[terms["log"] == log].itertuples():
            a = place.get((str(term.mode_a), str(term.source_a)))
            b = place.get((str(term.mode_b), str(term.source_b)))
            if a is not None and b is not None and a != b:
                cov[a, b] = cov[b, a] = term.cov_ln_f
        if np.linalg.eigvalsh(cov[:n, :n])[0] <= 0:
            raise BadTable(
                f"{path}: log {log}: variances and cross terms are no covariance; its least "
                "eigenvalue is not positive"
            )
    unknown = np.concatenate([np.zeros(n, dtype=bool), np.isnan(std_z)])
    cov[unknown], cov[:, unknown] = np.nan, np.nan
    return cov


_TRACK_KM = 1000.0
# A factor of 20 in frequency; and what drowns in the rounding of ln frequency.
_WIDEST, _TRACK_FINEST = 3.0, 1e-9
_TRACK_NEEDED = ("recorded_at", "mode", "drift", "drift_std")
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
    table = read_rows(path, _TRACK_NEEDED)
    if table.empty:
        raise BadTable(f"{path}: no row; needed is at least one drift")
    notes = []
    notes += name_machine(path, table)
    to_numbers(path, table, ("drift", "drift_std", "travel_km"))
    to_moments(path, table)
    std = table["drift_std"]
    _refuse(path, table, "drift", table["drift"].abs() > _WIDEST, "a change of ln frequency")
    wrong = (std < 0) | (std > _WIDEST) | ((std > 0) & (std < _TRACK_FINEST))
    _refuse(path, table, "drift_std", wrong, "a standard deviation of ln frequency, 0 at baseline")
    nameless = table["stage"].str.strip() == ""
    if nameless.any():
        raise BadTable(f"{path}, {lines(table, nameless)}: stage is empty; needed is a name")
    terms = None
    if cross_terms is not None:
        terms = _read_track_terms(cross_terms, str(table["stage"].iloc[0]))
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


def _read_track_terms(path: Path, only_machine: str) -> pd.DataFrame:
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
        travel[k] = rows["travel_km"].to_numpy(dtype=float) * _TRACK_KM
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
