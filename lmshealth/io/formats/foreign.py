"""Files that hold no log: what they are by their first bytes, and what is needed in their place."""

import re
import zipfile
import zlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from lmshealth.io.refusal import Unusable

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
_GZIP, _INNER = b"\x1f\x8b", 4096

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
    if head.startswith(_GZIP):
        with suppress(zlib.error):
            inner = zlib.decompressobj(wbits=31).decompress(head, _INNER)
            return describe(inner, path) if not inner.startswith(_GZIP) else ""
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
