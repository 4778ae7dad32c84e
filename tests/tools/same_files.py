"""Compare tables, pages and terminal output with those of an earlier revision, to the byte.

``python -m tests.tools.same_files --before REVISION`` simulates a life of 12 logs. Both revisions
run it, and print what the other commands find in its first log and tables, in every format. Files
and answers must be equal; of pages the white space between tags is left out. It takes about ten
minutes. `same_numbers` is for changes that write the same numbers otherwise.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from itertools import product
from pathlib import Path

from studies.harness.checkout import ROOT, checkout
from tests.tools.same_numbers import call

# The store holds the time of a run.
_SKIPPED = (".sqlite", ".sqlite-wal", ".sqlite-shm")
_FORMATS = ("table", "csv", "json")


def main() -> None:
    """Run both revisions, print what differs, and exit with 1 if anything does."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--before", required=True, help="revision to compare with")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary).resolve()
        with checkout(chosen.before, folder / "code") as old:
            call(old, "models", "simulate", "lms-y", "--life", "both", "--logs", "12",
                 "--seconds", "20", "--seed", "3", "--out", folder / "logs")  # fmt: skip
            call(old, "models", "sweep", "lms-y", "--out", folder / "sweep.h5")
            # Both write to the same folder, because answers contain paths.
            for name, code in (("before", old), ("after", ROOT)):
                answer(folder / "out", folder, code)
                (folder / "out").rename(folder / name)
        found = differences(folder / "before", folder / "after")
    print("\n".join(found) or "All files are equal.")
    sys.exit(bool(found))


def answer(out: Path, inputs: Path, code: Path) -> None:
    """Let a revision write its files and answers."""
    out.mkdir()
    run = out / "run"
    stage = ["--stage", "lms-y"]
    call(code, "lmshealth", "run", inputs / "logs", *stage, "--out", run, out=out / "run.txt")
    log = min((inputs / "logs").glob("*.h5"))
    ends = ["--input", "current_excitation", "--output", "acc_pitch", "--band", "95", "175"]
    answers: dict[str, list[str | Path]] = {
        "modes": ["modes", log, *stage],
        "found": ["modes", log, "--band", "80", "200", "--shapes"],
        "error": ["error", log],
        "spectrum": ["spectrum", log, *stage],
        "frf": ["frf", inputs / "sweep.h5", *ends],
        "stage": ["stage", "lms-y"],
        "plan": ["plan", *stage, "--detect", "guide_preload=0.05"],
    }
    for (name, words), style in product(answers.items(), _FORMATS):
        if style != "csv" or name not in ("stage", "plan"):
            made = out / f"{name}_{style}.txt"
            call(code, "lmshealth", *words, "--format", style, out=made)
    call(code, "lmshealth", "modes", log, *stage, "--plot", out / "modes.html")
    for command, table, more in (
        ("track", "modes", ["--smooth", "--events", out / "events.csv"]),
        ("infer", "track", ["--epochs", "4"]),
        ("prognose", "modes", ["--by", "2030-03-01"]),
    ):
        words = [command, run / f"{table}.csv", *stage, "--out", out / f"{command}.csv", *more]
        call(code, "lmshealth", *words, out=out / f"{command}.txt")


def differences(before: Path, after: Path) -> list[str]:
    """Return the names of files that differ, or are in one folder only."""
    names = {
        path.relative_to(folder).as_posix()
        for folder in (before, after)
        for path in folder.rglob("*.*")
        if path.is_file() and path.suffix not in _SKIPPED
    }
    return [name for name in sorted(names) if _content(before / name) != _content(after / name)]


def _content(path: Path) -> bytes | None:
    if not path.is_file():
        return None
    content = path.read_bytes()
    if path.suffix == ".html":
        content = re.sub(rb">\s+", b">", re.sub(rb"\s+<", b"<", content))
    return content


if __name__ == "__main__":
    main()
