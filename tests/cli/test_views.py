"""Terminal output: formats, widths, and no number where there is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest

from lmshealth.cli import terminal
from lmshealth.cli.views import (
    print_error,
    print_frf,
    print_health,
    print_life,
    print_magnitudes,
    print_modes,
    print_plans,
    print_stage,
    print_summaries,
    print_track,
)
from lmshealth.life.prognosis import LawWeight, Prognosis
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.service import decide, probability_before
from lmshealth.machine.summary import prognosis_rows, summarise, summarise_life
from lmshealth.modal.naming import Difference
from lmshealth.report.pages import by_urgency
from lmshealth.report.tables import stage_rows
from lmshealth.report.text import service_text
from lmshealth.stage.check import check_stage, diagnose
from lmshealth.stage.description import Decision, Stage, load_stage
from lmshealth.tracking.track import track
from tests.assessments import blind, make, nothing
from tests.lives import (
    DAMPING,
    FOOT,
    FREQUENCY,
    MOUNT,
    PRELOAD,
    START,
    make_health,
    make_history,
    make_prognosis,
    make_stage,
)

__all__ = ["make"]
NAN, STAGE = float("nan"), load_stage("lms-y")
Printed = Callable[[], str]


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


def test_velocities_of_more_than_a_percent_are_apart(capsys: pytest.CaptureFixture[str]) -> None:
    """100 and 104 mm/s have columns of their own, 200 and 201 one of their mean level."""
    rows = [magnitude("100 Hz", v, magnitude_mm_s2=v / 10) for v in (100.0, 104.0, 200.0, 201.0)]
    print_magnitudes(rows, [], [])
    head, _, row = capsys.readouterr().out.splitlines()[2:5]
    assert head.split()[1:4] == ["100", "104", "200"]
    assert row.split()[2:5] == ["10", "10.4", "20.1"]


def test_omitted_velocities_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    """Of twelve velocities seven are shown, the slowest and the fastest among them."""
    print_magnitudes([magnitude("100 Hz", float(v)) for v in range(1, 13)], [], [])
    out = capsys.readouterr().out
    assert "5 more velocities in csv and json" in out
    head = next(line for line in out.splitlines() if "band" in line).split()
    assert (head[1], head[-2]) == ("1", "12")


def test_missing_values_are_dashes_and_lines_are_marked(capsys: pytest.CaptureFixture[str]) -> None:
    """Unknown velocity is called so, no slope a dash, a line a tilde, listed once."""
    rows = [magnitude("50 Hz", NAN, line="mains", slope=NAN, slope_std=NAN, grows=None)]
    line = {"log": "a.h5", "channel": "acc_feed", "kind": "mains", "frequency_hz": 50.01,
            "amplitude": 0.016, "unit": "m/s²"}  # fmt: skip
    print_magnitudes(rows, [line, line | {"log": "b.h5", "frequency_hz": 49.99}], [refused()])
    out = capsys.readouterr().out
    assert "12.3~" in out
    assert out.splitlines()[2].split() == ["band", "unknown", "grows"]
    (row,) = [text for text in out.splitlines() if "mains" in text]
    assert row.split() == ["acc_feed", "mains", "50.01", "16", "2"]
    assert "no bytes" in out


def test_an_error_without_harmonics_above_the_floor_shows_a_dash(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Missing bandwidth is a dash; two channels are separate; the table fits 80 columns."""
    row = {
        "log": "velocity-0001.000.h5", "channel": "delta_e", "velocity_mm_s": 1.0,
        "duration_s": 4.0, "min_um": -12345.6, "max_um": 0.5, "std_um": 0.04, "mean_um": 0.0,
        "max_magnitude_um": 0.01, "strongest_hz": 12.5, "bandwidth_hz": 1000.0,
        "share_explained": 0.5, "n_above_floor": 0, "bandwidth_above_floor_hz": NAN,
        "share_explained_above_floor": 0.0, "n_harmonics": 100, "floor_nm": 30.0,
    }  # fmt: skip
    print_error([row], [], [])
    out = capsys.readouterr().out
    assert "–" in out
    assert "−12 300" in out
    assert max(len(line) for line in out.splitlines()) <= 80
    print_error([row, row | {"channel": "delta_e_2"}], [], [refused()])
    out = capsys.readouterr().out
    assert "delta_e_2" in out
    assert "corrupt" in out


def test_declared_and_found_stand_side_by_side(capsys: pytest.CaptureFixture[str]) -> None:
    """A mode off its description is shown with both values and a next step; others are not."""
    row = {"log": "a.h5", "mode": "roll", "channel": "acc", "frequency_hz": 136.4, "snr": 100.0}
    row |= {"frequency_std_hz": 0.1, "damping_ratio": 0.015, "damping_ratio_std": 0.001}
    row |= {"flags": "at-bound"}
    off = {"log": "a.h5", **Difference("roll", 126.5, 136.4, 0.0147, 0.015)._asdict()}
    print_modes([row], [], [off])
    words = " ".join(capsys.readouterr().out.split())
    assert "roll 126.500 136.400 +7.8 1.47 1.50" in words
    assert "correct it, or describe the modes that it lacks" in words
    print_modes([row], [])
    assert "declared" not in capsys.readouterr().out


def test_refusals_alone_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    """Where nothing was read there is no empty table, but why."""
    print_modes([], [refused()])
    text_ = capsys.readouterr().out
    assert "no bytes" in text_ and text_.startswith("No modes found.\nRefused\n")
    for show in (print_error, print_magnitudes):
        show([], [], [refused()])
        text_ = capsys.readouterr().out
        assert "no bytes" in text_ and text_.startswith("Refused\n")


def test_channels_used_in_part_are_no_refusals(capsys: pytest.CaptureFixture[str]) -> None:
    """A channel with gaps is used: it stands under a title of its own."""
    print_modes(
        [], [refused() | {"reason": "gaps", "channel": "acc_x", "detail": "3 missing"}, refused()]
    )
    first, second = capsys.readouterr().out.split("Used in part\n")
    assert "no bytes" in first and "gaps" not in first
    assert "3 missing" in second and "no bytes" not in second


def test_a_flagged_rate_is_no_refusal(capsys: pytest.CaptureFixture[str]) -> None:
    """A log is refused for its rate as a whole, or used with a warning that names the column."""
    flag = {"reason": "rate", "channel": "reference_velocity", "detail": "20040 Hz"}
    print_modes([], [refused() | flag, refused() | {"reason": "rate", "detail": "21000 Hz"}])
    first, second = capsys.readouterr().out.split("Used in part\n")
    assert "21000 Hz" in first and "20040 Hz" in second


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
        "chi_square": 1.02, "distortion": 0.0, "colour": 0.0, "method": "periods", "note": "",
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
    assert "nonlinear" not in out and "correlated" not in out


def test_several_responses_are_separate(capsys: pytest.CaptureFixture[str]) -> None:
    """Each response stands under the name of its log, with its own lines only."""
    lines = [response_line(10.0), response_line(20.0) | {"log": "other"}]
    print_frf([fitted(), fitted(log="other")], lines, [], [])
    first, second = capsys.readouterr().out.split("\nother\n")
    assert first.startswith("log\n")
    assert "1 of 1 lines" in first
    assert "1 of 1 lines" in second
    assert "20" not in first


def test_a_response_reports_what_its_fit_misses(capsys: pytest.CaptureFixture[str]) -> None:
    """Distortion, errors that neighbours share, and an input that does not repeat."""
    fit = fitted(method="segments", period_s=NAN, chi_square=300.0, distortion=0.061, colour=0.35)
    print_frf([fit], [response_line(10.0)], [], [])
    out = capsys.readouterr().out
    assert "not periodic" in out
    assert max(map(len, out.splitlines())) <= 80
    assert "6.1 % of the response" in " ".join(out.split())
    assert "0.35" in out


def test_a_mode_is_read_in_a_band_and_strongest_somewhere_in_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The strongest harmonic is printed as such, with its band, not as the mode."""
    band = {"kind": "mode", "low_hz": 131.6, "high_hz": 141.9, "strongest_hz": 133.2}
    found = magnitude("pitch", 10.0, **band, placed_by="identified")
    other = magnitude("pitch", 20.0, **band | {"strongest_hz": 139.1}, placed_by="identified")
    sought = magnitude("yaw", 10.0, **band | {"strongest_hz": 140.0}, placed_by="stage")
    print_magnitudes([found, other, sought], [], [])
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    text_ = " ".join(out.split())
    assert "Strongest harmonic of pitch at 133 to 139 Hz (band 132 to 142 Hz, around" in text_
    assert "yaw at 140 Hz (band 132 to 142 Hz, as described; mode not identified)." in text_
    assert "137 Hz" not in out


def test_harmonics_are_listed_with_their_channel(capsys: pytest.CaptureFixture[str]) -> None:
    """All of one channel, a dozen each of several; each column of the tables has its own name."""
    row = {
        "log": "logs/a.h5", "channel": "delta_e", "velocity_mm_s": 1.0, "duration_s": 4.0,
        "min_um": -1.0, "max_um": 0.5, "std_um": 0.04, "mean_um": 0.0, "max_magnitude_um": 0.5,
        "strongest_hz": 12.5, "bandwidth_hz": 1000.0, "share_explained": 0.5, "n_above_floor": 3,
        "bandwidth_above_floor_hz": 20.0, "share_explained_above_floor": 0.25, "n_harmonics": 20,
        "floor_nm": 30.0,
    }  # fmt: skip
    own = [
        {"log": "logs/a.h5", "channel": "delta_e", "frequency_hz": 12.5 * k, "amplitude_um": 1 / k}
        for k in range(1, 21)
    ]
    print_error([row], own, [])
    out = capsys.readouterr().out.replace("\u00a0", " ")
    assert max(map(len, out.splitlines())) <= 80
    assert "a.h5, delta_e: 12.5 (1), 25 (0.5), 37.5 (0.333)," in out and "250 (0.05)." in out
    assert "Strongest harmonics\n" in out and "Those above 30 nm\n" in out
    heads = [line.replace(" Hz", "").split() for line in out.splitlines() if line[:4] == " log"]
    assert len(heads) == 3 and all(len(set(head)) == len(head) for head in heads)
    print_error([row, row | {"log": "logs/b.h5"}], own, [])
    out = " ".join(capsys.readouterr().out.split())
    assert "150 (0.0833) and 8 more (see --format json)." in out and "250 (" not in out


def test_logs_are_named_without_their_folder(capsys: pytest.CaptureFixture[str]) -> None:
    """Names are without folders unless two logs share one; flags are explained."""
    row: dict[str, object] = {
        "log": "a/very/long/path/of/folders/log-0001.h5", "mode": "mode_1", "channel": "acc_pitch",
        "frequency_hz": 136.6, "frequency_std_hz": 0.2, "damping_ratio": 0.015,
        "damping_ratio_std": 0.001, "snr": 12.0, "flags": "",
    }  # fmt: skip
    print_modes([row], [])
    line = next(line for line in capsys.readouterr().out.splitlines() if "mode_1" in line)
    assert line.split()[:3] == ["log-0001.h5", "mode_1", "acc_pitch"]
    print_modes([row | {"flags": "cluster loose-fit"}], [])
    out = capsys.readouterr().out
    assert "cluster: one estimate for two modes" in out and "loose-fit: the residual" in out
    print_modes([row | {"log": "x/log.h5"}, row | {"log": "y/log.h5"}], [])
    out = capsys.readouterr().out
    assert "x/log.h5" in out and "y/log.h5" in out


def checked(stage: Stage, capsys: pytest.CaptureFixture[str]) -> str:
    """Examine and print."""
    examined = check_stage(stage)
    print_stage(stage_rows(examined, diagnose(examined)))
    return capsys.readouterr().out


@pytest.mark.parametrize("name", ["lms-x", "lms-y"])
def test_the_shipped_descriptions_fit_eighty_columns(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Modes, parameters, what is known, sensitivities, correlation, diagnose: no line breaks."""
    out = checked(load_stage(name), capsys)
    assert max(len(line) for line in out.splitlines()) <= 80
    assert all(out.count(word) >= 4 for word in ("guide_preload", "mount_stiffness"))
    heads = ("map error", "prior outside", "endless", "Sensitivity", "Correlation")
    assert all(head in out for head in heads)
    assert "+ guide_preload is identifiable" in out
    assert ("! mount_stiffness is not identifiable" in out) == (name == "lms-x")


def test_missing_limits_are_dashes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three parameters, one without a limit whose map ends above another's limit."""
    low = PRELOAD.replace("below = 0.6", "below = 0.1")
    out = checked(make_stage(tmp_path, (low, MOUNT, FOOT)), capsys)
    assert "→ –" in out
    assert out.count("Correlation of") == 3
    assert "nan" not in out


def test_without_health_only_modes_are_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One table and one sentence."""
    out = checked(make_stage(tmp_path, ()), capsys)
    assert "roll" in out
    assert "Sensitivity" not in out
    assert "nan" not in out
    assert "No [[parameter]]" in out


def test_plans_are_one_table_each_with_reasons(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A number of logs or what hinders, dashes for what is not known, what stands for what."""
    monkeypatch.setattr(terminal, "_width", lambda stream: 80)
    asked = {
        "parameter": "p", "loss": 0.05, "power": 0.9, "false_alarm": 0.01, "n_baseline": 7,
        "seconds_for_one_log": 42,
    }  # fmt: skip
    row = {
        "parameter": "p", "loss": 0.05, "seconds_per_log": 60.0, "n_logs": 3, "hindrance": "",
        "power_of_one_log": 0.5, "smallest_loss_of_one_log": 0.04, "smallest_loss": 0.02,
        "value_std_ln": 0.03,
    }  # fmt: skip
    short = row | {
        "seconds_per_log": 0.1, "n_logs": None, "hindrance": "too-short",
        "power_of_one_log": NAN, "smallest_loss_of_one_log": NAN, "smallest_loss": NAN,
        "value_std_ln": NAN,
    }  # fmt: skip
    weak = row | {"loss": 0.01, "n_logs": None, "hindrance": "baseline"}
    print_plans([asked, asked | {"loss": 0.01, "seconds_for_one_log": None}], [row, short, weak])
    shown = capsys.readouterr().out
    first, second = shown.split("p: to detect a loss of 1.0 %")
    assert "loss of 5.0 % with power 0.9, false-alarm probability 0.01" in first
    assert "loss, 7 logs" in first
    assert "60 3 50.0 % 4.0 % 2.0 % 3.0 %" in " ".join(first.split())
    assert "0.1 log too short – – – –" in " ".join(first.split())
    assert "from 42 s on" in first
    assert "baseline too short" in second
    assert "A single log of up to an hour is not enough" in second
    assert "hidden" not in shown
    assert max(len(line) for line in shown.splitlines()) <= 80


def test_changes_are_in_percent(capsys: pytest.CaptureFixture[str]) -> None:
    """Half the frequency is −50 %, not ln 2; a missing damping ratio is a dash."""
    ln_f = np.log(FREQUENCY[:1]) - np.log(2) * (np.arange(8) >= 4)[:, None]
    history = make_history(ln_f, ln_damping=np.full((8, 1), np.nan), std=1e-3)
    print_track(track(history))
    shown = capsys.readouterr().out
    assert "−49.99" in shown or "−50.0" in shown
    assert "−69" not in shown
    assert "–" in shown
    assert "nan" not in shown


def test_a_too_cautious_filter_is_not_widened(capsys: pytest.CaptureFixture[str]) -> None:
    """Logs that vary less than their uncertainty need no missing cause."""
    ln_f = np.tile(np.log(FREQUENCY[:2]), (40, 1))
    ln_zeta = np.tile(np.log(DAMPING[:2]), (40, 1))
    print_track(track(make_history(ln_f, ln_damping=ln_zeta, std=1e-3)))
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    shown = " ".join(shown.split())
    assert "NOT consistent" in shown
    assert "standard deviations are too large" in shown
    assert "multiplied" not in shown


def test_doubts_about_health_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """Missing values are no numbers; edges of the map and a bad fit are reported."""
    sure = make_health(np.random.default_rng(1).lognormal(-0.2, 0.02, (40, 2)))
    print_health(sure)
    text_ = capsys.readouterr().out
    assert " to " in text_
    assert "Correlation of guide_preload and mount_stiffness" in text_
    nothing = np.full((1, 2), np.nan)
    lost = replace(
        sure, judge_shift=nothing, judge_ratio=nothing,
        fit=np.array([1e-9]), at_edge=np.array([[True, False]]),
    )  # fmt: skip
    print_health(lost)
    text_ = capsys.readouterr().out
    assert "nan" not in text_
    assert max(map(len, text_.splitlines())) <= 80
    assert "p = 1e-09): no health is reported" in " ".join(text_.split())
    assert "guide_preload: the posterior ends at the edge" in text_
    assert "mount_stiffness: the posterior ends" not in text_
    print_health(replace(sure, identifiable=np.array([[True, False]])))
    text_ = " ".join(capsys.readouterr().out.split())
    assert "mount_stiffness: not identifiable" in text_


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Printed:
    """Return what was printed since the last time."""
    return lambda: capsys.readouterr().out


def shown(life: Prognosis, decision: Decision, printed: Printed, by: date | None = None) -> str:
    """Print a life and return the text."""
    before = None if by is None else (by, probability_before(life, by))
    print_life(summarise_life(life, STAGE), decide(life, decision), before)
    return printed()


def print_fleet(assessments: Sequence[Assessment]) -> None:
    """Print the result of a run."""
    print_summaries(by_urgency(summarise(one, one.service()) for one in assessments))


def test_the_numbers_are_those_of_the_table(printed: Printed) -> None:
    """A line per level with km, days and the date, as on the page; of one limit one "any"."""
    life = make_prognosis(np.linspace(1e5, 1e6, 1001), np.full(1001, 1e4))
    text = shown(life, Decision(next_service=date(2026, 4, 1)), printed, date(2026, 4, 1))
    row = prognosis_rows(summarise_life(life, STAGE), decide(life, Decision()))[0]
    line = next(line for line in text.splitlines() if " 50 " in line).split()
    days = row["rul_days_q50"]
    day = (START + timedelta(days=days)).date().isoformat()
    assert line[-6:] == ["50", f"{row['rul_km_q50']:.0f}", "km", f"{days:.0f}", "days", day]
    assert "guide preload below 60 %" in text and "any limit" not in text
    assert "already: below 1 %" in text and "before 2026-04-01: 23 %" in text
    service = decide(life, Decision())
    assert f"Service: by {service.by} (accepted risk 5 %)" in text
    assert "Before the service planned for 2026-04-01: 23 %" in text


def test_quantiles_beyond_the_horizon_have_no_number(printed: Printed) -> None:
    """Censored levels have no number; for a passed limit the service is now."""
    life = make_prognosis(np.r_[np.full(40, 1e6), np.full(60, np.inf)], np.full(100, 1e4))
    text = shown(life, Decision(), printed)
    line = next(line.split() for line in text.splitlines() if " beyond 10 000 " in line)
    assert line == ["50", "to", "95", "beyond", "10", "000", "km", "–", "–"]
    assert text.count("beyond 10 000 ") == 1
    assert "beyond horizon: 60 %" in text and "inf" not in text and "nan" not in text
    late = make_prognosis(np.r_[np.full(90, -1e6), np.full(10, np.inf)], np.full(100, 1e4))
    text = shown(late, Decision(cost_ratio=9.0), printed)
    assert "Service: now (least cost, where a failure costs 9 times a service)" in text
    assert "already been reached, at most: 90 %" in text
    text = shown(make_prognosis(np.full(9, np.inf), np.full(9, 1e4)), Decision(), printed)
    assert "no service needed yet" in text and "No service is needed within 10 000 km" in text
    idle = make_prognosis(np.full(9, 9e6), np.full(9, 1.0))
    text = shown(idle, Decision(), printed)
    assert "no date" in text and "out of range" in text and "too low for a calendar" in text


def test_probabilities_of_a_limit_have_their_own_lines(printed: Printed) -> None:
    """Each probability that belongs to the limit has a line without numbers of a level."""
    life = make_prognosis(np.linspace(1e5, 1e6, 1001), np.full(1001, 1e4))
    lines = shown(life, Decision(), printed, date(2026, 4, 1)).splitlines()
    for text in ("already: below 1 %", "beyond horizon: below 1 %", "before 2026-04-01: 23 %"):
        assert text in [line.strip() for line in lines]
    assert any("probability %" in line for line in lines)


@pytest.mark.parametrize("other", [np.inf, 2e6, 1.5e5])
def test_any_limit_is_not_printed_twice(printed: Printed, other: float) -> None:
    """Where one limit always comes first, any limit is that one in a line; else it has its rows."""
    remaining = np.column_stack([np.linspace(1e5, 1e6, 1001), np.full(1001, other)])
    both = np.column_stack([remaining, remaining.min(axis=1)])
    life = replace(
        make_prognosis(remaining[:, 0], np.full(1001, 1e4)),
        parameters=("guide_preload", "mount_stiffness", "any"),
        limits=np.array([0.6, 0.7, np.nan]),
        remaining=both,
        half=remaining / 2,
        health=np.full((1001, 2), 0.8),
        curve_quantiles=np.full((5, 3, 2), 0.8),
    )
    text = shown(life, Decision(), printed)
    alone = other > 1e6
    assert ("Any limit: the same as guide preload below 60 %." in text) is alone
    assert (" any limit " in text) is not alone


def test_the_risk_of_a_service_is_printed_once(printed: Printed) -> None:
    """The risk is printed only where it differs from the accepted one."""
    life = make_prognosis(np.linspace(1e3, 1e6, 1001), np.full(1001, 1e4))
    text_ = "Probability that a limit is reached before that day, at most"
    risks = [decide(life, Decision(max_risk=risk)).risk for risk in (0.05, 0.0592)]
    for risk, found in zip((0.05, 0.0592), risks, strict=True):
        text = shown(life, Decision(max_risk=risk), printed)
        assert (text_ in text) is (f"{100 * found:.0f} %" != f"{100 * risk:.3g} %")
    assert f"{100 * risks[0]:.0f} %" == "5 %"


def test_laws_and_unidentifiable_limits_are_named(printed: Printed) -> None:
    """Laws with their probability, improbable ones left out; a limit nobody sees is no part."""
    life = make_prognosis(np.full(9, 1e6), np.full(9, 1e4))
    assert "Law of" not in shown(life, Decision(), printed)
    weights = (("linear", 0.0, 0.7), ("none", 3e5, 0.295), ("power", 0.0, 0.005))
    laws = tuple(LawWeight("guide_preload", *weight) for weight in weights)
    text = shown(replace(life, laws=laws, unidentifiable=("mount_stiffness",)), Decision(), printed)
    text_ = "Law of guide preload: linear 70 %, none from 300 km after the baseline 30 %."
    assert text_ in " ".join(text.split()) and "power" not in text
    assert "Not included: the limit of mount stiffness" in text


def test_a_few_machines_are_printed_in_full(
    make: Callable[..., Assessment], printed: Printed
) -> None:
    """Verdict, gauges, remaining life of every limit and of any, and the service, in order."""
    good, bad = make("A", wear_km=400000, floor=0.98), make("B")
    print_fleet([good, blind(bad), nothing(make("C"))])
    text = printed()
    assert text.index("B: both (93 %). Roll") < text.index("C: not-enough-data. 2 logs")
    assert text.index("C: not") < text.index("A: healthy (97 %)")
    assert bad.health is not None
    low, middle, high = 100 * bad.health.quantile(np.array([0.05, 0.5, 0.95]))[:, -1, 0]
    assert f"guide preload {middle:.0f} % ({low:.0f} to {high:.0f} %)" in text
    assert "mount stiffness not determined" in text
    assert text.lower().count("any limit") == 2
    assert f"Service: by {bad.service().by}" in text


def test_many_machines_have_a_row_each(
    make: Callable[..., Assessment], printed: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty rows, the most urgent first, the rest counted; nothing runs off the terminal."""
    monkeypatch.setattr(terminal, "_width", lambda stream: 80)
    good, bad = make("good", wear_km=400000, floor=0.98), make("worst")
    fleet = [replace(good, judgement=replace(good.judgement, stage=f"M{k}")) for k in range(21)]
    print_fleet([*fleet, bad])
    text = printed()
    rows = [line for line in text.splitlines() if "healthy" in line or "both" in line]
    assert len(rows) == 20 and rows[0].strip().startswith("worst")
    assert service_text(bad.service()) in rows[0]
    assert "22 stages" in text and "2 more stages" in text
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text


def test_a_step_refers_to_nothing_below_on_a_terminal(
    make: Callable[..., Assessment], printed: Printed
) -> None:
    """The reasons of a machine that needs further logs are on its page only."""
    print_fleet([nothing(make("C"))])
    text = printed()
    assert "Record further logs; the page has the reasons." in text and "below" not in text


def test_a_log_that_was_due_is_asked_for_now(
    make: Callable[..., Assessment], printed: Printed
) -> None:
    """A day to inspect that has passed is worded as on the page."""
    one = summarise(make(), make().service())
    life, due = one.life, date(2026, 7, 18)
    assert life is not None
    service = replace(one.service, kind="by", inspect_by=due)
    for today, words in (
        (due, f"Inspect (record a log) by {due}"),
        (due + timedelta(days=1), f"A log was due by {due}: record one now"),
    ):
        print_summaries([replace(one, service=service, today=today)])
        assert words in printed()
