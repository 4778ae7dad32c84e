"""Tables of modal estimates or of drifts, ours or another program's.

`read_estimates` and `read_machines` read the columns of ``modes.csv``, `read_drifts` those of
``track.csv``. Missing columns are noted; contradictions are refused with their lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, freeze
from lmshealth.errors import BadTable
from lmshealth.io.log import BOOLEANS, Metadata, Refusal
from lmshealth.io.log import covariates as known_covariates
from lmshealth.io.manifest import lines, name_machine, read_rows, to_moments, to_numbers
from lmshealth.io.refusal import listed
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.modes import Modes
from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.history import History, build_history
from lmshealth.tracking.maintenance import NO_MAINTENANCE, Maintenance, without_logs

if TYPE_CHECKING:
    import pandas as pd

_KM, _MILLI, _MICRO = 1000.0, 1e-3, 1e-6
_NEEDED = ("recorded_at", "frequency_hz", "frequency_std_hz")
_DAMPING = ("damping_ratio", "damping_ratio_std")
_NUMBERS = (*_NEEDED[1:], *_DAMPING, "travel_km", "correlation_f_zeta", "snr", "excitation_mm_s2")
_RATE = "sample_rate_hz"
_LOOP = "delta_e_below_40hz_um"
# Columns that have one value per log.
_OF_LOG = ("stage", "recorded_at", "travel_km", "servo_id", _LOOP, _RATE, "baseline")
# Columns of text that may be missing, and what is assumed instead.
_TEXTS = {"mode": "", "source": "unknown", "servo_id": "", "channel": "", "baseline": ""}
# The column that only tables of drifts have.
_DRIFT = "drift"
_CROSS_TERMS = ("log", "source_a", "mode_a", "source_b", "mode_b", "cov_ln_f")
_SHAPE = "shape_"


@dataclass(frozen=True, slots=True, eq=False)
class Drifts:
    """The drifts of one machine, from which health is inferred; fields are as in `Track`."""

    stage: str
    recorded_at: tuple[datetime, ...]
    travel: FloatArray
    modes: tuple[str, ...]
    drift: FloatArray
    drift_cov: FloatArray

    def __post_init__(self) -> None:
        n, m = len(self.recorded_at), len(self.modes)
        freeze(self, ("travel", n), ("drift", n, m), ("drift_cov", n, m, m))


def read_estimates(
    path: Path,
    *,
    cross_terms: Path | None = None,
    stage: Stage | None = None,
    latest: datetime | None = None,
) -> tuple[list[LogEstimates], list[str]]:
    """Read the estimates of each log from a table in the columns of ``modes.csv``.

    Needed are ``recorded_at``, ``frequency_hz`` and ``frequency_std_hz``; a row is one estimate.
    Without ``log`` the rows of one moment are one log, without ``stage`` all are of one machine.

    `cross_terms` are covariances between estimates of one log, in the columns of ``modes_cov.csv``.
    The covariates of the stage are read too, and other mode names than its own are refused.
    `BadTable` if a table cannot be read or is one of drifts, a column is missing, a value is not
    valid, an estimate exists twice, or rows of one log contradict each other. The notes returned
    state what the table lacks, and what is assumed instead. Logs after the moment `latest`, by
    default a day from now, are refused.
    """
    table = _read(path, _NEEDED, "estimate")
    if _DRIFT in table.columns:
        raise BadTable(
            f"{path}: has a column {_DRIFT}, so it is a track: a filter has made its rows depend "
            "on each other; needed are independent estimates, such as modes.csv"
        )
    covariates = [*known_covariates()]
    if stage is not None:
        covariates += [c.name for c in stage.description.covariate if c.name not in covariates]
    shapes = [name for name in table.columns if name.startswith(_SHAPE)]
    to_numbers(path, table, (*_NUMBERS, _LOOP, _RATE, *covariates, *shapes))
    fallbacks = (
        dict.fromkeys((*_NUMBERS, _LOOP, _RATE), np.nan) | _TEXTS | {"log": table["recorded_at"]}
    )
    for name, value in fallbacks.items():
        if name not in table.columns:
            table[name] = value
    has_stage, notes = "stage" in table.columns, name_machine(path, table)
    to_moments(path, table, latest)
    notes += _drop_bad_damping(table)
    _check(path, table, stage)
    terms = None
    if cross_terms is not None:
        terms = read_rows(cross_terms, _CROSS_TERMS)
        to_numbers(cross_terms, terms, ("cov_ln_f",))
        if (empty := terms["cov_ln_f"].isna()).any():
            raise BadTable(f"{cross_terms}, {lines(terms, empty)}: cov_ln_f is empty")
        if not has_stage or "stage" not in terms.columns:  # of one machine, or of that of the log
            machines = table.groupby("log")["stage"].unique()
            if (several := machines.index[machines.str.len() > 1]).size:
                raise BadTable(
                    f"{cross_terms}: several machines have a log {several[0]}; needed is a column "
                    "stage"
                )
            terms["stage"] = terms["log"].map(machines.str[0])
    known = [c for c in covariates if c in table.columns]
    logs = [
        _log(path, str(log), rows, known, shapes, terms)
        for (_, log), rows in table.groupby(["stage", "log"], sort=False)
    ]
    return logs, [*notes, *_order_notes(table), *_term_notes(table, terms)]


def read_machines(
    path: Path,
    stage: Stage | None = None,
    *,
    cross_terms: Path | None = None,
    work: Maintenance = NO_MAINTENANCE,
    latest: datetime | None = None,
) -> tuple[list[tuple[History, list[Refusal]]], list[str]]:
    """Read a table in the columns of ``modes.csv``: a history per machine, with its refusals.

    Parameters are those of `read_estimates`, and the maintenance of all machines; a
    ``modes_cov.csv`` in the same folder has the cross terms if none are given. Raises `BadTable` as
    `read_estimates`.
    """
    default = path.with_name("modes_cov.csv")
    terms = cross_terms or (default if default.exists() else None)
    logs, notes = read_estimates(path, cross_terms=terms, stage=stage, latest=latest)
    own: dict[str, list[LogEstimates]] = {}
    for one in logs:
        own.setdefault(str(one.metadata.stage), []).append(one)
    notes += without_logs(work.actions, own)
    machines = [
        build_history(estimates, stage, work.of(name).actions) for name, estimates in own.items()
    ]
    return machines, notes


def has_drifts(path: Path) -> bool:
    """Return whether a table has drifts, as ``track.csv`` does, rather than estimates."""
    return _DRIFT in read_rows(path, ()).columns


def read_drifts(
    path: Path, *, cross_terms: Path | None = None, latest: datetime | None = None
) -> tuple[list[Drifts], list[str]]:
    """Read the drifts of each machine, and notes, from a table in the columns of ``track.csv``.

    Needed are ``recorded_at``, ``mode``, ``drift`` (of ln frequency against baseline) and
    ``drift_std``. Without ``stage`` all rows are of one machine. `cross_terms` are covariances
    between drifts of one epoch, in the columns of ``track_cov.csv``. `BadTable` if a table cannot
    be read, a column is missing, or a value is not valid.
    """
    table = _read(path, ("recorded_at", "mode", "drift", "drift_std"), "drift")
    notes = name_machine(path, table)
    to_numbers(path, table, ("drift", "drift_std", "travel_km"))
    to_moments(path, table, latest)
    # Without a column log, a drift is there twice only where all cells of two rows are equal.
    of_log = ["stage", "recorded_at", "log", "mode"]
    key = of_log if "log" in table.columns else [*table.columns]
    if (again := table.duplicated(key, keep=False)).any():
        first = table[again].iloc[0]
        when = first["recorded_at"].isoformat()
        raise BadTable(
            f"{path}, {lines(table, again)}: the drift of {first['mode']} at {when} exists twice; "
            "leave one of these rows out"
        )
    std, most = table["drift_std"], constants.MOST_DRIFT
    _refuse(path, table, "drift", table["drift"].abs() > most, "a change of ln frequency")
    wrong = (std < 0) | (std > most) | ((std > 0) & (std < constants.LEAST_DRIFT_STD))
    _refuse(path, table, "drift_std", wrong, "a standard deviation of ln frequency, 0 at baseline")
    terms = None
    if cross_terms is not None:
        terms = read_rows(cross_terms, ("recorded_at", "mode_a", "mode_b", "cov_drift"))
        machines = table["stage"].unique().tolist()
        if "stage" not in terms.columns and len(machines) > 1:
            raise BadTable(
                f"{cross_terms}: needed is a column stage: {path} has {listed(machines)}"
            )
        if "stage" not in terms.columns:
            terms["stage"] = machines[0]
        to_numbers(cross_terms, terms, ("cov_drift",))
        to_moments(cross_terms, terms, latest)
        if (strange := ~terms["stage"].isin(machines)).any():
            found = f"{int(strange.sum())} of {len(terms)} covariances in {cross_terms} are of"
            notes.append(f"{found} machines that the table does not have; they are not used")
    elif table["mode"].nunique() > 1:
        notes.append(
            "no covariances between the drifts of modes: they are assumed independent, though "
            "baseline and temperature are common to them; add track_cov.csv"
        )
    machines = [
        _drifts(path, str(stage), rows, None if terms is None else terms[terms["stage"] == stage])
        for stage, rows in table.groupby("stage", sort=False)
    ]
    return machines, notes


def _read(path: Path, needed: Sequence[str], content: str) -> pd.DataFrame:
    table = read_rows(path, needed)
    if table.empty:
        raise BadTable(f"{path}: no row; needed is at least one {content}")
    return table


def _refuse(path: Path, table: pd.DataFrame, name: str, wrong: pd.Series[bool], what: str) -> None:
    if wrong.any():
        got = table.loc[wrong, name].iloc[0]
        value = "missing" if np.isnan(got) else f"{got:g}"
        raise BadTable(f"{path}, {lines(table, wrong)}: {name} is {value}; needed is {what}")


def _drop_bad_damping(table: pd.DataFrame) -> list[str]:
    """Remove dampings without a positive value and standard deviation, in place."""
    ratio, std = (table[name] for name in _DAMPING)
    relative = (std / ratio).between(constants.LEAST_RELATIVE_STD, constants.MOST_RELATIVE_STD)
    bad = ratio.notna() & ~(ratio.between(*constants.DAMPING) & relative)
    if not bad.any():
        return []
    table.loc[bad, list(_DAMPING)] = np.nan
    return [
        f"{int(bad.sum())} damping ratios without a positive value and standard deviation "
        f"({lines(table, bad)}) are not used; the frequencies of these rows are"
    ]


def _check(path: Path, table: pd.DataFrame, stage: Stage | None) -> None:
    """Refuse estimates that are not valid, exist twice or have an unknown name."""
    std = "the standard deviation of a frequency, without which nothing is known"
    for name, what in (("frequency_hz", "a frequency"), ("frequency_std_hz", std)):
        needed = f"{what}, a positive number; leave rows out that have none"
        _refuse(path, table, name, ~(table[name] > 0), needed)
    named = table[table["mode"] != ""]
    alike = ["stage", "log", "source", "frequency_hz", "frequency_std_hz"]
    alike += ["channel"] if "channel" in table.columns else []
    if (again := (table["mode"] == "") & table.duplicated(alike, keep=False)).any():
        first = table[again].iloc[0]
        raise BadTable(
            f"{path}, {lines(table, again)}: {first['frequency_hz']:g} Hz exists twice for log "
            f"{first['log']}; leave one of these rows out"
        )
    twice = named.duplicated(["stage", "log", "mode", "source"], keep=False)
    if twice.any():
        first = named[twice].iloc[0]
        raise BadTable(
            f"{path}, {lines(named, twice)}: {first['mode']} by {first['source']} exists twice "
            f"for log {first['log']}; leave the column mode empty where names are not unique"
        )
    least = constants.LEAST_RELATIVE_STD
    fine = table["frequency_std_hz"] < least * table["frequency_hz"]
    needed = f"one that a measurement can have, in Hz, not below {least:g} of the frequency"
    _refuse(path, table, "frequency_std_hz", fine, needed)
    if stage is None:
        return
    known = [mode.name for mode in stage.modes]
    if strange := sorted(set(named["mode"]) - set(known)):
        raise BadTable(
            f"{path}: modes {strange} are none of {stage.name}, which has {known}; rename "
            "them, or leave the column mode empty to assign them by their frequency"
        )


def _order_notes(table: pd.DataFrame) -> list[str]:
    """List machines whose logs are not in the order of time."""
    logs = table.drop_duplicates(["stage", "log"])
    return [
        f"{machine}: the logs are not in the order of time; they are sorted"
        for machine, moments in logs.groupby("stage", sort=False)["recorded_at"]
        if not moments.is_monotonic_increasing
    ]


def _term_notes(table: pd.DataFrame, terms: pd.DataFrame | None) -> list[str]:
    """List cross terms that are not used, and logs that need some."""
    import pandas as pd  # late: a run needs none of it

    notes, covered = [], set()
    if terms is not None:
        known = pd.MultiIndex.from_frame(table[["stage", "log", "mode", "source"]])
        used: BoolArray = np.ones(len(terms), dtype=bool)
        for end in ("a", "b"):
            own = terms[["stage", "log", f"mode_{end}", f"source_{end}"]]
            used &= pd.MultiIndex.from_frame(own).isin(known)
        if not used.all():
            notes.append(
                f"{int((~used).sum())} of {used.size} cross terms are of estimates that the table "
                f"does not have ({lines(terms, pd.Series(~used, terms.index))}); they are not used"
            )
        across = terms[used & (terms["source_a"] != terms["source_b"])]
        covered = set(zip(across["stage"], across["log"], strict=True))
    several = table.groupby(["stage", "log"])["source"].nunique() > 1
    lone = [str(own[1]) for own in several.index[several] if own not in covered]
    if lone:
        notes.append(
            f"{len(lone)} logs with several sources, but no covariances between them "
            f"({lone[0]}): their errors are assumed independent, which overstates their common "
            "precision; add modes_cov.csv"
        )
    return notes


def _log(
    path: Path,
    log: str,
    rows: pd.DataFrame,
    covariates: Sequence[str],
    shapes: Sequence[str],
    terms: pd.DataFrame | None,
) -> LogEstimates:
    """Return the estimates of one log from its rows."""
    for name in (*_OF_LOG, *covariates):
        if name in rows.columns and rows[name].nunique(dropna=False) > 1:
            values = list(dict.fromkeys(rows[name]))[:2]
            raise BadTable(f"{path}: log {log} has {name} {values[0]} and {values[1]}; needed: one")
    first = rows.iloc[0]
    loop, travel = float(first[_LOOP]), float(first["travel_km"])
    # Programs that know no empty flag write numbers.
    flag = str(first["baseline"]).strip().lower().removesuffix(".0")
    if flag and flag not in BOOLEANS:
        raise BadTable(f"{path}: log {log} has baseline {first['baseline']}; needed: true or false")
    metadata = Metadata(
        stage=str(first["stage"]).strip(),
        recorded_at=first["recorded_at"],
        travel=None if np.isnan(travel) else travel * _KM,
        covariates={c: float(first[c]) for c in covariates if np.isfinite(first[c])},
        servo_id=str(first["servo_id"]) or None,
        baseline=BOOLEANS.get(flag),
    )
    frequency = rows["frequency_hz"].to_numpy(float)
    damping = rows["damping_ratio"].to_numpy(float)
    n = frequency.size
    modes = Modes(
        names=tuple(rows["mode"]),
        sources=tuple(rows["source"]),
        channels=tuple(rows["channel"]),
        ln_frequency=np.log(frequency),
        ln_damping=np.log(damping),
        cov=_covariance(path, log, rows, terms),
        snr=rows["snr"].to_numpy(float),
        dispersion=np.full(n, np.nan),
        excitation=rows["excitation_mm_s2"].to_numpy(float) * _MILLI,
        flags=("",) * n,
        shape_channels=tuple(name[len(_SHAPE) :] for name in shapes),
        shapes=rows[list(shapes)].to_numpy(float),
        lines=(),
        refused=(),
    )
    loop_error = loop * _MICRO if loop > 0 else None
    rate = float(first[_RATE])
    return LogEstimates(
        log, "", metadata, modes, loop_error, sample_rate=rate if rate > 0 else None
    )


def _covariance(path: Path, log: str, rows: pd.DataFrame, terms: pd.DataFrame | None) -> FloatArray:
    """Return the covariance of ``[ln f, ln ζ]``, ``(2 n, 2 n)``, NaN where ln ζ is unknown."""
    n = len(rows)
    std_f = (rows["frequency_std_hz"] / rows["frequency_hz"]).to_numpy(float)
    std_z = (rows["damping_ratio_std"] / rows["damping_ratio"]).to_numpy(float)
    cov = np.diag(np.concatenate([std_f, std_z]) ** 2)
    rho = rows["correlation_f_zeta"].fillna(0.0).to_numpy(float)
    if (np.abs(rho) >= 1).any():
        raise BadTable(f"{path}: log {log}: correlation_f_zeta reaches 1; needed is less")
    i = np.arange(n)
    cov[i, n + i] = cov[n + i, i] = rho * std_f * std_z
    if terms is not None:
        place = {key: i for i, key in enumerate(zip(rows["mode"], rows["source"], strict=True))}
        own = (terms["log"] == log) & (terms["stage"] == rows["stage"].iloc[0])
        for term in terms[own].itertuples():
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


def _drifts(path: Path, stage: str, rows: pd.DataFrame, terms: pd.DataFrame | None) -> Drifts:
    """Return the drifts of one machine from its rows."""
    # Logs of one moment are epochs of their own, in their order.
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
    # Covariances that no row has are zero.
    cov[known[:, :, None] & known[:, None, :]] = 0.0
    cov[k, i, i] = np.where(known[k, i], rows["drift_std"].to_numpy(dtype=float) ** 2, np.nan)
    if terms is not None:
        turn = terms.groupby(["recorded_at", "mode_a", "mode_b"], sort=False).cumcount()
        moments, values = terms["recorded_at"], terms["cov_drift"]
        ends = (terms[f"mode_{end}"].map(column) for end in ("a", "b"))
        for moment, count, a, b, value in zip(moments, turn, *ends, values, strict=True):
            # Those of other epochs or modes are ignored.
            at = place.get((moment, count))
            if at is not None and np.isfinite([a, b, value]).all() and a != b:
                cov[at, int(a), int(b)] = cov[at, int(b), int(a)] = value
    _expect_covariances(path, stage, cov, epochs)
    travel = np.full(shape[0], np.nan)
    if "travel_km" in rows.columns:
        travel[k] = rows["travel_km"].to_numpy(dtype=float) * _KM
    return Drifts(stage, tuple(moment for moment, _ in epochs), travel, modes, drift, cov)


def _expect_covariances(
    path: Path, stage: str, cov: FloatArray, epochs: Sequence[tuple[datetime, int]]
) -> None:
    """Refuse matrices that are no covariance; that of a baseline is zero."""
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
