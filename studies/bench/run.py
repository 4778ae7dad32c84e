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
from collections.abc import Iterator
from pathlib import Path

from studies.harness.claims import Claim, number
from studies.harness.study import Row, Study

STEP = "batch"

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
        found: Row = json.loads(figures.read_text(encoding="utf-8"))
    answer: Row = {
        "figures": found,
        # Whether the machine had other work.
        "processors": os.cpu_count(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "passed": {name: not row["missed"] for name, row in found.items()},
    }
    answer["passed"]["no bench failed"] = done.returncode == 0
    study.conclude(answer)


def claims(answer: Row) -> Iterator[Claim]:
    """Claim the cost of every step in times of a peer."""
    for name, row in answer["figures"].items():
        yield Claim(
            name,
            f"{number(row['ratio'])} times",
            f"{number(row['least'])} to {number(row['largest'])} in {row['turns']} turns",
            f"{row['peer']}; at most {number(row['at_most'])}",
            not row["missed"],
        )


if __name__ == "__main__":
    main()
