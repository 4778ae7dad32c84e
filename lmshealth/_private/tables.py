"""Specification of all tables that are written: names, units and meanings of their columns.

It is read from ``tables.toml``. CSV, JSON and terminal tables, tables of pages, frames of results
and ``report/TABLES.md`` are made of it. Names and sentences are as people read them.
"""

from collections.abc import Iterable, Mapping
from datetime import datetime
from functools import cached_property
from importlib import resources
from typing import Any, Literal

import msgspec

Row = dict[str, Any]
TEXTS = ("text", "moment", "day", "flag")
"""Types of columns that are no numbers."""


class Column(msgspec.Struct, frozen=True, array_like=True):
    """One or several columns of a table with a common unit, or type, and meaning."""

    names: str  # separated by blanks
    unit: str  # or a type: text, moment, day, count, flag
    meaning: str


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """A table that is written."""

    rows: str  # what a row is
    columns: tuple[Column | str, ...]  # strings: names of shared columns
    further: tuple[Column, ...] = ()  # columns that follow where they are needed
    shown: dict[str, str] = {}  # views: ``heading {column:format}``, separated by bars
    legend: str = ""  # explains headings of a view on a terminal
    values: dict[str, dict[str, str]] = {}  # meanings of the values of columns

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the columns in order, without further ones."""
        names = (one if isinstance(one, str) else one.names for one in self.columns)
        return tuple(" ".join(names).split())

    @cached_property
    def units(self) -> dict[str, str]:
        """Unit or type of each column."""
        units = {name: unit for name, (unit, _) in SHARED.items()}
        own = (one for one in (*self.columns, *self.further) if isinstance(one, Column))
        return units | {name: one.unit for one in own for name in one.names.split()}

    def row(self, *values: Any) -> Row:
        """Return a row, or all columns, from values in the order of the columns.

        Moments become texts.
        """
        pairs = zip(self.names, values, strict=True)
        return {n: v.isoformat() if isinstance(v, datetime) else v for n, v in pairs}

    def read(self, one: Any, **known: Any) -> Row:
        """Return a row, or all columns, from known values, and attributes with the other names."""
        return self.row(*(known[n] if n in known else getattr(one, n) for n in self.names))

    def rows_of(self, objects: Iterable[Any], **common: Any) -> list[Row]:
        """Return a row of each object, as `read` does."""
        return [self.read(one, **common) for one in objects]


class RefusalCode(msgspec.Struct, frozen=True, array_like=True):
    """A reason in ``refused.csv``."""

    what: str  # is refused: log, channel, mode, blow or row; ``warning`` where it is used
    cause: str
    cure: str
    details: tuple[str, ...] = ()  # templates of sentences of its details that pages translate


class _Specification(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    shared: dict[str, tuple[str, str]]
    run: dict[str, Table]
    command: dict[str, Table]
    refusals: dict[str, RefusalCode]
    notices: dict[str, tuple[Literal["note", "caution", "serious"], str, str]]
    steps: dict[str, str]


_TEXT = (resources.files(__package__) / "tables.toml").read_bytes()
_READ = msgspec.toml.decode(_TEXT, type=_Specification)
SHARED: Mapping[str, tuple[str, str]] = _READ.shared
"""Unit or type, and meaning, of columns of many tables."""
RUN_TABLES: Mapping[str, Table] = _READ.run
"""Tables of a run by the name of their file, without its ending."""
TABLES: Mapping[str, Table] = {**_READ.run, **_READ.command}
"""All tables, those of the answers of commands by their key there."""
REFUSALS: Mapping[str, RefusalCode] = _READ.refusals
"""Every code in the column ``reason`` of ``refused.csv``."""
NOTICES = _READ.notices
"""Severity, sentence and what to do of notices, by code and case (`machine.status`)."""
STEPS = _READ.steps
"""Sentences of next steps, by their kind."""
FLAGS: Mapping[str, str] = _READ.run["modes"].values["flags"]
"""Meaning of the flags of a mode."""
MOMENTS = sorted(
    {name for one in TABLES.values() for name, unit in one.units.items() if unit == "moment"}
)
"""Names of the columns of moments."""


def spell(name: str) -> str:
    """Return a name with blanks instead of underscores."""
    return name.replace("_", " ")


def fact(template: str, /, **values: object) -> str:
    """Return a sentence of a result: English, from a template in which values have names.

    Pages translate it by its template (`report.language.sentence`).
    """
    return template.format(**values)
