"""Tables of estimates: values read, notes on assumptions, refusals."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lmshealth._private.serialize import fingerprint
from lmshealth.errors import BadTable
from lmshealth.io.constants import LAST_MOMENT
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.report.tables import csv_text, track_tables
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import build_history
from lmshealth.tracking.maintenance import read_work
from lmshealth.tracking.read_tables import read_drifts, read_estimates, read_machines
from tests.lives import FADING, make_stage, make_track

HEAD = "stage,log,recorded_at,travel_km,temperature_c,mode,source,frequency_hz,frequency_std_hz,"
HEAD += "damping_ratio,damping_ratio_std,correlation_f_zeta\n"
ROW = "AX-1,{log},2026-03-{day:02d}T06:00:00+00:00,{km},21.5,{mode},{source},{f},{std},0.02,0.001,"
ROW += "{rho}\n"


def row(**changes: object) -> str:
    """Write one row of a table."""
    parts: dict[str, object] = {
        "log": "a", "day": 1, "km": 10, "mode": "roll", "source": "acc", "f": 126.4, "std": 0.1,
        "rho": 0.5,
    }  # fmt: skip
    return ROW.format(**(parts | changes))


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    """Two tracked modes, roll and pitch."""
    return make_stage(tmp_path / "stage", (FADING,))


def _write(tmp_path: Path, text: str, terms: str) -> tuple[Path, Path | None]:
    path, cross = tmp_path / "modes.csv", tmp_path / "modes_cov.csv"
    path.write_text(text)
    cross.write_text("log,source_a,mode_a,source_b,mode_b,cov_ln_f\n" + terms)
    return path, cross if terms else None


def read(
    tmp_path: Path, text: str, terms: str = "", stage: Stage | None = None
) -> list[LogEstimates]:
    """Write tables and read them."""
    path, cross = _write(tmp_path, text, terms)
    return read_estimates(path, cross_terms=cross, stage=stage)[0]


def notes(tmp_path: Path, text: str, terms: str = "") -> str:
    """Read tables and return its notes."""
    path, cross = _write(tmp_path, text, terms)
    return "\n".join(read_estimates(path, cross_terms=cross)[1])


def test_the_sample_rate_of_a_log_is_read(tmp_path: Path) -> None:
    """A table may state the sample rate of its logs, which then are compared with each other."""
    text = HEAD.strip() + ",sample_rate_hz\n" + row().strip() + ",20000\n"
    assert [log.sample_rate for log in read(tmp_path, text)] == [20_000.0]
    assert [log.sample_rate for log in read(tmp_path, HEAD + row())] == [None]


@pytest.mark.parametrize(
    ("flag", "means"),
    [("true", True), ("TRUE", True), ("1.0", True), ("no", False), ("0", False), ("", None)],
)
def test_a_flag_of_the_baseline_is_read(tmp_path: Path, flag: str, means: bool | None) -> None:
    """As people and programs write it; a column of 1 and nothing is one of numbers for pandas."""
    text = HEAD.strip() + ",baseline\n" + row().strip() + f",{flag}\n"
    assert [log.metadata.baseline for log in read(tmp_path, text)] == [means]


def test_a_flag_that_is_none_is_refused(tmp_path: Path) -> None:
    """It would else be taken for false, and percentages refer to another log."""
    text = HEAD.strip() + ",baseline\n" + row().strip() + ",wahr\n"
    with pytest.raises(BadTable, match="log a has baseline wahr; needed: true or false"):
        read(tmp_path, text)


def test_a_row_becomes_an_estimate_in_si_units(tmp_path: Path) -> None:
    """Hz become ln f with its relative standard deviation; km become m."""
    (reading,) = read(tmp_path, HEAD + row() + row(mode="pitch", f=136.6, std=0.2, rho=0))
    assert reading.metadata.travel == 10_000
    assert reading.metadata.covariates == {"temperature_c": 21.5}
    assert reading.modes.names == ("roll", "pitch")
    np.testing.assert_allclose(reading.modes.frequency, [126.4, 136.6])
    np.testing.assert_allclose(reading.modes.frequency_std, [0.1, 0.2])
    np.testing.assert_allclose(reading.modes.damping_ratio_std, [0.001, 0.001])
    np.testing.assert_allclose(reading.modes.correlation, [0.5, 0.0])


def test_dates_of_one_offset_are_plain_datetimes(tmp_path: Path) -> None:
    """Pandas makes Timestamps of a column of dates: a history of them could not be packed."""
    text = HEAD + "".join(row(log=f"{k}", day=k + 1) for k in range(3))
    readings = read(tmp_path, text)
    assert {type(one.metadata.recorded_at) for one in readings} == {datetime}
    history, _ = build_history(readings)
    stamped = replace(history, recorded_at=tuple(map(pd.Timestamp, history.recorded_at)))
    assert {type(moment) for moment in stamped.recorded_at} == {datetime}
    assert fingerprint(stamped) == fingerprint(history)
    terms = tmp_path / "none.csv"
    terms.write_text("recorded_at,mode_a,mode_b,cov_drift\n")
    (tmp_path / "track.csv").write_text(DRIFT_HEAD + drift_row())
    (drifts,), _ = read_drifts(tmp_path / "track.csv", cross_terms=terms)
    assert {type(moment) for moment in drifts.recorded_at} == {datetime}
    fingerprint(drifts)


def test_logs_of_the_future_are_refused_unless_allowed(tmp_path: Path) -> None:
    """The moment up to which dates are accepted holds for estimates, drifts and maintenance."""
    path, late = tmp_path / "modes.csv", "2062-03-01T06:00:00+00:00"
    path.write_text(HEAD + row().replace("2026-", "2062-"))
    with pytest.raises(BadTable, match=r"modes.csv, line 2: recorded_at is '2062-.*allow-future"):
        read_machines(path)
    work = tmp_path / "maintenance.csv"
    work.write_text(f"stage,recorded_at,action\nAX-1,{late},servo\n")
    with pytest.raises(BadTable, match=r"maintenance.csv, line 2: recorded_at is '2062-"):
        read_work(work)
    ((history, _),), _ = read_machines(path, latest=LAST_MOMENT, work=read_work(work, LAST_MOMENT))
    assert history.recorded_at[0].year == 2062
    drifts = tmp_path / "track.csv"
    drifts.write_text(DRIFT_HEAD + drift_row().replace("2026-", "2062-"))
    with pytest.raises(BadTable, match=r"track.csv, line 2: recorded_at is '2062-"):
        read_drifts(drifts)
    assert read_drifts(drifts, latest=LAST_MOMENT)[0][0].recorded_at[0].year == 2062


@pytest.mark.parametrize("end", [",\n", " , \n , ,,,,,,,,,,\n", "\n,,,,,,,,,,,\n,,,,,,,,,,,\n"])
def test_empty_cells_at_the_ends_of_lines_and_empty_rows_are_left_out(
    tmp_path: Path, end: str
) -> None:
    """Programs end lines with a delimiter, spreadsheets a table with empty rows."""
    (plain,) = read(tmp_path, HEAD + row())
    (found,) = read(tmp_path, HEAD + row().replace("\n", end))
    assert fingerprint(found) == fingerprint(plain)


def test_a_damping_that_is_not_used_leaves_machines_apart(tmp_path: Path) -> None:
    """Two machines have a log of one name; cross terms name their machine."""
    text = "".join(
        own.replace("AX-1", machine)
        for machine in ("AX-1", "AX-2")
        for own in (row(), row(source="delta_e"))
    )
    path, cross = tmp_path / "modes.csv", tmp_path / "modes_cov.csv"
    cross.write_text(
        "stage,log,source_a,mode_a,source_b,mode_b,cov_ln_f\nAX-1,a,acc,roll,delta_e,roll,1e-8\n"
    )
    for changed in (text, text.replace("0.02,0.001", "-0.02,0.001", 1)):
        path.write_text(HEAD + changed)
        one, two = (log.modes.cov[0, 1] for log in read_estimates(path, cross_terms=cross)[0])
        assert (one, two) == (1e-8, 0.0)


def test_cross_terms_enter_the_covariance_of_their_log(tmp_path: Path) -> None:
    """Cross terms of other logs, and of estimates that do not exist, are ignored."""
    text = HEAD + row() + row(mode="pitch") + row(log="b", day=2)
    terms = "a,acc,roll,acc,pitch,3e-7\nb,acc,roll,acc,pitch,4e-7\n"
    first, second = read(tmp_path, text, terms)
    assert first.modes.cov[0, 1] == first.modes.cov[1, 0] == 3e-7
    assert second.modes.cov.shape == (2, 2)


def test_cross_terms_are_of_their_machine(tmp_path: Path) -> None:
    """Two machines have a log of one name: the column stage is needed, and says which is meant."""
    own = HEAD + row() + row(mode="pitch")
    text = own + (row() + row(mode="pitch")).replace("AX-1", "AX-2")
    with pytest.raises(BadTable, match="several machines have a log a; needed is a column stage"):
        read(tmp_path, text, "a,acc,roll,acc,pitch,3e-7\n")
    (tmp_path / "named.csv").write_text(
        "stage,log,source_a,mode_a,source_b,mode_b,cov_ln_f\nAX-2,a,acc,roll,acc,pitch,3e-7\n"
    )
    (tmp_path / "modes.csv").write_text(text)
    logs, _ = read_estimates(tmp_path / "modes.csv", cross_terms=tmp_path / "named.csv")
    assert {one.metadata.stage: one.modes.cov[0, 1] for one in logs} == {"AX-1": 0.0, "AX-2": 3e-7}


def test_another_program_needs_three_columns(tmp_path: Path) -> None:
    """The notes list what is assumed without names, sources, odometer and damping."""
    text = "recorded_at,frequency_hz,frequency_std_hz\n2026-03-01T06:00:00Z,126.4,0.1\n"
    (reading,) = read(tmp_path, text)
    assert reading.modes.names == ("",)
    assert reading.modes.sources == ("unknown",)
    assert reading.metadata.travel is None
    assert np.isnan(reading.modes.ln_damping).all()
    assert np.isnan(reading.modes.cov[1]).all()
    assert "no column stage" in notes(tmp_path, text)


def test_assumptions_are_noted(tmp_path: Path) -> None:
    """Notes: order of time, dampings without a standard deviation, sources without cross terms."""
    text = HEAD + row(day=2) + row(log="b", day=1)
    assert "not in the order of time" in notes(tmp_path, text)
    text = HEAD + row().replace("0.02,0.001", "0.02,")
    assert "1 damping ratios" in notes(tmp_path, text)
    assert "line 2" in notes(tmp_path, text)
    text = HEAD + row() + row(source="delta_e")
    assert "add modes_cov.csv" in notes(tmp_path, text)
    terms = "a,acc,roll,delta_e,roll,1e-8\n"
    assert notes(tmp_path, text, terms) == ""
    told = notes(tmp_path, text, terms.replace("delta_e,roll", "delta_e,heave"))
    assert "1 of 1 cross terms are of estimates that the table does not have (line 2)" in told
    assert "add modes_cov.csv" in told
    text = HEAD + row(day=2) + row(log="b", day=1).replace("AX-1", "AX-2")
    assert notes(tmp_path, text) == ""
    assert notes(tmp_path, HEAD + row()) == ""


@pytest.mark.parametrize(
    ("text", "needle"),
    [
        (HEAD, "no row"),
        ("recorded_at,frequency_hz\n2026-03-01T06:00:00Z,1\n", "no column ['frequency_std_hz']"),
        (HEAD + row(std=""), "line 2: frequency_std_hz is missing"),
        (HEAD + row(std=-0.1), "line 2: frequency_std_hz is -0.1"),
        (
            HEAD + row(std=1e-9),
            "line 2: frequency_std_hz is 1e-09; needed is one that a measurement can have",
        ),
        ("recorded_at;frequency_hz\n1;2\n", "columns are separated by commas"),
        (HEAD + row(f=0), "line 2: frequency_hz is 0"),
        (HEAD + row(f="fast"), "line 2: frequency_hz is 'fast', needed a finite number"),
        (HEAD + row(f="inf"), "line 2: frequency_hz is 'inf', needed a finite number"),
        (HEAD + row(f="1e300"), "line 2: frequency_hz is '1e300', needed a number from"),
        (HEAD + row(f="1e12"), "line 2: frequency_hz is '1e12', needed a number from 0 to 1e+11"),
        (HEAD + row(km=1e300), "line 2: travel_km is '1e+300', needed a number from 0 to 1e+10"),
        (HEAD + row(km=-1), "line 2: travel_km is '-1', needed a number from 0 to 1e+10"),
        (HEAD + row().replace("2026", "1969"), "line 2: recorded_at is '1969-"),
        (HEAD + row().replace("2026", "9999"), "line 2: recorded_at is '9999-"),
        (HEAD + row().replace("2026", "2099"), "in the future; correct it, or set --allow-future"),
        (HEAD + row() + row(), "line 2, 3: roll by acc exists twice"),
        (HEAD + row(mode="") + row(mode="", f=80) + row(mode=""), "line 2, 4: 126.4 Hz exists twi"),
        (HEAD + row().replace("AX-1", " "), "line 2: stage is empty; needed is a name"),
        (HEAD.replace("source", "mode") + row(), "columns ['mode'] are there twice"),
        (HEAD + row().replace("\n", ",9\n"), "line 2: 13 cells in 12 columns"),
        (HEAD + row().replace("\n", ",,\n"), "cannot be read as a table: Length of header"),
        (
            "recorded_at;frequency_hz;frequency_std_hz\n2026-03-01T06:00:00Z;126,4;0,1\n",
            "there are ['recorded_at;frequency_hz;frequency_std_hz']; columns are separated by com",
        ),
        (HEAD + row() + row(log="b", day=2).replace("\n", ",\n"), "Expected 12 fields in line 3"),
        (HEAD + row() + row(mode="pitch", km=11), "log a has travel_km 10 and 11"),
        (HEAD + row(rho=1.0), "correlation_f_zeta reaches 1"),
        (HEAD + row().replace("+00:00", ""), "ISO 8601 with a time zone"),
        (HEAD + row().replace("2026-03-01T", "1.3.2026 "), "needed ISO 8601"),
    ],
)
def test_values_that_are_not_valid_are_refused_with_their_line(
    tmp_path: Path, text: str, needle: str
) -> None:
    """The error states the file, the line, the value and what is needed."""
    with pytest.raises(BadTable, match=r"modes\.csv") as caught:
        read(tmp_path, text)
    assert needle in str(caught.value)


def test_cross_terms_that_are_no_covariance_are_refused(tmp_path: Path) -> None:
    """A correlation above one, a text and a missing column are named."""
    text = HEAD + row() + row(mode="pitch")
    with pytest.raises(BadTable, match="log a: variances and cross terms are no covariance"):
        read(tmp_path, text, "a,acc,roll,acc,pitch,1e-3\n")
    with pytest.raises(BadTable, match="cov_ln_f is 'x', needed a finite number"):
        read(tmp_path, text, "a,acc,roll,acc,pitch,x\n")


def test_names_that_the_stage_does_not_know_are_refused(tmp_path: Path, stage: Stage) -> None:
    """The error lists the modes of the stage and the next step."""
    with pytest.raises(BadTable, match=r"modes \['shaker'\] are none of small") as caught:
        read(tmp_path, HEAD + row(mode="shaker"), stage=stage)
    assert "leave the column mode empty" in str(caught.value)


DRIFT_HEAD = "stage,recorded_at,travel_km,mode,drift,drift_std\n"
DRIFT_ROW = "AX-1,2026-03-{day:02d}T06:00:00+00:00,{km},{mode},{drift},{std}\n"
DRIFT_TERMS = "stage,recorded_at,mode_a,mode_b,cov_drift\n"
DRIFT_TERM = "AX-1,2026-03-{day:02d}T06:00:00+00:00,roll,pitch,{cov}\n"


def write_drifts(tmp_path: Path, text: str, terms: str = "") -> tuple[Path, Path | None]:
    """Write a table, and its cross terms where there are any."""
    path, cross = tmp_path / "track.csv", tmp_path / "track_cov.csv"
    path.write_text(text)
    cross.write_text(DRIFT_TERMS + terms)
    return path, cross if terms else None


def drift_row(day: int = 1, mode: str = "roll", drift: object = -0.01, std: object = 1e-3) -> str:
    """Write one drift_row."""
    return DRIFT_ROW.format(day=day, km=10 * day, mode=mode, drift=drift, std=std)


def test_what_a_track_writes_is_read_again(tmp_path: Path) -> None:
    """Drifts, covariances, moments and odometer are read as written; so are missing drifts."""
    rng = np.random.default_rng(1)
    root = 1e-3 * rng.standard_normal((5, 3, 3))
    cov = root @ np.swapaxes(root, 1, 2)
    drift = 0.01 * rng.standard_normal((5, 3))
    drift[0], cov[0] = 0.0, 0.0
    drift[3, 2], cov[3, 2], cov[3, :, 2] = np.nan, np.nan, np.nan
    known = make_track(drift, cov)
    for name, rows in track_tables(known).items():
        (tmp_path / f"{name}.csv").write_text(csv_text(name, rows), encoding="utf-8")
    (found,), notes = read_drifts(tmp_path / "track.csv", cross_terms=tmp_path / "track_cov.csv")
    assert notes == []
    assert (found.stage, found.modes) == (known.stage, known.modes)
    assert found.recorded_at == known.recorded_at
    np.testing.assert_allclose(found.travel, known.travel)
    np.testing.assert_array_equal(found.drift, known.drift)
    np.testing.assert_allclose(found.drift_cov, known.drift_cov, rtol=1e-14)


def test_logs_of_one_moment_are_epochs_of_their_own(tmp_path: Path) -> None:
    """Two logs of one moment have separate drifts and cross terms, in their order."""
    text = DRIFT_HEAD + "".join(
        drift_row(1, mode, d) for d in (-0.01, -0.02) for mode in ("roll", "pitch")
    )
    path, terms = write_drifts(
        tmp_path, text, DRIFT_TERM.format(day=1, cov=1e-7) + DRIFT_TERM.format(day=1, cov=2e-7)
    )
    (found,), _ = read_drifts(path, cross_terms=terms)
    np.testing.assert_array_equal(found.drift, [[-0.01, -0.01], [-0.02, -0.02]])
    np.testing.assert_array_equal(found.drift_cov[:, 0, 1], [1e-7, 2e-7])


def test_rows_are_put_in_the_order_of_time(tmp_path: Path) -> None:
    """Epochs ascend for any order of rows."""
    path, _ = write_drifts(
        tmp_path, DRIFT_HEAD + drift_row(3, drift=-0.03) + drift_row(1) + drift_row(2, drift=-0.02)
    )
    (found,), _ = read_drifts(path)
    np.testing.assert_array_equal(found.drift[:, 0], [-0.01, -0.02, -0.03])
    np.testing.assert_array_equal(found.travel, [1e4, 2e4, 3e4])


def test_what_is_missing_is_assumed_and_said(tmp_path: Path) -> None:
    """Without stage and cross terms: one machine, independent drifts, no odometer; two notes."""
    table = pd.DataFrame(
        {
            "recorded_at": ["2026-03-01T06:00:00Z"] * 2,
            "mode": ["roll", "pitch"],
            "drift": [-0.01, -0.02],
            "drift_std": [1e-3, 2e-3],
        }
    )
    path = tmp_path / "mine.csv"
    table.to_csv(path, index=False)
    (found,), notes = read_drifts(path)
    assert found.stage == "mine"
    assert np.isnan(found.travel).all()
    np.testing.assert_allclose(found.drift_cov[0], np.diag([1e-6, 4e-6]))
    assert "one machine, mine" in notes[0]
    assert "independent" in notes[1]


def test_several_machines_stay_apart(tmp_path: Path) -> None:
    """Every machine has its own drifts, modes and cross terms."""
    other = (drift_row(1, "yaw") + drift_row(2, "yaw")).replace("AX-1", "AX-2")
    text = DRIFT_HEAD + drift_row(1) + drift_row(1, "pitch") + other
    path, terms = write_drifts(tmp_path, text, DRIFT_TERM.format(day=1, cov=5e-7))
    (one, two), _ = read_drifts(path, cross_terms=terms)
    assert (one.modes, two.modes) == (("roll", "pitch"), ("yaw",))
    assert one.drift_cov[0, 0, 1] == 5e-7
    assert two.drift.shape == (2, 1)


@pytest.mark.parametrize(
    ("text", "terms", "told"),
    [
        ("stage;recorded_at\n", "", "separated by commas"),
        (DRIFT_HEAD, "", "no row"),
        (
            DRIFT_HEAD + drift_row(drift="much"),
            "",
            "line 2: drift is 'much', needed a finite number",
        ),
        (DRIFT_HEAD + drift_row() + drift_row(2, std=-1), "", "line 3: drift_std is -1"),
        (DRIFT_HEAD + drift_row() + drift_row(2, std=1e-170), "", "line 3: drift_std is 1e-170"),
        (
            DRIFT_HEAD + drift_row() + drift_row(2, std=1e20),
            "",
            "drift_std is 1e.20; needed is a standard",
        ),
        (
            DRIFT_HEAD + drift_row(drift=1e30),
            "",
            "line 2: drift is 1e.30; needed is a change of ln",
        ),
        (DRIFT_HEAD + drift_row().replace("AX-1", ""), "", "line 2: stage is empty"),
        (DRIFT_HEAD + drift_row().replace("+00:00", ""), "", "ISO 8601 with a time zone"),
        (DRIFT_HEAD + 2 * drift_row(), "", "line 2, 3: the drift of roll at .* exists twice"),
        (
            DRIFT_HEAD + drift_row() + drift_row(mode="pitch"),
            DRIFT_TERM.format(day=1, cov=1),
            "are no covariance",
        ),
    ],
)
def test_bad_tables_are_refused_by_their_line(
    tmp_path: Path, text: str, terms: str, told: str
) -> None:
    """Every error states the file, the place and the fault."""
    path, cross = write_drifts(tmp_path, text, terms)
    with pytest.raises(BadTable, match=told) as caught:
        read_drifts(path, cross_terms=cross)
    assert "track.csv" in str(caught.value)
