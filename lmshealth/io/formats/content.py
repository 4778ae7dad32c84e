"""What every format returns: columns as they are in the file, and metadata as text."""

import gzip
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from lmshealth.io import constants
from lmshealth.io.buffers import Samples
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.foreign import describe
from lmshealth.io.log import Refusal
from lmshealth.io.refusal import Unusable, corrupt, listed, repeated

GZIP = b"\x1f\x8b"
_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """Content of a file before the log contract is applied.

    ``columns`` are the wanted ones under their names in the file, ``(n_samples,)`` each; metadata
    are text as in the file; ``present`` are the names of all columns, for messages. Refused are
    wanted channels that cannot go with the others; the name of the log is added later. ``guessed``
    lists what neither the file nor the column map states; ``late`` has the number of samples by
    which a column starts after those that are not in it.
    """

    columns: dict[str, Samples]
    metadata: dict[str, str]
    present: tuple[str, ...]
    refused: tuple[Refusal, ...] = ()
    guessed: tuple[str, ...] = ()
    late: dict[str, int] = field(default_factory=dict)


Load = Callable[[Path, ColumnMap, float], Content]


@dataclass(frozen=True, slots=True)
class Format:
    """One file format.

    ``name`` is for messages; the suffixes are in lower case, with the leading dot; ``sniff``
    returns whether a file has this format from its leading bytes; ``load`` reads a file: path,
    column map, most memory in bytes. It may raise anything: `load_by` turns it into a refusal.
    With a ``library``, native code that can crash or hang, it is called in a process of its own,
    and must be a function of a module.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[bytes], bool]
    load: Load
    library: str = ""


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """Copy a file that gzip compressed to a temporary one as it was; other files are yielded.

    `Unusable`: ``too-large`` for more than the file can honestly hold.
    """
    with path.open("rb") as stream:
        packed = stream.read(len(GZIP)) == GZIP
    if not packed:
        yield path
        return
    stored, size = path.stat().st_size, 0
    with TemporaryDirectory(prefix="lmshealth-") as folder:
        copy = Path(folder) / path.name[: -len(".gz")]
        with gzip.open(path) as whole, copy.open("wb") as target:
            for block in iter(partial(whole.read, _BLOCK), b""):
                size += target.write(block)
                check_size(size, stored)
        yield copy


def gzipped(form: Format, others: Iterable[str] = ()) -> Format:
    """Return the format of such files that gzip compressed, also of those with other suffixes."""

    def load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
        with unpacked(path) as copy:
            with copy.open("rb") as stream:
                head = stream.read(_BLOCK >> 8)
                if not form.sniff(head):
                    if foreign := describe(head, copy):
                        raise Unusable("format", foreign)
                    raise corrupt(f"its content does not start as {form.name} does")
            return form.load(copy, columns, max_memory)

    suffixes = tuple(f"{suffix}.gz" for suffix in (*form.suffixes, *others))
    return Format(f"gzipped {form.name}", suffixes, lambda head: head.startswith(GZIP), load)


def load_by(form: str, load: Load, path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Read a file by the function of its format; whatever that raises becomes `Unusable`."""
    try:
        return load(path, columns, max_memory)
    except Unusable:
        raise
    except MemoryError as error:
        detail = f"reading it as {form} takes more memory than a log of its size does"
        raise Unusable("too-large", f"{detail}; copy the file again") from error
    except Exception as error:
        # Libraries raise any exception on damaged files; one file must not end a batch.
        text = " ".join(str(error).split())[:200]
        detail = f"cannot be read as {form} ({type(error).__name__}: {text})"
        raise Unusable("corrupt", detail) from error


def check_size(decoded: int, stored: int) -> None:
    """Refuse (``too-large``) what would decode to an unreasonable size, before it does."""
    limit = max(constants.SMALL_ENOUGH, constants.LARGEST_RATIO * stored)
    if decoded > limit:
        found = f"{stored} bytes would swell to {decoded} or more, allowed are {limit}"
        needed = "split the recording, or check where the file comes from"
        raise Unusable("too-large", f"{found}; {needed}")


def check_memory(what: str, needed: float, allowed: float) -> None:
    """Refuse (``too-large``) a part of a file that takes too much memory, before it is read."""
    if needed > allowed:
        found = f"needs {needed / 1e9:.2g} GB of memory, allowed are {allowed / 1e9:.2g} GB"
        step = "convert the file to HDF5 or Parquet, or raise --max-memory"
        raise Unusable("too-large", f"{what} {found}; {step}")


def wanted(names: Iterable[str], columns: ColumnMap) -> list[str]:
    """Choose the columns that contract or column map name; refuse (``columns``) a name twice."""
    chosen = [name for name in names if columns.target(name) is not None]
    if twice := repeated(chosen):
        raise Unusable("columns", f"the file names {listed(twice)} more than once")
    if len(chosen) > constants.MOST_COLUMNS:
        found = f"{len(chosen)} columns of signals, at most {constants.MOST_COLUMNS} are read"
        raise Unusable("columns", f"{found}; name those of the log in a column map (--columns)")
    return chosen


@contextmanager
def library(form: str, name: str) -> Iterator[None]:
    """Import the library of a format, or refuse the file if it is not installed."""
    try:
        yield
    except ImportError as error:
        needed = f"reading {form} needs {name}: pip install 'lmshealth[formats]'"
        raise Unusable("format", needed) from error


def not_numeric(column: str, found: str) -> Unusable:
    """Return the refusal of a wanted column that holds no series of numbers."""
    return Unusable("columns", f"column {column!r} holds {found}, needed one number per sample")
