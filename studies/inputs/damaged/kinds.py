"""All kinds of damage to a log, each with the reason that it must be refused with."""

from __future__ import annotations

import gzip
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from nptdms import ChannelObject, RootObject, TdmsWriter
from scipy.io import savemat

from studies.inputs.damaged.logfiles import (
    RATE,
    SUFFIXES,
    Archive,
    Columns,
    LogFile,
    text_of,
    write,
)

Rng = np.random.Generator
# Makes a damaged log in the place of a good one, and names what refused.csv must list.
Maker = Callable[[Archive, Path, LogFile, Rng], str]

_BINARY = (".parquet", ".h5", ".tdms", ".mat", ".uff")
_TEXT = (".csv", ".csv.gz")
_TYPED = (".csv", ".csv.gz", ".parquet", ".h5", ".tdms", ".mat")  # hold metadata of their own
_ERROR = "delta_e_um"
_ACC = "acc_feed_m_s2"  # the channel that is damaged
_ALL = (_ERROR, _ACC, "acc_pitch_m_s2")
_VELOCITY = "reference_velocity_mm_s"
_HEAD = 128  # bytes, the longest beginning that identifies a format: that of MAT
_BOMB = 40_000_000  # zeros that a bomb unpacks to: more than any file may


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of damage."""

    name: str
    reason: str  # in refused.csv
    suffixes: tuple[str, ...]  # of the formats that it happens to
    make: Maker
    lost: bool = True  # the whole log; else the rest of it is analysed


def _name_of(archive: Archive, path: Path) -> str:
    return path.relative_to(archive.folder).as_posix()


def _named(make: Callable[[Archive, Path, LogFile, Rng], None]) -> Maker:
    """Return a maker of a file that refused.csv lists by its own name."""

    def maker(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        make(archive, path, log, rng)
        return _name_of(archive, path)

    return maker


def _of_bytes(change: Callable[[bytes, Rng], bytes]) -> Maker:
    """Damage the bytes of a file."""

    @_named
    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
        write(archive, path, log)
        path.write_bytes(change(path.read_bytes(), rng))

    return make


def _of_columns(change: Callable[[Columns, Rng], Columns]) -> Maker:
    """Write other columns than a log should have."""
    return _named(
        lambda archive, path, log, rng: write(
            archive, path, replace(log, columns=change(dict(log.columns), rng))
        )
    )


def _of_metadata(**changes: str | None) -> Maker:
    """Change or remove metadata of a log."""

    @_named
    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
        metadata = {key: v for key, v in {**log.metadata, **changes}.items() if v is not None}
        write(archive, path, replace(log, metadata=metadata))

    return make


def _of_text(change: Callable[[list[bytes], Rng], list[bytes]]) -> Maker:
    """Damage the lines of delimited text, packed or not."""

    @_named
    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
        text = b"\n".join(change(text_of(log).split(b"\n"), rng))
        path.write_bytes(gzip.compress(text, 1) if path.suffix == ".gz" else text)

    return make


# Bytes and lines of text


def _cut(content: bytes, rng: Rng) -> bytes:
    return content[: int(len(content) * rng.uniform(0.2, 0.8))]


def _struck(content: bytes, rng: Rng) -> bytes:
    """Flip bits of a few bytes in the middle, which only a checksum detects."""
    at = len(content) // 2
    return content[:at] + bytes(255 - b for b in content[at : at + 4]) + content[at + 4 :]


def _cut_row(lines: list[bytes], rng: Rng) -> list[bytes]:
    """Cut before the last field of a row: a shorter last field is a number as well."""
    at = int(rng.integers(len(lines) // 2, len(lines) - 2))
    return [*lines[:at], lines[at].split(b",")[0]]


def _line(at: int | None, line: bytes) -> Maker:
    """Put a line in the place of another; None is one in the middle."""

    def change(lines: list[bytes], rng: Rng) -> list[bytes]:
        place = len(lines) // 2 if at is None else at
        return [*lines[:place], line, *lines[place + 1 :]]

    return _of_text(change)


def _head(lines: list[bytes]) -> int:
    return next(k for k, line in enumerate(lines) if not line.startswith(b"#"))


def _header_twice(lines: list[bytes], rng: Rng) -> list[bytes]:
    head = _head(lines)
    names = lines[head].split(b",")
    return [*lines[:head], b",".join([names[0], *names[:1], *names[2:]]), *lines[head + 1 :]]


# Columns and times


def _renamed(old: str, new: str) -> Maker:
    return _of_columns(lambda columns, rng: {new if k == old else k: v for k, v in columns.items()})


def _first(count: int) -> Maker:
    return _of_columns(lambda columns, rng: {name: v[:count] for name, v in columns.items()})


def _set(value: float, *names: str) -> Maker:
    return _of_columns(
        lambda columns, rng: columns | {name: np.full_like(columns[name], value) for name in names}
    )


def _clipped(columns: Columns, rng: Rng) -> Columns:
    values = columns[_ACC]
    reach = values.std() * rng.uniform(0.5, 1.5)
    return columns | {_ACC: np.clip(values, -reach, reach)}


def _missing(share: float) -> Maker:
    def change(columns: Columns, rng: Rng) -> Columns:
        values = columns[_ACC].copy()
        start = int(rng.integers(1, int(values.size * (0.95 - share))))
        values[start : start + int(share * values.size)] = np.nan
        return columns | {_ACC: values}

    return _of_columns(change)


def _restless(columns: Columns, rng: Rng) -> Columns:
    """Change the set velocity all the time."""
    n = columns[_ERROR].size
    return columns | {_VELOCITY: np.linspace(0, 4000, n, dtype=np.float32)}


def _time(stamps: Callable[[np.ndarray, Rng], np.ndarray]) -> Maker:
    """Write other moments of the samples."""
    return _of_columns(
        lambda columns, rng: {
            "time_s": stamps(np.arange(columns[_ERROR].size) / RATE, rng),
            **columns,
        }
    )


def _backwards(time: np.ndarray, rng: Rng) -> np.ndarray:
    at = int(rng.integers(10, time.size - 10))
    time[at:] -= 20 / RATE
    return time


def _unknown(time: np.ndarray, rng: Rng) -> np.ndarray:
    time[time.size // 2] = np.nan
    return time


def _dropped(columns: Columns, rng: Rng) -> Columns:
    time = np.arange(columns[_ERROR].size) / RATE
    start = int(rng.integers(100, 400))
    return {
        name: np.delete(values, slice(start, start + 50))
        for name, values in {"time_s": time, **columns}.items()
    }


# Files of one format


def _hdf5(change: Callable[[h5py.File, Path, np.ndarray], object]) -> Maker:
    """Put something else in the place of a column of an HDF5 file, perhaps outside the folder."""

    @_named
    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
        write(archive, path, log)
        with h5py.File(path, "a") as file:
            values = file[_ACC][()]
            del file[_ACC]
            change(file, archive.folder.parent, values)

    return make


def _external_link(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    with h5py.File(outside / "secret.h5", "w") as other:
        other["x"] = values
    file[_ACC] = h5py.ExternalLink(str(outside / "secret.h5"), "x")


def _external_storage(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    (outside / "secret.raw").write_bytes(values.tobytes())
    place = [(str(outside / "secret.raw"), 0, values.nbytes)]
    file.create_dataset(_ACC, values.shape, values.dtype, external=place)


def _virtual(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    with h5py.File(outside / "virtual.h5", "w") as other:
        other["x"] = values
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[:] = h5py.VirtualSource(str(outside / "virtual.h5"), "x", values.shape)
    file.create_virtual_dataset(_ACC, layout)


def _never_written(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    dataset = file.create_dataset(_ACC, values.shape, values.dtype, chunks=(1000,))
    dataset[:1000] = values[:1000]


def _strings(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    file.create_dataset(_ACC, data=["1.0"] * values.size, dtype=h5py.string_dtype())


def _hdf5_bomb(file: h5py.File, outside: Path, values: np.ndarray) -> None:
    zeros = np.zeros(_BOMB, dtype=np.int8)
    file.create_dataset(_ACC, data=zeros, chunks=(1 << 20,), compression="gzip")


def _mat(value: Callable[[np.ndarray], object]) -> Maker:
    """Put something else in the place of a variable of a MAT file."""

    @_named
    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
        columns = {**log.columns, _ACC: value(log.columns[_ACC])}
        savemat(path, {**columns, **log.metadata}, do_compression=True)

    return make


def _parquet(value: Callable[[int], object], *, alone: bool = False) -> Maker:
    """Put an array of another type in the place of n numbers of a Parquet file."""

    @_named
    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
        columns = {**({} if alone else log.columns), _ACC: value(log.columns[_ACC].size)}
        pq.write_table(pa.table(columns).replace_schema_metadata(dict(log.metadata)), path)

    return make


def _uuids(n: int) -> object:
    return pa.ExtensionArray.from_storage(
        pa.uuid(), pa.array([b"0123456789abcdef"] * n, pa.binary(16))
    )


@_named
def _gzip_bomb(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
    """Pack rows of zeros, some 300 MB of them."""
    with gzip.open(path, "wb", 9) as stream:
        stream.write(b"# sample_rate_hz: 2000\ndelta_e_um,acc_pitch_m_s2\n")
        for _ in range(300):
            stream.write(b"0.00000,0\n" * 100_000)


def _unfinished(content: bytes, rng: Rng) -> bytes:
    """Claim of a TDMS segment that its end was never written."""
    return content[:12] + struct.pack("<Q", (1 << 64) - 1) + content[20:]


@_named
def _two_rates(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
    channels = [
        ChannelObject("log", name, v, {"wf_increment": (2 if name == _ACC else 1) / RATE})
        for name, v in log.columns.items()
    ]
    with TdmsWriter(str(path)) as writer:
        writer.write_segment([RootObject(dict(log.metadata)), *channels])


# Files and folders


@_named
def _another_format(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
    other = next(s for s in _BINARY if not path.name.endswith(s))
    real = path.with_name(f".{path.name}{other}")
    write(Archive(archive.folder), real, log)
    real.rename(path)


@_named
def _link_out(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
    outside = archive.folder.parent / f"outside-{path.name}"
    write(Archive(archive.folder.parent), outside, log)
    path.symlink_to(outside)


def _copy(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    """Put the same content twice; the second by name is the copy."""
    write(archive, path, log)
    copy = path.with_name(f"{path.name.split('.')[0]}z{''.join(path.suffixes)}")
    copy.write_bytes(path.read_bytes())
    return _name_of(archive, copy)


# Tables in the folder of the logs


def _rows(*rows: Callable[[str], list[str]]) -> Maker:
    """Write a good log, and rows of the manifest for it from its moment."""

    @_named
    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> None:
        write(archive, path, log)
        moment = log.metadata["recorded_at"]
        archive.manifest += [[_name_of(archive, path), *cells(moment)] for cells in rows]

    return make


def _listed(template: str) -> Maker:
    """List a file in the manifest that is none of the folder."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        file = template.format(path.name)
        archive.manifest.append([file, "", "", ""])
        return file

    return make


def _work(*cells: str) -> Maker:
    """Record maintenance that cannot be understood."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        archive.maintenance.append([log.metadata["stage"], *cells])
        return f"maintenance.csv, line {len(archive.maintenance) + 1}"

    return make


KINDS: tuple[Kind, ...] = (
    # Bytes and lines
    Kind("no byte", "empty", SUFFIXES, _of_bytes(lambda content, rng: b"")),
    Kind("cut off", "corrupt", (*_BINARY, ".csv.gz"), _of_bytes(_cut)),
    Kind("cut off in a row", "corrupt", (".csv",), _of_text(_cut_row)),
    Kind("beginning overwritten", "corrupt", SUFFIXES,
         _of_bytes(lambda content, rng: rng.bytes(_HEAD) + content[_HEAD:])),
    Kind("bytes struck under a checksum", "corrupt", (".csv.gz", ".parquet", ".mat"),
         _of_bytes(_struck)),
    Kind("content of another format", "format", SUFFIXES, _another_format),
    Kind("text", "format", _BINARY, _of_bytes(lambda content, rng: b"no signal at all\n" * 100)),
    Kind("never finished", "corrupt", (".tdms",), _of_bytes(_unfinished)),
    Kind("blocks never written", "corrupt", (".h5",), _hdf5(_never_written)),
    Kind("NUL bytes in a row", "corrupt", _TEXT, _line(None, b"\0\0\0,1,1,1")),
    Kind("a row too long", "corrupt", _TEXT, _line(None, b"1,1,1,1,1,1")),
    Kind("another encoding, no moment", "metadata", _TEXT, _line(1, b"# machine: M\xfcller")),
    Kind("an open quote", "corrupt", _TEXT, _line(None, b'"1,1,1')),
    # Columns
    Kind("header and no rows", "empty", _TEXT,
         _of_text(lambda lines, rng: [*lines[: _head(lines) + 1], b""])),
    Kind("one sample", "empty", _TYPED, _first(1)),
    Kind("no signal", "columns", SUFFIXES,
         _of_columns(lambda columns, rng: {_VELOCITY: columns[_VELOCITY]})),
    Kind("a column twice", "columns", _TEXT, _of_text(_header_twice)),
    Kind("columns of unlike length", "columns", (".h5", ".mat", ".tdms", ".uff"),
         _of_columns(lambda columns, rng: columns | {_ACC: columns[_ACC][:-7]})),
    Kind("words among numbers", "columns", _TEXT, _line(None, b"1,high,1,1")),
    Kind("a column of words", "columns", (".h5",), _hdf5(_strings)),
    Kind("a column of words", "columns", (".parquet",), _parquet(lambda n: pa.array(["1.0"] * n))),
    Kind("a column of lists", "columns", (".parquet",), _parquet(lambda n: pa.array([[1.0]] * n))),
    Kind("a column of an extension type", "columns", (".parquet",), _parquet(_uuids)),
    Kind("cells", "columns", (".mat",), _mat(lambda v: np.array([v, "x"], dtype=object))),
    Kind("control characters in a name", "columns", _TYPED,
         _renamed(_ACC, "acc_\x1b[31m_m_s2")),
    Kind("no unit", "unit", _TYPED, _renamed(_ACC, "acc_feed")),
    Kind("a unit of another quantity", "unit", SUFFIXES, _renamed(_ACC, "acc_p_mm")),
    Kind("an unknown unit", "unit", SUFFIXES, _renamed(_ERROR, "delta_e_furlong")),
    # Metadata and times
    Kind("no machine", "metadata", _TYPED, _of_metadata(stage=None)),
    Kind("no moment", "metadata", _TYPED, _of_metadata(recorded_at=None)),
    Kind("no odometer", "metadata", _TYPED, _of_metadata(travel_km=None)),
    Kind("no time zone", "metadata", _TYPED, _of_metadata(recorded_at="2026-03-01T08:30:00")),
    Kind("no date", "metadata", _TYPED, _of_metadata(recorded_at="yesterday")),
    Kind("no number", "metadata", _TYPED, _of_metadata(travel_km="many")),
    Kind("an odometer below zero", "metadata", _TYPED, _of_metadata(travel_km="-5")),
    Kind("control characters", "metadata", _TYPED, _of_metadata(stage="damaged-\x1b[2J-Y")),
    Kind("writing turned about", "metadata", _TYPED, _of_metadata(stage="damaged-\u202eA-Y")),
    Kind("a machine of nobody", "no-stage", _TYPED, _of_metadata(stage="other-Z")),
    Kind("said twice", "metadata", _TEXT,
         _of_text(lambda lines, rng: [b"# travel_km: 1", b"# travel_km: 2", *lines])),
    Kind("no sample rate", "time", _TYPED, _of_metadata(sample_rate_hz=None)),
    Kind("two sample rates", "time", SUFFIXES, _time(lambda t, rng: 1.01 * t)),
    Kind("time runs backwards", "time", SUFFIXES, _time(_backwards)),
    Kind("time jitters", "time", SUFFIXES,
         _time(lambda t, rng: t + rng.uniform(-0.4, 0.4, t.size) / RATE)),
    Kind("time unknown", "time", SUFFIXES, _time(_unknown)),
    Kind("too slow for the modes", "sample-rate", _TYPED, _of_metadata(sample_rate_hz="200")),
    Kind("too short for the modes", "too-short", SUFFIXES, _first(200)),
    Kind("never at one velocity", "too-short", SUFFIXES, _of_columns(_restless)),
    # Signals
    Kind("all channels flat", "no-signal", SUFFIXES, _set(0.25, *_ALL)),
    Kind("nothing but NaN", "no-signal", _TYPED, _set(np.nan, *_ALL)),
    Kind("a flat channel", "flat", SUFFIXES, _set(0.0, _ACC), lost=False),
    Kind("a clipped channel", "clipped", SUFFIXES, _of_columns(_clipped), lost=False),
    Kind("a channel with a fifth missing", "missing-samples", _TYPED,
         _missing(0.2), lost=False),
    Kind("a channel with a short gap", "gaps", _TYPED, _missing(0.005), lost=False),
    Kind("samples dropped", "gaps", SUFFIXES, _of_columns(_dropped), lost=False),
    Kind("a channel of another rate", "time", (".tdms",), _two_rates, lost=False),
    # Files
    Kind("a link out of the folder", "escapes", SUFFIXES, _link_out),
    Kind("a link to nothing", "missing-file", SUFFIXES,
         _named(lambda archive, path, log, rng: path.symlink_to(archive.folder / "gone"))),
    Kind("a named pipe", "missing-file", SUFFIXES,
         _named(lambda archive, path, log, rng: os.mkfifo(path))),
    Kind("the same content twice", "duplicate", SUFFIXES, _copy),
    Kind("a column in another file", "escapes", (".h5",), _hdf5(_external_link)),
    Kind("samples in another file", "escapes", (".h5",), _hdf5(_external_storage)),
    Kind("a column put together elsewhere", "escapes", (".h5",), _hdf5(_virtual)),
    # Tables
    Kind("a row too long in the manifest", "bad-row", SUFFIXES,
         _rows(lambda m: ["", "", "", "one cell too many"])),
    Kind("two rows that differ in the manifest", "bad-row", SUFFIXES,
         _rows(lambda m: ["", "", "1"], lambda m: ["", "", "2"])),
    Kind("no number in the manifest", "metadata", _TYPED, _rows(lambda m: ["", m, "far"])),
    Kind("an odometer that runs backwards", "odometer", _TYPED, _rows(lambda m: ["", m, "9e6"])),
    Kind("a file above the folder in the manifest", "escapes", (".csv",), _listed("../{}")),
    Kind("a file of the system in the manifest", "escapes", (".csv",), _listed("/etc/{}")),
    Kind("no file of the manifest", "missing-file", (".csv",), _listed("gone/{}")),
    Kind("work of an unknown kind", "bad-row", (".csv",),
         _work("2026-03-01T00:00:00Z", "1", "repainted")),
    Kind("work at no moment", "bad-row", (".csv",), _work("soon", "1", "servo")),
    # Files that expand
    Kind("rows that swell a thousandfold", "too-large", (".csv.gz",), _gzip_bomb),
    Kind("a column that swells a thousandfold", "too-large", (".h5",), _hdf5(_hdf5_bomb)),
    Kind("a column that swells a thousandfold", "too-large", (".parquet",),
         _parquet(lambda n: pa.array(np.zeros(_BOMB)), alone=True)),
    Kind("a variable that swells a thousandfold", "too-large", (".mat",),
         _mat(lambda values: np.zeros(_BOMB))),
)  # fmt: skip
