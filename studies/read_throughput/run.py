"""Does reading a log cost more than the library that reads its format, and what is refused?

Question
    How long does each reader take, as a ratio to the bare library call that gives the same
    columns in the same process, and which of the real samples are read, which refused and why?
Method
    One minute of four signals at 20 kHz with the metadata of a log, written once in each format.
    Bare call and reader take turns; the least processor time of each counts. Beside it what
    `read_log` takes as a whole, which also hashes the file and judges every sample. CSV is
    compared with the faster one of pandas' C engine and pyarrow's reader. Then every UFF58, TDMS,
    MAT and CSV file of the real samples is read without and with its column map.
Run time
    About a minute.
Data
    All folders of LMSHEALTH_DATA; without them only the times are measured.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import json
import os
import shutil
import tempfile
import time
import tomllib
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import msgspec
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pyuff
import scipy.io
from nptdms import ChannelObject, RootObject, TdmsFile, TdmsWriter

from lmshealth.errors import BadLog
from lmshealth.readers import ColumnMap, read_log
from lmshealth.readers.formats import load
from studies.read_throughput.samples import MAPS
from studies.record import Stopwatch, keep

HERE = Path(__file__).parent
RATE = 20_000
# Noise and fixed costs do not shrink with the file: the quick form is judged more mildly. An HDF5
# reader that searched for damage as slowly as it might took 3.0 times the library.
BOUND, QUICK_BOUND = 1.3, 2.5
BOUNDED = ("log.h5", "log.parquet", "log.tdms", "plain.mat", "packed.mat", "log.csv")
META = {
    "stage": "demo-Y",
    "recorded_at": "2026-03-01T08:30:00+01:00",
    "travel_km": "123.5",
    "sample_rate_hz": str(RATE),
}
SUFFIXES = (".uff", ".tdms", ".mat", ".csv", ".gz")


def main() -> None:
    """Run the study; ``--quick`` reads half a minute instead of a whole and records nothing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    watch = Stopwatch()
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder), RATE * (30 if quick else 60))
        times = {name: compare(Path(folder) / name, call) for name, call in BARE.items()}
    bound = QUICK_BOUND if quick else BOUND
    answer = {
        "seed": 0,
        "times": times,
        "bound": bound,
        "passed": {name: times[name]["ratio"] <= bound for name in BOUNDED},
        "samples": samples() if "LMSHEALTH_DATA" in os.environ else None,
    }
    if not quick:
        if answer["samples"] is None:
            raise SystemExit("LMSHEALTH_DATA is not set: it names the folder of real measurements")
        keep(HERE / "result.json", __doc__.split("\n")[0], answer, watch)
    print(json.dumps(answer, indent=1))


def write(folder: Path, n: int) -> None:
    """Write the same log in every format."""
    rng = np.random.default_rng(0)
    columns = {
        "delta_e_um": rng.normal(0, 0.05, n),
        "acc_feed_m_s2": rng.normal(0, 0.3, n),
        "acc_pitch_m_s2": rng.normal(0, 0.3, n),
        "reference_velocity_mm_s": np.full(n, 100.0),
    }
    with h5py.File(folder / "log.h5", "w") as file:
        for name, values in columns.items():
            file[name] = values
        file.attrs.update(META)
    table = pa.table(columns).replace_schema_metadata(META)
    pq.write_table(table, folder / "log.parquet", use_dictionary=False)
    with TdmsWriter(str(folder / "log.tdms")) as writer:
        for start in range(0, n, RATE):
            second = slice(start, start + RATE)
            channels = [ChannelObject("log", k, v[second]) for k, v in columns.items()]
            writer.write_segment([RootObject(META), *channels])
    scipy.io.savemat(folder / "plain.mat", columns | META)
    scipy.io.savemat(folder / "packed.mat", columns | META, do_compression=True)
    with (folder / "log.csv").open("w") as stream:
        stream.writelines(f"# {key}: {value}\n" for key, value in META.items())
        pd.DataFrame(columns).to_csv(stream, index=False)
    with (folder / "log.csv").open("rb") as text, gzip.open(folder / "log.csv.gz", "wb", 1) as to:
        shutil.copyfileobj(text, to)
    for kind in ("ascii", "binary"):
        write_uff(folder / f"{kind}.uff", columns, binary=int(kind == "binary"))


def write_uff(path: Path, columns: dict[str, Any], *, binary: int) -> None:
    """Write time records, each under its column's name."""
    file = pyuff.UFF(str(path))
    for name, values in columns.items():
        record = pyuff.prepare_58(
            binary=binary, id1=name, func_type=1, rsp_node=1, rsp_dir=1, ref_node=0, ref_dir=0,
            data=values, x=np.arange(values.size) / RATE, abscissa_spacing=1,
            abscissa_min=0.0, abscissa_inc=1 / RATE, abscissa_spec_data_type=17,
            ordinate_spec_data_type=0, orddenom_spec_data_type=0,
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # pyuff leaves the file open
            file.write_sets([record], mode="add")


def bare_hdf5(path: Path) -> object:
    """Read every dataset with h5py."""
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}


def bare_parquet(path: Path) -> object:
    """Read every column with pyarrow."""
    table = pq.read_table(path)
    return {name: table.column(name).to_numpy() for name in table.column_names}


def bare_tdms(path: Path) -> object:
    """Read every channel with npTDMS."""
    file = TdmsFile.read(path)
    return {channel.name: channel[:] for group in file.groups() for channel in group.channels()}


def bare_pandas(path: Path) -> object:
    """Read every column with pandas; it unpacks gzip by itself."""
    return dict(pd.read_csv(path, skiprows=len(META), engine="c").items())


def bare_arrow(path: Path) -> object:
    """Read every column with pyarrow; it unpacks gzip by itself."""
    skip = pyarrow.csv.ReadOptions(skip_rows=len(META))
    table = pyarrow.csv.read_csv(path, read_options=skip)
    return {name: table.column(name).to_numpy() for name in table.column_names}


def bare_uff(path: Path) -> object:
    """Read every data set with pyuff."""
    return pyuff.UFF(str(path)).read_sets()


BARE: dict[str, tuple[Callable[[Path], object], ...]] = {
    "log.h5": (bare_hdf5,),
    "log.parquet": (bare_parquet,),
    "log.tdms": (bare_tdms,),
    "plain.mat": (scipy.io.loadmat,),
    "packed.mat": (scipy.io.loadmat,),
    "log.csv": (bare_pandas, bare_arrow),
    "log.csv.gz": (bare_pandas, bare_arrow),
    "ascii.uff": (bare_uff,),
    "binary.uff": (bare_uff,),
}


def cost(work: Callable[[], object]) -> float:
    """Return the processor time of one call in s, over all threads."""
    start = time.process_time()
    work()
    return time.process_time() - start


def compare(path: Path, calls: tuple[Callable[[Path], object], ...]) -> dict[str, Any]:
    """Let libraries and reader take turns on one file."""
    rounds = 2 if path.suffix == ".uff" else 9
    libraries: dict[str, list[float]] = {call.__name__: [] for call in calls}
    reader, whole = [], []
    for _ in range(rounds):
        for call in calls:
            libraries[call.__name__].append(cost(partial(call, path)))
        reader.append(cost(lambda: load(path, ColumnMap())))
        whole.append(cost(lambda: read_log(path)))
    least = {name: min(seconds) for name, seconds in libraries.items()}
    bare = min(least.values())
    megabytes = path.stat().st_size / 1e6
    return {
        "file_mb": round(megabytes, 1),
        "library_s": {name: round(seconds, 4) for name, seconds in least.items()},
        "reader_s": round(min(reader), 4),
        "ratio": round(min(reader) / bare, 2),
        "reader_mb_s": round(megabytes / min(reader)),
        "read_log_s": round(min(whole), 4),
        "read_log_ratio": round(min(whole) / bare, 2),
    }


def samples() -> dict[str, dict[str, str]]:
    """Read every sample without and with its column map."""
    data = Path(os.environ["LMSHEALTH_DATA"])
    files = sorted(path for path in data.rglob("*") if path.suffix in SUFFIXES)
    return {path.relative_to(data).as_posix(): outcomes(path, data) for path in files}


def outcomes(path: Path, data: Path) -> dict[str, str]:
    """Say what becomes of one sample; text under another suffix is offered as CSV."""
    name = path.relative_to(data).as_posix()
    found = {"as it is": outcome(path, ColumnMap(), name)}
    if name in MAPS:
        columns = msgspec.convert(tomllib.loads(MAPS[name]), ColumnMap)
        with contextlib.ExitStack() as stack:
            if path.name.endswith(".txt.gz"):
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
                path = Path(shutil.copyfile(path, folder / "renamed.csv.gz"))
            found["with its map"] = outcome(path, columns, name)
    return found


def outcome(path: Path, columns: ColumnMap, name: str) -> str:
    """Say in a line what `read_log` makes of a file."""
    try:
        log = read_log(path, columns=columns, name=name)
    except BadLog as error:
        return f"refused, {error.reason}: {error.detail}"
    n_samples = log.channels[0].values.size
    refused = "".join(f"; {r.channel} refused, {r.reason}" for r in log.refused)
    return f"read: {len(log.channels)} x {n_samples} at {log.sample_rate:.7g} Hz{refused}"


if __name__ == "__main__":
    main()
