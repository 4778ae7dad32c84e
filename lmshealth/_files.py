"""Read small tables; write files: completely or not at all."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

from lmshealth.errors import BadTable

if TYPE_CHECKING:
    from xarray import DataTree


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
    """Write a text as `replacing` does, with missing folders, or raise `BadTable`."""
    with _writing(target), replacing(target) as stream:
        stream.write(text)


def write_bytes(target: Path, content: bytes) -> None:
    """Write bytes in the same way."""
    with _writing(target), _in_place_of(target) as part, part.open("xb") as stream:
        stream.write(content)


@contextmanager
def replacing(target: Path) -> Iterator[IO[str]]:
    """Open a text file that replaces another in one step, once it is complete.

    A symbolic link in its place is replaced, not followed.
    """
    odd = "backslashreplace"  # one unprintable name must not keep all others from being written
    with (
        _in_place_of(target) as part,
        part.open("x", encoding="utf-8", errors=odd, newline="\n") as stream,
    ):
        yield stream


@contextmanager
def _in_place_of(target: Path) -> Iterator[Path]:
    # A random name: nobody can have put a link there.
    part = target.with_name(f".{secrets.token_hex(8)}.part")
    try:
        yield part
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def write_draws(target: Path, stages: Sequence[str], trees: Sequence[DataTree]) -> None:
    """Write posterior draws as NetCDF: in ArviZ's layout, of several machines in named groups."""
    from xarray import DataTree  # late: it takes a second to import

    names = [stage.replace("/", "_") for stage in stages]
    named = dict(zip(names, trees, strict=True))
    tree = trees[0] if len(trees) == 1 else DataTree.from_dict(named)
    with _writing(target):
        tree.to_netcdf(target, engine="h5netcdf")


@contextmanager
def _writing(target: Path) -> Iterator[None]:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise BadTable(f"{target}: cannot be written: {error.strerror or error}") from error
