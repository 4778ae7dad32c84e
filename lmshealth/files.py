"""Files that commands write: folders are made, and what keeps a file from being written is told."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lmshealth.errors import BadTable

if TYPE_CHECKING:
    from xarray import DataTree


def write_text(target: Path, text: str) -> None:
    """Write a text, folders included."""
    with _writing(target):
        target.write_text(text)


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
