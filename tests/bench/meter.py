"""Processor time of the steps of a run, and of a log by itself in between."""

from __future__ import annotations

import time
from pathlib import Path

from lmshealth import identify, read_log
from lmshealth.signal.readings import loop_error
from lmshealth.stage.description import Stage
from studies.cost.archive import Steps
from studies.harness.cost import cpu_s

EVERY = 21  # so that every recording that the logs are made of is among them


class Meter(Steps):
    """Divides processor time among the steps of a run, and measures the yardstick in between."""

    def __init__(self, logs: list[Path], stage: Stage) -> None:
        super().__init__()
        self._logs, self._stage = logs, stage
        self._every = min(EVERY, max(len(logs) // 2, 1))
        self.yardstick: list[tuple[float, float, float]] = []

    def __call__(self, what: str, done: int, total: int) -> None:
        """Measure the step that was reported last, and of some logs the yardstick."""
        super().__call__(what, done, total)
        if what == "identifying" and done and done % self._every == self._every // 2:
            self.yardstick.append(self._by_itself(self._logs[done - 1]))
            self._since = time.process_time()

    def _by_itself(self, path: Path) -> tuple[float, float, float]:
        """Return the times in s of reading a log, identification, and other analyses."""
        start = time.process_time()
        log = read_log(path)
        read = time.process_time()
        identified = cpu_s(lambda: identify(log, self._stage))
        other = cpu_s(lambda: loop_error(log))
        return read - start, identified, other
