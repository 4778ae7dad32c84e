"""Numbers in words, as pages for people write them."""

from __future__ import annotations

from datetime import datetime
from typing import Any

import numpy as np

from lmshealth._arrays import FloatArray

_KM = 1000.0
GAP = "\u202f"  # narrow space that does not break: between a number and its unit
_UNITS = {"c": "°C", "kg": "kg", "mm": "mm"}
LEVELS = np.array([0.05, 0.5, 0.95])


def spell(name: str) -> str:
    """Write a name in words."""
    return name.replace("_", " ")


def covariate(column: str) -> tuple[str, str]:
    """Split the name of a covariate's column into words and its unit, empty where unknown."""
    name, _, unit = column.rpartition("_")
    return (spell(name), _UNITS[unit]) if name and unit in _UNITS else (spell(column), "")


def law_words(kind: str) -> str:
    """Say what a law of a stage description does."""
    words = {
        "hertz-wear": "wear of the contacts (Hertz)",
        "loosening": "loosening towards a floor",
        "power": "loss as a power of travel",
        "linear": "loss in proportion to travel",
        "none": "no change",
    }
    return words.get(kind, kind)


def moment(when: datetime) -> str:
    """Write a moment for people."""
    return when.strftime("%Y-%m-%d %H:%M %Z").strip()


def percent(probability: float | np.floating[Any]) -> str:
    """Write a probability; draws cannot prove 0 or 1."""
    if probability < 0.01:
        return f"below 1{GAP}%"
    if probability > 0.99:
        return f"above 99{GAP}%"
    return f"{100 * probability:.0f}{GAP}%"


def chance(at_least: float, at_most: float) -> str:
    """Write a probability that is known between two values."""
    low, high = percent(at_least), percent(at_most)
    if low == high:
        return low
    if at_least < 0.01:
        return f"at most {high}"
    return f"at least {low}" if at_most > 0.99 else f"{low} to {high}"


def signed(value: float, digits: int) -> str:
    """Write a number with its sign."""
    return f"{value:+.{digits}f}".replace("-", "−")


def change(ln: float, std: float) -> tuple[float, float]:
    """Turn the change of a logarithm and its standard deviation into percent of what was before."""
    return 100 * float(np.expm1(ln)), 100 * float(np.exp(ln)) * std


def number(value: float) -> str:
    """Write three significant digits, thousands apart."""
    rounded = float(f"{value:.3g}")
    digits = 0 if not abs(rounded) < 10 or rounded.is_integer() else 1
    return f"{rounded:,.{digits}f}".replace(",", GAP).replace("-", "−")


def km(metres: float) -> str:
    """Write a distance given in m."""
    return f"{number(metres / _KM)}{GAP}km"


def whole_km(metres: float) -> str:
    """Write a distance given in m to the kilometre."""
    return f"{metres / _KM:,.0f}{GAP}km".replace(",", GAP)


def day_count(days: float) -> str:
    """Write a number of days, with years where there are many."""
    years = f" ({days / 365.25:.1f} years)" if days >= 1000 else ""
    return f"{number(days)}{GAP}days{years}"


def quantiles(values: FloatArray) -> list[float]:
    """Give 5, 50 and 95 % of draws that may be infinite: always one of the draws."""
    return [float(q) for q in np.quantile(values, LEVELS, method="inverted_cdf")]


def left(value: float, beyond: str, text: str) -> str:
    """Write what is left of a life."""
    return "already passed" if value <= 0 else beyond if np.isinf(value) else text
