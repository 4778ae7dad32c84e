"""Import of this project's modules as a system or an installation without some modules does it."""

import builtins
import importlib
import os
import signal
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

# Modules and names that Windows lacks.
ABSENT = {"crypt", "curses", "fcntl", "grp", "posix", "pty", "pwd", "readline", "resource",
          "syslog", "termios", "tty"}  # fmt: skip
SIGNALS = {one.name for one in signal.Signals} - {
    "SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM"
} | {"alarm", "pthread_kill", "pthread_sigmask", "setitimer", "sigwait"}  # fmt: skip
SYSTEM = {"chown", "fork", "forkpty", "geteuid", "getloadavg", "getpgid", "getuid",
          "killpg", "mkfifo", "nice", "openpty", "register_at_fork", "sched_getaffinity", "setsid",
          "sysconf", "uname", "wait4", "WNOHANG"}  # fmt: skip
# Modules of extras that the workflow `compat` does not install.
EXTRAS = {"apprise", "weasyprint", "ipykernel", "jupytext", "nbclient", "nbconvert", "pooch",
          "psycopg"}  # fmt: skip


def _without(module: ModuleType, names: Iterable[str]) -> ModuleType:
    """Copy a module without some of its names."""
    copy = ModuleType(module.__name__)
    left = {name: value for name, value in vars(module).items() if name not in set(names)}
    vars(copy).update(left)
    return copy


def hide(root: Path, hidden: set[str]) -> None:
    """Hide modules, and names of ``os`` and ``signal``, from modules below a folder only."""
    folder, venv = (f"{one.resolve()}{os.sep}" for one in (root, root / ".venv"))
    reduced = {"os": _without(os, SYSTEM), "signal": _without(signal, SIGNALS)}
    original = builtins.__import__

    def imported(
        name: str, space: Mapping[str, Any] | None = None, *rest: Any, **named: Any
    ) -> ModuleType:
        file = str((space or {}).get("__file__", ""))
        if file.startswith(folder) and not file.startswith(venv):
            if name.partition(".")[0] in hidden:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)
            if name in reduced:
                return reduced[name]
        return original(name, space, *rest, **named)

    # Typeshed has no place for further arguments.
    builtins.__import__ = imported  # type: ignore[assignment]


def main(root: Path) -> int:
    """Collect the tests below a folder, then import all modules of its packages."""
    original = builtins.__import__
    hide(root, ABSENT | EXTRAS)
    options = ["--collect-only", "-qq", "-p", "no:cacheprovider", "-W", "error"]
    if status := pytest.main([*options, str(root)]):
        return status
    builtins.__import__ = original
    hide(root, ABSENT)
    for package in ("lmshealth", "models", "studies"):
        for path in sorted((root / package).rglob("*.py")):
            name = ".".join(path.relative_to(root).with_suffix("").parts)
            if "notebooks" not in name and not name.endswith("__main__"):
                try:
                    importlib.import_module(name.removesuffix(".__init__"))
                except ModuleNotFoundError as error:
                    if str(error.name).partition(".")[0] in ABSENT:
                        raise  # others are of extras
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
