"""Content of files: columns as they are in the file and metadata as text, or what holds no log."""

import gzip
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from lmshealth.io import constants
from lmshealth.io.buffers import Samples
from lmshealth.io.column_map import ColumnMap
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

    `Unusable`: ``too-large`` for more than the file can hold.
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


_EXPORT = "; export acceleration or following error over time as CSV, HDF5 or TDMS"
_SOUND = f", whose samples have no unit{_EXPORT}"
_PICTURE = f", which holds no samples{_EXPORT}"
_SHEET = "; save the sheet with the samples as CSV"
_ARCHIVE = "; unpack it and name the logs in it"
_ARRAYS = "; save its arrays as columns of CSV, HDF5 or Parquet"

# First bytes, what has them, and what is needed. Text follows below.
_SIGNATURES: tuple[tuple[str, str, str], ...] = (
    (r"RIFF....WAVE|RF64....WAVE", "a sound file (WAV)", _SOUND),
    (r"fLaC", "a sound file (FLAC)", _SOUND),
    (r"ID3[\x02-\x04]|\xff[\xf2\xf3\xfa\xfb][\x10-\xef]", "a sound file (MP3)", _SOUND),
    (r"OggS|FORM....AIF[FC]|caff\x00|\.snd\x00", "a sound file", _SOUND),
    (r"RIFF....AVI |....ftyp|\x1aE\xdf\xa3", "a film", _PICTURE),
    (r"\x89PNG\r\n", "a picture (PNG)", _PICTURE),
    (r"\xff\xd8\xff", "a picture (JPEG)", _PICTURE),
    (r"GIF8[79]a|BM....\x00\x00\x00\x00|II\*\x00|MM\x00\*|RIFF....WEBP", "a picture", _PICTURE),
    (r"%PDF-|%!PS", "a printed document (PDF or PostScript)", _PICTURE),
    (r"\{\\rtf", "a text document (RTF)", _PICTURE),
    (r"\xd0\xcf\x11\xe0", "an office file of the old kind (.xls, .doc, .ppt)", _SHEET),
    (r"Rar!\x1a|7z\xbc\xaf|\xfd7zXZ|BZh[1-9]1AY|\x28\xb5\x2f\xfd", "an archive", _ARCHIVE),
    (r".{257}ustar", "an archive (tar)", _ARCHIVE),
    (r"\x93NUMPY", "an array of NumPy", _ARRAYS),
    (r"ARROW1\x00|FEA1\x00", "a table of Arrow (Feather)", _ARRAYS),
    (r"SQLite format 3\x00", "a database (SQLite)", _ARRAYS),
    (r"(?:MDF|UnFinMF) +[34]\.", "a measurement in MDF", _EXPORT),
    (r"CDF[\x01\x02\x05]|\x0e\x03\x13\x01", "an array file (NetCDF or HDF4)", _ARRAYS),
    (r"\x7fELF|MZ.\x00", "a program", _EXPORT),
    (r"\s*solid\b[^\n]*\n\s*facet\b", "a geometry (STL)", _PICTURE),
    (r"ply\r?\nformat |OFF\r?\n\d+ \d+ \d+", "a geometry (PLY or OFF)", _PICTURE),
    (r"    -1[ \t]*\r?\n {1,5}\d{1,5}[ b\r\n]", "a universal file (UFF)", "; rename it to .uff"),
    (r"DIAEXTENDED", "the header of a DIAdem file, whose numbers are in others", _EXPORT),
    (r"ISO-10303-21", "a geometry (STEP)", _PICTURE),
    (r"(?:#[^\n]*\n|\s|(?:mtllib|o|g)\s[^\n]*\n)*v\s+\S+\s+\S+\s+\S+[^\n]*\n(?:vn?|f)\s",
     "a geometry (OBJ)", _PICTURE),
    (r"\s*(?:\{\s*[\"}]|\[\s*(?:[\[{\"]|-?\d[\d.eE+-]*\s*[,\]]))", "JSON", _ARRAYS),
    (r"\s*<(?:!(?:doctype|DOCTYPE) html|(?:html|HTML)\b)", "a page of the web (HTML)", _ARRAYS),
    (r"\s*(?:<\?xml\b|<svg\b|<\w+(?:\s[^<>]*)?>\s*<\w)", "an XML file", _ARRAYS),
)  # fmt: skip
_COMPILED = [
    (re.compile(f"(?s){pattern}".encode("latin-1")), name, needed)
    for pattern, name, needed in _SIGNATURES
]
# Names in a zip archive that make it a file of another kind.
_ZIPPED = (
    (r"xl/", "a workbook (.xlsx)", _SHEET),
    (r"word/|ppt/", "an office file", _PICTURE),
    (r".*\.npy$", "arrays of NumPy (.npz)", _ARRAYS),
    (r"content\.xml$", "a workbook or text of OpenDocument (.ods, .odt)", _SHEET),
)
_STL_HEAD, _STL_FACET = 84, 50
_INNER = 4096  # bytes that are unpacked

# Names of a column of frequencies.
_FREQUENCY = re.compile(
    r"(?:freq(?:uency|uenz|\.)?|fréquence|frequenza|frecuencia)[\W_]*(?:in\W*)?(?:k?hz)?\W*"
    r"|f[\W_]*(?:in\W*)?k?hz\W*|k?hz",
    re.IGNORECASE,
)


def describe(head: bytes, path: Path) -> str:
    """Return what a file is that holds no log, and what is needed; empty where it may be one.

    From its first bytes, also below gzip, and for archives and binary geometries from the file.
    """
    if head.startswith(GZIP):
        with suppress(zlib.error):
            inner = zlib.decompressobj(wbits=31).decompress(head, _INNER)
            return describe(inner, path) if not inner.startswith(GZIP) else ""
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return _zipped(path)
    for pattern, name, needed in _COMPILED:
        if pattern.match(head):
            return f"is {name}{needed}"
    n_facets = int.from_bytes(head[_STL_HEAD - 4 : _STL_HEAD], "little")
    if n_facets and path.stat().st_size == _STL_HEAD + n_facets * _STL_FACET:
        return f"is a geometry (STL){_PICTURE}"
    return ""


def _zipped(path: Path) -> str:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError):
        names = []
    for pattern, kind, needed in _ZIPPED:
        if any(re.match(pattern, name) for name in names):
            return f"is {kind}{needed}"
    return f"is a zip archive of {len(names)} files{_ARCHIVE}"


def frequency_column(names: Iterable[str]) -> str:
    """Return the first column where it holds frequencies, as of a spectrum; else empty."""
    first = next(iter(names), "")
    return first if _FREQUENCY.fullmatch(first.strip()) else ""


def over_frequency(column: str) -> Unusable:
    """Return the refusal of a table over frequency."""
    what = f"is a table over frequency (column {column!r}), as of a spectrum"
    needed = "needed samples over time, of which spectra are estimated"
    step = "`lmshealth frf` reads responses: frequency_hz with real and imag, or with magnitude"
    return Unusable("format", f"{what}; {needed}; {step} and phase_deg")
