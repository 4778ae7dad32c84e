"""A process of its own for risky libraries: crashes, hangs, memory, interrupts, forks."""

import os
import signal
import subprocess
import sys
import threading
import time

import h5py
import numpy as np
import pytest

from lmshealth.errors import BadLog, LmshealthError
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats import isolation
from lmshealth.io.formats.content import Content, Format
from lmshealth.io.formats.isolation import read_isolated
from lmshealth.io.formats.registry import load
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable


def crash(path, columns, max_memory):
    """End the process as a native library does."""
    signal.raise_signal(signal.SIGSEGV)


def crash_once(path, columns, max_memory):
    """End the process at the first of two attempts."""
    mark = path.with_suffix(".mark")
    if not mark.exists():
        mark.touch()
        os._exit(7)
    return Content({}, {"stage": "\udcff"}, ("a",))


def kill(path, columns, max_memory):
    """End as the system ends a process without memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def hang(path, columns, max_memory):
    """Loop without giving way to other threads of Python, as native code does."""
    sum(range(1 << 40))


def swell(path, columns, max_memory):
    """Take more memory than a small file can need."""
    np.zeros(4 << 30, dtype="u1")


def print_much(path, columns, max_memory):
    """Print as libraries do."""
    print("{}" * 100, flush=True)
    os.write(2, b"error\n")
    return Content({}, {}, ())


def deceive(path, columns, max_memory):
    """Answer with bytes that are none of the protocol."""
    os.write(isolation_answers(), b"\x80\x04]garbage\n")
    return Content({}, {}, ())


def isolation_answers():
    """Find the pipe of answers: it is the first that is open after the standard ones."""
    return next(fd for fd in range(3, 64) if fd_is_pipe(fd))


def fd_is_pipe(fd):
    """Return whether a file descriptor is an open pipe."""
    try:
        return os.readlink(f"/proc/self/fd/{fd}").startswith("pipe")
    except OSError:
        return False


@pytest.fixture
def file(tmp_path):
    """Write a file, whatever it holds."""
    path = tmp_path / "log.x"
    path.write_bytes(b"x")
    return path


def attempt(function, path):
    """Read a file by a function in the process."""
    return read_isolated(Format("FORM", (), bool, function, "math"), path, ColumnMap(), 2e9)


@pytest.mark.parametrize(
    ("function", "reason", "words"),
    [
        (crash, "corrupt", "FORM crashes as it reads it (signal 11)"),
        (kill, "too-large", "killed"),
        (swell, "too-large", "takes more memory"),
        (hang, "too-slow", "more than 0.3 s"),
        (deceive, "corrupt", "FORM crashes"),
    ],
)
def test_refusals(file, function, reason, words, monkeypatch):
    """A file that ends its process, swells or hangs is refused, and the next one is read."""
    if function is hang:
        monkeypatch.setenv("LMSHEALTH_MAX_SECONDS", "0.3")
    with pytest.raises(Unusable) as caught:
        attempt(function, file)
    assert (caught.value.reason, words in caught.value.detail) == (reason, True), caught.value
    monkeypatch.delenv("LMSHEALTH_MAX_SECONDS", raising=False)
    assert attempt(print_much, file).columns == {}


def test_second_attempt(file):
    """A file that is sound in a new process is read: the one before may have done the damage."""
    assert attempt(crash_once, file).metadata == {"stage": "\udcff"}


@pytest.mark.parametrize("text", ["0", "-1", "soon", "nan"])
def test_limit_that_is_no_number(file, text, monkeypatch):
    """A limit of time that is no time is named."""
    monkeypatch.setenv("LMSHEALTH_MAX_SECONDS", text)
    with pytest.raises(LmshealthError, match=f"LMSHEALTH_MAX_SECONDS is '{text}'"):
        attempt(print_much, file)


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<f8", "i2", "u8"])
@pytest.mark.parametrize("size", [1, 300_000, 1_300_000])
def test_samples_arrive_unchanged(tmp_path, dtype, size):
    """Samples of any type and number are those of the file, whatever windows they come in."""
    values = np.random.default_rng(0).integers(0, 30_000, size).astype(dtype)
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["delta_e_um"] = values
    read = load(tmp_path / "log.h5", ColumnMap()).columns["delta_e_um"]
    np.testing.assert_array_equal(read[:], values.astype(float))


def test_interrupt(file):
    """An interrupt ends the process, so that its answer is none to the next request."""
    attempt(print_much, file)
    # A shell's job in the background ignores interrupts.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    # An interrupt just before the reader waits is noticed with the next one.
    timers = [
        threading.Timer(after, signal.pthread_kill, [threading.get_ident(), signal.SIGINT])
        for after in (0.2, 5.0)
    ]
    for timer in timers:
        timer.start()
    with pytest.raises(KeyboardInterrupt):
        attempt(hang, file)
    timers[1].cancel()
    signal.signal(signal.SIGINT, before)
    assert isolation._reader.process is None
    assert attempt(print_much, file).columns == {}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_fork(make):
    """A fork reads by a process of its own."""
    path = make("log.h5")
    expected = read_log(path).channels[0].values[:].sum()
    child = os.fork()
    if not child:
        os._exit(0 if read_log(path).channels[0].values[:].sum() == expected else 1)
    for _ in range(3):
        assert read_log(path).channels[0].values[:].sum() == expected
    assert os.waitpid(child, 0)[1] == 0


def test_threads(make):
    """Threads take turns at the process."""
    paths = [make("a.h5"), make("b.h5")] * 4
    sums = {}

    def read(k):
        sums[k] = read_log(paths[k]).channels[0].values[:].sum()

    threads = [threading.Thread(target=read, args=[k]) for k in range(len(paths))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(sums) == len(paths) and len(set(sums.values())) == 1


@pytest.mark.slow
@pytest.mark.parametrize("end", ["", "os.kill(os.getpid(), 9)"])
def test_process_ends_with_the_session(make, end):
    """The process ends with this one, whatever ends it, and prints nothing."""
    code = (
        "import os, sys; from lmshealth import read_log\n"
        "from lmshealth.io.formats import isolation\n"
        "read_log(sys.argv[1]); print(isolation._reader.process.pid, flush=True)\n" + end
    )
    command = [sys.executable, "-W", "error", "-c", code, str(make("log.h5"))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert not done.stderr and done.returncode == (-9 if end else 0)
    deadline = time.monotonic() + 5
    while alive(int(done.stdout)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(int(done.stdout))


def alive(pid):
    """Return whether a process runs."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_damaged_filters(tmp_path):
    """Bytes of the header of a filtered column, changed in turn, give the samples or a refusal.

    The header has no checksum; a filter that does not fit the type of the samples is detected.
    """
    path = tmp_path / "log.h5"
    samples = np.random.default_rng(0).normal(size=3000).astype("f4")
    with h5py.File(path, "w") as file:
        options = {"chunks": (1000,), "compression": "lzf", "shuffle": True, "fletcher32": True}
        file.create_dataset("delta_e_um", data=samples, **options)
        file.attrs["sample_rate_hz"] = 1000.0
    data = path.read_bytes()
    start, refused = data.index(b"shuffle") - 60, 0
    for at in range(start, start + 150):
        for value in {0, 1, 255, data[at] ^ 2} - {data[at]}:
            path.write_bytes(data[:at] + bytes([value]) + data[at + 1 :])
            try:
                values = read_log(path).channels[0].values
            except BadLog:
                refused += 1
            else:
                np.testing.assert_array_equal(values, samples.astype(float) * 1e-6)
    assert refused > 100
