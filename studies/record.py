"""How a study keeps what it found: numbers with seed, versions, machine and run time."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lmshealth.metrics import Coverage, clopper_pearson

# How often intervals claim to hold the truth, and how sure the judgement of that is.
NOMINAL, LEVEL = 0.95, 0.999
_PACKAGES = ("lmshealth", "numpy", "scipy", "emcee", "filterpy")


class Stopwatch:
    """Measures wall and processor time since it was made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def read(self) -> dict[str, float]:
        """Return seconds of wall time and of this process's processor time."""
        return {
            "wall_s": round(time.perf_counter() - self._wall, 1),
            "cpu_s": round(time.process_time() - self._cpu, 1),
        }


def keep(path: Path, question: str, answer: Mapping[str, Any], watch: Stopwatch) -> None:
    """Write the result of a study as JSON."""
    content = {
        "question": question,
        **answer,
        "recorded": {
            "date": datetime.now(UTC).date().isoformat(),
            "python": platform.python_version(),
            **{name: version(name) for name in _PACKAGES},
            **watch.read(),
        },
    }
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def conclude(
    record: Path,
    question: str,
    answer: Mapping[str, Any],
    watch: Stopwatch,
    *,
    quick: bool,
    not_met: Iterable[str] = (),
) -> None:
    """Print what a study found, record it unless it is the quick form, and fail where it fails.

    Parameters
    ----------
    record : Path
        Where the result goes.
    question : str
        First line of the study's docstring.
    answer : mapping
        With ``passed``, whether each thing asked is so.
    watch : Stopwatch
        Of the study.
    quick : bool
        Whether it is the quick form.
    not_met : iterable of str
        What is known not to be so.
    """
    print(json.dumps(answer, indent=1))
    if not quick:
        keep(record, question, answer, watch)
    failed = [name for name, fine in answer["passed"].items() if not fine]
    if not set(failed) <= set(not_met):
        raise SystemExit(f"not as asked: {failed}")


def judge_coverage(hits: int, n: int, nominal: float = NOMINAL) -> dict[str, Any]:
    """Tell how often intervals hold the truth, and whether that may be as often as they claim."""
    return as_row(Coverage(nominal, hits, n, *clopper_pearson(hits, n, LEVEL)))


def as_row(found: Coverage) -> dict[str, Any]:
    """Write a coverage down."""
    return {"hits": found.hits, "n": found.n, "share": found.share, "low": found.low,
            "high": found.high, "holds": found.holds}  # fmt: skip
