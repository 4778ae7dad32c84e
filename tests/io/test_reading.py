"""Reading whole files: formats agree, bad files end as ``BadLog`` with a reason."""

import gzip
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from lmshealth import io as readers
from lmshealth.errors import BadLog
from lmshealth.io import raw
from lmshealth.io.reading import content_digest, read_log, require_identity

ALL = ["log.csv", "log.csv.gz", "log.parquet", "log.h5", "log.hdf5", "log.tdms", "log.mat"]


def refused(path, reason, *words, **options):
    """Expect a refusal and look for words in its detail."""
    with pytest.raises(BadLog) as caught:
        read_log(path, **options)
    assert caught.value.reason == reason, caught.value
    for word in words:
        assert word in caught.value.detail
    return caught.value


@pytest.mark.parametrize("file", ALL)
def test_formats_hold_the_same_log(make, file):
    """Every format gives the same signals in SI units and the same metadata."""
    path = make(file)
    log, other = read_log(path), read_log(make("other.h5"))
    assert log.metadata == other.metadata
    assert log.metadata.travel == 123500.0
    assert log.metadata.recorded_at.utcoffset().total_seconds() == 3600
    assert log.sample_rate == 2000.0 and log.pieces == ((0, 400),) and log.refused == ()
    assert [c.name for c in log.channels] and {c.name for c in log.channels} == {
        "delta_e",
        "acc_feed",
    }
    values = {c.name: c.values for c in log.channels}
    for channel in other.channels:
        np.testing.assert_allclose(values[channel.name], channel.values, rtol=1e-12)
    assert 1e-8 < values["delta_e"].std() < 1e-7
    np.testing.assert_allclose(log.reference_velocity, 0.1)
    assert log.digest == content_digest(path) == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("file", ALL)
def test_zero_bytes(tmp_path, file):
    """A file of 0 bytes is refused as empty."""
    (tmp_path / file).write_bytes(b"")
    refused(tmp_path / file, "empty")


@pytest.mark.parametrize("file", ALL)
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_truncated(make, file, share):
    """A file cut in the middle is refused as corrupt."""
    path = make(file)
    data = path.read_bytes()
    if file == "log.csv":
        data = data[: data.rindex(b",", 0, int(len(data) * share))]
    else:
        data = data[: int(len(data) * share)]
    path.write_bytes(data)
    refused(path, "corrupt")


@pytest.mark.parametrize(
    ("content", "name", "found"),
    [
        ("log.parquet", "x.h5", "Parquet"),
        ("log.h5", "x.csv", "HDF5"),
        ("log.csv", "x.parquet", "CSV"),
        ("log.csv.gz", "x.csv", "gzip"),
        ("log.tdms", "x.mat", "TDMS"),
        ("log.mat", "x.tdms", "MAT"),
        ("log.csv", "x.uff", "CSV"),
        ("log.mat", "x.csv", "MAT"),
    ],
)
def test_wrong_extension(make, content, name, found):
    """Content of another format than the name says is named."""
    path = make(content)
    refused(path.rename(path.with_name(name)), "format", found)


def test_not_there(tmp_path):
    """Absent files, folders, pipes and impossible names are refused without waiting."""
    os.mkfifo(tmp_path / "pipe.csv")
    for path in ("absent.csv", ".", "pipe.csv", "nul\0.csv"):
        refused(tmp_path / path, "missing-file")
    with pytest.raises(BadLog, match="missing-file"):
        content_digest(tmp_path / "absent.csv")


def test_unknown_suffix(tmp_path):
    """A suffix that no format registered is refused with those that are."""
    (tmp_path / "log.xyz").write_bytes(b"abc")
    refused(tmp_path / "log.xyz", "format", ".parquet", ".csv.gz")


def test_gzip_bomb(tmp_path, monkeypatch):
    """A gzip bomb is stopped while it is unpacked."""
    monkeypatch.setattr(raw, "SMALL_ENOUGH", 1 << 20)
    member = gzip.compress(b"0\n" * (1 << 24), 9)
    (tmp_path / "bomb.csv.gz").write_bytes(gzip.compress(b"delta_e_um\n") + member)
    refused(tmp_path / "bomb.csv.gz", "too-large")


def test_hdf5_bomb(tmp_path):
    """An HDF5 file that declares terabytes is refused before they are allocated."""
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file.create_dataset("delta_e_um", (1 << 40,), chunks=(1 << 20,), dtype="f4")
        file.attrs["sample_rate_hz"] = 1000.0
    refused(tmp_path / "bomb.h5", "corrupt", "0 of 1048576")


@pytest.mark.slow
def test_parquet_bomb(make):
    """A Parquet file of a few bytes that declares a billion samples is refused."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = make("log.parquet")
    block = pa.table({"delta_e_um": np.zeros(1 << 24)})
    with pq.ParquetWriter(path, block.schema, use_dictionary=True) as writer:
        for _ in range(3):
            writer.write_table(block)
    refused(path, "too-large")


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


def test_hdf5_damaged_heap(make):
    """A heap of strings on which the HDF5 library would never return is refused."""
    path = make("log.h5")
    data = bytearray(path.read_bytes())
    first = data.index(b"GCOL") + 16
    data[first : first + 2] = bytes(2)
    data[first + 8 : first + 16] = bytes(8)
    path.write_bytes(data)
    refused(path, "corrupt", "heap")


def test_hdf5_attributes(make):
    """Attributes may be text, bytes, numbers or booleans; anything else is refused unread."""
    path = make("log.h5")
    with h5py.File(path, "a") as file:
        file.attrs["travel_km"] = np.float32(1.5)
        file.attrs["stage"] = np.bytes_(b"demo")
        file.attrs["servo_id"] = [3]
        file.attrs["baseline"] = True
    metadata = read_log(path).metadata
    assert (metadata.travel, metadata.stage) == (1500.0, "demo")
    assert (metadata.servo_id, metadata.baseline) == ("3", True)
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


def test_parquet_text_column(make):
    """A text column under a signal's name is named, elsewhere it is passed over."""
    refused(make("a.parquet", {"acc_x_g": np.array(["a"] * 400)}), "columns", "acc_x_g", "string")
    read_log(make("b.parquet", {"remark": np.array(["a"] * 400)}))


def test_parquet_without_pyarrow(make, monkeypatch):
    """Without pyarrow the error names the extra to install."""
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    refused(make("log.parquet"), "format", "lmshealth[formats]")


def test_require_identity(make):
    """A log without identity can be looked at, and is refused where a life is followed."""
    require_identity(read_log(make()))
    log = read_log(make(meta={"stage": None, "travel_km": None}))
    with pytest.raises(BadLog, match="stage, travel_km not given"):
        require_identity(log)


def test_overrides(make):
    """The manifest has the last word, its empty cells none."""
    log = read_log(make(), overrides={"travel_km": "7", "stage": " ", "baseline": "true"}, name="n")
    assert (log.metadata.travel, log.metadata.stage, log.metadata.baseline) == (7e3, "demo-Y", True)
    assert log.name == "n"


def test_import_is_light():
    """Importing the readers brings none of the libraries that read the formats."""
    folder = str(Path(readers.__file__).parents[1])
    # A bare stand-in for the package, whose own imports are not what is asked about here.
    code = (
        "import sys, types; package = types.ModuleType('lmshealth'); "
        f"package.__path__ = [{folder!r}]; sys.modules['lmshealth'] = package; "
        "import lmshealth.io.reading; "
        "late = ('pandas', 'pyarrow', 'h5py', 'scipy', 'nptdms', 'pyuff'); "
        "sys.exit(any(m in sys.modules for m in late))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
