"""Outputs: tables of parts, in the order of the machines, complete or not at all."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

from lmshealth._private.serialize import pack
from lmshealth._private.tables import RUN_TABLES, TABLES
from lmshealth.batch.assess import pack_assessment
from lmshealth.batch.run import MachineRecord, machine_output, write_tables
from lmshealth.errors import BadTable
from lmshealth.io.log import Refusal
from lmshealth.report.tables import csv_text, refused_rows
from tests.assessments import worn


def read(path: Path) -> list[dict[str, str]]:
    """Read a table."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def effect(mode: str, **more: Any) -> dict[str, bytes]:
    """Give effects.csv with one row."""
    row = {"stage": "A", "mode": mode, "coefficient": 0.1 + 0.2, "std": float("nan"), **more}
    return {"effects": pack(csv_text("effects", [row]))}


def test_rows_stand_in_the_order_of_the_machines(tmp_path: Path) -> None:
    """In whichever order machines are done; those that never come leave the others their place."""
    packed = {machine: effect(machine) for machine in ("C", "A", "D", "B")}
    write_tables(tmp_path, ["A", "B", "C", "D"], packed)
    assert [row["mode"] for row in read(tmp_path / "effects.csv")] == ["A", "B", "C", "D"]


def test_a_machine_that_never_comes_keeps_no_other_from_its_place(tmp_path: Path) -> None:
    """Rows of machines after one that failed are written nevertheless."""
    packed = {machine: effect(machine) for machine in ("C", "B")}
    write_tables(tmp_path, ["A", "B", "C"], packed)
    assert [row["mode"] for row in read(tmp_path / "effects.csv")] == ["B", "C"]


def test_parts_may_have_columns_of_their_own(tmp_path: Path) -> None:
    """A column that only some rows have is empty in the others, and comes last."""
    tables = {"A": effect("roll", note='two\nlines, "quoted"'), "B": effect("pitch", other=1)}
    write_tables(tmp_path, ["A", "B"], tables)
    one, two = read(tmp_path / "effects.csv")
    assert list(one) == [*TABLES["effects"].names, "note", "other"]
    assert (one["note"], one["other"]) == ('two\nlines, "quoted"', "")
    assert (two["mode"], two["note"], two["other"]) == ("pitch", "", "1")
    assert (float(two["coefficient"]), two["std"]) == (0.1 + 0.2, "")


def test_a_cell_may_hold_any_sign(tmp_path: Path) -> None:
    """What ends a line elsewhere does not end the run, nor take another row along."""
    write_tables(tmp_path, ["A", "B"], {"A": effect("one\rtwo"), "B": effect("pitch")})
    lines = (tmp_path / "effects.csv").read_bytes().decode().split("\n")
    assert ["one\rtwo" in lines[1], "pitch" in lines[2]] == [True, True]


def test_what_belongs_to_no_machine_comes_first(tmp_path: Path) -> None:
    """Refused logs are listed, and tables without rows have their headers."""
    rows = refused_rows([Refusal("a.h5", "empty", "0 bytes")])
    write_tables(tmp_path, [], {"": {"refused": pack(csv_text("refused", rows))}})
    assert [row["log"] for row in read(tmp_path / "refused.csv")] == ["a.h5"]
    for name, table in RUN_TABLES.items():
        head = (tmp_path / f"{name}.csv").read_text(encoding="utf-8").splitlines()[0]
        assert head == ",".join(table.names)


def test_tables_that_are_not_finished_leave_those_of_before(tmp_path: Path) -> None:
    """An error leaves the last complete tables, and no other file in the folder."""
    (tmp_path / "effects.csv").write_text("as it was")
    with pytest.raises(ValueError):
        write_tables(tmp_path, ["A", "B"], {"A": effect("roll"), "B": {"effects": b"damaged"}})
    assert [path.name for path in tmp_path.iterdir()] == ["effects.csv"]
    assert (tmp_path / "effects.csv").read_text() == "as it was"


def test_a_table_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    """What is in its place is named, not the file that was to take it, and nothing is left."""
    (tmp_path / "track.csv").mkdir()
    with pytest.raises(BadTable, match=r"track\.csv: cannot be written: Is a directory$"):
        write_tables(tmp_path, [], {})
    assert not list(tmp_path.glob(".*.part"))


@pytest.mark.slow
def test_a_page_needs_no_logs(tmp_path: Path) -> None:
    """The assessment is enough for the page; one that cannot be decoded has no output."""
    made = pack_assessment(worn(tmp_path))
    output = machine_output(MachineRecord("M7-Y", "M7-Y.html", made.content, None, None))
    assert output is not None
    summary = output.summary
    assert (summary.file, summary.identity) == ("M7-Y.html", "M7-Y")
    assert output.tables == {}
    lost = (("a.h5", b"nonsense"),)
    for assessment, logs in ((b"nonsense", None), (None, None), (made.content, lost)):
        assert machine_output(MachineRecord("M7-Y", "M7-Y.html", assessment, logs, None)) is None
