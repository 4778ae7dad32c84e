"""Where work is done: in this process, in several on this machine, or on a Dask cluster.

A worker that dies takes its task along, not the batch: see `Pool.spread`.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from functools import cache, partial
from importlib.metadata import version
from itertools import islice
from multiprocessing import connection
from multiprocessing.connection import Connection
from typing import Any, TypeVar
from urllib.parse import urlsplit

from threadpoolctl import threadpool_limits

from lmshealth.batch.addresses import shown_address, without_secrets
from lmshealth.errors import LmshealthError

Item = TypeVar("Item")
Result = TypeVar("Result")

# So many tasks per worker are under way: enough that none waits, few enough to be held in memory.
_AHEAD = 3
# Seconds that a scheduler has to answer, and its first worker to be there.
_TIMEOUT = 20


class SchedulerError(LmshealthError):
    """A Dask scheduler that cannot be used, or is lost."""


class Pool:
    """Does work in this process, one task after the other.

    Attributes
    ----------
    executor : Executor or None
        For parts of one task; None where there is nothing to be gained.
    size : int
        How many tasks are done at a time.
    losses : tuple of type
        What the executor raises where a worker died.
    """

    executor: Executor | None = None
    size: int = 1
    losses: tuple[type[Exception], ...] = (BrokenExecutor,)

    def spread(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        lost: Callable[[Item, str], Result],
    ) -> Iterator[tuple[Item, Result]]:
        """Apply a function to items, and yield them with the results, in the order of doing.

        Few items are taken ahead of the results, so that neither pile up in memory.

        Parameters
        ----------
        function : callable
            Of a module, or a `partial` of one; what it raises ends the batch.
        items : iterable
            Whatever the function takes.
        lost : callable
            Makes the result of an item whose worker died of it, from the item and the reason.
            Items that were under way elsewhere when a worker died are done again.
        """
        for item in items:
            yield item, function(item)


class _Processes(Pool):
    """Processes on this machine, started again when one of them dies."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._start()

    def _start(self) -> None:
        self._ours, theirs = multiprocessing.get_context("spawn").Pipe()
        self.executor: Executor = _open(self.size, theirs)

    def end(self) -> None:
        """End all processes at once, whatever they are about."""
        # In this order: the executor's thread fails on a process that dies when a task was
        # cancelled of which it does not know yet, and would leave this process waiting for ever.
        caretaker: Any = getattr(self.executor, "_executor_manager_thread", None)
        queue: Any = getattr(self.executor, "_call_queue", None)
        if queue is not None and not getattr(self.executor, "_broken", False):
            # Else a thread that writes a task waits for a reader for ever, as Python 3.11.2 does. A
            # broken executor sees to it itself, and two must not close it at once.
            queue._reader.close()
        self.executor.shutdown(wait=False, cancel_futures=True)
        self._ours.close()
        # Python wakes this thread as it ends itself, by a pipe that may be closed in that moment.
        if caretaker is not None:
            caretaker.join()

    def spread(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        lost: Callable[[Item, str], Result],
    ) -> Iterator[tuple[Item, Result]]:
        left = iter(items)
        while True:
            suspects: list[Item] = []
            for item, future in _done(self.executor, function, left, self.size):
                try:
                    result = future.result()
                except BrokenExecutor:
                    suspects.append(item)
                    continue
                yield item, result
            if not suspects:
                return
            # One of them ended a process, and that its pool. Each is done again in a process of
            # its own, so that only the one is lost.
            self.end()
            self._start()
            for item in suspects:
                yield item, _alone(function, item, lost)


class _Cluster(Pool):
    """Workers of a Dask cluster; its scheduler does again what was on a worker that died."""

    def __init__(self, client: Any) -> None:
        from distributed import KilledWorker

        self.losses = (BrokenExecutor, KilledWorker)
        self.client = client
        self.executor: Executor = client.get_executor(pure=False)
        self.size = max(1, sum(client.nthreads().values()))

    def spread(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        lost: Callable[[Item, str], Result],
    ) -> Iterator[tuple[Item, Result]]:
        # Not `submit` of the executor: a result that arrives as the worker dies that made it is
        # neither finished nor cancelled, which distributed/cfexecutor.py takes for an error.
        from distributed import as_completed

        checked = partial(_by_version, version("lmshealth"), function)
        left = iter(items)
        waiting: dict[Any, Item] = {}
        finished: Any = as_completed
        done = finished(loop=self.client.loop)
        try:
            while True:
                for item in islice(left, _AHEAD * self.size - len(waiting)):
                    future = self.client.submit(checked, item, pure=False)
                    waiting[future] = item
                    done.add(future)
                if not waiting:
                    return
                future = next(done)
                item = waiting.pop(future)
                try:
                    result = future.result()
                except self.losses:
                    result = lost(item, "it ended every worker that took it")
                yield item, result
        finally:
            self.client.cancel(list(waiting))


def _done(
    executor: Executor, function: Callable[[Item], Result], items: Iterator[Item], size: int
) -> Iterator[tuple[Item, Future[Result]]]:
    """Yield items with their futures when these are done, in whichever way."""
    waiting: dict[Future[Result], Item] = {}
    try:
        while True:
            for item in islice(items, _AHEAD * size - len(waiting)):
                try:
                    future = executor.submit(function, item)
                except BrokenExecutor as error:
                    future = Future()
                    future.set_exception(error)
                waiting[future] = item
                if future.done():
                    break  # it may be broken: look before more is taken
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future
                broken = not future.cancelled() and isinstance(future.exception(), BrokenExecutor)
                if broken:
                    items = iter(())
    finally:
        for future in waiting:
            future.cancel()


@contextmanager
def processes(size: int) -> Iterator[Pool]:
    """Work in so many processes of this machine; for one, in this process.

    They end with the pool, with an interrupt, and with this process, whatever ends it.
    """
    if size <= 1:
        with threadpool_limits(1):
            yield Pool()
        return
    pool = _Processes(size)
    try:
        yield pool
    except BaseException:
        pool.end()
        raise
    pool.executor.shutdown()


@contextmanager
def cluster(address: str) -> Iterator[Pool]:
    """Work on a Dask cluster.

    Scheduler and workers need this version of lmshealth, and workers see the logs under the same
    paths.

    Parameters
    ----------
    address : str
        Of its scheduler, such as ``tcp://host:8786``.

    Raises
    ------
    SchedulerError
        If it does not answer, has no worker, or one that is of another version.
    """
    shown = shown_address(address)
    try:
        from distributed.comm.core import CommClosedError
    except ImportError as error:
        raise SchedulerError(
            "--scheduler needs Dask: pip install 'lmshealth[distributed]'"
        ) from error
    try:
        _knock(address)
        client = _connected(address)
    # Settings may name modules that are not there, or no certificates, which is a TypeError.
    except (ImportError, OSError, TypeError, ValueError) as error:
        why = getattr(error, "strerror", None)
        detail = f"{why}; is it running?" if why else without_secrets(str(error), address)
        raise SchedulerError(f"cannot work on the Dask scheduler {shown}: {detail}") from None
    except Exception as error:  # whatever the library makes of words that it does not know
        raise SchedulerError(
            f"what answers at {shown} does not talk like a Dask scheduler: is it the right port?"
        ) from error
    comm_closed: Any = CommClosedError  # the library has no types
    try:
        _await_worker(client, shown)
        client.register_plugin(_one_thread(), name="lmshealth")  # of workers that come later, too
        client.run(_insist, version("lmshealth"))
        yield _Cluster(client)
    except (CancelledError, comm_closed) as error:
        raise SchedulerError(
            f"lost the Dask scheduler {shown}; what was done is kept: run again to go on"
        ) from error
    finally:
        _close(client)


def _await_worker(client: Any, shown: str) -> None:
    try:
        client.wait_for_workers(1, timeout=_TIMEOUT)
    except TimeoutError as error:
        raise SchedulerError(f"the Dask scheduler {shown} has no workers: start some") from error


def _knock(address: str) -> None:
    """See whether somebody answers at an address, before a client waits long for it."""
    parts = urlsplit(address)
    if parts.username or parts.password:
        raise ValueError("its address has no user and no password; certificates go by tls://")
    if not parts.hostname or not parts.port:
        raise ValueError("needed is an address like tcp://host:8786")
    with socket.create_connection((parts.hostname, parts.port), timeout=_TIMEOUT) as door:
        if parts.scheme != "tcp":
            return
        # Both ends begin with a greeting, for which the library would wait for ever.
        try:
            door.recv(1)
        except TimeoutError:
            raise ValueError(
                f"it said nothing for {_TIMEOUT} s: is it one, and the right port?"
            ) from None


def _connected(address: str) -> Any:
    """Open a client of a scheduler."""
    from distributed import Client

    # What becomes of its connections is told by our own errors. Each part has a level of its own.
    for name in logging.root.manager.loggerDict:
        if name.split(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)
    client = Client.__new__(Client)
    try:
        start: Any = Client.__init__
        start(client, address, timeout=_TIMEOUT, set_as_default=False)
    except BaseException:
        _close(client)
        raise
    return client


def _one_thread() -> Any:
    """Make a plugin that keeps linear algebra to one thread, as it is in processes of our own.

    More would be no faster, and sums in another order differ in their last digits.
    """
    from distributed import WorkerPlugin

    class OneThread(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            import scipy.linalg  # noqa: F401  # it brings a library of its own

            self.limits = threadpool_limits(1)

    return OneThread()


def _close(client: Any) -> None:
    """Let go of a client, also of one whose scheduler is gone."""
    try:
        if client.status != "newly-created":  # that has nothing to close
            client.close(timeout=_TIMEOUT)
    except (OSError, CancelledError) as error:
        logging.getLogger(__name__).debug("%s", error)
    # One that is not closed is closed as Python deletes it, in whichever thread that happens: in
    # that of a client being opened, it would wait for the lock that the opening holds.
    client.status = "closed"


def _open(size: int, end: Connection) -> ProcessPoolExecutor:
    """Start processes; they end when the other end of a pipe is closed.

    Raises
    ------
    LmshealthError
        If they cannot be started.
    """
    # Spawned, not forked: a fork would share locks of threads that do not come along.
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(size, mp_context=context, initializer=_begin, initargs=(end,))
    try:
        with _uninterrupted():  # until they know that an interrupt is not meant for them
            started = [executor.submit(os.getpid) for _ in range(size)]  # each starts one
        wait(started)
        for future in started:
            future.result()
    except BrokenExecutor as error:
        raise LmshealthError(
            "worker processes end as they start: a script that asks for several workers has to do "
            'so under `if __name__ == "__main__":`'
        ) from error
    return executor


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold back interrupts; processes that start meanwhile inherit that."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(end: Connection) -> None:
    """Let Ctrl-C be the parent's alone, end with the parent, and do sums in one order."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threadpool_limits(1)
    threading.Thread(target=_end_with_parent, args=(end,), daemon=True).start()


def _end_with_parent(end: Connection) -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel, end])
    os._exit(1)


def _alone(
    function: Callable[[Item], Result], item: Item, lost: Callable[[Item, str], Result]
) -> Result:
    """Work in a process of its own, and survive that process."""
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    with ours, _open(1, theirs) as executor:
        try:
            return executor.submit(function, item).result()
        except BrokenExecutor:
            return lost(item, "it ended the process that worked on it")


def _by_version(needed: str, function: Callable[[Item], Result], item: Item) -> Result:
    """Work only where results are those that the batch takes them for."""
    _insist(needed)
    return function(item)


@cache
def _own_version() -> str:
    return version("lmshealth")


def _insist(needed: str) -> None:
    found = _own_version()
    if found != needed:
        raise SchedulerError(
            f"a worker has lmshealth {found}, this run is of {needed}: install one version"
        )
