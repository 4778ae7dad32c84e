"""Progress bars of long jobs, with rate and remaining time."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich import progress
from rich.console import Console
from rich.text import Text


class _Rate(progress.ProgressColumn):
    """Rate per second, or per minute below one per second."""

    def render(self, task: progress.Task) -> Text:
        """Return the rate; empty until it is measured."""
        speed = task.finished_speed or task.speed
        if not speed:
            return Text("")
        return Text(f"{speed:.1f}/s" if speed >= 1 else f"{60 * speed:.1f}/min")


@contextmanager
def progress_bars(delay: float = 0.0) -> Iterator[Any]:
    """Show progress bars on standard error if it is a terminal; yield their callback.

    Nothing is shown in the first ``delay`` seconds.
    """
    shown_from = time.monotonic() + delay
    with progress.Progress(
        progress.TextColumn("{task.description:<12}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        _Rate(),
        progress.TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=not sys.stderr.isatty(),
    ) as bars:
        tasks: dict[str, Any] = {}

        def report(what: str, done: int, total: int) -> None:
            if time.monotonic() < shown_from:
                return
            if what not in tasks:
                # Work that is done at the start was cached and does not count for the rate.
                tasks[what] = bars.add_task(what, total=total, completed=done)
            bars.update(tasks[what], completed=done, total=total)

        yield report
