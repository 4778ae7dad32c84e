"""How speed is measured: in turns with a peer, held by the turns' own scatter, recorded."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from studies.cost.ratios.ratios import Figure, table

_FIGURES = pytest.StashKey[dict[str, dict[str, Any]]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let the figures be written down."""
    parser.addoption("--figures", type=Path, help="file that all figures are written to, as JSON")


def pytest_configure(config: pytest.Config) -> None:
    """Begin with no figure."""
    config.stash[_FIGURES] = {}


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Show all figures, and write them down where that is asked for."""
    figures = config.stash[_FIGURES]
    if figures:
        terminalreporter.section("figures")
        for line in table(figures):
            terminalreporter.write_line(line)
    if path := config.getoption("--figures"):
        path.write_text(json.dumps(figures), encoding="utf-8")


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
        assert benchmark.stats is not None
        own = benchmark.stats.stats.data
        times = zip(own, amounts, theirs, strict=True)
        self.record([t / n / other for t, n, other in times], name=name, beside=beside,
                  at_most=at_most)  # fmt: skip

    def record(self, ratios: Sequence[float], *, name: str, beside: str, at_most: float) -> None:
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
