"""The same signals written as every format."""

from __future__ import annotations

import gzip
import subprocess
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import pyuff
import scipy.io
from nptdms import ChannelObject, RootObject, TdmsWriter

META = {
    "stage": "demo-Y",
    "recorded_at": "2026-03-01T08:30:00+01:00",
    "travel_km": "123.5",
    "sample_rate_hz": "2000",
    "temperature_c": "21.4",
}
Writer = Callable[..., Path]


def signals(n: int = 400, rate: float = 2000.0) -> dict[str, np.ndarray]:
    """Make noise in the columns of the log contract."""
    rng = np.random.default_rng(0)
    return {
        "time_s": np.arange(n) / rate,
        "delta_e_um": rng.normal(0, 0.05, n),
        "acc_feed_m_s2": rng.normal(0, 0.3, n),
        "reference_velocity_mm_s": np.full(n, 100.0),
    }


def write(path: Path, columns: Mapping[str, np.ndarray], meta: Mapping[str, str]) -> Path:
    """Write columns and metadata in the format that the suffix names."""
    if path.suffix in (".h5", ".hdf5"):
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file[name] = values
            file.attrs.update(meta)
    elif path.suffix == ".parquet":
        table = pa.table(dict(columns)).replace_schema_metadata(dict(meta) | {"pandas": "{}"})
        pq.write_table(table, path)
    elif path.suffix == ".tdms":
        channels = [ChannelObject("log", name, values) for name, values in columns.items()]
        with TdmsWriter(str(path)) as writer:
            writer.write_segment([RootObject(dict(meta)), *channels])
    elif path.suffix == ".mat":
        scipy.io.savemat(path, {**columns, **meta}, do_compression=True)
    else:
        lines = [f"# {key}: {value}" for key, value in meta.items()] + [",".join(columns)]
        rows = zip(*columns.values(), strict=True)
        lines += [",".join(repr(float(value)) for value in row) for row in rows]
        data = ("\n".join(lines) + "\n").encode()
        path.write_bytes(gzip.compress(data, 1) if path.suffix == ".gz" else data)
    return path


def write_uff(path: Path, records: Mapping[str, np.ndarray], **entries: object) -> Path:
    """Write time records of acceleration in g at 2 kHz; entries replace those of the header."""
    path.unlink(missing_ok=True)
    file = pyuff.UFF(str(path))
    for name, values in records.items():
        header = {
            "binary": 0,
            "id1": name,
            "func_type": 1,
            "rsp_node": 1,
            "rsp_dir": 1,
            "ref_node": 0,
            "ref_dir": 0,
            "abscissa_spacing": 1,
            "abscissa_min": 0.0,
            "abscissa_inc": 5e-4,
            "abscissa_spec_data_type": 17,
            "abscissa_axis_units_lab": "s",
            "ordinate_spec_data_type": 12,
            "ordinate_axis_units_lab": "g",
            "orddenom_spec_data_type": 0,
        }
        data = {"data": values, "x": np.arange(values.size) / 2000}
        content = pyuff.prepare_58(**{**header, **data, **entries})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # pyuff leaves the file open
            file.write_sets([content], mode="add")
    return path


@pytest.fixture
def make(tmp_path: Path) -> Writer:
    """Write a log of usual signals, with some of them and of the metadata replaced or dropped."""

    def make(
        file: str = "log.csv",
        columns: Mapping[str, np.ndarray | None] | None = None,
        meta: Mapping[str, str | None] | None = None,
        n: int = 400,
    ) -> Path:
        table = {**signals(n), **(columns or {})}
        text = {**META, **(meta or {})}
        return write(
            tmp_path / file,
            {key: value for key, value in table.items() if value is not None},
            {key: value for key, value in text.items() if value is not None},
        )

    return make


@pytest.fixture
def peaks(root: Path) -> Callable[[Path, Path], tuple[int, int]]:
    """Measure the bytes of memory that a file takes, in blocks and by the bare library.

    A short one of its kind is read before, so that imports and caches do not count.
    """

    def peaks(short: Path, path: Path) -> tuple[int, int]:
        command = [sys.executable, "-W", "ignore", "tests/io/peak.py", str(short), str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=root)
        own, bare = (int(word) for word in done.stdout.split())
        return own, bare

    return peaks
