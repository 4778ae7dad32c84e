"""Pools: everything is done once, whoever dies, and nothing stays when they are gone."""

from __future__ import annotations

import gc
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from lmshealth.batch import constants, workers
from lmshealth.batch.workers import Pool, SchedulerError, processes
from lmshealth.errors import LmshealthError
from studies.harness import servers


def double(number: int) -> int:
    """Give twice a number."""
    return 2 * number


def die_of_three(number: int) -> int:
    """Give twice a number, and take the process along at 3."""
    if number == 3:
        os._exit(1)
    return 2 * number


def process_of(_: int) -> int:
    """Return the process that works."""
    return os.getpid()


def dawdle(data: bytes) -> int:
    """Take some time over much data."""
    time.sleep(0.2)
    return len(data)


def lost(number: int, why: str) -> int:
    """Stand for what was lost."""
    assert "ended" in why
    return -number


@pytest.mark.parametrize("killed", [False, True])
def test_no_thread_outlives_a_pool(monkeypatch: pytest.MonkeyPatch, killed: bool) -> None:
    """A slow end of the thread that feeds the queue is awaited: it removes semaphores."""
    from loky.backend.queues import Queue

    feed = Queue._feed

    def slow(*arguments: object) -> None:
        feed(*arguments)
        time.sleep(0.3)

    monkeypatch.setattr(Queue, "_feed", staticmethod(slow))
    before = set(threading.enumerate())
    with suppress(KeyboardInterrupt), processes(2) as pool:
        assert dict(pool.map_unordered(double, range(4), lost)) == {n: 2 * n for n in range(4)}
        assert set(threading.enumerate()) > before
        if killed:
            raise KeyboardInterrupt
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize("size", [1, 2])
def test_everything_is_done_once(size: int) -> None:
    """Each item comes back with its own result, also when there are more than fit in a window."""
    with processes(size) as pool:
        assert sorted(pool.map_unordered(double, range(40), lost)) == [
            (k, 2 * k) for k in range(40)
        ]
        assert list(pool.map_unordered(double, [], lost)) == []
        assert pool.size == size


@pytest.mark.parametrize("size", [1, 2])
def test_few_items_are_taken_ahead_of_results(size: int) -> None:
    """However many there are, no more are taken than some per worker: memory stays."""
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        while taken < 1000:
            taken += 1
            yield taken

    with processes(size) as pool:
        for done, _ in enumerate(pool.map_unordered(double, items(), lost)):
            assert taken <= done + 1 + 3 * size
            if done == 50:
                break


@pytest.mark.slow
def test_an_item_that_kills_its_process_is_lost_alone() -> None:
    """The others are done, those that were under way too, and the pool works on."""
    with processes(2) as pool:
        found = dict(pool.map_unordered(die_of_three, range(12), lost))
        assert found == {k: 2 * k for k in range(12)} | {3: -3}
        assert dict(pool.map_unordered(double, range(5), lost)) == {k: 2 * k for k in range(5)}


@pytest.mark.slow
def test_a_killed_process_loses_nothing() -> None:
    """What it was about is done again elsewhere."""
    with processes(2) as pool:
        (_, victim), *_ = pool.map_unordered(process_of, [0], lost)
        os.kill(victim, signal.SIGKILL)
        assert dict(pool.map_unordered(double, range(20), lost)) == {k: 2 * k for k in range(20)}


def test_a_mistake_is_raised_here() -> None:
    """What a function raises ends the batch with its own error."""
    with processes(2) as pool, pytest.raises(TypeError):
        list(pool.map_unordered(double, [None], lost))  # type: ignore[misc]


def test_processes_end_with_a_parent_that_is_killed(root: Path) -> None:
    """Nobody is left to work for nothing."""
    code = (
        "from lmshealth.batch.workers import processes\n"
        "from tests.batch.test_workers import lost, process_of\n"
        "import time\n"
        "if __name__ == '__main__':\n"
        "    with processes(2) as pool:\n"
        "        found = pool.map_unordered(process_of, range(20), lost)\n"
        "        print(*{process for _, process in found}, flush=True)\n"
        "        time.sleep(60)\n"
    )
    script = ["-c", code]
    with subprocess.Popen(
        [sys.executable, *script], stdout=subprocess.PIPE, text=True, cwd=root
    ) as parent:
        assert parent.stdout is not None
        children = [int(word) for word in parent.stdout.readline().split()]
        assert children and all(_is_there(child) for child in children)
        parent.kill()
    servers.wait_until(lambda: not any(_is_there(child) for child in children), "ending")


@pytest.mark.slow
def test_an_interrupt_as_work_begins_leaves_nothing_that_waits(root: Path) -> None:
    """Processes that are starting ignore an interrupt, and their tasks are dropped."""
    code = (
        "import signal\n"
        "from lmshealth.batch.workers import processes\n"
        "from tests.batch.test_workers import dawdle, lost\n"
        "if __name__ == '__main__':\n"
        "    signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "    items = (bytes(2**21) for _ in range(400))\n"
        "    with processes(2) as pool:\n"
        "        print(flush=True)\n"
        "        list(pool.map_unordered(dawdle, items, lost))\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        cwd=root, start_new_session=True,
    ) as parent:  # fmt: skip
        try:
            assert parent.stdout is not None
            parent.stdout.readline()
            time.sleep(0.3)
            os.killpg(parent.pid, signal.SIGINT)
            _, errors = parent.communicate(timeout=60)
        finally:
            parent.kill()
    assert parent.returncode == -signal.SIGINT
    assert errors.count("Traceback") == 1, errors


def test_processes_that_cannot_start_end_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """After some attempts one error states it, with what can be done."""
    monkeypatch.setattr(workers, "_initialise", os._exit)
    monkeypatch.setattr(constants, "START_ATTEMPTS", 2)
    with pytest.raises(LmshealthError, match=r"as they start \(2 attempts\).*fewer --workers"):
        _run_in_processes(1)


def _run_in_processes(number: int) -> int:
    with processes(2) as pool:
        ((_, result),) = pool.map_unordered(double, [number], lost)
        return result


def test_a_script_needs_no_guard(root: Path, tmp_path: Path) -> None:
    """Workers do not import the script that starts them."""
    script = tmp_path / "script.py"
    script.write_text(
        "from tests.batch.test_workers import _run_in_processes\nprint(_run_in_processes(4))\n"
    )
    words = [sys.executable, str(script)]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(words, capture_output=True, text=True, env=environment, check=True)
    assert (done.stdout, done.stderr) == ("8\n", "")


def _is_there(process: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False


# Dask


@pytest.mark.slow
def test_a_cluster_does_everything_once(cluster: servers.Cluster) -> None:
    """Results are those of this process; an item that kills its workers is lost alone."""
    with workers.cluster(cluster.address) as pool:
        assert pool.size == 2
        assert dict(pool.map_unordered(double, range(40), lost)) == {k: 2 * k for k in range(40)}
        # Dask gives up what four workers died of.
        for _ in range(4):
            cluster.add_worker()
        found = dict(pool.map_unordered(die_of_three, range(2, 5), lost))
        assert found == {2: 4, 3: -3, 4: 8}


@pytest.mark.slow
def test_a_worker_of_a_cluster_may_be_killed(cluster: servers.Cluster) -> None:
    """What it was about is done by another, and a worker that comes later works as all do."""
    with workers.cluster(cluster.address) as pool:
        tasks = pool.map_unordered(slowly, range(12), lost)
        found: dict[int, Any] = dict([next(tasks)])
        cluster.workers[0].kill()
        cluster.add_worker()
        found |= dict(tasks)
        assert {k: number for k, (number, _) in found.items()} == {k: 2 * k for k in range(12)}
        assert {threads for _, threads in found.values()} == {1}


@pytest.mark.slow
def test_a_result_may_arrive_as_its_worker_dies(
    cluster: servers.Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was fetched counts, though the scheduler holds it for lost by now."""
    from distributed import Future

    status = vars(Future)["status"].fget
    monkeypatch.setattr(
        Future, "status", property(lambda self: status(self).replace("finished", "lost"))
    )
    with workers.cluster(cluster.address) as pool:
        assert dict(pool.map_unordered(double, range(9), lost)) == {k: 2 * k for k in range(9)}


def slowly(number: int) -> tuple[int, int]:
    """Give twice a number after a while, and on how many threads linear algebra works."""
    from threadpoolctl import threadpool_info

    time.sleep(0.2)
    return 2 * number, max(library["num_threads"] for library in threadpool_info())


@pytest.mark.slow
def test_a_lost_scheduler_ends_the_batch(
    cluster: servers.Cluster, capfd: pytest.CaptureFixture[str]
) -> None:
    """It ends the batch with one error, and no other output."""
    with (
        pytest.raises(SchedulerError, match=f"lost the Dask scheduler {cluster.address}"),
        workers.cluster(cluster.address) as pool,
    ):
        for _ in pool.map_unordered(slowly, range(50), lost):
            cluster.scheduler.kill()
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_a_connection_that_breaks_is_that_of_a_lost_scheduler(cluster: servers.Cluster) -> None:
    """A result that is fetched in that moment fails by its connection."""
    from distributed.comm.core import CommClosedError

    with (
        pytest.raises(SchedulerError, match=f"lost the Dask scheduler {cluster.address}"),
        workers.cluster(cluster.address),
    ):
        raise CommClosedError("in <TCP (closed)>: ConnectionResetError")


@pytest.mark.slow
def test_a_worker_of_another_version_is_refused(
    cluster: servers.Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its results would be kept under the name of this version."""
    monkeypatch.setattr(workers, "VERSION", "0.0.1")
    with (
        pytest.raises(SchedulerError, match=f"lmshealth {version('lmshealth')}.*has 0.0.1"),
        workers.cluster(cluster.address),
    ):
        pass


@pytest.mark.slow
@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("nonsense", "needed is an address"),
        ("tcp://127.0.0.1", "needed is an address"),
        ("tcp://me:hunter2@127.0.0.1:8786", "no user and no password"),
        ("tcp://127.0.0.1:{port}", "refused"),
        ("nosuch://127.0.0.1:{listening}", "unknown address scheme"),
        ("tcp://127.0.0.1:{listening}", "no greeting within 2 s.*right port"),
        ("tls://127.0.0.1:{listening}", "TLS"),
    ],
)
def test_an_invalid_address_is_an_error(
    address: str, message: str, needs: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is an error soon, without its secrets."""
    needs("distributed")
    monkeypatch.setattr(constants, "SCHEDULER_TIMEOUT_S", 2)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        full = address.format(port=servers.free_port(), listening=listener.getsockname()[1])
        with pytest.raises(SchedulerError, match=message) as caught, workers.cluster(full):
            pass
    assert "hunter2" not in str(caught.value)
    _assert_no_client_is_open()


@pytest.mark.slow
def test_settings_that_cannot_be_applied_are_an_error(
    needs: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dask is there: what it misses is named, not Dask."""
    needs("distributed")
    import dask

    monkeypatch.setattr(workers, "_check_address", lambda address: None)
    loader = {"distributed.client.security-loader": "nosuchmodule.loader"}
    address = f"tcp://127.0.0.1:{servers.free_port()}"
    with (
        dask.config.set(loader),
        pytest.raises(SchedulerError, match=f"{address}: .*nosuchmodule"),
        workers.cluster(address),
    ):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("words", [b"SSH-2.0-OpenSSH_9.2\r\n", b"220 ready\r\n", bytes(64), b""])
def test_another_service_is_no_scheduler(words: bytes, needs: Callable[[str], None]) -> None:
    """Whatever it sends: a wrong port is reported as such."""
    needs("distributed")

    def serve(listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                with listener.accept()[0] as guest:
                    guest.sendall(words)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=serve, args=(listener,), daemon=True).start()
        address = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        with pytest.raises(SchedulerError, match=address), workers.cluster(address):
            pass
        listener.shutdown(socket.SHUT_RDWR)
    _assert_no_client_is_open()


def _assert_no_client_is_open() -> None:
    """Python would close it when it deletes it, in the middle of whatever is done then."""
    from distributed import Client

    clients = [thing for thing in gc.get_objects() if isinstance(thing, Client)]
    assert all(client.status == "closed" for client in clients)


@pytest.mark.slow
def test_a_cluster_without_workers_is_an_error(
    cluster: servers.Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody waits for work that nobody does."""
    from distributed import Client

    for worker in cluster.workers:
        worker.kill()
    with Client(cluster.address, timeout=servers.WAIT_S, set_as_default=False) as client:
        servers.wait_until(lambda: not client.nthreads(), "losing the workers")
    monkeypatch.setattr(constants, "SCHEDULER_TIMEOUT_S", 2)
    with pytest.raises(SchedulerError, match="has no workers"), workers.cluster(cluster.address):
        pass


@pytest.mark.slow
def test_a_pool_of_one_is_this_process() -> None:
    """Nothing is started for it."""
    with processes(1) as pool:
        assert type(pool) is Pool
        assert dict(pool.map_unordered(process_of, [1], lost)) == {1: os.getpid()}


def test_no_more_processes_start_than_there_are_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """None without a task, one for one, and more once there are more."""
    started: list[int] = []
    start = workers._ProcessPool.start

    def counted(pool: workers._ProcessPool, n: int) -> None:
        started.append(n)
        start(pool, n)

    monkeypatch.setattr(workers._ProcessPool, "start", counted)
    with processes(2) as pool:
        assert list(pool.map_unordered(double, [], lost)) == [] and not started
        for _ in range(2):
            assert list(pool.map_unordered(double, [4], lost)) == [(4, 8)] and started == [1]
        assert dict(pool.map_unordered(double, range(5), lost)) == {k: 2 * k for k in range(5)}
        assert started == [1, 2]
