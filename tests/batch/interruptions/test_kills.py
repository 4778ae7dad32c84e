"""A batch that is killed repeatedly ends as if it had not been interrupted.

The command line over a batch, on SQLite and on PostgreSQL. Kills come by a Poisson process: `kill
-9` of the main process or of a worker, SIGINT or SIGTERM to the group. A completed run is compared
with an uninterrupted one: tables and pages row by row, every log once in the store, no remaining
process, one line per interrupt. The next run begins with an empty store, up to `driving.N_KILLS`
kills; 100 of each store over 200 logs take half an hour.
"""

from __future__ import annotations

import random
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.batch.interruptions import driving
from tests.batch.interruptions.driving import N_KILLS, Reference, Stores, one_line

pytestmark = pytest.mark.slow
Row = dict[str, Any]

SEED = 20261122
# Shares of the kinds of kills, and their mean number in the time that a run takes.
HOWS: dict[str, float] = (
    {"main": 0.5, "worker": 0.2, "SIGINT": 0.15, "SIGTERM": 0.15} if N_KILLS > 1 else {"main": 1.0}
)
PER_RUN = 5.0 if N_KILLS > 1 else 10.0
IMPORTED_S = 2.0  # before, while Python imports, it reports an interrupt in its own way
MOST_OTHER = 20  # other ends of runs before the test is given up


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """Make a folder whose path is short: addresses of sockets are bounded."""
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.fixture(scope="module")
def reference(folder: Path) -> Reference:
    """Analyse a batch without interruption."""
    few = N_KILLS == 1
    return driving.reference_of(folder, driving.FEW if few else driving.MACHINES, quick=few)


@pytest.mark.parametrize("kind", ["sqlite", "postgres"])
def test_a_killed_batch_ends_as_without(
    folder: Path, reference: Reference, kind: str, needs: Callable[[str], None]
) -> None:
    """Nothing differs after kills at random moments, and each end is the expected one."""
    if kind == "postgres":
        needs("postgres")
    rng, kills = random.Random(f"{SEED} {kind}"), list[Row]()
    with driving.backends(folder) as kinds:
        while len(kills) < N_KILLS:
            found = killed(reference, kinds[kind], PER_RUN, HOWS, rng, N_KILLS - len(kills))
            assert found["differences"] == []
            assert found["other_ends"] == []
            kills += found["kills"]
    assert max(kill["gone_s"] for kill in kills) <= driving.ENDED_S
    silent = [kill for kill in kills if not kill.get("reported", True)]
    assert all(kill["after_s"] <= IMPORTED_S for kill in silent)


def test_the_comparison_sees_what_is_wrong(folder: Path, reference: Reference) -> None:
    """Negative controls: a row doubled, lost or moved, a digit changed, a page changed or lost."""
    assert all(driving.control(reference, folder).values())


def killed(
    reference: Reference, new_store: Stores, per_run: float, hows: dict[str, float],
    rng: random.Random, n: int,
) -> Row:  # fmt: skip
    """Kill runs of a batch, at most so many, until it is completed."""

    def draw() -> tuple[float, str] | None:
        """Draw the time in s to the next kill, and its kind; None if there were enough."""
        if len(kills) == n:
            return None
        wait_s = rng.expovariate(per_run / reference.seconds)
        return wait_s, rng.choices(list(hows), list(hows.values()))[0]

    kills: list[Row] = []
    other_ends: list[str] = []
    with new_store() as store, tempfile.TemporaryDirectory() as name:
        out, status = Path(name) / "out", None
        while status != driving.SOME_REFUSED:
            begun = time.monotonic()
            with driving.running(reference.command(out, store)) as run:
                how = ""
                # A run may survive the loss of a worker.
                while how in ("", "worker") and (drawn := draw()) and run.status(drawn[0]) is None:
                    if not run.kill(drawn[1], rng):
                        continue
                    how, after_s = drawn[1], time.monotonic() - begun
                    gone_s = 0.0 if how == "worker" else run.gone_after()
                    kills.append({"how": how, "after_s": after_s, "gone_s": gone_s})
                status, messages = run.status(), run.messages()
            if how == "SIGINT":
                kills[-1]["reported"] = one_line(messages)
            elif not (
                status == driving.SOME_REFUSED
                or (how == "main" and status == -signal.SIGKILL)
                or (how and one_line(messages))
            ):
                other_ends.append(f"{how or 'not killed'}: {status}: {messages[-3:]}")
                if len(other_ends) > MOST_OTHER:
                    raise RuntimeError(f"the batch does not come to its end: {other_ends}")
        differences = reference.judge(out, store)
    return {"kills": kills, "differences": differences, "other_ends": other_ends}
