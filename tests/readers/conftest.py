"""The same signals written as every format."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

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
    else:
        lines = [f"# {key}: {value}" for key, value in meta.items()] + [",".join(columns)]
        rows = zip(*columns.values(), strict=True)
        lines += [",".join(repr(float(value)) for value in row) for row in rows]
        data = ("\n".join(lines) + "\n").encode()
        path.write_bytes(gzip.compress(data, 1) if path.suffix == ".gz" else data)
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
