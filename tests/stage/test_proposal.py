"""Column maps and descriptions that are proposed from logs."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from lmshealth._private.toml import decode
from lmshealth.errors import BadLog, BadStage
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.reading import read_log
from lmshealth.stage.description import ModeSpec, load_stage
from lmshealth.stage.proposal import moment_of, propose, searches, write_skeleton

RNG = np.random.default_rng(1)
NOISE = RNG.normal(0, 1, (4, 2000)).round(4)
TIME = np.arange(2000) / 500


def write(path: Path, names: str, *columns: np.ndarray, before: str = "") -> Path:
    """Write columns below a line of names."""
    rows = [
        ",".join(f"{v!r}" for v in row)
        for row in zip(*map(np.ndarray.tolist, columns), strict=True)
    ]
    path.write_text("\n".join([f"{before}{names}", *rows, ""]), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("name", "target", "scale"),
    [
        ("AI 3 [g]", "acc_ai_3_g", 9.80665),
        ("AI 3 [m/s²]", "acc_ai_3_m_s2", 1.0),
        ("Beschleunigung X", "acc_beschleunigung_x", 1.0),
        ("Following error [nm]", "delta_e_following_error_nm", 1e-9),
        ("Schleppfehler", "delta_e_schleppfehler", 1e-6),
        ("PosErr", "delta_e_poserr", 1e-6),
        ("err_um", "delta_e_err_um", 1e-6),
        ("PE(0) [mm]", "delta_e_pe_0_mm", 1e-3),
        ("sensor_b [V]", "acc_sensor_b", 1.0),
        ("acc_feed_g", "acc_feed_g", 9.80665),
    ],
)
def test_a_signal_is_found_and_read(tmp_path: Path, name: str, target: str, scale: float) -> None:
    """A column is recognised by unit, name or oscillation, and the map reads it in SI units."""
    slow = np.linspace(0, 3, 2000).round(4)
    path = write(tmp_path / "a.csv", f"Time,{name},Temp [°C]", TIME, NOISE[0], slow)
    text, guesses = propose(path)
    assert {g.target for g in guesses} == {"time_s", target, ""}
    assert all(g.why for g in guesses)
    log = read_log(path, columns=decode(text.encode(), ColumnMap))
    assert log.sample_rate == pytest.approx(500)
    np.testing.assert_allclose(log.channels[0].values[:], scale * NOISE[0], rtol=1e-12)


def test_the_remaining_quantities(tmp_path: Path) -> None:
    """Set points, currents and further columns of times are recognised; a position is no error."""
    names = "Zeit [ms],Acc_X,Soll [mm],I_q [A],Pos [mm],Timestamp,crc_err"
    columns = 1e3 * TIME, NOISE[0], TIME, NOISE[1], NOISE[2], TIME, NOISE[1]
    text, guesses = propose(write(tmp_path / "a.csv", names, *columns))
    found = {g.source: g.target for g in guesses}
    assert found == {
        "Zeit": "time_ms", "Acc_X": "acc_x", "Soll": "reference_position_mm",
        "I_q": "current_i_q_a", "Pos": "", "Timestamp": "", "crc_err": "",
    }  # fmt: skip
    assert "assumed: set it" in text


@pytest.mark.parametrize(
    ("name", "text", "moment", "where"),
    [
        ("a.csv", "# recorded_at: 2026-01-05T08:00:00+01:00\n", "2026-01-05T08:00:00", "stated"),
        ("axis7_2026-01-05_0815.csv", "", "2026-01-05T08:15:00", "name"),
        ("20260105T081530.csv", "", "2026-01-05T08:15:30", "name"),
        ("log_20260105.csv", "", "2026-01-05T00:00:00", "name"),
        ("20261305.csv", "", "", ""),
        ("1202601057.csv", "", "", ""),
    ],
)
def test_when_a_log_was_recorded(
    tmp_path: Path, name: str, text: str, moment: str, where: str
) -> None:
    """The file comes before its name, a date that does not exist is none; the source is named."""
    path = write(tmp_path / name, "time_s,acc_x_g", TIME, NOISE[0], before=text)
    found, source = moment_of(path, read_log(path))
    assert found[:19] == moment and where in source
    assert not found or found[19] in "+-"
    assert ("time zone of this computer" in source) == (where == "name")


def test_a_header_says_when_a_log_was_recorded(tmp_path: Path) -> None:
    """LabVIEW states date and time without a zone."""
    head = (
        "LabVIEW Measurement\t\nX_Columns\tOne\n***End_of_Header***\t\n\t\nDate\t2026/01/05\t\n"
        "Time\t08:15:30,1250000000000\t\nY_Unit_Label\tg\t\n***End_of_Header***\t\nX_Value\ta\n"
    )
    rows = "\n".join(f"{t}\t{a}" for t, a in zip(TIME.tolist(), NOISE[0], strict=True))
    path = tmp_path / "2020-01-01.lvm"
    path.write_text(head + rows + "\n")
    found, source = moment_of(path, read_log(path))
    assert found.startswith("2026-01-05T08:15:30.125") and "header" in source


def test_structs_of_matlab_are_opened(tmp_path: Path) -> None:
    """Fields of structs are found by their names, and scalars are left out."""
    scipy.io.savemat(
        tmp_path / "a.mat",
        {"e": {"t": TIME, "Acc": NOISE[0], "fs": 500.0}, "stage": "A-1", "x": 1.0},
    )
    text, guesses = propose(tmp_path / "a.mat")
    assert {g.source: g.target for g in guesses if g.target} == {
        "e.t": "time_s", "e.Acc": "acc_e_acc",
    }  # fmt: skip
    assert read_log(tmp_path / "a.mat", columns=decode(text.encode(), ColumnMap)).sample_rate


def test_a_rate_is_asked_for(tmp_path: Path) -> None:
    """Without times a sample rate must be given; a counter is no time."""
    path = write(tmp_path / "a.csv", "n,acc", np.arange(2000.0), NOISE[0])
    with pytest.raises(BadLog, match="--sample-rate"):
        propose(path)
    text, _ = propose(path, rate=2000.0)
    assert read_log(path, columns=decode(text.encode(), ColumnMap)).sample_rate == 2000


def test_nothing_is_invented(tmp_path: Path) -> None:
    """A file without anything that oscillates is refused with the reasons."""
    path = write(tmp_path / "a.csv", "Time,Temp [°C],on", TIME, TIME, NOISE[0] > 0)
    with pytest.raises(BadLog, match="nothing looks like") as refused:
        propose(path)
    assert "Temp" in str(refused.value)


def test_searches_are_narrower_near_a_neighbour() -> None:
    """The default, twice the distance of the nearest mode, or the least."""
    assert searches([100.0]) == [0.15]
    assert searches([100.0, 104.0, 200.0]) == pytest.approx([0.0784, 0.0784, 0.15], abs=1e-3)
    assert searches([100.0, 100.2]) == [0.02, 0.02]


def test_any_name_is_quoted(tmp_path: Path) -> None:
    """Quotes, backslashes and wildcards in names mean themselves."""
    path = tmp_path / "my stage.toml"
    mode = ModeSpec("mode_1", 62.0, 0.02, snr=50.0)
    write_skeleton(path, 'in C:\\logs\\"a".csv\n\x7f', 'M[1]*"', [(mode, "± 0.1")])
    stage = load_stage(str(path))
    assert (stage.name, stage.modes) == ("my stage", (mode,))
    assert stage.description.source == 'in C:\\logs\\"a".csv\n\x7f'
    assert stage.description.match.stage == 'M[[]1][*]"'


@pytest.mark.parametrize("stem", ["a" * 201, "tab\t"])
def test_a_name_that_no_description_has_is_refused(tmp_path: Path, stem: str) -> None:
    """Before a file is written that cannot be read."""
    path = tmp_path / f"{stem}.toml"
    with pytest.raises(BadStage, match=r"not written.*name: "):
        write_skeleton(path, "", "A", [(ModeSpec("mode_1", 62.0, 0.02), "")])
    assert not path.exists()


START = 1_767_600_000.0  # 2026-01-05 08:00 UTC
STAMPS = {
    "time": lambda t: f"{t:.6f}",
    "time_s": lambda t: f"{t:.7f}",
    "Zeit [ms]": lambda t: f"{1e3 * t:.4f}",
    "millis": lambda t: f"{1e3 * t:.0f}",
    "micros": lambda t: f"{1e6 * t:.0f}",
    "t (us)": lambda t: f"{7e5 + 1e6 * t:.0f}",
    "elapsed [ns]": lambda t: f"{1e9 * t:.0f}",
    "timestamp_ns": lambda t: f"{9e12 + 1e9 * t:.0f}",
    "Time [min]": lambda t: f"{t / 60:.9f}",
    "Timestamp": lambda t: np.datetime_as_string(np.datetime64(int(1e6 * (START + t)), "us")),
    "Datum": lambda t: f"05.01.2026 08:00:{t:09.6f}",
    "Time": lambda t: f"{1e3 * (START + t):.0f}",
    "unix time": lambda t: f"{1e6 * (START + t):.0f}",
    "Date": lambda t: f"{46027.25 + t / 86400:.11f}",
    "": lambda t: f"{t:.5f}",
    " ": lambda t: np.datetime_as_string(np.datetime64(int(1e3 * (START + t)), "ms")),
}


LAYOUTS = [
    (400.0, 12, ",", "Rate 400, overflows 0\n"),
    (250.0, 2, ";", ""),
    (640.0, 5, "\t", "\n\n"),
]
CASES = [(stamp, *LAYOUTS[k % 3]) for k, stamp in enumerate(STAMPS)]
EVERY = [(stamp, *layout) for stamp in STAMPS for layout in LAYOUTS]


@pytest.mark.parametrize(
    ("stamp", "rate", "n_channels", "delimiter", "end"),
    [*CASES, *(pytest.param(*one, marks=pytest.mark.slow) for one in EVERY if one not in CASES)],
)
def test_the_proposed_rate_is_that_of_the_log(
    tmp_path: Path, stamp: str, rate: float, n_channels: int, delimiter: str, end: str
) -> None:
    """Rate and channels of a proposal are those that its column map reads."""
    rng = np.random.default_rng(n_channels)
    values = np.cumsum(rng.normal(0, 1, (600, n_channels)), axis=0)
    values = np.diff(values, axis=0, n=2).round(4)
    times = np.arange(len(values)) / rate
    rows = [
        delimiter.join([STAMPS[stamp](t), *map(str, row)])
        for t, row in zip(times.tolist(), values.tolist(), strict=True)
    ]
    names = [delimiter.join([stamp, *(f"ch{k + 1}" for k in range(n_channels))])]
    path = tmp_path / "a.csv"
    path.write_text("\n".join((names if stamp.strip() else []) + rows) + "\n" + end)
    text, guesses = propose(path)
    log = read_log(path, columns=decode(text.encode(), ColumnMap))
    (why,) = (g.why for g in guesses if g.target.startswith("time"))
    assert f"{log.sample_rate:.6g} Hz" in why
    assert log.sample_rate == pytest.approx(rate, rel=1e-3)
    assert len(log.channels) == n_channels and log.channels[0].values.size == len(values)


@pytest.mark.parametrize(
    ("name", "step", "n_units"),
    [("", 39.0625, 2), ("", 0.04, 2), ("Time", 0.5, 2), ("Time", 50.0, 2), ("t", 2.5, 2)],
)
def test_a_unit_that_nothing_states_is_asked_for(
    tmp_path: Path, name: str, step: float, n_units: int
) -> None:
    """Without a witness both readings are shown, and the rate chooses between them."""
    stamps = step * np.arange(2000)
    path = write(tmp_path / "a.csv", f"{name},b,c", stamps, NOISE[0], NOISE[1])
    path.write_text(path.read_text().partition("\n")[2] if not name else path.read_text())
    with pytest.raises(BadLog, match="nothing states its unit") as refused:
        propose(path)
    readings = [float(hz) for hz in re.findall(r"([\d.e+]+) Hz in", str(refused.value))]
    assert len(readings) >= n_units and "--sample-rate" in str(refused.value)
    for rate in readings[:2]:
        text, _ = propose(path, rate=rate)
        log = read_log(path, columns=decode(text.encode(), ColumnMap))
        assert log.sample_rate == pytest.approx(rate, rel=1e-4)


def test_a_counter_is_no_time_since_an_epoch(tmp_path: Path) -> None:
    """A count that is as large as a date is not read in its unit."""
    for first, step in ((1.7e9, 8333.0), (1.7e12, 1e6)):
        stamps = first + step * np.arange(2000)
        path = write(tmp_path / "a.csv", "SampleTime,acc_g", stamps, NOISE[0])
        with pytest.raises(BadLog, match="nothing states its unit"):
            propose(path)


def test_times_that_contradict_a_rate(tmp_path: Path) -> None:
    """Two statements of the sample rate that differ are refused with both, a ramp is no time."""
    path = write(tmp_path / "a.csv", "Time [ms],acc_g", 1e3 * TIME, NOISE[0])
    with pytest.raises(BadLog, match="give 500 Hz in ms, the stated sample rate is 510 Hz"):
        propose(path, rate=510.0)
    assert "sample_rate_hz" not in propose(path, rate=500.0)[0]
    path = write(tmp_path / "b.csv", "# sample_rate_hz: 400\nacc_g", NOISE[0])
    with pytest.raises(BadLog, match="states 400 Hz, --sample-rate is 500 Hz"):
        propose(path, rate=500.0)
    ramp = write(tmp_path / "c.csv", "x", 3.0 * TIME, NOISE[0])
    ramp.write_text(ramp.read_text().partition("\n")[2])
    assert {g.source: g.target for g in propose(ramp, rate=2000.0)[1]} == {"0": "", "1": "acc_1"}


def test_channels_of_one_kind(tmp_path: Path) -> None:
    """Equal names are numbered, other quantities left out, and late activity is seen."""
    late = np.where(TIME < 3.8, 0.0, NOISE[3])
    names = "Time,AI 1,AI-1,temperature,late,magnitude"
    columns = TIME, NOISE[0], NOISE[1], NOISE[2], late, np.abs(NOISE[3]) ** 6 + 1e-9
    found = {g.source: g.target for g in propose(write(tmp_path / "a.csv", names, *columns))[1]}
    assert found == {
        "Time": "time_s", "AI 1": "acc_ai_1", "AI-1": "acc_ai_1_2", "temperature": "",
        "late": "acc_late", "magnitude": "",
    }  # fmt: skip


def test_a_velocity_is_no_time(tmp_path: Path) -> None:
    """A unit that ends in s, and a set point that ascends, make no times."""
    names = "time_s,acc_x_g,reference_velocity_mm_s,speed_mm_s,Rate (deg/s)"
    rising, level = 3.0 * TIME, np.full(2000, 50.0)
    path = write(tmp_path / "a.csv", names, TIME, NOISE[0], level, rising, rising)
    found = {g.source: g.target for g in propose(path)[1]}
    assert [name for name, target in found.items() if target] == ["time_s", "acc_x_g"]
    named = write(tmp_path / "b.csv", f"# sample_rate_hz: 500\n{names[7:]}", NOISE[0], level,
                  rising, rising)  # fmt: skip
    assert not any(g.target.startswith("time") for g in propose(named)[1])


OUTSIDE = [
    ("axivity.csv", None, 400.0, 3),
    ("millis.csv", None, 400.0, 2),
    ("time_lowercase.csv", None, 400.0, 2),
    ("rrf_m956.csv", 1344.0, 1344.0, 3),
    ("rounded_1us.csv", 25600.0, 25600.0, 2),
    ("tdms_time_channel.tdms", None, 2000.0, 1),
]


@pytest.mark.parametrize(("name", "given", "rate", "n_channels"), OUTSIDE)
def test_files_of_others(
    needs: Callable[[str], None], name: str, given: float | None, rate: float, n_channels: int
) -> None:
    """Files that were proposed at a wrong rate, in part or not at all."""
    needs("data")
    path = Path(os.environ["LMSHEALTH_DATA"]) / "outside_faults" / name
    text, guesses = propose(path, rate=given)
    log = read_log(path, columns=decode(text.encode(), ColumnMap))
    assert log.sample_rate == pytest.approx(rate, rel=1e-5) and len(log.channels) == n_channels
    times = [g.why for g in guesses if g.target.startswith("time")]
    assert all(f"{log.sample_rate:.6g} Hz" in why for why in times)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_column_with_infinite_values_is_no_signal_and_no_warning(tmp_path: Path) -> None:
    """Two of them in a row have no difference."""
    samples = np.random.default_rng(0).normal(size=(3000, 2))
    samples[7:9, 1] = np.inf
    head = "acc_x_m_s2,1"
    np.savetxt(tmp_path / "a.csv", samples, delimiter=",", header=head, comments="")
    assert "acc_x_m_s2" in str(propose(tmp_path / "a.csv", rate=1000.0))
