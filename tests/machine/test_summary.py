"""Summaries of assessments: verdict in words, health, remaining life."""

from __future__ import annotations

from dataclasses import replace
from datetime import date, timedelta

import numpy as np
import pytest
from msgspec import structs

from lmshealth.machine.summary import Summary, first_limit, summarise, summarise_life
from lmshealth.report.text import headline as headline_of
from lmshealth.report.text import next_step, time_left, travel_left
from lmshealth.tracking.filters.track_state import Event
from tests.assessments import Assessment, Maker, blind, make, nothing

__all__ = ["make"]


def summary(assessment: Assessment) -> Summary:
    """Summarise an assessment."""
    return summarise(assessment, assessment.service())


@pytest.mark.parametrize(
    ("verdict", "headline", "state"),
    [
        ("healthy", "Healthy", "good"),
        ("preload", "Loss of guide preload", "bad"),
        ("mount", "Loss of mount stiffness", "bad"),
        ("both", "Loss of guide preload and mount stiffness", "bad"),
        ("step", "Sudden change without a known cause", "bad"),
        ("outside-map", "Modes moved by a cause outside the map", "open"),
        ("not-enough-data", "Not enough data for a verdict", "open"),
        ("no-alarm", "Modes tracked, no alarm", "open"),
    ],
)
def test_every_verdict_has_a_headline(make: Maker, verdict: str, headline: str, state: str) -> None:
    """A loss names the parameters of the description."""
    assessment = make()
    found = summary(replace(assessment, judgement=replace(assessment.judgement, verdict=verdict)))
    assert (headline_of(found), found.state) == (headline, state)


def test_an_alarm_replaces_a_missing_verdict(make: Maker) -> None:
    """An alarm without a verdict is the headline and most urgent; with a verdict it is not."""
    assessment = make()
    track = assessment.track
    assert track is not None
    last = len(track.recorded_at) - 1
    alarm = Event("alarm", last, track.modes[0], "", -0.02, 0.001, 9.0, False, last)
    judged = replace(assessment, track=replace(track, events=(alarm,)))
    judgement = replace(assessment.judgement, verdict="not-enough-data")
    found = replace(judged, judgement=judgement)
    expected = (f"Alarm: unexplained change of {track.modes[0]}", "bad")
    assert (headline_of(summary(found)), summary(found).state) == expected
    assert found.urgency(found.service())[0] == 0
    quiet = replace(found, track=replace(track, events=()))
    assert quiet.urgency(quiet.service())[0] == 1
    assert judged.alarmed == ()


def test_a_description_without_parameters_has_no_verdict(make: Maker) -> None:
    """Without a health parameter the headline does not ask for more data."""
    assessment = make()
    description = structs.replace(assessment.stage.description, parameter=(), map=None)
    stage = replace(assessment.stage, description=description)
    judgement = replace(assessment.judgement, verdict="no-alarm")
    found = summary(replace(assessment, stage=stage, health=None, judgement=judgement))
    assert (headline_of(found), found.state) == ("Modes tracked, no alarm", "open")


def test_health_is_that_of_the_draws(make: Maker) -> None:
    """Quantiles are those of the last epoch; a parameter that the data do not inform is marked."""
    assessment = make()
    assert assessment.health is not None
    found = summary(assessment).health
    expected = assessment.health.latest(np.array([0.05, 0.5, 0.95])).T
    np.testing.assert_allclose([(one.low, one.median, one.high) for one in found], expected)
    for k, one in enumerate(found):
        assert one.limit is not None
        draws = assessment.health.samples[-1, :, k]
        assert one.below_limit == np.mean(draws < one.limit)
    assert [one.determined for one in summary(blind(assessment)).health] == [True, False]


def test_a_mode_that_moved_alone_orders_no_service(make: Maker) -> None:
    """What to do is to look for its cause, before any service that was not overdue then."""
    assessment = make()
    outside = replace(assessment.judgement, verdict="outside-map")
    found = summary(replace(assessment, judgement=outside))
    sentence = next_step(found.step)
    assert sentence.startswith("Find out what moved the modes: sensors, cables, payload")
    assert summary(assessment).step.kind in ("plan", "service-now")
    healthy = make("sound", wear_km=400000, floor=0.98)
    assert found.urgency < summary(healthy).urgency
    day = assessment.judgement.recorded_at.date()
    for kind in (assessment, healthy):
        due = [replace(kind.service(), kind="by", by=day + timedelta(days=n)) for n in (-1, 1)]
        overdue, planned = (kind.urgency(service) for service in due)
        assert overdue < found.urgency < planned


def test_a_sudden_change_comes_first(make: Maker) -> None:
    """Until its cause is known it stands before worn machines, though no service is due."""
    assessment = make("sound", wear_km=400000, floor=0.98)
    jumped = replace(assessment, judgement=replace(assessment.judgement, verdict="step"))
    assert jumped.urgency(jumped.service()) < make().urgency(make().service())


def test_machines_are_sorted_by_the_calendar(make: Maker) -> None:
    """A service on an earlier day comes first, whatever the days since the last log are."""
    assessment = make()
    service = assessment.service()
    overdue = replace(service, kind="by", by=date(2026, 1, 1), wait=90.0)
    due = replace(service, kind="by", by=date(2026, 3, 1), wait=10.0)
    later = replace(service, kind="later", by=None, wait=np.inf)
    keys = [assessment.urgency(one) for one in (overdue, due, later)]
    assert keys == sorted(keys) and len(set(keys)) == 3


def test_gauges_and_limits_are_of_the_same_draws(make: Maker) -> None:
    """A gauge shows the last epoch alone, whatever the laws of the prognosis are."""
    assessment = make()
    assert assessment.health is not None
    low = replace(
        assessment, health=replace(assessment.health, chains=assessment.health.chains / 2)
    )
    gauge, other = summary(assessment).health[0], summary(low).health[0]
    np.testing.assert_allclose(
        (other.low, other.median, other.high), np.divide((gauge.low, gauge.median, gauge.high), 2)
    )
    assert low.service() == assessment.service()


def test_without_results_a_summary_has_no_numbers(make: Maker) -> None:
    """Without health and prognosis: no parameters, no life, no date."""
    found = summary(nothing(make()))
    assert found.health == () and found.life is None and found.service.by is None
    assert np.isnan(found.probability)


def test_the_first_limit_is_named(make: Maker) -> None:
    """The parameter whose limit is first in most draws; None when no draw ends."""
    prognosis = make().prognosis
    assert prognosis is not None
    assert prognosis.parameters == ("guide_preload", "mount_stiffness", "any")
    n = len(prognosis.remaining)
    preload, mount = np.full(n, 4e5), np.full(n, 5e5)
    mount[: n // 4] = 3e5
    draws = np.stack([preload, mount, np.minimum(preload, mount)], axis=1)
    share = 1 - (n // 4) / n
    assert first_limit(replace(prognosis, remaining=draws)) == ("guide_preload", share)
    assert first_limit(replace(prognosis, remaining=np.full((n, 3), np.inf))) is None
    assert first_limit(None) is None


def test_censored_and_negative_lives(make: Maker) -> None:
    """Draws beyond the horizon are infinite, negative ones count as already passed."""
    assessment = make()
    prognosis, stage = assessment.prognosis, assessment.stage
    assert prognosis is not None
    endless = replace(prognosis, remaining=np.full_like(prognosis.remaining, np.inf))
    life = summarise_life(endless, stage)
    assert {travel_left(m, life.horizon) for m in life.any.travel} == {"beyond 20\u202f000\u202fkm"}
    over = replace(prognosis, remaining=np.full_like(prognosis.remaining, -1.0))
    assert set(map(time_left, summarise_life(over, stage).limits[0].days)) == {"already passed"}


def test_limits_in_other_units_are_shown_as_fractions(make: Maker) -> None:
    """A parameter with a baseline of 5 kN has its limit as a fraction of it."""
    assessment = make()
    prognosis, stage = assessment.prognosis, assessment.stage
    assert prognosis is not None
    preload, mount = stage.description.parameter
    in_newton = structs.replace(preload, baseline=5000.0, unit="N")
    described = structs.replace(stage.description, parameter=(in_newton, mount))
    scaled = replace(prognosis, limits=prognosis.limits * [5e3, 1, 1])
    one, other = (
        summarise_life(life, own).limits[0]
        for life, own in ((prognosis, stage), (scaled, replace(stage, description=described)))
    )
    assert other.share == pytest.approx(one.share)
