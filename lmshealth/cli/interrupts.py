"""Ends of a command that a terminal or another process asks for."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

# Python itself raises KeyboardInterrupt for SIGINT.
_ENDS = [one for one in signal.Signals if one.name in ("SIGTERM", "SIGHUP")]


class Interrupted(KeyboardInterrupt):
    """End that another process asks for, with the number of its signal; as Ctrl-C otherwise."""


def _end(number: int, frame: object) -> NoReturn:
    """Handle a signal; a second one, as `timeout` sends, must not disturb the end."""
    for name in _ENDS:
        signal.signal(name, signal.SIG_IGN)
    raise Interrupted(number)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Treat SIGTERM and SIGHUP as interrupts."""
    main = threading.current_thread() is threading.main_thread()
    # `nohup` ignores SIGHUP; other handlers are of a program that calls this one.
    handled = [name for name in _ENDS if main and signal.getsignal(name) == signal.SIG_DFL]
    for name in handled:
        signal.signal(name, _end)
    try:
        yield
    finally:
        for name in handled:
            if signal.getsignal(name) is _end:
                signal.signal(name, signal.SIG_DFL)


@contextmanager
def loading() -> Iterator[None]:
    """End by an interrupt in one line, before there is a command that could report it."""
    try:
        with ended_by_signals():
            yield
    except KeyboardInterrupt as error:
        number = error.args[0] if isinstance(error, Interrupted) else signal.SIGINT
        sys.stderr.write("lmshealth: interrupted\n")
        sys.exit(128 + number)
