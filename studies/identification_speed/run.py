"""What does identification cost in time and memory?

Method
    Required: the headline record (three modes in three channels, 60 s at 1 kHz) in less than 0.05
    s; a log of 60 s at 20 kHz with four channels from Parquet to modes in at most three times the
    cost of reading and transforming it, with at most three times its memory. Each alternates with
    its reference in one process; medians of times and ratios, and least times. Memory is the peak
    that Python and numpy allocate from the file on, relative to all columns in double precision.
Run time
    One minute.
"""

from __future__ import annotations

import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import fft

from lmshealth import identify, load_stage, read_log
from lmshealth.io.log import Log
from models.dynamics.stages import stage_named
from models.recordings.formats import write_log
from models.recordings.recording import Recording, record
from studies.harness.claims import Claim, number
from studies.harness.study import Row, Study
from studies.identification.cases import CASES
from studies.identification.records import describe

STEP = "identify"

CASE = next(case for case in CASES if case.name == "three modes, three channels, 60 s")
SECONDS = 60.0
SIGNALS = ("delta_e", "acc_feed", "acc_pitch", "acc_between")


def main() -> None:
    """Run the study; ``--quick`` repeats less, with a shorter log, and records nothing."""
    study = Study(__file__, __doc__)
    answer: Row = {
        "record": headline(5 if study.quick else 40),
        "log": long_log(4, 15.0) if study.quick else long_log(15),
    }
    answer["passed"] = {
        "headline record in less than 0.05 s": answer["record"]["least_s"] < 0.05,
        "three times reading and transforming": answer["log"]["median_ratio"] <= 3,
        "three times the record's memory": answer["log"]["memory_over_record"] <= 3,
    }
    study.conclude(answer, quick_may_fail=True)


def timed(task: Callable[[], object]) -> float:
    """Seconds that a task takes."""
    start = time.perf_counter()
    task()
    return time.perf_counter() - start


def headline_log(seed: int) -> Log:
    """Make the headline record."""
    return CASE.make(np.random.default_rng(seed), CASE.modes, CASE.noise)


def headline(n: int) -> Row:
    """Identify the headline record, beside one product of matrices that every machine knows."""
    stage = describe(CASE.modes)
    square = np.random.default_rng(0).standard_normal((500, 500))
    identify(headline_log(0), stage)
    times, products = [], []
    for seed in range(n):
        log = headline_log(seed)
        times.append(timed(lambda log=log: identify(log, stage)))  # type: ignore[misc]
        products.append(timed(lambda: [square @ square for _ in range(4)]) / 4)
    return {
        "n": n,
        "least_s": min(times),
        "median_s": float(np.median(times)),
        # What the processor does at best, to compare machines by.
        "gigaflops": 2 * 500**3 / min(products) / 1e9,
    }


def long_log(n: int, seconds: float = SECONDS) -> Row:
    """Take a log of the simulated stage from Parquet to its modes."""
    with parquet_log(seconds) as (yardstick, all_of_it, n_samples):
        yardstick(), all_of_it()
        pairs = np.array([(timed(yardstick), timed(all_of_it)) for _ in range(n)])
        tracemalloc.start()
        try:
            all_of_it()
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    return {
        "n": n,
        "read_and_transform_s": float(np.median(pairs[:, 0])),
        "to_modes_s": float(np.median(pairs[:, 1])),
        "median_ratio": float(np.median(pairs[:, 1] / pairs[:, 0])),
        "least_ratio": float(pairs[:, 1].min() / pairs[:, 0].min()),
        "memory_over_record": peak / (8 * n_samples),
    }


@contextmanager
def parquet_log(
    seconds: float = SECONDS,
) -> Iterator[tuple[Callable[[], None], Callable[[], None], int]]:
    """Write that log; give what reads and transforms it, what takes it to modes, and its size."""
    stage = load_stage("lms-y")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.parquet"
        made = four_channels(seconds)
        write_log(made, path, "parquet")

        def yardstick() -> None:
            log = read_log(path)
            for channel in log.channels:
                if channel.name in SIGNALS:
                    fft.rfft(channel.values)

        def all_of_it() -> None:
            identify(read_log(path), stage)

        yield yardstick, all_of_it, sum(values.size for values in made.columns.values())


def four_channels(seconds: float) -> Recording:
    """Simulate some seconds at 20 kHz of the Y stage: Δe and three accelerometers."""
    rng = np.random.default_rng(1)
    made = record(stage_named("lms-y"), seconds=seconds, rng=rng)
    feed, pitch = made.columns["acc_feed_m_s2"], made.columns["acc_pitch_m_s2"]
    # A third accelerometer halfway between the other two, with the noise of one.
    between = (feed + pitch) / 2 + 0.1 * feed.std() * rng.standard_normal(feed.size)
    return replace(made, columns={**made.columns, "acc_between_m_s2": between})


def claims(answer: Row) -> Iterator[Claim]:
    """Claim time and memory."""
    record, log = answer["record"], answer["log"]
    yield Claim(
        "three modes in three channels of 60 s at 1 kHz, least time",
        f"{number(record['least_s'])} s",
        f"of {record['n']} turns",
        "0.05 s required",
        record["least_s"] < 0.05,
    )
    yield Claim(
        "a minute of four channels at 20 kHz, over reading and transforming it",
        number(log["median_ratio"]),
        f"median of {log['n']} turns",
        "3 required",
        log["median_ratio"] <= 3,
    )
    yield Claim(
        "its memory over that of the record",
        number(log["memory_over_record"]),
        "",
        "3 required",
        log["memory_over_record"] <= 3,
    )


if __name__ == "__main__":
    main()
