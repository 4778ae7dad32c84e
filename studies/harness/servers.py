"""Real servers for studies and tests: PostgreSQL, and a Dask scheduler with its workers.

Each is a child of the process that starts it and ends with it, even where that is killed: the
kernel signals it (`setpriv --pdeathsig`). All listen on this machine alone.
"""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

WAIT_S = 60.0  # longer than any server takes to start on a busy machine
MARK = "LMSHEALTH_STUDY_MARK"  # variable of the environment by which processes are found
_USER = "tester"
Popen = subprocess.Popen[bytes]
# Servers are killed here, machines are not: what is written need not reach the disk.
_SETTINGS = ("fsync=off", "shared_buffers=16MB", "max_connections=50", "log_min_messages=fatal")


def free_port() -> int:
    """Return a port of 127.0.0.1 on which nothing listens.

    It is below the ports that the system itself gives away (from 32768 on, Linux), so that no
    connection or server takes it before the one that it is meant for, or while that restarts.
    """
    while True:
        port = 20000 + secrets.randbelow(12000)
        with socket.socket() as listener:
            try:
                listener.bind(("127.0.0.1", port))
            except OSError:  # in use
                continue
            return port


def wait_until(done: Callable[[], bool], what: str, within_s: float = WAIT_S) -> None:
    """Wait for something to become true; raise TimeoutError, which names it, after too long."""
    end = time.monotonic() + within_s
    while not done():
        if time.monotonic() > end:
            raise TimeoutError(f"{what} took more than {within_s:g} s")
        time.sleep(0.02)


def marked(mark: str) -> dict[int, str]:
    """Find the living processes whose variable `MARK` is this, and their command lines."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if f"{MARK}={mark}".encode() in (folder / "environ").read_bytes().split(b"\0"):
                words = (folder / "cmdline").read_bytes().replace(b"\0", b" ")
                found[int(folder.name)] = words.decode(errors="replace")
        except OSError:  # ended meanwhile, or another user's
            continue
    return found


def _child(
    command: Sequence[str], *, end: str = "KILL", user: str = "", output: int = subprocess.DEVNULL
) -> Popen:
    """Start a process in a session of its own that gets the signal `end` when this one dies."""
    as_user = []
    if user:
        import pwd  # POSIX

        as_user = [f"--reuid={user}", f"--regid={pwd.getpwnam(user).pw_gid}", "--clear-groups"]
    return subprocess.Popen(
        ["setpriv", *as_user, "--pdeathsig", end, *command],
        start_new_session=True, cwd="/", stdout=output, stderr=output,
        # Workers import what this process can, and so does a scheduler. Where setproctitle is
        # installed they write their titles over their environment, and with it over the mark.
        env=os.environ
        | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path), "SPT_NOENV": "1"},
    )  # fmt: skip


# PostgreSQL


def postgres_programs() -> Path | None:
    """Find the folder of initdb and postgres, the newest version of several; None for none."""
    versions = Path("/usr/lib/postgresql").glob("*/bin/initdb")
    newest = max(versions, key=lambda p: int(p.parts[-3]), default=shutil.which("initdb"))
    return Path(newest).resolve().parent if newest else None


def missing_postgres() -> str | None:
    """Return why no PostgreSQL can be started here; None when one can."""
    if postgres_programs() is None:
        return "PostgreSQL's server is not installed (Debian: postgresql)"
    return _missing("psycopg", "postgres")


def _missing(module: str, extra: str) -> str | None:
    if shutil.which("setpriv") is None:
        return "setpriv is not installed (Debian: util-linux)"
    return None if find_spec(module) else f"{module} is not installed: pip install '.[{extra}]'"


@dataclass
class Postgres:
    """A cluster of its own, with one user and a password."""

    folder: Path  # of the data, the Unix socket and the log
    port: int  # of 127.0.0.1, and in the name of the socket
    password: str
    _process: Popen | None = None

    def start(self) -> None:
        """Start the server and wait until it answers."""
        programs = postgres_programs()
        assert programs is not None
        settings = [*_SETTINGS, f"port={self.port}", "listen_addresses=127.0.0.1",
                    f"unix_socket_directories={self.folder}"]  # fmt: skip
        command = [str(programs / "postgres"), "-D", str(self.folder / "data")]
        with (self.folder / "log").open("ab") as log:
            self._process = _child(
                command + [word for setting in settings for word in ("-c", setting)],
                end="INT", user=_unprivileged(), output=log.fileno(),
            )  # fmt: skip
        wait_until(self._answers, f"PostgreSQL (see {self.folder / 'log'})")

    def stop(self, how: int = signal.SIGINT) -> None:
        """End the server: SIGINT ends its sessions, SIGQUIT stops at once."""
        if self._process is not None:
            self._process.send_signal(how)
            self._process.wait(WAIT_S)
            self._process = None

    def signal(self, number: int) -> None:
        """Send a signal to the main process of the server."""
        assert self._process is not None
        self._process.send_signal(number)

    def url(self, database: str) -> str:
        """Return the address of a database for SQLAlchemy, through TCP."""
        return f"postgresql+psycopg://{_USER}:{self.password}@127.0.0.1:{self.port}/{database}"

    @contextmanager
    def database(self) -> Iterator[str]:
        """Make an empty database, give its address, and drop it with whoever still uses it."""
        name = f"db_{secrets.token_hex(6)}"
        self._execute(f"CREATE DATABASE {name}")
        try:
            yield self.url(name)
        finally:
            self._execute(f"DROP DATABASE {name} WITH (FORCE)")

    def _execute(self, statement: str) -> None:
        import psycopg

        place = f"host={self.folder} port={self.port} user={_USER} password={self.password}"
        with psycopg.connect(f"{place} dbname=postgres", autocommit=True) as connection:
            connection.execute(statement.encode())

    def _answers(self) -> bool:
        import psycopg

        assert self._process is not None
        if self._process.poll() is not None:
            raise RuntimeError((self.folder / "log").read_text(errors="replace"))
        try:
            self._execute("SELECT 1")
        except psycopg.OperationalError:
            return False
        return True


@contextmanager
def postgres() -> Iterator[Postgres]:
    """Make a cluster in a temporary folder, start its server, and remove both in the end."""
    programs, user = postgres_programs(), _unprivileged()
    assert programs is not None, missing_postgres()
    # Not within pytest's folders: those are closed to the user that the server runs as.
    folder = Path(tempfile.mkdtemp(prefix="lmshealth-postgres-"))
    server = Postgres(folder, free_port(), secrets.token_urlsafe())
    try:
        (folder / "password").write_text(server.password)
        if user:
            for path in (folder, folder / "password"):
                shutil.chown(path, user)
        made = _child(
            [str(programs / "initdb"), "-D", str(folder / "data"), "-U", _USER, "--no-locale",
             "-E", "UTF8", "--no-sync",
             "--auth=scram-sha-256", f"--pwfile={folder / 'password'}"],
            user=user,
        )  # fmt: skip
        if made.wait(WAIT_S):
            raise RuntimeError(f"initdb ended with {made.returncode}")
        server.start()
        yield server
    finally:
        server.stop()
        shutil.rmtree(folder, ignore_errors=True)


def _unprivileged() -> str:
    """Name whom the server runs as where that must not be us: it refuses root."""
    if os.geteuid():
        return ""
    import pwd

    names = {entry.pw_name for entry in pwd.getpwall()}
    return next(name for name in ("postgres", "nobody") if name in names)


# Dask

# Without an address the dashboard's server listens to all the world, even where it is off.
_HERE_ALONE = ("--host", "127.0.0.1", "--no-dashboard", "--dashboard-address", "127.0.0.1:0")


@dataclass
class Cluster:
    """A Dask scheduler and worker processes, without nannies: a killed worker is not restarted."""

    folder: str  # of what workers keep while they live
    address: str
    scheduler: Popen
    workers: list[Popen] = field(default_factory=list)  # those that were killed too

    def add_worker(self) -> None:
        """Start one more worker of one thread."""
        self.workers.append(
            _dask("worker", self.address, "--no-nanny", "--nthreads", "1", *_HERE_ALONE,
                  "--memory-limit", "0", "--death-timeout", str(WAIT_S),
                  "--local-directory", self.folder)
        )  # fmt: skip

    def await_workers(self, n: int) -> None:
        """Wait until so many workers have registered."""
        from distributed import Client

        with Client(self.address, timeout=WAIT_S, set_as_default=False) as client:
            client.wait_for_workers(n, timeout=WAIT_S)

    def stop(self) -> None:
        """Kill all of it."""
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


def missing_distributed() -> str | None:
    """Return why no Dask cluster can be started here; None when one can."""
    return _missing("distributed", "distributed")


@contextmanager
def dask_cluster(n_workers: int = 2) -> Iterator[Cluster]:
    """Start a scheduler and workers of one thread each, and kill them in the end."""
    port = free_port()
    scheduler = _dask("scheduler", "--port", str(port), *_HERE_ALONE)
    with tempfile.TemporaryDirectory(prefix="lmshealth-dask-") as folder:
        cluster = Cluster(folder, f"tcp://127.0.0.1:{port}", scheduler)
        try:
            for _ in range(n_workers):
                cluster.add_worker()
            cluster.await_workers(n_workers)
            yield cluster
        finally:
            cluster.stop()


def _dask(*words: str) -> Popen:
    """Start a program of Dask."""
    return _child([sys.executable, "-m", "dask", *words])
