"""MAT: names as MATLAB has them; what is no signal is refused, whatever size it claims."""

import struct
import zlib

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap, MatLayout
from lmshealth.io.reading import read_log
from tests.io.handmade import array, element, fields, mat_file, pack

NOISE = np.random.default_rng(0).normal(size=500)
RATE = {"sample_rate_hz": 1000.0}


def write(path, variables, packed=True):
    """Write variables with scipy."""
    scipy.io.savemat(path, variables, do_compression=packed)
    return path


def refused(path, reason, *words, **options):
    """Expect a refusal and look for words in its detail."""
    with pytest.raises(BadLog) as caught:
        read_log(path, **options)
    assert caught.value.reason == reason, caught.value
    for word in words:
        assert word in caught.value.detail


@pytest.mark.parametrize("packed", [True, False])
def test_variables(tmp_path, packed):
    """Vectors under names of the contract are read, whatever their direction and type."""
    counts = np.arange(500, dtype="i2")
    path = write(
        tmp_path / "log.mat",
        {"delta_e_um": NOISE[:, None], "acc_x_g": counts, "stage": "demo-Y", "note": "x", **RATE},
        packed,
    )
    log = read_log(path)
    values = {c.name: c.values for c in log.channels}
    np.testing.assert_allclose(values["delta_e"], NOISE * 1e-6)
    np.testing.assert_allclose(values["acc_x"], counts * 9.80665)
    assert log.sample_rate == 1000.0 and log.metadata.stage == "demo-Y"


@pytest.mark.parametrize("packed", [True, False])
def test_struct(tmp_path, packed):
    """Fields of a struct, entries of a struct array and columns of a matrix have MATLAB's names."""
    rows = np.array([(NOISE, "a"), (NOISE**2, "b")], dtype=[("Data", object), ("Name", object)])
    time = np.arange(500) / 1000
    log = {"X": {"Data": time}, "Y": rows, "M": np.stack([NOISE, NOISE**3], 1), **RATE}
    path = write(tmp_path / "log.mat", {"exp1": log, "other": 1.0}, packed)
    inside = ColumnMap(
        columns={"time_s": "X.Data", "delta_e_mm": "Y(2).Data", "acc_x_g": "M(:,2)"},
        mat=MatLayout("exp1"),
    )
    outside = ColumnMap(
        columns={k: f"exp1.{v}" for k, v in inside.columns.items()}, sample_rate_hz=1000.0
    )
    for columns in (inside, outside):
        read = read_log(path, columns=columns)
        values = {c.name: c.values for c in read.channels}
        np.testing.assert_allclose(values["delta_e"], NOISE**2 * 1e-3)
        np.testing.assert_allclose(values["acc_x"], NOISE**3 * 9.80665)
        assert read.sample_rate == 1000.0


def test_matrix_as_variable(tmp_path):
    """A matrix named by the map gives its columns."""
    path = write(tmp_path / "log.mat", {"log": np.stack([NOISE, NOISE**2], 1)})
    columns = ColumnMap(
        columns={"delta_e_um": "log(:,2)"}, sample_rate_hz=1e3, mat=MatLayout("log")
    )
    np.testing.assert_allclose(read_log(path, columns=columns).channels[0].values, NOISE**2 * 1e-6)


def test_what_is_missing_is_named(tmp_path):
    """A variable or a field that the map needs is named with what is there."""
    path = write(tmp_path / "log.mat", {"log": {"a": NOISE}, "b": 1.0})
    columns = ColumnMap(mat=MatLayout("exp1"))
    refused(path, "columns", "exp1", "log, b", columns=columns)
    columns = ColumnMap(columns={"delta_e_um": "c"}, mat=MatLayout("log"))
    refused(path, "columns", "needs c; there: a, b", columns=columns)


@pytest.mark.parametrize(
    ("value", "word"),
    [
        ("text", "text"),
        (NOISE + 1j, "complex numbers"),
        (np.ones((3, 4, 5)), "(3, 4, 5)"),
        (np.array([1.0, "a"], dtype=object), "cells"),
        (scipy.sparse.eye(3), "sparse"),
    ],
)
def test_no_series(tmp_path, value, word):
    """Text, complex numbers, cells, solids and sparse matrices are no signals."""
    path = write(tmp_path / "log.mat", {"delta_e_um": value, **RATE})
    refused(path, "columns", "delta_e_um", word)


def test_metadata_that_is_no_text(tmp_path):
    """A metadata key that holds an array is an error."""
    path = write(tmp_path / "log.mat", {"delta_e_um": NOISE, "sample_rate_hz": [1.0, 2.0]})
    refused(path, "metadata", "sample_rate_hz")


@pytest.mark.parametrize("kind", [3, 16, 17])
@pytest.mark.parametrize("packed", [True, False])
def test_objects_are_never_loaded(tmp_path, kind, packed):
    """Objects and functions are refused unread where they are wanted; elsewhere they are left."""
    wanted = array(kind, (1, 1), content=bytes(16))
    if kind != 17:  # those have no name that could be wanted
        refused(mat_file(tmp_path / "a.mat", pack(wanted, packed)), "columns", "save plain arrays")
    inner = array(kind, (1, 1), name=b"", content=bytes(16))
    wanted = pack(array(2, (1, 1), content=fields(b"x") + inner), packed)
    refused(mat_file(tmp_path / "b.mat", wanted), "columns", "save plain arrays")
    write(tmp_path / "c.mat", {"delta_e_um": NOISE, **RATE})
    good = (tmp_path / "c.mat").read_bytes()[128:]
    other = array(2, (1, 1), name=b"gadget", content=fields(b"x") + inner)
    assert read_log(mat_file(tmp_path / "d.mat", pack(other, packed), good)).channels


@pytest.mark.parametrize(
    "content",
    [
        array(6, (1 << 30, 1), content=element(9, bytes(80))),
        array(6, (-1, 10), content=element(9, bytes(80))),
        array(6, (10, 1), content=element(99, bytes(80))),
        array(2, (1, 1), content=element(5, struct.pack("<i", 0)) + element(1, b"")),
        array(2, (1 << 15, 1 << 15), content=fields(b"x")),
        array(2, (1, 1), content=fields(b"x") + element(6, bytes(8))),
        array(42, (10, 1), content=element(9, bytes(80))),
        element(14, element(6, bytes(4))),
        struct.pack("<II", 14, 1 << 31),
        struct.pack("<II", 15, 4) + b"none",
        b"\0\0\0",
    ],
)
def test_impossible_sizes(tmp_path, content):
    """Sizes that contradict each other are refused before memory is taken for them."""
    refused(mat_file(tmp_path / "log.mat", content), "corrupt")


@pytest.mark.parametrize(
    "claim", [array(4, (1, 1 << 30), content=element(4, b"")), array(1, (1 << 15, 1 << 15))]
)
def test_claims_of_what_is_not_read(tmp_path, claim):
    """Text and cells are no signals, whatever their size."""
    refused(mat_file(tmp_path / "log.mat", claim), "columns", "needed one number per sample")


def test_nesting(tmp_path):
    """Structs in structs without end are refused before they fill the stack."""
    inner = array(6, (0, 0), content=element(9, b""))
    for _ in range(200):
        inner = array(2, (1, 1), content=fields(b"x") + inner)
    refused(mat_file(tmp_path / "log.mat", inner), "corrupt", "nested")


@pytest.mark.slow
def test_bomb(tmp_path):
    """A variable that would swell to gigabytes is refused before it does."""
    squeeze = zlib.compressobj(9)
    size = 512 << 20
    zeros = bytes(1 << 20)
    head = array(6, (size // 8, 1), content=struct.pack("<II", 9, size))
    body = squeeze.compress(struct.pack("<II", 14, len(head) - 8 + size) + head[8:])
    body += b"".join(squeeze.compress(zeros) for _ in range(size >> 20)) + squeeze.flush()
    path = mat_file(tmp_path / "log.mat", struct.pack("<II", 15, len(body)), body)
    refused(path, "too-large", "swell")


def test_damaged_checksum(tmp_path):
    """A packed variable whose checksum is wrong is refused, even if its sizes are right."""
    path = write(tmp_path / "log.mat", {"delta_e_um": NOISE})
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    refused(path, "corrupt")


def test_more_than_claimed(tmp_path):
    """A packed variable that goes on behind its end is damaged."""
    good = array(6, (2, 1), content=element(9, bytes(16)))
    refused(mat_file(tmp_path / "log.mat", pack(good + bytes(8))), "corrupt", "damaged")
    refused(mat_file(tmp_path / "log.mat", pack(good[:-8])), "corrupt", "cut off")


def test_version_7_3(tmp_path):
    """The version that is HDF5 inside is named with what to do."""
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    (tmp_path / "log.mat").write_bytes(head.ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n")
    refused(tmp_path / "log.mat", "format", "-v7")


def test_same_variable_twice(tmp_path):
    """A variable that stands in the file twice is ambiguous."""
    path = write(tmp_path / "log.mat", {"delta_e_um": NOISE, **RATE})
    data = path.read_bytes()
    path.write_bytes(data + data[128:])
    refused(path, "columns", "more than once")
