"""Output to a terminal: tables, JSON, wrapped text, progress bars of long jobs."""

from __future__ import annotations

import logging
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from string import Formatter
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import click
import msgspec
from rich import box, progress
from rich.console import Console, RenderableType
from rich.table import Table

from lmshealth.io.log import WARNINGS
from lmshealth.report.text import fixed, number, percent, plain

if TYPE_CHECKING:  # so that --help does not import pandas and scipy
    from lmshealth.report.tables import Row

# Columns of text in a pipe, and the most on a terminal; of a table in a pipe, which is never cut.
_WIDTH, _WIDEST, _UNLIMITED = 78, 100, 10_000
PATIENCE = 2.0  # seconds without a progress bar
_REFUSED = "log {log} | channel {channel} | mode {mode} | reason {reason} | detail {detail}"
# Names up to this length are not split in a table that is too wide.
_NAME = 16


_logger = logging.getLogger(__name__)
_PRINTED = {"printed": True}  # records that are on the terminal already


def quiet() -> bool:
    """Return whether ``--quiet`` is set."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(__name__))


def start_log(context: click.Context, handler: logging.Handler) -> None:
    """Send records of the package to a handler until the command ends."""
    logger = logging.getLogger("lmshealth")
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    context.call_on_close(handler.close)
    context.call_on_close(lambda: logger.removeHandler(handler))


def _columns() -> int | None:
    """Return the width of the terminal; None for a pipe or a file."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def print_json(content: Mapping[str, Any], *, indent: int = 1) -> None:
    """Print JSON with null where a number is missing; with a negative indent in one line."""
    # msgspec writes null for NaN and infinity.
    encoded = msgspec.json.encode(content, enc_hook=lambda number: number.item())
    click.echo(msgspec.json.format(encoded, indent=indent))


def print_notes(notes: Iterable[str]) -> None:
    """Print on standard error what the reader must take into account."""
    for note in notes:
        _logger.info("note: %s", note, extra=_PRINTED)
        if not quiet():
            click.echo(f"note: {note}", err=True)


def print_errors(errors: Iterable[str]) -> None:
    """Print on standard error what has no result, and why."""
    for error in errors:
        _logger.info("%s", error, extra=_PRINTED)
        click.echo(f"lmshealth: {error}", err=True)


def print_text(text: str, mark: str = "") -> None:
    """Print text in lines that fit, indented below the mark."""
    width = min((_columns() or _WIDTH + 2) - 2, _WIDEST)
    for paragraph in (mark + text).split("\n"):
        lines = wrap(
            paragraph,
            width,
            subsequent_indent=" " * len(mark),
            break_long_words=False,
            break_on_hyphens=False,
        )
        click.echo(plain("\n".join(lines)))


def print_refused(rows: Sequence[Row]) -> None:
    """Print refusals and their reasons, and apart from them warnings about what is used."""
    for title, in_part in (("Refused", False), ("Used in part", True)):
        if own := [row for row in rows if _is_warning(row) == in_part]:
            print_table(title, cells(_REFUSED, short_names(own)), 5)


def _is_warning(row: Row) -> bool:
    # Whole logs are refused for the same reasons, without a channel.
    return row["reason"] in WARNINGS and bool(row["channel"])


class _Numbers(Formatter):
    """Format strings with numbers of `lmshealth.report.text`; a missing one is a dash.

    ``n`` is for significant digits, ``%`` for a share in percent, ``p`` for one without the sign.
    """

    def format_field(self, value: Any, spec: str) -> str:
        if value is None or value != value:  # NaN
            return "–"
        if spec.endswith("n"):
            return number(value, int(spec[1:-1]))
        if spec.endswith("p"):
            return fixed(100 * value, int(spec[1:-1]))
        return percent(value, int(spec[1:-1])) if spec.endswith("%") else format(value, spec)


def cells(columns: str, rows: Iterable[Row]) -> list[dict[str, str]]:
    """Format the cells of a table with columns ``heading {key:format}``, separated by bars."""
    split = [column.partition("{") for column in columns.split("|")]
    forms = {head.strip(): (start + rest).strip() for head, start, rest in split}
    fill = _Numbers().vformat
    return [{head: fill(form, (), row) for head, form in forms.items()} for row in rows]


def print_table(title: str, rows: Sequence[dict[str, str]], n_texts: int = 1) -> None:
    """Print rows under their keys: texts left-aligned, then numbers right-aligned.

    On a terminal texts are wrapped to its width; in a pipe every row is one line.
    """
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for place, name in enumerate(rows[0]):
        if place < n_texts:
            # The last text is the longest and is wrapped first; names before it are not split.
            words = " ".join([name, *(row[name] for row in rows)]).split()
            least = min(max(map(len, words), default=0), _NAME) if place < n_texts - 1 else None
            table.add_column(name, overflow="fold", min_width=least)
        else:
            longest = max((len(plain(row[name])) for row in rows), default=0)
            least = max(longest, *map(len, name.split() or [""]), 1)
            table.add_column(name, justify="right", min_width=least)
    for row in rows:
        table.add_row(*map(plain, row.values()))
    click.echo(plain(title))
    # Brackets in the cells are not markup.
    console = Console(markup=False, emoji=False, highlight=False, width=_columns() or _UNLIMITED)
    # A table that does not fit is wrapped by the terminal, not cut.
    free = console.options.update(max_width=_UNLIMITED)
    console.width = max(console.width, console.measure(table, options=free).minimum)
    console.print(table)


def short_names(rows: Sequence[Row], others: Sequence[Row] = ()) -> list[Row]:
    """Copy rows with the name of each log without its folder, where that is unique in all rows."""
    names = {row["log"]: Path(row["log"]).name for row in (*rows, *others)}
    shared = Counter(names.values())
    names = {log: name if shared[name] == 1 else log for log, name in names.items()}
    return [row | {"log": names[row["log"]]} for row in rows]


class _Bars(progress.Progress):
    """Progress bars that appear at a time of the monotonic clock, whether or not work goes on."""

    shown_from = 0.0

    def get_renderables(self) -> Iterable[RenderableType]:
        shown = time.monotonic() >= self.shown_from
        return super().get_renderables() if shown else ()


@contextmanager
def progress_bars(delay: float = 0.0) -> Iterator[Any]:
    """Show progress bars on standard error if it is a terminal; yield their callback.

    Nothing is shown in the first ``delay`` seconds. Until the end nothing may be printed on
    standard output.
    """
    with _Bars(
        progress.TextColumn("{task.description:<12}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=quiet() or not sys.stderr.isatty(),
    ) as bars:
        bars.shown_from = time.monotonic() + delay
        tasks: dict[str, Any] = {}

        def report(what: str, done: int, total: int) -> None:
            if done in (0, total) or done % max(total // 10, 1) == 0:
                _logger.info("%s: %d of %d", what, done, total)
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total, completed=done)
            bars.update(tasks[what], completed=done, total=total)

        yield report
