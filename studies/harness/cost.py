"""Processor time and memory of programs: in turns, or in a process of their own."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread() -> dict[str, str]:
    """Return an environment in which linear algebra uses one thread."""
    return {**os.environ, **dict.fromkeys(_THREADS, "1")}


def cpu_s(work: Callable[[], object]) -> float:
    """Return the processor time of one call in s, over all threads."""
    start = time.process_time()
    work()
    return time.process_time() - start


def in_turns(
    works: Mapping[str, Callable[[], object]],
    turns: int,
    cost: Callable[[Callable[[], object]], float] = cpu_s,
) -> dict[str, list[float]]:
    """Let programs take turns; return the cost of every turn by program."""
    spent: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(turns):
        for name, work in works.items():
            spent[name].append(cost(work))
    return spent


def in_own_process(module: str, *arguments: object) -> Any:
    """Run a module in a process of its own, on one thread; return the JSON of its last line."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=one_thread())
    return json.loads(done.stdout.splitlines()[-1])


def memory_bytes(entry: str = "VmHWM", process: int | str = "self") -> int:
    """Return the peak memory of a process, or another entry of its status, in bytes.

    `resource` would include the peak of the parent.
    """
    status = Path(f"/proc/{process}/status").read_text()
    return int(re.findall(rf"{entry}:\s*(\d+) kB", status)[0]) << 10
