"""Whole processes of the command line, by this code and by that before, in turns."""

from __future__ import annotations

import json
import os
import pstats
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from studies.harness.checkout import ROOT, checkout
from studies.harness.command_line import call
from studies.harness.cost import one_thread

# The code when seconds of whole processes were first asked for.
REVISION = "1811c297"
N_LOGS, SECONDS = 40, 10
TURNS = 7
PARTS = {
    "imports": "_find_and_load",
    "identification": "identify_log",
    "assessment": "assess_from",
    "of it the life": "fit_life",
    "page": "make_page",
    "of it figures": "print_figure",
}
NEW, STEPPED, SHORT = "last", "stepped.csv", "short.csv"
STEP, STEP_AT = 0.99, 16  # factor on all frequencies, and first log that has it


@dataclass(frozen=True)
class Programs:
    """A machine's logs, and the results of each program from all of them but the last."""

    folder: Path
    codes: dict[str, Path]

    def forget(self, name: str) -> None:
        """Restore the results of a program from all logs but the last."""
        own = self.folder / name
        shutil.rmtree(own / "out")
        shutil.copytree(own / "known", own / "out")

    def ratios(self, words: Callable[[str], list[object]]) -> list[float]:
        """Return the processor time of this code in times of that before, of each turn."""
        found = []
        for _ in range(TURNS):
            spent = []
            for name in self.codes:
                self.forget(name)
                spent.append(self.cpu_s(name, *words(name)))
            found.append(spent[1] / spent[0])
        return found

    def cpu_s(self, name: str, *words: object) -> float:
        """Return the processor time in s of a command and of all processes that it starts."""
        command = [sys.executable, "-m", "lmshealth", *map(str, words)]
        begin = resource.getrusage(resource.RUSAGE_CHILDREN)
        environment = {**one_thread(), "PYTHONPATH": str(self.codes[name])}
        subprocess.run(command, env=environment, capture_output=True, cwd=self.folder, check=False)
        end = resource.getrusage(resource.RUSAGE_CHILDREN)
        return end.ru_utime + end.ru_stime - begin.ru_utime - begin.ru_stime

    def run(self, name: str) -> list[object]:
        """Return the words of a run on the machine's logs."""
        out = self.folder / name / "out"
        return ["run", self.folder / "logs", "--stage", "lms-y", "--out", out]

    def prognose(self, name: str) -> list[object]:
        """Return the words of a prognosis of the machine with a step."""
        return ["prognose", STEPPED, "--stage", "lms-y", "--out", f"{name}.csv"]


def shares(both: Programs) -> dict[str, float]:
    """Return the shares of the processor time of one new log, all in one process."""
    profile = both.folder / "profile"
    both.forget("now")
    words = [str(word) for word in (*both.run("now"), "--workers", 1)]
    profiled = ["-m", "cProfile", "-o", str(profile), "-m", "lmshealth", *words]
    subprocess.run([sys.executable, *profiled], env=one_thread(), capture_output=True, cwd=ROOT,
                   check=True)  # fmt: skip
    stats: Any = pstats.Stats(str(profile))
    spent = {name: row[3] for (_, _, name), row in stats.stats.items() if name in PARTS.values()}
    return {part: spent[name] / stats.total_tt for part, name in PARTS.items()}


@contextmanager
def programs(folder: Path) -> Iterator[Programs]:
    """Simulate the machine, and let both programs know all of its logs but the last."""
    with checkout(REVISION, folder / "code") as before:
        both = Programs(folder, {"before": before, "now": ROOT})
        logs = folder / "logs"
        call("models", "simulate", "lms-y", "--life", "both", "--logs", N_LOGS, "--seconds",
             SECONDS, "--seed", 3, "--out", logs, quick=False)  # fmt: skip
        last = logs / f"log-{N_LOGS:04d}.h5"
        shutil.move(last, folder / NEW)
        # Files of this minute would be hashed again by each run.
        old = time.time() - 86_400
        for path in [*logs.iterdir(), folder / NEW]:
            os.utime(path, (old, old))
        for name in both.codes:
            (folder / name).mkdir()
            both.cpu_s(name, *both.run(name))
            shutil.copytree(folder / name / "out", folder / name / "known")
        modes = pd.read_csv(folder / "now" / "out" / "modes.csv")
        after = modes["log"].rank(method="dense") > STEP_AT
        modes["frequency_hz"] *= np.where(after, STEP, 1.0)
        modes.to_csv(folder / STEPPED, index=False)
        shutil.copy(folder / "now" / "out" / "modes_cov.csv", folder)
        shutil.move(folder / NEW, last)
        noise = np.random.default_rng(0).normal(size=4000)
        rows = pd.DataFrame({"time_s": np.arange(noise.size) / 1000, "acc_feed_m_s2": noise})
        rows.to_csv(folder / SHORT, index=False)
        yield both


if __name__ == "__main__":
    with TemporaryDirectory() as name, programs(Path(name)) as both:
        print(json.dumps(shares(both)))
