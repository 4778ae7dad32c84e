"""Language of pages and figures: one catalogue (gettext), which has the format of dates, too.

A thread has one language at a time, English unless `in_language` sets another. English has the
formats of the tables: ISO dates, a decimal point.
"""

import gettext
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import date
from functools import cache, lru_cache
from importlib import resources
from typing import Literal, get_args

Language = Literal["en", "de"]
LANGUAGES: tuple[Language, ...] = get_args(Language)
DOMAIN = "lmshealth"
FACT = "fact"
"""Context of sentences of results (`_private.tables.fact`), which tables have in English."""

_language: ContextVar[Language] = ContextVar("language", default="en")
_MOST_TEXT = 3000  # characters of sentences that are looked up: a file may hold any text
_PLACE = re.compile(r"\\\{(\w+)[^}]*\\\}")
_NUMBER = re.compile(r"(?<![\w.])(\d+)\.(\d+)(?![\w.])")
_BETWEEN = re.compile(r"([;:,]?) (and )?|$")  # parts of a detail of a refusal
_DAY = re.compile(r"\b\d{4}-\d\d-\d\d\b")


@contextmanager
def in_language(chosen: Language) -> Iterator[None]:
    """Write pages and figures in a language."""
    token = _language.set(chosen)
    try:
        yield
    finally:
        _language.reset(token)


def language() -> Language:
    """Return the code of the present language, as HTML has it."""
    return _language.get()


def mark(message: str) -> str:
    """Mark a message that is translated where it is used."""
    return message


def mark_either(one: str, many: str) -> tuple[str, str]:
    """Mark the messages of a number, as `mark` does."""
    return one, many


_MONTHS = (
    *(mark("Jan"), mark("Feb"), mark("Mar"), mark("Apr"), mark("May"), mark("Jun")),
    *(mark("Jul"), mark("Aug"), mark("Sep"), mark("Oct"), mark("Nov"), mark("Dec")),
)


def tr(message: str, /, **values: object) -> str:
    """Translate a message, and insert values by name."""
    found = _catalogue(language()).gettext(message) if message else ""
    return found.format(**values) if values else found


def tr_either(one: str, many: str, n: int) -> str:
    """Translate the message of a number: the first one for 1 in English, the second for others."""
    return _catalogue(language()).ngettext(one, many, n)


def tr_day(day: date) -> str:
    """Format a day of the calendar."""
    return format(day, tr("%Y-%m-%d"))


def tr_month(day: date) -> str:
    """Return the abbreviated month of a day."""
    return tr(_MONTHS[day.month - 1])


def decimal(number: str) -> str:
    """Write a number that Python has formatted with the decimal mark of the language."""
    return number if language() == "en" else number.replace(".", tr("0.1")[1])


def sentence(text: str) -> str:
    """Translate sentences of a result, each by the template that made it; others stay as they are.

    Results keep their sentences as text, which tables, stores and saved files have in English.
    """
    known = _sentences(language(), text)
    return known[1] if known else text


def is_known(text: str) -> bool:
    """Return whether `sentence` translates a text into the present language."""
    return _sentences(language(), text) is not None


def label(text: str) -> str:
    """Translate a label of a figure that was drawn in English, with its numbers and names."""
    chosen = language()
    if (known := tr(text)) != text or chosen == "en":
        return known
    for own, translation in _patterns(chosen, "", ""):
        if found := own.fullmatch(text):
            return translation.format(**_values(chosen, found))
    return _value(chosen, text)


@cache
def _catalogue(chosen: Language) -> gettext.NullTranslations:
    if chosen == "en":
        return gettext.NullTranslations()
    folder = resources.files("lmshealth") / "report" / "locale" / chosen / "LC_MESSAGES"
    with (folder / f"{DOMAIN}.mo").open("rb") as file:
        return gettext.GNUTranslations(file)


@cache
def _patterns(chosen: Language, context: str, end: str) -> list[tuple[re.Pattern[str], str]]:
    """Return the templates of a context with their translations, most text of their own first."""
    # gettext lists its messages nowhere else; those with a plural are pairs, the header is empty.
    known = vars(_catalogue(chosen))["_catalog"]
    parts = [(own.rpartition("\4"), text) for own, text in known.items() if isinstance(own, str)]
    found = [
        (template, text)
        for (own, _, template), text in parts
        if own == context and template and (context or "{" in template)
    ]
    found.sort(key=lambda one: len(re.sub(r"{[^}]*}", "", one[0])), reverse=True)
    return [(re.compile(_pattern(template) + end), text) for template, text in found]


def _pattern(template: str) -> str:
    """Return the pattern of a template; a value that it has twice is the same in both places."""
    parts = _PLACE.split(re.escape(template))  # every second one is a name
    names = parts[1::2]
    for k, name in enumerate(names):
        parts[2 * k + 1] = f"(?P={name})" if name in names[:k] else f"(?P<{name}>.+?)"
    return "".join(parts)


@lru_cache(maxsize=1000)
def _sentences(chosen: Language, text: str) -> tuple[int, str] | None:
    """Translate a text that consists of known sentences; None for another.

    Of several ways to divide it the one is taken in which the templates have most text of their
    own; how much, in characters, is returned with the translation.
    """
    if chosen == "en" or not text:
        return 0, text
    if len(text) > _MOST_TEXT:
        return None
    ways = []
    for own, translation in _patterns(chosen, FACT, r"(?=[;:,]?\s|$)"):
        # A value at the end may have blanks.
        for found in filter(None, (own.match(text), own.fullmatch(text))):
            if (between := _BETWEEN.match(text, found.end())) is None:
                continue
            if (further := _sentences(chosen, text[between.end() :])) is not None:
                n = found.end() - sum(map(len, found.groups())) + further[0]
                ways.append((n, found, translation, f"{between[1] or ''} ", between[2], further[1]))
    if not ways:
        return None
    n, found, translation, joint, joined, rest = max(ways, key=lambda way: way[0])
    values = _values(chosen, found)
    words = re.sub(r":[^{}]*}", "}", translation).format(**values)
    joint += f"{tr('and')} " if joined else ""
    return n, f"{words}{joint}{rest}".rstrip()


def _values(chosen: Language, found: re.Match[str]) -> dict[str, str]:
    """Translate the values of a template; unknown details, which quote a file, stay as they are."""
    return {
        name: one if name == "detail" and not _sentences(chosen, one) else _value(chosen, one)
        for name, one in found.groupdict().items()
    }


def _value(
    chosen: Language, value: str, separators: tuple[str, ...] = ("; ", ", ", " and ")
) -> str:
    """Translate a value of a sentence: sentences, or names, numbers and days, and lists of them."""
    if (known := _sentences(chosen, value)) is not None:
        return known[1]
    if separators:
        separator, *further = separators
        parts = [_value(chosen, part, tuple(further)) for part in value.split(separator)]
        return (f" {tr('and')} " if separator == " and " else separator).join(parts)
    text = _DAY.sub(lambda found: tr_day(date.fromisoformat(found[0])), _name(value))
    return _NUMBER.sub(lambda found: decimal(found[0]), text)


def _name(text: str) -> str:
    """Translate a name, which a sentence may begin with, or a name before a number."""
    found = re.match(r"[^\d+−]+(?= [\d+−])", text)
    name = found[0] if found else text
    low = name[:1].lower() + name[1:]
    known = tr(low)
    if name != low and known != low:
        known = known[:1].upper() + known[1:]
    return text if known == low else known + text[len(name) :]
