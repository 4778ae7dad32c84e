"""Servers that tests start: each test has its own database, and nothing outlives its starter."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.exc import OperationalError

from studies.harness.servers import MARK, Cluster, Postgres, marked, wait_until


def tell(url: str, statement: str) -> list[tuple[object, ...]]:
    """Tell a database something and give back the rows that it answers with."""
    engine = create_engine(url)
    try:
        with engine.begin() as connection:
            answer = connection.execute(text(statement))
            return [tuple(row) for row in answer] if answer.returns_rows else []
    finally:
        engine.dispose()


def test_databases_are_apart_and_need_the_password(postgres: Postgres) -> None:
    """What one database holds the next does not; nobody gets in without the password."""
    with postgres.database() as one, postgres.database() as two:
        tell(one, "CREATE TABLE t (n int)")
        assert tell(one, "SELECT * FROM t") == []
        assert tell(two, "SELECT count(*) FROM pg_tables WHERE tablename = 't'") == [(0,)]
        with pytest.raises(OperationalError, match="password"):
            tell(one.replace(postgres.password, "wrong"), "SELECT 1")
    with pytest.raises(OperationalError, match="does not exist"):
        tell(one, "SELECT 1")


def test_a_server_that_broke_down_keeps_what_was_written(postgres: Postgres) -> None:
    """Ended without a word and started again, the server has what it confirmed."""
    with postgres.database() as url:
        tell(url, "CREATE TABLE t AS SELECT 7 AS n")
        postgres.stop(signal.SIGQUIT)
        with pytest.raises(OperationalError):
            tell(url, "SELECT n FROM t")
        postgres.start()
        assert tell(url, "SELECT n FROM t") == [(7,)]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["postgres", "dask_cluster"])
def test_servers_end_with_who_started_them(
    root: Path, needs: Callable[[str], None], kind: str
) -> None:
    """Of a starter that is killed no server process is left."""
    needs({"postgres": "postgres", "dask_cluster": "distributed"}[kind])
    script = (
        f"from studies.harness.servers import {kind}\nwith {kind}():\n    print('up', flush=True)\n"
        "    input()\n"
    )
    # Children carry the mark in their environment, whatever sessions they make.
    mark = f"{os.getpid()}-{kind}"
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)  # the server may run as another user
        environment = {**os.environ, "TMPDIR": folder, MARK: mark}
        with subprocess.Popen(
            [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            cwd=root, env=environment, text=True,
        ) as starter:  # fmt: skip
            assert starter.stdout is not None
            assert starter.stdout.readline() == "up\n"
            assert len(marked(mark)) > 1
            starter.kill()
        wait_until(lambda: not marked(mark), f"the end of {kind}")


@pytest.mark.slow
def test_tasks_of_a_killed_worker_are_done_by_another(cluster: Cluster) -> None:
    """A worker that is killed is replaced, and every task is answered."""
    from distributed import Client

    with Client(cluster.address, set_as_default=False) as client:
        futures = client.map(lambda n: n * n, range(50))
        cluster.workers[0].kill()
        cluster.add_worker()
        assert client.gather(futures) == [n * n for n in range(50)]
        cluster.await_workers(2)
