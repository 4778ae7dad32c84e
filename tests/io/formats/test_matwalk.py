"""Arrays of MAT-files: every way of storing them as scipy reads it, in blocks of any size."""

import struct

import numpy as np
import pytest
import scipy.io

from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats import matbytes, matwalk
from lmshealth.io.formats.registry import load
from lmshealth.io.refusal import Unusable
from tests.io.handmade import array, element, fields, mat_file, pack

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
VALUES = np.arange(99) % 100


def vector(values, *, stored="f8", order="<", name=b"delta_e_um", sizes=None):
    """Write a vector of the class double in another type."""
    kind = next(kind for kind, code in TYPES.items() if code == stored)
    data = element(kind, values.astype(order + stored).tobytes(), order)
    return array(6, sizes or (values.size, 1), name, data, order)


def small(kind, data, order="<"):
    """Write up to four bytes inside their tag."""
    return struct.pack(order + "I", len(data) << 16 | kind) + data.ljust(4, b"\0")


@pytest.mark.parametrize("block", [8, 1 << 20])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("stored", TYPES.values())
def test_stored_types(tmp_path, monkeypatch, stored, order, packed, block):
    """Numbers are read from whatever type they are stored in, packed or not, in either order."""
    monkeypatch.setattr(matwalk, "_BLOCK", block)
    monkeypatch.setattr(matbytes, "_BLOCK", block)
    made = pack(vector(VALUES, stored=stored, order=order), packed, order)
    path = mat_file(tmp_path / "log.mat", made, order=order)
    values = load(path, ColumnMap()).columns["delta_e_um"]
    np.testing.assert_array_equal(values, VALUES)
    np.testing.assert_array_equal(values, scipy.io.loadmat(path)["delta_e_um"].ravel())


@pytest.mark.parametrize("packed", [False, True])
def test_columns_of_a_matrix(tmp_path, monkeypatch, packed):
    """The wanted columns of a matrix are read, whatever stands between them."""
    monkeypatch.setattr(matwalk, "_BLOCK", 96)
    table = np.random.default_rng(0).normal(size=(50, 5))
    scipy.io.savemat(tmp_path / "log.mat", {"m": table, "n": table}, do_compression=packed)
    names = {"delta_e_um": "m(:,2)", "acc_x_g": "m(:,5)", "acc_y_g": "n(:,1)"}
    raw = load(tmp_path / "log.mat", ColumnMap(columns=names))
    assert set(raw.columns) == set(names.values()) and len(raw.present) == 10
    np.testing.assert_array_equal(raw.columns["m(:,2)"], table[:, 1])
    np.testing.assert_array_equal(raw.columns["m(:,5)"], table[:, 4])
    np.testing.assert_array_equal(raw.columns["n(:,1)"], table[:, 0])


def test_entries_of_a_struct(tmp_path):
    """Entries of a struct have MATLAB's numbers, down the columns; empty fields are no arrays."""
    content = b"".join(vector(VALUES[:k], name=b"") + element(14, b"") for k in (1, 2, 3, 4, 5, 6))
    made = array(2, (2, 3), content=fields(b"x", b"none") + content)
    columns = load(mat_file(tmp_path / "log.mat", made), ColumnMap()).columns
    assert {name: values.size for name, values in columns.items()} == {
        f"delta_e_um({k}).x": k for k in (1, 2, 3, 4, 5, 6)
    }


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("kind", "encoding"),
    [(1, "latin-1"), (2, "latin-1"), (4, "utf-16"), (16, "utf-8"), (17, "utf-16"), (18, "utf-32")],
)
def test_text(tmp_path, kind, encoding, order):
    """Text is read in its encoding, and the shortest stands inside a tag."""
    end = {"<": "-le", ">": "-be"}[order] if encoding in ("utf-16", "utf-32") else ""
    written = element(kind, "Bühne ä".encode(encoding + end), order)
    path = mat_file(
        tmp_path / "log.mat",
        array(4, (1, 7), b"stage", written, order),
        array(4, (1, 1), b"servo_id", small(2, b"B", order), order),
        array(4, (0, 0), b"description", element(kind, b"", order), order),
        order=order,
    )
    metadata = load(path, ColumnMap()).metadata
    assert metadata == {"stage": "Bühne ä", "servo_id": "B", "description": ""}


def test_numbers_as_metadata(tmp_path):
    """A whole number reads alike, however it is stored."""
    path = mat_file(
        tmp_path / "log.mat",
        array(6, (1, 1), b"servo_id", small(2, b"\3")),
        vector(np.array([1.0]), name=b"baseline"),
        vector(np.array([12.25]), name=b"travel_km"),
    )
    metadata = load(path, ColumnMap()).metadata
    assert metadata == {"servo_id": "3", "baseline": "1", "travel_km": "12.25"}


@pytest.mark.parametrize("sizes", [(2, 99), (98, 1), (99, 1, 2)])
def test_other_numbers_of_entries(tmp_path, sizes):
    """An array whose content is not as long as its shape says is refused."""
    with pytest.raises(Unusable, match="cut off") as caught:
        load(mat_file(tmp_path / "log.mat", vector(VALUES, sizes=sizes)), ColumnMap())
    assert caught.value.reason == "corrupt"


def test_unreadable_text(tmp_path):
    """Metadata of several lines or without an end are refused."""
    for sizes, text in (((2, 3), b"abcdef"), ((1, 2 << 20), bytes(2 << 20))):
        made = array(4, sizes, b"stage", element(2, text))
        with pytest.raises(Unusable):
            load(mat_file(tmp_path / "log.mat", made), ColumnMap())


def test_small_types_that_swell(tmp_path):
    """Numbers of one byte count with the eight bytes that they take when they are read."""
    with pytest.raises(Unusable, match="would swell to 480000000") as caught:
        made = vector(np.zeros(60_000_000, dtype="i1"), stored="i1")
        load(mat_file(tmp_path / "log.mat", pack(made)), ColumnMap())
    assert caught.value.reason == "too-large"


@pytest.mark.parametrize(
    ("n", "item"),
    [(100_000, element(14, b"")), (100, vector(VALUES[:0], name=b"", sizes=(0, 900)))],
)
def test_arrays_without_end(tmp_path, n, item):
    """A variable with a huge number of arrays is refused before their names fill the memory."""
    made = array(2, (n, 1), content=fields(b"x") + item * n)
    with pytest.raises(Unusable, match="arrays; save the log by itself"):
        load(mat_file(tmp_path / "log.mat", made), ColumnMap())
