"""A plugin of pytest that writes down what each test came to, and its processor time."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

WATCH = "LMSHEALTH_MUTANTS_WATCH"
_failed: set[str] = set()
_passed: set[str] = set()


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Remember how a test ended."""
    if report.failed:
        _failed.add(report.nodeid)
    elif report.when == "call" and report.passed:
        _passed.add(report.nodeid)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Time a test with its fixtures, and the programs that it starts."""
    before = sum(os.times()[:4])
    result = yield
    name = item.nodeid
    row = {
        "test": name,
        "passed": name in _passed and name not in _failed,
        "failed": name in _failed,
        "seconds": round(sum(os.times()[:4]) - before, 3),
    }
    with Path(os.environ[WATCH]).open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")
    return result
