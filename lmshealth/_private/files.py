"""Read small tables; write files: completely or not at all."""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING

from lmshealth.errors import BadTable

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from xarray import DataTree


# Folders of the system whose devices, and links to streams, are written to and stay.
_STREAMS = ("/dev", "/dev/fd", "/proc/self/fd")
# Far above every table that is read as a whole.
_LARGEST_TABLE = 64 << 20


def read_table(path: Path) -> bytes:
    """Read a file of settings or rows; `OSError` for a device or a pipe, `ValueError` if too large.

    They would be read without end, or wait for a writer.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "is no regular file")
    if found.st_size > _LARGEST_TABLE:
        raise ValueError(f"{found.st_size} bytes are too many; needed at most {_LARGEST_TABLE}")
    return path.read_bytes()


def escapes(path: Path, folder: Path) -> bool:
    """Return whether a path leads out of a folder, by its parts or by symbolic links."""
    return not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def write_text(target: Path, text: str) -> None:
    """Write a text as `replacing` does."""
    with replacing(target) as stream:
        stream.write(text)


def write_bytes(target: Path, content: bytes) -> None:
    """Write bytes in the same way."""
    with _writing(target), _in_place_of(target) as part, part.open("ab") as stream:
        stream.write(content)


@contextmanager
def replacing(target: Path) -> Iterator[IO[str]]:
    """Open a text file that replaces another in one step, once it is complete.

    Missing folders are made. A symbolic link in its place is replaced, not followed. `BadTable` if
    it cannot be written.
    """
    odd = "backslashreplace"  # one unprintable name must not keep all others from being written
    with (
        _writing(target),
        _in_place_of(target) as part,
        part.open("a", encoding="utf-8", errors=odd, newline="\n") as stream,
    ):
        yield stream


def _is_stream(target: Path) -> bool:
    """Return whether a path is a device or a stream of the system, such as /dev/stdout.

    In other folders, /dev/shm among them, what is in the place of a file is replaced: a pipe
    without a reader would stop a run, and a link may have been put there by others.
    """
    if str(target.absolute().parent) not in _STREAMS:
        return False
    return target.is_symlink() or (target.exists() and not target.is_file())


@contextmanager
def _in_place_of(target: Path) -> Iterator[Path]:
    if _is_stream(target):
        yield target
        return
    # A random name: nobody can have put a link there.
    part = target.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with _locked(part, os.O_CREAT | os.O_EXCL):
            yield part
            part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def remove_abandoned(folder: Path) -> None:
    """Remove incomplete files of a folder whose writers were killed: nobody holds their locks."""
    for part in folder.glob(".*.part"):
        if re.fullmatch(r"\.[0-9a-f]{16}\.part", part.name):
            with suppress(OSError), _locked(part):
                part.unlink()


_tidy = cache(remove_abandoned)  # once per process: a run writes many files


@contextmanager
def _locked(part: Path, create: int = 0) -> Iterator[None]:
    """Hold the lock of a file, which ends with the process; `OSError` if another one has it."""
    # Windows needs none: it removes no file that is open. On a file system without locks
    # nothing is removed.
    if fcntl is None:
        yield
        return
    guard = os.open(part, os.O_RDWR | create, 0o666)
    try:
        with suppress(OSError) if create else nullcontext():
            fcntl.flock(guard, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(guard)


def free_name(stem: str, taken: set[str]) -> str:
    """Return a name that is not taken, regardless of case, by a number where needed; take it."""
    name, count = stem, 1
    while name.casefold() in taken:
        count += 1
        name = f"{stem}-{count}"
    taken.add(name.casefold())
    return name


def write_draws(target: Path, stages: Sequence[str], trees: Sequence[DataTree]) -> None:
    """Write posterior draws as NetCDF: in ArviZ's layout, of several machines in named groups."""
    from xarray import DataTree  # late: it takes a second to import

    # A group has no slash in its name; a machine that has none either keeps its own.
    taken = {stage.casefold() for stage in stages if "/" not in stage}
    named = {
        free_name(stage.replace("/", "_"), taken) if "/" in stage else stage: tree
        for stage, tree in zip(stages, trees, strict=True)
    }
    tree = trees[0] if len(trees) == 1 else DataTree.from_dict(named)
    write_bytes(target, bytes(tree.to_netcdf(engine="h5netcdf")))


@contextmanager
def _writing(target: Path) -> Iterator[None]:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _tidy(target.parent.absolute())
        yield
    except OSError as error:
        raise BadTable(f"{target}: cannot be written: {error.strerror or error}") from error
