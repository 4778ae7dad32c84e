"""Exports with a header of their own, and dialects of delimited text, written to their layouts."""

import gzip
import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap, CsvLayout
from lmshealth.io.formats.dialect import stated_dialect
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable

X = np.round(1e-3 * np.sin(np.arange(400) * 0.7), 6)
Y = np.round(1e-3 * np.cos(np.arange(400) * 0.3), 6)


def number(value: float, decimal: str = ".") -> str:
    """Write a number with a decimal mark."""
    return f"{value:.6f}".replace(".", decimal)


def twincat(delimiter: str, decimal: str) -> str:
    """Write a Scope export: two groups, the slower one padded with blanks."""
    d = delimiter
    start, end = "133481088000000000", "133481098000000000"
    head = [f"Name{d}scope", f"File{d}x.tcscopex", f"Starttime of export{d}{start}{d}date{d}time",
            f"Endtime of export{d}{end}{d}date{d}time", "", ""]  # fmt: skip
    rows = {
        "Name": ["acc one", "acc two", "Name", "slow"],
        "SymbolComment": ["", "", "SymbolComment", ""],
        "Data-Type": ["REAL64", "REAL64", "Data-Type", "REAL64"],
        "SampleTime[ms]": ["1", "1", "SampleTime[ms]", "2"],
        "ScaleFactor": ["1", "1", "ScaleFactor", "1"],
        "Unit": ["m/s^2", "mm/s^2", "Unit", "m/s^2"],
    }
    head += [d.join([key, *cells]) for key, cells in rows.items()]
    data = []
    for k in range(400):
        slow = [str(2 * k), number(0.5, decimal)] if k < 200 else ["", ""]
        data.append(d.join([str(k), number(X[k], decimal), number(Y[k], decimal), *slow]))
    return "\n".join([*head, "", *data, "EOF", ""])


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    ("delimiter", "decimal"), [("\t", "."), ("\t", ","), (";", ","), (";", ".")]
)
def test_twincat_scope(tmp_path, delimiter, decimal, compressed):
    """The faster group is read in its units and rate, the slower one is refused by name."""
    text = twincat(delimiter, decimal).encode()
    path = tmp_path / ("log.csv.gz" if compressed else "log.csv")
    path.write_bytes(gzip.compress(text) if compressed else text)
    log = read_log(path)
    assert [channel.name for channel in log.channels] == ["acc_acc_one", "acc_acc_two"]
    np.testing.assert_allclose(log.channels[0].values[:], X, atol=1e-12)
    np.testing.assert_allclose(log.channels[1].values[:], 1e-3 * Y, atol=1e-12)
    moment = log.metadata.recorded_at
    assert log.sample_rate == 1000 and moment is not None and moment.year == 2023
    assert [(r.channel, r.reason) for r in log.refused] == [("acc_slow_m_s2", "time")]


@pytest.mark.parametrize("mark", [" ", '"'])
def test_twincat_scope_with_padded_or_quoted_numbers(tmp_path, mark):
    """Rows that do not begin with a digit are read from the first one on."""
    end = mark.strip()
    lines = twincat(";", ",").split("\n")
    rows = [
        ";".join(f"{mark}{one}{end}" if one else "" for one in line.split(";"))
        if line[:1].isdigit()
        else line
        for line in lines
    ]
    (tmp_path / "log.csv").write_text("\n".join(rows))
    np.testing.assert_allclose(read_log(tmp_path / "log.csv").channels[0].values[:], X, atol=1e-12)


def test_twincat_scope_with_marks_between_thousands(tmp_path):
    """Whole numbers with commas are refused; the column map decides what a comma is."""
    text = re.sub(r"-?\d+\.\d+", "1,042", twincat(";", "."))
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(BadLog, match="'1,042' may have a mark between thousands"):
        read_log(tmp_path / "log.csv")
    found = stated_dialect(text.splitlines(), ColumnMap(csv=CsvLayout(decimal=",")))
    assert found is not None and found.decimal == ","


@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("own_x", ["No", "One"])
def test_labview(tmp_path, decimal, own_x):
    """A .lvm file is read with its units and interval, with and without X values."""
    head = ["LabVIEW Measurement", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab",
            f"Decimal_Separator\t{decimal}", f"X_Columns\t{own_x}", "Date\t2026/01/05",
            "***End_of_Header***", "", "Channels\t2", "Samples\t400\t400",
            "Y_Unit_Label\tm/s^2\tm/s^2", "X_Dimension\tTime\tTime", "X0\t0\t0",
            f"Delta_X\t{number(0.001, decimal)}\t{number(0.001, decimal)}", "***End_of_Header***",
            "X_Value\tfeed\tpitch\tComment"]  # fmt: skip
    x = [number(k / 1000, decimal) if own_x == "One" else "" for k in range(400)]
    rows = ["\t".join([x[k], number(X[k], decimal), number(Y[k], decimal)]) for k in range(400)]
    (tmp_path / "log.lvm").write_text("\n".join([*head, *rows, ""]))
    log = read_log(tmp_path / "log.lvm")
    assert log.sample_rate == 1000 and [c.name for c in log.channels] == ["acc_feed", "acc_pitch"]
    np.testing.assert_allclose(log.channels[1].values[:], Y, atol=1e-12)


def test_a_short_twincat_export_with_its_end(tmp_path):
    """The mark of the end is no key of the header, also where it is among the first lines."""
    lines = twincat("\t", ".").splitlines()
    (tmp_path / "log.csv").write_text("\n".join([*lines[:213], "EOF", ""]))
    log = read_log(tmp_path / "log.csv")
    np.testing.assert_allclose(log.channels[0].values[:], X[:200], atol=1e-12)


def lvm(own_x: str, rows: list[str], delta: str = "0.001") -> str:
    """Write a measurement of two channels with the units g and m/s²."""
    cells = lambda *words: ("\t\t" if own_x == "Multi" else "\t").join(words)  # noqa: E731
    names = cells("X_Value\tfeed", "X_Value\tpitch") if own_x == "Multi" else "X_Value\tfeed\tpitch"
    names = names.replace("\t\t", "\t")
    segment = [
        "",
        "Channels\t2",
        f"Samples\t{cells('400', '400')}",
        f"Y_Unit_Label\t{cells('g', 'm/s^2')}",
        f"X0\t{cells('0', '0')}",
        f"Delta_X\t{cells(delta, delta)}",
        "***End_of_Header***",
        f"{names}\tComment",
    ]
    return "\n".join([*segment, *rows, ""])  # fmt: skip


LVM_HEAD = "LabVIEW Measurement\nSeparator\tTab\nX_Columns\t{}\n***End_of_Header***\n"


def test_labview_with_several_columns_of_x(tmp_path):
    """Each channel has the unit, the rate and the times that stand before it."""
    rows = [f"{k / 1000}\t{X[k]:.6f}\t{k / 1000}\t{Y[k]:.6f}" for k in range(400)]
    (tmp_path / "log.lvm").write_text(LVM_HEAD.format("Multi") + lvm("Multi", rows))
    log = read_log(tmp_path / "log.lvm")
    assert log.sample_rate == 1000 and [c.name for c in log.channels] == ["acc_feed", "acc_pitch"]
    np.testing.assert_allclose(log.channels[0].values[:], 9.80665 * X, atol=1e-12)
    np.testing.assert_allclose(log.channels[1].values[:], Y, atol=1e-12)


def test_labview_of_several_segments(tmp_path):
    """Segments with X values are one log, cut where time is missing; others are refused."""
    rows = [f"{(k + 50 * (k >= 200)) / 1000}\t{X[k]:.6f}\t{Y[k]:.6f}" for k in range(400)]
    parts = [lvm("One", rows[:200]), lvm("One", rows[200:])]
    path = tmp_path / "log.lvm"
    path.write_text(LVM_HEAD.format("One") + "".join(parts))
    log = read_log(path)
    assert log.sample_rate == 1000 and log.pieces == ((0, 200), (200, 400))
    np.testing.assert_allclose(log.channels[1].values[:], Y, atol=1e-12)
    path.write_text(LVM_HEAD.format("No") + lvm("No", ["\t1\t2"] * 3) + lvm("No", ["\t1\t2"]))
    with pytest.raises(BadLog, match=r"line 17: a further segment.* needed X_Columns One"):
        read_log(path)
    path.write_text(LVM_HEAD.format("No") + lvm("No", ["\t1\t2"] * 401))
    with pytest.raises(BadLog, match="line 413: a further segment, more rows than Samples"):
        read_log(path)
    path.write_text(path.read_text().replace("g\tm/s^2", "V\tV"))  # no signal
    with pytest.raises(BadLog, match="line 413: a further segment, more rows than Samples"):
        read_log(path)
    for separator in "\t,":
        changed = LVM_HEAD.format("One") + parts[0] + parts[1].replace("pitch", "yaw")
        path.write_text(changed.replace("Tab", "Comma").replace("\t", separator))
        with pytest.raises(BadLog, match="same channels in all"):
            read_log(path)
    path.write_text((LVM_HEAD.format("One") + "".join(parts)).replace("\t", ","))
    np.testing.assert_array_equal(read_log(path).channels[1].values, log.channels[1].values)
    path.write_text(LVM_HEAD.format("One") + parts[0] + parts[0])
    with pytest.raises(BadLog, match="time"):
        read_log(path)


def test_gcs_array(tmp_path):
    """A GCS array names its columns and its interval."""
    head = ["# REM PI GCS", "# VERSION = 1", "# TYPE = 1", "# SEPARATOR = 32", "# DIM = 2",
            "# SAMPLE_TIME = 0.001", "# NDATA = 400", "# NAME0 = Position Error", "# NAME1 = x",
            "# END_HEADER"]  # fmt: skip
    rows = [f"{number(X[k])} {number(Y[k])} " for k in range(400)]
    (tmp_path / "log.dat").write_text("\n".join([*head, *rows, ""]))
    columns = ColumnMap(columns={"delta_e_mm": "Position Error"})
    log = read_log(tmp_path / "log.dat", columns=columns)
    assert log.sample_rate == 1000
    np.testing.assert_allclose(log.channels[0].values[:], 1e-3 * X, atol=1e-12)


@pytest.mark.parametrize("names", [{0: "a", 1: "b", 2: "c"}, {1: "a", 2: "b"}])
@pytest.mark.parametrize("end", ["", " "])
def test_numbered_names_keep_their_columns(tmp_path, names, end):
    """Columns are counted from 0 or 1, with more names than fields and with an empty last field."""
    head = ["# SEPARATOR = 59", "# SAMPLE_TIME = 0.001"]
    head += [f"# NAME{k} = {name} (g)" for k, name in names.items()] + ["# END_HEADER"]
    rows = [f"{number(X[k])};{number(Y[k])}" + (";" if end else "") for k in range(400)]
    (tmp_path / "log.dat").write_text("\n".join([*head, *rows, ""]))
    log = read_log(tmp_path / "log.dat")
    assert [one.name for one in log.channels] == ["acc_a", "acc_b"]
    np.testing.assert_allclose(log.channels[1].values[:], 9.80665 * Y, rtol=1e-5)


def test_a_clock_that_is_none_is_replaced_by_the_column_map():
    """A moment that cannot be read is refused with the step that helps."""
    text = (Path(__file__).parent / "layouts" / "labview.lvm").read_text(encoding="utf-8")
    lines = text.replace("2026/01/05", "2026/01/05\nTime\t24:00:00").splitlines()
    with pytest.raises(Unusable, match="or set recorded_at by a column map"):
        stated_dialect(lines, ColumnMap())
    moment = {"recorded_at": "2026-01-06T00:00:00+00:00"}
    assert stated_dialect(lines, ColumnMap(metadata=moment)) is not None


@pytest.mark.parametrize("stats", ["", "##stats errors=0\n"])
def test_klipper(tmp_path, stats):
    """Klipper writes mm/s² below a line of names that begins as a remark."""
    rows = [f"{k / 1000:.6f},{X[k]:.6f},{Y[k]:.6f},9810.0" for k in range(400)]
    (tmp_path / "log.csv").write_text(stats + "\n".join(["#time,accel_x,accel_y,accel_z", *rows]))
    log = read_log(tmp_path / "log.csv")
    assert log.sample_rate == 1000 and len(log.channels) == 2  # the third is flat
    np.testing.assert_allclose(log.channels[0].values[:], 1e-3 * X, atol=1e-12)


DIALECTS = itertools.product(
    (",", ";", "\t", "|", " ", " : "), (".", ","), ("utf-8", "utf-8-sig", "cp1252", "utf-16"),
    ("", "# stage: A\n", "Export 3.1\nAxis 7\n\n"), (False, True),
)  # fmt: skip


@pytest.mark.parametrize(
    ("delimiter", "decimal", "encoding", "before", "units"),
    [one for one in DIALECTS if one[0] != one[1] and not (one[0] == " " and one[4])][::3],
)
def test_dialects(tmp_path, delimiter, decimal, encoding, before, units):
    """Marks, encodings, preambles and units of every combination are read right."""
    d = delimiter
    names = d.join(["Time", "Pos", "acc"] if units else ["time_s", "delta_e_µm", "acc_x_g"])
    names += "\n" + d.join(["s", "µm", "m/s²"]) if units else ""
    rows = [d.join([number(k / 1000, decimal), number(X[k], decimal), number(Y[k], decimal)])
            for k in range(400)]  # fmt: skip
    (tmp_path / "log.txt").write_text(before + "\n".join([names, *rows, ""]), encoding=encoding)
    log = read_log(tmp_path / "log.txt")
    assert (decimal == ",") == ("decimal commas" in log.guessed)
    factor = 1.0 if units else 9.80665
    assert log.sample_rate == 1000
    np.testing.assert_allclose(log.channels[-1].values[:], factor * Y, atol=1e-12)
    if not units:
        np.testing.assert_allclose(log.channels[0].values[:], 1e-6 * X, atol=1e-15)


@pytest.mark.parametrize("text", ["a;b\n1,234;2,345\n3,456;5,678\n", "a;b\n1.234,5;2\n1,5;3\n"])
def test_marks_between_thousands_are_refused(tmp_path, text):
    """A text with two readings is refused, with the number that has two."""
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(BadLog, match="between thousands"):
        read_log(tmp_path / "log.csv", columns=ColumnMap(columns={"delta_e_um": "a"}))


@pytest.mark.parametrize(
    "pattern", ["{}", "2026-01-05 08:00:{:06.3f}", "2026-01-05T08:00:{:06.3f}Z"]
)
def test_moments(tmp_path, pattern):
    """Times of day, and ticks of 100 ns since 1601, are read as seconds since the first."""
    stamps = [
        133_481_088_000_000_000 + 10_000 * k if pattern == "{}" else k / 1000 for k in range(400)
    ]
    rows = [f"{pattern.format(stamps[k])},{X[k]:.6f}" for k in range(400)]
    (tmp_path / "log.csv").write_text("\n".join(["time_s,acc_x_m_s2", *rows, ""]))
    assert read_log(tmp_path / "log.csv").sample_rate == pytest.approx(1000, rel=1e-6)
