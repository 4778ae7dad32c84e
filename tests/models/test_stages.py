"""Tests of the stages' numbers."""

from dataclasses import fields, replace

import pytest

from models.errors import BadParameter, UnknownStage
from models.stages import SOURCES, STAGES, Condition, Number, Point, stage_named


def test_every_number_has_unit_and_source():
    """No number of a stage is without unit or source."""
    for stage in STAGES.values():
        for field in fields(stage):
            entry = getattr(stage, field.name)
            if not isinstance(entry, str):
                assert isinstance(entry, Number | Point)
                assert entry.unit
                assert entry.source in SOURCES


def test_both_stages_share_one_guide():
    """X and Y have the same blocks at the same places."""
    x, y = STAGES["lms-x"], STAGES["lms-y"]
    for name in ("block_stiffness", "block_lateral_ratio", "block_half_spacing", "guide_loss_time"):
        assert getattr(x, name) == getattr(y, name)


def test_unknown_stage_lists_the_known():
    """An unknown stage raises and says which exist."""
    with pytest.raises(UnknownStage, match="lms-x, lms-y") as caught:
        stage_named("lms-z")
    assert caught.value.got == "lms-z"


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), 1e3])
def test_impossible_condition_is_refused(bad):
    """A preload that is no positive fraction raises."""
    with pytest.raises(BadParameter, match="guide_preload"):
        Condition(guide_preload=bad)


def test_unknown_source_is_refused():
    """A number of unstated origin raises."""
    with pytest.raises(BadParameter, match="moving_mass"):
        replace(STAGES["lms-x"], moving_mass=Number(23.5, "kg", "somewhere"))
