"""Rendering of the page templates (Jinja2, everything escaped)."""

from __future__ import annotations

from datetime import datetime
from functools import cache
from importlib import metadata
from typing import Any

from lmshealth.report import text

_FILTERS = (
    *(text.change, text.fixed, text.interval, text.km, text.law, text.moment, text.number),
    *(text.percent, text.probability, text.probability_range, text.signed, text.spell),
    *(text.time_left, text.travel_left, text.whole_km),
)


def render(template: str, generated: datetime | None = None, /, **content: Any) -> str:
    """Render a template with the values of its names, and a time to print unless it is None."""
    version = metadata.version("lmshealth")
    page = _environment().get_template(template)
    return str(page.render(content, generated=generated, version=version))


def place(value: float, length: float) -> float:
    """Return the position of a value on a bar, in % of the bar's length."""
    return round(100 * min(max(value, 0.0) / length, 1.0), 2)


@cache
def _environment() -> Any:
    """Load the templates once per process: parsing takes longer than rendering."""
    import jinja2

    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("lmshealth.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pages.filters |= {function.__name__: function for function in (*_FILTERS, place)}
    pages.globals["covariate"] = text.covariate
    return pages
