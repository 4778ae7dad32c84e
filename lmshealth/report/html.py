"""Markup of the pages: templates, filled in with everything escaped."""

from __future__ import annotations

from datetime import datetime
from functools import cache
from importlib import metadata
from typing import Any

from lmshealth.report.text import km, moment, spell, whole_km


def render(template: str, generated: datetime | None = None, /, **content: Any) -> str:
    """Fill in a template of a page.

    Parameters
    ----------
    template : str
        Its file in ``templates/``.
    generated : datetime or None
        Moment to print on the page; nothing is printed for None.
    content : Any
        What the template names; a name that it lacks is an error.
    """
    version = metadata.version("lmshealth")
    page = _environment().get_template(template)
    return str(page.render(content, generated=generated, version=version))


@cache
def _environment() -> Any:
    """Set up the templates, once per process: to read them costs more than to fill them in."""
    import jinja2

    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("lmshealth.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pages.filters |= {"spell": spell, "moment": moment, "km": km, "whole_km": whole_km}
    return pages
