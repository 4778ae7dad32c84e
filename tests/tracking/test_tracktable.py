"""Tables of drifts: what is read, what is assumed and said, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lmshealth.errors import BadTable
from lmshealth.report.tables import COLUMNS, frame, track_cov_rows, track_rows
from lmshealth.tracking.read_tables import read_drifts
from tests.lives import make_track

HEAD = "stage,recorded_at,travel_km,mode,drift,drift_std\n"
ROW = "AX-1,2026-03-{day:02d}T06:00:00+00:00,{km},{mode},{drift},{std}\n"
TERMS = "stage,recorded_at,mode_a,mode_b,cov_drift\n"
TERM = "AX-1,2026-03-{day:02d}T06:00:00+00:00,roll,pitch,{cov}\n"


def write(tmp_path: Path, text: str, terms: str = "") -> tuple[Path, Path | None]:
    """Write a table, and its cross terms where there are any."""
    path, cross = tmp_path / "track.csv", tmp_path / "track_cov.csv"
    path.write_text(text)
    cross.write_text(TERMS + terms)
    return path, cross if terms else None


def row(day: int = 1, mode: str = "roll", drift: object = -0.01, std: object = 1e-3) -> str:
    """Write one row."""
    return ROW.format(day=day, km=10 * day, mode=mode, drift=drift, std=std)


def test_what_a_track_writes_is_read_again(tmp_path: Path) -> None:
    """Drifts, covariances, moments and odometer come back as they were; so do missing drifts."""
    rng = np.random.default_rng(1)
    root = 1e-3 * rng.standard_normal((5, 3, 3))
    cov = root @ np.swapaxes(root, 1, 2)
    drift = 0.01 * rng.standard_normal((5, 3))
    drift[0], cov[0] = 0.0, 0.0
    drift[3, 2], cov[3, 2], cov[3, :, 2] = np.nan, np.nan, np.nan
    known = make_track(drift, cov)
    for name, rows in (("track", track_rows(known)), ("track_cov", track_cov_rows(known))):
        frame(COLUMNS[name], rows).to_csv(tmp_path / f"{name}.csv", index=False)
    read = read_drifts(tmp_path / "track.csv", cross_terms=tmp_path / "track_cov.csv")
    (found,) = read.machines
    assert read.notes == ()
    assert (found.stage, found.modes) == (known.stage, known.modes)
    assert found.recorded_at == known.recorded_at
    np.testing.assert_allclose(found.travel, known.travel)
    np.testing.assert_array_equal(found.drift, known.drift)
    np.testing.assert_allclose(found.drift_cov, known.drift_cov, rtol=1e-14)


def test_logs_of_one_moment_are_epochs_of_their_own(tmp_path: Path) -> None:
    """Two logs of one moment keep their drifts and cross terms apart, in their order."""
    text = HEAD + "".join(row(1, mode, d) for d in (-0.01, -0.02) for mode in ("roll", "pitch"))
    path, terms = write(tmp_path, text, TERM.format(day=1, cov=1e-7) + TERM.format(day=1, cov=2e-7))
    (found,) = read_drifts(path, cross_terms=terms).machines
    np.testing.assert_array_equal(found.drift, [[-0.01, -0.01], [-0.02, -0.02]])
    np.testing.assert_array_equal(found.drift_cov[:, 0, 1], [1e-7, 2e-7])


def test_rows_are_put_in_the_order_of_time(tmp_path: Path) -> None:
    """Epochs ascend whatever the order of rows."""
    path, _ = write(tmp_path, HEAD + row(3, drift=-0.03) + row(1) + row(2, drift=-0.02))
    (found,) = read_drifts(path).machines
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
    read = read_drifts(path)
    (found,) = read.machines
    assert found.stage == "mine"
    assert np.isnan(found.travel).all()
    np.testing.assert_allclose(found.drift_cov[0], np.diag([1e-6, 4e-6]))
    assert "one machine, mine" in read.notes[0]
    assert "independent" in read.notes[1]


def test_several_machines_stay_apart(tmp_path: Path) -> None:
    """Every machine has its own drifts, modes and cross terms."""
    other = (row(1, "yaw") + row(2, "yaw")).replace("AX-1", "AX-2")
    text = HEAD + row(1) + row(1, "pitch") + other
    path, terms = write(tmp_path, text, TERM.format(day=1, cov=5e-7))
    one, two = read_drifts(path, cross_terms=terms).machines
    assert (one.modes, two.modes) == (("roll", "pitch"), ("yaw",))
    assert one.drift_cov[0, 0, 1] == 5e-7
    assert two.drift.shape == (2, 1)


@pytest.mark.parametrize(
    ("text", "terms", "told"),
    [
        ("stage;recorded_at\n", "", "parted by commas"),
        (HEAD, "", "no row"),
        (HEAD + row(drift="much"), "", "line 2: drift is no finite number"),
        (HEAD + row() + row(2, std=-1), "", "line 3: drift_std is -1"),
        (HEAD + row() + row(2, std=1e-170), "", "line 3: drift_std is 1e-170"),
        (HEAD + row() + row(2, std=1e200), "", "drift_std is 1e.200; needed is a standard"),
        (HEAD + row(drift=1e300), "", "line 2: drift is 1e.300; needed is a change of ln"),
        (HEAD + row().replace("AX-1", ""), "", "line 2: stage is empty"),
        (HEAD + row().replace("+00:00", ""), "", "needs a time zone"),
        (HEAD + row() + row(mode="pitch"), TERM.format(day=1, cov=1), "are no covariance"),
    ],
)
def test_bad_tables_are_refused_by_their_line(
    tmp_path: Path, text: str, terms: str, told: str
) -> None:
    """Every error names the file and what is wrong where."""
    path, cross = write(tmp_path, text, terms)
    with pytest.raises(BadTable, match=told) as caught:
        read_drifts(path, cross_terms=cross)
    assert "track.csv" in str(caught.value)
