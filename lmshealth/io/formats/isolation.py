"""A process of its own for files whose libraries can crash, hang or take any memory.

Native code can end its process by a signal, loop, or allocate what a damaged header claims. One
process per session reads such files, one after the other. It starts with the first of them, and
ends with this one. It is no fork, which is unsafe beside threads, and does not import the module
``__main__`` of a user. Requests and answers pass through its standard input and output, samples
through a temporary file that both processes map, so that no shared memory of the system is needed.
Both are JSON and bare numbers, never pickles: a damaged file may have written into the memory of
the sender of an answer.
"""

from __future__ import annotations

import atexit
import faulthandler
import json
import mmap
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from importlib import import_module
from multiprocessing.spawn import get_executable
from pathlib import Path
from typing import IO, Any, NamedTuple

import msgspec
import numpy as np

from lmshealth.errors import LmshealthError
from lmshealth.io import constants
from lmshealth.io.buffers import Spool
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, Load, load_by
from lmshealth.io.log import Refusal
from lmshealth.io.refusal import Unusable

_START = (
    "import json, sys; sys.path[:] = json.loads(sys.stdin.buffer.readline()); "
    "from lmshealth.io.formats.isolation import serve; serve()"
)
# Bytes of samples that are handed over at once: they stay in the processor's cache.
_WINDOW = 1 << 21
_SETTING = "LMSHEALTH_MAX_SECONDS"


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


class _Answer(msgspec.Struct, omit_defaults=True):
    """One line of an answer.

    Either samples that follow it, of a column by its number; or, at the end, what a `Content` has,
    with the numbers of its columns; or a refusal.
    """

    column: int = 0
    dtype: str = ""
    size: int = 0
    expected: int = 0  # of the whole column
    columns: dict[str, int] | None = None
    metadata: dict[str, str] = {}
    present: tuple[str, ...] = ()
    refused: tuple[Refusal, ...] = ()
    guessed: tuple[str, ...] = ()
    reason: str = ""
    detail: str = ""


class _Ended(Exception):
    """The process ended while it read a file."""


def read_isolated(form: Format, path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Read a file as `load_by` does, in the process.

    `Unusable` also where the process ends (``corrupt``), where reading takes too long
    (``too-slow``), and where the system ends the process (``too-large``).
    """
    stored = path.stat().st_size
    memory = max(3 * constants.SMALL_ENOUGH, min(max_memory, 4 * stored))
    seconds = _max_seconds() + stored / constants.SLOWEST_READING
    load = f"{form.load.__module__}:{form.load.__qualname__}"
    arguments = form.name, load, str(path.absolute()), msgspec.to_builtins(columns), max_memory
    request = _Request(*arguments, seconds, memory, form.library)
    try:
        return _reader.read(request)
    except _Ended:
        # The file before may have damaged the memory of the process.
        try:
            return _reader.read(request)
        except _Ended as error:
            raise Unusable("corrupt", f"{error}; copy the file again") from error


def _max_seconds() -> float:
    text = os.environ.get(_SETTING, "")
    try:
        seconds = float(text or constants.READING_SECONDS)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < 1e6:
        raise LmshealthError(f"{_SETTING} is {text!r}; needed a number of seconds above 0")
    return seconds


class _Process:
    """The running process, its pipes and its window."""

    def __init__(self) -> None:
        file = tempfile.NamedTemporaryFile(prefix="lmshealth-", delete=False)  # noqa: SIM115
        try:
            with file:
                file.truncate(_WINDOW)
                self._window = mmap.mmap(file.fileno(), _WINDOW)
            self.popen = subprocess.Popen(
                [os.fsdecode(get_executable() or sys.executable), "-P", "-c", _START],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                # Threads of linear algebra take memory, and none is needed.
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            )
            assert self.popen.stdin is not None and self.popen.stdout is not None
            self._requests: IO[bytes] = self.popen.stdin
            self._answers: Any = self.popen.stdout
            for text in (sys.path, file.name):
                self._write(text)
            self._answers.readline()
        finally:
            with suppress(OSError):  # Windows keeps it until the process has ended
                os.unlink(file.name)

    def _write(self, content: object) -> None:
        self._requests.write(json.dumps(content).encode() + b"\n")
        self._requests.flush()

    def read(self, request: _Request) -> Content:
        """Send a request and receive samples and content, or raise the refusal."""
        self._write(request)
        spools: dict[int, Spool] = {}
        while True:
            answer = msgspec.convert(json.loads(self._answers.readline()), _Answer)
            if answer.reason:
                raise Unusable(answer.reason, answer.detail)
            if answer.columns is not None:
                columns = {
                    name: spools.get(k, Spool()).samples() for name, k in answer.columns.items()
                }
                parts = answer.metadata, answer.present, answer.refused, answer.guessed
                return Content(columns, *parts)
            spool = spools.setdefault(answer.column, Spool(answer.expected))
            self._receive(spool, answer.size, np.dtype(answer.dtype))

    def _receive(self, spool: Spool, size: int, dtype: np.dtype[Any]) -> None:
        """Receive samples of a column."""
        if dtype.kind not in "fiu":
            raise ValueError(f"samples are of type {dtype}")
        window = np.frombuffer(self._window, dtype)
        for start in range(0, size, window.size):
            if not self._answers.read(1):
                raise EOFError
            part = window[: size - start]
            spool.append(part if spool.expected else part.copy())
            self._requests.write(b"\n")
            self._requests.flush()

    def end(self, patience: float) -> int:
        """Wait some seconds for its end, or end it; return its status, negative for a signal."""
        try:
            status = self.popen.wait(patience)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            status = 0
        for stream in (self._requests, self._answers):
            with suppress(OSError):  # of a request that could not be sent
                stream.close()
        self.popen.wait()
        return status


class _Reader:
    """The process of a session."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: _Process | None = None

    def read(self, request: _Request) -> Content:
        """Let the process read a file; `_Ended` if it ends without a known reason."""
        with self._lock:
            start = time.monotonic()
            try:
                if self._process is None:
                    self._process = _Process()
                start = time.monotonic()
                return self._process.read(request)
            except (EOFError, ValueError, TypeError, BrokenPipeError) as error:
                spent = time.monotonic() - start
                raise _reason(self._end(1.0), request, spent) from error
            except BaseException as error:
                # After an interrupt it would still send what belongs to this request.
                if not isinstance(error, Unusable) or error.reason == "too-large":
                    self._end()
                raise

    def _end(self, patience: float = 0.0) -> int:
        process, self._process = self._process, None
        return 0 if process is None else process.end(patience)

    def close(self) -> None:
        """End the process, at the end of the session."""
        if self._lock.acquire(timeout=1):
            self._end()
            self._lock.release()

    def forget(self) -> None:
        """Leave the process to the parent of a fork."""
        if self._process is not None:
            self._process.popen.returncode = 0  # so that it is not waited for
        self._lock, self._process = threading.Lock(), None


def _reason(status: int, request: _Request, spent: float) -> Exception:
    """Find out why the process ended."""
    if spent >= request.seconds:
        found = f"takes more than {request.seconds:.3g} s to be read as {request.form}"
        return Unusable("too-slow", f"{found}; copy the file again, or raise {_SETTING}")
    if status == -getattr(signal, "SIGKILL", 0):
        detail = "the process that read it was killed, perhaps for lack of memory; run again"
        return Unusable("too-large", detail)
    how = f"signal {-status}" if status < 0 else f"status {status}"
    return _Ended(f"the library of {request.form} crashes as it reads it ({how})")


_reader = _Reader()
atexit.register(_reader.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_reader.forget)


# In the process


def serve() -> None:
    """Read files until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles interrupts
    faulthandler.disable()
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    # What a library prints is no answer.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    with open(json.loads(requests.readline()), "r+b") as file:
        window = mmap.mmap(file.fileno(), _WINDOW)
    sender = _Sender(answers, window, requests)
    answers.write(b"\n")
    answers.flush()
    while line := requests.readline():
        request = _Request(*json.loads(line))
        with suppress(ImportError):  # the function of the format refuses the file
            import_module(request.library)
        _limit_memory(request.memory)
        # A thread that no library can hold ends the process.
        with open(os.devnull, "w") as file:
            faulthandler.dump_traceback_later(request.seconds, exit=True, file=file)
            sender.answer(request)
            faulthandler.cancel_dump_traceback_later()


class _Sender:
    """Sends the samples of each column while they are read."""

    def __init__(self, stream: IO[bytes], window: mmap.mmap, taken: IO[bytes]) -> None:
        self._stream = stream
        self._window = window
        self._taken = taken
        self._numbers: dict[object, int] = {}
        Spool.send = self._send

    def _number(self, spool: object) -> int:
        return self._numbers.setdefault(spool, len(self._numbers))

    def _send(self, spool: Spool, block: np.ndarray) -> None:
        window = np.frombuffer(self._window, block.dtype)
        header = self._number(spool), block.dtype.str, block.size, spool.expected
        self._line(_Answer(*header))
        for start in range(0, block.size, window.size):
            part = block[start : start + window.size]
            window[: part.size] = part
            self._stream.write(b"\n")
            self._stream.flush()
            self._taken.read(1)

    def answer(self, request: _Request) -> None:
        """Send all that a file holds, or why it is refused."""
        self._numbers.clear()
        try:
            module, name = request.load.split(":")
            load: Load = getattr(import_module(module), name)
            columns = msgspec.convert(request.columns, ColumnMap)
            path, most = Path(request.path), request.max_memory
            content = load_by(request.form, load, path, columns, most)
            numbers = {name: self._number(spool) for name, spool in content.columns.items()}
            parts = content.metadata, content.present, content.refused, content.guessed
            self._line(_Answer(0, "", 0, 0, numbers, *parts))
        except Unusable as error:
            self._line(_Answer(reason=error.reason, detail=error.detail))
        self._stream.flush()

    def _line(self, answer: _Answer) -> None:
        # Texts of a file may hold lone surrogates, which msgspec does not write.
        self._stream.write(json.dumps(msgspec.to_builtins(answer)).encode() + b"\n")


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
