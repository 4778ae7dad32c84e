"""Verdicts in one word."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lmshealth._private.arrays import FloatArray
from lmshealth.life import constants
from lmshealth.life.posterior.fit import LoneMode
from lmshealth.life.posterior.likelihood import NO_MODE
from lmshealth.life.verdict import (
    OUTSIDE_MAP,
    degraded_below,
    degraded_words,
    doubt_of_names,
    judge,
    lone_sentence,
    verdict_of,
)
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.filters.track_state import Event
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track
from tests.lives import (
    FOOT,
    FREQUENCY,
    MOUNT,
    PRELOAD,
    make_health,
    make_history,
    make_reading,
    make_stage,
    make_track,
)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Preload with limit 0.6 and mount with limit 0.7."""
    return make_stage(tmp_path_factory.mktemp("stage"))


def logs(n: int) -> History:
    """Make a history of so many logs."""
    return make_history(np.tile(np.log(FREQUENCY[:2]), (n, 1)))


def around(preload: float, mount: float, n: int = 1000) -> FloatArray:
    """Draw health closely around two values."""
    return np.random.default_rng(1).normal([preload, mount], 0.005, (n, 2))


def test_degraded_is_a_quarter_of_what_may_be_lost(stage: Stage, tmp_path: Path) -> None:
    """Without a limit a loss of 40 % is the limit."""
    assert [degraded_below(p) for p in stage.parameters] == pytest.approx([0.9, 0.925])
    foot = make_stage(tmp_path, (PRELOAD, MOUNT, FOOT)).parameters[2]
    assert degraded_below(foot) == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("preload", "mount", "word"),
    [
        (0.99, 1.0, "healthy"),
        (0.8, 0.99, "preload"),
        (0.98, 0.8, "mount"),
        (0.7, 0.75, "both"),
        # No wear raises a parameter: other resonances may have taken the names of the modes.
        (1.24, 1.0, "outside-map"),
        (1.05, 1.0, "healthy"),
        (1.24, 0.8, "mount"),
    ],
)
def test_the_verdict_is_that_of_the_draws(
    stage: Stage, preload: float, mount: float, word: str
) -> None:
    """Clear cases get their word with probability near 1, and numbers in the sentence."""
    found = judge(stage, logs(8), make_health(around(preload, mount)))
    assert found.verdict == word
    assert found.probability > 0.99
    assert f"Guide preload is at {100 * preload:.0f} %" in found.why
    said = "Guide preload is above its baseline value, which no wear does"
    assert found.why.startswith(said) is (word == "outside-map")
    assert found.recorded_at == logs(8).recorded_at[-1]


def test_the_probability_is_the_share_of_the_draws(stage: Stage) -> None:
    """Six draws in ten with worn preload: the word is preload, its probability 0.6."""
    samples = np.ones((10, 2))
    samples[:6, 0] = 0.8
    found = judge(stage, logs(8), make_health(samples))
    assert (found.verdict, found.probability) == ("preload", pytest.approx(0.6))


NAMES = ("guide_preload", "mount_stiffness", "foot")


@pytest.mark.parametrize(
    ("health", "verdict"),
    [
        ((0.99, 1.0, 1.0), "healthy"),
        ((0.99, 1.0, 0.7), "foot"),
        ((0.7, 1.0, 0.7), "preload+foot"),
        ((0.7, 0.7, 1.0), "both"),
        ((0.7, 0.7, 0.7), "preload+mount+foot"),
    ],
)
def test_a_verdict_names_every_degraded_parameter(
    tmp_path: Path, health: tuple[float, ...], verdict: str
) -> None:
    """A parameter that is neither preload nor mount is named as the description names it."""
    three = make_stage(tmp_path, (PRELOAD, MOUNT, FOOT))
    draws = np.random.default_rng(1).normal(health, 0.005, (1000, 3))
    found = judge(three, logs(8), make_health(draws, parameters=NAMES, informed=(0.9,) * 3))
    assert found.verdict == verdict
    assert verdict_of(degraded_words(verdict)) == verdict
    assert found.probability > 0.99


def test_an_uninformed_parameter_is_left_out(stage: Stage) -> None:
    """An uninformed mount is not in the verdict, however low its draws are, but named."""
    found = judge(stage, logs(8), make_health(around(0.99, 0.5), informed=(0.9, 0.1)))
    assert found.verdict == "healthy"
    assert "Mount stiffness: not constrained by these logs." in found.why


YAW = LoneMode("yaw", -0.02, 0.001, 0.8)


def alone(share: float, n: int = 1000) -> np.ndarray:
    """Let yaw move alone in the first draws."""
    return np.where(np.arange(n) < share * n, 2, NO_MODE)


@pytest.mark.parametrize(("share", "verdict"), [(0.8, OUTSIDE_MAP), (0.3, "healthy")])
def test_a_mode_that_moves_alone_in_most_draws_is_the_verdict(
    stage: Stage, share: float, verdict: str
) -> None:
    """With its drift and what to check, and health beside it; its probability is that of draws."""
    health = make_health(around(0.99, 1.0), lone=alone(share), lone_modes=(YAW,))
    found = judge(stage, logs(8), health)
    assert (found.verdict, found.probability) == (verdict, pytest.approx(max(share, 1 - share)))
    said = found.why.startswith(lone_sentence(YAW, stage))
    assert said == (verdict == OUTSIDE_MAP)
    assert "Guide preload is at 99 %" in found.why
    assert degraded_words(OUTSIDE_MAP) == ()


def test_the_sentence_about_a_mode_that_moves_alone_has_its_size(stage: Stage) -> None:
    """In percent, with its standard deviation, and the parameters that do not do this."""
    said = lone_sentence(YAW, stage)
    assert said.startswith("Yaw has moved by −2.0 ± 0.1 % alone; no state of guide preload and")


def test_a_mode_that_moves_alone_counts_only_without_a_loss(stage: Stage) -> None:
    """Draws with a loss are of the loss, whatever else moved; the most probable is the verdict."""
    worn = make_health(around(0.7, 1.0), lone=alone(1.0), lone_modes=(YAW,))
    found = judge(stage, logs(8), worn)
    assert (found.verdict, found.probability) == ("preload", pytest.approx(1.0))
    half = np.vstack([around(0.7, 1.0, 400), around(0.99, 1.0, 600)])
    mixed = make_health(half, lone=np.where(np.arange(1000) < 650, NO_MODE, 2), lone_modes=(YAW,))
    found = judge(stage, logs(8), mixed)
    # 400 draws of a loss, 250 healthy ones, and 350 in which yaw moved alone.
    assert (found.verdict, found.probability) == ("preload", pytest.approx(0.4))


def test_modes_that_may_each_have_moved_alone_count_together(stage: Stage) -> None:
    """Of 33 draws in a hundred roll, of 32 yaw moved alone: one of them has, and roll is named."""
    lone = np.repeat([0, 2, NO_MODE], [330, 320, 350])
    roll = LoneMode("roll", -0.02, 0.001, 0.33)
    health = make_health(around(0.99, 1.0), lone=lone, lone_modes=(roll, YAW))
    found = judge(stage, logs(8), health)
    assert (found.verdict, found.probability) == (OUTSIDE_MAP, pytest.approx(0.65))
    assert found.why.startswith(lone_sentence(roll, stage))


def test_a_mode_that_moves_alone_without_informed_health_is_no_verdict(stage: Stage) -> None:
    """Where the logs constrain no parameter, none of the draws counts."""
    health = make_health(around(0.99, 1.0), informed=(0.1, 0.1), lone=alone(1.0), lone_modes=(YAW,))
    assert judge(stage, logs(8), health).verdict == "not-enough-data"


def stepped(*, declared: bool = False, epoch: int = 5, evidence: float = 30.0) -> Track:
    """Make a track with one step of roll and pitch."""
    events = tuple(
        Event("step", epoch, mode, "", size, 0.001, evidence, declared, epoch + 1)
        for mode, size in (("roll", -0.03), ("pitch", 0.002))
    )
    bare = make_track(np.zeros((8, 2)), np.tile(1e-6 * np.eye(2), (8, 1, 1)))
    return replace(bare, events=events)


def test_an_undeclared_step_is_the_verdict(stage: Stage) -> None:
    """The word is step, with what jumped and what health is left; it has stated prior odds."""
    health = make_health(around(0.99, 0.6))
    found = judge(stage, logs(8), health, stepped(evidence=3.0))
    assert found.verdict == "step"
    prior = constants.STEP_PROBABILITY / (1 - constants.STEP_PROBABILITY)
    assert found.probability == pytest.approx(1 / (1 + np.exp(-3.0) / prior))
    assert "roll −3.0 %" in found.why
    assert "pitch +0.2 %" in found.why
    assert "Mount stiffness is at 60 %" in found.why
    assert "A payload or another condition that no log states" in found.why
    # Also where the logs do not carry health.
    assert judge(stage, logs(8), None, stepped()).verdict == "step"
    # Each jump since the baseline is named.
    first, second = stepped(epoch=3), stepped()
    both = replace(second, events=(*first.events, *second.events))
    days = [logs(8).recorded_at[epoch].date().isoformat() for epoch in (3, 5)]
    why = judge(stage, logs(8), health, both).why
    assert [f"before the log of {day} (roll" in why for day in days] == [True, True]


def test_a_declared_or_past_step_is_not_the_verdict(stage: Stage) -> None:
    """Declared steps, and those before the last overhaul, leave the word to health."""
    health = make_health(around(0.99, 0.99))
    assert judge(stage, logs(8), health, stepped(declared=True)).verdict == "healthy"
    serviced = replace(logs(8), baselines=(0, 2))
    assert judge(stage, serviced, health, stepped(epoch=1)).verdict == "healthy"


@pytest.mark.parametrize(
    ("n_logs", "options", "needle"),
    [
        (3, {}, "3 usable logs since the baseline began; it needs 5"),
        (8, {"fit": 9e-4}, "No life of the parameters on the map explains the logs (p = 0.0009)"),
        (8, {"informed": (0.2, 0.4)}, "do not constrain any health parameter"),
    ],
)
def test_too_little_data_has_no_verdict(
    stage: Stage, n_logs: int, options: dict, needle: str
) -> None:
    """Few logs, no life that explains them, no information: no verdict and no probability."""
    found = judge(stage, logs(n_logs), make_health(around(0.5, 0.5), **options))
    assert found.verdict == "not-enough-data"
    assert np.isnan(found.probability)
    assert needle in found.why


def test_without_health_there_is_no_verdict(stage: Stage) -> None:
    """Logs without health have the reason in the verdict."""
    found = judge(stage, logs(8), None)
    assert found.verdict == "not-enough-data"
    assert "do not contain enough information" in found.why


def test_without_parameters_the_description_is_the_reason(tmp_path: Path) -> None:
    """Where the description asks for no part, enough logs lack nothing; too few are the reason."""
    path = tmp_path / "modes.toml"
    path.write_text(
        'name = "m"\n[match]\nstage = "M"\n'
        '[[mode]]\nname = "roll"\nfrequency_hz = 120.0\ndamping_ratio = 0.01\n'
    )
    for n, why in ((1, "1 usable log since"), (3, "3 usable logs since"), (8, "no [[parameter]]")):
        found = judge(load_stage(str(path)), logs(n), None)
        assert found.verdict == "not-enough-data"
        assert why in found.why


@pytest.mark.parametrize(("n_logs", "alarm", "word"), [
    (8, True, "alarm"), (8, False, "no-alarm"), (2, True, "alarm"), (2, False, "not-enough-data"),
])  # fmt: skip
def test_frequencies_alone_have_alarms_as_verdict(
    tmp_path: Path, n_logs: int, alarm: bool, word: str
) -> None:
    """A description of modes asks for no health: an alarm does not stand beside missing data."""
    stage = make_stage(tmp_path, ())
    track = make_track(np.zeros((n_logs, 2)), np.tile(1e-6 * np.eye(2), (n_logs, 1, 1)))
    event = Event("alarm", 1, "roll", "", -0.02, 0.001, 9.0, False, 1)
    found = judge(stage, logs(n_logs), None, replace(track, events=(event,) * alarm))
    assert (found.verdict, np.isnan(found.probability)) == (word, True)
    assert found.why.startswith("Alarm since") == alarm


def test_an_alarm_without_a_verdict_is_reported(stage: Stage) -> None:
    """Mode, drift and date of an alarm come first; those before the baseline do not count."""
    drift = np.zeros((8, 2))
    drift[5:, 0] = np.log(0.96)
    bare = make_track(drift, np.tile(1e-6 * np.eye(2), (8, 1, 1)))
    alarm = Event("alarm", 5, "roll", "", -0.02, 0.001, 9.0, False, 6)
    alarmed = replace(bare, events=(alarm,))
    found = judge(stage, logs(8), None, alarmed)
    assert found.verdict == "not-enough-data"
    day = bare.recorded_at[5].date().isoformat()
    assert found.why.startswith(f"Alarm since {day}: roll has moved by −4.00 ± 0.10 % since")
    serviced = replace(logs(8), baselines=(0, 6))
    for track in (bare, replace(bare, events=(replace(alarm, declared=True),))):
        assert "Alarm" not in judge(stage, logs(8), None, track).why
    assert "Alarm" not in judge(stage, serviced, None, alarmed).why


def test_a_parameter_with_a_unit_is_reported_in_it(tmp_path: Path) -> None:
    """A parameter with a unit is reported in that unit, not in percent."""
    stage = make_stage(tmp_path, (PRELOAD.replace("limit", 'unit = "kN"\nlimit'), MOUNT))
    found = judge(stage, logs(8), make_health(around(0.8, 0.99)))
    assert re.search(r"Guide preload is 0\.(79|80)\d* kN \(90 %: 0\.79", found.why)


def test_names_are_compared_with_the_description_at_the_baseline_only(stage: Stage) -> None:
    """Modes may drift by 10 %; a baseline 5 % off is in doubt, with both values."""
    drift = np.outer(np.linspace(0.0, -0.1, 8), np.ones(2))
    track = make_track(drift, np.tile(1e-8 * np.eye(2), (8, 1, 1)))
    names = dict(zip(track.modes, track.ln_frequency[0].tolist(), strict=True))
    readings = [make_reading(log, float(k), 0.0, names) for k, log in enumerate(logs(8).logs)]
    assert doubt_of_names(stage, logs(8), track, readings) == ""
    repaired = replace(logs(8), baselines=(0, 4))
    since = np.where(np.arange(8)[:, None] < 4, drift, drift - drift[4])
    again = replace(track, drift=since)
    assert doubt_of_names(stage, repaired, again, readings) == ""
    off = replace(track, ln_frequency=track.ln_frequency + np.array([0.05, 0.0]))
    doubt = doubt_of_names(stage, logs(8), off, readings)
    declared, found = FREQUENCY[0], FREQUENCY[0] * np.exp(0.05)
    assert f"{track.modes[0]} {declared:.5g} Hz and {found:.5g} Hz" in doubt
    assert "correct the description" in doubt
    verdict = judge(stage, logs(8), None, track, doubt=doubt)
    assert verdict.verdict == "not-enough-data"
    assert doubt in verdict.why


def test_a_name_that_most_logs_doubt_withholds_health(stage: Stage) -> None:
    """Half of the logs are not enough."""
    track = make_track(np.zeros((8, 2)), np.tile(1e-8 * np.eye(2), (8, 1, 1)))
    names = dict(zip(track.modes, track.ln_frequency[0].tolist(), strict=True))
    sure = [make_reading(log, float(k), 0.0, names) for k, log in enumerate(logs(8).logs)]
    unsure = [
        replace(one, modes=replace(one.modes, flags=("", "loose-fit doubtful-name")))
        for one in sure
    ]
    assert doubt_of_names(stage, logs(8), track, unsure[:4] + sure[4:]) == ""
    doubt = doubt_of_names(stage, logs(8), track, unsure[:5] + sure[5:])
    assert f"{track.modes[1]} in 5 of 8 logs" in doubt


def test_modes_that_have_left_their_searches_withhold_health(stage: Stage) -> None:
    """Logs before are no state of now: with none of the modes in five logs there is no health."""
    track, history = make_track(np.zeros((12, 2)), np.tile(1e-8 * np.eye(2), (12, 1, 1))), logs(12)
    ln_f = np.log(np.tile([stage.modes[0].frequency_hz, stage.modes[1].frequency_hz], (12, 1)))
    for last, lost in ((8, False), (7, True)):
        seen = np.where(np.arange(12)[:, None] < last, ln_f, np.nan)
        seen = np.resize(seen, (12, len(history.series)))
        found = replace(history, ln_frequency=seen)
        doubt = doubt_of_names(stage, found, track)
        assert ("in the last 5 logs, or none agreed" in doubt) is lost
    stray = replace(found, ln_frequency=np.where(np.arange(12)[:, None] == 9, ln_f, seen))
    assert doubt_of_names(stage, stray, track) == ""
    one_log = tuple((9, mode) for mode in track.modes)
    # Neither an outlier, nor what is no certain step yet, is the mode of the logs before.
    assert doubt_of_names(stage, stray, replace(track, outliers=one_log))
    assert doubt_of_names(stage, stray, replace(track, unconfirmed=one_log))
    assert doubt_of_names(stage, stray, replace(track, unconfirmed=one_log[:1])) == ""


def test_dead_sensors_are_no_missing_alarm(tmp_path: Path) -> None:
    """Without a map all tracked modes count: none found in as many logs as a baseline has."""
    stage, n = make_stage(tmp_path, ()), 12
    assert not stage.informative
    track, history = make_track(np.zeros((n, 2)), np.tile(1e-8 * np.eye(2), (n, 1, 1))), logs(n)
    serviced = replace(history, baselines=(0, 7))  # and none is found since
    for own, last, word in (
        (history, 8, "no-alarm"),
        (history, 7, "not-enough-data"),
        (serviced, 7, "not-enough-data"),
    ):
        there = np.arange(n)[:, None] < last
        seen = replace(own, ln_frequency=np.where(there, own.ln_frequency, np.nan))
        doubt = doubt_of_names(stage, seen, track)
        found = judge(stage, seen, None, track, doubt=doubt)
        assert found.verdict == word
        names = ", ".join(history.modes)
        assert (f"None of the modes {names} was found in the last 5" in found.why) == bool(doubt)
