"""Findings: the sentence that a description deserves, and no other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from lmshealth.stage.check import StageCheck, check_stage, diagnose
from lmshealth.stage.description import load_stage
from tests.lives import FOOT, MOUNT, PRELOAD, make_stage, stage_text

INSIDE = 'kind = "lognormal", median = 1.0, sigma = 0.3'
NARROW = 'kind = "lognormal", median = 0.9, sigma = 0.1'


@pytest.fixture(scope="module")
def fine(tmp_path_factory: pytest.TempPathFactory) -> StageCheck:
    """Two parameters whose priors lie inside the map, two modes."""
    parts = tuple(part.replace(INSIDE, NARROW) for part in (PRELOAD, MOUNT))
    return check_stage(make_stage(tmp_path_factory.mktemp("fine"), parts))


def faults(examined: StageCheck) -> list[str]:
    """List what may have to be mended."""
    return [finding.text for finding in diagnose(examined) if not finding.good]


def merits(examined: StageCheck) -> str:
    """Join what is good."""
    return "\n".join(finding.text for finding in diagnose(examined) if finding.good)


def test_a_description_in_order_has_no_faults(fine: StageCheck) -> None:
    """Both parameters are told, with how well, and how their errors go together."""
    assert faults(fine) == []
    text = merits(fine)
    assert "guide_preload can be told: 5 logs of 60 s know it to" in text
    assert (
        "guide_preload and mount_stiffness can be told apart, their errors correlate by -" in text
    )
    assert "too high, the other tends down" in text
    assert "at most the 1e-05 wanted" in text


def test_errors_that_hardly_correlate_are_not_explained(fine: StageCheck) -> None:
    """The number stands alone; a positive one goes the same way."""
    small, large = fine.correlation * [[1, 0.1], [0.1, 1]], abs(fine.correlation)
    assert "tends" not in merits(replace(fine, correlation=small))
    assert "the other tends up too" in merits(replace(fine, correlation=large))


def test_what_the_map_hides_and_what_no_mode_feels(tmp_path: Path) -> None:
    """The X stage needs a better map for its mount; a foot that moves nothing needs a mode."""
    (text,) = faults(check_stage(load_stage("lms-x")))
    assert text.startswith("mount_stiffness is not identifiable: 5 logs of 60 s leave it known to")
    assert "less than the map's error" in text
    assert "with an exact map it would be 9.2 %" in text
    parts = (PRELOAD.replace(INSIDE, NARROW), FOOT)
    (text,) = faults(check_stage(make_stage(tmp_path, parts)))
    assert text.startswith("foot is not identifiable")
    assert "hardly feel it" in text


def test_combinations_are_written_as_powers(tmp_path: Path) -> None:
    """One mode that two parameters move tells their product."""
    parts = tuple(part.replace(INSIDE, NARROW) for part in (PRELOAD, MOUNT))
    found = faults(check_stage(make_stage(tmp_path, parts, n_modes=1)))
    assert any("together with others: guide_preload · mount_stiffness^3." in text for text in found)


def test_noise_is_told_from_what_no_log_shows(fine: StageCheck) -> None:
    """What more logs would tell is said so."""
    first = replace(fine.parameters[0], verdict="longer-logs")
    (text,) = faults(replace(fine, parameters=(first, fine.parameters[1])))
    assert text.startswith("guide_preload can be told by more or longer logs only")


def test_a_prior_and_a_limit_beyond_the_map(tmp_path: Path) -> None:
    """Both say how far the map reaches."""
    low = PRELOAD.replace("below = 0.6", "below = 0.1")
    found = faults(check_stage(make_stage(tmp_path, (low,))))
    assert any("from 0.2 to 1.5, and 8.8 % of its prior lies beyond" in text for text in found)
    assert any("limit 0.1 of guide_preload does not lie inside" in text for text in found)


def test_a_surrogate_is_judged_by_target_and_logs(fine: StageCheck) -> None:
    """Above the target is a fault where it may limit; above what logs reach the grid is too coarse.

    Far below what logs reach it is said to be above the target, and is no fault.
    """
    reached = fine.modes[0].reached
    slight = replace(fine.modes[0], surrogate_error=0.04 * reached)
    text = merits(replace(fine, modes=(slight, fine.modes[1])))
    assert "wanted; 4 % of what usual logs reach. It does not limit what can be told." in text
    for error, needle in (
        (0.06 * reached, "more than the 1e-05 wanted"),
        (2e-3, "grid denser"),
    ):
        modes = (replace(fine.modes[0], surrogate_error=error), fine.modes[1])
        (text,) = faults(replace(fine, modes=modes))
        assert needle in text
        assert "(roll)" in text


def test_modes_where_the_map_does_not_have_them(fine: StageCheck) -> None:
    """Outside the band that is searched, at the baseline or at the limits."""
    away = replace(fine.modes[0], map_frequency=150.0)
    worn = replace(fine.modes[1], limit_frequency=110.0)
    first, second = faults(replace(fine, modes=(away, worn)))
    assert first.startswith("roll is looked for from 107.4 to 145.4 Hz, and the map has it at 150")
    assert "110 Hz with every parameter at its limit" in second


def test_modes_that_only_one_side_knows(tmp_path: Path) -> None:
    """Followed but not on the map, and on the map but not described: told, not blamed."""
    make_stage(tmp_path)
    (tmp_path / "small.toml").write_text(stage_text(n_modes=2).replace('"pitch"', '"sway"'))
    text = merits(check_stage(load_stage(str(tmp_path / "small.toml"))))
    assert "sway is followed but not on the map" in text
    assert "The map also has pitch" in text


def test_a_description_without_health_says_so(tmp_path: Path) -> None:
    """One sentence, and no fault."""
    (finding,) = diagnose(check_stage(make_stage(tmp_path, ())))
    assert finding.good
    assert "no health is inferred" in finding.text
