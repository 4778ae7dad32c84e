"""Files that are written: whole or not at all, where they are asked for and nowhere else."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

from lmshealth.errors import BadTable

if TYPE_CHECKING:
    from xarray import DataTree


def write_text(target: Path, text: str) -> None:
    """Write a text as `replacing` does, folders included.

    Raises
    ------
    BadTable
        If it cannot be written.
    """
    with _writing(target), replacing(target) as stream:
        stream.write(text)


def write_bytes(target: Path, content: bytes) -> None:
    """Write what is no text in the same way.

    Raises
    ------
    BadTable
        If it cannot be written.
    """
    with _writing(target), _in_place_of(target) as part, part.open("xb") as stream:
        stream.write(content)


@contextmanager
def replacing(target: Path) -> Iterator[IO[str]]:
    """Give a file to write that takes the place of another in one step, when it is whole.

    A link that stands there is replaced, not followed.
    """
    # One name that is no text must not keep all others from being told.
    odd = "backslashreplace"
    with (
        _in_place_of(target) as part,
        part.open("x", encoding="utf-8", errors=odd, newline="\n") as stream,
    ):
        yield stream


@contextmanager
def _in_place_of(target: Path) -> Iterator[Path]:
    """Give the path of a new file that becomes another when it is closed."""
    # A name under which nobody can have laid a link, and which fits beside any other.
    part = target.with_name(f".{secrets.token_hex(8)}.part")
    try:
        yield part
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def write_draws(target: Path, stages: Sequence[str], trees: Sequence[DataTree]) -> None:
    """Write draws as NetCDF: of one machine as ArviZ has it, of several under the name of each."""
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
