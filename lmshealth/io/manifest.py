"""Folders of logs: which files are logs, the rows of their manifests, and other tables.

A bad row of a table next to logs is refused alone; a bad cell of a table of estimates
refuses the table. Both are named by their line.
"""

import codecs
import csv
import io
import os
import re
import stat
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lmshealth._private.files import escapes, read_table
from lmshealth.errors import BadLog, BadTable
from lmshealth.io import constants
from lmshealth.io.formats.registry import format_of, holds_samples, is_log
from lmshealth.io.log import (
    BOOLEANS,
    Refusal,
    low_high,
    metadata_keys,
    parse_metadata,
    parse_moment,
    possible,
)
from lmshealth.io.refusal import Unusable, listed, repeated, shown, visible

if TYPE_CHECKING:
    import pandas as pd


_MOST_LISTED = 3
_DELIMITERS = ",;\t"
MISSPELT = "unlike-key"  # reason of a column of a manifest that is probably misspelt
LIKE = 0.75  # likeness of words (difflib) from which one is taken for a misspelt other


class Row(NamedTuple):
    """One row of a table next to logs: its lines, such as ``line 3``, its cells, its fault.

    Cells are stripped, and empty where there is none; a bad row has those that can be split. Bytes
    that are no UTF-8 are kept as surrogates, as in names of files. A good row has no trouble.
    """

    where: str
    cells: dict[str, str]
    trouble: str


def read_sheet(path: Path, needed: Sequence[str]) -> Iterator[Row]:
    """Read a table row by row, after a header line, whose most frequent delimiter separates all.

    Commas, semicolons or tabs in UTF-8, or in UTF-16 with its mark, as spreadsheets write them.
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
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = content.decode("utf-16", "replace")
    else:
        text = content.decode("utf-8-sig", "surrogateescape")
    rows = io.StringIO(text, newline=None).readlines()
    header = next(filter(str.strip, rows), "")
    records = _records(rows, max(_DELIMITERS, key=header.count))
    names = [name.strip() for name in next(records, ("", [], ""))[1]]
    if not names:
        raise Unusable("empty", f"no header line; needed {listed(needed)}")
    wide = len(names) > constants.MOST_CELLS
    if wide or repeated(filter(None, names)) or not set(needed) <= set(names):
        detail = f"needed {listed(needed)}, none twice, with commas, semicolons or tabs between"
        raise Unusable("columns", f"columns are {listed(names)}; {detail}")
    for where, cells, trouble in records:
        stripped = [cell.strip() for cell in cells]
        if not any(stripped):  # spreadsheets write the rows below a table
            continue
        if not trouble and any(stripped[len(names) :]):
            trouble = f"{len(cells)} cells in {len(names)} columns"
        padded = dict.fromkeys(names, "") | dict(zip(names, stripped, strict=False))
        yield Row(where, padded, trouble)


def _records(lines: list[str], delimiter: str) -> Iterator[tuple[str, list[str], str]]:
    """Yield place, cells and trouble of each record."""
    # A new reader starts at the line after every record: an open quote would else include all
    # rows up to the next one without an error.
    at = 0
    while at < len(lines):
        some = lines[at : at + constants.LONGEST_CELL]
        reader = csv.reader(some, delimiter=delimiter, strict=True, skipinitialspace=True)
        try:
            cells, n, trouble = next(reader), reader.line_num, ""
        except csv.Error as error:
            cells, n, trouble = lines[at].split(delimiter), 1, f"no row of a table: {error}"
        where = f"line {at + 1}" if n == 1 else f"lines {at + 1} to {at + n}"
        at += n
        if cells:
            yield where, cells, trouble


def read_rows(path: Path, needed: Sequence[str]) -> "pd.DataFrame":
    """Read a table of estimates as text; `BadTable` if a column is missing or it cannot be read.

    Blank cells beyond the columns, and blank rows, are left out.
    """
    import pandas as pd  # late, as below: tables next to logs need none of it

    def read(**how: Any) -> pd.DataFrame:
        found: pd.DataFrame = pd.read_csv(
            io.BytesIO(content), dtype=str, keep_default_na=False, index_col=False, **how
        )
        return found

    try:
        content = path.read_bytes()
        names = read(header=None, nrows=1).iloc[0].str.strip().tolist()
    except (OSError, ValueError) as error:
        raise BadTable(f"{path}: cannot be read as a table: {str(error).strip()}") from error
    if missing := [name for name in needed if name not in names]:
        hint = "; columns are separated by commas" if len(names) == 1 else ""
        raise BadTable(f"{path}: no column {missing}; there are {names}{hint}")
    if twice := repeated(filter(None, names)):
        raise BadTable(f"{path}: columns {twice} are there twice; needed is one of each")
    n = len(names)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            try:
                table = read()
            except pd.errors.ParserWarning:  # all rows are longer, as by a delimiter at their ends
                table = read(header=0, names=[*range(n + 1)])
    except (ValueError, pd.errors.ParserWarning) as error:
        raise BadTable(f"{path}: cannot be read as a table: {str(error).strip()}") from error
    text = content.removeprefix(codecs.BOM_UTF8).splitlines()
    places = [k for k, line in enumerate(text, -1) if line.strip()][1:]
    if len(places) == len(table):  # no cell has several lines
        table.index = pd.Index(places)
    filled = table.apply(lambda cells: cells.str.strip() != "")
    if (beyond := filled.iloc[:, n:].any(axis=1)).any():
        raise BadTable(f"{path}, {lines(table, beyond)}: {n + 1} cells in {n} columns")
    table = pd.DataFrame(table.loc[filled.any(axis=1)].iloc[:, :n])
    table.columns = pd.Index(names)
    return table


def name_machine(path: Path, table: "pd.DataFrame") -> list[str]:
    """Fill in a missing column stage, in place, and return a note of it.

    `BadTable` if the column is there, and a cell of it is blank.
    """
    if "stage" in table.columns:
        if (nameless := table["stage"].str.strip() == "").any():
            what = "stage is empty; needed is a name"
            raise BadTable(f"{path}, {lines(table, nameless)}: {what}")
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
        numbers = pd.to_numeric(text, errors="coerce")
        table[name] = numbers
        unknown, odd = given & ~np.isfinite(numbers), given & ~numbers.between(*low_high(name))
        for wrong, needed in ((unknown, "a finite number"), (odd, possible(name))):
            if wrong.any():
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
            moments.append(parse_moment({"recorded_at": text}, latest))
        except Unusable as error:
            raise BadTable(f"{path}, line {int(index) + 2}: {error.detail}") from error
        if moments[-1] is None:
            raise BadTable(f"{path}, line {int(index) + 2}: recorded_at is empty")
    # Of another type pandas would make Timestamps of them.
    table["recorded_at"] = pd.Series(moments, table.index, dtype=object)


# Folders and manifests

MANIFEST = "manifest.csv"
NOT_LOGS = frozenset({MANIFEST, "maintenance.csv", "truth.csv"})


class FileList(NamedTuple):
    """Files of a folder, sorted, and refusals of those that must not or cannot be opened."""

    logs: tuple[Path, ...]
    refused: tuple[Refusal, ...]


@dataclass(frozen=True, slots=True)
class Manifest:
    """Rows of the manifests of a folder, by the absolute path of the log.

    ``rows`` are metadata without empty cells; ``refused`` manifests that cannot be read, and rows
    that name no log of the folder; ``bad`` the fault of one of the rows of a log. ``registers`` are
    the folders of manifests that state machine and date of logs; others only correct some logs.
    """

    rows: dict[Path, dict[str, str]]
    refused: tuple[Refusal, ...]
    bad: dict[Path, str]
    registers: set[Path] = field(default_factory=set)

    def names(self, log: Path) -> bool:
        """Return whether this log has a row."""
        return _absolute(log) in self.rows

    def is_baseline(self, log: Path) -> bool:
        """Return whether the row of this log declares it as baseline."""
        return _declares_baseline(self.rows.get(_absolute(log), {}))

    def omits(self, log: Path) -> bool:
        """Return whether this log has no row in a manifest that lists the logs of its folder."""
        path = _absolute(log)
        return path not in self.rows and not self.registers.isdisjoint(path.parents)

    def overrides(self, log: Path) -> dict[str, str]:
        """Return the metadata that override those of a log; empty for a log without a row.

        `BadLog` (``bad-row``) for a log whose row cannot be read or is contradicted.
        """
        path = _absolute(log)
        if path in self.bad:
            raise BadLog(shown(log), "bad-row", self.bad[path])
        return dict(self.rows.get(path, {}))


def copy_error(
    name: str, stated: Mapping[str, str], other: str, there: Mapping[str, str]
) -> BadLog:
    """Return the refusal of a copy of a log; both have metadata by their rows of the manifest.

    It is ``bad-row`` where these contradict each other, which is no harmless copy, else
    ``duplicate``.
    """
    contradicting = [
        f"{key} {visible(value[:80])} (there {visible(there[key][:80])})"
        for key, value in stated.items()
        if key in there and _parsed(key, value) != _parsed(key, there[key])
    ]
    same = f"same content as {other}"
    if not contradicting:
        return BadLog(name, "duplicate", f"{same}, which is analysed for both")
    found = f"{same}, but manifest.csv states {', '.join(contradicting)}"
    next_step = "correct the row, or delete one of the files"
    return BadLog(name, "bad-row", f"{found}; only {other} is analysed: {next_step}")


def _parsed(key: str, value: str) -> object:
    """Return what a cell states: one moment or number may be written in several ways."""
    try:
        return parse_metadata({key: value})
    except Unusable:
        return value


def find_logs(
    folder: str | Path, *, manifest: Manifest | None = None, follow_links: bool = False
) -> FileList:
    """Find the logs of a folder and its subfolders; `BadTable` if it is none.

    Logs are files with the suffix of a log, those that a manifest lists, and texts that hold
    samples. Samples under a suffix that is not read are refused (``skipped``), and so are rows of
    the manifest for files that are none of these (``bad-row``). Hidden files and folders are
    ignored. Symbolic links to files are followed as long as they stay in the folder, and with
    ``follow_links`` wherever they lead; links to folders are not.
    """
    root, listed = Path(folder), manifest.rows if manifest else {}
    skipped = list[Path]()

    def fits(path: Path) -> bool:
        if path.name in NOT_LOGS:
            return False
        if is_log(path) or _absolute(path) in listed:
            return True
        if path.name.endswith(constants.BACKUPS) or _trouble(path, root, follow_links=follow_links):
            return False
        has_samples, is_read = holds_samples(path), format_of(path) is not None
        if has_samples and not is_read:
            skipped.append(path)
        return has_samples and is_read

    found = _find(root, fits, follow_links=follow_links)
    named = {refusal.log for refusal in found.refused} | {name_of(one, root) for one in found.logs}
    detail = "holds samples, and its suffix is not read; rename it to .csv, or move it out"
    refused = [Refusal(name_of(path, root), "skipped", detail) for path in skipped]
    detail = "manifest.csv lists it, and a hidden file or a table is no log; rename it"
    others = (name_of(path, _absolute(root)) for path in sorted(listed) if os.path.isfile(path))
    refused += [Refusal(name, "bad-row", detail) for name in others if name not in named]
    return FileList(found.logs, (*found.refused, *refused))


def find_sheets(folder: str | Path, name: str, *, follow_links: bool = False) -> FileList:
    """Find the tables of a name, such as ``manifest.csv``, where `find_logs` finds logs."""
    found = _find(Path(folder), lambda path: path.name == name, follow_links=follow_links)
    # What else is wrong with the folder, `find_logs` lists.
    return FileList(found.logs, tuple(r for r in found.refused if Path(r.log).name == name))


def read_manifest(folder: str | Path, *, follow_links: bool = False) -> Manifest:
    """Read every ``manifest.csv`` of a folder and its subfolders, as found by `find_sheets`.

    Paths in a manifest are relative to it. Where two manifests name a log, the one nearer to the
    log overrides the other. A bad row refuses the log that it names, and nothing else.
    """
    found = find_sheets(folder, MANIFEST, follow_links=follow_links)
    return _merged(Path(folder), found, follow_links=follow_links)


def read_manifest_beside(log: str | Path) -> Manifest:
    """Read the ``manifest.csv`` in the folder of a log, which may have none, and no other."""
    root = Path(log).parent
    path = root / MANIFEST
    if not os.path.lexists(path):
        return Manifest({}, (), {})
    trouble = _trouble(path, root)
    found = FileList((), (Refusal(MANIFEST, *trouble),)) if trouble else FileList((path,), ())
    return _merged(root, found)


def _merged(root: Path, found: FileList, *, follow_links: bool = False) -> Manifest:
    """Read manifests of a folder, the nearest to the logs last."""
    manifest, refused = Manifest({}, (), {}), list(found.refused)
    for path in sorted(found.logs, key=lambda path: (len(path.parts), path)):
        try:
            refused += _add(manifest, path, root, follow_links=follow_links)
        except Unusable as error:
            refused.append(Refusal(name_of(path, root), error.reason, error.detail))
    return replace(manifest, refused=tuple(refused))


def name_of(path: Path, folder: Path) -> str:
    """Name a file relative to the folder of logs, as printable text."""
    return shown(path.relative_to(folder).as_posix())


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


def _find(root: Path, fits: Callable[[Path], bool], *, follow_links: bool) -> FileList:
    """Find files in a fixed order, without entering links or hidden folders."""
    if not root.is_dir():
        raise BadTable(f"{shown(root)} is no folder")
    logs: list[Path] = []
    refused: list[Refusal] = []

    def unreadable(error: OSError) -> None:
        folder = name_of(Path(error.filename), root)
        refused.append(Refusal(folder, "missing-file", f"cannot be opened: {error.strerror}"))

    for parent, folders, files in os.walk(root, onerror=unreadable):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for here in (Path(parent) / name for name in folders):
            if here.is_symlink() and escapes(here, root):
                detail = "a link out of the folder of logs"
                refused.append(Refusal(name_of(here, root), "escapes", detail))
        visible = (Path(parent) / name for name in sorted(files) if not name.startswith("."))
        for path in filter(fits, visible):
            if trouble := _trouble(path, root, follow_links=follow_links):
                refused.append(Refusal(name_of(path, root), *trouble))
            else:
                logs.append(path)
    return FileList(tuple(logs), tuple(refused))


def _trouble(path: Path, root: Path, *, follow_links: bool = False) -> tuple[str, str] | None:
    """Return reason and detail why a file must not be opened; None if it may."""
    if not follow_links and escapes(path, root):
        step = "copy the file into it, or set --follow-links"
        return "escapes", f"a link out of the folder of logs; {step}"
    try:
        regular = stat.S_ISREG(path.stat().st_mode)
    except OSError as error:
        return "missing-file", f"cannot be opened: {error.strerror}"
    return None if regular else ("missing-file", "is no regular file")


def _add(manifest: Manifest, path: Path, root: Path, *, follow_links: bool) -> Iterator[Refusal]:
    """Add the rows of one table to a manifest; yield those that name no log of the folder."""
    own, names = dict[Path, dict[str, str]](), set[str]()
    for where, cells, trouble in read_sheet(path, ("file",)):
        names.update(cells)
        place = f"{where} of {name_of(path, root)}"
        file = cells["file"].replace("\\", "/")
        if not file or "\0" in file:
            detail = trouble or f"file is {file!r}, needed the path of a log"
            yield Refusal(name_of(path, root), "bad-row", f"{where}: {detail}")
            continue
        # Accents are one letter or two, as the system that named the file composes them.
        spelt = [file, *(unicodedata.normalize(form, file) for form in ("NFC", "NFD"))]
        logs = [_absolute(path.parent / name) for name in spelt]
        log = next(filter(os.path.isfile, logs), logs[0])
        outside = not log.is_relative_to(_absolute(root))
        if outside or (not follow_links and escapes(log, root)):
            yield Refusal(shown(file), "escapes", f"{place} names a file out of the folder")
            continue
        row = {key: cells[key] for key in metadata_keys() if cells.get(key)}
        if own.setdefault(log, row) != row:
            trouble = trouble or f"{shown(file)} has another row already; keep one of them"
        if trouble:
            manifest.bad[log] = f"{place}: {trouble}"
        if not os.path.isfile(log):
            name, detail = name_of(log, _absolute(root)), f"{place} names no file"
            yield Refusal(name, "missing-file", detail, baseline=_declares_baseline(row))
    if any(row.keys() >= {"stage", "recorded_at"} for row in own.values()):
        manifest.registers.add(_absolute(path.parent))
    for name, key in _misspelt(names):
        detail = f"column {shown(name)} is not read, unlike {key}; rename it if that is meant"
        yield Refusal(name_of(path, root), MISSPELT, detail)
    for log, row in own.items():
        manifest.rows[log] = manifest.rows.get(log, {}) | row


def _declares_baseline(row: Mapping[str, str]) -> bool:
    return BOOLEANS.get(row.get("baseline", "").lower(), False)


def _misspelt(names: set[str]) -> Iterator[tuple[str, str]]:
    """Yield the columns that are almost a key of the metadata without a column, and that key."""
    keys = [key for key in metadata_keys() if key not in names]
    for name in sorted(names.difference(metadata_keys(), ("file", ""))):
        if near := get_close_matches(re.sub(r"\W+", "_", name.casefold()), keys, 1, LIKE):
            yield name, near[0]
