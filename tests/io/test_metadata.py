"""Metadata are typed with key and value in every error."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pandas as pd
import pytest

from lmshealth._private.serialize import fingerprint
from lmshealth.io import constants, log
from lmshealth.io.log import Metadata, moment_after, parse_metadata
from lmshealth.io.refusal import Unusable

MOMENT = datetime(2026, 3, 1, 8, 30, tzinfo=UTC)


def test_everything():
    """All keys are typed; unknown ones and empty values are passed over."""
    metadata, rate = parse_metadata(
        {
            "stage": " A ",
            "recorded_at": "2026-03-01T08:30:00Z",
            "travel_km": "1.5",
            "sample_rate_hz": "2e4",
            "temperature_c": "21",
            "payload_kg": "",
            "servo_id": "7",
            "baseline": "False",
            "description": "lms-y",
            "operator": "x",
        }
    )
    assert rate == 2e4 and metadata.stage == "A" and metadata.travel == 1500.0
    assert metadata.covariates == {"temperature_c": 21.0}
    assert metadata.baseline is False and metadata.servo_id == "7"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("recorded_at", "2026-03-01T08:30:00"),
        ("recorded_at", "yesterday"),
        ("recorded_at", "0001-01-01T00:00:00+14:00"),
        ("recorded_at", "1969-12-31T23:59:59Z"),
        ("recorded_at", "1970-01-01T00:30:00+01:00"),
        ("recorded_at", "9999-12-31T23:59:59-14:00"),
        ("recorded_at", "2100-01-01T00:00:00Z"),
        ("travel_km", "-1"),
        ("travel_km", "1e300"),
        ("travel_km", "1e11"),
        ("temperature_c", "1e300"),
        ("temperature_c", "-9999"),
        ("position_mm", "-1e9"),
        ("velocity_mm_s", "1e8"),
        ("travel_km", "1e306"),
        ("travel_km", "12,5"),
        ("temperature_c", "nan"),
        ("payload_kg", "1_0"),
        ("payload_kg", "1e7"),
        ("sample_rate_hz", "0"),
        ("sample_rate_hz", "inf"),
        ("sample_rate_hz", "1e-7"),
        ("sample_rate_hz", "1e12"),
        ("baseline", "maybe"),
        ("stage", "a\x1b[31m"),
        ("stage", "a\ufe0f"),
        ("stage", "a\u3164"),
        ("servo_id", "x" * 300),
    ],
)
def test_bad_values(key, value):
    """A value that cannot be is refused, naming the key."""
    with pytest.raises(Unusable, match=key) as caught:
        parse_metadata({key: value})
    assert caught.value.reason == "metadata"


@pytest.mark.parametrize(
    "given",
    [
        {"recorded_at": "1970-01-01T00:00:00Z", "travel_km": "0", "temperature_c": "-269"},
        {"travel_km": "1e10", "payload_kg": "-0.02", "position_mm": "-400", "velocity_mm_s": "-5"},
        {"sample_rate_hz": "0.1"},
        {"sample_rate_hz": "5e9"},
    ],
)
def test_unusual_values_are_no_faults(given):
    """Cryostats, tares, buildings and oscilloscopes are within the ranges."""
    parse_metadata(given)


def test_a_log_of_the_future_is_refused_by_its_date(monkeypatch):
    """A day from now is the limit; it can be given, and a clock that is too slow does not count."""
    given = {"recorded_at": MOMENT.isoformat()}
    assert parse_metadata(given, MOMENT)[0].recorded_at == MOMENT
    with pytest.raises(Unusable, match=r"2026-03-01T08:30:00.*--allow-future") as caught:
        parse_metadata(given, MOMENT - timedelta(seconds=1))
    assert caught.value.reason == "future"
    late = (constants.LAST_MOMENT - timedelta(seconds=1)).isoformat()
    parse_metadata({"recorded_at": late}, constants.LAST_MOMENT)
    with pytest.raises(Unusable, match=late[:10]):
        parse_metadata({"recorded_at": late})
    for year, last in ((1999, constants.MADE), (2080, datetime(2080, 1, 1, tzinfo=UTC))):
        monkeypatch.setattr(log, "datetime", type("Clock", (datetime,), {
            "now": classmethod(lambda cls, zone, year=year: datetime(year, 1, 1, tzinfo=zone)),
        }))  # fmt: skip
        assert not log.is_future(last + constants.FUTURE)
        assert log.is_future(last + constants.FUTURE + timedelta(seconds=1))


def test_moments_out_of_the_calendar_are_written_for_their_refusal():
    """A count since an epoch that is no date is quoted with its epoch."""
    assert moment_after(MOMENT, 90) == "2026-03-01T08:31:30+00:00"
    text = moment_after(constants.FIRST_MOMENT, 1e300)
    assert text == "1e+300 times 1 s after 1970-01-01"
    with pytest.raises(Unusable, match=r"recorded_at is '1e.300 times"):
        parse_metadata({"recorded_at": text})


def test_scalars_of_pandas_and_numpy_become_plain_or_are_refused():
    """A Timestamp is the datetime that it is: the same fingerprint, and plain arithmetic."""
    plain = Metadata("A", MOMENT, 5e3, {"temperature_c": 21.0}, baseline=True)
    same = Metadata(
        np.str_("A"), pd.Timestamp(MOMENT), np.float64(5e3), {"temperature_c": np.float64(21)},
        baseline=np.bool_(True),  # type: ignore[arg-type]
    )  # fmt: skip
    assert type(same.recorded_at) is datetime and same.recorded_at == MOMENT
    assert fingerprint(same) == fingerprint(plain)
    zoned = Metadata(recorded_at=pd.Timestamp(MOMENT).tz_convert("Europe/Berlin"))
    assert zoned.recorded_at is not None
    assert zoned.recorded_at.isoformat() == "2026-03-01T09:30:00+01:00"


@pytest.mark.parametrize(
    ("given", "needle"),
    [
        ({"recorded_at": pd.NaT}, "NaT"),
        ({"recorded_at": MOMENT.replace(tzinfo=None)}, "time zone"),
        ({"recorded_at": MOMENT.replace(year=1)}, "0001-03-01"),
        ({"recorded_at": MOMENT.replace(year=2150)}, "2150-03-01"),
        ({"recorded_at": np.datetime64("2026-03-01")}, "datetime64"),
        ({"travel": float("nan")}, "travel_km is nan"),
        ({"travel": 1e300}, "travel_km is 1e.297"),
        ({"velocity": float("inf")}, "velocity_mm_s is inf"),
        ({"covariates": {"temperature_c": 1e300}}, "temperature_c is 1e.300"),
        ({"covariates": {"own": 1e300}}, "own is 1e.300"),
    ],
)
def test_metadata_check_their_types_and_ranges(given, needle):
    """What no door lets in cannot be made in Python either."""
    with pytest.raises((ValueError, TypeError), match=needle):
        Metadata(**given)
