"""Text of instruments and loggers, written by hand to their layouts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lmshealth._private.toml import decode
from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.log import Log
from lmshealth.io.reading import read_log
from lmshealth.stage.proposal import propose

N, RATE = 300, 500.0
TIME = np.arange(N) / RATE
A, B = np.random.default_rng(1).normal(0, 1, (2, N)).round(4)
START = 1767600000  # 2026-01-05 08:00 UTC


def write(path: Path, head: str, rows: str, **kwargs: object) -> Path:
    """Write a head and rows of a format string with time, values and number of the row."""
    lines = [rows.format(t=t, a=a, b=b, k=k) for k, (t, a, b) in
             enumerate(zip(TIME.tolist(), A.tolist(), B.tolist(), strict=True))]  # fmt: skip
    path.write_text(head + "\n" + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def by_init(path: Path) -> Log:
    """Read a log by the column map that is proposed for it."""
    text, _ = propose(path)
    return read_log(path, columns=decode(text.encode(), ColumnMap))


HIOKI = (
    '"COMMENT","MEM DATA"\n"NUM_SIGS",3\n"INTERVAL",2.000E-03\n"HORZ_UNITS","S"\n'
    '"VERT_UNITS","S","m/s²","g"\n"SIGNAL","TIME","ACH1","ACH2"\n"DATA"'
)
TEKTRONIX = (
    "Model,MDO3014\n\nHorizontal Units,S,,\nSample Interval,0.002,,\nVertical Units,V,V,\n,,,\n"
    "Label,,,\nTIME,CH1,CH2"
)
CATMAN = (
    "Kanalname\tZeit 1\tAcc 1\tAcc 2\nKanalnummer\t1\t2\t3\nT0\t05.01.2026\t05.01.2026\t05.01.2026"
    "\nEinheit\ts\tm/s²\tg"
)
PULSE = "Header Size:\t4\nDate:\t05-01-2026 08:00:00\nX-Axis size:\t300\nAmplitudeUnit:\tm/s^2\n\n"


@pytest.mark.parametrize(
    ("head", "rows", "scales"),
    [
        (HIOKI, "{t:+.4E}, {a:+.4E}, {b:+.4E}", (1.0, 9.80665)),
        (TEKTRONIX, "{t:.5e},{a:.4f},{b:.4f}", (1.0, 1.0)),
        (CATMAN, "\t{t:.4f}\t{a:.4f}\t{b:.4f}", (1.0, 9.80665)),
        (PULSE, "{k}\t{t:.6E}\t{a:.4E}", (1.0,)),
        ("x-axis,1,2,3,4\nsecond,Volt,Volt,Volt,Volt", "{t:.4f},{a},{b},0,0", (1.0, 1.0)),
        ("X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,-1.0e-1,2.0e-03", "{k},{a},{b},", (1, 1)),
    ],
)
def test_layouts_of_instruments(
    tmp_path: Path, head: str, rows: str, scales: tuple[float, ...]
) -> None:
    """Names, units and rate are found below, above and beside lines of keys and values."""
    log = by_init(write(tmp_path / "a.txt", head, rows))
    assert log.sample_rate == pytest.approx(RATE, rel=1e-6)
    read = [channel.values[:] for channel in log.channels]
    for values, scale, held in zip(read, scales, (A, B), strict=False):
        np.testing.assert_allclose(values, scale * held, rtol=1e-4, atol=1e-4 * scale)
    assert len(read) == len(scales)


@pytest.mark.parametrize(("head", "unit"), [("millis,ax_g", 1e3), ("x\nmicros,ax_g", 1e6)])
def test_counters_of_loggers(tmp_path: Path, head: str, unit: float) -> None:
    """The names of the columns hold the units of time and acceleration."""
    lines = [f"{5e3 + unit * t:.0f},{a}" for t, a in zip(TIME.tolist(), A, strict=True)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([head, *lines, ""]))
    log = by_init(path)
    assert log.sample_rate == pytest.approx(RATE, rel=1e-6)
    np.testing.assert_allclose(log.channels[0].values[:], 9.80665 * A)


@pytest.mark.parametrize(
    ("name", "stamp"),
    [
        ("time_ms", lambda t: f"{1e3 * (START + t):.0f}"),
        ("time_us", lambda t: f"{1e6 * (START + t):.0f}"),
        ("time_s", lambda t: f"{1e3 * (START + t):.0f}"),
        ("time_s", lambda t: f"{START + t:.6f}"),
        ("time_ms", lambda t: f"{(START + 11644473600) * 10**7 + round(1e7 * t)}"),
        ("time_us", lambda t: f"{START * 10**9 + round(1e9 * t)}"),
        ("time_ms", lambda t: f"2026-01-05T08:00:{t:09.6f}Z"),
        ("time_s", lambda t: f"{46027 + 1 / 3 + t / 86400:.10f}"),
        ("time_us", lambda t: f"{1.2e12 + 1e6 * t:.0f}"),
        ("time_s", lambda t: f"{46027.25 + t:.4f}"),
    ],
)
def test_times_since_an_epoch_in_a_column_of_any_unit(
    tmp_path: Path, name: str, stamp: object
) -> None:
    """Ticks and days are recognised whatever unit the column has; large counts stay in theirs."""
    lines = [f"{stamp(t)},{a}" for t, a in zip(TIME.tolist(), A, strict=True)]  # type: ignore[operator]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([f"{name},acc_x_g", *lines, ""]))
    log = read_log(path)
    assert log.sample_rate == pytest.approx(RATE, rel=1e-4)
    moment = log.metadata.recorded_at
    assert moment is None or abs(moment.timestamp() - START) < 1e-3


@pytest.mark.parametrize(
    ("name", "ticks", "epoch", "found"),
    [
        ("time_us", 1e3, 0, "500000 Hz, or 500 Hz as times in ms since"),
        ("time_ns", 1e3, 0, r"5e\+08 Hz, or 500 Hz as times in ms since"),
        ("time_ns", 1e6, 0, "500000 Hz, or 500 Hz as times in µs since"),
        ("time_ns", 1e7, 11644473600, "50000 Hz, or 500 Hz as times in 100 ns since"),
    ],
)
def test_ticks_in_a_column_of_a_finer_unit_are_not_guessed(
    tmp_path: Path, name: str, ticks: float, epoch: int, found: str
) -> None:
    """Both rates are quoted; a map or the sample rate decides, and a slow count is in its unit."""
    path = tmp_path / "a.csv"

    def written(scale: float, head: str = "") -> Path:
        start = round((START + epoch) * ticks)
        rows = [f"{start + round(scale * t)},{a}" for t, a in zip(TIME.tolist(), A, strict=True)]
        path.write_text(f"{head}{name},acc_x_g\n" + "\n".join([*rows, ""]))
        return path

    with pytest.raises(BadLog, match=f"{name} gives {found} an epoch; map it to time_s"):
        read_log(written(ticks))
    log = read_log(path, columns=ColumnMap(columns={"time_s": name}))
    moment = log.metadata.recorded_at
    assert log.sample_rate == pytest.approx(RATE, rel=1e-4)
    assert moment is not None and abs(moment.timestamp() - START) < 1e-3
    unit = {"time_us": 1e6, "time_ns": 1e9}[name]
    log = read_log(written(ticks, f"# sample_rate_hz: {RATE * unit / ticks}\n"))
    assert log.sample_rate == RATE * unit / ticks and log.metadata.recorded_at is None
    log = read_log(written(unit))
    assert log.sample_rate == pytest.approx(RATE, rel=1e-4) and log.metadata.recorded_at is None


def test_more_names_than_fields_are_refused(tmp_path: Path) -> None:
    """A field of the names that the rows lack shifts all others: none is read by a wrong name."""
    path = tmp_path / "a.csv"
    rows = [f"{a},{b}" for a, b in zip(A, B, strict=True)]
    path.write_text("\n".join(["# sample_rate_hz: 500", "axis,acc_x_g,acc_y_g", *rows, ""]))
    with pytest.raises(BadLog, match=r"row 1 has 2 fields, the line of names 3.*\[csv\]"):
        read_log(path)


def test_a_header_of_diadem_is_refused(tmp_path: Path) -> None:
    """The numbers are in another file."""
    path = tmp_path / "a.dat"
    path.write_text("DIAEXTENDED  {@:ENGLISH\n#BEGINCHANNELHEADER\n200,Zeit\n202,s\n")
    with pytest.raises(BadLog, match=r"DIAdem.*export"):
        read_log(path)
