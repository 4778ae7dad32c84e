"""Compact SVG: without invisible content, and glyphs defined once per page."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TypeVar

Key = TypeVar("Key")

_GLYPH = re.compile(
    r'<path id="([\w-]*?)-?(?:DejaVu)(\w+-\w+)" ((?:d="[^"]*" )?transform="[^"]*"/>)\n?'
)


def compact(text: str) -> str:
    """Remove invisible content of an SVG by matplotlib: a third of its text."""
    text = re.sub(r"(?s)<!--.*?-->|<metadata>.*?</metadata>", "", text)
    text = re.sub(r"\n\s*", "\n", text).strip().replace("xlink:href", "href")
    # Two decimals of a point are finer than screens and printers.
    places = r'\s[dxy]="[^"]*"|translate\([^)]*\)'
    text = re.sub(places, lambda m: re.sub(r"(\.\d\d)\d+", r"\1", m[0]), text)
    text = re.sub(r'(?<=\sd=")[^"]*', lambda m: re.sub(r"\s*([A-Za-z])\s*", r"\1", m[0]), text)
    text = re.sub(r'style="[^"]*"', lambda m: re.sub(r"([:;,]) ", r"\1", m[0]), text)
    # Glyphs are placed by attributes instead of a transform.
    text = re.sub(r'" transform="translate\(([\d.-]+) ([\d.-]+)\)"/>', r'" x="\1" y="\2"/>', text)
    text = text.replace(' y="0"/>', "/>")
    # Successive equal markers share their style.
    text = re.sub(r'(?:<use [^>]*? (style="[^"]*")/>\n)(?:<use [^>]*? \1/>\n)+', _once, text)
    used = set(re.findall(r'(?:href="|url\()#([^")]+)', text))
    text = re.sub(r'\sid="([^"]*)"', lambda m: m[0] if m[1] in used else "", text)
    return re.sub(r"<g>\n(<(?:use|path) [^>]*/>)\n</g>", r"\1", text)


def _once(found: re.Match[str]) -> str:
    return f"<g {found[1]}>\n{found[0].replace(f' {found[1]}', '')}</g>\n"


def share_letters(pictures: Mapping[Key, str]) -> tuple[str, dict[Key, str]]:
    """Move the glyphs of all figures of a page into one element; return it and the figures."""
    letters: dict[str, str] = {}
    shared = {}
    for key, text in pictures.items():
        for _, name, outline in _GLYPH.findall(text):
            letters[name] = f'<path id="{name}" {outline}'
        text = _GLYPH.sub("", text).replace("<defs>\n</defs>\n", "")
        shared[key] = re.sub(r'href="#[\w-]*?-?DejaVu(\w+-\w+)"', r'href="#\1"', text)
    if not letters:
        return "", shared
    outlines = "\n".join(letters[name] for name in sorted(letters))
    return f'<svg class="letters" aria-hidden="true"><defs>\n{outlines}\n</defs></svg>', shared


def give_letters(page: str) -> str:
    """Copy the glyphs of a page into each of its figures, for readers that render them alone."""
    found = re.search(r'(?s)<svg class="letters"[^>]*>(<defs>.*?</defs>)</svg>', page)
    if found is None:
        return page
    return re.sub(r"<figure[^>]*>.*?<svg[^>]*>", lambda m: m[0] + found[1], page, flags=re.S)
