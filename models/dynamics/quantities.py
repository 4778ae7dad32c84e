"""Numbers of a stage with their unit and source."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from models.errors import BadParameter

SOURCES = ("paper", "catalogue", "calibrated", "our choice", "drawn")


@dataclass(frozen=True, slots=True)
class Number:
    """A value (SI) with its unit and where it comes from."""

    value: float
    unit: str
    source: str


@dataclass(frozen=True, slots=True)
class Point:
    """A point or three lengths (m) with where they come from."""

    value: tuple[float, float, float]
    unit: str
    source: str


def refuse_unstated(owner: Any) -> None:
    """Raise if a number of a dataclass has no source, or no value that is possible.

    Raises
    ------
    BadParameter
        With the name of the field: a source that is not in `SOURCES`, a value that is not finite,
        a mass or stiffness that is not positive.
    """
    for field in fields(owner):
        entry = getattr(owner, field.name)
        if not isinstance(entry, Number | Point):
            continue
        if entry.source not in SOURCES:
            raise BadParameter(f"source of {field.name}", entry.source, ", ".join(SOURCES))
        if not np.all(np.isfinite(entry.value)):
            raise BadParameter(field.name, f"{entry.value} {entry.unit}", "finite numbers")
        positive = entry.unit in ("kg", "N/m", "N m²")
        if positive and not np.all(np.asarray(entry.value) > 0.0):
            raise BadParameter(field.name, f"{entry.value} {entry.unit}", "a positive number")
