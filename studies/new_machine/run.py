"""Do the tutorial's commands give the output shown, and do the results agree with the truth?

Method
    README.md describes a new machine step by step. A shell runs its commands in an empty folder
    from which only the project and the data are accessible. The output is compared with the
    tutorial line by line, without digits. The machine is a motor bench with a flexible coupling,
    excited by a multisine (20 s, real data); its modal map is that of two inertias on a spring.
    These data contain no ageing. The same recording is therefore used for two machines: ``bench-A``
    as measured, whose coupling must be reported as healthy, and ``bench-B``, whose manifest states
    a decreasing sample rate, so that all frequencies, and with their square the stiffness, decrease
    by a known amount. The dates of the logs are artificial. Control: a decrease half as large must
    be outside the interval of B.
Answer
    Yes. Over the ten logs of A the frequency scatters by a sixth of its stated standard deviation,
    because the nonlinearity is the same in each log. A has no alarm, and no end of life within the
    horizon. B raises an alarm at its third log, after a loss of 1.6 %; at its last log the inferred
    stiffness is 0.930 (0.923 to 0.935), the true one 0.929. ``lmshealth stage`` reports from the
    description alone that one mode does not determine both stiffness and load inertia.
Run time
    Two minutes of processor time.
Data
    Folder ``fditools_two_inertia_bench`` of LMSHEALTH_DATA.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from studies.harness.claims import Claim, Older, counted, number
from studies.harness.study import Row, Study, real_data
from studies.new_machine.cut import APART_H, SLOWER

STEP = "infer"

OLDER = {
    "result": Older("9841f4ed50d5", "modes were averaged over coloured forces"),
}

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
LIMIT = 0.8
QUICK_STEPS = 3
_BLOCK = re.compile(r"^```(sh|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_DIGITS = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")


class Step(NamedTuple):
    """Commands of the tutorial, and the lines of output that it shows."""

    commands: str
    shown: str


def main() -> None:
    """Run the tutorial; ``--quick`` ends after the map and writes no record."""
    study = Study(__file__, __doc__)
    real_data()
    with tempfile.TemporaryDirectory() as scratch:
        answer = answered(Path(scratch), quick=study.quick)
    study.conclude(answer)


def steps() -> list[Step]:
    """Read the blocks of commands of the tutorial, each with the output shown after it."""
    found: list[Step] = []
    for kind, text in _BLOCK.findall((HERE / "README.md").read_text(encoding="utf-8")):
        if kind == "sh":
            found.append(Step(text, ""))
        else:
            found[-1] = found[-1]._replace(shown=found[-1].shown + text)
    return found


def answered(scratch: Path, *, quick: bool) -> Row:
    """Run the tutorial, to its end or to the map, and compare its results with the truth."""
    (scratch / "studies").symlink_to(HERE.parent)
    told = [follow(step, scratch) for step in steps()[: QUICK_STEPS if quick else None]]
    bench = scratch / "bench"
    made = {"bench.map.csv": "bench.map.csv", "manifest.csv": "logs/manifest.csv"}
    same = {k: (bench / v).read_bytes() == (HERE / k).read_bytes() for k, v in made.items()}
    answer: Row = {"seed": 0, "limit": LIMIT, "steps": told, "files_as_shown": same}
    if quick:
        return answer | {"passed": as_shown(answer)}
    events = pd.read_csv(bench / "events.csv")[["stage", "travel_km", "kind"]]
    answer |= {
        "modes": tell_modes(bench),
        "stiffness": tell_stiffness(bench),
        "remaining": tell_remaining(bench),
        "events": events.to_dict("records"),
    }
    return answer | {"passed": judge(answer)}


def follow(step: Step, scratch: Path) -> Row:
    """Run a step in a shell, and compare the output with that in the tutorial."""
    python = f"'{sys.executable}'"
    tools = f'lmshealth() {{ {python} -m lmshealth "$@"; }}\npython() {{ {python} "$@"; }}\n'
    begin = time.perf_counter()
    done = subprocess.run(
        ["sh", "-e", "-c", tools + step.commands],
        capture_output=True, text=True, check=False, cwd=scratch,
        env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "80"},
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{step.commands}ended with {done.returncode}: {done.stderr}")
    came = {plain(line) for line in (done.stdout + done.stderr).splitlines()}
    missing = [line for line in step.shown.splitlines() if plain(line) not in came]
    return {
        "commands": step.commands.replace("\\\n", "").splitlines(),
        "wall_s": round(time.perf_counter() - begin, 1),
        "shown_and_not_come_out": missing,
    }


def plain(line: str) -> str:
    """Normalise a line: replace numbers by 0, as last digits may differ, and collapse blanks."""
    return " ".join(_DIGITS.sub("0", line).split())


def tell_modes(bench: Path) -> Row:
    """Return the scatter and the stated standard deviation of the frequency of bench-A."""
    modes = pd.read_csv(bench / "modes.csv")
    own = modes[modes["stage"] == "bench-A"]
    return {
        "n": len(modes),
        "mean_hz": float(own["frequency_hz"].mean()),
        "scatter_hz": float(own["frequency_hz"].std()),
        "stated_std_hz": float(own["frequency_std_hz"].median()),
    }


def tell_stiffness(bench: Path) -> list[Row]:
    """Compare the inferred stiffness with the true one, which follows from the manifest."""
    health = pd.read_csv(bench / "health.csv").rename(columns={"travel_km": "hours"})
    falling = (1 - SLOWER * (health["hours"] / APART_H).round()) ** 2
    health["truth"] = falling.where(health["stage"] == "bench-B", 1.0)
    health["inside"] = health["truth"].between(health["q05"], health["q95"])
    half = (1 + health["truth"]) / 2
    health["half_the_fall_inside"] = half.between(health["q05"], health["q95"])
    columns = ["stage", "hours", "truth", "q05", "median", "q95", "converged", "inside"]
    return health[[*columns, "half_the_fall_inside"]].to_dict("records")


def tell_remaining(bench: Path) -> Row:
    """Return the remaining life, and the true one of bench-B at a constant rate of loss (hours)."""
    table = pd.read_csv(bench / "prognosis.csv")
    own = table[table["parameter"] == "coupling_stiffness"].set_index("stage")
    columns = ["rul_km_q05", "rul_km_q50", "rul_km_q95", "probability_beyond_horizon"]
    last = float(pd.read_csv(bench / "modes.csv")["travel_km"].max())
    told = own[columns].astype(object).where(own[columns].notna(), None).to_dict("index")
    return told | {"true_of_bench-B_h": (1 - float(np.sqrt(LIMIT))) / SLOWER * APART_H - last}


def as_shown(answer: Row) -> dict[str, bool]:
    """Return whether the commands print the output shown, and write the files of this folder."""
    missing = [line for step in answer["steps"] for line in step["shown_and_not_come_out"]]
    same = all(answer["files_as_shown"].values())
    return {
        "what is shown comes out": not missing,
        "the files of this folder are those that are made": same,
    }


def judge(answer: Row) -> dict[str, bool]:
    """Return whether the output is as shown, and whether the results agree with the truth."""
    sound, worn = (
        [row for row in answer["stiffness"] if row["stage"] == name]
        for name in ("bench-A", "bench-B")
    )
    left, alarms = answer["remaining"], [e for e in answer["events"] if e["kind"] == "alarm"]
    last, end = left["bench-B"], left["true_of_bench-B_h"]
    return as_shown(answer) | {
        "every log gives the mode": answer["modes"]["n"] == 20,
        "every epoch of both machines converged": all(r["converged"] for r in answer["stiffness"]),
        "A is sound at every epoch": all(row["inside"] for row in sound),
        "B is as stiff as it is at every epoch": all(row["inside"] for row in worn),
        "control: half of B's fall is outside at the end": not worn[-1]["half_the_fall_inside"],
        "B alone raises an alarm": [alarm["stage"] for alarm in alarms] == ["bench-B"],
        "A has no end in sight": left["bench-A"]["probability_beyond_horizon"] > 0.9,
        "B's end is inside its interval": last["rul_km_q05"] <= end <= last["rul_km_q95"],
    }


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that the results for both machines are correct, and the output is as shown."""
    rows, left, passed = answer["stiffness"], answer["remaining"], answer["passed"]
    lines = [line for step in answer["steps"] for line in step["commands"]]
    yield Claim(
        "commands of the tutorial with the documented output",
        f"{len(lines)} of {len(lines)}" if passed["what is shown comes out"] else "not all",
        met=passed["what is shown comes out"],
    )
    yield counted(
        "epochs of a real coupling (one recording cut into logs, its loss a false sample "
        "rate) inside their 90 % intervals",
        sum(row["inside"] for row in rows),
        len(rows),
        "half the loss: outside at the end",
        met=all(row["inside"] for row in rows)
        and passed["control: half of B's fall is outside at the end"],
    )
    worn = left["bench-B"]
    yield Claim(
        "hours until the one made to lose reaches its limit",
        number(worn["rul_km_q50"]),
        f"{number(worn['rul_km_q05'])} to {number(worn['rul_km_q95'])} (90 %)",
        f"{number(left['true_of_bench-B_h'])} if it goes on",
        passed["B's end is inside its interval"],
    )


if __name__ == "__main__":
    main()
