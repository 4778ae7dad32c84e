"""Tables that lie beside logs: read row by row, so that a bad row costs itself and no other."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from lmshealth.readers.raw import SMALL_ENOUGH
from lmshealth.readers.trouble import Unusable, listed

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
        if (size := path.stat().st_size) > SMALL_ENOUGH:
            raise Unusable("too-large", f"{size} bytes, allowed are {SMALL_ENOUGH}; split it")
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
