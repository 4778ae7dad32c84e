"""MAT: names as MATLAB has them, objects and impossible sizes refused before scipy sees them."""

import struct
import zlib

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from lmshealth.errors import BadLog
from lmshealth.readers import ColumnMap, read_log
from lmshealth.readers.columns import MatLayout

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


def element(kind, data):
    """Write a data element of a MAT-file, padded to 8 bytes."""
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def array(kind, sizes, name=b"delta_e_um", content=b""):
    """Write an array of a class with anything as its content."""
    return element(
        14,
        element(6, struct.pack("<II", kind, 0))
        + element(5, struct.pack(f"<{len(sizes)}i", *sizes))
        + element(1, name)
        + content,
    )


def raw(path, *elements):
    """Write a file of hand-made elements."""
    head = b"MATLAB 5.0 MAT-file, hand-made".ljust(124) + b"\x00\x01IM"
    path.write_bytes(head + b"".join(elements))
    return path


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
        ("text", "<U4"),
        (NOISE + 1j, "complex128"),
        (np.ones((3, 4, 5)), "(3, 4, 5)"),
        (np.array([1.0, "a"], dtype=object), "object"),
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
    """Objects and functions are refused unread, also inside a struct; elsewhere they are left."""
    thing = array(kind, (1, 1), name=b"", content=bytes(16))
    fields = element(5, struct.pack("<i", 8)) + element(1, b"x".ljust(8, b"\0"))
    outer = array(2, (1, 1), content=fields + thing)
    other = array(kind, (1, 1), name=b"gadget", content=bytes(16))
    if packed:
        outer, other = (
            element(15, zlib.compress(x))[: 8 + len(zlib.compress(x))] for x in (outer, other)
        )
    refused(raw(tmp_path / "a.mat", outer), "columns", "save plain arrays")
    write(tmp_path / "b.mat", {"delta_e_um": NOISE, **RATE})
    good = (tmp_path / "b.mat").read_bytes()[128:]
    assert read_log(raw(tmp_path / "c.mat", other, good)).channels


@pytest.mark.parametrize(
    "content",
    [
        array(6, (1 << 30, 1), content=element(9, bytes(80))),
        array(6, (-1, 10), content=element(9, bytes(80))),
        array(6, (10, 1), content=element(99, bytes(80))),
        array(4, (1, 1 << 30), content=element(4, b"")),
        array(1, (1 << 15, 1 << 15)),
        array(2, (1, 1), content=element(5, struct.pack("<i", 0)) + element(1, b"")),
        array(42, (10, 1), content=element(9, bytes(80))),
        element(14, element(6, bytes(4))),
        struct.pack("<II", 14, 1 << 31),
        struct.pack("<II", 15, 4) + b"none",
        b"\0\0\0",
    ],
)
def test_impossible_sizes(tmp_path, content):
    """Sizes that contradict each other are refused before memory is taken for them."""
    refused(raw(tmp_path / "log.mat", content), "corrupt")


def test_nesting(tmp_path):
    """Cells in cells without end are refused before they fill the stack."""
    inner = b""
    for _ in range(200):
        inner = array(1, (1, 1), content=inner or array(6, (0, 0), content=element(9, b"")))
    refused(raw(tmp_path / "log.mat", inner), "corrupt", "nested")


def test_bomb(tmp_path):
    """A variable that would swell to gigabytes is refused before it does."""
    squeeze = zlib.compressobj(9)
    size = 512 << 20
    zeros = bytes(1 << 20)
    head = array(6, (size // 8, 1), content=struct.pack("<II", 9, size))
    body = squeeze.compress(struct.pack("<II", 14, len(head) - 8 + size) + head[8:])
    body += b"".join(squeeze.compress(zeros) for _ in range(size >> 20)) + squeeze.flush()
    path = raw(tmp_path / "log.mat", struct.pack("<II", 15, len(body)), body)
    refused(path, "too-large", "swell")


def test_damaged_checksum(tmp_path):
    """A packed variable whose checksum is wrong is refused, even if its sizes are right."""
    path = write(tmp_path / "log.mat", {"delta_e_um": NOISE})
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    refused(path, "corrupt")


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


def test_big_endian(tmp_path):
    """A file written on a machine of the other order of bytes is read alike."""
    swap = NOISE.astype(">f8").tobytes()
    flags = struct.pack(">II", 6, 8) + struct.pack(">II", 6, 0)
    sizes = struct.pack(">II", 5, 8) + struct.pack(">ii", NOISE.size, 1)
    name = struct.pack(">II", 1, 10) + b"delta_e_um".ljust(16, b"\0")
    body = flags + sizes + name + struct.pack(">II", 9, len(swap)) + swap
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI"
    (tmp_path / "log.mat").write_bytes(head + struct.pack(">II", 14, len(body)) + body)
    log = read_log(tmp_path / "log.mat", columns=ColumnMap(sample_rate_hz=1000.0))
    np.testing.assert_allclose(log.channels[0].values, NOISE * 1e-6)
