"""Languages of the report: catalogues, marked messages, and pages without English words."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import date, timedelta
from itertools import pairwise
from pathlib import Path
from string import Formatter
from typing import Any

import numpy as np
import pandas as pd
import pytest
from babel.dates import format_date
from babel.numbers import format_decimal
from jinja2 import Environment

from lmshealth import identify, load_stage, read_log
from lmshealth._private.serialize import unpack
from lmshealth._private.tables import REFUSALS, fact
from lmshealth.batch.assess import pack_assessment
from lmshealth.batch.run import MachineRecord, machine_output
from lmshealth.io.log import Refusal
from lmshealth.life.posterior.fit import LoneMode
from lmshealth.life.verdict import OUTSIDE_MAP, judge
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.status import make_status, on_day
from lmshealth.machine.summary import summarise
from lmshealth.report import figures, text
from lmshealth.report.language import (
    LANGUAGES,
    _patterns,
    in_language,
    is_known,
    label,
    sentence,
    tr,
    tr_month,
)
from lmshealth.report.pages import _WORDS, date_page, make_page, write_index
from lmshealth.report.rendering import read
from tests.assessments import Maker, blind, leaves, make, nothing, worn
from tests.report.fleet_rows import make_refused, make_rows
from tests.report.test_readable import seen_in_a_log
from tests.tools import catalogue

__all__ = ["make"]

TRANSLATED = LANGUAGES[1:]
REPORT = catalogue.PACKAGE / "report"
# Words of a template outside of messages: names, files and units.
NO_MESSAGES = {"lmshealth", "csv", "refused", "SHA", "NIS", "km"}
# Texts with blanks that are no messages: classes of a style sheet, and the heading of a column.
NAMES = {" scroll many", "MAC with baseline"}
# Words on German pages that are English as well, or names of this project and of the tests.
NO_ENGLISH = {
    *("test", "tests", "small", "stage", "acc_feed", "acc_pitch", "feed", "pitch", "servo", "roll"),
    *("joint", "alarm", "median", "position", "parameter", "posteriori", "importance", "sampling"),
    *("log", "logs", "ratio", "index", "free", "mac", "unknown"),
}


def texts(value: Any) -> tuple[str, ...]:
    """Return a message, or both of a number."""
    return (value,) if isinstance(value, str) else tuple(value)


def places(message: str) -> set[str]:
    """Return the values and the marks of a message that its translation must have."""
    if "${" in message or message.startswith("Collator"):
        return set()  # of the script
    values = {f"{{{name}}}" for _, name, _, _ in Formatter().parse(message) if name}
    return values | set(re.findall(r"</?\w+[^>]*>", message))


@pytest.mark.parametrize("language", TRANSLATED)
def test_every_message_is_translated(language: str) -> None:
    """Each message of the sources, once, with the same values and marks; none is fuzzy or old."""
    found, known = catalogue.template(), catalogue.stored(language)
    assert {(m.context, m.id) for m in found if m.id} == {(m.context, m.id) for m in known if m.id}
    assert not known.obsolete
    for message in known:
        if not message.id:
            continue
        assert not message.fuzzy, message.id
        originals, translations = texts(message.id), texts(message.string)
        assert all(translations) and len(translations) == len(originals), message.id
        for one, other in zip(originals, translations, strict=True):
            assert places(one) == places(other), (one, other)
            edges = (one[:1] == " ", one[-1:] == " ")
            assert edges == (other[:1] == " ", other[-1:] == " "), one


@pytest.mark.parametrize("language", TRANSLATED)
def test_the_compiled_catalogue_is_that_of_the_text(language: str) -> None:
    """Control: a translation that was changed without compiling it differs."""
    known = catalogue.stored(language)
    compiled = catalogue.path(language, "mo").read_bytes()
    assert catalogue.as_mo(known) == compiled
    known["Fleet"].string = "Fuhrpark"
    assert catalogue.as_mo(known) != compiled


def unmarked(template: str) -> Iterator[str]:
    """Yield what a template has as words outside of its messages."""
    markup, expression = "", list[tuple[str, str]]()
    for _, kind, value in Environment(extensions=["jinja2.ext.i18n"]).lex(template):
        if kind == "data":
            markup += value
        elif kind in ("variable_end", "block_end"):
            markup += "\N{REPLACEMENT CHARACTER}" if kind == "variable_end" else ""
            yield from _sentences_of(expression)
            expression = []
        elif kind != "whitespace":
            expression.append((kind, value))
    markup = re.sub(r"(?s)<style>.*?</style>|<script>.*?</script>", "", markup)
    shown = re.findall(r'(?:aria-label|alt|title|placeholder|data-label|content)="([^"]*)"', markup)
    policy = [one for one in shown if "default-src" in one or "width=device" in one]
    attributes = [one for one in shown if one not in (*policy, "light dark")]
    for part in (re.sub(r"(?s)<[^>]*>", "\n", markup), *attributes):
        for word in re.findall(r"[^\W\d_]{2,}", part):
            if word not in NO_MESSAGES:
                yield word


def _sentences_of(expression: list[tuple[str, str]]) -> Iterator[str]:
    """Yield texts with a blank between words that are no argument of a message."""
    for k, (kind, value) in enumerate(expression):
        before = [own for _, own in expression[max(k - 2, 0) : k]]
        is_marked = before in (["_", "("], ["_n", "("]) or value in _plurals(expression)
        plain = "" if value[1:-1] in NAMES else re.sub(r"{[^}]*}", "", value)
        if kind == "string" and re.search(r"[^\W\d_]{2,} [^\W\d_]{2,}", plain) and not is_marked:
            yield value


def _plurals(expression: list[tuple[str, str]]) -> list[str]:
    """Return the second messages of numbers."""
    return [
        expression[k + 4][1]
        for k, (_, value) in enumerate(expression[:-4])
        if value == "_n" and expression[k + 4][0] == "string"
    ]


@pytest.mark.parametrize("language", TRANSLATED)
def test_days_and_numbers_are_those_of_the_locale(language: Any) -> None:
    """The catalogue has the forms that the Unicode locale data have (oracle: Babel)."""
    with in_language(language):
        for month in range(1, 13):
            day = date(2026, month, 3)
            assert text.day(day) == format_date(day, locale=language)
            assert tr_month(day) == format_date(day, "LLL", locale=language)
        assert text.fixed(12.5, 1) == format_decimal(12.5, locale=language)


def test_pages_need_no_babel(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has the locales of all countries, and is larger than many libraries together."""
    for name in [name for name in sys.modules if name.split(".")[0] == "babel"]:
        monkeypatch.setitem(sys.modules, name, None)
    _patterns.cache_clear()
    test_a_sentence_has_the_formats_of_german()
    with in_language("de"):
        assert (text.day(date(2026, 3, 5)), tr_month(date(2026, 3, 5))) == ("05.03.2026", "Mär")


@pytest.mark.parametrize("path", sorted(catalogue.TEMPLATES.glob("*.j2")), ids=lambda p: p.name)
def test_a_template_has_no_unmarked_words(path: Path) -> None:
    """All words are messages."""
    assert list(unmarked(path.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize(
    "added", ["<p>Some words</p>", '<p title="A hint"></p>', "{{ parts.table(['Some head']) }}"]
)
def test_an_unmarked_word_is_found(added: str) -> None:
    """Control: in text, in an attribute, and in an argument."""
    assert list(unmarked(added))


def unmarked_constants(source: str) -> Iterator[str]:
    """Yield texts with words in a module that are neither messages nor docstrings."""
    tree, marked = ast.parse(source), set[int]()
    for node in ast.walk(tree):
        name = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
        if name in ("tr", "mark", "mark_either", "tr_either"):
            marked |= {id(inner) for inner in ast.walk(node)}
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            marked.add(id(node.value))
    for node in ast.walk(tree):
        is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if is_text and id(node) not in marked and re.search(r"[^\W\d_]{2,} \w", node.value):  # type: ignore[attr-defined]
            yield node.value  # type: ignore[attr-defined]


def test_a_module_of_wording_has_no_unmarked_texts() -> None:
    """Control: a sentence that is returned as it is, is found."""
    source = (REPORT / "text.py").read_text(encoding="utf-8")
    assert list(unmarked_constants(source)) == []
    assert list(unmarked_constants(source + 'def f():\n    return "not marked"\n')) == [
        "not marked"
    ]


def facts(language: str) -> list[str]:
    """Return the templates of the sentences of results."""
    return [str(one.id) for one in catalogue.stored(language) if one.context == catalogue.FACT]


@pytest.mark.parametrize("language", TRANSLATED)
def test_sentences_of_results_are_translated_by_their_templates(language: Any) -> None:
    """Each by itself, and all pairs of neighbours; numbers, days and names as in the language."""
    made = []
    for template in facts(language):
        fields = [(name, form) for _, name, form, _ in Formatter().parse(template) if name]
        values: dict[str, Any] = {name: 3.25 if form else f"x{name}" for name, form in fields}
        made.append(fact(template, **values))
    with in_language(language):
        for one, other in pairwise(made):
            assert is_known(one), one
            assert sentence(f"{one} {other}") == f"{sentence(one)} {sentence(other)}"
        assert not is_known("The moon is made of cheese.")
        assert sentence("The moon is made of cheese.") == "The moon is made of cheese."
    assert sentence(made[0]) == made[0]


def test_a_sentence_has_the_formats_of_german() -> None:
    """Names, decimals, days and lists in it."""
    why = "Guide preload is at 72 % of its baseline value (90 %: 67 to 76 %)."
    jump = (
        "The frequencies jumped before the log of 2026-09-01 (pitch +1.5 %, roll −0.3 %), and no "
        "declared maintenance explains it."
    )
    with in_language("de"):
        assert sentence(f"{jump} {why}") == (
            "Die Frequenzen sind vor der Aufzeichnung vom 01.09.2026 gesprungen (Nicken +1,5 %, "
            "Wanken −0,3 %), und keine angegebene Instandhaltung erklärt dies. Vorspannung der "
            "Führung liegt bei 72 % des Bezugswerts (90 %: 67 bis 76 %)."
        )
        assert (text.fixed(-0.5, 2), text.number(1234567)) == ("−0,50", "1\u202f230\u202f000")
        assert (text.count(1, "log"), text.count(2, "week")) == ("1 Aufzeichnung", "2 Wochen")
        assert label("limit 60 %") == "Grenzwert 60 %"
        assert label("guide preload in % of baseline") == "Vorspannung der Führung in %"
        assert label("114.06 Hz") == "114,06 Hz"
    assert (tr("Fleet"), label("114.06 Hz"), text.capitalize("114.06 Hz")) == (
        *("Fleet", "114.06 Hz", "114.06 Hz"),
    )


def test_the_words_of_the_script_are_there() -> None:
    """Each is in the script, and replaced by German ones."""
    script = read("index.js")
    with in_language("de"):
        assert [words_ for words_ in _WORDS if words_ not in script or tr(words_) == words_] == []


def vocabulary(language: str) -> set[str]:
    """Return the words of English messages that are in no message of a language."""
    found, translations = set[str](), set[str]()
    for message in catalogue.stored(language):
        if message.id and "${" not in texts(message.id)[0]:
            found |= _words_of(" ".join(texts(message.id)))
            translations |= _words_of(" ".join(texts(message.string)))
    codes = {word for code in REFUSALS for word in code.split("-")}
    return found - translations - codes - NO_ENGLISH


def _words_of(message: str) -> set[str]:
    """Return the words of a message in small letters, without values and marks."""
    plain = re.sub(r"{[^}]*}|<[^>]*>|\w+\.csv|\[\[?\w+]]?|--[\w-]+|`[^`]*`", " ", message)
    return {word.casefold() for word in re.findall(r"(?<![\w_-])[^\W\d_]{3,}(?![\w_-])", plain)}


def english(source: str, known: set[str]) -> set[str]:
    """Return the English words on a page, without what it marks as English."""
    source = re.sub(r'(?s)<span lang="en">.*?</span>|<td class="path">.*?</td>', " ", source)
    source = re.sub(r"(?s)<style>.*?</style>|<script>.*?</script>|<dl>.*?</dl>", " ", source)
    source += " ".join(re.findall(r'(?:aria-label|placeholder|data-label)="([^"]*)"', source))
    return _words_of(re.sub(r"(?s)<[^>]*>", " ", source)) & known


def states(make: Maker, folder: Path) -> Iterator[tuple[str, Assessment]]:
    """Yield machines in several states, with sentences of the package itself."""
    made = replace(make(), notices=(), refused=(Refusal("a.csv", "jump", "x", mode="roll"),))
    judged = judge(made.stage, made.history, made.health, made.track)
    base = replace(made, judgement=judged)
    assert base.prognosis is not None and base.health is not None
    yield "worn", base
    latest, before = seen_in_a_log(), seen_in_a_log("log-1.h5", seed=3)
    yield "with spectra", replace(base, latest=latest, at_baseline=before)
    yield "undetermined", blind(base)
    unseen = judge(made.stage, made.history, None)
    yield "nothing", replace(nothing(base), judgement=unseen)
    never = replace(base.prognosis, remaining=np.full_like(base.prognosis.remaining, np.inf))
    healthy = replace(base.judgement, verdict="healthy")
    yield "healthy", replace(base, prognosis=never, judgement=healthy)
    misfit = replace(base.prognosis, chi_square=400.0, walk=0.04)
    yield "misfit", replace(base, prognosis=misfit)
    lone = LoneMode("pitch", 0.9, 0.02, 0.001)
    alone = replace(base.judgement, verdict=OUTSIDE_MAP)
    moved = replace(base.health, lone_modes=(lone,))
    yield "outside", replace(base, judgement=alone, health=moved)
    stepped = replace(worn(folder), notices=())
    why = judge(stepped.stage, stepped.history, stepped.health, stepped.track)
    yield "step", replace(stepped, judgement=why)


@pytest.mark.slow
@pytest.mark.parametrize("language", TRANSLATED)
def test_pages_have_no_english_words(make: Maker, tmp_path: Path, language: Any) -> None:
    """Pages of several states, on several days, with a report before; and the fleet page.

    Control: the page in English has hundreds of them.
    """
    known, found = vocabulary(language), dict[str, set[str]]()
    for name, made in states(make, tmp_path):
        summary = summarise(made, made.service(), "a.html")
        before = replace(summary, n_logs=30, verdict="healthy", probability=0.9, life=None)
        status, found[name] = make_status(made, summary), set()
        with in_language(language):
            undated = make_page(made, summary, before=before)
        in_english = make_page(made, summary) if name == "worn" else ""
        for days in (0, 400):
            of_day = on_day(summary, status, summary.recorded_at.date() + timedelta(days))
            with in_language(language):
                page = date_page(undated, of_day, status)
                index = write_index(tmp_path, [of_day], made.refused)
            row = english(index.read_text(encoding="utf-8"), known)
            found[name] |= english(page, known) | row
            assert f'<html lang="{language}">' in page
            if in_english:
                as_it_was = date_page(in_english, of_day, status)
                assert len(english(as_it_was, known)) > 150
    with in_language(language):
        index = write_index(tmp_path, make_rows(24), make_refused(30))
    found["fleet"] = english(index.read_text(encoding="utf-8"), known)
    found["reading"] = english((tmp_path / "how-to-read.html").read_text(encoding="utf-8"), known)
    assert {name: own for name, own in found.items() if own} == {}


def test_tables_are_the_same_in_every_language(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a machine: only its page is in the language of the run."""
    monkeypatch.setattr(figures, "svg", lambda draw, *, salt, size: f'<svg id="{salt}"></svg>')
    packed = pack_assessment(worn(tmp_path)).content
    made = [
        machine_output(MachineRecord("M7-Y", "a.html", packed, None, None, language=language))
        for language in LANGUAGES
    ]
    first, second = made
    assert first is not None and second is not None
    assert first.page != second.page and "Restlebensdauer" in second.page
    assert list(leaves(first.summary)) == list(leaves(second.summary))
    assert list(leaves(first.status)) == list(leaves(second.status))
    tables = [
        {name: unpack(own, str) for name, own in one.tables.items()} for one in (first, second)
    ]
    assert tables[0] == tables[1]


def test_templates_of_details_are_those_of_the_sources() -> None:
    """The text between their values is in a string of the package; control: another one is not."""
    sources = (ast.parse(file.read_text("utf-8")) for file in catalogue.PACKAGE.rglob("*.py"))
    nodes = (node for source in sources for node in ast.walk(source))
    known = "\n".join(str(one.value) for one in nodes if isinstance(one, ast.Constant))

    def unknown(template: str) -> list[str]:
        """Return what is in no string; a part after a colon or a comma may be of another one."""
        parts = (re.split(r"[;:,] (?:and )?", own) for own in re.split(r"{\w+}", template))
        return [part for own in parts for part in own if part.strip() not in known]

    templates = [one for refusal in REFUSALS.values() for one in refusal.details]
    assert [part for one in templates for part in unknown(one)] == []
    assert unknown("all {n} samples are cheese; check it") == [" samples are cheese"]


@pytest.mark.parametrize("language", TRANSLATED)
def test_details_of_a_damaged_log_are_translated(language: Any, tmp_path: Path) -> None:
    """Channels that are flat, clipped, full of gaps, copied or without sign, and modes not seen."""
    rng = np.random.default_rng(1)
    first, second = rng.standard_normal((2, 10_000))
    gap, full = second.copy(), first.copy()
    gap[100:140], full[rng.random(full.size) < 0.3] = np.nan, np.nan
    channels = {
        "flat": -np.zeros(first.size),
        "clipped": first.clip(-1, 1),
        "gap": gap,
        "full": full,
    }
    channels |= {"copy": 2 * first, "rectified": abs(first)}
    table = pd.DataFrame({"time_s": np.arange(first.size) / 500, "delta_e_um": first})
    for name, values in channels.items():
        table[f"acc_{name}_m_s2"] = values
    table.to_csv(tmp_path / "log.csv", index=False)
    refused = identify(read_log(tmp_path / "log.csv"), load_stage("lms-y")).refused
    reasons = {one.reason for one in refused}
    assert reasons >= {"flat", "clipped", "gaps", "missing-samples", "dependent", "rectified"}
    assert "not-excited" in reasons
    with in_language(language):
        assert [one.detail for one in refused if not is_known(one.detail)] == []
        (flat,) = {one.detail for one in refused if one.reason == "flat"}
        quoted = "line 2: recorded_at is '2026-07-25', needed ISO 8601"
        unread = f"a.csv cannot be read completely ({quoted}): work on this machine that it lists "
        assert quoted in sentence(f"{unread}there is not used.")
        assert sentence(flat) == "alle 10000 Abtastwerte sind 0 (SI); prüfen Sie den Sensor"
