"""Short logs of several machines in every format, each with noise and circumstances of its own."""

from __future__ import annotations

import csv
import gzip
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyuff
from nptdms import ChannelObject, RootObject, TdmsWriter
from scipy.io import savemat
from scipy.signal import decimate

from models.dynamics.stages import STAGES
from models.recordings.recording import SAMPLE_RATE_HZ, record

Columns = dict[str, np.ndarray]
MACHINES = tuple(f"damaged-{letter}-Y" for letter in "ABCDEF")
SECONDS, VELOCITY = 6.0, 0.010
_EVERY_TENTH = 10
RATE = SAMPLE_RATE_HZ / _EVERY_TENTH
_SIGNALS = ("delta_e_um", "acc_feed_m_s2", "acc_pitch_m_s2")
_HEADS = {
    "manifest": ("file", "stage", "recorded_at", "travel_km"),
    "maintenance": ("stage", "recorded_at", "travel_km", "action"),
}
# Two modes of the simulated stage and nothing to infer: the study examines files.
DESCRIPTION = """name = "faults"
[match]
stage = "damaged-?-Y"
[[mode]]
name = "roll"
frequency_hz = 126.4
damping_ratio = 0.0147
[[mode]]
name = "pitch"
frequency_hz = 136.6
damping_ratio = 0.0153
"""


@dataclass(frozen=True, slots=True)
class LogFile:
    """What is to be written: columns named with their units, and metadata as text."""

    columns: Columns
    metadata: dict[str, str]


@dataclass(slots=True)
class Archive:
    """A folder of logs with its tables."""

    folder: Path  # Of the logs
    # Rows of the tables without their header, in the order in which they are added
    manifest: list[list[str]] = field(default_factory=list)
    maintenance: list[list[str]] = field(default_factory=list)

    def close(self) -> None:
        """Write the tables."""
        write_table(self.folder, "manifest", self.manifest)
        write_table(self.folder, "maintenance", self.maintenance)


def write_table(folder: Path, name: str, rows: list[list[str]], *more: str) -> None:
    """Write a table with its header, and with more columns than it needs."""
    with (folder / f"{name}.csv").open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream).writerows([[*_HEADS[name], *more], *rows])


def recordings(n: int, seconds: float = SECONDS) -> list[Columns]:
    """Simulate some recordings of one stage, at a tenth of the servo's rate."""
    return [dict(_recording(k, seconds)) for k in range(n)]


@cache
def _recording(k: int, seconds: float) -> Columns:
    rng = np.random.default_rng([20261122, k])
    columns = record(STAGES["lms-y"], seconds=seconds, velocity=VELOCITY, rng=rng).columns
    slow = {name: decimate(columns[name], _EVERY_TENTH, ftype="fir") for name in _SIGNALS}
    slow["reference_velocity_mm_s"] = np.full(slow["delta_e_um"].size, 1e3 * VELOCITY)
    return {name: values.astype(np.float32) for name, values in slow.items()}


def log_of(base: Columns, number: int, rng: np.random.Generator) -> LogFile:
    """Return one recording as another log: a thousandth of noise, and the next moment of a life."""
    columns = {
        name: values
        if name.startswith("reference")
        else (values + 1e-3 * values.std() * rng.standard_normal(values.size)).astype(np.float32)
        for name, values in base.items()
    }
    own = number // len(MACHINES)
    moment = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(hours=own)
    stage = MACHINES[number % len(MACHINES)]
    metadata = {"stage": stage, "recorded_at": moment.isoformat(), "travel_km": f"{0.5 * own:g}",
                "sample_rate_hz": f"{RATE:g}"}  # fmt: skip
    return LogFile(columns, metadata)


def write(archive: Archive, path: Path, log: LogFile) -> None:
    """Write a log in the format that its name asks for; what the format lacks, in the manifest."""
    suffix = ".csv.gz" if path.name.endswith(".csv.gz") else path.suffix
    path.parent.mkdir(parents=True, exist_ok=True)
    WRITERS[suffix](path, log)
    if suffix == ".uff":
        cells = [log.metadata.get(key, "") for key in ("stage", "recorded_at", "travel_km")]
        archive.manifest.append([path.relative_to(archive.folder).as_posix(), *cells])


def text_of(log: LogFile) -> bytes:
    """Write a log as delimited text."""
    lines = [f"# {key}: {value}" for key, value in log.metadata.items()] + [",".join(log.columns)]
    rows = zip(*(values.tolist() for values in log.columns.values()), strict=True)
    lines += [",".join(f"{value:.7g}" for value in row) for row in rows]
    return ("\n".join(lines) + "\n").encode()


def _hdf5(path: Path, log: LogFile) -> None:
    with h5py.File(path, "w") as file:
        for name, values in log.columns.items():
            file[name] = values
        file.attrs.update(log.metadata)


def _parquet(path: Path, log: LogFile) -> None:
    table = pa.table(dict(log.columns)).replace_schema_metadata(dict(log.metadata))
    pq.write_table(table, path, use_dictionary=False, write_page_checksum=True)


def _tdms(path: Path, log: LogFile) -> None:
    channels = [ChannelObject("log", name, values) for name, values in log.columns.items()]
    with TdmsWriter(str(path)) as writer:
        writer.write_segment([RootObject(dict(log.metadata)), *channels])


def _mat(path: Path, log: LogFile) -> None:
    savemat(path, {**log.columns, **log.metadata}, do_compression=True)


def _uff(path: Path, log: LogFile) -> None:
    path.unlink(missing_ok=True)
    file = pyuff.UFF(str(path))
    for name, values in log.columns.items():
        record_58 = pyuff.prepare_58(
            binary=1, id1=name, func_type=1, rsp_node=1, rsp_dir=1, ref_node=0, ref_dir=0,
            abscissa_spacing=1, abscissa_min=0.0, abscissa_inc=1 / RATE,
            abscissa_spec_data_type=17, abscissa_axis_units_lab="s",
            ordinate_spec_data_type=0, orddenom_spec_data_type=0,
            data=values.astype(float), x=np.arange(values.size) / RATE,
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # pyuff leaves the file open
            file.write_sets([record_58], mode="add")


WRITERS: Mapping[str, Callable[[Path, LogFile], object]] = {
    ".csv": lambda path, log: path.write_bytes(text_of(log)),
    ".csv.gz": lambda path, log: path.write_bytes(gzip.compress(text_of(log), 1)),
    ".parquet": _parquet,
    ".h5": _hdf5,
    ".tdms": _tdms,
    ".mat": _mat,
    ".uff": _uff,
}
SUFFIXES = tuple(WRITERS)
