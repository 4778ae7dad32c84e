"""Metadata of a log: text of the file, the column map and the manifest, converted and checked."""

import math
import re
import unicodedata
from collections.abc import Mapping
from datetime import UTC, date, datetime, timedelta

import numpy as np

from lmshealth.io import constants
from lmshealth.io.covariates import covariates, metadata_keys
from lmshealth.io.log import MOMENTS, Metadata, expect_moment, expect_possible, possible
from lmshealth.io.refusal import Unusable

# Characters that no name has, as a class of regular expressions: control and bidirectional ones,
# and those that nobody sees (soft hyphens, fillers, byte order marks, tags, selectors of variants).
INVISIBLE = (
    "\x00-\x1f\x7f-\x9f\xad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f\u200b-\u200f"
    "\u2028-\u202e\u2060-\u206f\u3164\ufe00-\ufe0f\ufeff\uffa0\ufff0-\ufffb\ufffe\uffff"
    "\U000e0000-\U000e0fff\U000f0000-\U0010ffff"
)
_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


def parse_metadata(
    text: Mapping[str, str], latest: datetime | None = None
) -> tuple[Metadata, float | None]:
    """Convert the metadata of a log; unknown keys and empty values are ignored.

    The sample rate in Hz is returned beside the rest. `Unusable` (``metadata``, or ``future`` for a
    moment after `latest`, see `parse_moment`) names key and value.
    """
    given = {key: text[key].strip() for key in metadata_keys() if text.get(key, "").strip()}
    travel, velocity = _number(given, "travel_km"), _number(given, "velocity_mm_s")
    if (flag := given.get("baseline", "").lower()) and flag not in _BOOLEANS:
        raise _bad(given, "baseline", "true or false")
    return Metadata(
        stage=parse_name(given, "stage"),
        recorded_at=parse_moment(given, latest),
        travel=None if travel is None else 1e3 * travel,
        covariates={
            key: value for key in covariates() if (value := _number(given, key)) is not None
        },
        servo_id=parse_name(given, "servo_id"),
        baseline=_BOOLEANS.get(flag),
        description=parse_name(given, "description"),
        velocity=None if velocity is None else 1e-3 * velocity,
    ), _number(given, "sample_rate_hz")


def _bad(given: Mapping[str, str], key: str, needed: str) -> Unusable:
    return Unusable("metadata", f"{key} is {given[key][:80]!a}, needed {needed}")


def parse_name(given: Mapping[str, str], key: str) -> str | None:
    """Read a name; None where there is none. Very long ones are refused, and invisible characters.

    Names are normalised (NFC): systems differ in how they write an accented letter, and one
    machine must not become two.
    """
    name = given.get(key)
    if not name:
        return None
    is_odd = not name.isprintable() or re.search(f"[{INVISIBLE}]", name)
    if is_odd or len(name) > constants.LONGEST_NAME:
        raise _bad(given, key, f"printable text of at most {constants.LONGEST_NAME} characters")
    return unicodedata.normalize("NFC", name)


def parse_moment(given: Mapping[str, str], latest: datetime | None = None) -> datetime | None:
    """Read ``recorded_at``; None where it is not given.

    `Unusable`: ``metadata`` without date or time zone, or out of the range of `constants`;
    ``future`` for one after `latest`, by default a day from now.
    """
    if not given.get("recorded_at"):
        return None
    try:
        moment = datetime.fromisoformat(given["recorded_at"])
        expect_moment(moment)
    except ValueError as error:
        needed = f"ISO 8601 with a time zone, {MOMENTS}, such as 2026-03-01T08:30:00+01:00"
        raise _bad(given, "recorded_at", needed) from error
    if is_future(moment, latest):
        what = f"recorded_at is {given['recorded_at'][:80]!a}, in the future"
        raise Unusable("future", f"{what}; correct it, or set --allow-future")
    return moment


def is_future(moment: datetime | None, latest: datetime | None = None) -> bool:
    """Return whether a log of a moment was recorded after `latest`, by default a day from now."""
    now = max(datetime.now(UTC), constants.MADE)
    return moment is not None and moment > (latest or now + constants.FUTURE)


def _number(given: Mapping[str, str], key: str) -> float | None:
    """Read a number in the range of its key; None where it is not given."""
    if key not in given:
        return None
    try:
        # Python reads 1_000 as a number; no exporter means that.
        value = math.nan if "_" in given[key] else float(given[key])
        expect_possible(key, value)
    except ValueError as error:
        raise _bad(given, key, possible(key)) from error
    return value


def moment_after(epoch: datetime, count: float, unit: timedelta = timedelta(seconds=1)) -> str:
    """Write a moment after an epoch; `parse_moment` refuses what is out of the calendar."""
    try:
        return (epoch + count * unit).isoformat()
    except OverflowError:
        return f"{count:g} times {unit.total_seconds():g} s after {epoch.date()}"


def as_text(value: object) -> str:
    """Write a value of a file or a column map as the text that `parse_metadata` reads."""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, np.datetime64):  # of TDMS, in UTC
        return f"{np.datetime_as_string(value, unit='us')}+00:00"
    return value.isoformat() if isinstance(value, date) else str(value)
