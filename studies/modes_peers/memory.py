"""The most memory that a tool takes for a record, in a process of its own."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from studies.identification.cases import CASES
from studies.identification.records import accelerations

_SHORT = 6.0


def peak_of(tool: str, case: int) -> float:
    """Megabytes at the peak of a call, above what was held before it."""
    command = [sys.executable, "-m", "studies.modes_peers.memory", tool, str(case)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(json.loads(done.stdout))


def _kilobytes(entry: str) -> int:
    """Read a line of the process's status; `resource` would count its parent's too."""
    status = Path("/proc/self/status").read_text()
    return int(re.findall(rf"{entry}:\s*(\d+) kB", status)[0])


def main() -> None:
    """Call the tool for a short record, whose imports do not count, and then for the record."""
    from studies.modes_peers.peers import TOOLS

    tool = next(tool for tool in TOOLS if tool.name == sys.argv[1])
    case, rng = CASES[int(sys.argv[2])], np.random.default_rng(0)
    log = case.make(rng, case.modes, case.noise)
    short = replace(case, moves=1, make=partial(accelerations, seconds=_SHORT, moves=1))
    tool(short.make(rng, short.modes, short.noise), short)
    before = _kilobytes("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far
    tool(log, case)
    print(json.dumps((_kilobytes("VmHWM") - before) / 1024))


if __name__ == "__main__":
    main()
