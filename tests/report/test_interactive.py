"""Interactive page: complete in itself, linked, harmless, and refused with a way out."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmshealth.errors import LmshealthError
from lmshealth.report.interactive import interactive_page
from tests.assessments import Maker, chromium, make, nothing, watch
from tests.report.test_readable import seen_in_a_log

__all__ = ["make"]

HOSTILE = "<img src=x onerror=alert(1)></script><script>alert(2)</script>"
# Ranges and levels of the pictures that a reader has on the screen.
RANGES = """() => Object.values(Bokeh.index).flatMap((view) => [...view.model.references()])
  .filter((model) => model.type === "Figure")
  .map((one) => [one.title.text, one.x_range.id, one.x_range.start, one.x_range.end])"""


def items(text: str) -> list[dict[str, Any]]:
    """Return the pictures of a page as Bokeh reads them."""
    found = re.search(r'(?s)id="pictures">(.*?)</script>', text)
    assert found
    read: list[dict[str, Any]] = json.loads(found[1])
    return read


def test_one_page_has_all_sections(make: Maker) -> None:
    """Spectra, tracks and posterior are there, each a document of Bokeh, without an address."""
    latest = seen_in_a_log()
    text = interactive_page(replace(make(), latest=latest), "../M7-Y.html")
    assert len(items(text)) == text.count('<div class="card plots"') == 3
    assert not re.search(r'<(?:script|link|img)[^>]*\s(?:src|href)="(?!data:)', text)
    assert text.count("sha256-") == 2 and "default-src 'none'" in text
    assert 'href="../M7-Y.html"' in text


def test_what_is_missing_is_left_out(make: Maker) -> None:
    """A machine without results has a page that states it."""
    text = interactive_page(replace(nothing(make()), waterfall=None), "a.html")
    assert items(text) == [] and "do not determine anything" in text


def test_without_bokeh_the_way_out_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the extra and the command that repeats the pages."""
    monkeypatch.setitem(sys.modules, "bokeh.plotting", None)
    monkeypatch.delitem(sys.modules, "lmshealth.report.interactive")
    with pytest.raises(LmshealthError, match=r"lmshealth\[interactive\].*report --interactive"):
        importlib.import_module("lmshealth.report.interactive")


@pytest.mark.slow
def test_a_browser_shows_it_offline(
    make: Maker, tmp_path: Path, needs: Callable[[str], None]
) -> None:
    """No request leaves the page; a zoom moves all pictures of a section; no name is executed."""
    needs("chromium")
    latest, made = seen_in_a_log(), make()
    latest = replace(latest, log=HOSTILE)
    history = replace(made.history, logs=tuple(f"{HOSTILE}{k}" for k in range(40)))
    assessment = replace(made, latest=latest, history=history)
    path = tmp_path / "page.html"
    path.write_text(interactive_page(assessment, "../M7-Y.html"), encoding="utf-8")
    with chromium() as browser:
        page, seen = watch(browser, path)
        page.wait_for_function(
            "() => document.querySelectorAll('.plots').length === 3 && Bokeh.documents.length === 3"
            " && Bokeh.documents.every((one) => one.is_idle)",
            timeout=120_000,
        )
        shown = page.evaluate(RANGES)
        tracks = [one for one in shown if one[0].startswith("Frequency of")]
        assert len(tracks) == 3 and len({one[1] for one in tracks}) == 1
        page.evaluate(
            """(id) => { for (const doc of Bokeh.documents) {
                 const range = doc.get_model_by_id(id);
                 if (range) { range.start = 500; range.end = 900; } } }""",
            tracks[0][1],
        )
        moved = [one for one in page.evaluate(RANGES) if one[1] == tracks[0][1]]
        assert len(moved) == 5 and all(one[2:] == [500, 900] for one in moved)
        # Names of logs appear under the pointer, and are text.
        box = page.locator(".bk-Figure").nth(1).bounding_box()
        for share in np.linspace(0.1, 0.9, 30):
            page.mouse.move(box["x"] + share * box["width"], box["y"] + 0.5 * box["height"])
        assert page.locator("img[src='x']").count() == 0
        assert [one for one in seen if "setting log level" not in one] == []


@pytest.mark.slow
def test_the_check_of_requests_can_fail(
    make: Maker, tmp_path: Path, needs: Callable[[str], None]
) -> None:
    """A page that loads a script from elsewhere is noticed, even where its policy stops it."""
    needs("chromium")
    path = tmp_path / "page.html"
    text = interactive_page(make(), "a.html")
    path.write_text(
        text.replace("</main>", '<script src="https://x.invalid/a.js"></script></main>')
    )
    with chromium() as browser:
        _, seen = watch(browser, path)
        assert any("x.invalid" in one for one in seen)
