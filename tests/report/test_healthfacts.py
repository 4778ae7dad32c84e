"""What is said first of a stage: verdict, gauges, lives and service in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from lmshealth.report.assessment import Assessment
from lmshealth.report.healthfacts import (
    first_limit,
    gauges,
    health_now,
    how_sure,
    lives,
    service_words,
    tone,
    verdict_words,
)
from lmshealth.report.text import percent
from lmshealth.tracking.track import Event
from tests.report.test_machine_page import blind, make, nothing

__all__ = ["make"]
Maker = Callable[..., Assessment]


@pytest.mark.parametrize(
    ("verdict", "words", "colour"),
    [
        ("healthy", "Healthy", "good"),
        ("preload", "Loss of guide preload", "bad"),
        ("mount", "Loss of mount stiffness", "bad"),
        ("both", "Loss of guide preload and mount stiffness", "bad"),
        ("mount+foot", "Loss of mount stiffness", "bad"),
        ("step", "A sudden change that nothing explains", "bad"),
        ("not-enough-data", "Not enough data for a verdict", "open"),
    ],
)
def test_every_verdict_has_words(make: Maker, verdict: str, words: str, colour: str) -> None:
    """A loss names the parameters of the description that its word stands for."""
    assessment = make()
    judgement = replace(assessment.judgement, verdict=verdict)
    told = replace(assessment, judgement=judgement)
    assert (verdict_words(told), tone(told)) == (words, colour)


def test_an_alarm_is_told_where_there_is_no_verdict(make: Maker) -> None:
    """It is bad news that stands first, however little else is known; a verdict goes before it."""
    assessment = make()
    track = assessment.track
    assert track is not None
    last = len(track.recorded_at) - 1
    alarm = Event("alarm", last, track.modes[0], "", -0.02, 0.001, 9.0, False, last)
    judged = replace(assessment, track=replace(track, events=(alarm,)))
    judgement = replace(assessment.judgement, verdict="not-enough-data")
    told = replace(judged, judgement=judgement)
    assert (verdict_words(told), tone(told)) == (f"Alarm: {track.modes[0]} moved", "bad")
    assert told.urgency(told.service())[0] == 0
    quiet = replace(told, track=replace(track, events=()))
    assert quiet.urgency(quiet.service())[0] == 1
    assert judged.alarmed == ()


def test_modes_that_are_only_followed_ask_for_no_verdict(make: Maker) -> None:
    """Who describes no part is not told to bring more data."""
    assessment = make()
    description = structs.replace(assessment.stage.description, parameter=())
    stage = replace(assessment.stage, description=description)
    judgement = replace(assessment.judgement, verdict="not-enough-data")
    told = replace(assessment, stage=stage, judgement=judgement)
    assert (verdict_words(told), tone(told)) == ("Modes followed, no verdict asked for", "open")


def test_gauges_share_a_length_and_keep_their_places(make: Maker) -> None:
    """Places are percent of one length, in order; a given length moves them all alike."""
    assessment = make()
    assert assessment.health is not None
    own, long = gauges(assessment), gauges(assessment, 3.0)
    for gauge, other, median in zip(own, long, assessment.health.latest(0.5).ravel(), strict=True):
        places = gauge.places
        assert 0 < places["low"] < places["median"] < places["high"] <= 100
        assert other.places["median"] == pytest.approx(100 * median / 3, abs=0.01)
        assert other.places["baseline"] == pytest.approx(100 / 3, abs=0.01)
        assert gauge.value == other.value == f"{100 * median:.0f}\u202f%"
    assert [gauge.told for gauge in gauges(blind(assessment))] == [True, False]


def test_nothing_known_gives_nothing(make: Maker) -> None:
    """Without health and prognosis there are no gauges, lives, date and probability."""
    bare = nothing(make())
    assert health_now(bare) is None and gauges(bare) == () and lives(bare.prognosis) == ()
    assert how_sure(bare) == "" and service_words(bare.service())["by"] is None


def test_the_part_that_limits_is_named(make: Maker) -> None:
    """That whose limit is first in most draws, with their share; nothing where none ends."""
    prognosis = make().prognosis
    assert prognosis is not None
    assert prognosis.parameters == ("guide_preload", "mount_stiffness", "any")
    n = len(prognosis.remaining)
    preload, mount = np.full(n, 4e5), np.full(n, 5e5)
    mount[: n // 4] = 3e5
    draws = np.stack([preload, mount, np.minimum(preload, mount)], axis=1)
    share = 1 - (n // 4) / n
    assert first_limit(replace(prognosis, remaining=draws)) == ("guide preload", percent(share))
    assert first_limit(replace(prognosis, remaining=np.full((n, 3), np.inf))) is None
    assert first_limit(None) is None


def test_a_life_that_ends_nowhere_has_no_number(make: Maker) -> None:
    """Draws past the horizon are told as such, those past the limit as passed."""
    prognosis = make().prognosis
    assert prognosis is not None
    endless = replace(prognosis, remaining=np.full_like(prognosis.remaining, np.inf))
    assert set(lives(endless)[-1].km) == {"beyond 20\u202f000\u202fkm"}
    over = replace(prognosis, remaining=np.full_like(prognosis.remaining, -1.0))
    assert set(lives(over)[0].days) == {"already passed"}
