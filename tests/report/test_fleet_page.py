"""The front page: rows that are light, named safely, and stand for themselves."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import date, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmshealth._private.serialize import pack, unpack
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.summary import Summary, summarise
from lmshealth.report.pages import by_urgency, file_names, write_index
from lmshealth.report.text import GAP
from tests.assessments import Page, blind, chromium, leaves, make, nothing, watch, words
from tests.report.fleet_rows import TODAY, make_refused, make_rows

__all__ = ["make"]
N = 60


def row_of(assessment: Assessment) -> Summary:
    """Return the row of a stage."""
    return summarise(assessment, assessment.service(), "stage.html")


def test_rows_go_to_other_processes_and_into_a_store(make: Callable[..., Assessment]) -> None:
    """Packed or pickled a row comes back as it was, infinite lives and missing ones too."""
    for assessment in (make(), blind(make()), nothing(make()), make(wear_km=400000, floor=0.98)):
        row = row_of(assessment)
        for again in (unpack(pack(row), Summary), pickle.loads(pickle.dumps(row))):
            assert list(leaves(again)) == list(leaves(row))


def test_summaries_are_small(make: Callable[..., Assessment]) -> None:
    """A row takes less than a hundredth of what its assessment takes."""
    assessment = make()
    row = row_of(assessment)
    assert len(pickle.dumps(row)) < len(pickle.dumps(assessment.health)) / 100


def percent_of(text: str) -> int:
    """Return the first number of a cell."""
    return int(text.split("\u202f")[0])


@pytest.mark.parametrize(
    ("identities", "files"),
    [
        (["M7-Y"], ["M7-Y.html"]),
        (["A 1", "A/1", "a-1"], ["a-1.html", "A-1-2.html", "A-1-3.html"]),
        # Whose identity is a file name has that, also beside one that sorts before it.
        (["LMS 3", "LMS-3"], ["LMS-3.html", "LMS-3-2.html"]),
        # What is numbered because of its case, or of the index, takes no name of another.
        (["A", "a", "a-2"], ["A.html", "a-2.html", "a-3.html"]),
        (["index", "index-2"], ["index-2.html", "index-3.html"]),
        (["index", "..", "", "Führung"], ["index-2.html", "stage-2.html", "stage.html"]),
        (["x" * 70, "x" * 80], ["x" * 60 + ".html", "x" * 60 + "-2.html"]),
    ],
)
def test_files_are_safe_and_never_twice_the_same(identities: list[str], files: list[str]) -> None:
    """Signs that no file system takes are gone, and the order of the stages plays no part."""
    names = file_names(identities)
    assert set(files) <= set(names.values())
    own = {"M7-Y", "LMS-3", "a-1", "a-2", "index-2"} & names.keys()
    assert all(names[one] == f"{one}.html" for one in own)
    assert len({name.casefold() for name in names.values()}) == len(identities)
    assert file_names(reversed(identities)) == names
    assert all(len(name) <= 70 and not set('/\\:*?"<>|') & set(name) for name in names.values())


def bars(page: Page) -> dict[str, int]:
    """Return the calendar of services: what stands over each month, now first."""
    part = page.source[page.source.index('<ol class="months">') :].partition("</ol>")[0]
    found = re.findall(r'<b>(\d*)</b>.*?<span class="label">(\w+)', part)
    return {label: int(count or 0) for count, label in found}


def test_services_are_counted_by_month(tmp_path: Path) -> None:
    """Every date is due now, in a month of the year or later; the rest is counted too."""
    rows = make_rows(400)
    dates = [row.service.by for row in rows if row.service.by]
    page = Page(write_index(tmp_path, rows, ()))
    counts = bars(page)
    assert list(counts)[:3] == ["now", "Nov", "Dec"] and len(counts) == 13
    assert counts["now"] == sum(day <= TODAY for day in dates) > 0
    assert counts["Nov"] == sum(TODAY < day < date(2026, 12, 1) for day in dates)
    assert counts["Feb"] == sum(date(2027, 2, 1) <= day < date(2027, 3, 1) for day in dates) > 0
    kinds = [row.service.kind for row in rows]
    assert (
        f"{len(dates) - sum(counts.values())} are due after these months, {kinds.count('later')} "
        f"need no service within the horizon, {kinds.count('unknown')} have no date"
    ) in words(page)


def test_remaining_lives_are_counted_in_bins(tmp_path: Path) -> None:
    """Every machine with a life is in one bin; the last is beyond the horizon."""
    rows = make_rows(400)
    source = Page(write_index(tmp_path, rows, ())).source
    part = source[source.index('id="lives"') :].partition("</ol>")[0]
    pairs = re.findall(r'<b>(\d*)</b>.*?<span class="label">([^<]+)', part)
    counts = {label: int(count or 0) for count, label in pairs}
    left = [row.life.any.travel[3] / 1000 for row in rows if row.life]
    assert sum(counts.values()) == len(left) > 100
    assert counts["beyond"] == sum(np.isinf(left))
    assert counts["passed"] == sum(km <= 0 for km in left)
    assert counts[f"to 1{GAP}000"] == sum(500 < km <= 1000 for km in left)


def test_no_date_can_break_the_calendar(tmp_path: Path) -> None:
    """A clock that was far off leaves a page all the same; without dates there is none."""
    rows = make_rows(N)
    late = [replace(row, recorded_at=datetime.max) for row in rows]
    assert bars(Page(write_index(tmp_path, late, ())))["now"] > 0
    undated = [row for row in rows if row.service.by is None]
    assert len(undated) > 10
    assert "Services due" not in Page(write_index(tmp_path, undated, ())).text


def test_a_small_fleet_needs_no_script(tmp_path: Path) -> None:
    """Ten stages are seen at a glance; from eleven on there is something to find them with."""
    for n, there in ((10, False), (11, True)):
        page = Page(write_index(tmp_path, make_rows(n), ()))
        assert ("script" in page.tags, "input" in page.tags) == (there, there)


def test_a_verdict_outside_the_map_is_counted_as_one_that_is_not_clear(tmp_path: Path) -> None:
    """Neither the header nor the filter states that such a machine has no verdict."""
    rows = [replace(row, verdict="outside-map", state="open") for row in make_rows(N)]
    text = words(Page(write_index(tmp_path, rows, ())))
    assert f"0 healthy, {N} without a clear verdict" in text
    assert f"No clear verdict {N}" in text and "No verdict" not in text


def test_thousands_of_refused_logs_stay_short(tmp_path: Path) -> None:
    """They stand by reason with their number, folded, and only some of them; a few stand open."""
    refused = make_refused(3000)
    page = Page(write_index(tmp_path, make_rows(1), refused))
    text = words(page)
    for reason in {item.reason for item in refused}:
        n = sum(item.reason == reason for item in refused)
        assert f"{reason.capitalize()}: {n} " in text and f"{n - 50} more" in text
    assert text.count("archive/") == 100 and "<details open>" not in page.source
    few = Page(write_index(tmp_path, make_rows(1), refused[:12]))
    assert few.text.count("archive/") == 12 and "<details>" not in few.source


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the front page of a fleet with three states, and a page to go to."""
    folder = tmp_path_factory.mktemp("fleet")
    rows = make_rows(N)
    accented = replace(rows[0], identity="Führung 12", file="other.html")
    (folder / "other.html").write_text("<title>other</title>")
    return write_index(folder, [accented, *rows[1:]], ())


@pytest.fixture(scope="module")
def browser(needs: Callable[[str], None]) -> Iterator[Any]:
    """Give one browser to all tests here."""
    needs("chromium")
    with chromium() as started:
        yield started


def seen_rows(page: Any) -> list[str]:
    """Return the names of the stages that show, from the top."""
    return list(page.locator("tbody tr:visible th a").all_text_contents())


@pytest.mark.slow
def test_the_check_of_requests_can_fail(browser: Any, tmp_path: Path) -> None:
    """A page that loads a script from elsewhere is noticed, even where its policy stops it."""
    path = write_index(tmp_path, make_rows(2), ())
    text = path.read_text(encoding="utf-8")
    path.write_text(
        text.replace("</main>", '<script src="https://x.invalid/a.js"></script></main>')
    )
    _, seen = watch(browser, path)
    assert any("x.invalid" in one for one in seen)


@pytest.mark.slow
def test_a_stage_is_found_by_its_name(browser: Any, fleet: Path) -> None:
    """Parts of name and verdict match in any order and without accents; the count is announced."""
    page, seen = watch(browser, fleet)
    status = page.locator("[role=status]")
    assert status.inner_text() == f"{N} of {N} stages, most urgent first"
    page.get_by_label("Find").press_sequentially("m0028 x")
    assert seen_rows(page) == ["LINE00-M0028-X"]
    assert status.inner_text() == f"1 of {N} stages, most urgent first"
    page.get_by_label("Find").fill("HEALTHY fuhr")
    assert seen_rows(page) == ["Führung 12"]
    page.get_by_label("Find").fill("nothing like it")
    assert seen_rows(page) == [] and status.inner_text().startswith("0 of")
    page.get_by_role("button", name="Show all").click()
    assert len(seen_rows(page)) == N and page.get_by_label("Find").input_value() == ""
    assert seen == []


@pytest.mark.slow
def test_states_and_dates_filter(browser: Any, fleet: Path) -> None:
    """States are chosen by keyboard alone; a month of the calendar gives what is due by it."""
    page, seen = watch(browser, fleet)
    rows = make_rows(N)
    page.get_by_label("Find").focus()
    page.keyboard.press("Tab")
    page.keyboard.press("ArrowRight")
    assert len(seen_rows(page)) == sum(row.state == "bad" for row in rows) > 0
    page.keyboard.press("ArrowRight")
    assert len(seen_rows(page)) == sum(row.state == "open" for row in rows) > 0
    page.get_by_label("All").check(force=True)
    page.get_by_role("button", name=re.compile("Mar")).click()
    assert page.get_by_label("Service before").input_value() == "2027-04-01"
    due = [row for row in rows if row.service.by and row.service.by < date(2027, 4, 1)]
    assert len(seen_rows(page)) == len(due) > 0
    assert seen == []


@pytest.mark.slow
def test_columns_sort(browser: Any, fleet: Path) -> None:
    """Numbers sort as numbers, names as people count, what is missing goes last both ways."""
    page, _ = watch(browser, fleet)
    worst = [row.identity for row in by_urgency(make_rows(N))]
    assert seen_rows(page)[:3] == worst[:3]
    head = page.get_by_role("columnheader", name="Guide preload")

    def shown() -> list[str]:
        return list(page.locator("tbody tr td:nth-child(3)").all_text_contents())

    head.get_by_role("button").click()
    up = shown()
    values = [percent_of(text) for text in up if text != "–"]
    assert (
        values == sorted(values)
        and up[-1] == "–"
        and head.get_attribute("aria-sort") == "ascending"
    )
    head.get_by_role("button").press("Enter")
    down = shown()
    assert [percent_of(text) for text in down if text != "–"] == values[::-1]
    assert down[-1] == "–" and head.get_attribute("aria-sort") == "descending"
    assert page.locator("[role=status]").inner_text().endswith("by guide preload, descending")
    head.get_by_role("button").click()
    assert head.get_attribute("aria-sort") is None and seen_rows(page)[1:3] == worst[1:3]
    life = page.get_by_role("columnheader", name="Remaining life, median")
    life.get_by_role("button").click()
    lives = {row.identity: row.life.any.travel[3] if row.life else np.nan for row in make_rows(N)}
    found = [
        lives[name] for name in seen_rows(page) if name in lives and lives[name] == lives[name]
    ]
    assert found == sorted(found)


@pytest.mark.slow
def test_filters_are_restored_on_return(browser: Any, fleet: Path) -> None:
    """After a look at a page of a stage the list is as it was left."""
    page, _ = watch(browser, fleet)
    page.get_by_label("Find").fill("fuhrung")
    page.get_by_role("link", name="Führung 12").click()
    assert page.title() == "other"
    page.go_back()
    assert seen_rows(page) == ["Führung 12"]


@pytest.mark.slow
def test_filters_survive_a_reload_in_the_address(browser: Any, fleet: Path) -> None:
    """Words, state, date and order are in the fragment, which asks nobody and can be sent."""
    page, seen = watch(browser, fleet)
    page.get_by_label("Loss or change").check(force=True)
    page.get_by_label("Service before").fill("2027-04-01")
    head = page.get_by_role("columnheader", name="Guide preload").get_by_role("button")
    head.click()
    head.click()
    shown, address = seen_rows(page), page.url
    assert 0 < len(shown) < N
    assert "#state=bad&before=2027-04-01&order=-2" in address
    page.reload()
    assert (seen_rows(page), page.url) == (shown, address)
    other, also = watch(browser, fleet)
    other.goto(address)
    assert seen_rows(other) == shown
    other.evaluate("location.hash = ''")
    other.wait_for_function("!document.querySelector('tbody tr[hidden]')")
    page.get_by_role("button", name="Show all").click()
    assert page.url == fleet.as_uri() + "#" and len(seen_rows(page)) == N
    assert seen == also == []


@pytest.mark.slow
def test_the_list_is_complete_without_script(browser: Any, fleet: Path) -> None:
    """No row and no count is missing, and nothing shows that would not work."""
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(fleet.as_uri())
    assert len(seen_rows(page)) == N
    assert page.locator("input:visible, button:visible, select:visible").count() == 0
    assert page.locator("[role=status]").inner_text() == f"{N} stages, most urgent first"


@pytest.mark.slow
def test_the_header_stays_visible_and_the_page_fits_a_phone(browser: Any, fleet: Path) -> None:
    """Far down the columns have names; on a phone nothing goes sideways, order is chosen."""
    page, _ = watch(browser, fleet)
    page.locator("tbody tr").last.scroll_into_view_if_needed()
    assert page.locator("thead").bounding_box()["y"] >= 0
    for scheme in ("light", "dark"):
        phone, seen = watch(browser, fleet, scheme, 390)
        assert phone.evaluate("document.documentElement.scrollWidth") <= 390
        phone.get_by_label("Order").select_option("Stage")
        assert seen_rows(phone)[0] == "Führung 12" and seen_rows(phone)[1].startswith(
            "LINE00-M0001"
        )
        assert seen == []


HOSTILE = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' onmouseover='alert(1)' x='",
    "</style><script>alert(1)</script>",
    "</script><svg onload=alert(1)>",
    "javascript:alert(1)",
    "{{ 7 * 7 }}{% raw %}",
    "--><script>alert(1)</script><!--",
    "&lt;b&gt; &quot;",
    "\u202egnp.exe\x00\u2028",
    "__proto__",
    "../../../etc/passwd",
)


@pytest.mark.slow
def test_no_name_is_ever_run(browser: Any, tmp_path: Path) -> None:
    """Names, verdicts, parameters and reasons that are markup or script stay text."""
    rows = make_rows(len(HOSTILE))
    files = file_names(HOSTILE)
    rows = [
        replace(
            row,
            identity=evil,
            file=files[evil],
            verdict=evil,
            lost=(evil,),
            health=tuple(replace(one, name=evil) for one in row.health),
        )
        for row, evil in zip(rows, HOSTILE, strict=True)
    ]
    refused = [
        replace(item, log=evil, reason=evil, detail=evil)
        for item, evil in zip(make_refused(len(HOSTILE)), HOSTILE, strict=True)
    ]
    path = write_index(tmp_path, rows, refused)
    page, seen = watch(browser, path)
    assert seen == []
    shown = page.locator("tbody th a").all_text_contents()
    assert sorted(shown) == sorted(evil.replace("\x00", "") for evil in HOSTILE)
    for evil in HOSTILE:
        page.get_by_label("Find").fill(evil)
        assert page.locator("tbody tr:visible").count() >= 1
    page.get_by_label("Find").fill("")
    for k in range(page.locator("thead button").count()):
        page.locator("thead button").nth(k).click()
        page.mouse.move(400, 300 + 10 * k)
    assert page.locator("script").count() == 1 and page.locator("img").count() == 0
    links = page.locator("tbody th a").evaluate_all("all => all.map(one => one.protocol)")
    assert set(links) == {"file:"}
    assert seen == []


@pytest.mark.slow
def test_the_policy_lets_no_other_script_run(browser: Any, fleet: Path, tmp_path: Path) -> None:
    """Were something to get through all the same, the browser would refuse to run it."""
    text = fleet.read_text(encoding="utf-8")
    for k, inserted in enumerate(("<script>alert(1)</script>", "<img src=x onerror=alert(1)>")):
        path = tmp_path / f"{k}.html"
        path.write_text(text.replace("</main>", f"{inserted}</main>"), encoding="utf-8")
        page, seen = watch(browser, path)
        assert any("Content Security Policy" in message for message in seen)
        assert "1" not in seen
        assert len(seen_rows(page)) == N
