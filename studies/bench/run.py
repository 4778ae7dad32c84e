"""What does each step cost beside a peer or a lower bound in the same turn?

Question
    Is every figure of speed still reached: identification, sampling, whole lives, remaining life,
    tracking, reading, simulation, batches?
Method
    ``tests/bench``, by pytest-benchmark. Peer and ours take turns in one process; the figure is the
    ratio of their processor times (of wall times for workers), its median over the turns. It is
    missed where more turns are above the bound than chance allows at 1 % if the median were on it.
    Where seconds were asked for, the bound is those seconds in times of the peer, as the study of
    that step recorded both. Figures whose peer is not installed are left out.
Run time
    Some ten minutes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from studies.record import Study

ROOT = Path(__file__).parents[2]
QUICK = "simulation"


def main() -> None:
    """Run the study; ``--quick`` times one figure and records nothing."""
    study = Study(__file__, __doc__)
    with tempfile.TemporaryDirectory() as name:
        figures = Path(name) / "figures.json"
        command = [
            *(sys.executable, "-m", "pytest", "tests/bench", "-o", "python_files=bench_*.py"),
            *("-p", "no:xdist", "--benchmark-timer=time.process_time"),
            *("--benchmark-columns=median", "--figures", str(figures)),
            *(("-k", QUICK) if study.quick else ()),
        ]
        done = subprocess.run(command, cwd=ROOT, stdout=sys.stderr, check=False)
        found: dict[str, Any] = json.loads(figures.read_text(encoding="utf-8"))
    answer: dict[str, Any] = {
        "figures": found,
        # Whether the machine had other work.
        "processors": os.cpu_count(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "passed": {name: not row["missed"] for name, row in found.items()},
    }
    answer["passed"]["no bench failed"] = done.returncode == 0
    study.conclude(answer)


if __name__ == "__main__":
    main()
