"""Light SVG: the same picture in fewer bytes, with texts as texts."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import imread

from lmshealth.report import figures as plots
from tests.assessments import chromium


def curve(ax: Axes) -> None:
    """Draw points, a line and words."""
    x = np.linspace(0, 1, 20)
    ax.plot(x, x**2, "o-", label="line 12.5 Hz")
    ax.set_xlabel("odometer in km")
    ax.legend()


def bar(ax: Axes) -> None:
    """Draw other words."""
    ax.bar([1, 2], [3, 4])
    ax.set_title("Quite other letters: XYZ")


@pytest.fixture(scope="module")
def pictures() -> dict[str, str]:
    """Give two pictures of a page."""
    return {name: plots.svg(draw, salt=name) for name, draw in (("a", curve), ("b", bar))}


def targets(text: str) -> tuple[set[str], list[str]]:
    """Return what is referred to, and all identifiers."""
    return set(re.findall(r'(?:href="|url\()#([^")]+)', text)), re.findall(r'\sid="([^"]+)', text)


def test_lean_keeps_what_is_seen() -> None:
    """Numbers keep two decimals, scales all; what is referred to keeps its name, nothing else."""
    text = plots._compact(
        '<svg>\n <!-- made by -->\n <metadata>x</metadata>\n <g id="axes">\n'
        '  <path id="m1" d="M 0.123456 1 \nL 2 3.999 \nz" style="fill: none; stroke: #000"/>\n'
        '  <use xlink:href="#m1" transform="translate(1.23456 0)"/>\n'
        '  <use xlink:href="#m1" transform="translate(1.5 -2.25) scale(0.0156)"/>\n </g>\n</svg>'
    )
    assert text == (
        '<svg>\n<g>\n<path id="m1" d="M0.12 1L2 3.99z" style="fill:none;stroke:#000"/>\n'
        '<use href="#m1" transform="translate(1.23 0)"/>\n'
        '<use href="#m1" transform="translate(1.5 -2.25) scale(0.0156)"/>\n</g>\n</svg>'
    )


def test_successive_markers_share_their_style() -> None:
    """A run of equal markers shares its style, one that looks otherwise has its own."""
    red, blue = 'style="fill:red"', 'style="fill:blue"'
    rows = [f'<use href="#m" x="{k}" {red if k < 3 else blue}/>\n' for k in range(4)]
    text = plots._compact(f'<svg>\n<path id="m"/>\n{"".join(rows)}</svg>')
    assert text.count(red) == text.count(blue) == 1 and text.count("<use") == 4
    assert text.index("<g ") < text.index('x="0"') < text.index('x="2"') < text.index("</g>")


def test_every_name_is_found_and_used(pictures: dict[str, str]) -> None:
    """A picture alone is well formed and refers to what it has, and to all that it names."""
    for text in pictures.values():
        ElementTree.fromstring(text)
        used, there = targets(text)
        assert used == set(there) and len(there) == len(set(there))


def test_texts_stay_texts(pictures: dict[str, str]) -> None:
    """A reader can find and copy the words of a figure; any other font may take their place."""
    words = [text.text for text in ElementTree.fromstring(pictures["a"]).iter() if text.text]
    assert {"odometer in km", "line 12.5 Hz"} <= set(words)
    assert "sans-serif" in pictures["a"] and "DejaVuSans-" not in pictures["a"]


@pytest.mark.slow
def test_a_picture_looks_as_before(
    tmp_path_factory: pytest.TempPathFactory, needs: Callable[[str], None]
) -> None:
    """A browser draws the lean page like what matplotlib writes, but for the edges of lines."""
    needs("chromium")
    folder, target = tmp_path_factory.mktemp("svg"), io.StringIO()
    style: Any = plots._STYLE
    with matplotlib.rc_context(style):
        figure = Figure(figsize=plots.SIZE, layout="constrained", facecolor="none")
        curve(figure.add_subplot())
        figure.savefig(target, format="svg")
    shown = "<style>svg{display:block}</style>" + plots.svg(curve, salt="a")
    seen = []
    with chromium() as browser:
        for k, text in enumerate((target.getvalue(), shown, plots.svg(bar, salt="b"))):
            path = folder / f"{k}.html"
            path.write_text(f"<!DOCTYPE html><meta charset=utf-8>{text[text.index('<s') :]}")
            page = browser.new_page()
            page.goto(path.as_uri())
            seen.append(imread(io.BytesIO(page.locator("svg").last.screenshot()))[..., :3])
    assert seen[0].shape == seen[1].shape and np.ptp(seen[0]) > 0.5
    off = [np.mean(np.abs(seen[0] - other).max(axis=-1) > 0.3) for other in seen[1:]]
    assert off[0] < 1e-3 < off[1]
