"""Record all studies in full, one after the other: ``make studies FULL=1``.

A study whose record was made by the code that it has now is not run again, unless a check failed
for which the study has no reason (``NOT_MET``), and trials of an interrupted study are kept
(`studies.harness.study`). A study that fails does not stop the others; the exit status is then 1.
What studies print is in ``studies/.kept``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from runpy import run_path

from studies.harness.provenance import PROJECT, code_of_script
from studies.harness.study import KEPT, record_of
from studies.harness.summary import GROUPS

_RECORDS = "Study(__file__"


def scripts(root: Path, groups: Sequence[str]) -> Iterator[tuple[Path, str]]:
    """Yield the scripts that record, in the order of the groups, with their names as modules."""
    for group in groups:
        for path in sorted((root / group).rglob("*.py")):
            if _RECORDS in path.read_text(encoding="utf-8"):
                yield path, ".".join(path.relative_to(root.parent).with_suffix("").parts)


def is_fresh(script: Path) -> bool:
    """Return whether a record, without a failed check that has no reason, is of today's code."""
    path = record_of(script)
    made = json.loads(path.read_text(encoding="utf-8"))["recorded"] if path.exists() else {}
    # Records of earlier versions have no digest.
    return (
        "code" in made
        and not unexplained(script, made["failed"])
        and made["code"] == code_of_script(script, made["also"])
    )


def unexplained(script: Path, failed: Sequence[str]) -> set[str]:
    """Return the failed checks of a record for which its study has no reason."""
    # Most records have none: their studies are not imported.
    return set(failed) - set(run_path(str(script)).get("NOT_MET", ())) if failed else set()


def run_all(root: Path, groups: Sequence[str], kept: Path = KEPT) -> list[str]:
    """Run the studies of groups in a folder whose records are not fresh; return what failed."""
    failed = []
    kept.mkdir(parents=True, exist_ok=True)
    for script, module in scripts(root, groups):
        if is_fresh(script):
            print(f"{module}: recorded by the same code", flush=True)
            continue
        start, log = time.perf_counter(), kept / f"{module}.txt"
        with log.open("w", encoding="utf-8") as file:
            command = [sys.executable, "-m", module]
            done = subprocess.run(command, cwd=root.parent, stdout=file, stderr=file, check=False)
        minutes = f"{(time.perf_counter() - start) / 60:.1f} min"
        if done.returncode:
            failed.append(module)
        how = f"FAILED, see {log}" if done.returncode else "done"
        print(f"{module}: {how}, {minutes}", flush=True)
    return failed


def main() -> int:
    """Record all studies, then write the pages of all records."""
    failed = run_all(PROJECT / "studies", GROUPS)
    pages = subprocess.run([sys.executable, "-m", "studies.harness.summary"], check=False)
    print(f"{len(failed)} studies failed: {', '.join(failed)}" if failed else "All are recorded.")
    return int(bool(failed) or pages.returncode != 0)


if __name__ == "__main__":
    sys.exit(main())
