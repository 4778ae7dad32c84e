"""Does reading a log cost more than the library that reads its format?

Method
    One minute of four signals at 20 kHz with the metadata of a log, written once in each format.
    The bare library call that gives the same columns and the reader take turns in one process; the
    least processor time of each counts, beside that of `read_log`, which also hashes the file and
    judges every sample. CSV is compared with the faster one of pandas' C engine and pyarrow's
    reader. HDF5, Parquet and MAT are read in a process of their own, whose time counts, and which
    hands samples over in files. The same write alone is timed beside it, and the quick form judges
    readers by the library and that write: plain MAT is little but one copy of memory. Then ten
    minutes of the same signals, read in a process of its own by the reader and by the bare call,
    which holds all of the log (control): the peak of its memory, less what it had after a short
    file, in minutes of the log (8 bytes for each sample of each channel), and the processor time.
Run time
    About ten minutes, and 2 GB of disk.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.registry import confirm, load
from lmshealth.io.reading import read_log
from studies.cost.reading.files import BARE, RATE, Columns, signals, write
from studies.cost.reading.memory import both_s
from studies.harness.claims import Claim, span
from studies.harness.cost import in_own_process, in_turns
from studies.harness.study import Row, Study

_SHARED = "samples come from another process through shared pages, which takes 10 ms for a minute"
_BUSY = "lines are checked for damage first; 1.29 on 29 November, 1.4 beside other work"
NOT_MET = dict.fromkeys(("log.h5", "log.tdms", "plain.mat", "packed.mat"), _SHARED)

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


def main() -> None:
    """Run the study; ``--quick`` reads less of fewer formats, and records nothing."""
    study = Study(__file__, __doc__)
    quick, collect = study.quick, study.trials.collect
    names, how = (BOUNDED, (60, 3)) if quick else (tuple(BARE), (60, ROUNDS))
    found = collect(timed, [(name, *how) for name in names])
    times = dict(zip(names, found, strict=True))
    names, minutes = (QUICK_MEMORY, QUICK_MINUTES) if quick else (tuple(BARE), LONG_MINUTES)
    chosen = ("delta_e_um",) if quick else tuple(signals(1))
    found = collect(long_log, [(name, minutes, chosen) for name in names])
    memory = dict(zip(names, found, strict=True))
    bound = QUICK_BOUND if quick else BOUND
    answer = {
        "seed": 0,
        "times": times,
        "bound": bound,
        "passed": {
            name: times[name]["ratio_with_transfer" if quick else "ratio"] <= bound
            for name in BOUNDED
        },
        "memory_minutes": minutes,
        "memory": memory,
        "memory_bound": MOST_MINUTES,
        "memory_passed": {
            name: memory[name]["minutes_of_reader"]
            < MOST_MINUTES
            < memory[name]["minutes_of_library"]
            for name in STREAMED
            if name in memory
        },
    }
    study.conclude(answer, not_met=NOT_MET | {"log.csv": _BUSY}, quick_may_fail=True)


def timed(name: str, seconds: int, rounds: int) -> Row:
    """Let libraries and reader take turns on a file of a format."""
    with tempfile.TemporaryDirectory() as folder:
        columns = signals(RATE * seconds)
        path = write(Path(folder) / name, columns)
        isolated = bool(confirm(path).library)
        works = {call.__name__: partial(call, path) for call in BARE[name]}
        ours = {"reader": lambda: load(path, ColumnMap()), "read_log": lambda: read_log(path)}
        ours["transfer"] = partial(transfer, columns if isolated else {}, Path(folder))
        load(path, ColumnMap())  # starts the process that reads native formats
        spent = in_turns(works | ours, 2 if path.suffix == ".uff" else rounds, both_s)
        megabytes = path.stat().st_size / 1e6
    least = {way: min(own) for way, own in spent.items()}
    bare = min(least[way] for way in works)
    return {
        "file_mb": round(megabytes, 1),
        "library_s": {way: round(least[way], 4) for way in works},
        "reader_s": round(least["reader"], 4),
        "ratio": round(least["reader"] / bare, 2),
        "transfer_s": round(least["transfer"], 4),
        "ratio_with_transfer": round(least["reader"] / (bare + least["transfer"]), 2),
        "reader_mb_s": round(megabytes / least["reader"]),
        "read_log_s": round(least["read_log"], 4),
        "read_log_ratio": round(least["read_log"] / bare, 2),
    }


def transfer(columns: Columns, folder: Path) -> None:
    """Write samples to files, as the process that reads a format does for the one that asks."""
    for name, values in columns.items():
        path = folder / f"{name}.samples"
        path.write_bytes(values.data)
        path.unlink()


def long_log(name: str, n_minutes: int, chosen: tuple[str, ...]) -> dict[str, float]:
    """Return the peak memory of reader and library, in minutes of the log, and their time."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "short").mkdir()
        paths = Path(folder) / name, Path(folder) / "short" / name
        for path, seconds in zip(paths, (60 * n_minutes, 1), strict=True):
            columns = signals(RATE * seconds)
            write(path, {key: columns[key] for key in chosen})
        del columns
        found = in_own_process("studies.cost.reading.memory", *paths)
    minute = 8 * 60 * RATE * len(chosen)
    return {
        f"{key}_of_{way}": round(value, digits)
        for way, own in found.items()
        for key, value, digits in (
            ("minutes", own["bytes"] / minute, 2),
            ("cpu_s", own["cpu_s"], 3),
        )
    }


def claims(answer: Row) -> Iterator[Claim]:
    """Claim times and memory beside the bare libraries."""
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


if __name__ == "__main__":
    main()
