"""Layouts of delimited text that have a header of their own: TwinCAT, LabVIEW, PI, Klipper, Rigol.

A layout returns the `Dialect` that the first lines of a file state, or None for another file. The
layouts were taken from public readers and samples; see the README of `io`.
"""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

from lmshealth.io.formats.dialect import Dialect, fields_of
from lmshealth.io.formats.unit_channels import Described, rate_of
from lmshealth.io.metadata import moment_after
from lmshealth.io.refusal import corrupt

_GCS_LINE = re.compile(r"#\s*([A-Z_]+\d*)\s*=\s*(.*\S)\s*")
# Key of a moment without a time zone, which is no metadatum of a log.
LOCAL_TIME = "local_time"
_FILETIME_EPOCH = datetime(1601, 1, 1, tzinfo=UTC)


def twincat(lines: Sequence[str]) -> Dialect | None:
    """TwinCAT Scope: rows of keys, groups of channels, each with a column of times in ms."""
    delimiter = next((d for d in "\t;:, " if lines and lines[0].startswith(f"Name{d}")), None)
    at = {fields_of(line, delimiter or ",")[0]: k for k, line in enumerate(lines) if line.strip()}
    start = next((k for k, line in enumerate(lines) if line.startswith("Starttime of export")), 0)
    if delimiter is None or not start:
        return None
    below = {key: k for key, k in at.items() if k > start and key != "EOF"}
    keys = {key: fields_of(lines[k], delimiter) for key, k in below.items()}
    interval = keys.get("SampleTime[ms]", [])
    if "Name" not in keys or len(interval) != len(keys["Name"]):
        raise corrupt("a TwinCAT Scope export without Name and SampleTime[ms] of each channel")
    # Values are written as scaled; their unit is followed by its quantity: g (Acceleration).
    units = [unit.partition("(")[0] for unit in keys.get("Unit", [""] * len(interval))]
    channels = []
    for name, text, unit in zip(keys["Name"], interval, units, strict=False):
        rate = _number(text)
        if name == "Name":
            # The key column of a group holds its times; its rate is that of the next channel.
            channels.append(Described("time", "ms", None))
        elif name:
            own = None if rate is None else rate_of(rate / 1000)
            channels.append(Described(name, unit.strip(), own))
            if len(channels) > 1 and channels[-2].name == "time" and channels[-2].rate is None:
                channels[-2] = Described("time", "ms", own)
    first = max(keys_at for key, keys_at in at.items() if key in keys and _number(key) is None)
    while first + 1 < len(lines) and not lines[first + 1].strip():
        first += 1
    # The numbers of the first row may be whole.
    decimal = "," if delimiter != "," and any("," in row for row in lines[first + 1 :]) else "."
    ticks = fields_of(lines[start], delimiter)[1:2]
    counted = int(ticks[0]) if ticks else 0  # 0 states no moment
    moment = moment_after(_FILETIME_EPOCH, counted // 10, timedelta(microseconds=1))
    metadata = {"recorded_at": moment} if counted else {}
    return Dialect(delimiter, decimal, tuple(channels), first + 1, metadata)


def labview(lines: Sequence[str]) -> Dialect | None:
    """LabVIEW measurement file (.lvm); `csv` drops the headers of further segments."""
    if not lines or not lines[0].startswith("LabVIEW Measurement"):
        return None
    delimiter = "," if any(line.startswith("Separator,") for line in lines) else "\t"
    rows = [fields_of(line, delimiter) for line in lines]
    keys = {row[0]: row[1:] for row in rows if len(row) > 1}
    where = next((k for k, row in enumerate(rows) if row and row[0] == "X_Value"), None)
    if where is None:
        raise corrupt("a LabVIEW measurement without a line X_Value that names the columns")
    decimal = (keys.get("Decimal_Separator") or ["."])[0]
    names = [name for name in rows[where] if name]
    units, deltas, starts = (
        [*keys.get(key, []), *[""] * len(names)] for key in ("Y_Unit_Label", "Delta_X", "X0")
    )
    own_x = (keys.get("X_Columns") or ["One"])[0]
    channels = [Described("time", "s") if own_x == "One" else Described("X_Value", "")]
    for k, name in enumerate(names[1:]):
        # Of several columns of X values each stands before its channel.
        rate, start = rate_of(_number(deltas[k])), _number(starts[k]) or 0.0
        if own_x == "Multi" and channels[-1].name == "X_Value":
            channels[-1] = Described("time", "s", rate, start=start)
        channels.append(Described(name, units[k], rate, start=start))
    day, clock = (keys.get(key, [""])[0].replace("/", "-") for key in ("Date", "Time"))
    metadata = {LOCAL_TIME: f"{day} {clock.replace(',', '.')[:15]}"} if day and clock else {}
    return Dialect(delimiter, decimal, tuple(channels), where + 1, metadata)


def gcs_array(lines: Sequence[str]) -> Dialect | None:
    """PI GCS array: lines ``# KEY = value`` up to ``# END_HEADER``."""
    end = next((k for k, line in enumerate(lines) if line.strip() == "# END_HEADER"), None)
    if end is None:
        return None
    found = (_GCS_LINE.fullmatch(line.rstrip("\r\n")) for line in lines[:end])
    keys = {match[1]: match[2] for match in found if match}
    delimiter, n = chr(int(keys.get("SEPARATOR", "32"))), int(keys.get("DIM", "1"))
    interval = _number(keys.get("SAMPLE_TIME", ""))
    names = [keys.get(f"NAME{k}", str(k)) for k in range(n)]
    rate = rate_of(interval)
    return Dialect(delimiter, ".", tuple(Described(name, "", rate) for name in names), end + 1)


def klipper(lines: Sequence[str]) -> Dialect | None:
    """Klipper's accelerometer CSV: ``#time,accel_x,accel_y,accel_z`` in s and mm/s²."""
    where = next((k for k, line in enumerate(lines[:3]) if line.startswith("#time,accel_")), None)
    if where is None:
        return None
    names = lines[where].strip().split(",")[1:]
    channels = Described("time", "s"), *(Described(name, "mm/s²") for name in names)
    return Dialect(",", ".", tuple(channels), where + 1)


def rigol(lines: Sequence[str]) -> Dialect | None:
    """Rigol oscilloscope: names, then units with the interval, then rows with a number of each."""
    if len(lines) < 2 or not lines[0].startswith("X,") or ",Start,Increment" not in lines[0]:
        return None
    names, units = (fields_of(line, ",") for line in lines[:2])
    n = names.index("Start")
    rate = rate_of(_number(units[n + 1]))
    channels = (Described(*pair, rate) for pair in zip(names[1:n], units[1:n], strict=True))
    return Dialect(",", ".", (Described("X", ""), *channels), 2)


LAYOUTS = (twincat, labview, gcs_array, klipper, rigol)


def _number(text: str) -> float | None:
    """Read a number with a decimal point or comma; None for any other text."""
    try:
        return float(text.strip().replace(",", "."))
    except ValueError:
        return None
