"""What a terminal shows of remaining lives and of machines as a whole."""

from __future__ import annotations

from collections.abc import Sequence

import click

from lmshealth.cli.terminal import print_table, print_text
from lmshealth.report.brief import Brief, LifeBrief

# So many machines are told one by one, and so many have a row in a table.
_FEW, _MOST_ROWS = 3, 20


def print_briefs(briefs: Sequence[Brief]) -> None:
    """Print what a run found of each machine: of a few all, of many a row each.

    Parameters
    ----------
    briefs : sequence of Brief
        Of all machines, worst first.
    """
    if len(briefs) > _FEW:
        _print_fleet(briefs)
        return
    for one in briefs:
        print_text(f"{one.stage}: {one.verdict}. {one.why}")
        for gauge in one.gauges:
            click.echo(f"  {gauge}")
        if one.life is not None:
            print_life(one.life)


def _print_fleet(briefs: Sequence[Brief]) -> None:
    cells = [
        (one.stage, one.verdict, "\n".join(one.gauges), one.left, one.due)
        for one in briefs[:_MOST_ROWS]
    ]
    texts = ("stage", "verdict", "health", "km left", "service")
    print_table(
        f"{len(briefs)} stages, worst first (medians with 90 % intervals)", texts, (), cells
    )
    rest = len(briefs) - _MOST_ROWS
    if rest > 0:
        click.echo(f"{rest} more stages; verdict.csv and prognosis.csv list all.")


def print_life(life: LifeBrief) -> None:
    """Print the quantiles of a remaining life for each limit and any, then when to service."""
    heads = ("chance %", "km", "hours", "days", "date")
    print_table(life.title, ("until",), heads, life.cells)
    for text in life.sentences:
        print_text(text)
    click.echo()
