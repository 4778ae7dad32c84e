"""Logs whose identification is timed: the record of three modes, and a minute from Parquet.

Estimates depend on the log and its description only: start values from the last log of a machine
would save half of the time of a log, but select one of several maxima by the order of reading.
"""

from __future__ import annotations

import tempfile
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
from models.recordings.recording import record
from studies.modes.identification.cases import CASES

CASE = next(case for case in CASES if case.name == "three modes, three channels, 60 s")
SECONDS = 60.0
SIGNALS = ("delta_e", "acc_feed", "acc_pitch", "acc_between")


def headline_log(seed: int) -> Log:
    """Make the headline record."""
    return CASE.make(np.random.default_rng(seed), CASE.modes, CASE.noise)


@contextmanager
def parquet_log() -> Iterator[tuple[Callable[[], None], Callable[[], None]]]:
    """Write a minute at 20 kHz; yield its reading and transforming, and its identification."""
    stage = load_stage("lms-y")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.parquet"
        rng = np.random.default_rng(1)
        made = record(stage_named("lms-y"), seconds=SECONDS, rng=rng)
        feed, pitch = made.columns["acc_feed_m_s2"], made.columns["acc_pitch_m_s2"]
        # A third accelerometer halfway between the other two, with the noise of one.
        between = (feed + pitch) / 2 + 0.1 * feed.std() * rng.standard_normal(feed.size)
        made = replace(made, columns={**made.columns, "acc_between_m_s2": between})
        write_log(made, path, "parquet")

        def yardstick() -> None:
            log = read_log(path)
            for channel in log.channels:
                if channel.name in SIGNALS:
                    fft.rfft(channel.values[:])

        def all_of_it() -> None:
            identify(read_log(path), stage)

        yield yardstick, all_of_it
