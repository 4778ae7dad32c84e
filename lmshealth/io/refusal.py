"""Why a file cannot be used, before anyone has said which file it is."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

_SHOWN = 12


class Unusable(Exception):
    """What is wrong with the file at hand; `read_log` turns it into a ``BadLog`` with its name.

    Parameters
    ----------
    reason : str
        Short kind of the trouble, the ``reason`` column of ``refused.csv``.
    detail : str
        What was found, what is needed, and the next step.
    """

    def __init__(self, reason: str, detail: str) -> None:
        self.reason = reason
        # It quotes what the file says, and may reach a terminal.
        self.detail = visible(detail)
        super().__init__(f"{reason}: {self.detail}")


def listed(names: Iterable[str]) -> str:
    """List names for a message, the first dozen of them, with control characters made visible."""
    all_names = list(names)
    shown = ", ".join(
        name if name.isprintable() and len(name) <= 60 else ascii(name[:60])
        for name in all_names[:_SHOWN]
    )
    more = len(all_names) - _SHOWN
    return (shown or "nothing") + (f" and {more} more" if more > 0 else "")


def visible(text: str) -> str:
    """Escape control characters, marks that turn the direction of writing, and halves of signs."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def shown(path: str | Path) -> str:
    """Write a path so that it can be printed and stored, whatever bytes its name has.

    The backslash is doubled, so that different names stay different.
    """
    return visible(os.fsdecode(path).replace("\\", "\\\\"))
