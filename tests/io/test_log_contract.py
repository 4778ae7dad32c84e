"""The contract: what is needed, what is refused, what goes on."""

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.reading import read_log


def fails(path, reason, words):
    """Expect a refusal of the whole log."""
    with pytest.raises(BadLog, match=words) as caught:
        read_log(path)
    assert caught.value.reason == reason


def test_missing_signal(make):
    """A log without Δe and acceleration says what is there and what is needed."""
    path = make(columns={"delta_e_um": None, "acc_feed_m_s2": None, "current_a": np.arange(400.0)})
    fails(path, "columns", "no signal: needed delta_e_um.*there: time_s")


def test_missing_rate(make):
    """A log without time and sample rate says that one of them is needed."""
    fails(make(columns={"time_s": None}, meta={"sample_rate_hz": None}), "time", "needed one")
    assert read_log(make(columns={"time_s": None})).sample_rate == 2000.0


def test_unknown_unit(make):
    """An unknown unit is an error for a signal and of no interest elsewhere."""
    fails(make(columns={"acc_x_furlong": np.zeros(400)}), "unit", "acc_x_furlong.*there: time_s")
    read_log(make(columns={"weather_furlong": np.zeros(400)}))


def test_one_signal_in_two_units(make):
    """The same signal in two units is ambiguous."""
    fails(make(columns={"delta_e_nm": np.arange(400.0)}), "columns", "more than one unit")


def test_lengths(make):
    """Columns of different lengths are named with their lengths."""
    fails(make("log.h5", {"delta_e_um": np.arange(300.0)}), "columns", "delta_e 300")


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (np.zeros(400), "flat"),
        (np.clip(np.random.default_rng(0).normal(size=400), -1, 1).repeat(1), "clipped"),
        (np.where(np.arange(400) < 50, np.nan, np.arange(400.0)), "missing-samples"),
    ],
)
def test_bad_channel_is_refused_alone(make, values, reason):
    """A bad channel is refused with its reason, the others go on over the whole record."""
    log = read_log(make(columns={"acc_bad_m_s2": values}))
    assert [(r.channel, r.reason) for r in log.refused] == [("acc_bad", reason)]
    assert {c.name for c in log.channels} == {"delta_e", "acc_feed"} and log.pieces == ((0, 400),)


def test_no_channel_left(make):
    """A log whose channels are all refused is refused with all reasons."""
    path = make(columns={"delta_e_um": np.zeros(400), "acc_feed_m_s2": np.ones(400)})
    fails(path, "no-signal", "delta_e: flat.*acc_feed: flat")


@pytest.mark.parametrize("file", ["log.csv", "log.parquet", "log.h5"])
def test_short_gaps_split(make, file):
    """Missing samples of any channel split the record, with counts, and stay NaN."""
    values = np.random.default_rng(1).normal(size=400)
    values[[100, 101]] = np.nan
    log = read_log(make(file, {"acc_feed_m_s2": values}))
    assert log.pieces == ((0, 100), (102, 400))
    assert [(r.channel, r.reason) for r in log.refused] == [("acc_feed", "gaps")]
    assert "2 of 400" in log.refused[0].detail
    channel = next(c for c in log.channels if c.name == "acc_feed")
    assert np.isnan(channel.values).sum() == 2


def test_dropped_samples(make):
    """Gaps in time are named with counts and split the record."""
    time = np.arange(400) / 2000
    time[250:] += 5 / 2000
    log = read_log(make(columns={"time_s": time}))
    assert log.pieces == ((0, 250), (250, 400)) and "5 dropped" in log.refused[0].detail


def test_velocity_from_position(make):
    """A set point given as position is differentiated, never across a gap."""
    time = np.arange(400) / 2000
    time[250:] += 5 / 2000
    columns = {
        "reference_velocity_mm_s": None,
        "reference_position_mm": 50 * time,
        "time_s": time,
    }
    np.testing.assert_allclose(read_log(make(columns=columns)).reference_velocity, 0.05)


def test_useless_set_point(make):
    """A set point that is mostly missing is refused, and cuts nothing."""
    log = read_log(make(columns={"reference_velocity_mm_s": np.full(400, np.nan)}))
    assert log.reference_velocity is None and log.pieces == ((0, 400),)
    assert log.refused[0].channel == "reference_velocity"


@pytest.mark.parametrize("n", [0, 1])
def test_too_few_samples(make, n):
    """Fewer than two samples are no recording."""
    fails(make("log.h5", n=n), "empty", "at least 2")


def test_arrays_are_read_only(make):
    """A log cannot be changed by who reads it."""
    with pytest.raises(ValueError, match="read-only"):
        read_log(make()).channels[0].values[0] = 1.0
