"""What other machines taught, in words on the page of a young machine."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from lmshealth.prognosis.fleet_prior import FleetPrior, LawPrior
from lmshealth.prognosis.life_likelihood import expected_scatter, scatter_prior
from lmshealth.report.fleetfacts import taught
from lmshealth.report.machine_page import write_report
from lmshealth.report.text import GAP
from lmshealth.stage.description import ScatterPrior, load_stage
from lmshealth.stage.priors import Lognormal, Normal
from tests.assessments import worn

SCATTER = ScatterPrior((0.0, 1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
LEARNED = FleetPrior(
    n_machines=25,
    laws=(
        LawPrior(
            "guide_preload",
            "hertz-wear",
            (0.5, 0.82),
            "life_km",
            (Lognormal(8000, 1.0), Lognormal(4100, 0.5)),
        ),
        LawPrior("guide_preload", "none", (0.5, 0.18), "", None),
        LawPrior(
            "belt", "linear", (1.0, 1.0), "rate_per_km", (Normal(0, 1e-4), Normal(2e-5, 5e-5))
        ),
    ),
    scatter=SCATTER,
)


def plain(text: str) -> str:
    """Read text as a person does, with one space for every gap."""
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text.replace(GAP, " ")))


def test_priors_are_told_before_and_after() -> None:
    """Shares, medians and 90 % ranges are those of the priors; scatter is told by its means."""
    told = taught(LEARNED, load_stage("lms-y"))
    assert told is not None
    assert told.n_machines == 25
    wear, none, belt = [[plain(cell) for cell in row] for row in told.laws]
    assert wear == [
        "guide preload, wear of the contacts (Hertz)",
        "50 %; life 8 000 km (1 540 to 41 400 km)",
        "82 %; life 4 100 km (1 800 to 9 330 km)",
    ]
    assert none == ["guide preload, no change", "50 %", "18 %"]
    assert belt[2] == "above 99 %; 2 % per 1 000 km (−6.2 to 10 %)"
    walk, factor, deviation = [[plain(cell) for cell in row] for row in told.scatter]
    assert walk == ["random walk of ln frequency", "0.44 %", "0.05 %"]
    assert factor == ["factor on reported errors", "1.07", "1.50"]
    assert deviation == ["health about its law", "2.70 %", "0.00 %"]


def test_expected_scatter_is_what_is_believed() -> None:
    """A stage is believed to scatter as every stage, until it is told otherwise."""
    stage = load_stage("lms-y")
    assert expected_scatter(scatter_prior(replace(stage, scatter=SCATTER))) == (5e-4, 1.5, 0.0)
    assert scatter_prior(stage) == scatter_prior(replace(stage, digest="another"))


@pytest.mark.slow
def test_page_of_a_young_machine_names_what_it_was_taught(tmp_path: Path) -> None:
    """The page says from how many machines a prior was learned; without one it says nothing."""
    assessment = worn(tmp_path)
    pages = [
        plain(write_report(tmp_path / name, [one], ())[0].read_text(encoding="utf-8"))
        for name, one in (("own", assessment), ("taught", replace(assessment, fleet=LEARNED)))
    ]
    heading = "What other machines teach"
    assert heading not in pages[0]
    assert heading in pages[1]
    assert "learned from 25 other machines of the description lms-y" in pages[1]
    assert "82 %; life 4 100 km (1 800 to 9 330 km)" in pages[1]
