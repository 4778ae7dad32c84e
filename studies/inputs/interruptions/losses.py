"""What happens to a run whose disk is full, or whose database stops?

Method
    Full disk: output and store, or output alone, on a file system that is too small and grows with
    each run until everything fits. Lost database: PostgreSQL is stopped at a random moment after
    the first log and started before the next run. Each failed run must exit with status 1 and one
    line without the password; the final output must equal that of a run without failure. Control:
    see `kills`.
Answer
    Twelve runs on full disks (six with output and store, six with output alone) and five without
    database report it in one line, without the password; all final outputs are equal.
Run time
    Four to fifteen minutes.
"""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from studies.harness.claims import Claim
from studies.harness.servers import missing_postgres, postgres
from studies.harness.study import Row, Study
from studies.inputs.interruptions import driving
from studies.inputs.interruptions.driving import SOME_REFUSED, Reference, one_line

SEED = 20261122
MACHINES, QUICK_MACHINES = {"WORN-A": 40, "WATCHED-A": 40}, {"WATCHED-A": 4}
# Fractions of the space that output, and store where it is there too, need.
SIZES, QUICK_SIZES = (0.05, 0.2, 0.4, 0.6, 0.75, 0.9, 4.0), (0.4, 4.0)
# Failed runs, and the latest end of the database after the first log, over the time of a run.
LOST, QUICK_LOST = (5, 0.5), (1, 0.0)
Ends = list[tuple[int | None, list[str]]]  # statuses and messages


def main() -> None:
    """Run the study; ``--quick`` does a small part and records nothing."""
    study = Study(__file__, __doc__)
    quick, once = study.quick, partial(study.trials.once, also=driving.PROGRAM)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        machines = QUICK_MACHINES if quick else MACHINES
        reference = driving.reference_of(folder, machines, quick=quick)
        both = partial(full_disk, reference, folder / "both", with_store=True)
        output = partial(full_disk, reference, folder / "output", with_store=False)
        lost = partial(lost_database, reference, quick=quick)
        answer: Row = {
            "seed": SEED,
            "full disk": once(both, QUICK_SIZES if quick else SIZES),
            "full disk, output alone": None if quick else once(output, SIZES),
            "lost database": once(lost, *(QUICK_LOST if quick else LOST)),
        }
    # What this machine does not allow is left out.
    tried = {name: found for name, found in answer.items() if isinstance(found, dict)}
    answer["passed"] = {
        f"{check}, {name}": held
        for name, found in tried.items()
        for check, held in {
            "it did fail": found["failed"] > 0,
            "told in one line": not found["other_ends"],
            "as uninterrupted": not found["differences"],
        }.items()
    }
    study.conclude(answer)


def full_disk(
    reference: Reference, folder: Path, sizes: Sequence[float], *, with_store: bool
) -> Row | None:
    """Run on a file system that is too small, enlarge it and go on; None if none can be made."""
    place, kept = folder / "disk", folder / "kept"
    place.mkdir(parents=True)
    # In a mount namespace of its own: whatever happens, the file system ends with the shell.
    shell = ["unshare", *(["--map-root-user"] if os.geteuid() else []), "--mount", "sh", "-c"]
    tried = subprocess.run([*shell, f"mount -t tmpfs none {place}"], capture_output=True)
    if tried.returncode:
        return None
    store = (place if with_store else folder) / "store.sqlite"
    first = reference.out.parent / "reference.sqlite"
    needing = [*reference.out.iterdir(), *([first] if with_store else [])]
    need = sum(path.stat().st_size for path in needing)
    command = " ".join(reference.command(place / "out", f"sqlite:///{store}"))
    script = f"mount -t tmpfs -o size={need // 100} none {place}\n"
    for k, size in enumerate(sizes):
        script += f"mount -o remount,size={round(size * need)} {place}\n"
        script += f"{command} >/dev/null 2>{folder}/said-{k}; echo $?\n"
    script += f"cp -r {place} {kept}"
    done = subprocess.run([*shell, script], capture_output=True, text=True, check=True)
    ends: Ends = [
        (int(status), (folder / f"said-{k}").read_text().splitlines())
        for k, status in enumerate(done.stdout.split())
    ]
    store = kept / store.name if with_store else store
    differences = reference.judge(kept / "out", f"sqlite:///{store}")
    return {"sizes_of_what_is_needed": sizes, **failures(ends), "differences": differences}


def lost_database(reference: Reference, n: int, latest: float, *, quick: bool) -> Row | None:
    """Stop the database server in the middle of runs, start it, and run again.

    Runs that did not need it any more are not counted, until n have failed.
    """
    if missing_postgres() is not None:
        return None
    rng = random.Random(SEED)
    ends: Ends = []
    differences: list[str] = []
    with postgres() as server:
        while sum(status != SOME_REFUSED for status, _ in ends) < n and len(ends) < 4 * n:
            with server.database() as store, tempfile.TemporaryDirectory() as name:
                command = reference.command(Path(name) / "out", store)
                with driving.running(command) as run:
                    run.begun(store)
                    run.status(rng.uniform(0.0, latest) * reference.seconds)
                    server.stop(signal.SIGQUIT)
                    ends.append((run.status(), run.messages()))
                server.start()
                if any(server.password in line for line in ends[-1][1]):
                    differences.append("the password was shown")
                driving.completed(command, quick=quick)
                differences += reference.judge(Path(name) / "out", store)
    return {"runs": len(ends), **failures(ends), "differences": differences}


def failures(ends: Ends) -> Row:
    """Return messages of failed runs without addresses, and other ends."""
    failed = [messages[0] for status, messages in ends if status == 1 and one_line(messages)]
    other = [
        f"{status}: {messages[-3:]}"
        for status, messages in ends
        if status != SOME_REFUSED and not (status == 1 and one_line(messages))
    ]
    reported = {re.sub(r"\w+:/\S+|'?/\S+", "…", line) for line in failed}
    return {"failed": len(failed), "said": sorted(reported), "other_ends": other}


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that a full disk and a lost database are reported, and lose nothing."""
    for name in ("full disk", "full disk, output alone", "lost database"):
        row = answer[name]
        if row is None:
            yield Claim(name, "not tried: this machine does not allow it", met=False)
            continue
        fine = all(held for what, held in answer["passed"].items() if what.endswith(f", {name}"))
        yield Claim(
            f"{name}: what is not as without it",
            str(len(row["differences"])),
            f"{row['failed']} runs failed",
            "each in one line",
            fine,
        )


if __name__ == "__main__":
    main()
