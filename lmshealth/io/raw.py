"""What every format hands over: columns as they stand in the file, and metadata as text."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from lmshealth.io.buffers import Samples
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.log import Refusal
from lmshealth.io.refusal import Unusable

# Honest recordings are noise and compress by single digits; constant ones are refused anyway.
LARGEST_RATIO = 200
SMALL_ENOUGH = 256 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Raw:
    """A file's content before the contract is applied.

    Attributes
    ----------
    columns : dict of str to ndarray or Stored
        Wanted columns under their name in the file, each of shape ``(n_samples,)``.
    metadata : dict of str to str
        As the file has it.
    present : tuple of str
        All column names of the file, for messages.
    refused : tuple of Refusal
        Channels that are wanted and cannot go with the others; their log is not named yet.
    hint : str
        What in the column map may not fit the file, where wanted columns are not found.
    """

    columns: dict[str, Samples]
    metadata: dict[str, str]
    present: tuple[str, ...]
    refused: tuple[Refusal, ...] = ()
    hint: str = ""


@dataclass(frozen=True, slots=True)
class Format:
    """One file format.

    Attributes
    ----------
    name : str
        As users call it.
    suffixes : tuple of str
        In lower case, with the leading dot.
    sniff : callable
        Tells by the leading bytes of a file whether it is of this format.
    load : callable
        Read a file: path, column map, most memory in bytes. It may raise anything:
        `lmshealth.io.formats.registry.load` turns it into a refusal.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[bytes], bool]
    load: Callable[[Path, ColumnMap, float], Raw]


def size_limit(stored: int) -> int:
    """Bound in bytes for the decoded content of a file of ``stored`` bytes."""
    return max(SMALL_ENOUGH, LARGEST_RATIO * stored)


def check_size(decoded: int, stored: int) -> None:
    """Refuse content that would swell to an unreasonable size, before it does.

    Raises
    ------
    Unusable
        With reason ``too-large``.
    """
    if decoded > size_limit(stored):
        raise Unusable(
            "too-large",
            f"{stored} bytes would swell to {decoded} or more, allowed are {size_limit(stored)}; "
            "split the recording, or check where the file comes from",
        )


def wanted(names: Iterable[str], columns: ColumnMap) -> list[str]:
    """Choose the columns of a file that the contract or the column map ask for."""
    return [name for name in names if columns.target(name) is not None]


def missing_library(form: str, library: str) -> Unusable:
    """Say that the library which reads a format is not installed."""
    return Unusable("format", f"reading {form} needs {library}: pip install 'lmshealth[formats]'")


def not_numeric(column: str, found: str) -> Unusable:
    """Say that a column that is needed holds something else than numbers."""
    return Unusable("columns", f"column {column!r} holds {found}, needed one number per sample")
