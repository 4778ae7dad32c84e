"""SEP005 dictionaries in and out."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.reading import read_log, read_sep005

X = np.random.default_rng(3).normal(0, 1, (2, 500))
CHANNEL = {"data": X[0], "name": "feed", "unit_str": "m/s²", "fs": 1000.0}


def test_a_log_comes_back(make):
    """Samples, units, rate and start of a file survive both ways; the digest is of the content."""
    log = read_log(make())
    channels = log.to_sep005()
    assert {one["unit_str"] for one in channels} == {"m", "m/s²"}
    assert all(datetime.fromisoformat(one["start_timestamp"]) for one in channels)
    again = read_sep005(channels)
    assert again.sample_rate == log.sample_rate
    assert again.metadata.recorded_at == log.metadata.recorded_at
    assert [(c.name, c.kind) for c in again.channels] == [(c.name, c.kind) for c in log.channels]
    for one, other in zip(log.channels, again.channels, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
    assert read_sep005(channels).digest == again.digest
    channels[0]["data"][0] += 1
    assert read_sep005(channels).digest != again.digest


@pytest.mark.parametrize(("unit", "scale"), [("g", 9.80665), ("mm/s^2", 1e-3), ("m/s^2", 1.0)])
def test_units_and_times_of_others(unit, scale):
    """Accelerations are read in the unit that is stated, at the rate of their times."""
    time = 5 + np.arange(500) / 250
    other = {"data": X[1], "name": "pitch", "unit_str": unit, "time": time,
             "start_timestamp": "2026-01-05 08:00:00"}  # fmt: skip
    log = read_sep005([other, {"data": X[0], "name": "T", "unit_str": "°C", "fs": 1.0}])
    assert [c.name for c in log.channels] == ["acc_pitch"]
    assert log.sample_rate == pytest.approx(250)
    assert log.metadata.recorded_at.isoformat() == "2026-01-05T08:00:00+00:00"
    np.testing.assert_allclose(log.channels[0].values, scale * X[1])
    mapped = ColumnMap(columns={"delta_e_um": "T"})
    log = read_sep005([{**CHANNEL, "name": "T", "unit_str": "µm"}], columns=mapped)
    np.testing.assert_allclose(log.channels[0].values, 1e-6 * X[0])


def test_another_rate_is_refused_by_name():
    """A channel of another rate does not join the others."""
    slow = {**CHANNEL, "name": "slow", "fs": 10.0}
    log = read_sep005([CHANNEL, {**CHANNEL, "name": "b", "data": X[1]}, slow])
    assert [one.channel for one in log.refused] == ["acc_slow_m_s2"]


def without(key):
    """Leave out a key."""
    return {name: value for name, value in CHANNEL.items() if name != key}


@pytest.mark.parametrize(
    ("channel", "why"),
    [
        *((without(key), f"no '{key}'") for key in ("data", "name", "unit_str")),
        (without("fs"), "fs is None"),
        (CHANNEL | {"fs": -1}, "fs is -1"),
        (CHANNEL | {"fs": "fast"}, "could not convert"),
        (CHANNEL | {"data": [1.0, 2.0]}, "no array"),
        (CHANNEL | {"data": X}, "one dimension"),
        (CHANNEL | {"data": np.array(["a"])}, "no array"),
        (CHANNEL | {"name": 7}, "must be text"),
        (CHANNEL | {"time": np.arange(3.0)}, "time has 3 values"),
        (CHANNEL | {"start_timestamp": "yesterday"}, "isoformat"),
        ("feed", "needed a dictionary"),
    ],
)
def test_what_is_no_sep005(channel, why):
    """Anything else is refused with the channel and what is wrong with it."""
    with pytest.raises(BadLog, match=f"channel 1 is no SEP005: .*{why}|channel 1.*{why}"):
        read_sep005([CHANNEL, channel])


def test_channels_that_contradict_each_other():
    """Another start and two columns of times are refused, and a gap on the way out."""
    other = {**CHANNEL, "name": "b", "data": X[1]}
    stamps = [{"start_timestamp": f"2026-01-0{day} 08:00:00"} for day in (1, 2)]
    (refusal,) = read_sep005([CHANNEL | stamps[0], other | stamps[1]]).refused
    assert refusal.reason == "time" and "starts at 86400 s, the others at 0 s" in refusal.detail
    times = [{"time": np.arange(500) / rate} for rate in (1000, 999.0)]
    with pytest.raises(BadLog, match="different times"):
        read_sep005([CHANNEL | times[0], other | times[1]])
    log = read_sep005([CHANNEL, other])
    with pytest.raises(BadLog, match="interrupted"):
        replace(log, pieces=((0, 200), (200, 500))).to_sep005()
