"""The figure of a record: all shares that it claims, with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from studies.harness.claims import Claim

# Fewer shares are read from the table.
FEWEST = 3
# Colours that colour-blind readers can distinguish (Okabe and Ito).
_MET, _NOT_MET, _CONTROL = "#0072b2", "#d55e00", "#999999"
_WIDTH, _LINE, _AXIS = 9.0, 0.24, 0.7  # inches
_LETTERS = 78
_SETTINGS: dict[Any, object] = {"svg.hashsalt": "shares", "svg.fonttype": "none", "font.size": 8}


def shown(claims: Sequence[Claim]) -> list[Claim]:
    """Return the claims of shares, if they are enough for a figure."""
    found = [claim for claim in claims if claim.shares]
    return found if len(found) >= FEWEST else []


def draw(claims: Sequence[Claim], path: Path) -> None:
    """Draw one line for each claim: its shares in percent, over their intervals."""
    with matplotlib.rc_context(_SETTINGS):
        figure = Figure(figsize=(_WIDTH, _AXIS + _LINE * len(claims)), layout="constrained")
        ax = figure.add_subplot()
        for y, claim in enumerate(claims):
            colour = _CONTROL if "(control)" in claim.what else _MET if claim.met else _NOT_MET
            for share, low, high in claim.shares:
                ax.plot([100 * low, 100 * high], [y, y], lw=2, alpha=0.5, color=colour)
                ax.plot(100 * share, y, "o", ms=3.5, color=colour)
        names = [shorten(claim.what, _LETTERS, placeholder=" …") for claim in claims]
        ax.set_yticks(range(len(claims)), names)
        ax.set_ylim(len(claims) - 0.4, -0.6)
        ax.set_xlim(-2, 102)
        ax.set_xlabel("%; orange: requirement not met, grey: control that must fail")
        ax.grid(axis="x", alpha=0.3)
        figure.savefig(path, metadata={"Date": None})
