"""What is shown of logs: numbers as people read them, tables that fit, names that are not torn."""

from __future__ import annotations

import pytest

from lmshealth.cli.logview import print_error, print_frf, print_magnitudes, print_modes

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
    """Missing bandwidth is a dash; two channels are told apart; the table fits 80 columns."""
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
    assert "-12346" in out
    assert max(len(line) for line in out.splitlines()) <= 80
    print_error([row, row | {"channel": "delta_e_2"}], [], [refused()])
    out = capsys.readouterr().out
    assert "delta_e_2" in out
    assert "corrupt" in out


def test_refusals_alone_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    """Where nothing was read there is no empty table, but why."""
    print_modes([], [refused()])
    told = capsys.readouterr().out
    assert "no bytes" in told and told.startswith("No modes found.\nRefused\n")
    for show in (print_error, print_magnitudes):
        show([], [], [refused()])
        told = capsys.readouterr().out
        assert "no bytes" in told and told.startswith("Refused\n")


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
    assert max(map(len, out.splitlines())) <= 80
    assert "6.1 % of the response" in " ".join(out.split())
    assert "0.35" in out


def test_a_mode_is_read_in_a_band_and_strongest_somewhere_in_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The strongest harmonic is told as such, with the band and what placed it, not as the mode."""
    band = {"kind": "mode", "low_hz": 131.6, "high_hz": 141.9, "strongest_hz": 133.2}
    found = magnitude("pitch", 10.0, **band, placed_by="identified")
    other = magnitude("pitch", 20.0, **band | {"strongest_hz": 139.1}, placed_by="identified")
    sought = magnitude("yaw", 10.0, **band | {"strongest_hz": 140.0}, placed_by="stage")
    print_magnitudes([found, other, sought], [], [])
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    told = " ".join(out.split())
    assert "Strongest harmonic of pitch at 133 to 139 Hz (read from 132 to 142 Hz, around" in told
    assert "yaw at 140 Hz (read from 132 to 142 Hz, where it is described, not found)." in told
    assert "137 Hz" not in out


def test_harmonics_are_listed_and_say_whose_they_are(capsys: pytest.CaptureFixture[str]) -> None:
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
    assert "Strongest harmonics\n" in out and "Those of them above 30 nm\n" in out
    heads = [line.replace(" Hz", "").split() for line in out.splitlines() if line[:4] == " log"]
    assert len(heads) == 3 and all(len(set(head)) == len(head) for head in heads)
    print_error([row, row | {"log": "logs/b.h5"}], own, [])
    out = " ".join(capsys.readouterr().out.split())
    assert "150 (0.083) and 8 more, which json lists." in out and "250 (" not in out


def test_logs_are_named_without_their_folder(capsys: pytest.CaptureFixture[str]) -> None:
    """A long path does not tear names; two logs of one name keep their folders."""
    row: dict[str, object] = {
        "log": "a/very/long/path/of/folders/log-0001.h5", "mode": "mode_1", "channel": "acc_pitch",
        "frequency_hz": 136.6, "frequency_std_hz": 0.2, "damping_ratio": 0.015,
        "damping_ratio_std": 0.001, "snr": 12.0, "flags": "",
    }  # fmt: skip
    print_modes([row], [])
    line = next(line for line in capsys.readouterr().out.splitlines() if "mode_1" in line)
    assert line.split()[:3] == ["log-0001.h5", "mode_1", "acc_pitch"]
    print_modes([row | {"log": "x/log.h5"}, row | {"log": "y/log.h5"}], [])
    out = capsys.readouterr().out
    assert "x/log.h5" in out and "y/log.h5" in out
