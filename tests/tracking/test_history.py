"""Histories: order of logs, columns of modes, contradictory odometers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmshealth.errors import NotEnoughData
from lmshealth.io.log import WARNINGS, Refusal
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.contradictions import sort_by_time
from lmshealth.tracking.history import (
    History,
    Series,
    build_history,
    contradiction_notices,
    doubt_of_clock,
    missing_mode_notices,
)
from lmshealth.tracking.maintenance import Action
from lmshealth.tracking.track import accepted_estimates, outlier_refusals, track
from tests.lives import FADING, START, awkward_history, make_reading, make_stage, make_track


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    """Two tracked modes, roll and pitch."""
    return make_stage(tmp_path, (FADING,))


def test_readings_are_sorted_by_moment_then_name(stage: Stage) -> None:
    """Any order is sorted by time; equal moments are sorted by name."""
    late = make_reading("a", 5, 3e5, {"roll": 4.8})
    early = make_reading("z", 1, 1e5, {"roll": 4.81})
    twin = make_reading("b", 1, 1e5, {"roll": 4.81})
    assert [r.log for r in sort_by_time([late, early, twin])] == ["b", "z", "a"]
    history, refused = build_history([late, early, twin], stage)
    assert history.logs == ("b", "z", "a")
    assert list(history.recorded_at) == sorted(history.recorded_at)
    assert refused == []


def test_modes_are_lined_up_with_their_covariances(stage: Stage) -> None:
    """Each mode has its column, rows and cross terms, for any order within a log."""
    readings = [
        make_reading("0", 0, 0.0, {"pitch": 4.9, "roll": 4.8}),
        make_reading("1", 1, 1e5, {"roll": 4.79}),
    ]
    history, _ = build_history(readings, stage)
    assert history.modes == ("roll", "pitch")
    np.testing.assert_array_equal(history.ln_frequency, [[4.8, 4.9], [4.79, np.nan]])
    own = readings[0].modes.cov
    order = [1, 0, 3, 2]  # roll before pitch, for frequency and for damping
    np.testing.assert_array_equal(history.cov[0], own[np.ix_(order, order)])
    alone = readings[1].modes.cov
    np.testing.assert_array_equal(history.cov[1][np.ix_([0, 2], [0, 2])], alone)
    assert np.isnan(history.cov[1][1]).all()
    assert np.isnan(history.cov[1][:, 3]).all()


def test_modes_that_are_not_tracked_or_never_found_are_left_out(stage: Stage) -> None:
    """Only tracked modes that a log detects make a column; logs without estimates are epochs."""
    readings = [
        make_reading("0", 0, 0.0, {"pitch": 4.9, "shaker": 3.0}),
        make_reading("1", 1, 1e5, {"shaker": 3.0}),
    ]
    history, _ = build_history(readings, stage)
    assert history.modes == ("pitch",)
    assert np.isnan(history.ln_frequency[1]).all()


def test_one_mistyped_odometer_does_not_rewrite_the_life(stage: Stage) -> None:
    """The log that contradicts most others is refused, with an odometer too high or too low."""
    for wrong, at in ((1.8e7, 1), (1e3, 4)):
        travels = [1e5, 2e5, 3e5, 4e5, 5e5, 6e5]
        travels[at] = wrong
        readings = [make_reading(str(k), k, s, {"roll": 4.8}) for k, s in enumerate(travels)]
        history, refused = build_history(readings, stage)
        np.testing.assert_array_equal(history.travel, np.delete(travels, at))
        assert history.logs == tuple(str(k) for k in range(6) if k != at)
        assert [(r.log, r.reason) for r in refused] == [(str(at), "odometer")]
        assert f"{wrong / 1000:g}" in refused[0].detail


@pytest.mark.parametrize(
    ("n_logs", "reset", "slips", "doubt"),
    [
        *((12, 11, (), False), (12, 9, (), True), (12, 3, (), True), (101, 91, (), True)),
        *((60, 60, (5, 17, 30, 44, 45), False), (12, 12, (3, 6), False)),
    ],
)
def test_after_a_reset_of_the_odometer_no_log_is_known_to_be_right(
    stage: Stage, n_logs: int, reset: int, slips: tuple[int, ...], doubt: bool
) -> None:
    """More than two logs in a row contradict the others: a serious notice instead of health.

    Single ones are left out, also several of a long life.
    """
    travels = [1e5 * (k + 1 if k < reset else 0.5 + k - reset) for k in range(n_logs)]
    for k in slips:
        travels[k] = 1e9
    readings = [make_reading(str(k), k, s, {"roll": 4.8}) for k, s in enumerate(travels)]
    history, refused = build_history(readings, stage)
    (notice,) = contradiction_notices(history, refused)
    severity, code = ("serious", "contradict") if doubt else ("caution", "left-out")
    assert (notice.severity, notice.code) == (severity, f"logs-{code}")
    assert notice.what.startswith(f"In {len(refused)} of {n_logs} logs odometer")
    assert doubt_of_clock(history, refused) == (notice.what if doubt else "")


def dated(days: list[float], travel: list[float], stage: Stage) -> tuple[list[str], list[str]]:
    """Return the logs of a history, and those refused for their date; logs are days and km."""
    readings = [
        make_reading(str(k), day, 1e3 * km, {"roll": 4.8})
        for k, (day, km) in enumerate(zip(days, travel, strict=True))
    ]
    history, refused = build_history(readings, stage)
    assert all(one.reason == "date" for one in refused)
    return list(history.logs), [one.log for one in refused]


@pytest.mark.parametrize(
    ("days", "lost"),
    [
        ({39: 36 * 365.0}, ["39"]),  # in 2062
        ({0: -56 * 365.0}, ["0"]),  # 1970
        ({0: -26 * 365.0, 39: 36 * 365.0}, ["0", "39"]),
        ({0: -46 * 365.0, 1: -46 * 365.0 + 0.01}, ["0", "1"]),
        ({39: 39 + 200.0}, []),  # idle for half a year
        ({38: 38 + 800.0, 39: 39 + 800.0}, []),  # idle for two years, confirmed
    ],
)
def test_a_date_years_away_that_the_odometer_contradicts_is_refused(
    stage: Stage, days: dict[int, float], lost: list[str]
) -> None:
    """A clock that was not set does not move the usage of forty logs; a machine may be idle."""
    moments = [days.get(k, float(k)) for k in range(40)]
    kept, refused = dated(moments, [10.0 * k for k in range(40)], stage)
    assert sorted(refused) == sorted(lost) and len(kept) == 40 - len(lost)


def test_a_late_log_after_much_travel_is_kept(stage: Stage) -> None:
    """Ten daily logs and one after two years of the same use agree."""
    days = [*map(float, range(10)), 730.0]
    kept, refused = dated(days, [10 * day for day in days], stage)
    assert not refused and len(kept) == 11


def jumping(values: list[float], stage: Stage) -> tuple[list[bool], list[str]]:
    """Return the logs that kept their roll of these ln frequencies, and those refused."""
    readings = [
        make_reading(str(k), k, 1e5 * k, {"roll": value, "pitch": 4.9})
        for k, value in enumerate(values)
    ]
    history, refused = build_history(readings, stage)
    followed = track(history, stage)
    refused += outlier_refusals(history, followed)
    history = accepted_estimates(history, followed)
    assert all(r.reason == "jump" and r.mode == "roll" for r in refused)
    roll, pitch = history.modes.index("roll"), history.modes.index("pitch")
    assert np.isfinite(history.ln_frequency[:, pitch]).all()
    kept = np.isfinite(history.ln_frequency[:, roll])
    np.testing.assert_array_equal(np.isfinite(history.cov[:, roll, roll]), kept)
    return kept.tolist(), [r.log for r in refused]


def test_a_jump_in_one_log_only_is_not_believed(stage: Stage) -> None:
    """A frequency that deviates in one log, also in the last, is refused with its mode."""
    kept, refused = jumping([4.84, 4.841, 4.92, 4.84, 4.839, 4.70], stage)
    assert kept == [True, True, False, True, True, False]
    assert refused == ["2", "5"]


def test_a_jump_that_the_next_log_confirms_is_a_step(stage: Stage) -> None:
    """A step costs no log once the next log confirms it."""
    kept, refused = jumping([4.84, 4.841, 4.839, 4.79, 4.791, 4.789, 4.79], stage)
    assert all(kept)
    assert not refused


def test_drift_within_reach_is_no_jump(stage: Stage) -> None:
    """A steady loss of 0.5 % per log, as of fast wear, is accepted."""
    kept, refused = jumping([4.84 - 0.005 * k for k in range(6)], stage)
    assert all(kept)
    assert not refused


def test_every_source_of_a_mode_has_its_column(stage: Stage) -> None:
    """Logs with and without accelerometers make one mode with two series."""
    readings = [make_reading(str(k), k, 1e5 * k, {"roll": 4.8, "pitch": 4.9}) for k in range(4)]
    readings[2] = replace(
        readings[2], modes=replace(readings[2].modes, sources=("delta_e", "delta_e"))
    )
    history, _ = build_history(readings, stage)
    assert history.modes == ("roll", "pitch")
    assert history.series == (
        Series("roll", "acc"),
        Series("roll", "delta_e"),
        Series("pitch", "acc"),
        Series("pitch", "delta_e"),
    )
    there = np.isfinite(history.ln_frequency)
    np.testing.assert_array_equal(there[:, 0], [True, True, False, True])
    np.testing.assert_array_equal(there[:, 1], [False, False, True, False])


def test_a_new_tuning_is_a_step_of_the_servo(stage: Stage) -> None:
    """A change of servo_id that maintenance declares too is one step."""
    readings = [
        replace(r, metadata=replace(r.metadata, servo_id="b" if k in (2, 3) else "a"))
        for k, r in enumerate(make_reading(str(k), k, 1e5 * k, {"roll": 4.8}) for k in range(5))
    ]
    told = [Action("AX-1", START + timedelta(days=1.5), "servo")]
    history, _ = build_history(readings, stage, told)
    assert [(s.kind, s.first, s.name) for s in history.steps] == [("servo", 2, "b")]
    np.testing.assert_array_equal(history.steps[0].there, [False, False, True, True, False])


def test_an_unknown_tuning_is_that_of_the_log_before(stage: Stage) -> None:
    """Logs without servo_id after a retuning are not of the first tuning."""
    readings = [make_reading(str(k), k, 1e5 * k, {"roll": 4.8}) for k in range(6)]
    ids = (None, "a", None, "b", None, None)
    named = [
        replace(r, metadata=replace(r.metadata, servo_id=own))
        for r, own in zip(readings, ids, strict=True)
    ]
    history, _ = build_history(named, stage)
    assert [(s.kind, s.first, s.name) for s in history.steps] == [("servo", 3, "b")]
    np.testing.assert_array_equal(history.steps[0].there, [False] * 3 + [True] * 3)


def test_work_is_a_step_or_a_baseline(stage: Stage) -> None:
    """Work on guide or mount opens a baseline; actions before the first log have no effect."""
    readings = [make_reading(str(k), k, 1e5 * k, {"roll": 4.8}) for k in range(6)]
    days = {"regrease": 0.5, "sensor": 1.5, "mount-tightened": 3.5, "servo": -2.0}
    told = [Action("AX-1", START + timedelta(days=d), action) for action, d in days.items()]
    history, _ = build_history(readings, stage, told)
    found = [(step.kind, step.first) for step in history.steps]
    assert found == [("regreasing", 1), ("sensor", 2), ("reset", 4)]
    assert history.baselines == (0, 4)
    assert history.baseline == 4


def test_work_of_one_day_is_one_step(stage: Stage) -> None:
    """Work on guide and mount before one log lets the modes jump once, by as much as either."""
    readings = [make_reading(str(k), k, 1e5 * k, {"roll": 4.8}) for k in range(4)]
    told = [
        Action("AX-1", START + timedelta(days=1.5), action)
        for action in ("guide-replaced", "preload-adjust", "regrease", "regrease")
    ]
    history, _ = build_history(readings, stage, told)
    assert [(step.kind, step.first) for step in history.steps] == [("reset", 2), ("regreasing", 2)]


def test_a_first_log_in_doubt_is_that_of_its_baseline(stage: Stage) -> None:
    """A life that has ended does not begin with the doubtful log of the next one."""
    readings = [make_reading(str(k), k, 1e5 * k, {"roll": 4.8}) for k in range(6)]
    history, _ = build_history(readings, stage)
    doubtful = replace(history, baselines=(0, 4), in_doubt=(0,))
    assert doubtful.first_logs(4).in_doubt == ()
    assert doubtful.first_logs(5).in_doubt == (0,)


def test_without_every_odometer_the_clock_is_time(stage: Stage) -> None:
    """One log without travel makes the time of recording the clock."""
    readings = [make_reading(str(k), k, 1e5 * k, {"roll": 4.8}) for k in range(3)]
    readings[1] = replace(readings[1], metadata=replace(readings[1].metadata, travel=None))
    history, _ = build_history(readings, stage)
    assert not history.has_odometer
    np.testing.assert_allclose(history.clock(), 86400.0 * np.arange(3))


def test_modes_without_a_name_are_given_one(stage: Stage) -> None:
    """With a stage, an unnamed estimate has the name of the mode whose search contains it."""
    reading = make_reading("0", 0, 0.0, {"": float(np.log(126.0))})
    far = make_reading("1", 1, 1e5, {"": float(np.log(300.0))})
    history, _ = build_history([reading, far], stage)
    assert history.modes == ("roll",)
    assert np.isnan(history.ln_frequency[1]).all()


def test_a_name_is_given_once(stage: Stage) -> None:
    """A resonance beside a named mode is not that mode: it is refused, and the mode stays."""
    beside, pitch = np.log([132.2, 136.6])
    readings = [
        make_reading(str(k), k, 1e5 * k, {"": float(beside), "pitch": float(pitch)})
        for k in range(6)
    ]
    alike = [replace(r, modes=replace(r.modes, cov=1e-6 * np.eye(4))) for r in readings]
    history, refused = build_history(alike, stage)
    assert history.series == (Series("pitch", "acc"),)
    np.testing.assert_allclose(history.ln_frequency[:, 0], pitch)
    # Until three logs show it, it is of no known mode.
    reasons = [one.reason for one in refused]
    assert reasons == ["unconfirmed"] * 2 + ["undescribed"] * 4
    assert {one.mode for one in refused[2:]} == {"132.2 Hz"}
    # Without any name the lower one is roll, which both together are nearest to.
    unnamed = [replace(r, modes=replace(r.modes, names=("", ""))) for r in alike]
    history, _ = build_history(unnamed, stage)
    assert history.modes == ("roll", "pitch")
    np.testing.assert_allclose(history.ln_frequency, np.tile([beside, pitch], (6, 1)))


@pytest.mark.parametrize(
    ("frequencies", "names"),
    [
        ((120.0, 130.0, 146.0), ("", "", "")),
        ((131.5, 142.0, 161.0), ("", "", "")),
        ((121.3, 131.1, 148.8), ("", "", "yaw")),
    ],
)
def test_modes_that_moved_together_get_their_names(
    frequencies: tuple[float, ...], names: tuple[str, ...]
) -> None:
    """Estimates without a name are assigned together: the nearest mode may be another's."""
    made = make_reading("0", 0, 0.0, dict(zip("abc", np.log(frequencies), strict=True)))
    reading = replace(made, modes=replace(made.modes, names=names))
    history, refused = build_history([reading], load_stage("lms-y"))
    assert history.modes == ("roll", "pitch", "yaw") and refused == []
    np.testing.assert_allclose(np.exp(history.ln_frequency[0]), frequencies)


def test_the_first_declared_baseline_counts(stage: Stage) -> None:
    """The baseline is the first log declared one, or without a declaration the first log."""
    flags = [None, False, True, True]
    readings = [
        make_reading(str(k), k, 1e5 * k, {"roll": 4.8}, baseline=flag)
        for k, flag in enumerate(flags)
    ]
    history, _ = build_history(readings, stage)
    assert history.baseline == 2
    np.testing.assert_allclose(history.clock(), [-2e5, -1e5, 0, 1e5])
    assert build_history(readings[:2], stage)[0].baseline == 0


def test_covariates_are_nan_where_a_log_has_none(stage: Stage) -> None:
    """Covariates of any log make a column, NaN in logs without."""
    readings = [
        make_reading("0", 0, 0.0, {"roll": 4.8}, covariates={"temperature_c": 20.0}),
        make_reading("1", 1, 1e5, {"roll": 4.8}, covariates={"payload_kg": 3.0}),
    ]
    history, _ = build_history(readings, stage)
    np.testing.assert_array_equal(history.covariates["temperature_c"], [20.0, np.nan])
    np.testing.assert_array_equal(history.covariates["payload_kg"], [np.nan, 3.0])


_DEPENDS_ON_AMPLITUDE = """
[[covariate]]
name = "excitation_db"
reference = 0.0
prior_std = 0.002
"""


def excited(levels: Sequence[Mapping[str, float]], softening: float = 0.0) -> list[LogEstimates]:
    """Make readings whose modes are excited to m/s², and soften by as much per dB."""
    readings = []
    rng = np.random.default_rng(2)
    for k, level in enumerate(levels):
        ln_f = {
            name: float(
                4.8 + 0.1 * i + 2e-4 * rng.normal() - softening * np.nan_to_num(20 * np.log10(a))
            )
            for i, (name, a) in enumerate(level.items())
        }
        one = make_reading(f"{k:02d}", k, 1e5 * k, ln_f)
        cov = np.diag([2e-4] * len(level) + [0.05] * len(level)) ** 2
        modes = replace(one.modes, cov=cov, excitation=np.array(list(level.values())))
        readings.append(replace(one, modes=modes))
    return readings


def test_the_level_of_the_excitation_is_a_covariate_where_it_is_described(tmp_path: Path) -> None:
    """It is 0 dB in the first log; a mode that is missing, or comes later, does not change it."""
    levels = [
        {"roll": 0.1, "pitch": 0.5},
        {"roll": 0.2, "pitch": 1.0},
        {"pitch": 5.0},
        {"roll": np.nan, "pitch": 0.5},
        {},
    ]
    described = make_stage(tmp_path / "described", (FADING,), tail=_DEPENDS_ON_AMPLITUDE)
    found, _ = build_history(excited(levels), described)
    expected = [0, 20 * np.log10(2), 20, 0, np.nan]
    np.testing.assert_allclose(found.covariates["excitation_db"], expected, atol=1e-9)
    later, _ = build_history(excited([{"roll": 0.1}, *levels[1:]]), described)
    np.testing.assert_allclose(later.covariates["excitation_db"][2], 20, atol=1e-9)
    silent, _ = build_history(excited(levels), make_stage(tmp_path / "other", (FADING,)))
    assert "excitation_db" not in silent.covariates


def test_frequencies_that_depend_on_the_amplitude_are_no_drift(tmp_path: Path) -> None:
    """A guide that softens with the level is tracked at one level, and drifts without."""
    rng = np.random.default_rng(4)
    # The machine is excited more and more, by 20 dB in all.
    levels = [
        {name: a * 10 ** (k / 30 + 0.1 * rng.normal()) for name, a in (("roll", 1), ("pitch", 2))}
        for k in range(30)
    ]
    readings = excited(levels, softening=1e-3)
    drifts = {}
    for name, tail in (("with", _DEPENDS_ON_AMPLITUDE), ("without", "")):
        own = make_stage(tmp_path / name, (FADING,), tail=tail)
        found = track(build_history(readings, own)[0], own)
        drifts[name] = found.drift[-1] / np.sqrt(np.diagonal(found.drift_cov[-1]))
    assert (np.abs(drifts["with"]) < 3).all()
    assert (drifts["without"] < -5).all()


def test_no_reading_is_refused(stage: Stage) -> None:
    """The error for a history without logs names the stage."""
    with pytest.raises(NotEnoughData, match="small: no usable log"):
        build_history([], stage)


def test_modes_that_stay_ambiguous_make_a_note(stage: Stage) -> None:
    """Three logs in a row with ambiguous estimates make a note of their number, two do not."""
    readings = [make_reading(str(k), k, 1e5 * k, {"roll": 4.8}) for k in range(5)]
    history, _ = build_history(readings, stage)
    doubts = [Refusal(str(k), "ambiguous", "", mode="roll") for k in range(5)]
    for n in (3, 4):
        (told,) = missing_mode_notices(history, doubts[-n:])
        assert f"roll: the estimates of the last {n} logs are ambiguous" in told.what
    assert missing_mode_notices(history, doubts[:4]) == []


def test_a_mode_that_is_no_longer_seen_is_told(stage: Stage) -> None:
    """Three logs in a row without a mode make a note, two do not."""
    logs = [
        make_reading(f"{day}", day, 1e5 * day, {"roll": 4.8} | ({"pitch": 4.9} if day < 4 else {}))
        for day in range(1, 7)
    ]
    history, refused = build_history(logs, stage)
    told = missing_mode_notices(history, refused)
    assert [(one.code, one.where) for one in told] == [("mode-missing", "pitch")]
    assert told[0].what == "pitch: no estimate in the last 3 logs; nothing new is known."
    history, refused = build_history(logs[:5], stage)
    assert missing_mode_notices(history, refused) == []


@pytest.fixture
def history() -> History:
    """Make two modes by two sources, with a second baseline at log 9."""
    return awkward_history(np.random.default_rng(1))


def test_the_present_baseline_is_the_last(history: History) -> None:
    """The last of several baselines counts, and the clock is 0 there."""
    assert history.baseline == 9
    assert history.clock()[9] == 0
    np.testing.assert_allclose(np.diff(history.clock()), np.diff(history.travel))


def test_without_odometer_the_clock_is_time(history: History) -> None:
    """With one odometer reading missing, the clock is the time in seconds."""
    travel = history.travel.copy()
    assert history.has_odometer
    travel[3] = np.nan
    timed = replace(history, travel=travel)
    assert not timed.has_odometer
    week = timedelta(days=7).total_seconds()
    np.testing.assert_allclose(timed.clock(), week * (np.arange(16) - 9))
    assert timed.recorded_at[0] == START


def test_series_know_their_mode(history: History) -> None:
    """Columns of the estimates are found by mode."""
    assert history.mode_of().tolist() == [0, 1, 0, 1]
    assert history.columns("pitch") == [1, 3]
    assert history.columns("yaw") == []


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("travel", np.zeros(3), r"travel has shape \(3,\), needed \(16,\)"),
        ("loop_error", np.zeros((16, 1)), "loop_error has shape"),
        ("ln_damping", np.zeros((16, 2)), r"ln_damping has shape \(16, 2\), needed \(16, 4\)"),
        ("cov", np.zeros((16, 4, 4)), r"cov has shape .* needed \(16, 8, 8\)"),
        ("baselines", (), "baselines are logs"),
        ("baselines", (0, 16), r"baselines are logs \(0, 16\) of 16"),
        ("series", (Series("strange", "acc"),) * 4, "not among"),
    ],
)
def test_histories_that_contradict_themselves_are_refused(
    history: History, field: str, value: object, message: str
) -> None:
    """The error names wrong shapes, baselines that are no logs, and series of unknown modes."""
    with pytest.raises(ValueError, match=message):
        changed: dict[str, Any] = {field: value}
        replace(history, **changed)


@pytest.mark.parametrize("variance", [np.nan, 0.0, -1e-6])
def test_estimates_without_errors_are_refused(history: History, variance: float) -> None:
    """The error names log and series of a missing, zero or negative variance."""
    cov = np.array(history.cov)
    cov[5, 2, 2] = variance
    with pytest.raises(ValueError, match=r"005.csv: roll by delta_e has an estimate of variance"):
        replace(history, cov=cov)
    cov = np.array(history.cov)
    cov[5, 2, 3] = np.nan
    with pytest.raises(ValueError, match=r"005.csv: roll by delta_e .* without covariances"):
        replace(history, cov=cov)


def test_logs_out_of_order_are_refused(history: History) -> None:
    """The error names a clock or odometer that runs backwards; equal moments are accepted."""
    moments = list(history.recorded_at)
    moments[4], moments[5] = moments[5], moments[4]
    with pytest.raises(ValueError, match=r"recorded_at runs backwards at 005.csv"):
        replace(history, recorded_at=tuple(moments))
    travel = np.array(history.travel)
    travel[7] = travel[8] + 1
    with pytest.raises(ValueError, match=r"travel runs backwards at 008.csv"):
        replace(history, travel=travel)
    moments[5] = moments[4] = moments[3]
    assert replace(history, recorded_at=tuple(moments)).clock().size == 16


def test_arrays_are_read_only(history: History) -> None:
    """Arrays of a history, a step or a track are read-only."""
    followed = make_track(np.zeros((3, 2)), np.zeros((3, 2, 2)))
    for array in (history.cov, history.steps[0].there, followed.drift, followed.innovations):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def rated(rates: Sequence[float | None], drift: float = -5e-3, follow: float = 1.0) -> list:
    """Make readings of two modes that wear; frequencies follow rates other than 20 kHz."""
    rng = np.random.default_rng(3)
    readings = []
    for k, rate in enumerate(rates):
        off = follow * np.log((rate or 20e3) / 20e3) + k * drift
        one = make_reading(str(k), k, k * 1e5, {"roll": 4.8 + off, "pitch": 4.9 + 1.1 * off})
        moved = one.modes.ln_frequency + rng.normal(0, 5e-4, 2)
        cov = one.modes.cov * 1e-4
        modes = replace(one.modes, ln_frequency=moved, cov=cov)
        readings.append(replace(one, modes=modes, sample_rate=rate))
    return readings


@pytest.mark.parametrize("at", [0, 7, 11])
@pytest.mark.parametrize("odd", [19.6e3, 20.4e3, 19e3])
def test_a_log_whose_frequencies_follow_another_rate_is_left_out(stage, at, odd):
    """One header of twelve that is off moves all frequencies of its log; both rates are stated."""
    rates = [20e3 if k != at else odd for k in range(12)]
    history, refused = build_history(rated(rates), stage)
    assert history.logs == tuple(str(k) for k in range(12) if k != at)
    [one] = [own for own in refused if own.reason == "odd-rate"]
    assert one.log == str(at) and f"{odd:g} Hz" in one.detail and "20000 Hz" in one.detail
    [notice] = contradiction_notices(history, refused)
    assert (notice.code, notice.severity, notice.where) == ("odd-rate", "caution", str(at))


def test_damage_beside_another_rate_is_kept(stage):
    """Modes that move ten times as far as the rate explains do not follow it."""
    rates = [20e3] * 9 + [20.2e3] * 3
    history, refused = build_history(rated(rates, follow=-10.0), stage)
    assert len(history.logs) == 12 and refused == []


def test_headers_that_alternate_keep_the_first_rate(stage):
    """Where both rates are as frequent, the logs that differ from the first are left out."""
    history, refused = build_history(rated([20e3, 19.6e3] * 6), stage)
    assert history.logs == tuple(str(k) for k in range(0, 12, 2))
    assert {one.reason for one in refused} == {"odd-rate"} and len(refused) == 6


@pytest.mark.parametrize(
    "rates",
    [
        [20e3] * 12,
        [None] * 6 + [20e3] * 6,
        [20e3] * 8 + [10e3] * 4,  # another setting
        [20e3, 19.6e3] * 6,
        [51.2e3] * 10 + [50e3] * 2,
        [20e3 * (1 + 1e-4 * (k % 2)) for k in range(12)],  # two crystals
        [3200 * (1 + 3e-3 * np.sin(k)) for k in range(12)],  # an oscillator that drifts
        [20e3, 19.6e3],
    ],
)
def test_other_rates_whose_frequencies_agree_are_kept(stage, rates):
    """A rate that was set otherwise moves no frequency."""
    history, refused = build_history(rated(rates, follow=0.0), stage)
    assert len(history.logs) == len(rates) and contradiction_notices(history, refused) == []


def test_a_rate_that_is_off_by_less_than_modes_resolve_is_noted(stage):
    """The log is kept, with both rates in its row, which is a warning."""
    history, refused = build_history(rated([20e3] * 11 + [19.99e3]), stage)
    assert len(history.logs) == 12
    [one] = refused
    assert (one.log, one.reason, one.channel) == ("11", "rate", "sample_rate_hz")
    assert "19990 Hz" in one.detail and "20000 Hz" in one.detail
    assert one.reason in WARNINGS and contradiction_notices(history, refused) == []
