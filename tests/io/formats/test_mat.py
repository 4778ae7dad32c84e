"""MAT: names as MATLAB has them; all but signals are refused, whatever size they claim."""

import struct
import zlib

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap, MatLayout
from lmshealth.io.formats.registry import load
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable
from tests.io.handmade import array, element, fields, mat_file, pack

NOISE = np.random.default_rng(0).normal(size=500)
RATE = {"sample_rate_hz": 1000.0}


def write(path, variables, packed=True):
    """Write variables with scipy."""
    scipy.io.savemat(path, variables, do_compression=packed)
    return path


def refused(path, reason, *words, **options):
    """Expect a refusal with words in its detail."""
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
    values = {c.name: c.values[:] for c in log.channels}
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
        values = {c.name: c.values[:] for c in read.channels}
        np.testing.assert_allclose(values["delta_e"], NOISE**2 * 1e-3)
        np.testing.assert_allclose(values["acc_x"], NOISE**3 * 9.80665)
        assert read.sample_rate == 1000.0


def test_matrix_as_variable(tmp_path):
    """A matrix named by the map gives its columns."""
    path = write(tmp_path / "log.mat", {"log": np.stack([NOISE, NOISE**2], 1)})
    columns = ColumnMap(
        columns={"delta_e_um": "log(:,2)"}, sample_rate_hz=1e3, mat=MatLayout("log")
    )
    np.testing.assert_allclose(
        read_log(path, columns=columns).channels[0].values[:], NOISE**2 * 1e-6
    )


def test_what_is_missing_is_named(tmp_path):
    """A variable or a field that the map needs is named with those that are there."""
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


def foreign(kind, name):
    """Write an object (3), a function (16), or an object of a newer class (17), without a name."""
    value = vector(VALUES, name=b"")
    if kind == 17:
        words = element(1, b"") + element(1, b"MCOS") + element(1, b"gadget")
        return element(14, element(6, struct.pack("<II", kind, 0)) + words + value)
    content = value if kind == 16 else element(1, b"gadget") + fields(b"x") + value
    return array(kind, (1, 1), name=name, content=content)


@pytest.mark.parametrize("kind", [3, 16, 17])
@pytest.mark.parametrize("packed", [True, False])
def test_objects_are_never_loaded(tmp_path, kind, packed):
    """Objects and functions are refused where they are wanted; elsewhere they are left."""
    if kind != 17:  # those have no name that could be wanted
        wanted = array(kind, (1, 1), content=bytes(16))
        refused(mat_file(tmp_path / "a.mat", pack(wanted, packed)), "columns", "save plain arrays")
    inner = foreign(kind, b"")
    wanted = pack(array(2, (1, 1), content=fields(b"x") + inner), packed)
    refused(mat_file(tmp_path / "b.mat", wanted), "columns", "save plain arrays")
    write(tmp_path / "c.mat", {"delta_e_um": NOISE, **RATE})
    good = (tmp_path / "c.mat").read_bytes()[128:]
    other = array(2, (1, 1), name=b"gadget", content=fields(b"x") + inner)
    assert read_log(mat_file(tmp_path / "d.mat", pack(other, packed), good)).channels


@pytest.mark.parametrize(
    "content",
    [
        array(6, (1 << 20, 1), content=element(9, bytes(80))),
        array(6, (-1, 10), content=element(9, bytes(80))),
        array(6, (10, 1), content=element(99, bytes(80))),
        array(2, (1, 1), content=element(5, struct.pack("<i", 0)) + element(1, b"")),
        array(2, (1 << 10, 1 << 10), content=fields(b"x")),
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


@pytest.mark.parametrize(("kind", "rest"), [(6, element(9, bytes(80))), (2, fields(b"x"))])
def test_claims_of_gigabytes(tmp_path, kind, rest):
    """Numbers that do not fit into the file are refused before memory is taken for them."""
    content = array(kind, (1 << 15, 1 << 15), content=rest)
    refused(mat_file(tmp_path / "log.mat", content), "too-large", "swell")


@pytest.mark.parametrize(
    "claim", [array(4, (1, 1 << 30), content=element(4, b"")), array(1, (1 << 15, 1 << 15))]
)
def test_claims_of_what_is_not_read(tmp_path, claim):
    """Text and cells are no signals, whatever their size."""
    refused(mat_file(tmp_path / "log.mat", claim), "columns", "needed one number per sample")


def test_nesting(tmp_path):
    """Structs in structs without end are refused, and fill no stack of this process."""
    inner = array(6, (0, 0), content=element(9, b""))
    for _ in range(2000):
        inner = array(2, (1, 1), content=fields(b"x") + inner)
    refused(mat_file(tmp_path / "log.mat", inner), "corrupt")


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
    """A packed variable that continues after its end is damaged."""
    good = array(6, (2, 1), content=element(9, bytes(16)))
    refused(mat_file(tmp_path / "log.mat", pack(good + bytes(8))), "corrupt", "corrupted")
    refused(mat_file(tmp_path / "log.mat", pack(good[:-8])), "corrupt")


def test_version_7_3(tmp_path):
    """The version that is HDF5 inside is named with what to do."""
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    (tmp_path / "log.mat").write_bytes(head.ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n")
    refused(tmp_path / "log.mat", "format", "-v7")


def test_same_variable_twice(tmp_path):
    """Two variables of one name are ambiguous."""
    path = write(tmp_path / "log.mat", {"delta_e_um": NOISE, **RATE})
    data = path.read_bytes()
    path.write_bytes(data + data[128:])
    refused(path, "columns", "more than once")


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


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("stored", TYPES.values())
def test_stored_types(tmp_path, stored, order, packed):
    """Numbers are read from whatever type they are stored in, packed or not, in either order."""
    made = pack(vector(VALUES, stored=stored, order=order), packed, order)
    path = mat_file(tmp_path / "log.mat", made, order=order)
    values = load(path, ColumnMap()).columns["delta_e_um"]
    np.testing.assert_array_equal(values, VALUES)
    np.testing.assert_array_equal(values, scipy.io.loadmat(path)["delta_e_um"].ravel())


@pytest.mark.parametrize("packed", [False, True])
def test_columns_of_a_matrix(tmp_path, packed):
    """The wanted columns of a matrix are read, whatever is between them."""
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
    [(4, "utf-16"), (16, "utf-8"), (17, "utf-16"), (18, "utf-32")],
)
def test_text(tmp_path, kind, encoding, order):
    """Text is read in its encoding; one byte per letter is ASCII; the shortest is inside a tag."""
    end = {"<": "-le", ">": "-be"}[order] if encoding in ("utf-16", "utf-32") else ""
    written = element(kind, "Bühne ä".encode(encoding + end), order)
    path = mat_file(
        tmp_path / "log.mat",
        array(4, (1, 7), b"stage", written, order),
        array(4, (1, 1), b"servo_id", small(2, b"B", order), order),
        array(4, (1, 4), b"travel_km", element(2, b"12.5", order), order),
        array(4, (0, 0), b"description", element(kind, b"", order), order),
        order=order,
    )
    metadata = load(path, ColumnMap()).metadata
    read = {"stage": "Bühne ä", "servo_id": "B", "travel_km": "12.5", "description": ""}
    assert metadata == read


@pytest.mark.parametrize("kind", [1, 2])
def test_text_in_an_unknown_encoding(tmp_path, kind):
    """Letters of one byte that are not ASCII are refused: the file does not name their encoding."""
    made = array(4, (1, 7), b"stage", element(kind, "Bühne ä".encode("latin-1")))
    refused(mat_file(tmp_path / "log.mat", vector(VALUES), made), "metadata", "MATLAB 7")


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
    """An array whose content has another length than its shape is refused."""
    with pytest.raises(Unusable) as caught:
        load(mat_file(tmp_path / "log.mat", vector(VALUES, sizes=sizes)), ColumnMap())
    assert caught.value.reason == "corrupt"


def test_unreadable_text(tmp_path):
    """Metadata of several lines are refused."""
    made = array(4, (2, 3), b"stage", element(2, b"abcdef"))
    with pytest.raises(Unusable, match="stage is no single text"):
        load(mat_file(tmp_path / "log.mat", made), ColumnMap())


def test_small_types_that_swell(tmp_path):
    """Numbers of one byte count with the eight bytes that they take when they are read."""
    with pytest.raises(Unusable, match="would swell to 480000000") as caught:
        made = vector(np.zeros(60_000_000, dtype="i1"), stored="i1")
        load(mat_file(tmp_path / "log.mat", pack(made)), ColumnMap())
    assert caught.value.reason == "too-large"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "item"),
    [
        (30_000, vector(np.zeros(1), name=b"")),
        (100, vector(np.zeros(1800), name=b"", sizes=(2, 900))),
    ],
)
def test_arrays_without_end(tmp_path, n, item):
    """A variable with a huge number of arrays is refused before their names fill the memory."""
    made = array(2, (n, 1), content=fields(b"x") + item * n)
    with pytest.raises(Unusable, match="arrays; save the log by itself"):
        load(mat_file(tmp_path / "log.mat", made), ColumnMap())


@pytest.mark.parametrize("packed", [False, True])
def test_limit_of_memory(tmp_path, packed):
    """A variable that takes more memory than allowed is refused with the next step."""
    path = mat_file(tmp_path / "log.mat", pack(vector(VALUES), packed))
    size = 8 * VALUES.size
    assert load(path, ColumnMap(), size).columns
    with pytest.raises(Unusable, match=r"'delta_e_um' needs .* raise --max-memory") as caught:
        load(path, ColumnMap(), size - 1)
    assert caught.value.reason == "too-large"


@pytest.mark.parametrize("packed", [True, False])
def test_structs_of_testlab(tmp_path, packed):
    """Names, unit, rate and values of an export of Siemens Testlab need no column map."""
    values = np.random.default_rng(1).normal(size=(400, 2))
    label = {"quantity": {"label": "g"}}
    axis = {"start_value": 0.0, "increment": 1 / 2048, "number_of_values": 400.0}
    names = np.array(["carriage:+Z", "carriage:+X"], dtype=object)
    struct = {"x_values": axis, "y_values": label | {"values": values}}
    signal = struct | {"function_record": {"name": names}}
    other = {"y_values": {"values": values[0] + 1j}, "x_values": axis}  # a response
    variables = {"Signal": signal, "FRF": other, "Plain": {"a": 1.0}}
    scipy.io.savemat(tmp_path / "log.mat", variables, do_compression=packed)
    log = read_log(tmp_path / "log.mat")
    assert log.sample_rate == 2048
    assert [one.name for one in log.channels] == ["acc_carriage_Z", "acc_carriage_X"]
    for channel, held in zip(log.channels, values.T, strict=True):
        np.testing.assert_allclose(channel.values[:], 9.80665 * held, rtol=1e-12)
    signal["function_record"] = {"name": "one"}
    scipy.io.savemat(tmp_path / "log.mat", {"S": signal}, do_compression=packed)
    columns = ColumnMap(columns={"delta_e_um": "S:2"})
    (found,) = read_log(tmp_path / "log.mat", columns=columns).channels
    np.testing.assert_allclose(found.values[:], 1e-6 * values[:, 1], rtol=1e-12)
