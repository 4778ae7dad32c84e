"""Metadata are typed with key and value in every error."""

import pytest

from lmshealth.io.metadata import parse_metadata
from lmshealth.io.refusal import Unusable


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
        ("travel_km", "-1"),
        ("travel_km", "1e306"),
        ("travel_km", "12,5"),
        ("temperature_c", "nan"),
        ("payload_kg", "1_0"),
        ("sample_rate_hz", "0"),
        ("sample_rate_hz", "inf"),
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
