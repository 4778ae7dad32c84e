"""Write the catalogues of messages of the report from its templates and modules.

``python -m tests.tools.catalogue`` adds new messages to ``lmshealth.po`` of each language, removes
those that are no more, and compiles ``lmshealth.mo``, which the package reads. A new message has no
translation, and `tests/report/test_language.py` fails until it has one.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from babel.messages.catalog import Catalog
from babel.messages.extract import extract_from_file
from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po, write_po
from jinja2.ext import babel_extract

from lmshealth._private.tables import FLAGS, NOTICES, REFUSALS, STEPS, TABLES
from lmshealth.report.language import DOMAIN, FACT, LANGUAGES
from lmshealth.report.text import view_columns

PACKAGE = Path(__file__).parents[2] / "lmshealth"
TEMPLATES = PACKAGE / "report" / "templates"
KEYWORDS: dict[str | None, dict[str, Any]] = {
    None: {"tr": None, "mark": None, "tr_either": (1, 2), "mark_either": (1, 2)},
    FACT: {"fact": None},
}
IN_TEMPLATES = ("_", "_n")
# Lines of the header: dates, and placeholders for people.
_LEFT_OUT = (
    *(b"POT-Creation-Date", b"PO-Revision-Date", b"Generated-By", b"Copyright", b"FIRST AUTHOR"),
    *(b"Report-Msgid-Bugs-To", b"Last-Translator", b"Language-Team", b"Project-Id-Version"),
)


def main() -> None:
    """Update the catalogue of every language but English, and compile it."""
    for language in LANGUAGES[1:]:
        known = stored(language)
        known.update(template(), no_fuzzy_matching=True)
        known.obsolete.clear()
        path(language, "po").write_bytes(as_po(known))
        path(language, "mo").write_bytes(as_mo(stored(language)))


def stored(language: str) -> Catalog:
    """Read the catalogue of a language."""
    with path(language, "po").open("rb") as file:
        return read_po(file, locale=language, domain=DOMAIN)


def path(language: str, suffix: str) -> Path:
    """Return the file of a catalogue."""
    return PACKAGE / "report" / "locale" / language / "LC_MESSAGES" / f"{DOMAIN}.{suffix}"


def as_po(catalogue: Catalog) -> bytes:
    """Write a catalogue as text: by place, without dates, which would differ each time."""
    target = io.BytesIO()
    write_po(
        target, catalogue, width=100, omit_header=False, sort_by_file=True, include_lineno=False
    )
    lines = target.getvalue().splitlines(keepends=True)
    return b"".join(line for line in lines if not line.lstrip(b'"# ').startswith(_LEFT_OUT))


def as_mo(catalogue: Catalog) -> bytes:
    """Compile a catalogue; its header has a fixed date, so that the bytes are reproducible."""
    catalogue.creation_date = catalogue.revision_date = datetime(2000, 1, 1, tzinfo=UTC)
    target = io.BytesIO()
    write_mo(target, catalogue)
    return target.getvalue()


def template() -> Catalog:
    """Return all messages of the report, without translations."""
    catalogue = Catalog(domain=DOMAIN, project="lmshealth", fuzzy=False)
    for message, place, context in messages():
        catalogue.add(message, locations=[(place, 1)], context=context)
    return catalogue


def messages() -> Iterator[tuple[Any, str, str | None]]:
    """Yield messages (pairs for plurals) with their file and context."""
    for file in sorted(PACKAGE.rglob("*.py")):
        place = file.relative_to(PACKAGE.parent).as_posix()
        for context, keywords in KEYWORDS.items():
            for _, message, _, _ in extract_from_file("python", file, keywords=keywords):
                yield message, place, context
    for file in sorted(TEMPLATES.glob("*.j2")):
        with file.open("rb") as content:
            for _, function, found, _ in babel_extract(content, IN_TEMPLATES, [], {}):
                texts = found if isinstance(found, tuple) else (found,)  # of all arguments
                of_template = texts[:2] if function == "_n" else texts[0]
                if of_template is not None:  # a word that is marked elsewhere
                    yield of_template, f"lmshealth/report/templates/{file.name}", None
    place = "lmshealth/_private/tables.toml"
    for table in TABLES.values():
        if "page" in table.shown:
            yield from ((head, place, None) for head in view_columns(table.shown["page"]))
    notices = (sentence for _, *own in NOTICES.values() for sentence in own if sentence)
    yield from ((sentence, place, FACT) for sentence in (*FLAGS.values(), *notices))
    yield from ((sentence, place, None) for sentence in STEPS.values() if sentence)
    for code, refusal in REFUSALS.items():
        yield code, place, None
        yield from ((template, place, FACT) for template in refusal.details)


if __name__ == "__main__":
    main()
