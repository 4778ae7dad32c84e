"""Folders of logs: which files are logs, and what the manifests beside them say."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from lmshealth.errors import BadLog, BadTable
from lmshealth.io.formats.registry import is_log
from lmshealth.io.log import Refusal
from lmshealth.io.metadata import KEYS
from lmshealth.io.refusal import Unusable, shown
from lmshealth.io.tables import read_sheet

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
        Manifests that cannot be read, and rows that name no log of the folder.
    bad : dict of Path to str
        By absolute path of the log, what is wrong with a row of it.
    """

    rows: dict[Path, dict[str, str]]
    refused: tuple[Refusal, ...]
    bad: dict[Path, str]

    def names(self, log: Path) -> bool:
        """Tell whether a row is about this log."""
        return _absolute(log) in self.rows

    def overrides(self, log: Path) -> dict[str, str]:
        """Give the metadata that override what a log says; empty for a log without a row.

        Raises
        ------
        BadLog
            With reason ``bad-row``: what a manifest says of the log cannot be understood, and what
            the log says of itself is not what was meant.
        """
        path = _absolute(log)
        if path in self.bad:
            raise BadLog(shown(log), "bad-row", self.bad[path])
        return dict(self.rows.get(path, {}))


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
            refused.append(Refusal(name_of(path, root), *trouble))
    return Found(tuple(logs), tuple(refused))


def read_manifest(folder: str | Path) -> Manifest:
    """Read every ``manifest.csv`` of a folder and its subfolders; it may have none.

    Paths in a manifest are relative to it. Where two manifests name a log, the one nearer to the
    log has the last word. A bad row refuses the log that it names, and nothing else.

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
    found = find_sheets(root, MANIFEST)
    return _together(root, found.logs, found.refused)


def read_manifest_beside(log: str | Path) -> Manifest:
    """Read the ``manifest.csv`` in the folder of a log, and no other; there may be none.

    Parameters
    ----------
    log : str or Path
        The log, which need not exist.
    """
    root = Path(log).parent
    path = root / MANIFEST
    if not os.path.lexists(path):
        return Manifest({}, (), {})
    trouble = _trouble(path, root)
    refused = (Refusal(MANIFEST, *trouble),) if trouble else ()
    return _together(root, () if trouble else (path,), refused)


def _together(root: Path, paths: Iterable[Path], refused: Iterable[Refusal]) -> Manifest:
    """Read manifests of a folder, the nearest to the logs last."""
    manifest = Manifest({}, (), {})
    refused = list(refused)
    for path in sorted(paths, key=lambda path: (len(path.parts), path)):
        try:
            refused += _add(manifest, path, root)
        except Unusable as error:
            refused.append(Refusal(name_of(path, root), error.reason, error.detail))
    return replace(manifest, refused=tuple(refused))


def find_sheets(folder: str | Path, name: str) -> Found:
    """Find the tables of a name beside the logs of a folder, where `find_logs` looks for logs.

    Parameters
    ----------
    folder : str or Path
        The archive.
    name : str
        Such as ``manifest.csv``.

    Raises
    ------
    BadTable
        If it is no folder.
    """
    root = Path(folder)
    paths = [path for path in _walk(root, []) if path.name == name]
    troubles = {path: _trouble(path, root) for path in paths}
    return Found(
        tuple(path for path in paths if troubles[path] is None),
        tuple(Refusal(name_of(path, root), *why) for path, why in troubles.items() if why),
    )


def name_of(path: Path, folder: Path) -> str:
    """Name a file as the user knows it: relative to the folder of logs, and fit to be printed."""
    return shown(path.relative_to(folder).as_posix())


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))


def _walk(root: Path, refused: list[Refusal]) -> Iterator[Path]:
    """Yield all files in a fixed order, without entering links or hidden folders."""
    if not root.is_dir():
        raise BadTable(f"{shown(root)} is no folder")

    def unreadable(error: OSError) -> None:
        folder = name_of(Path(error.filename), root)
        refused.append(Refusal(folder, "missing-file", f"cannot be opened: {error.strerror}"))

    for parent, folders, files in os.walk(root, onerror=unreadable):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        here = Path(parent)
        for name in folders:
            if (here / name).is_symlink() and _escapes(here / name, root):
                folder = name_of(here / name, root)
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


def _add(manifest: Manifest, path: Path, root: Path) -> Iterator[Refusal]:
    """Add what one table says to a manifest; yield the rows that name no log of the folder."""
    own: dict[Path, dict[str, str]] = {}
    for where, cells, trouble in read_sheet(path, ("file",)):
        place = f"{where} of {name_of(path, root)}"
        file = cells["file"].replace("\\", "/")
        if not file or "\0" in file:
            detail = trouble or f"file is {file!r}, needed the path of a log"
            yield Refusal(name_of(path, root), "bad-row", f"{where}: {detail}")
            continue
        log = _absolute(path.parent / file)
        if not log.is_relative_to(_absolute(root)) or _escapes(log, root):
            yield Refusal(shown(file), "escapes", f"{place} names a file out of the folder")
            continue
        row = {key: cells[key] for key in KEYS if cells.get(key)}
        if own.setdefault(log, row) != row:
            trouble = trouble or f"{shown(file)} has another row already; keep one of them"
        if trouble:
            manifest.bad[log] = f"{place}: {trouble}"
        if not os.path.isfile(log):
            yield Refusal(shown(file), "missing-file", f"{place} names what is no file")
    for log, row in own.items():
        manifest.rows[log] = manifest.rows.get(log, {}) | row
