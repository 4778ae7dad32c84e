"""A process of its own for files whose libraries can crash, hang or take any memory.

Native code can end its process by a signal, loop, or allocate what a damaged header claims. One
process per session reads such files, one after the other. It starts with the first of them, and
ends with this one. It is no fork, which is unsafe beside threads, and does not import the module
``__main__`` of a user. Requests and answers pass through its standard input and output, the samples
of each column through a temporary file. Both are JSON and bare numbers, never pickles: a damaged
file may have written into the memory of the sender of an answer.
"""

import atexit
import faulthandler
import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from multiprocessing.spawn import get_executable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, cast

import msgspec

from lmshealth.errors import LmshealthError
from lmshealth.io import constants
from lmshealth.io.buffers import Spool, received
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, Load, load_by
from lmshealth.io.refusal import Unusable

# Signals by which a user, a supervisor or a terminal that is closed ends a program.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
INTERRUPTS = frozenset(one for one in signal.Signals if one.name in _NAMES)


def ignore_interrupts() -> None:
    """Leave interrupts to the parent of this process: a group of processes gets them as one."""
    for one in INTERRUPTS:
        signal.signal(one, signal.SIG_IGN)


_START = (
    "import sys; sys.path[:] = sys.argv[1:]; "
    "from lmshealth.io.formats.isolation import serve; serve()"
)
_SETTING = "LMSHEALTH_MAX_SECONDS"
# Threads of linear algebra take memory, and none is needed. What a column has freed is used for the
# next one (glibc): taking it from the system again costs as much as a copy.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
_ENVIRONMENT |= {"MALLOC_MMAP_THRESHOLD_": str(1 << 25), "MALLOC_TRIM_THRESHOLD_": str(1 << 27)}


class _Request(NamedTuple):
    """Arguments of `load_by`, and what the process may take: seconds, and bytes of memory."""

    form: str
    load: str  # module and name of the function
    path: str
    columns: dict[str, Any]  # of a `ColumnMap`
    max_memory: float
    seconds: float
    memory: float
    library: str  # imported before these count
    folder: str  # for the samples


@dataclass(frozen=True, slots=True, eq=False)
class _Received(Content):
    """A content with the names of the files of its columns."""

    columns: Any


class _Ended(Exception):
    """The process ended while it read a file."""


def read_isolated(form: Format, path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Read a file as `load_by` does, in the process.

    `Unusable` also where the process ends (``corrupt``), where reading takes too long
    (``too-slow``), and where the system ends the process (``too-large``).
    """
    stored = path.stat().st_size
    memory = max(3 * constants.SMALL_ENOUGH, min(max_memory, constants.LARGEST_RATIO * stored))
    seconds = _max_seconds() + stored / constants.SLOWEST_READING
    load = f"{form.load.__module__}:{form.load.__qualname__}"
    arguments = form.name, load, str(path.absolute()), msgspec.to_builtins(columns), max_memory
    # Windows may keep an empty folder.
    with TemporaryDirectory(prefix="lmshealth-", ignore_cleanup_errors=True) as folder:
        request = _Request(*arguments, seconds, memory, form.library, folder)
        with suppress(_Ended):  # the file before may have damaged the memory of the process
            return _reader.read(request)
        try:
            return _reader.read(request)
        except _Ended as error:
            raise Unusable("corrupt", f"{error}; copy the file again") from error


def _max_seconds() -> float:
    text = os.environ.get(_SETTING, "")
    with suppress(ValueError):
        if 0 < (seconds := float(text or constants.READING_SECONDS)) < 1e6:
            return seconds
    raise LmshealthError(f"{_SETTING} is {text!r}; needed a number of seconds above 0")


class _Reader:
    """The process of a session; None while there is none."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.process: Any = None  # a `subprocess.Popen`

    def read(self, request: _Request) -> Content:
        """Let the process read a file; `_Ended` if it ends without a known reason."""
        with self._lock:
            start = time.monotonic()
            try:
                if self.process is None:
                    self._start()
                start = time.monotonic()
                return self._exchange(request)
            except (EOFError, ValueError, TypeError, BrokenPipeError) as error:
                spent = time.monotonic() - start
                raise _reason(self._end(1.0), request, spent) from error
            except BaseException as error:
                # After an interrupt it would still send what belongs to this request.
                if not isinstance(error, Unusable) or error.reason == "too-large":
                    self._end()
                raise

    def _start(self) -> None:
        """Start the process, and wait until it is ready."""
        python = os.fsdecode(get_executable() or sys.executable)
        self.process = subprocess.Popen(
            [python, "-P", "-c", _START, *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | _ENVIRONMENT,
        )
        self.process.stdout.readline()

    def _exchange(self, request: _Request) -> Content:
        """Send a request and receive the content, or raise the refusal."""
        self.process.stdin.write(json.dumps(request).encode() + b"\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        content, *refusal = msgspec.convert(json.loads(line), tuple[_Received | None, str, str])
        if content is None:
            raise Unusable(*refusal)
        files = {name: os.path.basename(own) for name, own in content.columns.items()}
        columns = {name: received(os.path.join(request.folder, own)) for name, own in files.items()}
        return replace(content, columns=columns)

    def _end(self, patience: float = 0.0) -> int:
        """Wait some seconds for its end, or end it; return its status, negative for a signal."""
        process, self.process = self.process, None
        if process is None:
            return 0
        try:
            status: int = process.wait(patience)
        except subprocess.TimeoutExpired:
            process.kill()
            status = 0
        for stream in (process.stdin, process.stdout):
            with suppress(OSError):  # of a request that could not be sent
                stream.close()
        process.wait()
        return status

    def close(self) -> None:
        """End the process, at the end of the session."""
        if self._lock.acquire(timeout=1):
            self._end()
            self._lock.release()

    def forget(self) -> None:
        """Leave the process to the parent of a fork."""
        if self.process is not None:
            self.process.returncode = 0  # so that it is not waited for
        self._lock, self.process = threading.Lock(), None


def _reason(status: int, request: _Request, spent: float) -> Exception:
    """Find out why the process ended."""
    if spent >= request.seconds:
        found = f"takes more than {request.seconds:.3g} s to be read as {request.form}"
        return Unusable("too-slow", f"{found}; copy the file again, or raise {_SETTING}")
    if status == -getattr(signal, "SIGKILL", 0):
        found = "the process that read it was killed, perhaps for lack of memory"
        return Unusable("too-large", f"{found}; run again")
    how = f"signal {-status}" if status < 0 else f"status {status}"
    return _Ended(f"the library of {request.form} crashes as it reads it ({how})")


_reader = _Reader()
atexit.register(_reader.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_reader.forget)


# In the process


def serve() -> None:
    """Read files until standard input ends."""
    ignore_interrupts()
    faulthandler.disable()
    answers = os.fdopen(os.dup(1), "w", encoding="ascii")
    # What a library prints is no answer.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    print(file=answers, flush=True)
    while line := sys.stdin.buffer.readline():
        request = _Request(*json.loads(line))
        with suppress(ImportError):  # the function of the format refuses the file
            import_module(request.library)
        _limit_memory(request.memory)
        # A thread that no library can hold ends the process.
        with open(os.devnull, "w") as nowhere:
            faulthandler.dump_traceback_later(request.seconds, exit=True, file=nowhere)
            # Texts of a file may hold lone surrogates, which msgspec does not write.
            print(json.dumps(msgspec.to_builtins(_answer(request))), file=answers, flush=True)
            faulthandler.cancel_dump_traceback_later()


def _answer(request: _Request) -> tuple[Content | None, str, str]:
    """Read a file, its samples into files of the folder; return content, or reason and detail."""
    Spool.folder = request.folder
    try:
        module, name = request.load.split(":")
        load: Load = getattr(import_module(module), name)
        columns, path = msgspec.convert(request.columns, ColumnMap), Path(request.path)
        content = load_by(request.form, load, path, columns, request.max_memory)
        files: Any = {name: cast(Spool, own).name for name, own in content.columns.items()}
        return replace(content, columns=files), "", ""
    except Unusable as error:
        return None, error.reason, error.detail


def _limit_memory(allowed: float) -> None:
    """Limit what the process may allocate from now on, where the system can (Linux)."""
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[5])
    except (ImportError, OSError):
        return
    most = pages * resource.getpagesize() + int(allowed)
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
