"""Moments and ticks in columns of times: converted to times since the first."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from lmshealth._private.arrays import FloatArray
from lmshealth.io import constants
from lmshealth.io.buffers import Samples, Spool, blocks
from lmshealth.io.column_map import ColumnMap, role_of
from lmshealth.io.formats.content import Content
from lmshealth.io.metadata import moment_after
from lmshealth.io.refusal import Unusable

# End of the note of what was taken for what.
SINCE_EPOCH = "since an epoch"
# Least magnitude of time stamps that count ticks since an epoch, ticks of a second, and that epoch
# as Unix time in s; the last time in s, of the year 2286, that is read in the unit of its column;
# and Unix times from 2001 to 2039 (those of LabVIEW, since 1904, are later).
_TICKS = (
    *((1e18, 1e9, "ns", 0), (1e16, 1e7, "100 ns", -11644473600)),
    *((1e15, 1e6, "µs", 0), (1e12, 1e3, "ms", 0)),
)
_LATEST, _UNIX_TIMES = 1e10, (1e9, 2.2e9)
# Days since 1900 from 1954 to 2173, which spreadsheets write, and their largest step: in s it would
# be a sample rate of 1 MHz.
_DAYS, _DAY_STEP = (2e4, 1e5), 1e-6


class SinceFirst:
    """Conversion of the moments of a column to times since the first, block by block.

    ``unit`` is that of the column in s, ``first`` the earliest moment of the first block.
    """

    def __init__(self, unit: float) -> None:
        self._unit = unit
        self.first: np.datetime64 | None = None

    def __call__(self, moments: np.ndarray) -> FloatArray:
        """Return the times of moments, ``(n,)`` each, NaN where there is none."""
        moments = moments.astype("datetime64[ns]")
        there = moments[~np.isnat(moments)]
        if self.first is None and there.size:
            self.first = there.min()
        if self.first is None:
            return np.full(moments.shape, np.nan)
        return (moments - self.first) / np.timedelta64(1, "ns") * (1e-9 / self._unit)


def parse_moments(text: Any) -> np.ndarray:
    """Read a series of text as moments, ``(n,)``; what is none is no time."""
    import pandas as pd

    day_first = bool(text.astype(str).str.match(r"\d{1,2}\.").any())
    text = text.astype(str).str.replace(",", ".") if text.dtype == object else text
    found = pd.to_datetime(text, errors="coerce", utc=True, dayfirst=day_first, format="mixed")
    moments: np.ndarray = found.dt.tz_localize(None).to_numpy("datetime64[ns]")
    return moments


def without_epoch(content: Content, columns: ColumnMap) -> Content:
    """Convert ticks or days since an epoch in columns of times to times since the first.

    Other times stay as they are.
    """
    for name, samples in content.columns.items():
        target = columns.target(name) or ""
        if role_of(target) == "time" and samples.size:
            with suppress(Unusable):  # a unit that is not stated is refused with the others
                unit = columns.signal(target).factor
                content.columns[name], guessed, moment = _since_first(samples, unit)
                metadata, guessed = moment | content.metadata, (*content.guessed, *guessed)
                content = replace(content, metadata=metadata, guessed=guessed)
    return content


def _since_first(time: Samples, unit: float) -> tuple[Samples, tuple[str, ...], dict[str, str]]:
    """Convert ticks or days since an epoch to times since the first, in a unit in s.

    Other times stay as they are. Return what was taken for what, and the moment of the first ticks.
    """
    first = next((block for _, block in blocks(time)), np.zeros(1))
    start, step = float(first[0]), float(np.ptp(first)) / max(first.size - 1, 1)
    ticks = (one[1:] for one in _TICKS if abs(start) >= one[0] and abs(start) * unit > _LATEST)
    if _DAYS[0] <= start < _DAYS[1] and step < _DAY_STEP:
        scale, what, epoch = 1 / 86400, "days", None
    elif _UNIX_TIMES[0] <= start * unit < _UNIX_TIMES[1]:
        scale, what, epoch = 1 / unit, "", 0
    else:
        scale, what, epoch = next(ticks, (0.0, "", None))
    if not scale:
        return time, (), {}
    spool = Spool()
    for _, block in blocks(time):
        spool.append((block - start) / (scale * unit))
    guessed = (f"times in {what} {SINCE_EPOCH}",) if what else ()
    if epoch is None:
        return spool.samples(), guessed, {}
    moment = moment_after(constants.FIRST_MOMENT, start / scale + epoch)
    return spool.samples(), guessed, {"recorded_at": moment}
