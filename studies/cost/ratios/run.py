"""Is every figure of speed still met, relative to a peer or a lower bound in the same turn?

Method
    ``tests/bench`` with pytest-benchmark: identification, sampling, lives, tracking, batches. Peer
    and program take turns in one process; the figure is the median ratio of their processor times
    (wall times for workers). It is missed if more turns exceed the bound than chance allows at 1 %
    for a median on the bound. A requirement in seconds is expressed in times of the peer; of whole
    processes, with all that they start, the peer is the code of the time when it was made. Where
    the time goes: a run with one new log, in one process, under cProfile.
Run time
    Half an hour.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from studies.harness.checkout import ROOT
from studies.harness.claims import Claim, number
from studies.harness.cost import in_own_process
from studies.harness.study import Row, Study

QUICK = "walker"
_SEARCH = (
    "three quarters are the search for modes, which refines every mode of every set that it tries: "
    "1,450 evaluations of a likelihood of a log of four channels"
)
NOT_MET = {
    "identify the record of three modes": _SEARCH,
    "60 s of four channels at 20 kHz, Parquet to modes": _SEARCH,
    "tracking 10,000 epochs of five modes": (
        "all settings are filtered at once, and each log is searched for outliers, steps and new "
        "rates, in many small steps of which none dominates"
    ),
    "modes of a log of 4 s, whole process": (
        "three quarters of what is left are imports of numpy, SciPy and pandas"
    ),
    "one new log on 39, whole process": (
        "two fifths are the figures of the machine's page, which are drawn anew, a third the "
        "assessment, a quarter imports"
    ),
    "prognose after a step, whole process": (
        "the bound is 6 s over the 60 s that the code before took on another machine"
    ),
    "no bench failed": "a figure that is missed fails its bench",
}


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
        "shares": {} if study.quick else in_own_process("tests.bench.processes"),
        # Whether the machine had other work.
        "processors": os.cpu_count(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "passed": {name: not row["missed"] for name, row in found.items()},
    }
    answer["passed"]["no bench failed"] = done.returncode == 0
    study.conclude(answer, not_met=NOT_MET)


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
    shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in answer["shares"].items())
    yield Claim("where the processor time of one new log on 39 goes", shares, "", "")


if __name__ == "__main__":
    main()
