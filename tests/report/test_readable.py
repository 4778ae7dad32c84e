"""What can be read of the pages: no text is cut or tiny, and all of it has enough contrast."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmshealth.machine.assessment import Assessment
from lmshealth.modal.identification import read_ambient
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.mode_shapes import mode_shapes
from lmshealth.modal.spectra_summary import summarise
from lmshealth.stage.description import load_stage
from tests.assessments import Maker, blind, chromium, make, nothing, watch, write_report
from tests.signals import Mode, accelerations, make_log

__all__ = ["make"]

pytestmark = pytest.mark.slow

LEAST_PIXELS, LEAST_CONTRAST = 10.0, 4.5
# Texts of figures that leave their picture, and texts that leave their card or the window, unless
# they can be scrolled to.
CUT = """() => {
  const out = [];
  const outside = (box, frame) => box.left < frame.left - 1 || box.right > frame.right + 1
    || box.top < frame.top - 1 || box.bottom > frame.bottom + 1;
  for (const text of document.querySelectorAll("figure svg text")) {
    const box = text.getBoundingClientRect(), svg = text.ownerSVGElement;
    if (box.width && outside(box, svg.getBoundingClientRect())) out.push(text.textContent);
  }
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; (node = walker.nextNode()); ) {
    const own = node.parentElement;
    if (!node.data.trim() || own.closest("svg, .unseen, .scroll, script")) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    const frame = own.closest(".card")?.getBoundingClientRect();
    for (const box of range.getClientRects()) {
      const right = Math.min(frame?.right ?? Infinity, innerWidth);
      if (box.width && (box.right > right + 1 || box.left < (frame?.left ?? 0) - 1)) {
        out.push(node.data.trim());
      }
    }
  }
  return out;
}"""
# Exponents of powers of ten are left out: they have 70 % of the 10 points of all other text.
TINY = """(least) => [...document.querySelectorAll("figure svg text")]
  .map((text) => [text, text.getScreenCTM()])
  .map(([text, way]) => [text, getComputedStyle(text).fontSize, Math.hypot(way.a, way.b)])
  .map(([text, size, scale]) => [text, parseFloat(size), scale])
  .filter(([text, points, scale]) => points > 7 && points * scale < least)
  .map(([text, points, scale]) => `${text.textContent}: ${(points * scale).toFixed(1)} px`)"""
PALE = """(least) => {
  const pixel = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const known = new Map();
  const rgba = (colour) => {
    if (known.has(colour)) return known.get(colour);
    pixel.clearRect(0, 0, 1, 1);
    pixel.fillStyle = colour;
    pixel.fillRect(0, 0, 1, 1);
    known.set(colour, [...pixel.getImageData(0, 0, 1, 1).data].map((v) => v / 255));
    return known.get(colour);
  };
  const over = (top, below) => below.map((v, i) => top[3] * top[i] + (1 - top[3]) * v);
  const light = (c) => {
    const [r, g, b] = c.map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (element) => {
    const layers = [];
    for (let one = element; one; one = one.parentElement) {
      layers.push(rgba(getComputedStyle(one).backgroundColor));
    }
    return layers.reverse().reduce((below, top) => over(top, below), [1, 1, 1]);
  };
  const found = new Map();
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; (node = walker.nextNode()); ) {
    const own = node.parentElement, style = getComputedStyle(own);
    if (!node.data.trim() || own.closest("title, script, style, .unseen")) continue;
    const ground = behind(own), ink = rgba(own.closest("svg") ? style.fill : style.color);
    const [dark, bright] = [light(over(ink, ground)), light(ground)].sort((a, b) => a - b);
    const contrast = (bright + 0.05) / (dark + 0.05);
    if (contrast < least) found.set(`${node.data.trim().slice(0, 40)}: ${contrast.toFixed(2)}`, 1);
  }
  return [...found.keys()];
}"""


@pytest.fixture(scope="module")
def browser(needs: Callable[[str], None]) -> Iterator[Any]:
    """Give one browser to all tests here."""
    needs("chromium")
    with chromium() as one:
        yield one


@cache
def seen_in_a_log(name: str = "log-9.h5", seed: int = 2) -> LogEstimates:
    """Identify a log of two channels, with its spectra and shapes."""
    stage, rng = load_stage("lms-y"), np.random.default_rng(seed)
    modes = [Mode(126.4, 0.015, shape=(1.0, 0.3)), Mode(136.4, 0.015, shape=(-0.4, 1.0))]
    made = accelerations(rng, modes, 20_000, 1000.0, 1.0)
    log = make_log({"acc_pitch": made[0], "acc_feed": made[1]}, 1000.0)
    reading = read_ambient(log, stage)
    spectra = summarise(reading.spectra, reading.fitted, reading.modes, (110.0, 180.0), 100)
    shapes = mode_shapes(reading.modes, reading.fitted)
    found = LogEstimates(name, log.digest, log.metadata, reading.modes)
    return replace(found, spectra=spectra, shapes=shapes)


def worn(make: Maker) -> Assessment:
    """Return a worn machine whose first and last logs are shown."""
    latest, before = seen_in_a_log("log-9.h5"), seen_in_a_log("log-1.h5", seed=3)
    return replace(make(), latest=latest, at_baseline=before)


def pages(make: Maker, folder: Path) -> list[Path]:
    """Write pages of machines, and of the fleet.

    Worn, partly determined, unknown, with a mode that moved alone, and with a last log left out.
    """
    alone, off = make("M5-Y"), make("M6-Y", wear_km=400000, floor=0.98)
    alone = replace(alone, judgement=replace(alone.judgement, verdict="outside-map"))
    assert off.track is not None
    off = replace(off, track=replace(off.track, outliers=((len(off.track.logs) - 1, "roll"),)))
    machines = [worn(make), blind(make("M8-Y")), nothing(make("M9-Y")), alone, off]
    found = write_report(folder / "out", machines, ())
    assert found[0].with_name("index.html").is_file()
    return sorted(found[0].parent.glob("*.html"))


def test_all_text_can_be_read(browser: Any, make: Maker, tmp_path: Path) -> None:
    """Nothing is cut, tiny or pale at 1280 and 390 px, in both schemes."""
    for path in pages(make, tmp_path):
        for width in (1280, 390):
            for scheme in ("light", "dark"):
                page, seen = watch(browser, path, scheme, width)
                page.evaluate("document.querySelectorAll('details').forEach((d) => d.open = true)")
                where = f"{path.name} at {width} px, {scheme}"
                assert page.evaluate(CUT) == [], where
                assert page.evaluate(TINY, LEAST_PIXELS) == [], where
                assert page.evaluate(PALE, LEAST_CONTRAST) == [], where
                assert seen == []
                page.context.close()


def test_faults_are_found(browser: Any, make: Maker, tmp_path: Path) -> None:
    """The same checks find a text that is moved out of its picture, shrunk, and bleached."""
    path = write_report(tmp_path / "out", [worn(make)], ())[0]
    page, _ = watch(browser, path, "light", 390)
    first = "document.querySelector('figure svg text')"
    page.evaluate(f"{first}.setAttribute('transform', 'translate(3000 50)')")
    page.evaluate(f"{first}.style.fontSize = '7.5px'")
    page.evaluate("document.querySelector('.why').style.color = '#aaa'")
    page.evaluate("document.querySelector('.to-do').style.whiteSpace = 'nowrap'")
    assert len(page.evaluate(CUT)) == 2
    assert len(page.evaluate(TINY, LEAST_PIXELS)) >= 1
    assert len(page.evaluate(PALE, LEAST_CONTRAST)) >= 1
    page.context.close()


def test_a_wide_table_says_that_it_scrolls(browser: Any, make: Maker, tmp_path: Path) -> None:
    """On a phone a hint stands above a table that is wider than it, and above no other."""
    path = write_report(tmp_path / "out", [worn(make)], ())[0]
    for width in (390, 1280):
        page, _ = watch(browser, path, "light", width)
        page.wait_for_timeout(100)
        found = page.evaluate(
            """() => [...document.querySelectorAll(".scroll")].map((one) => [
                 one.scrollWidth > one.clientWidth + 1,
                 parseFloat(getComputedStyle(one, "::before").height) > 5])"""
        )
        assert all(wide == hint for wide, hint in found)
        assert any(wide for wide, _ in found) == (width == 390)
        page.context.close()
