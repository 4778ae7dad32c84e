"""Does the front page stay usable for 1,000 stages?

Method
    Rows of an invented fleet, in Chromium without a network. In turns, each in a page of its own:
    the front page; the same with every row laid out, in sight or not (control, must be slower); and
    a bare table of the same text, without bars, style and script. Time runs from the start of
    navigation to the second frame after loading. A key stroke is typed into the search field,
    letter by letter, and ends when rows and count are laid out again.
Answer
    Yes. A key stroke takes 16 ms where the page takes 1.2 s to load, medians on a busy machine; the
    slowest of all took 0.13 s.
Run time
    Half a minute.
"""

from __future__ import annotations

import html
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.report.assessment import Summary
from lmshealth.report.fleet_page import write_index
from lmshealth.report.text import interval, percent, probability, time_left, travel_left
from studies.harness.claims import Claim
from studies.harness.study import Row, Study
from studies.scale.rows import make_refused, make_rows

STEP = "batch"

SOUGHT = "line04-m0417"
# Of the page against the bare table, and of bytes per stage.
BOUND_RATIO, BOUND_BYTES = 4.0, 1500
_SETTLED = """() => new Promise((done) => requestAnimationFrame(() =>
    requestAnimationFrame(() => done(performance.now()))))"""
# A paint is told some time after it was. The page forbids `eval`, by which one would wait for it
# from outside.
_PAINT = """() => new Promise((done) => new PerformanceObserver((entries) => {
    for (const entry of entries.getEntriesByName("first-contentful-paint")) done(entry.startTime);
}).observe({ type: "paint", buffered: true }))"""
_TYPE = """(sought) => {
    const find = document.getElementById("find"), times = [];
    for (let n = 1; n <= sought.length; n++) {
        const begin = performance.now();
        find.value = sought.slice(0, n);
        find.dispatchEvent(new Event("input"));
        document.documentElement.offsetHeight;
        times.push(performance.now() - begin);
    }
    return times;
}"""


def bare(rows: Sequence[Summary]) -> str:
    """Write the words of the rows as the plainest table."""
    lines = []
    for row in rows:
        cells = [
            row.identity,
            row.recorded_at.date().isoformat(),
            row.headline,
            probability(row.probability),
        ]
        for one in row.health:
            cells += [percent(one.median, 0), interval(one.low, one.high)]
        if row.life is not None:
            left = row.life.any
            cells += [travel_left(left.travel[3], row.life.horizon), time_left(left.days[3])]
        cells.append(f"{row.service.kind} {row.service.by or ''}")
        lines.append("".join(f"<td>{html.escape(cell)}" for cell in cells))
    return f"<!DOCTYPE html><title>bare</title><table><tr>{'<tr>'.join(lines)}</table>"


def write_pages(folder: Path, n: int) -> dict[str, Path]:
    """Write the front page, and what it is compared with."""
    rows = make_rows(n)
    page = write_index(folder, rows, make_refused(3 * n))
    text = page.read_text(encoding="utf-8")
    others = {"all laid out": text.replace("content-visibility: auto;", ""), "bare": bare(rows)}
    assert others["all laid out"] != text
    paths = {"page": page}
    for name, content in others.items():
        paths[name] = folder / f"{name}.html"
        paths[name].write_text(content, encoding="utf-8")
    return paths


def watch(browser: Any, path: Path) -> Row:
    """Load a page once; type into its search field, where it has one."""
    context = browser.new_context(offline=True, viewport={"width": 1280, "height": 800})
    page = context.new_page()
    page.goto(path.as_uri())
    settled = page.evaluate(_SETTLED)
    paint = page.evaluate(_PAINT)
    has_field = page.locator("#find").count() > 0
    strokes = page.evaluate(_TYPE, SOUGHT) if has_field else []
    nodes = page.evaluate("document.querySelectorAll('*').length")
    context.close()
    return {"settled_ms": settled, "paint_ms": paint, "stroke_ms": strokes, "elements": nodes}


def measure(paths: Mapping[str, Path], repeats: int) -> dict[str, dict[str, float]]:
    """Load all pages in turns; give medians, and the slowest key stroke."""
    from playwright.sync_api import sync_playwright

    seen: dict[str, list[Row]] = {name: [] for name in paths}
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        for _ in range(repeats):
            for name, path in paths.items():
                seen[name].append(watch(browser, path))
        browser.close()
    found = {}
    for name, own in seen.items():
        row = {"bytes": paths[name].stat().st_size, "elements": own[0]["elements"]}
        for key in ("settled_ms", "paint_ms"):
            row[key] = round(float(np.median([one[key] for one in own])), 1)
        if strokes := [stroke for one in own for stroke in one["stroke_ms"]]:
            row["stroke_ms"] = round(float(np.median(strokes)), 2)
            row["slowest_stroke_ms"] = round(max(strokes), 2)
        found[name] = row
    return found


def main() -> None:
    """Run the study, or a small form of it."""
    study = Study(__file__, __doc__)
    n, repeats = (300, 5) if study.quick else (1000, 15)
    with tempfile.TemporaryDirectory() as folder:
        pages = measure(write_pages(Path(folder), n), repeats)
    page, control, plain = pages["page"], pages["all laid out"], pages["bare"]
    answer = {
        "stages": n,
        "loads": repeats,
        "pages": pages,
        "bytes_per_stage": round(page["bytes"] / n),
        "to_bare": round(page["settled_ms"] / plain["settled_ms"], 2),
        "control_to_bare": round(control["settled_ms"] / plain["settled_ms"], 2),
        "stroke_to_load": round(page["stroke_ms"] / page["settled_ms"], 4),
    }
    answer["passed"] = {
        f"a stage takes at most {BOUND_BYTES} bytes": answer["bytes_per_stage"] <= BOUND_BYTES,
        f"shown in {BOUND_RATIO:g} times a bare table": answer["to_bare"] <= BOUND_RATIO,
        "a key stroke takes a tenth of a load": answer["stroke_to_load"] <= 0.1,
        "control: slower with every row laid out": answer["control_to_bare"] > answer["to_bare"],
    }
    study.conclude(answer)


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that the front page of many machines is light."""
    passed = answer["passed"]
    yield Claim(
        f"{answer['stages']:,} stages on one page load, over a bare table of the same text",
        f"{answer['to_bare']:.2f} times",
        f"median of {answer['loads']} loads",
        f"4 required; with every row laid out {answer['control_to_bare']:.1f}",
        all(passed.values()),
    )
    size = answer["bytes_per_stage"]
    yield Claim("a stage on it", f"{size:,} bytes", "", "1,500 required", size <= 1500)


if __name__ == "__main__":
    main()
