"""Helpers of all folders: arrays, results, files, serialisation, TOML; plug-ins.

Plug-ins are objects that installed packages add under a group of entry points.
"""

import logging
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from typing import Any, TypeVar

_log = logging.getLogger(__name__)
T = TypeVar("T")


def load_plug_ins(
    group: str, noun: str, known: Sequence[T], check: Callable[[Any, Sequence[T]], T]
) -> tuple[T, ...]:
    """Return the known objects and those of a group; one that cannot be used is logged as an error.

    `check` returns a loaded object, given all before it, or raises an error that states what it is
    and what is needed. A broken package must not keep the others from being used.
    """
    found = list(known)
    for point in entry_points(group=group):
        try:
            found.append(check(point.load(), found))
        except Exception as error:
            source = point.dist.name if point.dist else "an unknown distribution"
            what = f"{type(error).__name__}: {error}"
            _log.error("%s %r of %s is not used: %s; update or uninstall it",
                       noun, point.name, source, what)  # fmt: skip
    return tuple(found)
