"""Templates: everything is escaped, and nothing is left out in silence."""

from __future__ import annotations

import jinja2
import pytest

from lmshealth.report.rendering import _environment, render


def test_what_a_template_names_must_be_there() -> None:
    """A name that is missing ends it, instead of a hole in a page."""
    with pytest.raises(jinja2.UndefinedError):
        render("index.html.j2", rows=[])


def test_text_is_escaped() -> None:
    """Markup in content stays text, in elements and in attributes."""
    page = _environment().from_string('<p title="{{ it }}">{{ it }}</p>')
    evil = "\"'><script>"
    safe = "&#34;&#39;&gt;&lt;script&gt;"
    assert page.render(it=evil) == f'<p title="{safe}">{safe}</p>'
