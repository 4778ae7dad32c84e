"""Column names of the log contract: quantity by prefix, unit by suffix, factor to SI."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from lmshealth.io.refusal import Unusable

Role = Literal[
    "displacement", "acceleration", "current", "reference_velocity", "reference_position", "time"
]

STANDARD_GRAVITY = 9.80665

_UNITS: dict[str, tuple[str, float]] = {
    "m": ("length", 1.0),
    "mm": ("length", 1e-3),
    "um": ("length", 1e-6),
    "nm": ("length", 1e-9),
    "m_s": ("velocity", 1.0),
    "mm_s": ("velocity", 1e-3),
    "m_s2": ("acceleration", 1.0),
    "mm_s2": ("acceleration", 1e-3),
    "g": ("acceleration", STANDARD_GRAVITY),
    "a": ("current", 1.0),
    "ma": ("current", 1e-3),
    "s": ("time", 1.0),
}
# `_m_s2` must be tried before `_s`, or an acceleration would be read as a time.
_LONGEST_FIRST = sorted(_UNITS, key=len, reverse=True)

# "Â" is left of a superscript or a micro sign that some exporter encoded twice.
_SPELLINGS = str.maketrans(
    {"/": "_", "^": None, "*": None, "µ": "u", "μ": "u", "²": "2", " ": None, "Â": None}
)
_ALIASES = {"A": "a", "mA": "ma", "gn": "g", "m_s_s": "m_s2", "m_sec2": "m_s2"}

_LONGEST_NAME = 200

_DIMENSIONS: dict[Role, str] = {
    "displacement": "length",
    "acceleration": "acceleration",
    "current": "current",
    "reference_velocity": "velocity",
    "reference_position": "length",
    "time": "time",
}
_PREFIXES: dict[str, Role] = {
    "delta_e": "displacement",
    "acc": "acceleration",
    "current": "current",
    "reference_velocity": "reference_velocity",
    "reference_position": "reference_position",
}


@dataclass(frozen=True, slots=True)
class Signal:
    """What a column holds.

    Attributes
    ----------
    name : str
        Column name without its unit.
    role : str
        Physical quantity, and whether it is measured or a set point.
    factor : float
        SI value of one in the column's unit.
    """

    name: str
    role: Role
    factor: float


def role_of(column: str) -> Role | None:
    """Tell the quantity of a column by its prefix; None where the contract knows no such column.

    ``time`` alone is no prefix: a column such as ``time_of_day`` is nobody's signal.
    """
    if column in ("time", "time_s"):
        return "time"
    for prefix, role in _PREFIXES.items():
        if column == prefix or column.startswith(prefix + "_"):
            return role
    return None


def unit_key(text: str) -> str | None:
    """Find the contract's word for a unit (``m/s²`` is ``m_s2``); None for an unknown unit."""
    word = text.strip().translate(_SPELLINGS)
    word = _ALIASES.get(word, word)
    return word if word in _UNITS else None


def acceleration_unit(text: str) -> str | None:
    """Find the contract's word for a unit of acceleration; None for any other unit."""
    word = unit_key(text)
    return word if word is not None and _UNITS[word][0] == "acceleration" else None


def parse_column(column: str, unit: str | float | None = None) -> Signal:
    """Read quantity, name and unit from a column name.

    Parameters
    ----------
    column : str
        A name for which `role_of` knows the quantity.
    unit : str or float, optional
        Unit of a column whose name carries none: a unit, or the SI value of one count.

    Raises
    ------
    Unusable
        With reason ``unit`` when the unit is missing, unknown or of another quantity; with reason
        ``columns`` when the contract knows no such column, or it has signs that cannot be seen.
    """
    role = role_of(column)
    if role is None:
        raise Unusable("columns", f"{column!r} is no column of the log contract")
    if not column.isprintable() or len(column) > _LONGEST_NAME:
        needed = f"printable text of at most {_LONGEST_NAME} characters"
        raise Unusable("columns", f"a column is called {column[:80]!r}, needed {needed}")
    suffix = next((unit for unit in _LONGEST_FIRST if column.endswith("_" + unit)), None)
    if unit is not None:
        return _with_unit(column, suffix, role, unit)
    if suffix is None or _UNITS[suffix][0] != _DIMENSIONS[role]:
        found = "no known unit" if suffix is None else f"the unit {suffix}"
        raise Unusable(
            "unit", f"column {column!r} carries {found}; needed one of {_choices(role)} as suffix"
        )
    return Signal(column.removesuffix("_" + suffix), role, _UNITS[suffix][1])


def _with_unit(column: str, suffix: str | None, role: Role, unit: str | float) -> Signal:
    """Read a column whose unit a column map gives; a name that has its own must not contradict."""
    if suffix is not None and _UNITS[suffix][0] == _DIMENSIONS[role]:
        raise Unusable(
            "unit",
            f"column {column!r} carries the unit {suffix} and is given {unit!r} as well; name it "
            f"{column.removesuffix('_' + suffix)!r} to read it by the latter",
        )
    if isinstance(unit, str):
        key = unit_key(unit)
        if key is None or _UNITS[key][0] != _DIMENSIONS[role]:
            raise Unusable(
                "unit", f"column {column!r} is given the unit {unit!r}; needed {_choices(role)}"
            )
        return Signal(column, role, _UNITS[key][1])
    if not math.isfinite(unit) or unit == 0:
        raise Unusable("unit", f"column {column!r} is given the scale {unit}; needed a number")
    return Signal(column, role, float(unit))


def _choices(role: Role) -> str:
    return ", ".join(f"_{unit}" for unit, (what, _) in _UNITS.items() if what == _DIMENSIONS[role])
