"""HDF5: links and virtual columns, damage that the HDF5 library does not survive, attributes.

The library works in a process of its own: it may end, loop, or run into the limit of memory.
"""

import subprocess
import sys

import h5py
import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats import native
from lmshealth.io.formats.registry import load
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable

LIBRARIES = ["earliest", "latest"]


@pytest.fixture(params=LIBRARIES)
def log(request, tmp_path):
    """Write a log with text attributes, by either layout of attributes."""
    path = tmp_path / "log.h5"
    with h5py.File(path, "w", libver=request.param) as file:
        file["delta_e_um"] = np.random.default_rng(0).normal(size=100)
        file.attrs.update({"stage": "demo", "servo_id": "x" * 9000, "sample_rate_hz": "2000"})
    return path


def test_texts_of_any_honest_length(log):
    """Short texts and those with a heap of their own are read."""
    metadata = load(log, ColumnMap()).metadata
    assert metadata == {"stage": "demo", "servo_id": "x" * 9000, "sample_rate_hz": "2000"}


@pytest.mark.parametrize("claim", [0, 8, 1 << 30, (1 << 64) - 1])
def test_damaged_sizes(log, claim, monkeypatch):
    """A heap of strings with a claim of zero is read for ever, one beyond the heap not at all."""
    monkeypatch.setenv("LMSHEALTH_MAX_SECONDS", "0.2")
    data = log.read_bytes()
    at = data.index(b"GCOL") + 24
    # The free space behind the first text: index 0, and the size under test.
    free = at + 8 + 8
    damaged = data[:free] + bytes(8) + claim.to_bytes(8, "little") + data[free + 16 :]
    log.write_bytes(damaged)
    with pytest.raises(Unusable) as caught:
        load(log, ColumnMap())
    assert caught.value.reason == ("corrupt" if claim else "too-slow")


def test_heap_that_claims_gigabytes(log):
    """A heap is no larger than the file."""
    data = log.read_bytes()
    at = data.index(b"GCOL") + 8
    log.write_bytes(data[:at] + (1 << 33).to_bytes(8, "little") + data[at + 8 :])
    with pytest.raises(Unusable, match="cannot be read as HDF5") as caught:
        load(log, ColumnMap())
    assert caught.value.reason == "corrupt"


def test_text_that_claims_gigabytes(log):
    """The library would clear 4 GB before it looks for the text; later layouts have checksums."""
    data = log.read_bytes()
    at = data.index((9000).to_bytes(4, "little"))
    log.write_bytes(data[:at] + ((1 << 32) - 1).to_bytes(4, "little") + data[at + 4 :])
    with pytest.raises(Unusable, match=r"allocation failed|checksum") as caught:
        load(log, ColumnMap())
    assert caught.value.reason == "corrupt"


def test_name_that_is_no_text(tmp_path):
    """A column whose name is not UTF-8 is passed over, and named."""
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file[b"\xff\xfe"] = np.arange(4.0)
        file["delta_e_um"] = np.random.default_rng(0).normal(size=100)
    content = load(tmp_path / "log.h5", ColumnMap())
    assert list(content.columns) == ["delta_e_um"]
    assert content.present == ("delta_e_um", "\ufffd\ufffd")


def test_samples_with_the_bytes_of_a_heap(log):
    """Samples with the bytes of a heap refuse nothing."""
    with h5py.File(log, "a") as file:
        noise = np.random.default_rng(1).normal(size=99)
        file["acc_x_g"] = np.append(np.frombuffer(b"GCOL\1\0\0\0"), noise)
    assert load(log, ColumnMap()).columns["acc_x_g"].size == 100


@pytest.mark.slow
@pytest.mark.parametrize("lists_files", [False, True])
@pytest.mark.parametrize("library", LIBRARIES)
def test_virtual_columns_end_no_process(tmp_path, library, lists_files):
    """A virtual column is refused, also one that cannot be opened, without a crash at the end."""
    path = tmp_path / "log.h5"
    layout = h5py.VirtualLayout((10,), "f8")
    if lists_files:
        layout[:] = h5py.VirtualSource("other.h5", "x", (10,))
    with h5py.File(path, "w", libver=library) as file:
        file.create_virtual_dataset("delta_e_um", layout, fillvalue=1.25)
    # The version of the message with the fill value: the column cannot be opened.
    data = path.read_bytes()
    value = data.index(np.float64(1.25).tobytes())
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(data[: value - 8] + b"\xff" + data[value - 7 :])
    code = (
        "import sys; from pathlib import Path; from lmshealth.io.column_map import ColumnMap; "
        "from lmshealth.io.formats.registry import load\n"
        "for name in sys.argv[1:]:\n"
        "    try: load(Path(name), ColumnMap())\n"
        "    except Exception as error: print(error.reason)\n"
    )
    command = [sys.executable, "-c", code, str(path), str(damaged)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout in ("escapes\nescapes\n", "escapes\ncorrupt\n")


def refused(path, reason, *words):
    """Expect a refusal with words in its detail."""
    with pytest.raises(BadLog) as caught:
        read_log(path)
    assert caught.value.reason == reason, caught.value
    for word in words:
        assert word in caught.value.detail


def test_hdf5_links_are_not_followed(make, tmp_path):
    """External links, external storage and virtual datasets are refused as escapes."""
    source = make("source.h5")
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["delta_e_um"] = h5py.ExternalLink(str(source), "delta_e_um")
    refused(tmp_path / "link.h5", "escapes")
    (tmp_path / "raw.bin").write_bytes(bytes(800))
    with h5py.File(tmp_path / "storage.h5", "w") as file:
        external = [(str(tmp_path / "raw.bin"), 0, 800)]
        file.create_dataset("delta_e_um", (100,), "f8", external=external)
    refused(tmp_path / "storage.h5", "escapes")
    layout = h5py.VirtualLayout((400,), "f8")
    layout[:] = h5py.VirtualSource(source, "delta_e_um", (400,))
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        file.create_virtual_dataset("delta_e_um", layout)
    refused(tmp_path / "virtual.h5", "escapes")


def test_hdf5_unwritten_blocks(tmp_path):
    """Blocks that a crashed recorder never wrote are not read as zeros."""
    with h5py.File(tmp_path / "log.h5", "w") as file:
        data = file.create_dataset("delta_e_um", (1000,), "f8", chunks=(100,))
        data[:500] = np.random.default_rng(0).normal(size=500)
        file.attrs["sample_rate_hz"] = 1000
    refused(tmp_path / "log.h5", "corrupt", "5 of 10")


@pytest.mark.parametrize("damage", ["place", "mask"])
def test_blocks_out_of_place(tmp_path, damage):
    """A block at the place of another would be read as zeros, one without its filter as noise."""
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        values = np.random.default_rng(0).normal(size=400).astype("f4")
        file.create_dataset("delta_e_um", data=values, chunks=(100,), shuffle=True)
        file.attrs["sample_rate_hz"] = 1000
        place = file["delta_e_um"].id.get_chunk_info(2).byte_offset
    data = path.read_bytes()
    # Key of a block: its size, mask of its filters and place in the column; then its place here.
    at = data.index(place.to_bytes(8, "little")) - 24
    assert int.from_bytes(data[at + 8 : at + 16], "little") == 200
    start, new = (at + 8, bytes(8)) if damage == "place" else (at + 4, b"\1")
    path.write_bytes(data[:start] + new + data[start + len(new) :])
    refused(path, "corrupt", "blocks that are not where they belong")


def test_hdf5_damaged_heap(make, monkeypatch):
    """A heap of strings on which the HDF5 library would never return is refused."""
    monkeypatch.setenv("LMSHEALTH_MAX_SECONDS", "0.2")
    path = make("log.h5")
    data = bytearray(path.read_bytes())
    first = data.index(b"GCOL") + 16
    data[first : first + 2] = bytes(2)
    data[first + 8 : first + 16] = bytes(8)
    path.write_bytes(data)
    refused(path, "too-slow", "more than 0.2")


def test_hdf5_attributes(make):
    """Attributes may be text, bytes, numbers, booleans or empty; others are refused unread."""
    path = make("log.h5")
    with h5py.File(path, "a") as file:
        file.attrs["travel_km"] = np.float32(1.5)
        file.attrs["stage"] = np.bytes_(b"demo")
        file.attrs["servo_id"] = [3]
        file.attrs["baseline"] = True
    metadata = read_log(path).metadata
    assert (metadata.travel, metadata.stage) == (1500.0, "demo")
    assert (metadata.servo_id, metadata.baseline) == ("3", True)
    with h5py.File(path, "a") as file:
        file.attrs["servo_id"] = h5py.Empty("S1")
        file.attrs["travel_km"] = h5py.Empty("f8")
    metadata = read_log(path).metadata
    assert (metadata.servo_id, metadata.travel) == (None, None)
    for value in ([1, 2], np.array([[1, 2]], dtype=object)[0, :0]):
        with h5py.File(path, "a") as file:
            file.attrs.create("servo_id", value, dtype="i8")
        refused(path, "metadata", "servo_id")
    with h5py.File(path, "a") as file:
        data = np.empty((), dtype=object)
        data[()] = np.arange(3)
        file.attrs.create("servo_id", data, dtype=h5py.vlen_dtype("i8"))
    refused(path, "metadata", "servo_id")


@pytest.mark.parametrize("kind", ["text", "group", "matrix"])
def test_hdf5_column_that_is_no_series(tmp_path, kind):
    """Strings, groups and matrices under a signal's name are named."""
    with h5py.File(tmp_path / "log.h5", "w") as file:
        if kind == "group":
            file.create_group("delta_e_um")
        else:
            file["delta_e_um"] = ["a", "b"] if kind == "text" else np.zeros((3, 3))
    refused(tmp_path / "log.h5", "columns", "delta_e_um")


def test_a_block_that_is_read_as_zeros_is_refused(tmp_path):
    """A compressed block whose index is damaged reads as zeros; a block of zeros is none."""
    values = np.random.default_rng(0).standard_normal(400)
    values[100:200] = 0
    with h5py.File(tmp_path / "log.h5", "w") as file:
        item = file.create_dataset("acc_x_g", data=values, chunks=(100,), compression="gzip")
        native._check_blocks(item, values, 0)
        lost = values.copy()
        lost[300:] = 0
        with pytest.raises(Unusable, match="from 300 on are read as zeros"):
            native._check_blocks(item, lost, 0)
