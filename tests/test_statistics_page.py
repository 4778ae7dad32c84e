"""The page of `make statistics`: every claim with its control, interval and ranks."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.claims import Claims, Part
from tests.statistical import evidence
from tests.statistical.page import _TITLES, write_page

PART = Part(200, ("ranks", "rate", "squares"))


def rows() -> list[dict[str, object]]:
    """Make the claims of one test."""
    rng, claims = np.random.default_rng(1), Claims("life", PART, 0.01, 3)
    claims.claim("ranks", evidence.uniform(rng.uniform(size=200)))
    claims.control("ranks", evidence.uniform(0.5 + 0.5 * (rng.uniform(size=200) - 0.5)))
    claims.claim("rate", evidence.at_most(1, 200, 0.05))
    claims.control("rate", evidence.at_most(60, 200, 0.05))
    claims.claim("squares", evidence.sum_of_squares(200, 200))
    claims.control("squares", evidence.sum_of_squares(400, 200))
    return claims.rows()


@pytest.mark.parametrize(
    ("rejected", "failed", "headline"),
    [(False, False, "All claims hold"), (True, True, "Not all claims hold"),
     (False, True, "Not all claims hold")],
)  # fmt: skip
def test_the_page_has_all_claims(
    rejected: bool, failed: bool, headline: str, tmp_path: Path
) -> None:
    """Figures say what good looks like; shares have intervals, claims p values and controls."""
    made, target = rows(), tmp_path / "page.html"
    held = [(0.003, rejected), (0.005, False), (0.01, False)]
    write_page(target, made, held, failed=failed, made="today")
    page = target.read_text(encoding="utf-8")
    assert headline in page
    assert ("REJECTED" in page) == rejected
    for part in PART.claims:
        assert f">{part}<" in page
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", page, re.S)
    assert len(captions) == 3
    assert sum("Good: " in caption for caption in captions) == 2
    assert "must not look good" in page and "make statistics, today;" in page
    assert "stated at most 5 %" in page
    assert "0.5 % (0.0127 to 2.75)" in page


def test_a_sum_of_squares_has_its_mean_and_interval(tmp_path: Path) -> None:
    """The interval holds the true mean square where the sum is what it should be."""
    claims = Claims("filter", Part(9, ("errors",)), 0.01, 1)
    claims.claim("errors", evidence.sum_of_squares(110, 100))
    (row,) = claims.rows()
    assert row["text"] == "mean square 1.1 (0.849 to 1.48), stated 1"
    write_page(tmp_path / "page.html", [{**row, "name": "tracking: errors"}], [(0.01, False)],
               failed=False, made="today")  # fmt: skip
    assert row["text"] in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_some_claims_are_not_all(tmp_path: Path) -> None:
    """A run of some tests holds no more than these."""
    made = rows()[:1]
    write_page(tmp_path / "page.html", made, [(0.003, False)], failed=False, made="today")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "Claims that were tested hold" in text
    assert "1 of 3 claims" in text


def test_a_p_value_keeps_what_it_is_of() -> None:
    """Counts and places travel with it, as plain lists; of claims made as one all counts."""
    (row, other, _) = rows()
    assert len(row["places"]) == 200  # type: ignore[arg-type]
    assert [share[2] for share in row["shares"]] == [0.5, 0.9]  # type: ignore[attr-defined]
    assert other["shares"] == [[1, 200, 0.05, "most"]]
    both = evidence.all_of([evidence.at_least(9, 10, 0.5), evidence.at_least(1, 10, 0.5)])
    assert both == pytest.approx(2 * 11 / 1024)
    assert len(both.shares) == 2


def test_every_group_of_claims_has_a_title(root: Path) -> None:
    """Those of all files of statistical tests."""
    files = (root / "tests" / "statistical").glob("test_*_calibration.py")
    assert {path.stem[5:-12] for path in files} == set(_TITLES)
