"""Bars that say how far a long job is, how fast it goes, and when it will be done."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text


class _Rate(ProgressColumn):
    """How many are done in a second, or in a minute where they are slow."""

    def render(self, task: Task) -> Text:
        """Give the rate, once it is known."""
        speed = task.finished_speed or task.speed
        if not speed:
            return Text("")
        return Text(f"{speed:.1f}/s" if speed >= 1 else f"{60 * speed:.1f}/min")


@contextmanager
def progress_bars() -> Iterator[Any]:
    """Show bars with rate and time left on a terminal's standard error, and nothing elsewhere."""
    with Progress(
        TextColumn("{task.description:<12}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=not sys.stderr.isatty(),
    ) as bars:
        known: dict[str, Any] = {}

        def tell(what: str, done: int, total: int) -> None:
            if what not in known:
                # What is done at the beginning was done before: it is no measure of the rate.
                known[what] = bars.add_task(what, total=total, completed=done)
            bars.update(known[what], completed=done, total=total)

        yield tell
