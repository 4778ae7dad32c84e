"""Every way in which a log is damaged here, and the reason that it must be refused with."""

from __future__ import annotations

import gzip
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from studies.faults.containers import (
    ACC,
    BOMB,
    Maker,
    Rng,
    external_link,
    external_storage,
    gzip_bomb,
    hdf5,
    hdf5_bomb,
    mat,
    name_of,
    never_written,
    parquet,
    strings,
    two_rates,
    unfinished,
    virtual,
)
from studies.faults.logfiles import RATE, SUFFIXES, Archive, Columns, LogFile, text_of, write

_BINARY = (".parquet", ".h5", ".tdms", ".mat", ".uff")
_TEXT = (".csv", ".csv.gz")
_TYPED = (".csv", ".csv.gz", ".parquet", ".h5", ".tdms", ".mat")  # hold metadata of their own
_ERROR = "delta_e_um"
_ALL = (_ERROR, ACC, "acc_pitch_m_s2")
# The longest beginning that a format is known by: that of MAT.
_HEAD = 128


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of damage."""

    name: str  # In words
    reason: str  # Reason in refused.csv
    suffixes: tuple[str, ...]  # Formats that it can happen to
    make: Maker  # Does it
    lost: bool = True  # Whether the whole log is lost by it; else the rest of it is analysed


def _of_bytes(change: Callable[[bytes, Rng], bytes]) -> Maker:
    """Damage what a file holds."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        write(archive, path, log)
        path.write_bytes(change(path.read_bytes(), rng))
        return name_of(archive, path)

    return make


def _of_columns(change: Callable[[Columns, Rng], Columns]) -> Maker:
    """Write other columns than a log should have."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        write(archive, path, replace(log, columns=change(dict(log.columns), rng)))
        return name_of(archive, path)

    return make


def _of_metadata(**changes: str | None) -> Maker:
    """Change or remove metadata of a log."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        metadata = {key: v for key, v in {**log.metadata, **changes}.items() if v is not None}
        write(archive, path, replace(log, metadata=metadata))
        return name_of(archive, path)

    return make


def _of_text(change: Callable[[list[bytes], Rng], list[bytes]]) -> Maker:
    """Damage the lines of delimited text, packed or not."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        text = b"\n".join(change(text_of(log).split(b"\n"), rng))
        path.write_bytes(gzip.compress(text, 1) if path.suffix == ".gz" else text)
        return name_of(archive, path)

    return make


# Bytes


def _cut(content: bytes, rng: Rng) -> bytes:
    return content[: int(len(content) * rng.uniform(0.2, 0.8))]


def _scrambled(content: bytes, rng: Rng) -> bytes:
    return rng.bytes(_HEAD) + content[_HEAD:]


def _cut_row(lines: list[bytes], rng: Rng) -> list[bytes]:
    """Cut before the last field of a row: a shorter last field is a number as well."""
    at = int(rng.integers(len(lines) // 2, len(lines) - 2))
    return [*lines[:at], lines[at].split(b",")[0]]


def _struck(content: bytes, rng: Rng) -> bytes:
    """Flip bits of a few bytes in the middle, which only a checksum detects."""
    at = len(content) // 2
    return content[:at] + bytes(255 - b for b in content[at : at + 4]) + content[at + 4 :]


# Lines of text


def _line(at: int | None, line: bytes) -> Maker:
    """Put a line in the place of another; None is one in the middle."""

    def change(lines: list[bytes], rng: Rng) -> list[bytes]:
        place = len(lines) // 2 if at is None else at
        return [*lines[:place], line, *lines[place + 1 :]]

    return _of_text(change)


def _head(lines: list[bytes]) -> int:
    return next(k for k, line in enumerate(lines) if not line.startswith(b"#"))


def _header_only(lines: list[bytes], rng: Rng) -> list[bytes]:
    return [*lines[: _head(lines) + 1], b""]


def _header_twice(lines: list[bytes], rng: Rng) -> list[bytes]:
    head = _head(lines)
    names = lines[head].split(b",")
    return [*lines[:head], b",".join([names[0], *names[:1], *names[2:]]), *lines[head + 1 :]]


def _said_twice(lines: list[bytes], rng: Rng) -> list[bytes]:
    return [b"# travel_km: 1", b"# travel_km: 2", *lines]


# Columns


def _renamed(old: str, new: str) -> Callable[[Columns, Rng], Columns]:
    return lambda columns, rng: {new if k == old else k: v for k, v in columns.items()}


def _no_signal(columns: Columns, rng: Rng) -> Columns:
    return {"reference_velocity_mm_s": columns["reference_velocity_mm_s"]}


def _only(count: int) -> Callable[[Columns, Rng], Columns]:
    return lambda columns, rng: {name: values[:count] for name, values in columns.items()}


def _unlike(columns: Columns, rng: Rng) -> Columns:
    return columns | {ACC: columns[ACC][:-7]}


def _set(value: float, *names: str) -> Callable[[Columns, Rng], Columns]:
    return lambda columns, rng: (
        columns | {name: np.full(columns[name].size, value, dtype=np.float32) for name in names}
    )


def _clipped(columns: Columns, rng: Rng) -> Columns:
    values = columns[ACC]
    reach = values.std() * rng.uniform(0.5, 1.5)
    return columns | {ACC: np.clip(values, -reach, reach)}


def _missing(share: float) -> Callable[[Columns, Rng], Columns]:
    def change(columns: Columns, rng: Rng) -> Columns:
        values = columns[ACC].copy()
        start = int(rng.integers(1, int(values.size * (0.95 - share))))
        values[start : start + int(share * values.size)] = np.nan
        return columns | {ACC: values}

    return change


def _restless(columns: Columns, rng: Rng) -> Columns:
    """Change the set velocity all the time."""
    n = columns[_ERROR].size
    return columns | {"reference_velocity_mm_s": np.linspace(0, 4000, n, dtype=np.float32)}


# Time


def _time(stamps: Callable[[np.ndarray, Rng], np.ndarray]) -> Callable[[Columns, Rng], Columns]:
    def change(columns: Columns, rng: Rng) -> Columns:
        n = columns[_ERROR].size
        return {"time_s": stamps(np.arange(n) / RATE, rng), **columns}

    return change


def _backwards(time: np.ndarray, rng: Rng) -> np.ndarray:
    at = int(rng.integers(10, time.size - 10))
    time[at:] -= 20 / RATE
    return time


def _jittered(time: np.ndarray, rng: Rng) -> np.ndarray:
    return time + rng.uniform(-0.4, 0.4, time.size) / RATE


def _unknown(time: np.ndarray, rng: Rng) -> np.ndarray:
    time[time.size // 2] = np.nan
    return time


def _dropped(columns: Columns, rng: Rng) -> Columns:
    n = columns[_ERROR].size
    keep = np.ones(n, dtype=bool)
    start = int(rng.integers(100, 400))
    keep[start : start + 50] = False
    return {"time_s": (np.arange(n) / RATE)[keep], **{k: v[keep] for k, v in columns.items()}}


def _no_rate(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    return _of_metadata(sample_rate_hz=None)(archive, path, log, rng)


# Files and folders


def _another_format(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    other = next(s for s in _BINARY if not path.name.endswith(s))
    real = path.with_name(f".{path.name}{other}")
    write(Archive(archive.folder), real, log)
    real.rename(path)
    return name_of(archive, path)


def _link_out(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    outside = archive.folder.parent / f"outside-{path.name}"
    write(Archive(archive.folder.parent), outside, log)
    path.symlink_to(outside)
    return name_of(archive, path)


def _dangling(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    path.symlink_to(archive.folder / "gone")
    return name_of(archive, path)


def _pipe(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    os.mkfifo(path)
    return name_of(archive, path)


def _copy(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    """Put the same content twice; the second by name is the copy."""
    write(archive, path, log)
    copy = path.with_name(f"{path.name.split('.')[0]}z{''.join(path.suffixes)}")
    copy.write_bytes(path.read_bytes())
    return name_of(archive, copy)


# Tables in the folder of the logs


def _bad_row(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    write(archive, path, log)
    archive.manifest.append([name_of(archive, path), "", "", "", "one cell too many"])
    return name_of(archive, path)


def _row(cells: Callable[[str], list[str]]) -> Maker:
    """Override the metadata of a good log by the manifest."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        write(archive, path, log)
        archive.manifest.append([name_of(archive, path), *cells(log.metadata["recorded_at"])])
        return name_of(archive, path)

    return make


def _two_rows(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
    write(archive, path, log)
    archive.manifest += [[name_of(archive, path), "", "", km] for km in ("1", "2")]
    return name_of(archive, path)


def _named(template: str) -> Maker:
    """Name a file in the manifest that is none of the folder."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        file = template.format(path.name)
        archive.manifest.append([file, "", "", ""])
        return file

    return make


def _work(*cells: str) -> Maker:
    """Return for work that cannot be understood."""

    def make(archive: Archive, path: Path, log: LogFile, rng: Rng) -> str:
        archive.maintenance.append([log.metadata["stage"], *cells])
        return f"maintenance.csv, line {len(archive.maintenance) + 1}"

    return make


_BOMBS = (
    Kind("rows that swell a thousandfold", "too-large", (".csv.gz",), gzip_bomb),
    Kind("a column that swells a thousandfold", "too-large", (".h5",), hdf5(hdf5_bomb)),
    Kind("a column that swells a thousandfold", "too-large", (".parquet",), parquet("bomb")),
    Kind("a variable that swells a thousandfold", "too-large", (".mat",),
         mat(lambda values: np.zeros(BOMB))),
)  # fmt: skip
_OF_BYTES = (
    Kind("no byte", "empty", SUFFIXES, _of_bytes(lambda content, rng: b"")),
    Kind("cut off", "corrupt", (*_BINARY, ".csv.gz"), _of_bytes(_cut)),
    Kind("cut off in a row", "corrupt", (".csv",), _of_text(_cut_row)),
    Kind("beginning overwritten", "corrupt", SUFFIXES, _of_bytes(_scrambled)),
    Kind("bytes struck under a checksum", "corrupt", (".csv.gz", ".parquet", ".mat"),
         _of_bytes(_struck)),
    Kind("content of another format", "format", SUFFIXES, _another_format),
    Kind("text", "format", _BINARY, _of_bytes(lambda content, rng: b"no signal at all\n" * 100)),
    Kind("never finished", "corrupt", (".tdms",), _of_bytes(unfinished)),
    Kind("blocks never written", "corrupt", (".h5",), hdf5(never_written)),
    Kind("NUL bytes in a row", "corrupt", _TEXT, _line(None, b"\0\0\0,1,1,1")),
    Kind("a row too long", "corrupt", _TEXT, _line(None, b"1,1,1,1,1,1")),
    Kind("another encoding", "corrupt", _TEXT, _line(1, b"# machine: M\xfcller")),
    Kind("an open quote", "corrupt", _TEXT, _line(None, b'"1,1,1')),
)  # fmt: skip
_OF_COLUMNS = (
    Kind("header and no rows", "empty", _TEXT, _of_text(_header_only)),
    Kind("one sample", "empty", _TYPED, _of_columns(_only(1))),
    Kind("no signal", "columns", SUFFIXES, _of_columns(_no_signal)),
    Kind("a column twice", "columns", _TEXT, _of_text(_header_twice)),
    Kind("columns of unlike length", "columns", (".h5", ".mat", ".tdms", ".uff"),
         _of_columns(_unlike)),
    Kind("words among numbers", "columns", _TEXT, _line(None, b"1,high,1,1")),
    Kind("a column of words", "columns", (".h5",), hdf5(strings)),
    Kind("a column of words", "columns", (".parquet",), parquet("text")),
    Kind("a column of lists", "columns", (".parquet",), parquet("lists")),
    Kind("a column of an extension type", "columns", (".parquet",), parquet("extension")),
    Kind("cells", "columns", (".mat",), mat(lambda v: np.array([v, "x"], dtype=object))),
    Kind("control characters in a name", "columns", _TYPED,
         _of_columns(_renamed(ACC, "acc_\x1b[31m_m_s2"))),
    Kind("no unit", "unit", _TYPED, _of_columns(_renamed(ACC, "acc_feed"))),
    Kind("a unit of another quantity", "unit", SUFFIXES, _of_columns(_renamed(ACC, "acc_p_mm"))),
    Kind("an unknown unit", "unit", SUFFIXES, _of_columns(_renamed(_ERROR, "delta_e_furlong"))),
)  # fmt: skip
_OF_METADATA = (
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
    Kind("said twice", "metadata", _TEXT, _of_text(_said_twice)),
    Kind("no sample rate", "time", _TYPED, _no_rate),
    Kind("two sample rates", "time", SUFFIXES, _of_columns(_time(lambda t, rng: 1.01 * t))),
    Kind("time runs backwards", "time", SUFFIXES, _of_columns(_time(_backwards))),
    Kind("time jitters", "time", SUFFIXES, _of_columns(_time(_jittered))),
    Kind("time unknown", "time", SUFFIXES, _of_columns(_time(_unknown))),
    Kind("too slow for the modes", "sample-rate", _TYPED, _of_metadata(sample_rate_hz="200")),
    Kind("too short for the modes", "too-short", SUFFIXES, _of_columns(_only(200))),
    Kind("never at one velocity", "too-short", SUFFIXES, _of_columns(_restless)),
)
_OF_SIGNALS = (
    Kind("all channels flat", "no-signal", SUFFIXES, _of_columns(_set(0.25, *_ALL))),
    Kind("nothing but NaN", "no-signal", _TYPED, _of_columns(_set(np.nan, *_ALL))),
    Kind("a flat channel", "flat", SUFFIXES, _of_columns(_set(0.0, ACC)), lost=False),
    Kind("a clipped channel", "clipped", SUFFIXES, _of_columns(_clipped), lost=False),
    Kind("a channel with a fifth missing", "missing-samples", _TYPED,
         _of_columns(_missing(0.2)), lost=False),
    Kind("a channel with a short gap", "gaps", _TYPED, _of_columns(_missing(0.005)), lost=False),
    Kind("samples dropped", "gaps", SUFFIXES, _of_columns(_dropped), lost=False),
    Kind("a channel of another rate", "time", (".tdms",), two_rates, lost=False),
)  # fmt: skip
_OF_FILES = (
    Kind("a link out of the folder", "escapes", SUFFIXES, _link_out),
    Kind("a link to nothing", "missing-file", SUFFIXES, _dangling),
    Kind("a named pipe", "missing-file", SUFFIXES, _pipe),
    Kind("the same content twice", "duplicate", SUFFIXES, _copy),
    Kind("a column in another file", "escapes", (".h5",), hdf5(external_link)),
    Kind("samples in another file", "escapes", (".h5",), hdf5(external_storage)),
    Kind("a column put together elsewhere", "escapes", (".h5",), hdf5(virtual)),
)
_OF_TABLES = (
    Kind("a row too long in the manifest", "bad-row", SUFFIXES, _bad_row),
    Kind("two rows that differ in the manifest", "bad-row", SUFFIXES, _two_rows),
    Kind("no number in the manifest", "metadata", _TYPED, _row(lambda m: ["", m, "far"])),
    Kind("an odometer that runs backwards", "odometer", _TYPED, _row(lambda m: ["", m, "9e6"])),
    Kind("a file above the folder in the manifest", "escapes", (".csv",), _named("../{}")),
    Kind("a file of the system in the manifest", "escapes", (".csv",), _named("/etc/{}")),
    Kind("no file of the manifest", "missing-file", (".csv",), _named("gone/{}")),
    Kind("work of an unknown kind", "bad-row", (".csv",),
         _work("2026-03-01T00:00:00Z", "1", "repainted")),
    Kind("work at no moment", "bad-row", (".csv",), _work("soon", "1", "servo")),
)  # fmt: skip
KINDS: tuple[Kind, ...] = (
    *_OF_BYTES, *_OF_COLUMNS, *_OF_METADATA, *_OF_SIGNALS, *_OF_FILES, *_OF_TABLES, *_BOMBS,
)  # fmt: skip
