"""Write ``TABLES.md`` and ``REFUSALS.md`` of ``lmshealth/report`` from ``_private/tables.toml``.

``python -m tests.tools.columns`` does so. Columns that are the same in many tables are explained
once.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from lmshealth._private.tables import REFUSALS, RUN_TABLES, SHARED, TABLES, Table
from lmshealth.io.log import WARNINGS

REPORT = Path(__file__).parents[2] / "lmshealth" / "report"
_KINDS = {
    "log": "Logs",
    "channel": "Channels of a log that is used",
    "warning": "Warnings: it is used nevertheless",
    "mode": "Modes of a log that is used",
    "blow": "Blows of an impact test",
    "row": "Rows of tables",
}
_OF_REFUSALS = """\
# Refusals: cause and cure

<!-- Written by `python -m tests.tools.columns` from ../_private/tables.toml; edit that file. -->

Every code in the column `reason` of `refused.csv`, of `BadLog.reason` and of `Refusal.reason`. The
detail beside it states what was found and what is needed. What is refused is listed on the page of
the machine too, and does not end a run ([exit status](../cli/README.md#exit-status)). Limits are in
`constants.py` of [io](../io/README.md) and [modal](../modal/README.md)."""
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
    """Write the pages."""
    for name, text in pages().items():
        (REPORT / name).write_text(text, encoding="utf-8", newline="\n")


def pages() -> dict[str, str]:
    """Return the texts of the pages by the names of their files."""
    found = {"TABLES.md": _lines(), "REFUSALS.md": _refusals()}
    return {name: "".join(f"{line}\n" for line in lines) for name, lines in found.items()}


def _refusals() -> Iterator[str]:
    """Yield a section per code, so that each has an address of its own."""
    yield _OF_REFUSALS
    for kind, title in _KINDS.items():
        yield from ("", f"## {title}")
        for code, one in REFUSALS.items():
            if one.what == kind:
                flag = WARNINGS.get(code)
                yield from ("", f"### {code}", "", f"*Cause:* {_begun(one.cause)}.", "")
                yield f"*Cure:* {_begun(one.cure)}."
                if flag:
                    yield from ("", f"Modes that it may change have the flag `{flag}`.")


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


def _begun(text: str) -> str:
    """Begin a text with a capital letter."""
    return text[:1].upper() + text[1:]


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
