"""What does identification cost in time and memory?

Method
    Required: the headline record (three modes in three channels, 60 s at 1 kHz) in less than 0.05
    s; logs of 20 and 60 s at 20 kHz with four channels from Parquet to modes in at most three times
    the cost of reading and transforming them, with at most three times the memory of the longer
    one. Each alternates with its reference in one process; medians of times and ratios, and least
    times. Times are those of the processor, without the process that decodes files for both.
    Memory is the peak that Python and numpy allocate from the file on, relative to all columns in
    double precision.

    How much could start values from the last log of the machine save? At most what start values
    at the result save: identification of the log of 20 s alternates with one in which every search
    for a posterior mode starts where it ended before. They are not used: a posterior may have
    several maxima, of which the start selects one, so that estimates would depend on the order in
    which logs are read. They depend on the log and its description only, and are cached by content.
Run time
    One minute.
"""

from __future__ import annotations

import tempfile
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy import fft

from lmshealth import identify, load_stage, read_log
from lmshealth.io.log import Log
from lmshealth.modal.ambient.whittle import Likelihood
from models.dynamics.stages import stage_named
from models.recordings.formats import write_log
from models.recordings.recording import record
from studies.common.cost import in_turns
from studies.harness.claims import Claim, number
from studies.harness.study import Row, Study
from studies.identification.cases import CASES
from studies.identification.records import describe

STEP = "identify"

CASE = next(case for case in CASES if case.name == "three modes, three channels, 60 s")
SECONDS, SHORT = 60.0, 20.0
SIGNALS = ("delta_e", "acc_feed", "acc_pitch", "acc_between")


def main() -> None:
    """Run the study; ``--quick`` repeats less, with a shorter log, and records nothing."""
    study = Study(__file__, __doc__)
    answer: Row = {
        "record": headline(5 if study.quick else 40),
        "log": long_log(4, 15.0) if study.quick else long_log(15),
        "short_log": long_log(4 if study.quick else 25, SHORT),
        "best_start": best_start(4 if study.quick else 25),
    }
    answer["passed"] = {
        "headline record in less than 0.05 s": answer["record"]["least_s"] < 0.05,
        "three times reading and transforming": answer["log"]["median_ratio"] <= 3,
        "the same of 20 s": answer["short_log"]["median_ratio"] <= 3,
        "three times the record's memory": answer["log"]["memory_over_record"] <= 3,
    }
    study.conclude(answer, quick_may_fail=True)


def headline_log(seed: int) -> Log:
    """Make the headline record."""
    return CASE.make(np.random.default_rng(seed), CASE.modes, CASE.noise)


def headline(n: int) -> Row:
    """Identify the headline record, beside a product of matrices, to compare machines by."""
    stage = describe(CASE.modes)
    square = np.random.default_rng(0).standard_normal((500, 500))
    identify(headline_log(0), stage)
    logs = iter([headline_log(seed) for seed in range(n)])
    products = {"products": lambda: [square @ square for _ in range(4)]}
    spent = in_turns({"ours": lambda: identify(next(logs), stage)} | products, n)
    return {
        "n": n,
        "least_s": min(spent["ours"]),
        "median_s": float(np.median(spent["ours"])),
        "gigaflops": 2 * 500**3 / (min(spent["products"]) / 4) / 1e9,
    }


def best_start(n: int) -> Row:
    """Identify a log, and again with each search for a posterior mode started at its end."""
    stage, ends, evaluations = load_stage("lms-y"), list[np.ndarray](), {"ours": 0, "ideal": 0}
    with written_log(SHORT) as (path, _):
        log = read_log(path)
    plain, derivatives = Likelihood.minimise, Likelihood.derivatives

    def recorded(likelihood: Likelihood, start: np.ndarray) -> np.ndarray:
        ends.append(plain(likelihood, start))
        return ends[-1]

    def ideal() -> None:
        left = iter(ends)
        with patch.object(Likelihood, "minimise", lambda own, _: plain(own, next(left))):
            identify(log, stage)

    with patch.object(Likelihood, "minimise", recorded):
        identify(log, stage)
    works = {"ours": lambda: identify(log, stage), "ideal": ideal}
    for name, work in works.items():

        def counted(likelihood: Likelihood, p: np.ndarray, name: str = name) -> object:
            evaluations[name] += 1
            return derivatives(likelihood, p)

        with patch.object(Likelihood, "derivatives", counted):
            work()
    spent = in_turns(works, n)
    return {
        "n": n,
        "searches": len(ends),
        "evaluations": evaluations["ours"],
        "evaluations_at_best": evaluations["ideal"],
        "saved_share": 1 - float(np.median(np.divide(spent["ideal"], spent["ours"]))),
    }


def long_log(n: int, seconds: float = SECONDS) -> Row:
    """Take a log of the simulated stage from Parquet to its modes."""
    with parquet_log(seconds) as (yardstick, all_of_it, n_samples):
        yardstick(), all_of_it()
        spent = in_turns({"yardstick": yardstick, "ours": all_of_it}, n)
        tracemalloc.start()
        all_of_it()
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    ours, reference = spent["ours"], spent["yardstick"]
    return {
        "n": n,
        "read_and_transform_s": float(np.median(reference)),
        "to_modes_s": float(np.median(ours)),
        "median_ratio": float(np.median(np.divide(ours, reference))),
        "least_ratio": min(ours) / min(reference),
        "memory_over_record": peak / (8 * n_samples),
    }


@contextmanager
def parquet_log(
    seconds: float = SECONDS,
) -> Iterator[tuple[Callable[[], None], Callable[[], None], int]]:
    """Write a log of 20 kHz; yield its reading and transforming, its identification, its size."""
    stage = load_stage("lms-y")
    with written_log(seconds) as (path, n_samples):

        def yardstick() -> None:
            log = read_log(path)
            for channel in log.channels:
                if channel.name in SIGNALS:
                    fft.rfft(channel.values)

        def all_of_it() -> None:
            identify(read_log(path), stage)

        yield yardstick, all_of_it, n_samples


@contextmanager
def written_log(seconds: float) -> Iterator[tuple[Path, int]]:
    """Write a log of 20 kHz; yield its path, and the number of samples of all columns."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.parquet"
        rng = np.random.default_rng(1)
        made = record(stage_named("lms-y"), seconds=seconds, rng=rng)
        feed, pitch = made.columns["acc_feed_m_s2"], made.columns["acc_pitch_m_s2"]
        # A third accelerometer halfway between the other two, with the noise of one.
        between = (feed + pitch) / 2 + 0.1 * feed.std() * rng.standard_normal(feed.size)
        made = replace(made, columns={**made.columns, "acc_between_m_s2": between})
        write_log(made, path, "parquet")
        yield path, sum(values.size for values in made.columns.values())


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
    short, best = answer["short_log"], answer["best_start"]
    for name, one in (("a minute", log), ("20 s", short)):
        yield Claim(
            f"{name} of four channels at 20 kHz, over reading and transforming it",
            number(one["median_ratio"]),
            f"median of {one['n']} turns",
            "3 required",
            one["median_ratio"] <= 3,
        )
    yield Claim(
        "share of its identification that start values at the result would save",
        number(best["saved_share"]),
        f"median of {best['n']} turns",
        f"{best['evaluations']} evaluations of derivatives; {best['evaluations_at_best']} there",
    )
    memory = log["memory_over_record"]
    yield Claim("its memory over that of the record", number(memory), "", "3 required", memory <= 3)


if __name__ == "__main__":
    main()
