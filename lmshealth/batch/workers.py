"""Workers: this process, processes of this machine (loky), or a Dask cluster.

Tasks of a worker that dies are run again; only one that ends its worker each time is lost. This
module imports little, because the processes import it before the batch begins; the rest follows
with the tasks.
"""

import atexit
import gc
import logging
import multiprocessing
import os
import signal
import socket
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent import futures
from contextlib import contextmanager
from functools import partial
from itertools import chain, islice
from multiprocessing import connection, resource_tracker
from multiprocessing.connection import Connection
from typing import Any, TypeVar
from urllib.parse import urlsplit

from loky import ProcessPoolExecutor
from threadpoolctl import threadpool_limits

from lmshealth._private.serialize import VERSION
from lmshealth.batch import constants
from lmshealth.errors import LmshealthError
from lmshealth.io.formats.isolation import INTERRUPTS, ignore_interrupts

Item = TypeVar("Item")
Result = TypeVar("Result")
Task = Callable[[Item], Result]
OnCrash = Callable[[Item, str], Result]
Progress = Callable[[str, int, int], None]
"""Callback: name of the step, how many items are done, how many there are."""

# Of worker processes: loky restarts a process that has grown by 300 MB, which logs of unequal
# length do without any leak, and prints a traceback of native code for every crash.
_ENVIRONMENT = {"LOKY_MAX_MEMORY_LEAK_SIZE": "1e18", "PYTHONFAULTHANDLER": ""}


class SchedulerError(LmshealthError):
    """A Dask scheduler that cannot be used, or whose connection is lost."""


class Pool:
    """Execute tasks in this process, one after the other; other pools run ``size`` at a time."""

    size: int = 1

    def map_unordered(
        self, function: Task[Item, Result], items: Iterable[Item], on_crash: OnCrash[Item, Result]
    ) -> Iterator[tuple[Item, Result]]:
        """Apply a function to items; yield each item with its result, in the order of completion.

        The function is one of a module, or a `partial` of one; its exceptions end the batch. No
        more than `constants.TASKS_AHEAD` items per worker are taken before their results are
        fetched, so that memory does not grow with the number of items. ``on_crash`` makes the
        result of an item that ends its worker, from the item and the reason; other items that were
        running when a worker died are run again.
        """
        for item in items:
            yield item, function(item)


class Threads(Pool):
    """Threads of this process, for work that waits for disks, or computes without its lock."""

    def __init__(self, size: int) -> None:
        self.size = min(size, os.cpu_count() or 1)

    def map_unordered(
        self, function: Task[Item, Result], items: Iterable[Item], on_crash: OnCrash[Item, Result]
    ) -> Iterator[tuple[Item, Result]]:
        """Apply a function to items, at most ``size`` at a time."""
        with futures.ThreadPoolExecutor(self.size) as executor:
            for item, future in _completed(executor, function, iter(items), self.size):
                yield item, future.result()


class _ProcessPool(Pool):
    """Processes on this machine, restarted when one of them dies.

    They start with the first tasks, and no more of them than there are tasks: a process takes a
    second to import what it needs.
    """

    def __init__(self, size: int) -> None:
        self.size, self._n_started = size, 0
        self._others: set[threading.Thread] = set()  # that feed the queues of pools opened before

    def start(self, n: int) -> None:
        """Start processes in place of fewer; where one is killed meanwhile, try again."""
        self.close()
        for _ in range(constants.START_ATTEMPTS):
            # The processes exit when the other end of this pipe is closed, by us or by our own end.
            parent_exit, self._open_end = multiprocessing.Pipe(duplex=False)
            # Processes that start in these blocks inherit the mask: two trackers of resources, and
            # after those, whose start has unblocked some interrupts, the workers.
            with _interrupts_blocked():
                resource_tracker.ensure_running()
                self.executor: ProcessPoolExecutor = ProcessPoolExecutor(
                    n, initializer=_initialise, initargs=(parent_exit,), env=_ENVIRONMENT
                )
            self._n_started = n
            self._others = _feeders()
            try:
                with _interrupts_blocked():
                    first = self.executor.submit(os.getpid)
                first.result()
                return
            except futures.BrokenExecutor:
                self.close(kill=True)
        found = f"worker processes end as they start ({constants.START_ATTEMPTS} attempts)"
        raise LmshealthError(f"{found}: is there enough memory? Use fewer --workers")

    def close(self, *, kill: bool = False) -> None:
        """End all processes, after the tasks that are running, or at once."""
        if self._n_started:
            self._n_started = 0
            self.executor.shutdown(kill_workers=kill)
            # loky does not wait for the thread that feeds its queue. Where Python ends between the
            # removal of a semaphore by this thread and its report, loky warns of a lost one.
            for thread in _feeders() - self._others:
                thread.join(constants.FEEDER_END_S)
            self._open_end.close()

    def map_unordered(
        self, function: Task[Item, Result], items: Iterable[Item], on_crash: OnCrash[Item, Result]
    ) -> Iterator[tuple[Item, Result]]:
        left = iter(items)
        first = list(islice(left, self.size))
        if len(first) > self._n_started:
            self.start(len(first))
        left = chain(first, left)
        while first:
            interrupted: list[Item] = []
            for item, future in _completed(self.executor, function, left, self.size):
                try:
                    result = future.result()
                except futures.BrokenExecutor:
                    interrupted.append(item)
                    continue
                yield item, result
            if not interrupted:
                return
            # One of these items ended its process, and with it the pool. Each is run again alone,
            # so that only that one is lost.
            self.close(kill=True)
            self.start(len(first))
            with _process_pool(1) as single:
                for item in interrupted:
                    yield item, single.run_alone(function, item, on_crash)

    def run_alone(
        self, function: Task[Item, Result], item: Item, on_crash: OnCrash[Item, Result]
    ) -> Result:
        """Run a task that may have ended its process; a process may also be killed from outside."""
        for _ in range(constants.ATTEMPTS_ALONE):
            if not self._n_started:
                self.start(1)
            try:
                result: Result = self.executor.submit(function, item).result()
                return result
            except futures.BrokenExecutor:
                self.close(kill=True)
        ended = f"the process that worked on it alone ended {constants.ATTEMPTS_ALONE} times"
        return on_crash(item, ended)


def _feeders() -> set[threading.Thread]:
    """Return the threads that feed the queues of loky's pools."""
    return {one for one in threading.enumerate() if one.name == "QueueFeederThread"}


def _completed(
    executor: futures.Executor, function: Task[Item, Result], items: Iterator[Item], size: int
) -> Iterator[tuple[Item, futures.Future[Result]]]:
    """Yield items with their futures when these are done; after a crash take no more items."""
    running: dict[futures.Future[Result], Item] = {}
    while True:
        for item in islice(items, constants.TASKS_AHEAD * size - len(running)):
            try:
                future = executor.submit(function, item)
            except futures.BrokenExecutor as error:
                future = futures.Future()
                future.set_exception(error)
            running[future] = item
            if future.done():
                break  # perhaps by a crash: see below before more items are taken
        if not running:
            return
        for future in futures.wait(running, return_when="FIRST_COMPLETED").done:
            if isinstance(future.exception(), futures.BrokenExecutor):
                items = iter(())
            yield running.pop(future), future


@contextmanager
def _process_pool(size: int) -> Iterator[_ProcessPool]:
    with warnings.catch_warnings():
        # Where neither psutil nor pgrep is installed, loky warns that it kills only its own.
        warnings.filterwarnings("ignore", module=r"loky\.")
        pool = _ProcessPool(size)
        try:
            yield pool
        except BaseException:
            pool.close(kill=True)
            raise
        pool.close()


@contextmanager
def processes(size: int) -> Iterator[Pool]:
    """Open a pool of processes of this machine; of one, work in this process.

    The processes end with the pool, with an interrupt, and with this process, whatever ends it.
    """
    if size > 1:
        with _process_pool(size) as pool:
            yield pool
    else:
        with threadpool_limits(1):
            yield Pool()


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block interrupts in this thread; processes and threads that start meanwhile inherit that."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPTS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _initialise(parent_exit: Connection) -> None:
    """Set up a worker process: no interrupts, one thread for linear algebra, exit with parent."""
    gc.set_threshold(50_000)  # as `lmshealth.cli.main`, also the next
    atexit.register(gc.freeze)
    ignore_interrupts()
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPTS)
    threadpool_limits(1)  # as in `processes`: sums in another order differ in their last digits

    def exit_with_parent() -> None:
        connection.wait([parent_exit])  # ready when the other end is closed
        os._exit(1)

    threading.Thread(target=exit_with_parent, daemon=True).start()


# Dask


class _Cluster(Pool):
    """Workers of a Dask cluster; its scheduler reruns what was on a worker that died."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.size = max(1, sum(client.nthreads().values()))

    def map_unordered(
        self, function: Task[Item, Result], items: Iterable[Item], on_crash: OnCrash[Item, Result]
    ) -> Iterator[tuple[Item, Result]]:
        # Not by the executor of the client: a result that arrives as its worker dies is neither
        # finished nor cancelled, which distributed/cfexecutor.py takes for an error.
        from distributed import KilledWorker, as_completed

        completed: Any = as_completed  # the library has no types
        done = completed(loop=self.client.loop)
        checked = partial(_run_checked, VERSION, function)
        left, running = iter(items), dict[Any, Item]()
        try:
            while True:
                for item in islice(left, constants.TASKS_AHEAD * self.size - len(running)):
                    future = self.client.submit(checked, item, pure=False)
                    running[future] = item
                    done.add(future)
                if not running:
                    return
                future = next(done)
                item = running.pop(future)
                try:
                    result = future.result()
                except (futures.BrokenExecutor, KilledWorker):
                    result = on_crash(item, "every worker that took it ended")
                yield item, result
        finally:
            self.client.cancel(list(running))


@contextmanager
def cluster(address: str) -> Iterator[Pool]:
    """Open a pool of the workers of a Dask cluster.

    The address is that of the scheduler, such as ``tcp://host:8786``. Scheduler and workers need
    this version of lmshealth, and the workers need the logs under the same paths. `SchedulerError`
    if the scheduler does not answer, has no worker, or has a worker of another version.
    """
    from lmshealth.batch.database import shown_address, without_secrets  # late, as all of this

    shown = shown_address(address)
    try:
        from distributed.comm.core import CommClosedError
    except ImportError as error:
        missing = "--scheduler needs Dask: pip install 'lmshealth[distributed]'"
        raise SchedulerError(missing) from error
    try:
        client = _connected(address)
    # Dask's settings may name modules that are missing, or lack certificates (a TypeError).
    except (ImportError, OSError, TypeError, ValueError) as error:
        why = getattr(error, "strerror", None)
        detail = f"{why}; is it running?" if why else without_secrets(str(error), address)
        raise SchedulerError(f"cannot work on the Dask scheduler {shown}: {detail}") from None
    except Exception as error:  # whatever the library makes of an answer that it cannot parse
        why = "does not answer like a Dask scheduler: is it the right port?"
        raise SchedulerError(f"the service at {shown} {why}") from error
    comm_closed: Any = CommClosedError  # the library has no types
    try:
        client.wait_for_workers(1, timeout=constants.SCHEDULER_TIMEOUT_S)
        client.register_plugin(_one_thread(), name="lmshealth")  # also of workers that join later
        client.run(_require_version, VERSION)
        yield _Cluster(client)
    except TimeoutError as error:
        raise SchedulerError(f"the Dask scheduler {shown} has no workers: start some") from error
    except (futures.CancelledError, comm_closed) as error:
        kept = "finished results are stored: run again to continue"
        raise SchedulerError(f"lost the Dask scheduler {shown}; {kept}") from error
    finally:
        _close(client)


def _check_address(address: str) -> None:
    """Check that a service answers at an address, before a client waits long for it."""
    parts = urlsplit(address)
    if parts.username or parts.password:
        raise ValueError("its address has no user and no password; certificates go by tls://")
    if not parts.hostname or not parts.port:
        raise ValueError("needed is an address like tcp://host:8786")
    timeout = constants.SCHEDULER_TIMEOUT_S
    with socket.create_connection((parts.hostname, parts.port), timeout=timeout) as service:
        if parts.scheme != "tcp":
            return
        # Both ends begin with a greeting, for which the library would wait for ever.
        try:
            service.recv(1)
        except TimeoutError:
            why = f"no greeting within {timeout} s: is it a scheduler, and the right port?"
            raise ValueError(why) from None


def _connected(address: str) -> Any:
    """Open a client of a scheduler."""
    from distributed import Client

    _check_address(address)
    # Our own errors report what becomes of its connections. Each logger has a level of its own.
    for name in logging.root.manager.loggerDict:
        if name.split(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)
    client = Client.__new__(Client)
    try:
        start: Any = Client.__init__
        start(client, address, timeout=constants.SCHEDULER_TIMEOUT_S, set_as_default=False)
    except BaseException:
        _close(client)
        raise
    return client


def _one_thread() -> Any:
    """Make a plugin that keeps linear algebra to one thread, as in processes of our own."""
    from distributed import WorkerPlugin

    class OneThread(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            import scipy.linalg  # noqa: F401  # it loads a library of its own

            self.limits = threadpool_limits(1)

    return OneThread()


def _close(client: Any) -> None:
    """Close a client, also one whose scheduler is gone."""
    try:
        if client.status != "newly-created":  # such a client has nothing to close
            client.close(timeout=constants.SCHEDULER_TIMEOUT_S)
    except (OSError, futures.CancelledError) as error:
        logging.getLogger(__name__).debug("%s", error)
    # Python closes an open client when it deletes it, in whichever thread that happens: in the
    # thread of a client being opened it would wait for the lock that the opening holds.
    client.status = "closed"


def _run_checked(needed: str, function: Task[Item, Result], item: Item) -> Result:
    """Run a task on a worker of the needed version only: the store names results by version."""
    _require_version(needed)
    return function(item)


def _require_version(needed: str) -> None:
    if needed != VERSION:
        found = f"a worker has lmshealth {VERSION}, this run has {needed}"
        raise SchedulerError(f"{found}: install one version")
