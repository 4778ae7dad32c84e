"""A full disk and a lost database are reported in one line, and nothing is lost by them.

Full disk: output and store, or output alone, on a file system that is too small and grows with each
run until everything fits. Lost database: PostgreSQL is stopped at a random moment after the first
log and started before the next run. Each failed run must exit with status 1 and one line without
the password; the final output must equal that of a run without failure. `LMSHEALTH_KILLS=5` or more
tries a larger batch, more sizes, and five lost databases.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from studies.harness.servers import postgres
from tests.batch.interruptions import driving
from tests.batch.interruptions.driving import N_KILLS, SOME_REFUSED, Reference, one_line

pytestmark = pytest.mark.slow
Row = dict[str, Any]

SEED = 20261122
FEW = N_KILLS == 1
MACHINES = driving.FEW if FEW else {"WORN-A": 40, "WATCHED-A": 40}
# Fractions of the space that output, and store where it is there too, need.
SIZES = (0.4, 4.0) if FEW else (0.05, 0.2, 0.4, 0.6, 0.75, 0.9, 4.0)
# Failed runs, and the latest end of the database after the first log, over the time of a run.
N_LOST, LATEST = (1, 0.0) if FEW else (5, 0.5)
Ends = list[tuple[int | None, list[str]]]  # statuses and messages


@pytest.fixture(scope="module")
def reference() -> Iterator[Reference]:
    """Analyse a batch without interruption."""
    with tempfile.TemporaryDirectory() as name:
        yield driving.reference_of(Path(name), MACHINES, quick=FEW)


@pytest.mark.parametrize("with_store", [True, False], ids=["with-store", "output-alone"])
def test_a_full_disk(reference: Reference, tmp_path: Path, with_store: bool) -> None:
    """Runs fail in one line until all fits, and the last one has everything."""
    found = full_disk(reference, tmp_path, SIZES, with_store=with_store)
    if found is None:
        pytest.skip("no file system can be made here")
    check(found)


def test_a_lost_database(reference: Reference, needs: Callable[[str], None]) -> None:
    """A run whose database stops fails in one line, and the next one has everything."""
    needs("postgres")
    check(lost_database(reference, N_LOST, LATEST, quick=FEW))


def check(found: Row) -> None:
    """Require that runs failed, each in one line, and that nothing differs in the end."""
    assert found["failed"] > 0
    assert found["other_ends"] == []
    assert found["differences"] == []


def full_disk(
    reference: Reference, folder: Path, sizes: Sequence[float], *, with_store: bool
) -> Row | None:
    """Run on a file system that is too small, enlarge it and go on; None if none can be made."""
    place, kept = folder / "disk", folder / "kept"
    place.mkdir(parents=True)
    # In a mount namespace of its own: whatever happens, the file system ends with the shell.
    shell = ["unshare", *(["--map-root-user"] if os.geteuid() else []), "--mount", "sh", "-c"]
    tried = subprocess.run([*shell, f"mount -t tmpfs none {place}"], capture_output=True)
    if tried.returncode:
        return None
    store = (place if with_store else folder) / "store.sqlite"
    first = reference.out.parent / "reference.sqlite"
    needing = [*reference.out.iterdir(), *([first] if with_store else [])]
    need = sum(path.stat().st_size for path in needing)
    command = " ".join(reference.command(place / "out", f"sqlite:///{store}"))
    script = f"mount -t tmpfs -o size={need // 100} none {place}\n"
    for k, size in enumerate(sizes):
        script += f"mount -o remount,size={round(size * need)} {place}\n"
        script += f"{command} >/dev/null 2>{folder}/said-{k}; echo $?\n"
    script += f"cp -r {place} {kept}"
    done = subprocess.run([*shell, script], capture_output=True, text=True, check=True)
    ends: Ends = [
        (int(status), (folder / f"said-{k}").read_text().splitlines())
        for k, status in enumerate(done.stdout.split())
    ]
    store = kept / store.name if with_store else store
    differences = reference.judge(kept / "out", f"sqlite:///{store}")
    return {"sizes_of_what_is_needed": sizes, **failures(ends), "differences": differences}


def lost_database(reference: Reference, n: int, latest: float, *, quick: bool) -> Row:
    """Stop the database server in the middle of runs, start it, and run again.

    Runs that did not need it any more are not counted, until n have failed.
    """
    rng = random.Random(SEED)
    ends: Ends = []
    differences: list[str] = []
    with postgres() as server:
        while sum(status != SOME_REFUSED for status, _ in ends) < n and len(ends) < 4 * n:
            with server.database() as store, tempfile.TemporaryDirectory() as name:
                command = reference.command(Path(name) / "out", store)
                with driving.running(command) as run:
                    run.begun(store)
                    run.status(rng.uniform(0.0, latest) * reference.seconds)
                    server.stop(signal.SIGQUIT)
                    ends.append((run.status(), run.messages()))
                server.start()
                if any(server.password in line for line in ends[-1][1]):
                    differences.append("the password was shown")
                driving.completed(command, quick=quick)
                differences += reference.judge(Path(name) / "out", store)
    return {"runs": len(ends), **failures(ends), "differences": differences}


def failures(ends: Ends) -> Row:
    """Count failed runs that reported why in one line, and list other ends."""
    failed = [status == 1 and one_line(messages) for status, messages in ends]
    other = [
        f"{status}: {messages[-3:]}"
        for (status, messages), fine in zip(ends, failed, strict=True)
        if status != SOME_REFUSED and not fine
    ]
    return {"failed": sum(failed), "other_ends": other}
