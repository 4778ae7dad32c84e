"""Write `README.md` beside this file: all claims of the studies, as they were recorded.

``python -m studies.summary`` does it, and nothing else writes that page.
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

from studies.claims import STEPS, Claim, Older

HERE = Path(__file__).parent
PAGE = HERE / "README.md"
_DIGITS = 12  # of the digest of a record that is older than a mend
_HEAD = """\
# What the studies claim

Written by `python -m studies.summary` from the records beside the scripts; no figure is typed. Each
claim stands with how sure it is, and with what stands beside it in the same run: a peer, a bound,
what was asked, or a control that must be found out. A study is run by its script, `--quick` for
its short form. What a long one has done is kept in `studies/.kept`, by the code that it depends on:
interrupted, it goes on, and with other code it begins anew. What the tests hold at every run, as
`tests/stage/test_identifiability.py` does for `stage`, has no record.
"""


@dataclass(frozen=True, slots=True)
class Record:
    """A record of a study, or the place of one that is not recorded.

    Attributes
    ----------
    study, name : str
        Folder, and the record in it without its suffix.
    step : str
        Of the chain.
    older : Older or None
        What was mended since it was recorded.
    content : dict or None
        The record; None if there is none.
    claims : tuple of Claim
        What it claims.
    """

    study: str
    name: str
    step: str
    older: Older | None
    content: dict[str, Any] | None
    claims: tuple[Claim, ...]

    @property
    def script(self) -> str:
        """Name the script that records it."""
        own = f"{self.name}.py"
        return own if (HERE / self.study / own).exists() else "run.py"


def records() -> Iterator[Record]:
    """Find all records that studies claim something of, whether they are there or not."""
    for path in sorted(HERE.glob("*/claims.py")):
        study = path.parent.name
        module = import_module(f"studies.{study}.claims")
        names = [name for name, own in vars(module).items() if _is_of(own, module.__name__)]
        for name in names:
            yield _record(module, study, name)


def _is_of(own: Any, module: str) -> bool:
    return callable(own) and own.__module__ == module and not own.__name__.startswith("_")


def _record(module: Any, study: str, name: str) -> Record:
    path = HERE / study / f"{name}.json"
    if not path.exists():
        return Record(study, name, module.STEP, None, None, ())
    text = path.read_bytes()
    older = getattr(module, "OLDER", {}).get(name)
    # The note ends with the record that it is of.
    if older and hashlib.sha256(text).hexdigest()[:_DIGITS] != older.digest:
        older = None
    content = json.loads(text)
    claims = tuple(getattr(module, name)(content))
    return Record(study, name, module.STEP, older, content, claims)


def page() -> str:
    """Give the page."""
    found = list(records())
    there = [record for record in found if record.content is not None]
    claims = [claim for record in there for claim in record.claims]
    short = sum(not claim.met for claim in claims)
    lines = [
        _HEAD,
        f"{len(claims)} claims of {len(there)} records; **{short} are not met** and say so.",
    ]
    if missing := [f"{r.study}/{r.name}" for r in found if r.content is None]:
        lines.append(f"Not recorded: {', '.join(missing)}.")
    for step in STEPS:
        lines += ["", f"## {step[0].upper()}{step[1:]}"]
        for record in found:
            if record.step == step:
                lines += ["", *section(record)]
    return "\n".join(lines) + "\n"


def section(record: Record) -> Iterator[str]:
    """Give the lines of one record."""
    title = record.study if record.name == "result" else f"{record.study}, {record.name}"
    script = f"[{record.script}]({record.study}/{record.script})"
    yield f"### {title}"
    yield ""
    if record.content is None:
        yield f"{question(record)} **Not recorded**: {script} has not been run in full."
        return
    made = record.content["recorded"]
    told = f"[{record.name}.json]({record.study}/{record.name}.json)"
    yield (
        f"{record.content['question']} Recorded {made['date']} in {_duration(made)} by {script}: "
        f"{told}."
    )
    if record.older:
        yield f"**Recorded before {record.older.why}.**"
    yield ""
    yield "| claim | figure | how sure | beside it | |"
    yield "| --- | --- | --- | --- | --- |"
    for claim in record.claims:
        cells = (claim.what, claim.figure, claim.interval, claim.beside)
        met = "" if claim.met else "**not met**"
        yield f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} | {met} |"
    reasons = record.content.get("not_met", {})
    for name, fine in record.content.get("passed", {}).items():
        if not fine:
            why = f": {reasons[name]}" if isinstance(reasons, dict) and name in reasons else ""
            yield from ("", f"Not so: *{name}*{why}.")


def question(record: Record) -> str:
    """Give the question of a script."""
    tree = ast.parse((HERE / record.study / record.script).read_text(encoding="utf-8"))
    return (ast.get_docstring(tree) or "").split("\n")[0]


def _duration(made: dict[str, Any]) -> str:
    """Tell the run time; after an interruption with that of what was done before."""
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
