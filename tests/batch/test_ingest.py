"""Ingest: several logs in one task, and those of a task whose worker ends."""

from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path

from lmshealth.batch import constants
from lmshealth.batch.cache import Resources
from lmshealth.batch.ingest import _identified, _Outcome, _Task
from lmshealth.batch.store import Store
from lmshealth.batch.workers import Item, OnCrash, Pool, Result, Task
from lmshealth.io.log import Refusal

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
    refused = [one.refused[0] for part in parts for one in part]
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
    assert len([one for part in parts for one in part]) == len(tasks)
    assert pool.sizes == [1] * len(tasks)
