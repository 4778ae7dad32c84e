"""Folders of logs: which files are logs, and what the manifests beside them say."""

from __future__ import annotations

import csv
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from lmshealth.errors import BadTable
from lmshealth.logs import Refusal
from lmshealth.readers.formats import is_log
from lmshealth.readers.metadata import KEYS
from lmshealth.readers.reading import shown
from lmshealth.readers.trouble import listed

MANIFEST = "manifest.csv"
NOT_LOGS = frozenset({MANIFEST, "maintenance.csv", "truth.csv"})


class Found(NamedTuple):
    """What a folder holds.

    Attributes
    ----------
    logs : tuple of Path
        Files with a suffix of the log contract, sorted.
    refused : tuple of Refusal
        Files that look like logs and must not or cannot be opened, named relative to the folder.
    """

    logs: tuple[Path, ...]
    refused: tuple[Refusal, ...]


@dataclass(frozen=True, slots=True)
class Manifest:
    """What the manifests of a folder say about its logs.

    Attributes
    ----------
    rows : dict of Path to dict of str to str
        Metadata by absolute path of the log, empty cells left out.
    refused : tuple of Refusal
        Rows that name no log of the folder.
    """

    rows: dict[Path, dict[str, str]]
    refused: tuple[Refusal, ...]

    def overrides(self, log: Path) -> dict[str, str]:
        """Give the metadata that override what a log says; empty for a log without a row."""
        return dict(self.rows.get(_absolute(log), {}))


def find_logs(folder: str | Path) -> Found:
    """Find the logs of a folder and its subfolders by their suffix.

    Hidden files and folders are passed over. Symbolic links to files are followed as long as
    they stay in the folder; links to folders are not, what they hold is found where it is.

    Parameters
    ----------
    folder : str or Path
        The archive.

    Raises
    ------
    BadTable
        If it is no folder.
    """
    root = Path(folder)
    logs: list[Path] = []
    refused: list[Refusal] = []
    for path in _walk(root, refused):
        if path.name in NOT_LOGS or not is_log(path):
            continue
        trouble = _trouble(path, root)
        if trouble is None:
            logs.append(path)
        else:
            refused.append(Refusal(_inside(path, root), *trouble))
    return Found(tuple(logs), tuple(refused))


def read_manifest(folder: str | Path) -> Manifest:
    """Read every ``manifest.csv`` of a folder and its subfolders; it may have none.

    Paths in a manifest are relative to it. Where two manifests name a log, the one nearer to the
    log has the last word.

    Parameters
    ----------
    folder : str or Path
        The archive.

    Raises
    ------
    BadTable
        If it is no folder, if a manifest cannot be read, has no column ``file``, has rows longer
        than its header, or names a log twice.
    """
    root = Path(folder)
    rows: dict[Path, dict[str, str]] = {}
    refused: list[Refusal] = []
    found = [path for path in _walk(root, []) if path.name == MANIFEST]
    for path in sorted(found, key=lambda path: (len(path.parts), path)):
        trouble = _trouble(path, root)
        if trouble is not None:
            refused.append(Refusal(_inside(path, root), *trouble))
            continue
        for log, row in _rows(path, root, refused).items():
            rows[log] = rows.get(log, {}) | row
    return Manifest(rows, tuple(refused))


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


def _inside(path: Path, root: Path) -> str:
    """Name a file as the user knows it: relative to the folder of logs."""
    return shown(path.relative_to(root).as_posix())


def _walk(root: Path, refused: list[Refusal]) -> Iterator[Path]:
    """Yield all files in a fixed order, without entering links or hidden folders."""
    if not root.is_dir():
        raise BadTable(f"{shown(root)} is no folder")

    def unreadable(error: OSError) -> None:
        folder = _inside(Path(error.filename), root)
        refused.append(Refusal(folder, "missing-file", f"cannot be opened: {error.strerror}"))

    for parent, folders, files in os.walk(root, onerror=unreadable):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        here = Path(parent)
        for name in folders:
            if (here / name).is_symlink() and _escapes(here / name, root):
                folder = _inside(here / name, root)
                refused.append(Refusal(folder, "escapes", "a link out of the folder of logs"))
        yield from (here / name for name in sorted(files) if not name.startswith("."))


def _escapes(path: Path, root: Path) -> bool:
    return not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(root))


def _trouble(path: Path, root: Path) -> tuple[str, str] | None:
    """Say why a file must not be opened; None if it may."""
    if _escapes(path, root):
        return "escapes", "a link out of the folder of logs; copy the file into it"
    try:
        regular = stat.S_ISREG(path.stat().st_mode)
    except OSError as error:
        return "missing-file", f"cannot be opened: {error.strerror}"
    return None if regular else ("missing-file", "is no regular file")


def _rows(path: Path, root: Path, refused: list[Refusal]) -> dict[Path, dict[str, str]]:
    """Read one manifest, by absolute path of the logs it names."""
    rows: dict[Path, dict[str, str]] = {}
    for line, row in _table(path):
        file = row.pop("file").replace("\\", "/")
        where = f"line {line} of {shown(path)}"
        if not file:
            raise BadTable(f"{where}: file is empty")
        log = _absolute(path.parent / file)
        if log in rows:
            raise BadTable(f"{where}: {file} has a row already; keep one of them")
        if not log.is_relative_to(_absolute(root)) or _escapes(log, root):
            refused.append(Refusal(file, "escapes", f"{where} names a file out of the folder"))
            continue
        rows[log] = {key: row[key] for key in KEYS if row.get(key)}
        if not os.path.lexists(log):
            refused.append(Refusal(file, "missing-file", f"{where} names a file that is not there"))
    return rows


def _table(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line numbers and rows, cells stripped, missing ones empty."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream, skipinitialspace=True)
            names = [name.strip() for name in reader.fieldnames or ()]
            if names.count("file") != 1 or len(set(names)) != len(names):
                raise BadTable(
                    f"{shown(path)}: columns are {listed(names)}; needed each once, and file"
                )
            reader.fieldnames = names
            for row in reader:
                if None in row:
                    raise BadTable(
                        f"line {reader.line_num} of {shown(path)}: more cells than columns"
                    )
                yield reader.line_num, {key: (row[key] or "").strip() for key in names}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadTable(f"{shown(path)}: {error}") from error
