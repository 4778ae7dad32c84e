"""The page of ``make statistics``: claims with controls, ranks, coverages, Monte-Carlo errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lmshealth._private.files import write_text
from lmshealth.calibration.page import (
    Block,
    Picture,
    Share,
    histogram_picture,
    render_page,
    share_picture,
)
from lmshealth.calibration.ranks import clopper_pearson

Row = dict[str, Any]
_TITLES = {
    "decay": "Modes from free decays",
    "frf": "Modes from frequency responses",
    "growth": "Growth of vibration with velocity",
    "kind": "Health and verdicts by kind of life",
    "life": "Health and remaining life",
    "line": "Spectral lines",
    "modal": "Modes from ambient vibration",
    "planning": "Planning of logs",
    "tracking": "Tracking of modes over a life",
}
_SIDES = {"as": "", "most": "at most ", "least": "at least "}


def write_page(
    target: Path,
    rows: Sequence[Row],
    held: Sequence[tuple[float, bool]],
    *,
    failed: bool,
    made: str,
) -> None:
    """Write the page of claims; `held` has the level of each, and whether it is rejected.

    ``made`` says when, from which code, seed and in which time.
    """
    level, of = rows[0]["level"], rows[0]["of"]
    rejected = [row["name"] for row, (_, out) in zip(rows, held, strict=True) if out]
    groups = dict.fromkeys(row["name"].split(": ")[0] for row in rows)
    why = [
        f"{len(rows)} of {of} claims were tested, {len(rejected)} rejected by Holm's rule. A suite "
        f"without any fault is rejected in at most {level:.0%} of runs with other seeds."
    ]
    state, headline = "good", "All claims hold"
    if len(rows) < of:
        state, headline = "open", "Claims that were tested hold"
    if rejected or failed:
        state, headline = "bad", "Not all claims hold"
        why.append(f"Rejected: {'; '.join(rejected) or 'none; a test or a control failed'}.")
    blocks = [
        Block(
            "How to read this page",
            (
                "Each claim is about an interval or a rate that the program states. It is tested "
                "on simulated data whose truth is known. The p value is the probability of data "
                "as far off, if the claim is true: small ones speak against it.",
                "Each claim has a control: the same test on results that are wrong on purpose. A "
                "test that does not reject its control could not find a fault.",
                "Ranks: where the true value lies among the values that the program holds "
                "possible. Level bars: the uncertainty is right. Bars high at both ends: "
                "intervals too narrow; high in the middle: too wide; high at one side: a bias.",
            ),
        ),
        *(_block(group, rows, held, k) for k, group in enumerate(groups)),
    ]
    title = "Statistical claims of lmshealth"
    sub = f"Written by make statistics, {made}; other data: LMSHEALTH_SEED=7 make statistics"
    write_text(target, render_page(title, sub, (state, headline, why), blocks))


def _block(
    group: str, rows: Sequence[Row], held: Sequence[tuple[float, bool]], number: int
) -> Block:
    """Return the claims of a group of tests."""
    own = [(row, one) for row, one in zip(rows, held, strict=True)
           if row["name"].split(": ")[0] == group]  # fmt: skip
    figures: list[Picture] = []
    shares = [share for row, _ in own for share in _shares(row["name"], row)]
    if shares:
        caption = (
            "Good: each bar reaches its dashed line, or lies on the claimed side of it. By chance "
            "one of twenty misses it (red): that alone is no rejection, which the table tells."
        )
        figures.append(
            share_picture("Coverages and rates", shares, caption, salt=f"s{number}", wide=True)
        )
    for k, (row, _) in enumerate(own):
        if row["places"]:
            name = row["name"].split(": ", 1)[1].capitalize()
            note = f"p = {row['p']:.2g}."
            figures.append(histogram_picture(name, row["places"], note, salt=f"r{number}-{k}"))
    control = next((row for row, _ in own if row["wrong"]["places"]), None)
    if control:
        name = control["name"].split(": ", 1)[1]
        figures.append(
            histogram_picture(
                f"Control: {name}, wrong on purpose", control["wrong"]["places"],
                f"p: {_probability(control['control'])}.", salt=f"c{number}",
                expected="This one must not look good: its bars must not be of equal height.",
            )
        )  # fmt: skip
    table = [
        {
            "claim": row["name"].split(": ", 1)[1],
            "data sets": f"{row['trials']}",
            "measured (95 % Monte-Carlo interval)": "; ".join(
                [*map(_measured, row["shares"]), *filter(None, [row["text"]])]
            ),
            "p": f"{row['p']:.2g}",
            "rejected below": f"{level:.1g}",
            "p of the control": _probability(row["control"]),
            "": "REJECTED" if out else "holds",
        }
        for row, (level, out) in own
    ]
    text = f"{len(table)} claims, tested by tests/statistical/test_{group}_calibration.py."
    return Block(_TITLES[group], (text,), figures, table)


def _probability(p: float) -> str:
    """Format a p value that may be too small for a number of the machine."""
    return f"{p:.1g}" if p > 0 else "below 1e-300"


def _measured(share: Sequence[Any]) -> str:
    hits, n, stated, side = share
    low, high = clopper_pearson(hits, n)
    return (
        f"{100 * hits / n:.3g} % ({100 * low:.3g} to {100 * high:.3g}), stated "
        f"{_SIDES[side]}{100 * stated:.3g} %"
    )


def _shares(name: str, row: Row) -> list[Share]:
    """Return the shares of a claim with their labels."""
    label, several = name.split(": ", 1)[1], len(row["shares"]) > 1
    return [
        Share(f"{label}, {100 * stated:g} %" if several else label, hits / n,
              *clopper_pearson(hits, n), stated, side)
        for hits, n, stated, side in row["shares"]
    ]  # fmt: skip
