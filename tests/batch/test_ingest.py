"""Ingest: several logs in one task, and those of a task whose worker ends."""

from collections.abc import Iterable, Iterator
from contextlib import closing
from datetime import datetime
from hashlib import sha256
from pathlib import Path
from threading import Thread
from time import process_time
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest

from lmshealth.batch import constants
from lmshealth.batch.alerts import Alerts
from lmshealth.batch.ingest import Settings, _identified, _Outcome, _Task, _within, identify_log
from lmshealth.batch.run import run
from lmshealth.batch.store import Resources, Store
from lmshealth.batch.workers import Item, OnCrash, Pool, Result, Task
from lmshealth.errors import BadLog, LmshealthError
from lmshealth.io.log import Refusal
from lmshealth.io.manifest import copy_error
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.stage.description import load_stage
from tests.signals import Mode, accelerations, write_archive_stage, write_log

BAD = "log-0013"


class Fragile(Pool):
    """A pool whose workers end by one log."""

    size = 2

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def map_unordered(
        self, function: Task[Item, Result], items: Iterable[Item], on_crash: OnCrash[Item, Result]
    ) -> Iterator[tuple[Item, Result]]:
        """Apply the function to parts without that log."""
        for part in items:
            assert isinstance(part, tuple)
            self.sizes.append(len(part))
            ends = any(task.name == BAD for task in part)
            yield part, on_crash(part, "signal 9") if ends else function(part)


def work(tasks: Iterable[_Task]) -> list[_Outcome]:
    """Refuse every log."""
    return [_Outcome(("", ""), "", None, (Refusal(task.name, "empty", ""),)) for task in tasks]


def test_a_log_that_ends_its_worker_costs_no_other_log() -> None:
    """The logs of its task are identified one by one, and it alone is refused for that."""
    tasks = [_Task(Path(f"log-{k:04d}"), f"log-{k:04d}", {}, "0" * 64, None) for k in range(150)]
    pool = Fragile()
    with closing(Store("sqlite://")) as store:
        parts = list(_identified(tasks, work, Resources(store, pool), lambda part: ()))
    refused = [one.refused[0] for part, _ in parts for one in part]
    assert sorted(one.log for one in refused) == [task.name for task in tasks]
    assert [one.log for one in refused if one.reason == "crashed"] == [BAD]
    assert max(pool.sizes) == constants.LOGS_PER_TASK
    assert pool.sizes.count(1) == constants.LOGS_PER_TASK


def test_few_logs_are_spread_over_the_workers() -> None:
    """A handful of logs is not one task."""
    tasks = [_Task(Path(str(k)), str(k), {}, "0" * 64, None) for k in range(6)]
    pool = Fragile()
    with closing(Store("sqlite://")) as store:
        parts = list(_identified(tasks, work, Resources(store, pool), lambda part: ()))
    assert len([one for part, _ in parts for one in part]) == len(tasks)
    assert pool.sizes == [1] * len(tasks)


def test_a_log_is_refused_at_the_end_of_its_time(tmp_path: Path) -> None:
    """Its refusal states how far it came and the next step; with enough time it has modes."""
    stage = load_stage("lms-y")
    noise = accelerations(np.random.default_rng(1), [Mode(126.4, 0.015)], 20_000, 1000.0, 0.5)
    path = tmp_path / "log.csv"
    facts = {"sample_rate_hz": 1000, "stage": "one-Y", "recorded_at": "2026-01-01T00:00:00Z"}
    facts |= {"travel_km": 10, "temperature_c": 21}
    head = "\n".join([*(f"# {key}: {value}" for key, value in facts.items()), "acc_roll_m_s2"])
    np.savetxt(path, noise[0], header=head, comments="")
    digest = sha256(path.read_bytes()).hexdigest()
    task = _Task(path, "log.csv", {}, digest, None)
    short = identify_log(task, (stage,), {}, 1e-3)
    (refusal,) = short.outcome if isinstance(short.outcome, tuple) else ()
    assert refusal.reason == "too-slow"
    assert "allowed are 0.001 s" in refusal.detail
    assert "--seconds-per-log" in refusal.detail
    assert not short.lasting
    assert isinstance(identify_log(task, (stage,), {}, 60.0).outcome, LogEstimates)


def test_the_time_of_a_log_is_its_own() -> None:
    """What another thread of the same worker identifies meanwhile does not count."""

    def work_for_a_while() -> None:
        end = process_time() + 0.3
        while process_time() < end:
            pass

    check = _within(0.2, "log.csv")
    other = Thread(target=work_for_a_while)
    other.start()
    other.join()
    check("fit", 1, 2)
    work_for_a_while()
    with pytest.raises(BadLog, match="too-slow"):
        check("fit", 2, 2)


def test_a_copy_that_its_row_contradicts_names_the_contradiction() -> None:
    """Samples are of one machine and moment: another one is a bad row, in full; a copy is none."""
    moment = "2026-09-01T08:00:00+00:00"
    there = {"stage": "A", "travel_km": "1", "recorded_at": "2026-04-04T22:25:26+00:00"}
    for same in ({"stage": "A"}, {"travel_km": "1.0", "recorded_at": "2026-04-04T22:25:26Z"}):
        error = copy_error("b.csv", same, "a.csv", there)
        assert error.reason == "duplicate" and "analysed for both" in error.detail
    error = copy_error("b.csv", {**there, "stage": "B", "recorded_at": moment}, "a.csv", there)
    assert (error.log, error.reason) == ("b.csv", "bad-row")
    assert f"recorded_at {moment} (there {there['recorded_at']}); only a.csv" in error.detail
    assert "stage B (there A), " in error.detail and "travel_km" not in error.detail


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"workers": 0}, "workers is 0; needed a whole number of at least 1"),
        ({"workers": "2"}, "workers is '2'; needed a whole number"),
        ({"epochs": -3}, "epochs is -3"),
        ({"epochs": 2.5}, "epochs is 2.5"),
        ({"seed": -1}, "seed is -1; needed a whole number of at least 0"),
        ({"max_memory": -1.0}, "max_memory is -1.0; needed a number above 0"),
        ({"seconds_per_log": float("nan")}, "seconds_per_log is nan"),
        ({"alerts": Alerts(silent_days=-7)}, "silent_days is -7"),
        ({"latest": datetime(2026, 1, 1)}, "latest is .*; needed a moment with a time zone"),
        ({"today": "2026-01-01"}, "today is '2026-01-01'; needed a day"),
        ({"language": "fr"}, "language is 'fr'; needed one of"),
        ({"columns": {"columns": {}}}, "columns is .*; needed a result of column_map"),
    ],
)
def test_impossible_settings_are_refused(given: dict[str, Any], text: str) -> None:
    """Each is named with its value, and what is needed."""
    with pytest.raises(LmshealthError, match=f"^Settings: {text}"):
        Settings(**given)


def test_a_recording_that_is_stored_in_two_forms_is_analysed_once(tmp_path: Path) -> None:
    """An attribute or a compression makes another file of it; the listed one is analysed."""
    folder = tmp_path / "logs"
    first, other = write_log(folder / "1.h5", 1.0, 0), write_log(folder / "2.h5", 0.98, 1)
    copy = folder / "0-copy.h5"
    copy.write_bytes(other.read_bytes())
    with h5py.File(copy, "a") as file:
        file.attrs["remark"] = "exported again"
    rows = "".join(f"{path.name},{100 * k}\n" for k, path in enumerate((first, other)))
    (folder / "manifest.csv").write_text(f"file,travel_km\n{rows}")
    stage = load_stage(write_archive_stage(tmp_path))
    result = run(folder, [stage], tmp_path / "out")
    refused = pd.read_csv(tmp_path / "out" / "refused.csv")
    assert dict(zip(refused["log"], refused["reason"], strict=True)) == {"0-copy.h5": "duplicate"}
    assert (result.n_logs, result.n_refused, result.n_unlisted) == (2, 0, 0)
