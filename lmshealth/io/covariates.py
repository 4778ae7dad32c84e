"""Covariates that logs may have: those of the package, and those of installed packages."""

import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from lmshealth._private.plug_ins import load_plug_ins
from lmshealth.io import constants

GROUP = "lmshealth.covariates"
"""Group of entry points: each names a tuple of key, least and largest value."""

Key = tuple[str, float, float]

SHIPPED = ("temperature_c", "payload_kg", "position_mm")
OTHER_KEYS = (
    *("stage", "recorded_at", "travel_km", "sample_rate_hz"),
    *("servo_id", "baseline", "description", "velocity_mm_s"),
)
"""Keys of metadata that are no covariate."""


@cache
def covariates() -> Mapping[str, tuple[float, float]]:
    """Return the range of each covariate by its key, which ends with its unit.

    They are found on first use: a package that offers one may import this one.
    """
    shipped = [(key, *constants.RANGES[key]) for key in SHIPPED]
    return {
        key: (low, high) for key, low, high in load_plug_ins(GROUP, "covariate", shipped, _checked)
    }


@cache
def metadata_keys() -> tuple[str, ...]:
    """Return the keys of the metadata of a log."""
    first = OTHER_KEYS.index("servo_id")
    return (*OTHER_KEYS[:first], *covariates(), *OTHER_KEYS[first:])


def _checked(given: Any, others: Sequence[Key]) -> Key:
    """Return a covariate of another package; `TypeError` or `ValueError` if it is none."""
    if not isinstance(given, tuple) or len(given) != 3:
        raise TypeError(f"it is {given!r}, needed a tuple of key, least and largest value")
    key, low, high = given[0], float(given[1]), float(given[2])
    if not (isinstance(key, str) and re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)+", key)):
        raise ValueError(f"its key is {key!r}, needed small letters with a unit: humidity_percent")
    if key in (*OTHER_KEYS, *(own for own, *_ in others)):
        raise ValueError(f"its key {key!r} is known already; needed another")
    most = constants.LARGEST_NUMBER
    if not -most <= low < high <= most:
        raise ValueError(f"its range is {low:g} to {high:g}, needed ascending finite numbers")
    return key, low, high
