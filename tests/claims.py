"""Claims of the statistical tests: p values that travel to one judgement of the whole suite.

A test claims something and gives the p value of it, and for every claim the p value of a control:
the same check on input that is wrong. Holm's rule holds all claims together to one level, which is
the probability that a suite without fault fails at all [Holm1979]. A claim that is rejected alone,
below the level over the number of claims, fails its own test; so does a control that is not
rejected at that same, strictest level: the check could not have seen a fault.

As a pytest plugin this gathers the claims of all workers, applies the rule and prints a table. It
writes a page with their ranks and coverages to the file that LMSHEALTH_STATISTICS names.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lmshealth.calibration.ranks import holm

_PROPERTY = "statistical claim"


@dataclass(frozen=True)
class Part:
    """What one test draws and claims.

    Attributes
    ----------
    trials : int
        How many data sets it draws.
    claims : tuple of str
        Each has a p value and a control.
    control : int
        How many data sets its control has, where it has its own.
    """

    trials: int
    claims: tuple[str, ...]
    control: int = 0


def generator(seed: int, name: str) -> np.random.Generator:
    """Give a test its own generator, whatever other tests run and in which order."""
    own = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    return np.random.default_rng([seed, own])


@dataclass
class Claims:
    """What a test has claimed so far.

    Attributes
    ----------
    link : str
        What the test is about, for the table.
    part : Part
        What it was to claim.
    level : float
        Of the whole suite.
    of : int
        Number of claims of the whole suite.
    p, controls : dict
        P values by claim; of several controls of a claim the largest. They may have ``shares``,
        ``places`` and ``text`` (`tests.statistical.evidence`).
    """

    link: str
    part: Part
    level: float
    of: int
    p: dict[str, float] = field(default_factory=dict)
    controls: dict[str, float] = field(default_factory=dict)

    @property
    def trials(self) -> int:
        """How many data sets to draw."""
        return self.part.trials

    def claim(self, name: str, p: float) -> None:
        """State a claim, once."""
        assert name in self.part.claims, f"{name!r} is none of {self.part.claims}"
        assert name not in self.p, f"{name!r} is claimed twice"
        self.p[name] = p

    def control(self, name: str, p: float) -> None:
        """Give the p value that a claim has on input that is wrong."""
        assert name in self.part.claims, f"{name!r} is none of {self.part.claims}"
        self.controls[name] = max(p, self.controls.get(name, 0.0))

    def rows(self) -> list[dict[str, Any]]:
        """Write the claims down for the judgement of the whole suite."""
        none = float("nan")
        return [
            {"name": f"{self.link}: {name}", "p": float(p), "trials": self.trials,
             "level": self.level, "of": self.of, "control": float(self.controls.get(name, none)),
             **_kept(p), "wrong": _kept(self.controls.get(name, none))}
            for name, p in self.p.items()
        ]  # fmt: skip

    def settle(self) -> None:
        """Fail where a claim is rejected alone, lacks its control, or has one that is not seen."""
        strictest = self.level / self.of
        wrong = [f"{name}: not claimed" for name in self.part.claims if name not in self.p]
        wrong += [f"{name}: no control" for name in self.part.claims if name not in self.controls]
        wrong += [
            f"{name}: p = {p:.2g}, rejected below {strictest:.2g}"
            for name, p in self.p.items()
            if not p > strictest
        ]
        wrong += [
            f"{name}: the control has p = {p:.2g}, the check could not have seen a fault"
            for name, p in self.controls.items()
            if not p <= strictest
        ]
        if wrong:
            pytest.fail("\n".join(wrong), pytrace=False)


def _kept(p: float) -> dict[str, Any]:
    """Return the counts, places and text of a p value, in lists that workers can send."""
    shares = [list(one) for one in getattr(p, "shares", ())]
    return {"shares": shares, "places": list(getattr(p, "places", ())),
            "text": getattr(p, "text", "")}  # fmt: skip


KEY = pytest.StashKey[Claims]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Settle the claims of a test that has come to its end."""
    claims = item.stash.get(KEY, None)
    try:
        yield
    finally:
        if claims is not None:
            item.user_properties += [(_PROPERTY, row) for row in claims.rows()]
    if claims is not None:
        claims.settle()


class _Judgement:
    """Gathers the claims of all tests, from wherever they ran."""

    def __init__(self) -> None:
        self.rows: list[Any] = []
        self.begin = time.time()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Take the claims of a test."""
        if report.when == "call":
            self.rows += [row for name, row in report.user_properties if name == _PROPERTY]

    def rejected(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Apply Holm's rule."""
        first = self.rows[0]
        return holm([row["p"] for row in self.rows], first["level"], first["of"])

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fail the run where a claim is rejected."""
        if self.rows and self.rejected()[1].any() and session.exitstatus == 0:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(
        self, terminalreporter: pytest.TerminalReporter, exitstatus: int
    ) -> None:
        """Print the table of claims, the least probable first, and write their page."""
        if not self.rows:
            return
        asked, rejected = self.rejected()
        level, of = self.rows[0]["level"], self.rows[0]["of"]
        terminalreporter.section("statistical claims")
        width = max(len(row["name"]) for row in self.rows)
        write = terminalreporter.write_line
        write(f"{'claim':{width}}  trials  p        held to  control")
        for k in np.argsort([row["p"] for row in self.rows], kind="stable"):
            row = self.rows[k]
            write(
                f"{row['name']:{width}}  {row['trials']:6d}  {row['p']:<7.2g}  {asked[k]:<7.2g}  "
                f"{row['control']:<7.2g}{'  REJECTED' if rejected[k] else ''}"
            )
        write(
            f"{len(self.rows)} of {of} claims made, {np.count_nonzero(rejected)} rejected by Holm's"
            f" rule: a suite without fault fails in at most {level:.0%} of reseeded runs"
        )
        if target := os.environ.get("LMSHEALTH_STATISTICS"):
            from studies.harness.provenance import commit  # late: few runs need these
            from tests.statistical.page import write_page

            failed = exitstatus != pytest.ExitCode.OK
            held = zip(asked.tolist(), rejected.tolist(), strict=True)
            minutes = (time.time() - self.begin) / 60
            seed = os.environ.get("LMSHEALTH_SEED", "that of the suite")
            made = f"{date.today():%Y-%m-%d}, code {commit()}, seed {seed}, {minutes:.0f} minutes"
            write_page(Path(target), self.rows, list(held), failed=failed, made=made)
            write(f"Page: {target}")


def pytest_configure(config: pytest.Config) -> None:
    """Gather claims in every run."""
    config.pluginmanager.register(_Judgement(), "judgement of claims")
