"""Compare the numbers that the program computes with those of an earlier revision of it.

``python -m tests.tools.same_numbers --before REVISION`` checks the earlier revision out into a
temporary worktree. Its simulated stages write a life of logs with all their faults, an FRF log and
a log with stops. Then both revisions run the same commands on the same files: `run` with its
tables, `modes` (ambient, found without a description, after stops), `spectrum`, `error`, `frf`,
`track` and `infer` and `prognose` from a table of another program, `stage`, `plan`, and those of
the simulated stages. Every cell of every table and every number of every JSON answer is compared:
numbers to 1e-9 relative, texts to the letter. Where wording was changed on purpose, texts are
counted and are no difference. It takes about 10 minutes for both revisions; ``--quick`` takes a
twelfth of the logs.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from studies.harness.checkout import ROOT, checkout

Row = dict[str, Any]

TOLERANCE = 1e-9
# Columns and keys that hold sentences for people, whose wording may change.
WORDING = ("why", "detail", "reason_detail", "text", "note", "notes", "sentence", "findings")
# Names of run-time products that are no result.
SKIPPED = ("lmshealth.sqlite",)


def main() -> None:
    """Run both revisions, print what differs, and exit with 1 if anything does."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--before", required=True, help="revision to compare with")
    parser.add_argument("--keep", default="", help="folder of inputs and earlier answers to keep")
    parser.add_argument("--quick", action="store_true", help="a twelfth of the logs")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(chosen.keep or temporary).resolve()
        with checkout(chosen.before, folder / "code") as old:
            if not (folder / "before").exists():
                make_inputs(folder / "inputs", old, quick=chosen.quick)
                answer_all(folder / "before", folder / "inputs", old)
        answer_all(Path(temporary) / "after", folder / "inputs", ROOT)
        found = compare(folder / "before", Path(temporary) / "after")
    print(json.dumps({"before": chosen.before, **found}, indent=1))
    sys.exit(bool(found["different"]))


def call(code: Path, *arguments: str | Path, out: Path | None = None) -> None:
    """Run a module of a revision; keep its standard output in a file."""
    command = [sys.executable, "-m", *map(str, arguments)]
    env = {**os.environ, "PYTHONPATH": str(code), "COLUMNS": "200", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=code, env=env, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 3):
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr}")
    if out is not None:
        out.write_text(done.stdout, encoding="utf-8")


def make_inputs(folder: Path, code: Path, *, quick: bool) -> None:
    """Write the logs and the foreign table that both revisions read."""
    folder.mkdir(parents=True)
    logs, seconds = ("6", "10") if quick else ("40", "20")
    faults = [word for name in ("mains-hum", "dropped-samples", "dead-channel")
              for word in ("--fault", name)]  # fmt: skip
    for name, stage, life, extra in (
        ("demo", "lms-y", "both", []),
        ("faults", "lms-x", "preload-wear", faults),
        ("crash", "lms-y", "crash", []),
    ):
        call(code, "models", "simulate", stage, "--life", life, "--logs", logs, "--seconds",
             seconds, "--seed", "3", "--out", folder / name, *extra)  # fmt: skip
    call(code, "models", "sweep", "lms-y", "--out", folder / "sweep.h5")
    call(code, "models", "velocities", "lms-y", "--velocity", "100", "--velocity", "400",
         "--strokes", "3", "--seconds", "12", "--out", folder / "moves")  # fmt: skip
    # A table of another program: no names of modes, no covariances, five modes that drift.
    rows = ["stage,log,recorded_at,travel_km,temperature_c,frequency_hz,frequency_std_hz,"
            "damping_ratio,damping_ratio_std"]  # fmt: skip
    for k in range(40 if not quick else 10):
        for i, f in enumerate((101.0, 117.0, 126.5, 136.6, 160.0)):
            shift = 1e-3 * math.sin(1.7 * k + i) - 2e-4 * k * (i % 2)
            rows.append(
                f"m,log{k:03d},2026-01-{1 + k % 28:02d}T{6 + k // 28:02d}:00:00+00:00,{10 * k},"
                f"{21 + 2 * math.sin(k):.3f},{f * (1 + shift):.6f},0.05,"
                f"{0.015 * (1 + 0.05 * math.cos(3.1 * k + i)):.6f},0.0006"
            )
    (folder / "foreign.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def answer_all(out: Path, inputs: Path, code: Path) -> None:
    """Let one revision answer everything."""
    out.mkdir(parents=True, exist_ok=True)
    epochs = ["--epochs", "5"]
    for name, stage in (("demo", "lms-y"), ("faults", "lms-x"), ("crash", "lms-y")):
        call(
            code, "lmshealth", "run", inputs / name, "--stage", stage, "--out", out / name, *epochs
        )
    first = sorted((inputs / "demo").glob("*.h5"))[0]
    moves = sorted((inputs / "moves").glob("*.h5"))
    answers: dict[str, list[str | Path]] = {
        "modes": ["modes", first, "--stage", "lms-y"],
        "modes_found": ["modes", first, "--band", "80", "200"],
        "modes_settling": ["modes", *moves, "--stage", "lms-y", "--part", "settling"],
        "spectrum": ["spectrum", *moves, "--stage", "lms-y"],
        "error": ["error", *moves],
        "frf": ["frf", inputs / "sweep.h5", "--input", "current_excitation", "--output",
                "acc_pitch", "--band", "95", "175"],
        "stage": ["stage", "lms-y"],
        "stage_x": ["stage", "lms-x"],
        "plan": ["plan", "--stage", "lms-y", "--detect", "guide_preload=0.05"],
    }  # fmt: skip
    for name, words in answers.items():
        call(code, "lmshealth", *words, "--format", "json", out=out / f"{name}.json")
    modes, track = out / "demo" / "modes.csv", out / "track_of_table.csv"
    call(code, "lmshealth", "track", inputs / "foreign.csv", "--out", out / "foreign.csv",
         "--effects", out / "effects_foreign.csv",
         "--events", out / "events_foreign.csv")  # fmt: skip
    call(code, "lmshealth", "track", modes, "--stage", "lms-y", "--out", track)
    call(code, "lmshealth", "infer", track, "--stage", "lms-y", "--out", out / "health.csv")
    call(code, "lmshealth", "prognose", modes, "--stage", "lms-y", "--out", out / "prognosis.csv")
    for stage in ("lms-x", "lms-y"):
        call(code, "models", "modes", stage, "--format", "json", out=out / f"models_{stage}.json")
        call(code, "models", "map", stage, "--out", out / f"map_{stage}.csv")
    call(code, "models", "simulate", "lms-y", "--life", "crash", "--logs", "2", "--seconds", "2",
         "--seed", "5", "--format", "csv", "--out", out / "simulated")  # fmt: skip


def compare(before: Path, after: Path) -> Row:
    """Compare all tables and answers of two folders."""
    names = {p.relative_to(before).as_posix() for p in before.rglob("*.*")}
    names = {n for n in names if n.endswith((".csv", ".json")) and Path(n).name not in SKIPPED}
    cells, worst, wording, different = 0, 0.0, 0, []
    for name in sorted(names):
        if not (after / name).exists():
            different.append(f"{name}: missing")
            continue
        old, new = dict(_values(before / name)), dict(_values(after / name))
        different += [f"{name}: {key} missing" for key in old.keys() - new.keys()][:5]
        for key in old.keys() & new.keys():
            cells += 1
            gap = _gap(old[key], new[key])
            if gap <= TOLERANCE:
                worst = max(worst, gap)
            elif math.isinf(gap) and _is_wording(key):
                wording += 1
            else:
                different.append(f"{name}: {key}: {old[key]!r} was, {new[key]!r} is")
    return {
        "files": len(names), "cells": cells, "worst_relative_difference": worst,
        "cells_of_wording_that_changed": wording, "different": sorted(different)[:50],
        "n_different": len(different),
    }  # fmt: skip


def _is_wording(key: str) -> bool:
    return any(part in WORDING for part in key.replace("[", ".").replace("]", "").split("."))


def _gap(old: Any, new: Any) -> float:
    """Relative difference of two cells; infinite where texts differ."""
    try:
        a, b = float(old), float(new)
    except (TypeError, ValueError):
        return 0.0 if old == new else math.inf
    if a == b or (math.isnan(a) and math.isnan(b)):
        return 0.0
    return abs(a - b) / max(abs(a), abs(b))


def _values(path: Path) -> Iterator[tuple[str, Any]]:
    """Every cell of a table or number of a JSON answer, each with where it stands."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".json":
        yield from _leaves("", json.loads(text))
        return
    for k, row in enumerate(csv.DictReader(text.splitlines())):
        for column, value in row.items():
            yield f"{k}.{column}", value


def _leaves(place: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(f"{place}.{key}", inner)
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from _leaves(f"{place}[{k}]", inner)
    else:
        yield place, value


if __name__ == "__main__":
    main()
