"""Conformance test of file formats, for the authors of plug-ins (io/README.md, Add a format)."""

import random
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from lmshealth.io import constants
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Format, load_by
from lmshealth.io.formats.registry import fault_of
from lmshealth.io.refusal import Unusable

# Beginnings of other formats, and of none.
_OTHERS = (b"\x89HDF\r\n\x1a\n", b"PAR1", b"TDSm\x0e\0\0\0", b"\x1f\x8b\x08\0", bytes(64))
_CUTS = 12


def check_format(
    form: Format,
    path: Path,
    expected: Mapping[str, ArrayLike],
    *,
    columns: ColumnMap | None = None,
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Check that a format keeps the protocol, on a file whose content is known.

    Parameters
    ----------
    form : Format
        The format; one with a ``library`` is called in this process.
    path : Path
        A file of at least 20 rows, with a suffix of the format. Cut copies are written beside it.
    expected : mapping of str to array_like, shape (n_samples,)
        Columns as they are in the file, of which at least one is a signal.
    columns : ColumnMap, optional
        The map by which the file is read, where its names are not those of the log contract.
    metadata : mapping of str to str, optional
        Metadata that the format must find.

    Raises
    ------
    AssertionError
        With what was found, and what the protocol needs.
    """
    used = ColumnMap() if columns is None else columns
    _check_fields(form, path)
    content = form.load(path, used, constants.MAX_MEMORY)
    assert not (fault := fault_of(content)), f"load returns {fault}"
    found, needed = set(content.columns), set(expected)
    assert found == needed, f"load returns the columns {found}, needed {needed}"
    assert content.present, "present is empty, needed the names of all columns"
    for name, values in expected.items():
        read = np.asarray(content.columns[name][:])
        np.testing.assert_array_equal(read, np.asarray(values), f"column {name!r} differs")
    for key, text in (metadata or {}).items():
        got = content.metadata.get(key)
        assert got == text, f"metadata {key!r} is {got!r}, needed {text!r}"
    nothing = ColumnMap(columns={"acc_absent_g": "no such column"})
    others = form.load(path, nothing, constants.MAX_MEMORY).columns
    wrong = [name for name in others if nothing.target(name) is None]
    assert not wrong, f"load returns {wrong}, which contract and column map do not name"
    _check_damaged(form, path, used, expected)


def _check_fields(form: Format, path: Path) -> None:
    assert isinstance(form, Format), f"it is a {type(form).__name__}, needed a Format"
    assert form.name and form.name.isprintable(), f"name is {form.name!r}, needed printable text"
    for suffix in form.suffixes:
        fine = suffix.startswith(".") and suffix == suffix.lower()
        assert fine, f"suffix {suffix!r} is not in lower case with a leading dot"
    assert path.name.lower().endswith(form.suffixes), f"{path.name} has no suffix of the format"
    if form.library:
        module, name = import_module(form.load.__module__), form.load.__qualname__
        assert getattr(module, name, None) is form.load, "load must be a function of a module"
    head = path.read_bytes()[:4096]
    assert form.sniff(head) is True, "sniff does not return True for the file"
    for other in (other for other in _OTHERS if other[:2] != head[:2]):
        assert form.sniff(other) is False, f"sniff does not return False for {other[:8]!r}"


def _check_damaged(
    form: Format, path: Path, columns: ColumnMap, expected: Mapping[str, ArrayLike]
) -> None:
    """Check that a file that is cut off or empty is refused, or read up to where it ends."""
    whole, rng = path.read_bytes(), random.Random(0)
    cut = path.with_name(f"cut_{path.name}")
    try:
        for size in [*sorted(rng.randrange(1, len(whole)) for _ in range(_CUTS)), 0]:
            cut.write_bytes(whole[:size])
            try:
                content = load_by(form.name, form.load, cut, columns, constants.MAX_MEMORY)
            except Unusable:
                continue
            for name, samples in content.columns.items():
                assert size or not samples.size, "load returns samples of an empty file"
                # The last number of a text that is cut off may be a part of one.
                read = np.asarray(samples[:])[:-1]
                fine = np.array_equal(read, np.asarray(expected[name])[: read.size], equal_nan=True)
                assert fine, f"cut off after {size} bytes, {name!r} has other values"
    finally:
        cut.unlink(missing_ok=True)
