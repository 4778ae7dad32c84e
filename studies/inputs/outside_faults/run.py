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
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path

from studies.harness.checkout import ROOT, checkout
from studies.harness.claims import Claim
from studies.harness.study import Row, Study
from studies.inputs.outside_faults.case import Case, Program, Seen

SCRIPTS = ("run", "case", "figure")

EACH = 6  # of the cases of the quick form
# Modules beside this one, each with its CASES.
KINDS = tuple(
    path.stem for path in sorted(Path(__file__).parent.glob("*.py")) if path.stem not in SCRIPTS
)


def main() -> None:
    """Run all cases with both revisions."""
    study = Study(__file__, __doc__, before="e0d0b2d", only="")
    chosen = [one for one in cases() if study.options.only in f"{one.kind}: {one.name}"]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        chosen = chosen[::EACH] if study.quick else chosen
        now = all_answers(chosen, Program(ROOT), folder / "now")
        before: dict[str, tuple[Seen, Seen]] = {}
        if not study.quick:
            with checkout(study.options.before, folder / "code") as code:
                before = all_answers(chosen, Program(code), folder / "before")
    rows = [_row(one, now[one.name], before.get(one.name)) for one in chosen]
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


def all_answers(chosen: list[Case], program: Program, folder: Path) -> dict[str, tuple[Seen, Seen]]:
    """Give all cases to a program, as many at a time as there are processors."""

    def ask(case: Case) -> tuple[Seen, Seen]:
        found = answers(case, program, folder)
        print(
            *(f"{one.right!s:5} {one.answer}" for one in found),
            case.name,
            sep=" | ",
            file=sys.stderr,
        )
        return found

    with ThreadPoolExecutor(os.cpu_count()) as pool:  # each call is a process
        return dict(zip((one.name for one in chosen), pool.map(ask, chosen), strict=True))


def answers(case: Case, program: Program, folder: Path) -> tuple[Seen, Seen]:
    """Give a case and its control to a program, each in a new folder; never raises."""
    found = []
    for name, ask in (("fault", case.fault), ("control", case.control)):
        own = folder / case.kind / case.name.replace("/", " ") / name
        own.mkdir(parents=True)
        try:
            found.append(ask(program, own))
        except Exception as error:  # an older program may answer in a way that a case cannot read
            found.append(Seen(False, f"{type(error).__name__}: {error}"[:160]))
    return found[0], found[1]


def _row(case: Case, now: tuple[Seen, Seen], before: tuple[Seen, Seen] | None) -> Row:
    """Return the row of the table of one case."""
    return {
        "kind": case.kind,
        "case": case.name,
        "right": case.right,
        "before": before[0].answer if before else "",
        "right_before": bool(before and before[0].right),
        "now": now[0].answer,
        "right_now": bool(now[0].right),
        "control": now[1].answer,
        "control_right": bool(now[1].right),
    }


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
