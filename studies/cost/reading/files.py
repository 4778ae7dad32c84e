"""The same log in every format, and the bare library call that reads each."""

from __future__ import annotations

import gzip
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pyuff
import scipy.io
from nptdms import ChannelObject, RootObject, TdmsFile, TdmsWriter

RATE = 20_000
META = {
    "stage": "demo-Y",
    "recorded_at": "2026-03-01T08:30:00+01:00",
    "travel_km": "123.5",
    "sample_rate_hz": str(RATE),
}
Columns = dict[str, np.ndarray]


def signals(n: int) -> Columns:
    """Make the columns of a log."""
    rng = np.random.default_rng(0)
    return {
        "delta_e_um": rng.normal(0, 0.05, n),
        "acc_feed_m_s2": rng.normal(0, 0.3, n),
        "acc_pitch_m_s2": rng.normal(0, 0.3, n),
        "reference_velocity_mm_s": np.full(n, 100.0),
    }


def _hdf5(path: Path, columns: Columns) -> None:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values
        file.attrs.update(META)


def _parquet(path: Path, columns: Columns) -> None:
    table = pa.table(columns).replace_schema_metadata(META)
    # One row group holds the whole log: the most that a reader can be asked to stream.
    pq.write_table(table, path, use_dictionary=False, row_group_size=table.num_rows)


def _tdms(path: Path, columns: Columns) -> None:
    n = columns["delta_e_um"].size
    with TdmsWriter(str(path)) as writer:
        for start in range(0, n, RATE):
            second = slice(start, start + RATE)
            channels = [ChannelObject("log", k, v[second]) for k, v in columns.items()]
            writer.write_segment([RootObject(META), *channels])


def _mat(path: Path, columns: Columns) -> None:
    scipy.io.savemat(path, {**columns, **META}, do_compression=path.stem == "packed")


def _csv(path: Path, columns: Columns) -> None:
    options = pyarrow.csv.WriteOptions(quoting_style="none")
    with path.open("wb") as stream:
        stream.writelines(f"# {key}: {value}\n".encode() for key, value in META.items())
        pyarrow.csv.write_csv(pa.table(columns), stream, options)


def _csv_gz(path: Path, columns: Columns) -> None:
    plain = path.with_suffix(".text")
    _csv(plain, columns)
    with plain.open("rb") as text, gzip.open(path, "wb", 1) as packed:
        shutil.copyfileobj(text, packed, 1 << 20)
    plain.unlink()


def _uff(path: Path, columns: Columns) -> None:
    """Write time records, each under its column's name."""
    file = pyuff.UFF(str(path))
    for name, values in columns.items():
        record = pyuff.prepare_58(
            binary=int(path.stem == "binary"), id1=name, func_type=1, rsp_node=1, rsp_dir=1,
            ref_node=0, ref_dir=0, data=values, x=np.arange(values.size) / RATE,
            abscissa_spacing=1, abscissa_min=0.0, abscissa_inc=1 / RATE,
            abscissa_spec_data_type=17, ordinate_spec_data_type=0, orddenom_spec_data_type=0,
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # pyuff leaves the file open
            file.write_sets([record], mode="add")


_WRITERS: dict[str, Callable[[Path, Columns], None]] = {
    "log.h5": _hdf5,
    "log.parquet": _parquet,
    "log.tdms": _tdms,
    "plain.mat": _mat,
    "packed.mat": _mat,
    "log.csv": _csv,
    "log.csv.gz": _csv_gz,
    "ascii.uff": _uff,
    "binary.uff": _uff,
}


def write(path: Path, columns: Columns) -> Path:
    """Write a log in the format that the file's name asks for."""
    _WRITERS[path.name](path, columns)
    return path


def bare_h5py(path: Path) -> object:
    """Read every dataset with h5py."""
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}


def bare_pyarrow(path: Path) -> object:
    """Read every column of a Parquet or CSV file with pyarrow, which unpacks gzip by itself."""
    skip = pyarrow.csv.ReadOptions(skip_rows=len(META))
    is_parquet = path.suffix == ".parquet"
    table = pq.read_table(path) if is_parquet else pyarrow.csv.read_csv(path, read_options=skip)
    return {name: table.column(name).to_numpy() for name in table.column_names}


def bare_nptdms(path: Path) -> object:
    """Read every channel with npTDMS."""
    groups = TdmsFile.read(path).groups()
    return {channel.name: channel[:] for group in groups for channel in group.channels()}


def bare_pandas(path: Path) -> object:
    """Read every column with pandas; it unpacks gzip by itself."""
    return dict(pd.read_csv(path, skiprows=len(META), engine="c").items())


def bare_scipy(path: Path) -> object:
    """Read every variable with scipy."""
    return scipy.io.loadmat(path)


def bare_pyuff(path: Path) -> object:
    """Read every data set with pyuff."""
    return pyuff.UFF(str(path)).read_sets()


Call = Callable[[Path], Any]
BARE: dict[str, tuple[Call, ...]] = {
    "log.h5": (bare_h5py,),
    "log.parquet": (bare_pyarrow,),
    "log.tdms": (bare_nptdms,),
    "plain.mat": (bare_scipy,),
    "packed.mat": (bare_scipy,),
    "log.csv": (bare_pandas, bare_pyarrow),
    "log.csv.gz": (bare_pandas, bare_pyarrow),
    "ascii.uff": (bare_pyuff,),
    "binary.uff": (bare_pyuff,),
}
