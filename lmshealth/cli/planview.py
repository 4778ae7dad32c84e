"""What a terminal shows of plans: what logs of several lengths can do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from lmshealth.cli.terminal import percent, print_table, print_text

if TYPE_CHECKING:  # so that help comes without pandas and scipy
    from lmshealth.report.tables import Row

_HINDRANCES = {
    "too-short": ("log too short", "its modes cannot be identified."),
    "baseline": ("baseline too short", "more logs now do not help, more or longer ones there do."),
    "parameters": ("hidden", "other parameters change the modes alike; track further modes."),
}


def print_plans(detect: Sequence[Row], plan: Sequence[Row]) -> None:
    """Print what logs of several lengths can do, one table per loss to be seen."""
    for asked in detect:
        name, n_baseline = asked["parameter"], asked["n_baseline"]
        cells = [
            (
                f"{row['seconds_per_log']:g}",
                _HINDRANCES[row["hindrance"]][0] if row["hindrance"] else str(row["n_logs"]),
                _share(row["power_of_one_log"]),
                _share(row["smallest_loss_of_one_log"]),
                _share(row["smallest_loss"]),
            )
            for row in plan
            if row["parameter"] == name and row["loss"] == asked["loss"]
        ]
        heads = ("s per log", "logs", "power, 1 log", "loss, 1 log", f"loss, {n_baseline} logs")
        print_table(
            f"{name}: to see a loss of {percent(asked['loss'])} with power {asked['power']:g}, "
            f"false alarms {asked['false_alarm']:g}",
            (),
            heads,
            cells,
        )
        alone = asked["seconds_for_one_log"]
        click.echo(
            f"One log is enough from {alone} s on.\n"
            if alone
            else "No one log of an hour is enough.\n"
        )
    for kind in dict.fromkeys(row["hindrance"] for row in plan if row["hindrance"]):
        print_text(": ".join(_HINDRANCES[kind]))
    print_text(
        "At best. Baseline and logs now are of one length; loss: the smallest seen.\n"
        "Not counted: temperature, wander between logs, errors of the map."
    )


def _share(value: float) -> str:
    return "–" if math.isnan(value) else percent(value)
