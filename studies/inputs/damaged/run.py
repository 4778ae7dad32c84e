"""Is every good log of an archive analysed, and every damaged one listed with the right reason?

Method
    Four simulated recordings are written a thousand times, each with a thousandth of fresh noise
    and the next moment of a machine's life, in seven formats in turn. Among them are damaged logs
    of every kind in `KINDS` of `kinds.py`, which states the reason of each, once in each format
    that can be damaged so. One `lmshealth run` with two workers. Damage of a channel
    or a stretch must leave the rest of its log analysed. Damage that no file shows is left out:
    flipped bits without a checksum, text cut between rows or inside the last number. The exit
    status must report refused logs, and standard error must be empty. Controls: a good log
    expected to be bad, a bad one expected to be good, and a wrong reason must be detected.
Run time
    Ten minutes on two processors.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from studies.harness.claims import Claim, controls_seen, counted
from studies.harness.study import Row, Study
from studies.inputs.damaged import logfiles
from studies.inputs.damaged.kinds import KINDS
from studies.inputs.damaged.logfiles import MACHINES, SUFFIXES

N_GOOD, N_GOOD_QUICK, N_BASES = 1000, 8, 4
_SEED = 20261122
# Of the quick form: every so many of the kinds, each in one format, without those that swell, and
# so many machines.
_EVERY, _FEW = 4, 2
_GOOD = "good"


@dataclass(frozen=True, slots=True)
class Expected:
    """What is to become of a log, or of a row: its name, its kind, the reason, if all is lost."""

    name: str
    kind: str
    reason: str
    lost: bool


@dataclass(frozen=True, slots=True)
class Found:
    """Results of the run for all logs."""

    # By log, the reasons for which all of it and a channel of it is refused
    whole: defaultdict[str, set[str]]
    partly: defaultdict[str, set[str]]
    analysed: set[str]  # Logs with a mode in ``modes.csv``

    def reason(self, expected: Expected) -> str:
        """Tell in one word what became of a log."""
        whole = self.whole[expected.name]
        if whole or expected.lost:
            return " and ".join(sorted(whole)) or "not refused"
        if expected.name not in self.analysed:
            return "not analysed"
        partly = " and ".join(sorted(self.partly[expected.name]))
        return partly if expected.reason != _GOOD else _GOOD


def main() -> None:
    """Run the study; ``--quick`` does a part of it and records nothing."""
    study = Study(__file__, __doc__)
    quick = study.quick
    with tempfile.TemporaryDirectory(prefix="damaged-") as folder:
        expected = make_archive(Path(folder), quick)
        command = [sys.executable, "-m", "lmshealth", "run", "logs", "--stage", "stage.toml",
                   "--out", "out", "--workers", "1" if quick else "2"]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
        answer = judge(expected, read_found(Path(folder) / "out"), done)
    study.conclude(answer)


def make_archive(folder: Path, quick: bool) -> list[Expected]:
    """Write the logs, good and bad ones mixed over the lives of the machines."""
    archive = logfiles.Archive(folder / "logs")
    archive.folder.mkdir()
    (folder / "stage.toml").write_text(logfiles.DESCRIPTION)
    bases = logfiles.recordings(1 if quick else N_BASES)
    damages = list(chosen(quick))
    n = len(damages) + (N_GOOD_QUICK if quick else N_GOOD)
    # No damage at either end of a life: an odometer is contradicted by what comes after.
    places = np.linspace(0.1 * n, 0.9 * n, len(damages)).astype(int).tolist()
    damaged = dict(zip(places, damages, strict=True))
    expected = []
    for k in range(n):
        rng = np.random.default_rng([_SEED, k])
        number = len(MACHINES) * (k // _FEW) + k % _FEW if quick else k
        log = logfiles.log_of(bases[k % len(bases)], number, rng)
        kind, suffix = damaged.get(k, (None, SUFFIXES[k % len(SUFFIXES)]))
        path = archive.folder / f"log-{k:04d}{suffix}"
        if kind is None:
            logfiles.write(archive, path, log)
            expected.append(Expected(path.name, _GOOD, _GOOD, False))
        else:
            name = kind.make(archive, path, log, rng)
            expected.append(Expected(name, kind.name, kind.reason, kind.lost))
    archive.close()
    return expected


def chosen(quick: bool) -> Iterator[tuple[Any, str]]:
    """Return kinds of damage with the format that each happens to."""
    for k, kind in enumerate(KINDS):
        if not quick:
            yield from ((kind, suffix) for suffix in kind.suffixes)
        elif k % _EVERY == 0 and kind.reason != "too-large":
            yield kind, kind.suffixes[k // _EVERY % len(kind.suffixes)]


def read_found(out: Path) -> Found:
    """Read what the run wrote."""
    refused = pd.read_csv(out / "refused.csv", dtype=str, keep_default_na=False)
    # The manifest lists few of the logs: a notice, with which a log is analysed all the same.
    refused = refused[refused["reason"] != "not-listed"]
    modes = pd.read_csv(out / "modes.csv", dtype=str, keep_default_na=False)
    found = Found(defaultdict(set), defaultdict(set), set(modes["log"]))
    columns = refused[["log", "detail", "mode", "channel", "reason"]]
    for log, detail, mode, channel, reason in columns.to_numpy().tolist():
        # Rows of a table have no name of their own but their line.
        in_table = log in ("manifest.csv", "maintenance.csv")
        name = f"{log}, {detail.split(':')[0]}" if in_table else log
        if not mode:
            (found.partly if channel else found.whole)[name].add(reason)
    return found


def wrong(expected: Sequence[Expected], found: Found) -> list[str]:
    """List what became of logs otherwise than expected, and what nobody expected at all."""
    other = [
        f"{one.name} ({one.kind}): {found.reason(one)}, expected {one.reason}"
        for one in expected
        if found.reason(one) != one.reason
    ]
    known = {one.name for one in expected}
    refused = {name for name, reasons in found.whole.items() if reasons}
    return other + [f"{name}: not expected at all" for name in sorted(refused - known)]


def judge(
    expected: Sequence[Expected], found: Found, done: subprocess.CompletedProcess[str]
) -> Row:
    """Compare what was found with what is right."""
    other = wrong(expected, found)
    counts = Counter((one.kind, found.reason(one)) for one in expected)
    good = next(one for one in expected if one.kind == _GOOD)
    bad = next(one for one in expected if one.lost)
    controls = {
        "a good log said to be bad": [replace(good, reason="corrupt", lost=True)],
        "a bad log said to be good": [replace(bad, reason=_GOOD, lost=False)],
        "another reason": [replace(bad, reason="never heard of")],
    }
    caught = {
        name: len(wrong([*expected, *said], found)) == len(other) + 1
        for name, said in controls.items()
    }
    n_good = sum(one.kind == _GOOD for one in expected)
    return {
        "good": n_good,
        "good_analysed": sum(v for (kind, told), v in counts.items() if kind == told == _GOOD),
        "damaged": len(expected) - n_good,
        "damaged_told_right": len(expected) - n_good - sum(f"({_GOOD})" not in o for o in other),
        "kinds": len({one.kind for one in expected}) - 1,
        "reasons": sorted({one.reason for one in expected} - {_GOOD}),
        "exit_status": done.returncode,
        "standard_error": done.stderr[-2000:],
        "wrong": other[:50],
        "controls": caught,
        "confusion": [
            {"kind": kind, "reported": told, "logs": count}
            for (kind, told), count in counts.items()
        ],
        "passed": {
            "every log is told right": not other,
            "the exit status says that some were refused": done.returncode == 3,
            "nothing stands on standard error": not done.stderr,
            "no traceback anywhere": "Traceback" not in done.stdout + done.stderr,
            "controls are caught": all(caught.values()),
        },
    }


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that damaged logs are refused, and good ones analysed."""
    yield counted(
        f"damaged logs of {answer['kinds']} kinds refused with the right reason",
        answer["damaged_told_right"],
        answer["damaged"],
        controls_seen(answer["controls"]),
        met=answer["damaged_told_right"] == answer["damaged"],
    )
    yield counted(
        "good logs among them analysed",
        answer["good_analysed"],
        answer["good"],
        met=answer["good_analysed"] == answer["good"],
    )


if __name__ == "__main__":
    main()
