"""Write the pages of the studies: all claims, as they were recorded, and their figures.

``python -m studies.harness.summary`` writes what stands between `MARKS` in ``studies/README.md``,
one line a record, and in the page of each group, all claims of its records, and the figure of each
record with enough shares. ``FRONT_PAGE.md`` has the statements of the front page (`front_page`),
``PEERS.md`` other programs (`peers`).
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from studies.harness import front_page, peers
from studies.harness.claims import Claim
from studies.harness.figures import draw, shown
from studies.harness.study import STUDIES, record_of

HERE = STUDIES
GROUPS = ("inputs", "modes", "track", "health", "life", "robustness", "paper", "cost")
MARKS = "<!-- claims -->\n", "<!-- end of claims -->\n"


@dataclass(frozen=True, slots=True)
class Record:
    """A record of a study, or the place of a record that does not exist yet."""

    script: Path
    question: str
    content: dict[str, Any] | None
    claims: tuple[Claim, ...]  # computed from the content

    @property
    def path(self) -> Path:
        """Return the file of the record."""
        return record_of(self.script)

    @property
    def figure(self) -> Path:
        """Return the file of the figure."""
        return self.path.with_suffix(".svg")

    @property
    def title(self) -> str:
        """Return the name of the study, and of its part where it has several scripts."""
        _, *names = self.script.relative_to(HERE).with_suffix("").parts
        return ", ".join(name.replace("_", " ") for name in names if name != "run")

    @property
    def command(self) -> str:
        """Return the command that records."""
        parts = self.script.relative_to(HERE).with_suffix("").parts
        return f"python -m {'.'.join(('studies', *parts))}"


def records(group: str) -> list[Record]:
    """Find the records of all scripts of a group that have claims, whether they exist or not."""
    found = []
    for script in sorted((HERE / group).rglob("*.py")):
        text = script.read_text(encoding="utf-8")
        if "\ndef claims(" not in text:
            continue
        question = (ast.get_docstring(ast.parse(text)) or "").split("\n")[0]
        if record_of(script).exists():
            content = json.loads(record_of(script).read_text(encoding="utf-8"))
            parts = script.relative_to(HERE).with_suffix("").parts
            module = import_module(".".join(("studies", *parts)))
            # Reasons of checks that are not met may be found after the record was made.
            reasons = content.get("not_met", {})
            if isinstance(reasons, dict):
                content["not_met"] = {**reasons, **getattr(module, "NOT_MET", {})}
            found.append(Record(script, question, content, tuple(module.claims(content))))
        else:
            found.append(Record(script, question, None, ()))
    return found


def between_marks(page: Path, lines: Sequence[str]) -> str:
    """Return a page with other lines between its marks."""
    head, rest = page.read_text(encoding="utf-8").split(MARKS[0])
    return "\n".join([head + MARKS[0], *lines, "", MARKS[1]]) + rest.split(MARKS[1])[1]


def overview() -> str:
    """Return the page of all studies: one line a record."""
    found = [(group, record) for group in GROUPS for record in records(group)]
    there = [record for _, record in found if record.content is not None]
    claims = [claim for record in there for claim in record.claims]
    lines = [
        f"{len(claims)} claims of {len(there)} records; "
        f"**{sum(not claim.met for claim in claims)} are not met**. Of {len(found)} studies "
        f"{len(found) - len(there)} have no record: they are new, or their code was corrected.",
        "",
        "| study | question | answer: the first claim | claims | not met | recorded |",
        "| --- | --- | --- | ---: | ---: | --- |",
    ]
    for group, record in found:
        link = f"[{group}/{record.title}]({group}/README.md#{anchor(record)})"
        if record.content is None:
            lines.append(row([link, record.question, "", "", "", "no"]))
            continue
        first, n = record.claims[0], len(record.claims)
        interval = f"; {first.interval}" if first.interval else ""
        short = sum(not claim.met for claim in record.claims)
        made = record.content["recorded"]["date"]
        answer = f"{first.what}: {first.figure}{interval}"
        lines.append(row([link, record.question, answer, str(n), str(short), made]))
    return between_marks(HERE / "README.md", lines)


def statements() -> str:
    """Return the page of the statements of the front page."""
    found = {}
    for group in GROUPS:
        for record in records(group):
            name = record.script.relative_to(HERE).with_suffix("").as_posix().removesuffix("/run")
            address = f"{group}/README.md#{anchor(record)}"
            found[name] = front_page.Support(record.claims, record.command, address)
    return between_marks(HERE / "FRONT_PAGE.md", list(front_page.lines(found)))


def other_programs() -> str:
    """Return the page of other programs on the same records, series and lives."""
    return between_marks(HERE / "PEERS.md", peers.lines(HERE))


def group_page(group: str) -> str:
    """Return the page of a group: all claims of its records."""
    lines: list[str] = []
    for record in records(group):
        lines += ["", *section(record, HERE / group)]
    return between_marks(HERE / group / "README.md", lines[1:])


def anchor(record: Record) -> str:
    """Return the name of a record's heading in addresses."""
    return record.title.replace(",", "").replace(" ", "-")


def row(cells: Sequence[str]) -> str:
    """Return a row of a table."""
    return "| " + " | ".join(cell.replace("|", "&#124;") for cell in cells) + " |"


def section(record: Record, folder: Path) -> Iterator[str]:
    """Return the lines of one record on the page in a folder."""
    yield f"### {record.title}"
    yield ""
    script = f"[`{record.command}`]({record.script.relative_to(folder).as_posix()})"
    if record.content is None:
        yield f"{record.question} **Not recorded**: {script} has not been run in full."
        return
    made = record.content["recorded"]
    link = f"[record]({record.path.relative_to(folder).as_posix()})"
    when = made["date"] + (f" by {made['commit']}" if made.get("commit") else "")
    where = f" ({made['machine']})" if made.get("machine") else ""
    yield f"{record.question} {script}, recorded {when} in {_duration(made)}{where}: {link}."
    yield ""
    yield "| claim | figure | uncertainty | comparison | |"
    yield "| --- | --- | --- | --- | --- |"
    for claim in record.claims:
        met = "" if claim.met else "**not met**"
        yield row([claim.what, claim.figure, claim.interval, claim.beside, met])
    if shown(record.claims):
        yield ""
        yield f"![shares and intervals]({record.figure.relative_to(folder).as_posix()})"
    reasons = record.content.get("not_met", {})
    for name, fine in record.content.get("passed", {}).items():
        if not fine:
            why = f": {reasons[name]}" if isinstance(reasons, dict) and name in reasons else ""
            if why and name in made.get("failed", ()):
                why += " (found after the record)"
            yield from ("", f"Check not met: *{name}*{why}.")


def _duration(made: dict[str, Any]) -> str:
    """Format the run time, with that of kept trials, and what confirms those of earlier code."""
    kept, taken_over = made.get("kept_s", 0.0), made.get("taken_over", 0)
    more = f" and {_time(kept)} of kept trials" if kept else ""
    if taken_over:
        more += f" ({made['repeated']} of {taken_over:,} trials of earlier code repeated and equal)"
    return _time(made["wall_s"]) + more


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def main() -> None:
    """Write the pages and the figures."""
    for group in GROUPS:
        for record in records(group):
            if claims := shown(record.claims):
                draw(claims, record.figure)
            else:
                record.figure.unlink(missing_ok=True)
        (HERE / group / "README.md").write_text(group_page(group), encoding="utf-8")
    (HERE / "README.md").write_text(overview(), encoding="utf-8")
    (HERE / "FRONT_PAGE.md").write_text(statements(), encoding="utf-8")
    (HERE / "PEERS.md").write_text(other_programs(), encoding="utf-8")


if __name__ == "__main__":
    main()
