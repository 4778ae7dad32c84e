"""Metadata of a log: typed once, at the door, with the key and the value named in every error."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Mapping
from datetime import UTC, datetime

from lmshealth.io.log import Metadata
from lmshealth.io.refusal import Unusable

COVARIATES = ("temperature_c", "payload_kg", "position_mm")
KEYS = (
    "stage",
    "recorded_at",
    "travel_km",
    "sample_rate_hz",
    *COVARIATES,
    "servo_id",
    "baseline",
    "description",
    "velocity_mm_s",
)

_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}
_LONGEST_NAME = 200
_METRES_PER_KM = 1e3
_METRES_PER_MM = 1e-3


def parse_metadata(text: Mapping[str, str]) -> tuple[Metadata, float | None]:
    """Type the metadata of a log; unknown keys and empty values are passed over.

    Parameters
    ----------
    text : mapping of str to str
        Keys of the log contract to what the file, the column map or the manifest say.

    Returns
    -------
    Metadata
        What is known beside the samples.
    float or None
        Sample rate in Hz.

    Raises
    ------
    Unusable
        With reason ``metadata``, naming key and value.
    """
    given = {key: text[key].strip() for key in KEYS if text.get(key, "").strip()}
    metadata = Metadata(
        stage=parse_name(given, "stage"),
        recorded_at=parse_moment(given),
        travel=_travel(given),
        covariates={key: _number(given, key) for key in COVARIATES if key in given},
        servo_id=parse_name(given, "servo_id"),
        baseline=_boolean(given),
        description=parse_name(given, "description"),
        velocity=_velocity(given),
    )
    return metadata, _sample_rate(given)


def _bad(given: Mapping[str, str], key: str, needed: str) -> Unusable:
    return Unusable("metadata", f"{key} is {given[key][:80]!r}, needed {needed}")


def parse_name(given: Mapping[str, str], key: str) -> str | None:
    """Read a name; None where there is none.

    The two ways to write an accented letter, by one sign or by two, are one name: systems differ
    in which of them they write, and a machine must not become two.

    Raises
    ------
    Unusable
        With reason ``metadata`` for a name with signs that cannot be seen, or a very long one.
    """
    if not given.get(key):
        return None
    if not given[key].isprintable() or len(given[key]) > _LONGEST_NAME:
        raise _bad(given, key, f"printable text of at most {_LONGEST_NAME} characters")
    return unicodedata.normalize("NFC", given[key])


def _number(given: Mapping[str, str], key: str) -> float:
    try:
        # Python reads 1_000 as a number; no exporter means that.
        value = math.nan if "_" in given[key] else float(given[key])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise _bad(given, key, "a finite number")
    return value


def parse_moment(given: Mapping[str, str]) -> datetime | None:
    """Read ``recorded_at``; None where it is not given.

    Raises
    ------
    Unusable
        With reason ``metadata`` if it is no moment with a time zone.
    """
    if not given.get("recorded_at"):
        return None
    needed = "ISO 8601 with a time zone, such as 2026-03-01T08:30:00+01:00"
    try:
        moment = datetime.fromisoformat(given["recorded_at"])
        if moment.tzinfo is None:
            raise _bad(given, "recorded_at", needed)
        moment.astimezone(UTC)
    except (ValueError, OverflowError) as error:
        raise _bad(given, "recorded_at", needed) from error
    return moment


def _travel(given: Mapping[str, str]) -> float | None:
    if "travel_km" not in given:
        return None
    travel = _number(given, "travel_km") * _METRES_PER_KM
    if not 0 <= travel < math.inf:
        raise _bad(given, "travel_km", "an odometer of 0 or more")
    return travel


def _velocity(given: Mapping[str, str]) -> float | None:
    if "velocity_mm_s" not in given:
        return None
    return _number(given, "velocity_mm_s") * _METRES_PER_MM


def _sample_rate(given: Mapping[str, str]) -> float | None:
    if "sample_rate_hz" not in given:
        return None
    rate = _number(given, "sample_rate_hz")
    # Outside this range 1 / rate or rate * samples leave the numbers that floats can hold.
    if not 1e-9 < rate < 1e12:
        raise _bad(given, "sample_rate_hz", "a positive number")
    return rate


def _boolean(given: Mapping[str, str]) -> bool | None:
    if "baseline" not in given:
        return None
    value = _BOOLEANS.get(given["baseline"].lower())
    if value is None:
        raise _bad(given, "baseline", "true or false")
    return value
