"""The registry of file formats: a new one is a module with a `Format`, and its name here."""

from pathlib import Path

from lmshealth.io import constants
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, load_by
from lmshealth.io.formats.csv import CSV, CSV_GZ
from lmshealth.io.formats.hdf5 import HDF5
from lmshealth.io.formats.isolation import read_isolated
from lmshealth.io.formats.mat import MAT
from lmshealth.io.formats.parquet import PARQUET
from lmshealth.io.formats.tdms import TDMS
from lmshealth.io.formats.uff import UFF
from lmshealth.io.formats.vendor_files import RTX, TRACE
from lmshealth.io.refusal import Unusable, corrupt, listed

# Binary formats first: text is recognised by the absence of other signatures.
FORMATS: tuple[Format, ...] = (HDF5, PARQUET, TDMS, MAT, CSV_GZ, RTX, TRACE, UFF, CSV)
SUFFIXES: tuple[str, ...] = tuple(sorted(s for form in FORMATS for s in form.suffixes))
# Exporters use them for delimited text, and people for notes: such files are read where they are
# named, and not collected from folders.
TEXT_SUFFIXES = (".txt", ".tsv", ".dat", ".asc")

_HEAD = 4096


def is_log(path: Path) -> bool:
    """Return whether a file of a folder has the suffix of a log."""
    return path.name.lower().endswith(SUFFIXES)


def format_of(path: Path) -> Format | None:
    """Return the format of a file's suffix; None for an unregistered one."""
    name = path.name.lower()
    if name.removesuffix(".gz").endswith(TEXT_SUFFIXES):
        return CSV_GZ if name.endswith(".gz") else CSV
    return next((form for form in FORMATS if name.endswith(form.suffixes)), None)


def format_name(path: Path) -> str:
    """Return the name of that format: the same bytes are another log in another format."""
    form = format_of(path)
    return "" if form is None else form.name


def load(path: Path, columns: ColumnMap, max_memory: float = constants.MAX_MEMORY) -> Content:
    """Read a file by the format of its suffix, which its first bytes must confirm.

    `Unusable`: ``format`` for an unknown suffix or another format's content, ``empty`` for 0 bytes,
    ``corrupt`` for content that cannot be read, and the reasons of the formats.
    """
    form = confirm(path)
    if form.library:
        return read_isolated(form, path, columns, max_memory)
    return load_by(form.name, form.load, path, columns, max_memory)


def confirm(path: Path) -> Format:
    """Return the format of a file's suffix, which its first bytes must confirm."""
    form = format_of(path)
    if form is None:
        known = (*SUFFIXES, *TEXT_SUFFIXES)
        raise Unusable("format", f"unknown suffix; needed one of {listed(known)}")
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    if not head:
        raise Unusable("empty", "0 bytes; copy the file again")
    if form.sniff(head):
        return form
    actual = next((other for other in FORMATS if other.sniff(head)), None)
    if actual is None:
        raise corrupt(f"does not start as {form.name} does")
    found = f"the suffix is that of {form.name}, the content is {actual.name}"
    raise Unusable("format", f"{found}; rename the file to {actual.suffixes[0]}")
