"""Why a file cannot be used, before anyone has said which file it is."""

from __future__ import annotations

from collections.abc import Iterable

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
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


def listed(names: Iterable[str]) -> str:
    """List names for a message, the first dozen of them, with control characters made visible."""
    all_names = list(names)
    shown = ", ".join(
        name if name.isprintable() and len(name) <= 60 else ascii(name[:60])
        for name in all_names[:_SHOWN]
    )
    more = len(all_names) - _SHOWN
    return (shown or "nothing") + (f" and {more} more" if more > 0 else "")
