"""Tables that others wrote, read row by row: what is missing or wrong is named by its line."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lmshealth.errors import BadTable

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
