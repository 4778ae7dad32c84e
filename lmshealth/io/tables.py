"""Tables: those next to logs, read row by row, and those of estimates, read as text by columns.

A bad row of a table next to logs is refused alone; a bad cell of a table of estimates
refuses the table. Both are named by their line.
"""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lmshealth._private.files import read_table
from lmshealth.errors import BadTable
from lmshealth.io import constants
from lmshealth.io.log import low_high, parse_moment, possible
from lmshealth.io.refusal import Unusable, listed, repeated

if TYPE_CHECKING:
    import pandas as pd

_MOST_LISTED = 3


class Row(NamedTuple):
    """One row of a table next to logs: its lines, such as ``line 3``, its cells, its fault.

    Cells are stripped, and empty where there is none; a bad row has those that can be split. Bytes
    that are no UTF-8 are kept as surrogates, as in names of files. A good row has no trouble.
    """

    where: str
    cells: dict[str, str]
    trouble: str


def read_sheet(path: Path, needed: Sequence[str]) -> Iterator[Row]:
    """Read a table of comma-separated values row by row, after a header line.

    `Unusable`: ``missing-file``, ``too-large``, ``empty``, and ``columns`` where a needed one is
    missing, or any is there twice.
    """
    try:
        content = read_table(path)
    except OSError as error:
        raise Unusable("missing-file", f"cannot be opened: {error.strerror}") from error
    except ValueError as error:
        raise Unusable("too-large", f"{error}; split it") from error
    if (n_rows := content.count(b"\n") + content.count(b"\r")) > constants.MOST_ROWS:
        raise Unusable("too-large", f"{n_rows} lines, allowed are {constants.MOST_ROWS}; split it")
    text = content.decode("utf-8-sig", "surrogateescape")
    records = _records(io.StringIO(text, newline=None).readlines())
    names = [name.strip() for name in next(records, ("", [], ""))[1]]
    if not names:
        raise Unusable("empty", f"no header line; needed {listed(needed)}")
    wide = len(names) > constants.MOST_CELLS
    if wide or repeated(filter(None, names)) or not set(needed) <= set(names):
        detail = f"needed {listed(needed)}, none twice, and commas between"
        raise Unusable("columns", f"columns are {listed(names)}; {detail}")
    for where, cells, trouble in records:
        stripped = [cell.strip() for cell in cells]
        if not trouble and any(stripped[len(names) :]):
            trouble = f"{len(cells)} cells in {len(names)} columns"
        padded = dict.fromkeys(names, "") | dict(zip(names, stripped, strict=False))
        yield Row(where, padded, trouble)


def _records(lines: list[str]) -> Iterator[tuple[str, list[str], str]]:
    """Yield place, cells and trouble of each record.

    A new reader starts at the line after every record: an open quote would else include all rows
    up to the next one without an error.
    """
    at = 0
    while at < len(lines):
        some = lines[at : at + constants.LONGEST_CELL]
        reader = csv.reader(some, strict=True, skipinitialspace=True)
        try:
            cells, n, trouble = next(reader), reader.line_num, ""
        except csv.Error as error:
            cells, n, trouble = lines[at].split(","), 1, f"no row of a table: {error}"
        where = f"line {at + 1}" if n == 1 else f"lines {at + 1} to {at + n}"
        at += n
        if cells:
            yield where, cells, trouble


def read_rows(path: Path, needed: Sequence[str]) -> "pd.DataFrame":
    """Read a table of estimates as text; `BadTable` if a column is missing or it cannot be read."""
    import pandas as pd  # late, as below: tables next to logs need none of it

    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise BadTable(f"{path}: cannot be read as a table: {error}") from error
    if missing := [name for name in needed if name not in table.columns]:
        hint = "; columns are separated by commas" if len(table.columns) == 1 else ""
        raise BadTable(f"{path}: no column {missing}; there are {list(table.columns)}{hint}")
    return table


def name_machine(path: Path, table: "pd.DataFrame") -> list[str]:
    """Fill in a missing column stage, in place, and return a note of it."""
    if "stage" in table.columns:
        return []
    table["stage"] = path.stem
    return [f"no column stage: all rows are taken for one machine, {path.stem}"]


def lines(table: "pd.DataFrame", wrong: "pd.Series[bool]") -> str:
    """Name the lines of the file that are marked, at most three of them."""
    found = [str(int(i) + 2) for i in table.index[wrong]]
    more = f" and {len(found) - _MOST_LISTED} more" if len(found) > _MOST_LISTED else ""
    return f"line {', '.join(found[:_MOST_LISTED])}{more}"


def to_numbers(path: Path, table: "pd.DataFrame", names: Iterable[str]) -> None:
    """Convert columns to numbers, in place; missing columns are ignored, empty cells are NaN.

    Any other cell raises `BadTable`, and so does a number out of the range of its column.
    """
    import pandas as pd

    for name in [name for name in names if name in table.columns]:
        text = table[name]
        given = text.str.strip() != ""
        numbers = pd.to_numeric(table[name], errors="coerce")
        if numbers.dtype == float:  # before 3.1 pandas rounds their last digits
            known = np.isfinite(numbers)
            numbers[known] = table[name][known].astype(float)
        table[name] = numbers
        for wrong, needed in (
            (~np.isfinite(numbers), "a finite number"),
            (~numbers.between(*low_high(name)), possible(name)),
        ):
            if (wrong := wrong & given).any():
                what = f"{name} is {text[wrong].iloc[0][:80]!a}, needed {needed}"
                raise BadTable(f"{path}, {lines(table, wrong)}: {what}")


def to_moments(path: Path, table: "pd.DataFrame", latest: datetime | None = None) -> None:
    """Convert the column recorded_at to dates with time zone, in place, or raise `BadTable`.

    Those after `latest` are refused, too (`parse_moment`).
    """
    import pandas as pd

    moments = []
    for index, text in zip(table.index, table["recorded_at"], strict=True):
        try:
            moment = parse_moment({"recorded_at": text}, latest)
        except Unusable as error:
            raise BadTable(f"{path}, line {int(index) + 2}: {error.detail}") from error
        if moment is None:
            raise BadTable(f"{path}, line {int(index) + 2}: recorded_at is empty")
        moments.append(moment)
    # Of another type pandas would make Timestamps of them.
    table["recorded_at"] = pd.Series(moments, table.index, dtype=object)
