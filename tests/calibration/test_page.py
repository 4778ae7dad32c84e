"""The results of a check: tables, JSON, and a page that a stranger can read."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from lmshealth._private.tables import TABLES
from lmshealth.calibration.check import CalibrationCheck
from lmshealth.calibration.page import (
    Share,
    histogram_picture,
    rank_histogram,
    share_plot,
    verdict_of,
    write_results,
)
from tests.calibration.test_check import outcomes, summary


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
