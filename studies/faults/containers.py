"""Damage from inside: HDF5, MAT, Parquet and TDMS files that hold what no log may."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from studies.faults.logfiles import RATE, Archive, LogFile, write

Rng = np.random.Generator
# Makes a damaged log in the place of a good one, and names what refused.csv must list.
Maker = Callable[[Archive, Path, LogFile, Rng], str]
# The channel that is damaged.
ACC = "acc_feed_m_s2"
# Zeros that a bomb unpacks to: more than any file may.
BOMB = 40_000_000


def name_of(archive: Archive, path: Path) -> str:
    """Name a file as refused.csv does."""
    return path.relative_to(archive.folder).as_posix()


def hdf5(change: Callable[[h5py.File, Path, np.ndarray], None]) -> Maker:
    """Put something else in the place of a column of an HDF5 file."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        write(archive, path, log)
        with h5py.File(path, "a") as file:
            values = file[ACC][()]
            del file[ACC]
            change(file, archive.folder.parent, values)
        return name_of(archive, path)

    return make


def external_link(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    """Put a column into another file."""
    with h5py.File(outside / "secret.h5", "w") as other:
        other["x"] = values
    file[ACC] = h5py.ExternalLink(str(outside / "secret.h5"), "x")


def external_storage(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    """Put samples into another file."""
    (outside / "secret.raw").write_bytes(values.tobytes())
    place = [(str(outside / "secret.raw"), 0, values.nbytes)]
    file.create_dataset(ACC, values.shape, values.dtype, external=place)


def virtual(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    """Put a column together from another file."""
    with h5py.File(outside / "virtual.h5", "w") as other:
        other["x"] = values
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[:] = h5py.VirtualSource(str(outside / "virtual.h5"), "x", values.shape)
    file.create_virtual_dataset(ACC, layout)


def never_written(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    """Leave most blocks unwritten."""
    dataset = file.create_dataset(ACC, values.shape, values.dtype, chunks=(1000,))
    dataset[:1000] = values[:1000]


def strings(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    """Write numbers as words."""
    file.create_dataset(ACC, data=["1.0"] * values.size, dtype=h5py.string_dtype())


def hdf5_bomb(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    """Pack zeros."""
    file.create_dataset(
        ACC, data=np.zeros(BOMB, dtype=np.int8), chunks=(1 << 20,), compression="gzip"
    )


def mat(value: Callable[[np.ndarray], object]) -> Maker:
    """Put something else in the place of a variable of a MAT file."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        import scipy.io

        columns = {**log.columns, ACC: value(log.columns[ACC])}
        scipy.io.savemat(path, {**columns, **log.metadata}, do_compression=True)
        return name_of(archive, path)

    return make


def parquet(kind: str) -> Maker:
    """Return a column of a Parquet file a type that is no number."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        import pyarrow as pa
        import pyarrow.parquet as pq

        n = log.columns[ACC].size
        odd = {
            "text": lambda: pa.array(["1.0"] * n),
            "lists": lambda: pa.array([[1.0]] * n),
            "extension": lambda: pa.ExtensionArray.from_storage(
                pa.uuid(), pa.array([b"0123456789abcdef"] * n, pa.binary(16))
            ),
            "bomb": lambda: pa.array(np.zeros(BOMB)),
        }[kind]()
        columns = {**log.columns, ACC: odd} if kind != "bomb" else {ACC: odd}
        table = pa.table(columns).replace_schema_metadata(dict(log.metadata))
        pq.write_table(table, path)
        return name_of(archive, path)

    return make


def gzip_bomb(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    """Pack rows of zeros, some 300 MB of them."""
    with gzip.open(path, "wb", 9) as stream:
        stream.write(b"# sample_rate_hz: 2000\ndelta_e_um,acc_pitch_m_s2\n")
        for _ in range(300):
            stream.write(b"0.00000,0\n" * 100_000)
    return name_of(archive, path)


def unfinished(content: bytes, rng: Rng) -> bytes:
    """Claim of a TDMS segment that its end was never written."""
    return content[:12] + struct.pack("<Q", (1 << 64) - 1) + content[20:]


def two_rates(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    """Return a channel another rate."""
    from nptdms import ChannelObject, RootObject, TdmsWriter

    channels = [
        ChannelObject("log", name, v, {"wf_increment": (2 if name == ACC else 1) / RATE})
        for name, v in log.columns.items()
    ]
    with TdmsWriter(str(path)) as writer:
        writer.write_segment([RootObject(dict(log.metadata)), *channels])
    return name_of(archive, path)
