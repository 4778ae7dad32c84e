"""Write `README.md` of the studies: all claims, as they were recorded.

``python -m studies.harness.summary`` writes the part of that page between its two `MARKS`.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from studies.harness.claims import STEPS, Claim, Older
from studies.harness.study import STUDIES

HERE = STUDIES
PAGE = HERE / "README.md"
MARKS = "<!-- claims -->\n", "<!-- end of claims -->\n"
_DIGITS = 12  # of the digest of a record that is older than a correction


@dataclass(frozen=True, slots=True)
class Record:
    """A record of a study, or the place of a record that does not exist yet."""

    study: str  # folder
    script: str
    name: str  # of the record, without suffix
    step: str  # of the method that it examines
    older: Older | None  # correction since it was recorded
    content: dict[str, Any] | None
    claims: tuple[Claim, ...]  # computed from the content


def records() -> Iterator[Record]:
    """Find the records of all scripts that define claims, whether they exist or not."""
    for path in sorted(HERE.glob("*/*.py")):
        if "\nSTEP = " not in path.read_text(encoding="utf-8"):
            continue
        module = import_module(f"studies.{path.parent.name}.{path.stem}")
        own = "result" if path.stem == "run" else path.stem
        for function in (name for name in vars(module) if name.split("_")[0] == "claims"):
            yield _record(
                module, path, function, function.removeprefix("claims").lstrip("_") or own
            )


def _record(module: Any, script: Path, function: str, name: str) -> Record:
    path, study = script.with_name(f"{name}.json"), script.parent.name
    if not path.exists():
        return Record(study, script.name, name, module.STEP, None, None, ())
    text = path.read_bytes()
    older = getattr(module, "OLDER", {}).get(name)
    # A new record ends the note.
    if older and hashlib.sha256(text).hexdigest()[:_DIGITS] != older.digest:
        older = None
    content = json.loads(text)
    claims = tuple(getattr(module, function)(content))
    return Record(study, script.name, name, module.STEP, older, content, claims)


def page() -> str:
    """Return the page: all claims, and the text around them as it is."""
    head, rest = PAGE.read_text(encoding="utf-8").split(MARKS[0])
    found = list(records())
    there = [record for record in found if record.content is not None]
    claims = [claim for record in there for claim in record.claims]
    short = sum(not claim.met for claim in claims)
    lines = [
        head + MARKS[0],
        f"{len(claims)} claims of {len(there)} records; **{short} are not met**.",
    ]
    if missing := [f"{r.study}/{r.name}" for r in found if r.content is None]:
        lines.append(f"Not recorded: {', '.join(missing)}.")
    for step in STEPS:
        lines += ["", f"## {step[0].upper()}{step[1:]}"]
        for record in found:
            if record.step == step:
                lines += ["", *section(record)]
    return "\n".join(lines) + "\n\n" + MARKS[1] + rest.split(MARKS[1])[1]


def section(record: Record) -> Iterator[str]:
    """Return the lines of one record."""
    title = record.study if record.name == "result" else f"{record.study}, {record.name}"
    script = f"[{record.script}]({record.study}/{record.script})"
    yield f"### {title}"
    yield ""
    if record.content is None:
        yield f"{question(record)} **Not recorded**: {script} has not been run in full."
        return
    made = record.content["recorded"]
    link = f"[{record.name}.json]({record.study}/{record.name}.json)"
    yield f"{question(record)} Recorded {made['date']} in {_duration(made)} by {script}: {link}."
    if record.older:
        yield f"**Recorded before {record.older.why}.**"
    yield ""
    yield "| claim | figure | uncertainty | comparison | |"
    yield "| --- | --- | --- | --- | --- |"
    for claim in record.claims:
        cells = (claim.what, claim.figure, claim.interval, claim.beside)
        met = "" if claim.met else "**not met**"
        yield f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} | {met} |"
    reasons = record.content.get("not_met", {})
    for name, fine in record.content.get("passed", {}).items():
        if not fine:
            why = f": {reasons[name]}" if isinstance(reasons, dict) and name in reasons else ""
            yield from ("", f"Check not met: *{name}*{why}.")


def question(record: Record) -> str:
    """Return the question of a script."""
    tree = ast.parse((HERE / record.study / record.script).read_text(encoding="utf-8"))
    return (ast.get_docstring(tree) or "").split("\n")[0]


def _duration(made: dict[str, Any]) -> str:
    """Format the run time, after an interruption with that of the kept trials."""
    kept = made.get("kept_s", 0.0)
    more = f", after {_time(kept)} before an interruption" if kept else ""
    return _time(made["wall_s"]) + more


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
