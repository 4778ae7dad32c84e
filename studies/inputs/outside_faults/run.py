"""Which faulty inputs of others are accepted in silence, lost, or end the program?

Method
    Every case of the modules beside this one is an input with one fault (a wrong sample rate, a
    wrapped counter, a date of the year 9999, a closed standard output, ...) and its control, the
    same input without the fault. Each is given to the program before the faults were closed
    (``--before``, checked out into a temporary worktree) and to the program as it is. A case
    passes where the faulty input is answered as stated under "right" and the control is answered
    without refusal or flag.

Run time
    Half an hour for both revisions, two cases at a time; ``--quick`` gives each sixth case to the
    present one.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from studies.harness.checkout import ROOT, checkout
from studies.harness.claims import Claim
from studies.harness.study import Row, Study, real_data
from studies.inputs.outside_faults.case import Case, Program

SCRIPTS = ("run", "case", "no_logs")

EACH = 6  # of the cases of the quick form
SIDES = ("fault", "control")
Answer = Sequence[Any]  # whether it is right, and its text
# By revision; the present program has no name.
PROGRAMS = {"": Program(ROOT)}
# Modules beside this one, each with its CASES.
KINDS = tuple(
    path.stem for path in sorted(Path(__file__).parent.glob("*.py")) if path.stem not in SCRIPTS
)


def main() -> None:
    """Give all cases to both revisions."""
    study = Study(__file__, __doc__, before="e0d0b2d", only="")
    real_data()  # some inputs are there
    chosen = [one.name for one in cases() if study.options.only in f"{one.kind}: {one.name}"]
    chosen = chosen[::EACH] if study.quick else chosen
    # Each call is a process of its own, so that threads do.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        ask = partial(study.trials.collect, answer, pool=pool)
        present = ask([(name, side, "") for name in chosen for side in SIDES])
        now = dict(zip(chosen, zip(present[::2], present[1::2], strict=True), strict=True))
        before: dict[str, Answer] = dict.fromkeys(chosen, (False, ""))
        if not study.quick:
            revision = study.options.before
            with TemporaryDirectory() as folder, checkout(revision, Path(folder) / "code") as code:
                PROGRAMS[revision] = Program(code)
                found = ask([(name, "fault", revision) for name in chosen])
                before = dict(zip(chosen, found, strict=True))
    rows = [_row(one, *now[one.name], before[one.name]) for one in cases() if one.name in now]
    study.conclude(
        {
            "cases": len(rows),
            "right_before": sum(row["right_before"] for row in rows),
            "right": sum(row["right_now"] for row in rows),
            "controls_right": sum(row["control_right"] for row in rows),
            "passed": {row["case"]: row["right_now"] and row["control_right"] for row in rows},
        },
        details={"rows": rows},
    )


def cases() -> list[Case]:
    """Return all cases, in the order of their kinds."""
    modules = (import_module(f"studies.inputs.outside_faults.{kind}") for kind in KINDS)
    return [case for module in modules for case in module.CASES]


def answer(name: str, side: str, revision: str) -> tuple[bool, str]:
    """Give one side of a case to a program in a new folder; never raises."""
    case = next(one for one in cases() if one.name == name)
    with TemporaryDirectory() as folder:
        try:
            right, text = getattr(case, side)(PROGRAMS[revision], Path(folder))
        except Exception as error:  # an older program may answer in a way that a case cannot read
            right, text = False, f"{type(error).__name__}: {error}"
    print(name, side, revision, bool(right), text, sep=" | ", file=sys.stderr)
    return bool(right), text[:200]


def _row(case: Case, fault: Answer, control: Answer, before: Answer) -> Row:
    """Return the row of the table of one case."""
    return {
        "kind": case.kind,
        "case": case.name,
        "right": case.right,
        "before": _without_folders(before[1]),
        "right_before": before[0],
        "now": _without_folders(fault[1]),
        "right_now": fault[0],
        "control": _without_folders(control[1]),
        "control_right": control[0],
    }


def _without_folders(text: str) -> str:
    """Return an answer with the names of files, without the folders of this computer."""
    return re.sub(r"(?:/[\w.\-]+)+/(?=[\w.])", "", text)


def claims(record: Row) -> list[Claim]:
    """Claim the right answer to every case, beside the code before."""
    found = []
    for kind in KINDS:
        rows = [row for row in record["rows"] if row["kind"] == kind]
        right, before, controls = (
            sum(row[key] for row in rows) for key in ("right_now", "right_before", "control_right")
        )
        found.append(
            Claim(
                f"faulty inputs answered right: {kind}",
                f"{right} of {len(rows)}",
                "",
                f"{before} before; controls {controls} of {len(rows)}",
                right == controls == len(rows),
            )
        )
    return found


if __name__ == "__main__":
    main()
