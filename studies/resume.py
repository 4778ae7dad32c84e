"""How a long study goes on after an interruption: what it has done is kept, and not done again.

Every trial is a function of the arguments that tell it from others. Its value is kept as a line of
JSON under ``studies/.kept``, beside the digest of all code that it depends on: values of other code
are no evidence for this one, and are done anew. Values come back from JSON whether they were kept
or are new, so that a study which was interrupted has the result of one which was not.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

from studies.provenance import code_of, name_of

KEPT = Path(__file__).parent / ".kept"
Work = Callable[..., Any]


class Trials:
    """Trials of a study, done once.

    Parameters
    ----------
    path : Path or None
        File that keeps them; None if nothing shall be kept.

    Attributes
    ----------
    kept_s : float
        Seconds that those took which were done before.
    """

    def __init__(self, path: Path | None) -> None:
        self._path, self.kept_s = path, 0.0

    def once(self, work: Work, *task: Any, also: Iterable[str] = ()) -> Any:
        """Do one trial, or look it up."""
        return self.collect(work, [task], also=also)[0]

    def collect(
        self,
        work: Work,
        tasks: Iterable[tuple[Any, ...]],
        *,
        also: Iterable[str] = (),
        pool: Executor | None = None,
    ) -> list[Any]:
        """Do trials, but for those that were done before.

        Parameters
        ----------
        work : callable
            What is done, a function of a module or a part of one; its value can be told in JSON.
        tasks : iterable of tuples
            Arguments that tell trials from each other: strings, numbers, and the like.
        also : iterable of str
            Modules of the project that it needs and does not import, as programs that it starts.
        pool : Executor, optional
            Where it is done; one after the other if there is none.
        """
        tasks = [tuple(task) for task in tasks]
        if self._path is None:
            return [json.loads(json.dumps(value)) for value, _ in _done(work, tasks, pool)]
        name, code = name_of(work), code_of(work, tuple(also))
        known = _read(self._path, name, code)
        self.kept_s += sum(known[key]["seconds"] for key in map(json.dumps, tasks) if key in known)
        missing = [task for task in dict.fromkeys(tasks) if json.dumps(task) not in known]
        for task, (value, seconds) in zip(missing, _done(work, missing, pool), strict=True):
            row = {"work": name, "task": task, "code": code, "seconds": seconds, "value": value}
            line = json.dumps(row)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
            known[json.dumps(task)] = json.loads(line)
        return [known[json.dumps(task)]["value"] for task in tasks]


def _done(
    work: Work, tasks: list[tuple[Any, ...]], pool: Executor | None
) -> Iterator[tuple[Any, float]]:
    """Do trials one after the other, or in a pool; give value and seconds of each in turn."""
    todo = partial(_timed, work)
    return pool.map(todo, tasks) if pool else map(todo, tasks)


def _timed(work: Work, task: tuple[Any, ...]) -> tuple[Any, float]:
    start = time.perf_counter()
    value = work(*task)
    return value, round(time.perf_counter() - start, 2)


def _read(path: Path, name: str, code: str) -> dict[str, Any]:
    """Read what a work of this code has given; what is of other code is forgotten."""
    if not path.exists():
        return {}
    rows = []
    text = path.read_text(encoding="utf-8")
    for line in text.splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue  # the run ended while it was written
    rows = [row for row in rows if row["work"] != name or row["code"] == code]
    whole = "".join(json.dumps(row) + "\n" for row in rows)
    if whole != text:
        part = path.with_suffix(".part")
        part.write_text(whole, encoding="utf-8")
        part.replace(path)
    return {json.dumps(row["task"]): row for row in rows if row["work"] == name}
