"""Terminal: numbers as people read them, tables that fit, JSON without NaN."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from lmshealth.progress import progress_bars
from lmshealth.terminal import (
    print_error,
    print_frf,
    print_health,
    print_json,
    print_magnitudes,
    print_modes,
    print_plans,
    print_track,
)
from lmshealth.tracking import track
from tests.lives import DAMPING, FREQUENCY, make_health, make_history

NAN = float("nan")


def magnitude(band: str, velocity: float, **other: object) -> dict[str, object]:
    """Make a row of a magnitude."""
    row: dict[str, object] = {
        "log": f"far/away/velocity-{velocity:08.3f}.h5", "stage": "A-Y", "velocity_mm_s": velocity,
        "channel": "acc_feed", "band": band, "kind": "grid", "low_hz": 95.0, "high_hz": 105.0,
        "magnitude_mm_s2": 12.345, "line": None, "rms_mm_s2": 777.0, "slope": 0.5,
        "slope_std": 0.1, "grows": True,
    }  # fmt: skip
    return row | other


def refused() -> dict[str, object]:
    """Make a row of a refusal."""
    return {"log": "b.h5", "channel": "", "mode": "", "reason": "corrupt", "detail": "no bytes"}


def test_json_has_null_for_what_is_no_number(capsys: pytest.CaptureFixture[str]) -> None:
    """NaN and infinity at any depth become null."""
    print_json({"rows": [{"a": NAN, "b": [math.inf, 1.0], "c": "x"}]})
    assert json.loads(capsys.readouterr().out) == {
        "rows": [{"a": None, "b": [None, 1.0], "c": "x"}]
    }


def test_magnitudes_fit_eighty_columns(capsys: pytest.CaptureFixture[str]) -> None:
    """Seven velocities of three digits stand beside each other, one row per band, unbroken."""
    speeds = (1.0, 5.0, 10.0, 20.0, 100.0, 200.0, 400.0)
    rows = [magnitude(f"{f} Hz", v, magnitude_mm_s2=0.012345) for f in (100, 110) for v in speeds]
    rows += [magnitude("10-390 Hz", v, kind="health", low_hz=10, high_hz=390) for v in speeds]
    print_magnitudes(rows, [], [])
    out = capsys.readouterr().out
    assert max(len(line) for line in out.splitlines()) <= 80
    (line,) = [line for line in out.splitlines() if "100 Hz" in line]
    assert line.count("0.012") == 7
    assert "0.50±0.10*" in line
    (line,) = [line for line in out.splitlines() if "RMS 10-390" in line]
    assert line.count("777") == 7


def test_more_velocities_than_fit_are_said_to_be_left_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of twelve velocities seven are shown, the slowest and the fastest among them."""
    print_magnitudes([magnitude("100 Hz", float(v)) for v in range(1, 13)], [], [])
    out = capsys.readouterr().out
    assert "5 more velocities in csv and json" in out
    head = next(line for line in out.splitlines() if "band" in line).split()
    assert (head[1], head[-2]) == ("1", "12")


def test_what_cannot_be_told_is_a_dash_and_lines_are_marked(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Unknown velocity is a question mark, no slope a dash, a line a tilde, listed once."""
    rows = [magnitude("50 Hz", NAN, line="mains", slope=NAN, slope_std=NAN, grows=None)]
    line = {"log": "a.h5", "channel": "acc_feed", "kind": "mains", "frequency_hz": 50.01,
            "amplitude": 0.016, "unit": "m/s²"}  # fmt: skip
    print_magnitudes(rows, [line, line | {"log": "b.h5", "frequency_hz": 49.99}], [refused()])
    out = capsys.readouterr().out
    assert "12.3~" in out
    assert " ? " in out
    (row,) = [text for text in out.splitlines() if "mains" in text]
    assert row.split() == ["acc_feed", "mains", "50.01", "16", "2"]
    assert "no bytes" in out


def test_an_error_without_harmonics_above_the_floor_shows_a_dash(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Missing bandwidth is a dash; two channels are told apart; the table fits 80 columns."""
    row = {
        "log": "velocity-0001.000.h5", "channel": "delta_e", "velocity_mm_s": 1.0,
        "duration_s": 4.0, "min_um": -12345.6, "max_um": 0.5, "std_um": 0.04, "mean_um": 0.0,
        "max_magnitude_um": 0.01, "strongest_hz": 12.5, "bandwidth_hz": 1000.0,
        "share_explained": 0.5, "n_above_floor": 0, "bandwidth_above_floor_hz": NAN,
        "share_explained_above_floor": 0.0, "n_harmonics": 100, "floor_nm": 30.0,
    }  # fmt: skip
    print_error([row], [])
    out = capsys.readouterr().out
    assert "–" in out
    assert "-12346" in out
    assert max(len(line) for line in out.splitlines()) <= 80
    print_error([row, row | {"channel": "delta_e_2"}], [refused()])
    out = capsys.readouterr().out
    assert "delta_e_2" in out
    assert "corrupt" in out


def test_refusals_alone_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    """Where nothing was read there is no empty table, but why."""
    for show in (print_error, print_modes):
        show([], [refused()])
        assert "no bytes" in capsys.readouterr().out
    print_magnitudes([], [], [refused()])
    assert "no bytes" in capsys.readouterr().out


def test_there_is_no_bar_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """Progress is told without a trace in a pipe."""
    with progress_bars() as tell:
        tell("logs", 1, 2)
        tell("logs", 2, 2)
    captured = capsys.readouterr()
    assert captured.err == captured.out == ""


def response_line(frequency: float) -> dict[str, object]:
    """Make a row of a frequency response."""
    return {
        "log": "log", "frequency_hz": frequency, "gain": 0.01234, "gain_std": 1.2e-5,
        "phase_rad": -1.5708, "coherence": 0.99, "fit_gain": 0.0123,
    }  # fmt: skip


def fitted(**other: object) -> dict[str, object]:
    """Make a row of a fit."""
    row: dict[str, object] = {
        "log": "log", "input": "current", "output": "acc_x", "period_s": 5.0, "n_averages": 4.0,
        "chi_square": 1.02, "distortion": 0.0, "colour": 0.0,
    }  # fmt: skip
    return row | other


def test_a_response_is_shown_at_some_of_its_lines(capsys: pytest.CaptureFixture[str]) -> None:
    """A dozen of a thousand lines, what was averaged, and nothing of what is not there."""
    print_frf([fitted()], [response_line(0.1 * k) for k in range(1, 1001)], [], [])
    out = capsys.readouterr().out
    assert max(len(line) for line in out.splitlines()) <= 80
    assert out.count("0.01234 ± 1.2e-05") == 12
    assert "12 of 1000 lines" in out
    assert "-90.0" in out
    assert "Mean of 4 periods of 5 s" in out
    assert "nonlinear" not in out
    assert "correlate" not in out


def test_several_responses_are_told_apart(capsys: pytest.CaptureFixture[str]) -> None:
    """Each response stands under the name of its log, with its own lines only."""
    lines = [response_line(10.0), response_line(20.0) | {"log": "other"}]
    print_frf([fitted(), fitted(log="other")], lines, [], [])
    first, second = capsys.readouterr().out.split("\nother\n")
    assert first.startswith("log\n")
    assert "1 of 1 lines" in first
    assert "1 of 1 lines" in second
    assert "20" not in first


def test_a_response_says_what_its_fit_misses(capsys: pytest.CaptureFixture[str]) -> None:
    """Distortion, errors that neighbours share, and an input that does not repeat."""
    fit = fitted(period_s=NAN, chi_square=300.0, distortion=0.061, colour=0.35)
    print_frf([fit], [response_line(10.0)], [], [])
    out = capsys.readouterr().out
    assert "does not repeat" in out
    assert "6.1 % of the response" in out
    assert "0.35" in out


def test_plans_are_one_table_each_and_say_why_there_is_none(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A number of logs or what hinders, dashes for what is not known, what stands for what."""
    asked = {
        "parameter": "p", "loss": 0.05, "power": 0.9, "false_alarm": 0.01, "n_baseline": 7,
        "seconds_for_one_log": 42,
    }  # fmt: skip
    row = {
        "parameter": "p", "loss": 0.05, "seconds_per_log": 60.0, "n_logs": 3, "hindrance": "",
        "power_of_one_log": 0.5, "smallest_loss_of_one_log": 0.04, "smallest_loss": 0.02,
    }  # fmt: skip
    short = row | {
        "seconds_per_log": 0.1, "n_logs": None, "hindrance": "too-short",
        "power_of_one_log": NAN, "smallest_loss_of_one_log": NAN, "smallest_loss": NAN,
    }  # fmt: skip
    weak = row | {"loss": 0.01, "n_logs": None, "hindrance": "baseline"}
    print_plans([asked, asked | {"loss": 0.01, "seconds_for_one_log": None}], [row, short, weak])
    shown = capsys.readouterr().out
    first, second = shown.split("p: to see a loss of 1.0 %")
    assert "loss of 5.0 % with power 0.9, false alarms 0.01" in first
    assert "loss, 7 logs" in first
    assert "60 3 50.0 % 4.0 % 2.0 %" in " ".join(first.split())
    assert "0.1 log too short – – –" in " ".join(first.split())
    assert "from 42 s on" in first
    assert "baseline too short" in second
    assert "No one log of an hour" in second
    assert "hidden" not in shown
    assert max(len(line) for line in shown.splitlines()) <= 80


def test_changes_are_percent_of_what_was_before(capsys: pytest.CaptureFixture[str]) -> None:
    """Half the frequency is 50 % less, not ln 2; a damping that nobody told is a dash."""
    ln_f = np.log(FREQUENCY[:1]) - np.log(2) * (np.arange(8) >= 4)[:, None]
    history = make_history(ln_f, ln_damping=np.full((8, 1), np.nan), std=1e-3)
    print_track(track(history))
    shown = capsys.readouterr().out
    assert "-50.0" in shown
    assert "-69.3" not in shown
    assert "–" in shown
    assert "nan" not in shown


def test_a_filter_that_is_too_cautious_is_not_said_to_be_widened(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Logs that vary less than they say ask for no missing cause."""
    ln_f = np.tile(np.log(FREQUENCY[:2]), (40, 1))
    ln_zeta = np.tile(np.log(DAMPING[:2]), (40, 1))
    print_track(track(make_history(ln_f, ln_damping=ln_zeta, std=1e-3)))
    shown = capsys.readouterr().out
    assert "does NOT agree" in shown
    assert "rather too wide" in shown
    assert "widened" not in shown


def test_health_that_did_not_converge_shows_no_interval(capsys: pytest.CaptureFixture[str]) -> None:
    """What was not found is no number; what stands at an edge or fits nothing is told."""
    sure = make_health(np.random.default_rng(1).lognormal(-0.2, 0.02, (40, 2)))
    print_health(sure)
    told = capsys.readouterr().out
    assert " to " in told
    assert "Correlation of guide_preload and mount_stiffness" in told
    nothing = np.full((1, 2), np.nan)
    lost = replace(
        sure, converged=np.array([False]), ess_bulk=nothing, ess_tail=nothing, r_hat=nothing,
        prior_shift=nothing, prior_ratio=nothing, laplace_shift=nothing, laplace_ratio=nothing,
        fit=np.array([1e-9]), at_edge=np.array([[True, False]]),
    )  # fmt: skip
    print_health(lost)
    told = capsys.readouterr().out
    assert "nan" not in told
    assert told.count("not converged") == 2
    assert "p = 1e-09): nothing is claimed" in told
    assert "guide_preload stands at the edge of the map" in told
    assert "mount_stiffness stands" not in told
    odd = replace(
        sure, laplace_shift=np.array([[0.9, 0.0]]), identifiable=np.array([[True, False]])
    )
    print_health(odd)
    told = capsys.readouterr().out
    assert "guide_preload: far from normal; Laplace's approximation lies +0.9 σ lower" in told
    assert "mount_stiffness: not identifiable" in told
