"""Does reading a log cost more than the library that reads its format, and what is refused?

Question
    How long does each reader take, as a ratio to the bare library call that gives the same
    columns in the same process? How much memory does it take for a long log? Which of the real
    samples are read, which refused and why?
Method
    One minute of four signals at 20 kHz with the metadata of a log, written once in each format.
    Bare call and reader take turns; the least processor time of each counts. Beside it what
    `read_log` takes as a whole, which also hashes the file and judges every sample. CSV is
    compared with the faster one of pandas' C engine and pyarrow's reader. Then ten minutes of the
    same signals, read in a process of its own by the reader and by the bare call: the peak of its
    memory, less what it had after a short file, in minutes of the log (8 bytes for each sample of
    each channel), and the processor time. The bare call is the control: it holds all of the log,
    and what the reader puts on disk costs time that it does not. Then every UFF58, TDMS,
    MAT and delimited file of the real samples is read without and with its column map.
Run time
    About ten minutes, and 2 GB of disk.
Data
    All folders of LMSHEALTH_DATA; ``--quick`` measures times and memory alone and needs none.
"""

from __future__ import annotations

import os
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import msgspec

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.registry import load
from lmshealth.io.reading import read_log
from studies.harness.claims import Claim, span
from studies.harness.study import Row, Study
from studies.read_throughput.files import BARE, RATE, Call, signals, write
from studies.read_throughput.memory import needs
from studies.read_throughput.samples import MAPS

STEP = "read"

# Noise and fixed costs do not shrink with the file: the quick form is judged more mildly. An HDF5
# reader that searched for damage as slowly as it might took 3.0 times the library.
BOUND, QUICK_BOUND = 1.3, 2.5
BOUNDED = ("log.h5", "log.parquet", "log.tdms", "plain.mat", "packed.mat", "log.csv")
# Of the log held in memory at once.
MOST_MINUTES = 4
LONG_MINUTES, QUICK_MINUTES = 10, 5
QUICK_MEMORY = ("log.h5", "log.parquet")
# The others are decoded as a whole, up to --max-memory.
STREAMED = ("log.h5", "log.parquet", "log.csv", "log.csv.gz")
ROUNDS = 9
SUFFIXES = (".uff", ".tdms", ".mat", ".csv", ".gz")


def main() -> None:
    """Run the study; ``--quick`` reads less of fewer formats, no samples, and records nothing."""
    study = Study(__file__, __doc__)
    if not study.quick and "LMSHEALTH_DATA" not in os.environ:
        raise SystemExit("LMSHEALTH_DATA is not set: it names the folder of real measurements")
    quick, trials = study.quick, study.trials
    names = BOUNDED if quick else tuple(BARE)
    found = trials.collect(timed, [(name, *((8, 3) if quick else (60,))) for name in names])
    times = dict(zip(names, found, strict=True))
    long = QUICK_MINUTES if quick else LONG_MINUTES
    names = QUICK_MEMORY if quick else tuple(BARE)
    chosen = ("delta_e_um",) if quick else tuple(signals(1))
    found = trials.collect(long_log, [(name, long, chosen) for name in names])
    memory = dict(zip(names, found, strict=True))
    bound = QUICK_BOUND if quick else BOUND
    answer = {
        "seed": 0,
        "times": times,
        "bound": bound,
        "passed": {name: times[name]["ratio"] <= bound for name in BOUNDED},
        "memory_minutes": long,
        "memory": memory,
        "memory_bound": MOST_MINUTES,
        "memory_passed": {
            name: row["minutes_of_reader"] < MOST_MINUTES < row["minutes_of_library"]
            for name, row in memory.items()
            if name in STREAMED
        },
        "samples": None if quick else samples(),
    }
    study.conclude(answer, quick_may_fail=True)


def timed(name: str, seconds: int, rounds: int = ROUNDS) -> Row:
    """Compare reader and libraries on a file of a format."""
    with tempfile.TemporaryDirectory() as folder:
        return compare(write(Path(folder) / name, signals(RATE * seconds)), BARE[name], rounds)


def cost(work: Callable[[], object]) -> float:
    """Return the processor time of one call in s, over all threads."""
    start = time.process_time()
    work()
    return time.process_time() - start


def compare(path: Path, calls: tuple[Call, ...], rounds: int) -> Row:
    """Let libraries and reader take turns on one file."""
    rounds = 2 if path.suffix == ".uff" else rounds
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


def long_log(name: str, n_minutes: int, chosen: tuple[str, ...]) -> dict[str, float]:
    """Return the peak memory of reader and library, in minutes of the log, and their time."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "short").mkdir()
        paths = Path(folder) / name, Path(folder) / "short" / name
        for path, seconds in zip(paths, (60 * n_minutes, 1), strict=True):
            columns = signals(RATE * seconds)
            write(path, {key: columns[key] for key in chosen})
        del columns
        found = needs(*paths)
    minute = 8 * 60 * RATE * len(chosen)
    return {
        "minutes_of_reader": round(found["reader"]["bytes"] / minute, 2),
        "minutes_of_library": round(found["library"]["bytes"] / minute, 2),
        "cpu_s_of_reader": round(found["reader"]["cpu_s"], 3),
        "cpu_s_of_library": round(found["library"]["cpu_s"], 3),
    }


def samples() -> dict[str, dict[str, str]]:
    """Read every sample without and with its column map."""
    data = Path(os.environ["LMSHEALTH_DATA"])
    files = sorted(path for path in data.rglob("*") if path.suffix in SUFFIXES)
    return {path.relative_to(data).as_posix(): outcomes(path, data) for path in files}


def outcomes(path: Path, data: Path) -> dict[str, str]:
    """Return what becomes of one sample."""
    name = path.relative_to(data).as_posix()
    found = {"as it is": outcome(path, ColumnMap(), name)}
    if name in MAPS:
        columns = msgspec.convert(tomllib.loads(MAPS[name]), ColumnMap)
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


def claims(answer: Row) -> Iterator[Claim]:
    """Claim times and memory beside the bare libraries, and what becomes of real files."""
    times, memory = answer["times"], answer["memory"]
    bounded = [times[name]["ratio"] for name in answer["passed"]]
    yield Claim(
        "processor time of a reader over that of the bare library, six formats",
        span(bounded),
        "least of nine turns",
        f"{answer['bound']} required",
        max(bounded) <= answer["bound"],
    )
    yield Claim(
        "the same of compressed CSV and UFF58",
        span(row["ratio"] for name, row in times.items() if name not in answer["passed"]),
    )
    yield Claim(
        f"memory for a log of {answer['memory_minutes']} minutes, in minutes of the log",
        span(row["minutes_of_reader"] for row in memory.values()),
        "",
        f"the libraries take {span(row['minutes_of_library'] for row in memory.values())}",
        all(answer["memory_passed"].values()),
    )
    samples = answer["samples"].values()
    told = sum(any(text.startswith("read") for text in sample.values()) for sample in samples)
    yield Claim(
        "real files that are read, as they are or by a column map",
        f"{told} of {len(samples)}",
        "",
        "the others are refused with a reason",
    )


if __name__ == "__main__":
    main()
