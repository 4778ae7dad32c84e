"""Archives of any number of short logs of equal cost, and the cost of the steps of a run."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from studies.inputs.damaged.logfiles import DESCRIPTION, Archive, log_of, recordings, write

LOGS_PER_MACHINE, SECONDS = 100, 10.0
_N_BASES = 8


def make_archive(folder: Path, n_logs: int) -> None:
    """Write ``stage.toml`` and ``logs``: so many of machines that do not age, 100 to a machine."""
    (folder / "stage.toml").write_text(DESCRIPTION.replace("damaged-?-Y", "many-*-Y"))
    archive = Archive(folder / "logs")
    n_bases = min(_N_BASES, -(-n_logs // 2))
    bases = recordings(n_bases, SECONDS)
    for k in range(n_logs):
        machine, own = divmod(k, LOGS_PER_MACHINE)
        log = log_of(bases[k % n_bases], 0, np.random.default_rng([20261122, k]))
        moment = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(hours=own)
        log.metadata["stage"] = f"many-{machine:04d}-Y"
        log.metadata["recorded_at"] = moment.isoformat()
        log.metadata["travel_km"] = f"{0.5 * own:g}"
        write(archive, archive.folder / f"{machine:04d}" / f"{own:03d}.h5", log)


class Steps:
    """Divides the time of a clock among the steps of a run, by its reports of progress."""

    def __init__(self, clock: Callable[[], float] = time.process_time) -> None:
        self._clock, self._step, self._since = clock, "starting", clock()
        self.seconds: dict[str, float] = {}

    def __call__(self, what: str, done: int, total: int) -> None:
        """Add the time since the last report to the step that it named."""
        now = self._clock()
        self.seconds[self._step] = self.seconds.get(self._step, 0.0) + now - self._since
        self._step, self._since = what, self._clock()
