"""Run a study: options, trials that are computed once, and the record of its results.

A trial is a function of the arguments that distinguish it from other trials. Its value is appended
as one line of JSON to a file under ``studies/.kept``, with the digest of all code that it depends
on. All values pass through JSON, so that an interrupted study has the same result as one that ran
without interruption. Of values of other code a random sample is computed again: where it agrees,
run times apart, the others are taken over, and the record counts both; where one differs, all are
computed again.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import AbstractContextManager, nullcontext, suppress
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from lmshealth.calibration.ranks import NOMINAL, judge_coverage
from studies.harness.provenance import code_of, code_of_script, commit, machine, name_of

Row = dict[str, Any]
Work = Callable[..., Any]

STUDIES = Path(__file__).parents[1]
KEPT = STUDIES / ".kept"
_PACKAGES = ("lmshealth", "numpy", "scipy", "emcee", "filterpy")
# Trials of other code of which one is repeated, and least number that are: where each of 20 agrees,
# at most 14 % of all differ (95 %).
_REPEATED, _LEAST_REPEATED = 15, 20
# Numbers that agree to this are equal: the rest is rounding. Run times are of the machine.
_ROUNDING, _TIMES = 1e-6, ("cpu_s", "seconds", "time_over_ours")


class Study:
    """A run of a study: its options, its trials, its run time, its record.

    ``script`` is its ``__file__``: ``run.py`` writes ``result.json``, any other script a record of
    its own name. The first line of ``doc`` is the question. Further arguments are options of the
    command line with their defaults. ``quick`` is the form that records and keeps nothing.
    """

    def __init__(self, script: str, doc: str | None, **options: Any) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()
        parser = argparse.ArgumentParser(
            description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        for name, default in ({"quick": False} | options).items():
            kind = {"action": "store_true"} if default is False else {"type": type(default)}
            parser.add_argument(f"--{name}", default=default, **kind)
        self.options = parser.parse_args()
        self.quick: bool = self.options.quick
        self._script = Path(script)
        self._question = str(doc).split("\n", 1)[0]
        name = "-".join(self._script.resolve().with_suffix("").parts[-3:])
        # What is measured under studies/cost are run times.
        file = None if self.quick else KEPT / f"{name}.jsonl"
        self.trials = Trials(file, takes_over="cost" not in self._script.parts)

    def pool(self, n: int = 2) -> AbstractContextManager[Executor | None]:
        """Return a pool of ``n`` processes; the quick form stays in this process."""
        return nullcontext() if self.quick else spawn_pool(n)

    def conclude(
        self,
        answer: Mapping[str, Any],
        *,
        details: Mapping[str, Any] | None = None,
        not_met: Iterable[str] = (),
        quick_may_fail: bool = False,
    ) -> None:
        """Print the answer, record it unless this is the quick form, and exit on a failed check.

        ``passed`` of the answer has a bool for each check; those in ``not_met`` are documented as
        not passed: of a mapping, the reasons of those that are not are added to the answer.
        ``details`` are recorded and not printed. A quick form that is too small to be judged may
        fail.
        """
        failed = [check for check, fine in answer.get("passed", {}).items() if not fine]
        if isinstance(not_met, Mapping):
            reasons = {check: why for check, why in not_met.items() if check in failed}
            answer = {**answer, "not_met": reasons}
        print(json.dumps(answer, indent=1))
        wrong = sorted(set(failed) - set(not_met))
        if not self.quick:
            self._write(record_of(self._script), {**answer, **(details or {})}, wrong)
        if wrong and not (self.quick and quick_may_fail):
            raise SystemExit(f"not as asked: {failed}")

    def _write(self, path: Path, answer: Mapping[str, Any], failed: list[str]) -> None:
        """Write a record: results, versions, and run time with that of kept trials."""
        content = {
            "question": self._question,
            **answer,
            "recorded": {
                "date": datetime.now(UTC).date().isoformat(),
                "commit": commit(),
                "code": code_of_script(self._script, self.trials.also),
                "also": sorted(self.trials.also),
                "machine": machine(),
                "failed": failed,
                "python": platform.python_version(),
                **{name: version(name) for name in _PACKAGES},
                "wall_s": round(time.perf_counter() - self._wall, 1),
                "cpu_s": round(time.process_time() - self._cpu, 1),
                "kept_s": round(self.trials.kept_s, 1),
                "repeated": self.trials.repeated,
                "taken_over": self.trials.taken_over,
            },
        }
        path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


class Trials:
    """Trials of a study, each computed once and kept in a file, if there is one.

    ``kept_s`` is the run time in s of the trials whose values were kept before, ``also`` the
    modules that they need and do not import, ``taken_over`` the number of values of other code, of
    which ``repeated`` trials confirmed them.
    """

    def __init__(self, path: Path | None, *, takes_over: bool = True) -> None:
        self._path, self._takes_over = path, takes_over
        self.kept_s, self.also, self.repeated, self.taken_over = 0.0, set[str](), 0, 0

    def once(self, work: Work, *task: Any, also: Iterable[str] = ()) -> Any:
        """Compute one trial, or read its kept value."""
        return self.collect(work, [task], also=also)[0]

    def collect(
        self,
        work: Work,
        tasks: Iterable[tuple[Any, ...]],
        *,
        also: Iterable[str] = (),
        pool: Executor | None = None,
    ) -> list[Any]:
        """Compute trials, except those whose values are kept, and return them in order.

        ``work`` is a function of a module, or a partial of one, and JSON can express its arguments
        (``tasks``) and its value; ``also`` names modules of the project that it needs and does not
        import, as programs that it starts.
        """
        tasks, also = [tuple(task) for task in tasks], tuple(also)
        self.also.update(also)
        if self._path is None:
            return [json.loads(json.dumps(value)) for value, _ in _compute(work, tasks, pool)]
        name, code = name_of(work), code_of(work, also)
        kept = _read(self._path, name)
        asked = list(dict.fromkeys(tasks))
        old = [task for task in asked if kept.get(json.dumps(task), {}).get("code", code) != code]
        if old:
            sample = _sample(old) if self._takes_over else old
            # An interrupted sample is repeated whole: its values are kept once all are known.
            pairs = zip(sample, _compute(work, sample, pool), strict=True)
            again = {json.dumps(task): _row(name, task, code, *done) for task, done in pairs}
            if all(alike(row["value"], kept[key]["value"]) for key, row in again.items()):
                confirmed = {"code": code, "confirmed_by": len(sample)}
                kept |= {key: kept[key] | confirmed for key in map(json.dumps, old)}
            else:
                kept = {key: row for key, row in kept.items() if row["code"] == code}
            kept |= again
            _rewrite(self._path, name, kept)
        by = [kept[key].get("confirmed_by") for key in map(json.dumps, asked) if key in kept]
        self.taken_over += sum(n is not None for n in by)
        self.repeated += max((n for n in by if n is not None), default=0)
        self.kept_s += sum(kept[key]["seconds"] for key in map(json.dumps, tasks) if key in kept)
        missing = [task for task in asked if json.dumps(task) not in kept]
        for task, done in zip(missing, _compute(work, missing, pool), strict=True):
            kept[json.dumps(task)] = row = _row(name, task, code, *done)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
        return [kept[json.dumps(task)]["value"] for task in tasks]


def spawn_pool(n: int) -> ProcessPoolExecutor:
    """Return a pool of ``n`` processes that import everything themselves."""
    return ProcessPoolExecutor(n, mp_context=get_context("spawn"))


def _compute(
    work: Work, tasks: list[tuple[Any, ...]], pool: Executor | None
) -> Iterator[tuple[Any, float]]:
    """Compute trials in order, in a pool if there is one; yield value and run time in s."""
    timed = partial(_timed, work)
    return pool.map(timed, tasks) if pool else map(timed, tasks)


def _timed(work: Work, task: tuple[Any, ...]) -> tuple[Any, float]:
    start = time.perf_counter()
    value = work(*task)
    return value, round(time.perf_counter() - start, 2)


def _sample(tasks: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    """Return the trials of a random sample, and one of each kind that a text in the task names."""
    order = np.random.default_rng(len(tasks)).permutation(len(tasks)).tolist()
    kinds = {tuple(x for x in tasks[k] if isinstance(x, str)): k for k in reversed(order)}
    chosen = {*order[: max(_LEAST_REPEATED, len(tasks) // _REPEATED)], *kinds.values()}
    return [tasks[k] for k in sorted(chosen)]


def alike(one: Any, other: Any) -> bool:
    """Return whether two values of a trial are equal but for rounding and run times."""
    if isinstance(one, dict) and isinstance(other, dict):
        same = one.keys() == other.keys()
        return same and all(key in _TIMES or alike(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return bool(np.isclose(one, other, rtol=_ROUNDING, atol=0.0, equal_nan=True))
    return bool(one == other)


def _row(name: str, task: tuple[Any, ...], code: str, value: Any, seconds: float) -> Row:
    """Return a trial as the file has it."""
    row = {"work": name, "task": task, "code": code, "seconds": seconds, "value": value}
    return dict(json.loads(json.dumps(row)))


def _rows(path: Path) -> Iterator[Row]:
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    for line in text.splitlines():
        with suppress(json.JSONDecodeError):  # the run ended while a line was written
            yield json.loads(line)


def _read(path: Path, name: str) -> dict[str, Row]:
    """Read the kept trials of a work, of any code."""
    return {json.dumps(row["task"]): row for row in _rows(path) if row["work"] == name}


def _rewrite(path: Path, name: str, kept: Mapping[str, Row]) -> None:
    """Write the file of kept trials with others of one work."""
    rows = [*(row for row in _rows(path) if row["work"] != name), *kept.values()]
    part = path.with_suffix(".part")
    part.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    part.replace(path)


def judge_scores(z: NDArray[np.float64], nominal: float = NOMINAL) -> Row:
    """Return the coverage of normal intervals from errors in standard deviations."""
    hits = int(np.sum(np.abs(z) < norm.isf((1 - nominal) / 2)))
    return judge_coverage(hits, z.size, nominal)


def real_data() -> Path:
    """Return the folder of real measurements."""
    if "LMSHEALTH_DATA" not in os.environ:
        raise SystemExit("LMSHEALTH_DATA is not set: it names the folder of real measurements")
    return Path(os.environ["LMSHEALTH_DATA"])


def record_of(script: str | Path) -> Path:
    """Return the file of a script's record: ``result.json`` of ``run.py``, else of its own name."""
    path = Path(script)
    return path.with_name("result.json" if path.stem == "run" else f"{path.stem}.json")
