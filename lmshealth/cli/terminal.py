"""Output to a terminal: tables, JSON, wrapped text, progress bars of long jobs.

Standard streams end no command: closed, full, or of an encoding without some characters.
"""

from __future__ import annotations

import codecs
import errno
import io
import json
import logging
import os
import re
import shutil
import sys
import time
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from textwrap import wrap
from typing import Any, TextIO, TypeVar

import click
import msgspec
from rich import box, progress
from rich.cells import cell_len
from rich.console import Console, RenderableType
from rich.table import Table

from lmshealth._private.tables import TABLES, TEXTS, Row
from lmshealth.io.log import WARNINGS
from lmshealth.report.text import GAP, cells, first_field, plain, view_columns

_ERRORS = "lmshealth-readable"
# What neither a decomposition nor the name of a character gives.
_ASCII = {"±": "+/-", "−": "-", "–": "-", "—": "-", "×": "x", "°": "deg", "→": "->", "─": "-",
          "µ": "u", "μ": "u", "∆": "delta", "∞": "inf", "≈": "~", "≤": "<=", "≥": ">="}  # fmt: skip


def readable(text: str) -> str:
    """Replace what standard output cannot encode by ASCII: +/- for ±, delta for Δ, else ?."""
    return text.encode(_charset(), _ERRORS).decode(_charset())


def _charset() -> str:
    return getattr(sys.stdout, "charset", None) or sys.stdout.encoding or "utf-8"


def _replace(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    return "".join(map(_spelled, error.object[error.start : error.end])), error.end


def _spelled(character: str) -> str:
    if character in _ASCII:
        return _ASCII[character]
    parts = unicodedata.normalize("NFKD", character).replace("\u2044", "/")
    name = unicodedata.name(character, "")
    if name.startswith("GREEK"):
        return name.rpartition("LETTER ")[2].partition(" ")[0].lower()
    return parts.encode("ascii", "ignore").decode() or "?" * (not unicodedata.combining(character))


codecs.register_error(_ERRORS, _replace)


class _Stream(io.TextIOWrapper):
    """Standard stream that goes on, and writes nowhere, once it cannot be written to."""

    lost: OSError | None = None

    def __init__(self, stream: io.TextIOWrapper) -> None:
        self._original = stream  # it closes the buffer when it is deleted
        with suppress(OSError):
            stream.flush()  # what was written before comes first
        self.charset = codecs.lookup(stream.encoding).name
        # click writes UTF-8 to whatever is ASCII.
        encoding = "latin-1" if self.charset == "ascii" else self.charset
        how: Any = {name: getattr(stream, name) for name in ("line_buffering", "write_through")}
        super().__init__(stream.buffer, encoding, _ERRORS, **how)

    def write(self, text: str) -> int:
        try:
            super().write(text.encode(self.charset, _ERRORS).decode(self.charset))
        except OSError as error:
            self._lose(error)
        return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self._lose(error)

    def _lose(self, error: OSError) -> None:
        """Send what follows, and what is still in the buffer, nowhere."""
        self.lost = error
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)


@contextmanager
def standard_streams() -> Iterator[None]:
    """Work with whatever standard streams the process has.

    Characters that a stream cannot encode are replaced, see `readable`. A closed stream is one
    that nobody reads. What cannot be written (a full disk, a closed pipe) is lost, the work is
    done, and the exit status is at least 1.
    """
    # Else the next file that is opened, such as the store, has the number of a standard stream.
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    was_closed = sys.stdout is None
    for number, name in enumerate(("stdout", "stderr"), 1):
        stream = getattr(sys, name) or os.fdopen(number, "w", encoding="utf-8", closefd=False)
        # Others are of a caller, who reads what was written.
        if getattr(sys, name) is getattr(sys, f"__{name}__"):
            setattr(sys, name, _Stream(stream))
    if was_closed:
        click.echo("note: standard output is closed: results are not printed", err=True)
    try:
        yield
    except SystemExit as end:
        sys.stdout.flush()
        error: OSError | None = getattr(sys.stdout, "lost", None)
        if error is None:
            raise
        if error.errno != errno.EPIPE:  # of `| head`, which has read what it needs
            why = f"standard output: {error.strerror}: what was to be printed is lost"
            click.echo(f"lmshealth: {why}; files are not concerned", err=True)
        sys.exit(end.code or 1)


# Texts, tables and progress bars

# Columns of text in a pipe, and the most on a terminal; of a table in a pipe, which is never cut.
_WIDTH, _WIDEST, _UNLIMITED = 78, 100, 10_000
_NARROWEST = 12  # columns of a terminal: the text of a narrower one is as wide as this
PATIENCE = 2.0  # seconds without a progress bar
# Names up to this length are not split in a table that is too wide; the last text becomes as
# narrow as the other.
_NAME, _SHORT = 16, 10


Item = TypeVar("Item")
Report = Callable[[str, int, int], None]

_logger = logging.getLogger(__name__)
_PRINTED = {"printed": True}  # records that are on the terminal already


def quiet() -> bool:
    """Return whether ``--quiet`` is set."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(__name__))


def start_log(context: click.Context, handler: logging.Handler) -> None:
    """Send records of the package to a handler until the program ends, which prints its error."""
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    context = context.find_root()  # that of a command ends before, or not at all for a bad option
    logger = logging.getLogger("lmshealth")
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    context.call_on_close(handler.close)
    context.call_on_close(lambda: logger.removeHandler(handler))


def _width(stream: TextIO) -> int | None:
    """Return the width of a terminal in columns; None for a pipe or a file."""
    return max(shutil.get_terminal_size().columns, _NARROWEST) if stream.isatty() else None


def print_json(content: Mapping[str, Any], *, indent: int = 1) -> None:
    """Print JSON with null where a number is missing; with a negative indent in one line."""
    # msgspec writes null for NaN and infinity.
    encoded = msgspec.json.encode(content, enc_hook=lambda number: number.item())
    text = msgspec.json.format(encoded, indent=indent).decode()
    if not codecs.lookup(_charset()).name.startswith("utf"):
        text = re.sub(r"[^\0-\x7f]", lambda found: json.dumps(found[0])[1:-1], text)
    click.echo(text)


def print_notes(notes: Iterable[str]) -> None:
    """Print on standard error what the reader must take into account."""
    for note in notes:
        _logger.info("note: %s", note, extra=_PRINTED)
        if not quiet():
            print_line(f"note: {note}", err=True)


def print_errors(errors: Iterable[str]) -> None:
    """Print on standard error what has no result, and why."""
    for error in errors:
        _logger.info("%s", error, extra=_PRINTED)
        print_line(f"lmshealth: {error}", err=True)


def print_line(text: str, *, err: bool = False) -> None:
    """Print a line that a terminal gets in parts which fit, and a pipe whole."""
    width = _width(sys.stderr if err else sys.stdout)
    lines = _wrapped(readable(text), width) if width else [text]
    click.echo(plain("\n".join(lines)), err=err)


def print_text(text: str, mark: str = "") -> None:
    """Print text in lines that fit, indented below the mark."""
    terminal = _width(sys.stdout)
    width = min((terminal or _WIDTH + 2) - 2, _WIDEST)
    indent = " " * len(mark)
    lines = _wrapped(readable(mark + text), width, indent, fold=terminal is not None)
    click.echo(plain("\n".join(lines)))


def _wrapped(text: str, width: int, indent: str = "", *, fold: bool = True) -> Iterator[str]:
    """Split text into lines between words, and with ``fold`` words that are longer than a line."""
    joint = "\u2060"  # makes a character of two columns count twice
    counted = "".join(one + joint * (cell_len(one) - 1) for one in text)
    for line in counted.split("\n"):
        parts = wrap(
            line, width, subsequent_indent=indent, break_long_words=fold, break_on_hyphens=False
        )
        yield from (part.replace(joint, "") for part in parts or [""])


def print_refused(rows: Sequence[Row]) -> None:
    """Print refusals and their reasons, and apart from them warnings about what is used."""
    # Whole logs are refused for the same reasons as parts, without a channel.
    parts = [row["reason"] in WARNINGS and bool(row["channel"]) for row in rows]
    for title, in_part in (("Refused", False), ("Used in part", True)):
        if own := [row for row, is_part in zip(rows, parts, strict=True) if is_part == in_part]:
            print_view(title, "refused", short_names(own))


def print_table(title: str, rows: Sequence[dict[str, str]], n_texts: int = 1) -> None:
    """Print rows under their keys: texts left-aligned, then numbers right-aligned.

    On a terminal texts are wrapped to its width; where that is not enough, a row takes a line for
    each cell. In a pipe every row is one line.
    """
    print_line(title)
    heads = [readable(name) for name in rows[0]]
    columns = [[plain(readable(row[name])) for row in rows] for name in rows[0]]
    each = enumerate(zip(heads, columns, strict=True))
    widths = [_widths(*one, is_text=k < n_texts, is_last=k == n_texts - 1) for k, one in each]
    width = _width(sys.stdout) or _UNLIMITED
    fitting = _fitting(widths, width - 2 * len(heads))
    if fitting is None:
        _print_records(heads, columns, n_texts, width)
        return
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for k, (head, own) in enumerate(zip(heads, fitting, strict=True)):
        justify: Any = "left" if k < n_texts else "right"
        table.add_column(head, overflow="fold", justify=justify, width=own)
    for row in zip(*columns, strict=True):
        table.add_row(*row)
    # Brackets in the cells are not markup.
    console = Console(file=io.StringIO(), markup=False, emoji=False, highlight=False, width=width)
    with console.capture() as captured:
        console.print(table)
    click.echo(captured.get(), nl=False)


def _widths(name: str, cells: list[str], *, is_text: bool, is_last: bool) -> tuple[int, int]:
    """Return the least and the natural width of a column."""
    splits = is_text or not any(map(str.isdecimal, "".join(cells)))
    words = [*name.split(), *(word for cell in cells for word in cell.split())]
    least = max(map(cell_len, words if splits else [*name.split(), *cells]), default=1)
    # Names of usual length are not split, and the last text is the longest.
    least = min(least, _SHORT if is_last else _NAME) if is_text else least
    lines = [line for text in (name, *cells) for line in text.split("\n")]
    return max(least, 1), max(1, *map(cell_len, lines))


def print_view(
    title: str,
    table: str,
    rows: Sequence[Row],
    view: str = "terminal",
    headings: Mapping[str, str | None] | None = None,
) -> None:
    """Print rows of a table of `TABLES` by one of its views, some under other headings.

    A column under the heading None is left out.
    """
    spec = TABLES[table]
    columns = view_columns(spec.shown[view], headings)
    is_text = [spec.units.get(first_field(form)) in TEXTS for form in columns.values()]
    print_table(title, cells(columns, rows), [*is_text, False].index(False))


def _fitting(widths: Sequence[tuple[int, int]], room: int) -> list[int] | None:
    """Return widths of columns, the widest of them reduced first; None if the least do not fit."""
    found = [widest for _, widest in widths]
    if sum(least for least, _ in widths) > room:
        return None
    while sum(found) > room:
        reducible = [k for k, (least, _) in enumerate(widths) if found[k] > least]
        found[max(reducible, key=found.__getitem__)] -= 1
    return found


def _print_records(
    heads: Sequence[str], columns: Sequence[Sequence[str]], n_texts: int, width: int
) -> None:
    """Print each row of a table as lines of heading and cell; numbers stay whole."""
    for row in zip(*columns, strict=True):
        for k, (head, cell) in enumerate(zip(heads, row, strict=True)):
            own = cell if k < n_texts else cell.replace(" ", GAP)
            if own.strip():
                line = f"{head}: {own}" if head else own
                click.echo(plain("\n".join(_wrapped(line, width, " "))))
        click.echo()


def short_names(rows: Sequence[Row], others: Sequence[Row] = ()) -> list[Row]:
    """Copy rows with the name of each log without its folder, where that is unique in all rows."""
    names = {row["log"]: Path(row["log"]).name for row in (*rows, *others)}
    shared = Counter(names.values())
    names = {log: name if shared[name] == 1 else log for log, name in names.items()}
    return [row | {"log": names[row["log"]]} for row in rows]


def log_progress(what: str, done: int, total: int) -> None:
    """Write the begin, the end and each tenth of a step to the log."""
    if done in (0, total) or done % max(total // 10, 1) == 0:
        _logger.info("%s: %d of %d", what, done, total)


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
            log_progress(what, done, total)
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total, completed=done)
            bars.update(tasks[what], completed=done, total=total)

        yield report


def counted(report: Report, what: str, items: Sequence[Item]) -> Iterator[Item]:
    """Yield items, and report before each, and at the end, how many of them are done."""
    for done, item in enumerate(items):
        report(what, done, len(items))
        yield item
    report(what, len(items), len(items))
