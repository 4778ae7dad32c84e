"""Tables that lie beside logs: read row by row, so that a bad row costs itself and no other.

Tables that others wrote, read row by row: what is missing or wrong is named by its line.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from lmshealth.errors import BadTable
from lmshealth.io import constants
from lmshealth.io.refusal import Unusable, listed

# A cell of more lines than these is a quote that was never closed.
_MOST_LINES = 50


class Row(NamedTuple):
    """One row of a table.

    Attributes
    ----------
    where : str
        The lines of the file that it takes, such as ``line 3``.
    cells : dict of str to str
        By column, stripped, empty where there is none; of a bad row what can be told apart. Bytes
        that are no UTF-8 stay what they are, as in names of files.
    trouble : str
        What is wrong with it; empty for a good row.
    """

    where: str
    cells: dict[str, str]
    trouble: str


def read_sheet(path: Path, needed: Sequence[str]) -> Iterator[Row]:
    """Read a table row by row.

    Parameters
    ----------
    path : Path
        Comma-separated values with a header line.
    needed : sequence of str
        Columns that must be there.

    Raises
    ------
    Unusable
        With the reasons ``missing-file``, ``too-large``, ``empty``, and ``columns`` where one is
        missing or stands there twice.
    """
    records = _records(_lines(path))
    names = [name.strip() for name in next(records, ("", [], ""))[1]]
    if not names:
        raise Unusable("empty", f"no header line; needed {listed(needed)}")
    twice = {name for name in names if name and names.count(name) > 1}
    if twice or not set(needed) <= set(names):
        raise Unusable(
            "columns",
            f"columns are {listed(names)}; needed {listed(needed)}, none twice, and commas between",
        )
    for where, cells, trouble in records:
        stripped = [cell.strip() for cell in cells]
        if not trouble and any(stripped[len(names) :]):
            trouble = f"{len(cells)} cells in {len(names)} columns"
        stripped += [""] * (len(names) - len(cells))
        yield Row(where, dict(zip(names, stripped, strict=False)), trouble)


def _lines(path: Path) -> list[str]:
    try:
        if (size := path.stat().st_size) > constants.SMALL_ENOUGH:
            raise Unusable(
                "too-large", f"{size} bytes, allowed are {constants.SMALL_ENOUGH}; split it"
            )
        text = path.read_bytes().decode("utf-8-sig", "surrogateescape")
    except OSError as error:
        raise Unusable("missing-file", f"cannot be opened: {error.strerror}") from error
    return io.StringIO(text, newline=None).readlines()


def _records(lines: list[str]) -> Iterator[tuple[str, list[str], str]]:
    """Yield place, cells and trouble of each record.

    Every record begins anew at the line after the last: else an open quote would swallow all rows
    up to the next one, and nobody would miss them.
    """
    at = 0
    while at < len(lines):
        reader = csv.reader(lines[at : at + _MOST_LINES], strict=True, skipinitialspace=True)
        try:
            cells, n, trouble = next(reader), reader.line_num, ""
        except csv.Error as error:
            cells, n, trouble = lines[at].split(","), 1, f"no row of a table: {error}"
        where = f"line {at + 1}" if n == 1 else f"lines {at + 1} to {at + n}"
        at += n
        if cells:
            yield where, cells, trouble


_TOLD = 3


def read_rows(path: Path, needed: Sequence[str]) -> pd.DataFrame:
    """Read a table as text, cell by cell.

    Raises
    ------
    BadTable
        If it cannot be read, or a column is missing.
    """
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise BadTable(f"{path}: cannot be read as a table: {error}") from error
    missing = [name for name in needed if name not in table.columns]
    if missing:
        told = "; columns are parted by commas" if len(table.columns) == 1 else ""
        raise BadTable(f"{path}: no column {missing}; there are {list(table.columns)}{told}")
    return table


def name_machine(path: Path, table: pd.DataFrame) -> list[str]:
    """Fill in the column stage where there is none, in place, and give the note that says so."""
    if "stage" in table.columns:
        return []
    table["stage"] = path.stem
    return [f"no column stage: all rows are taken for one machine, {path.stem}"]


def lines(table: pd.DataFrame, wrong: pd.Series[bool]) -> str:
    """Name the first lines of the file that are meant."""
    found = [str(int(i) + 2) for i in table.index[wrong]]
    more = f" and {len(found) - _TOLD} more" if len(found) > _TOLD else ""
    return f"line {', '.join(found[:_TOLD])}{more}"


def to_numbers(path: Path, table: pd.DataFrame, names: Iterable[str]) -> None:
    """Turn columns that are there into numbers, in place; empty cells into NaN.

    Raises
    ------
    BadTable
        If a cell holds something else.
    """
    for name in names:
        if name not in table.columns:
            continue
        given = table[name].str.strip() != ""
        table[name] = pd.to_numeric(table[name], errors="coerce")
        wrong = given & ~np.isfinite(table[name])
        if wrong.any():
            raise BadTable(f"{path}, {lines(table, wrong)}: {name} is no finite number")


def to_moments(path: Path, table: pd.DataFrame) -> None:
    """Turn the column recorded_at into moments, in place.

    Raises
    ------
    BadTable
        If one is no ISO date with time zone.
    """
    table["recorded_at"] = [_moment(path, i, text) for i, text in table["recorded_at"].items()]


def _moment(path: Path, index: Any, text: str) -> datetime:
    where = f"{path}, line {int(index) + 2}: recorded_at {text!r}"
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise BadTable(f"{where} is no ISO date, such as 2026-03-01T06:00:00+00:00") from error
    if moment.tzinfo is None:
        raise BadTable(f"{where} needs a time zone, such as {text}+00:00")
    return moment
