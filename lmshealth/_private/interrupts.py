"""Signals by which a user, a supervisor or a terminal that is closed ends a program."""

import signal

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
INTERRUPTS = frozenset(one for one in signal.Signals if one.name in _NAMES)


def ignore_interrupts() -> None:
    """Leave interrupts to the parent of this process: a group of processes gets them as one."""
    for one in INTERRUPTS:
        signal.signal(one, signal.SIG_IGN)
