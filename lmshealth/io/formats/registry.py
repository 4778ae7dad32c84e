"""The registry of file formats: those of the project, and those of plug-ins.

A plug-in is a `Format` under the entry-point group ``lmshealth.formats`` of an installed package.
"""

import re
from collections.abc import Sequence
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth._private import load_plug_ins
from lmshealth.io import constants
from lmshealth.io.buffers import Stored
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, describe, gzipped, load_by, without_epoch
from lmshealth.io.formats.csv import CSV
from lmshealth.io.formats.instruments import RTX, TDMS, TRACE
from lmshealth.io.formats.isolation import read_isolated
from lmshealth.io.formats.native import HDF5, MAT, PARQUET
from lmshealth.io.formats.uff import UFF
from lmshealth.io.refusal import Unusable, corrupt, listed

# Exporters use them for delimited text, and people for notes: such files are read where they are
# named, and collected from folders if they are compressed or `holds_samples`.
TEXT_SUFFIXES = (".txt", ".tsv", ".dat", ".asc")
# Binary formats first: text is recognised by the absence of other signatures.
FORMATS: tuple[Format, ...] = (
    *(HDF5, PARQUET, TDMS, MAT),
    *(gzipped(CSV, TEXT_SUFFIXES), *map(gzipped, (RTX, TRACE, UFF))),
    *(RTX, TRACE, UFF, CSV),
)
SUFFIXES = tuple(sorted(suffix for form in FORMATS for suffix in form.suffixes))
GROUP = "lmshealth.formats"

_HEAD = 4096
_NUMBERS = re.compile(rb'(?i)(?=.*\d|.*nan)(?:[\d\s.,;:|/+\-eTZ"]|nan|inf)+')


@cache
def plug_ins() -> tuple[Format, ...]:
    """Load the formats of plug-ins; one that cannot be used is logged as an error, once."""
    return load_plug_ins(GROUP, "format", FORMATS, _checked)[len(FORMATS) :]


def _checked(form: Any, others: Sequence[Format]) -> Format:
    """Return the format of a plug-in; `TypeError` or `ValueError` if it is none."""
    if not isinstance(form, Format):
        raise TypeError(f"it is a {type(form).__name__}, needed a Format")
    taken = {suffix for other in others for suffix in other.suffixes} | set(TEXT_SUFFIXES)
    if not form.suffixes or any(suffix.endswith(tuple(taken)) for suffix in form.suffixes):
        found = f"its suffixes are {listed(form.suffixes)}"
        raise ValueError(f"{found}, needed some that are not taken")
    return form


def is_log(path: Path) -> bool:
    """Return whether a file of a folder has the suffix of a log."""
    return not path.name.lower().endswith(TEXT_SUFFIXES) and format_of(path) is not None


def holds_samples(path: Path) -> bool:
    """Return whether a file, of any suffix, begins as a text that continues as rows of numbers.

    Notes, reports and short tables do not; numbers include moments, NaN and infinity.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(constants.SAMPLED_BYTES)
    except OSError:
        return False
    if head.lstrip()[:1] in (b"{", b"[", b"<"):  # JSON, XML, HTML
        return False
    lines = head.replace(b"\0", b"").splitlines()  # UTF-16 has a zero beside each character
    is_cut = len(head) == constants.SAMPLED_BYTES
    rows = takewhile(_NUMBERS.fullmatch, reversed(lines[:-1] if is_cut else lines))
    needed = constants.SAMPLED_ROWS_CUT if is_cut else constants.SAMPLED_ROWS
    return sum(1 for _ in rows) >= needed


def format_of(path: Path) -> Format | None:
    """Return the format of a file's suffix; None for an unregistered one."""
    name = path.name.lower()
    if name.endswith(TEXT_SUFFIXES):
        return CSV
    own = next((form for form in FORMATS if name.endswith(form.suffixes)), None)
    return own or next((form for form in plug_ins() if name.endswith(form.suffixes)), None)


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
        content = read_isolated(form, path, columns, max_memory)
    else:
        content = load_by(form.name, form.load, path, columns, max_memory)
    if form not in FORMATS and (fault := fault_of(content)):
        raise Unusable("format", f"the plug-in for {form.name} returns {fault}; update it")
    return without_epoch(content, columns)


def fault_of(content: object) -> str:
    """Return what of a content breaks the protocol of formats; empty where nothing does."""
    if not isinstance(content, Content):
        return f"a {type(content).__name__} in place of a Content"
    for name, samples in content.columns.items():
        array = (
            isinstance(samples, np.ndarray) and samples.ndim == 1 and samples.dtype.kind in "fiu"
        )
        if not isinstance(name, str) or not (array or isinstance(samples, Stored)):
            return f"column {name!r} that is no array of numbers of one dimension"
    for key, text in content.metadata.items():
        if not isinstance(text, str):
            return f"metadata {key!r} that are no text"
    return ""


def confirm(path: Path) -> Format:
    """Return the format of a file's suffix, which its first bytes must confirm."""
    form = format_of(path)
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    if not head:
        raise Unusable("empty", "0 bytes; copy the file again")
    name = format_name(path)
    try:
        if form is not None and form.sniff(head):
            return form
    except Exception as error:
        if form in FORMATS:
            raise
        detail = f"the plug-in for {name} fails ({type(error).__name__}: {error}); update it"
        raise Unusable("format", detail) from error
    if foreign := describe(head, path):
        raise Unusable("format", foreign)
    actual = next((other for other in FORMATS if other.sniff(head)), None)
    found = f"unknown suffix {path.suffix!r}"
    if form is None and actual in (None, CSV):
        known = (*SUFFIXES, *TEXT_SUFFIXES, *(s for own in plug_ins() for s in own.suffixes))
        step = "rename text to .csv, save other arrays as columns of HDF5 or Parquet"
        raise Unusable("format", f"{found}; needed one of {', '.join(known)}; {step}")
    if actual is None:
        raise corrupt(f"does not start as {name} does")
    found = f"the suffix is that of {name}" if name else found
    step = f"rename the file to {actual.suffixes[0]}"
    raise Unusable("format", f"{found}, the content is {actual.name}; {step}")
