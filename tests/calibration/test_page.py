"""The results of a check: tables, JSON, and a page that a stranger can read."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from lmshealth._private.tables import TABLES
from lmshealth.calibration import page as pages
from lmshealth.calibration.check import DAYS, DRAWN, CalibrationCheck
from lmshealth.calibration.page import (
    Share,
    histogram_picture,
    life_rows,
    rank_histogram,
    share_plot,
    verdict_of,
    write_results,
)
from lmshealth.report.tables import csv_text
from tests.calibration.test_check import HEALTH, outcomes, summary


@pytest.fixture(scope="module")
def folder(checked: CalibrationCheck, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write all results of a check."""
    target = tmp_path_factory.mktemp("results")
    assert write_results(target, checked) == target / "calibration.html"
    return target


def test_every_figure_says_what_good_looks_like(folder: Path) -> None:
    """Each caption does; those of controls say that they must not look good."""
    page = (folder / "calibration.html").read_text(encoding="utf-8")
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", page, re.S)
    assert len(captions) == page.count("<svg aria") >= 7
    assert all("Good: " in caption for caption in captions)
    assert sum("must not look good" in caption for caption in captions) == 2


def test_the_page_needs_nothing_else(folder: Path) -> None:
    """No script and no address of another file."""
    page = (folder / "calibration.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert not re.findall(r'(?:src|href)="(?!#|data:)', page)
    assert "not of raw samples" in page


def test_tables_have_the_columns_of_the_specification(
    folder: Path, checked: CalibrationCheck
) -> None:
    """Rows of lives are one per life and quantity."""
    for name in ("coverage", "rates", "lives"):
        with (folder / f"{name}.csv").open(newline="") as file:
            rows = list(csv.reader(file))
        assert tuple(rows[0]) == TABLES[f"calibration_{name}"].names
        assert len(rows) > 1
    assert len(rows) == 1 + 2 * len(checked.outcomes)


def test_json_has_the_judgement(folder: Path, checked: CalibrationCheck) -> None:
    """It is strict JSON, and has the checks by name."""
    content = json.loads((folder / "calibration.json").read_text(), parse_constant=pytest.fail)
    assert content["passed"] == checked.passed
    assert len(content["coverage"]) == len(checked.coverage)
    assert content["schedule"]["logs"] == 12


@pytest.mark.parametrize(
    ("n", "width", "state"), [(120, 1.0, "good"), (120, 0.5, "bad"), (6, 1.0, "open")]
)
def test_the_verdict_is_good_bad_or_open(n: int, width: float, state: str) -> None:
    """As stated; not as stated; too few lives."""
    found, headline, why = verdict_of(summary(outcomes(n, width)))
    assert found == state
    assert headline
    assert why


def test_bars_beyond_the_band_have_another_colour() -> None:
    """Uniform ranks are of one colour, those of narrow intervals not."""
    from matplotlib.figure import Figure

    def colours(places: np.ndarray) -> int:
        ax = rank_histogram(Figure().add_subplot(), places)
        (bars,) = ax.containers
        return len({bar.get_facecolor() for bar in bars})

    rng = np.random.default_rng(0)
    assert colours(rng.uniform(size=150)) == 1
    assert colours(rng.beta(0.3, 0.3, size=150)) == 2
    assert "Good: " in histogram_picture("t", rng.uniform(size=9), "", salt="s").caption


def test_a_share_apart_from_what_is_stated_has_another_colour() -> None:
    """Its interval misses the dashed line."""
    from matplotlib.figure import Figure

    rows = [Share("a", 0.5, 0.4, 0.6, 0.5), Share("b", 0.2, 0.1, 0.3, 0.5), Share("c", 1, 1, 1)]
    ax = share_plot(Figure().add_subplot(), rows)
    points = [line.get_color() for line in ax.lines if line.get_marker() == "o"]
    assert points[0] == points[2] != points[1]


def test_colours_are_those_of_the_verdict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the rule over all checks passes is not red, though its 95 % interval alone misses."""
    shown: dict[str, Share] = {}

    def record(title: str, rows: list[Share], caption: str, **_: Any) -> pages.Picture:
        shown.update({one.label: one for one in rows})
        return pages.Picture(title, "", caption)

    monkeypatch.setattr(pages, "share_picture", record)
    ends = [np.linspace(0.002, 0.048, 9), np.linspace(0.952, 0.998, 8)]
    places = np.concatenate([*ends, np.linspace(0.055, 0.945, 83)]).tolist()
    chance = [
        msgspec.structs.replace(one, places={HEALTH: place})
        for one, place in zip(outcomes(100, late=0.11), places, strict=True)
    ]
    write_results(tmp_path, found := summary(chance))
    assert found.wrong == ()
    held = shown[f"{DRAWN}, 90 %"], shown[f"{DRAWN}: limit reached before the service date"]
    assert held[0].high < 0.9 and held[1].low > 0.05
    assert not any(one.missed for one in held)
    write_results(tmp_path, found := summary(outcomes(120, 0.5, late=0.3)))
    assert "as described: limit reached before the service date" in found.wrong
    assert shown[f"{DRAWN}, 90 %"].missed
    assert shown[f"{DRAWN}: limit reached before the service date"].missed


def test_what_is_beyond_the_horizon_is_an_empty_cell() -> None:
    """As in prognosis.csv, of truth, quantiles and service; other numbers stay."""
    (life,) = outcomes(1)
    endless = msgspec.structs.replace(
        life,
        truth={HEALTH: 0.5, DAYS: np.inf},
        places={HEALTH: 0.4, DAYS: 0.5},
        quantiles={**life.quantiles, DAYS: (90.0, 95.0, np.inf, np.inf, np.inf)},
        service="later",
        wait=np.inf,
    )
    text = csv_text("calibration_lives", life_rows(summary([endless])))
    health, days = text.splitlines()[1:]
    assert health.endswith(f"{HEALTH},0.5,-1.0,-0.5,0.0,0.5,1.0,0.4,healthy,,later,,")
    assert days.endswith(f"{DAYS},,90.0,95.0,,,,0.5,healthy,,later,,")
