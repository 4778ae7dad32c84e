"""Refusals: why a file cannot be used, and text of files made safe to print."""

import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

_NEAREST = 3
_MOST_LISTED = 12


class Unusable(Exception):
    """A file that cannot be used; `read_log` turns it into a ``BadLog`` with the file's name.

    The reason is the code in ``refused.csv`` (report/REFUSALS.md has all); the detail is what was
    found, what is needed, and the next step.
    """

    def __init__(self, reason: str, detail: str) -> None:
        self.reason = reason
        # It quotes the file, and may reach a terminal.
        self.detail = visible(detail)
        super().__init__(f"{reason}: {self.detail}")


def corrupt(what: str) -> Unusable:
    """Return the refusal of a damaged file."""
    return Unusable("corrupt", f"{what}; copy the file again")


def listed(names: Iterable[str]) -> str:
    """List names for a message: the first dozen, with control characters escaped."""
    all_names = list(names)
    text = ", ".join(
        name if name.isprintable() and len(name) <= 60 else ascii(name[:60])
        for name in all_names[:_MOST_LISTED]
    )
    more = len(all_names) - _MOST_LISTED
    return (text or "nothing") + (f" and {more} more" if more > 0 else "")


def nearest(sought: Iterable[str], names: Iterable[str]) -> str:
    """List for a message the names most like those sought, or all of at most a dozen."""
    from difflib import get_close_matches

    there = {name.casefold(): name for name in names}
    near = [
        there[key] for one in sought for key in get_close_matches(one.casefold(), there, _NEAREST)
    ]
    more = len(there) - len(set(near))
    if not near or len(there) <= _MOST_LISTED:
        return listed(there.values())
    return listed(dict.fromkeys(near)) + (f" (most like it, of {len(there)})" if more else "")


def repeated(names: Iterable[str]) -> list[str]:
    """Return the names that occur more than once, sorted."""
    return sorted(name for name, n in Counter(names).items() if n > 1)


def visible(text: str) -> str:
    """Escape control characters, marks of writing direction and lone surrogates."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def shown(path: str | Path) -> str:
    """Write a path as printable text; a doubled backslash keeps different names different."""
    return visible(os.fsdecode(path).replace("\\", "\\\\"))
