"""Watch a folder of logs, and run over it whenever files have arrived and stopped growing."""

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from lmshealth.batch.ingest import Settings
from lmshealth.batch.run import RunResult, run
from lmshealth.errors import LmshealthError
from lmshealth.stage.description import Stage

_Files = dict[Path, tuple[int, int]]


def watch(
    folder: Path, stages: Sequence[Stage], out: Path, settings: Settings, *, interval: float
) -> Iterator[RunResult | LmshealthError]:
    """Yield the result of `run`, or its error, whenever it has something to do; never end.

    Files whose size or time differ from the poll before, ``interval`` seconds earlier, are left to
    a later run. The folder is polled, because network shares report no changes. There is a run on
    every new day (UTC) too: services fall due, and machines fall silent, without a new log.
    """
    before, done, day = _files(folder, out), _Files(), None
    while True:
        time.sleep(interval)
        now, today = _files(folder, out), datetime.now(UTC).date()
        settled = {path: seen for path, seen in now.items() if before.get(path) == seen}
        before = now
        new = settled.items() - done.items() or done.keys() - now.keys()
        # A folder without files may be a share that is not mounted now: tables stay as they are.
        if settled and (new or today != day):
            done, day = settled, today
            growing = frozenset(now.keys() - settled.keys())
            try:
                yield run(folder, stages, out, replace(settings, growing=growing))
            except LmshealthError as error:
                yield error


def _files(folder: Path, out: Path) -> _Files:
    """Return size in bytes and time of change in ns of all files outside of the output."""
    found: _Files = {}
    inside = out.resolve()
    for parent, folders, files in os.walk(folder.absolute()):
        here = Path(parent)
        folders[:] = [
            name for name in folders if name[0] != "." and (here / name).resolve() != inside
        ]
        for path in (here / name for name in files if name[0] != "."):
            try:
                seen = path.stat()
            except OSError:  # removed meanwhile
                continue
            found[path] = seen.st_size, seen.st_mtime_ns
    return found
