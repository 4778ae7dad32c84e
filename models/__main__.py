"""Command line of the simulated stages: ``python -m models``."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from models.errors import ModelError
from models.formats import WRITERS
from models.lives import Plan, simulate_life
from models.mapping import modal_map
from models.plant import SENSORS, closed_loop_modes, participation
from models.stages import NOMINAL, Condition, stage_named

_TABLE_WIDTH = 100
_EXAMPLES = {
    "modes": "python -m models modes lms-y --preload 0.8 --format json",
    "map": "python -m models map lms-y --out lms-y.map.csv",
    "simulate": (
        "python -m models simulate lms-y --life both --logs 60 --seconds 20 --seed 1 --out life"
    ),
}


def _epilog(command: str) -> str:
    """Return the example under a command's help."""
    return f"Example: {_EXAMPLES[command]}"


@click.group()
def cli() -> None:
    """Simulate the linear-motor stages LMS-X and LMS-Y: modes, modal maps, lives of logs."""


def _mode_records(stage_name: str, condition: Condition) -> list[dict[str, Any]]:
    """Return the modal table of a stage as JSON-ready records."""
    stage = stage_named(stage_name)
    return [
        {
            "mode": mode.name,
            "frequency_hz": mode.frequency_hz,
            "damping_ratio": mode.damping_ratio,
            "direction": mode.direction,
            "participation": participation(stage, mode),
        }
        for mode in closed_loop_modes(stage, condition)
    ]


@cli.command(epilog=_epilog("modes"))
@click.argument("stage")
@click.option("--preload", default=1.0, show_default=True, help="Guide preload, 1 as new.")
@click.option("--mount", default=1.0, show_default=True, help="Mount stiffness, 1 as new.")
@click.option(
    "--temperature", default=NOMINAL.temperature_c, show_default=True, help="Temperature, °C."
)
@click.option(
    "--format",
    "file_format",
    type=click.Choice(["table", "json"]),
    default="table",
    show_default=True,
)
def modes(stage: str, preload: float, mount: float, temperature: float, file_format: str) -> None:
    """Print the closed-loop modes of STAGE (lms-x or lms-y).

    Participation is the displacement that a signal reads in the mode, as a part of the
    platform's largest.
    """
    records = _mode_records(stage, Condition(preload, mount, temperature))
    if file_format == "json":
        click.echo(json.dumps({"modes": records}, indent=2))
        return
    table = Table("mode", "frequency Hz", "damping %", "direction", *SENSORS)
    for record in records:
        table.add_row(
            record["mode"],
            f"{record['frequency_hz']:.2f}",
            f"{100 * record['damping_ratio']:.2f}",
            record["direction"],
            *(f"{record['participation'][name]:.4f}" for name in SENSORS),
        )
    console = Console()
    # Cut-off names are useless in a file or a pipe.
    Console(width=max(console.width, _TABLE_WIDTH)).print(table)


@cli.command("map", epilog=_epilog("map"))
@click.argument("stage")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True)
def map_command(stage: str, out: Path) -> None:
    """Write the modal map of STAGE over guide preload and mount stiffness."""
    modal_map(stage_named(stage)).to_csv(out, index=False, float_format="%.12g")


@cli.command(epilog=_epilog("simulate"))
@click.argument("stage")
@click.option("--life", required=True, help="Name of the life, for example both.")
@click.option("--logs", type=int, required=True, help="Count of logs.")
@click.option("--seconds", type=float, default=20.0, show_default=True, help="Length of each.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True)
@click.option(
    "--format",
    "file_format",
    type=click.Choice(list(WRITERS)),
    default="hdf5",
    show_default=True,
)
@click.option(
    "--workers", type=int, default=None, help="Processes; without it 2 where there are 2 cores."
)
def simulate(
    stage: str,
    life: str,
    logs: int,
    seconds: float,
    seed: int,
    out: Path,
    file_format: str,
    workers: int | None,
) -> None:
    """Write a life of STAGE: logs, manifest.csv, maintenance.csv and truth.csv."""
    plan = Plan(stage, life, logs, seconds, seed, file_format)
    count = min(2, os.cpu_count() or 1) if workers is None else workers
    _with_progress(logs, lambda advance: simulate_life(plan, out, workers=count, progress=advance))


def _with_progress(total: int, work: Callable[[Callable[[int], None]], None]) -> None:
    """Run work with a progress bar on standard error, shown only on a terminal."""
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("logs", total=total)
        work(lambda done: progress.advance(task, done))


def main() -> None:
    """Run the command line; a named error is one line on standard error and status 1."""
    try:
        cli(prog_name="python -m models")
    except (ModelError, OSError) as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
