"""Write ``lmshealth/report/TABLES.md``, the columns of all tables, from their specification.

``python -m tests.tools.columns`` does so. Columns that are the same in many tables are explained
once.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from lmshealth._private.tables import RUN_TABLES, SHARED, TABLES, Table

PAGE = Path(__file__).parents[2] / "lmshealth" / "report" / "TABLES.md"
_HEAD = ["", "| column | unit or type | meaning |", "| --- | --- | --- |"]
_OPENING = """\
# Columns of all tables

<!-- Written by `python -m tests.tools.columns` from ../_private/tables.toml; edit that file. -->

Files of `run` are CSV; those of `track`, `infer` and `prognose` have the same columns. Tables of
other commands are keys of their JSON answers, and `--format csv` prints the first. `to_frame` of
`Modes`, `Track`, `Health` and `Prognosis` has columns of modes, track, health and prognosis.

A unit of 1 is that of a plain number; where none is given, it follows from the parameter, the
covariate or the channels. A *moment* is ISO 8601 with zone, a *day* an ISO date, a *flag* True or
False (JSON: true or false). The last columns of a list, with `<...>` in their names or from
an option, are there where they are needed.

## Columns of many tables"""


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8", newline="\n")


def page() -> str:
    """Return the text of the page."""
    return "".join(f"{line}\n" for line in _lines())


def _lines() -> Iterator[str]:
    yield _OPENING
    yield from _HEAD
    yield from (_row(name, unit, meaning) for name, (unit, meaning) in SHARED.items())
    for title, of_run in (("Files of a run", True), ("Answers of single commands", False)):
        yield from ("", f"## {title}")
        for name, table in TABLES.items():
            if (name in RUN_TABLES) == of_run:
                yield from ("", f"**{name}{'.csv' if of_run else ''}**: {table.rows}")
                yield from _HEAD
                yield from _rows(table)
                for column, meanings in table.values.items():
                    yield from ("", f"Values of `{column}`:", "")
                    yield from (f"- `{value}`: {meaning}" for value, meaning in meanings.items())


def _rows(table: Table) -> Iterator[str]:
    for one in (*table.columns, *table.further):
        if isinstance(one, str):
            yield _row(one, "", "as in many tables")
        else:
            yield _row(one.names, one.unit, one.meaning)


def _row(names: str, unit: str, meaning: str) -> str:
    listed = ", ".join(f"`{name}`" for name in names.split())
    return f"| {listed} | {unit} | {meaning} |"


if __name__ == "__main__":
    main()
