"""How speed is measured: in turns with a peer, held by the turns' own scatter, recorded."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from studies.bench.ratios import FALSE_ALARM, Figure, table
from studies.record import Stopwatch, keep
from tests.conftest import ROOT

RECORD = ROOT / "studies" / "bench" / "result.json"
QUESTION = "What does each step cost beside a peer or a lower bound in the same turn?"
METHOD = (
    "Peer and ours take turns in one process; the figure is the ratio of their processor times "
    "(of wall times for workers), its median over the turns. It is missed where more turns are "
    f"above the bound than chance allows at {100 * FALSE_ALARM:g} % if the median were on it."
)
_FIGURES = pytest.StashKey[dict[str, dict[str, Any]]]()
_WATCH = pytest.StashKey[Stopwatch]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let the figures be recorded."""
    parser.addoption("--record", action="store_true", help=f"write {RECORD.relative_to(ROOT)}")


def pytest_configure(config: pytest.Config) -> None:
    """Begin with no figure."""
    config.stash[_FIGURES], config.stash[_WATCH] = {}, Stopwatch()


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Show all figures, and record them where that is asked for; of some, beside the others."""
    figures = config.stash[_FIGURES]
    if not figures:
        return
    terminalreporter.section("figures")
    for line in table(figures):
        terminalreporter.write_line(line)
    if config.getoption("--record"):
        known = json.loads(RECORD.read_text())["figures"] if RECORD.exists() else {}
        others = known if config.getoption("keyword") else {}
        answer = {
            "method": METHOD,
            "figures": others | figures,
            # Whether the machine had other work.
            "processors": os.cpu_count(),
            "load": [round(load, 1) for load in os.getloadavg()],
        }
        keep(RECORD, QUESTION, answer, config.stash[_WATCH])


class Race:
    """Runs ours and a peer in turns, and holds what comes of it."""

    def __init__(self, request: pytest.FixtureRequest) -> None:
        self._request = request

    def __call__(
        self,
        ours: Callable[[], object],
        peer: Callable[[], object],
        *,
        name: str,
        beside: str,
        at_most: float,
        turns: int = 9,
    ) -> None:
        """Time both; what they return counts as the amount of work if it is a number."""
        theirs: list[float] = []
        amounts: list[float] = []

        def first_the_peer() -> None:
            begin = time.process_time()
            found = peer()
            theirs.append((time.process_time() - begin) / _amount(found))

        def then_ours() -> None:
            amounts.append(_amount(ours()))

        benchmark: BenchmarkFixture = self._request.getfixturevalue("benchmark")
        assert benchmark._timer is time.process_time, "run `make bench`"
        peer(), ours()  # what is put off until the first call
        benchmark.pedantic(then_ours, setup=first_the_peer, rounds=turns)
        own = benchmark.stats.stats.data
        times = zip(own, amounts, theirs, strict=True)
        self.told([t / n / other for t, n, other in times], name=name, beside=beside,
                  at_most=at_most)  # fmt: skip

    def told(self, ratios: Sequence[float], *, name: str, beside: str, at_most: float) -> None:
        """Hold ratios that were measured elsewhere."""
        figure = Figure(name, beside, at_most, tuple(ratios))
        self._request.config.stash[_FIGURES][name] = figure.row()
        assert not figure.missed, figure.row()


def _amount(found: object) -> float:
    return float(found) if isinstance(found, int | float) else 1.0


@pytest.fixture
def race(request: pytest.FixtureRequest) -> Race:
    """Hold a figure."""
    return Race(request)
