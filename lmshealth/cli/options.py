"""Options of the command line that several commands share, and how their values are read."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from lmshealth.io.constants import MAX_MEMORY
from lmshealth.signal.segments import PARTS

TABLE = click.Path(exists=True, dir_okay=False, path_type=Path)
OUT = click.Path(dir_okay=False, path_type=Path)

LOGS = click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path))
STAGE = click.option("--stage", help="Stage description: a .toml file or a shipped name.")
_COLUMNS = click.option(
    "--columns", type=click.Path(path_type=Path), help="Column map of the export."
)
FORMAT = click.option(
    "--format",
    "style",
    type=click.Choice(["table", "csv", "json"]),
    default="table",
    show_default=True,
)
PART = click.option(
    "--part",
    type=click.Choice(PARTS),
    default="record",
    show_default=True,
    help="Read all of the log, or what its set point says is this.",
)
COV = click.option("--cov", type=TABLE, help="Cross terms; default modes_cov.csv beside MODES.csv.")
MAINTENANCE = click.option("--maintenance", type=TABLE, help="What was done, as maintenance.csv.")
EPOCHS = click.option(
    "--epochs",
    type=click.IntRange(1),
    default=40,
    show_default=True,
    help="Infer health at no more than this many epochs per machine.",
)
SEED = click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
WORKERS = click.option(
    "--workers", type=click.IntRange(1), help="Processes; default one per processor."
)
SCHEDULER = click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Work on a Dask cluster instead, by the address of its scheduler: it has this version of "
    "lmshealth, and its workers see the logs under the same paths.",
)
PDF = click.option("--pdf", is_flag=True, help="Also write a PDF beside the page of each stage.")


class Finite(click.FloatRange):
    """A number in a range: NaN is in none of them, and infinity is no number to count with."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Refuse what compares with nothing, or is without end."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number.", param, ctx)
        return number


class Day(click.DateTime):
    """A day of the calendar."""

    def __init__(self) -> None:
        super().__init__(["%Y-%m-%d"])

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Say how a day is written, not which format does not match."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(f"{value!r} is no day; needed YYYY-MM-DD, such as 2027-03-01.", param, ctx)


SHARE = Finite(0, 1, min_open=True, max_open=True)

_MAX_MEMORY = click.option(
    "--max-memory",
    type=Finite(0, min_open=True),
    default=MAX_MEMORY / 1e9,
    show_default=True,
    envvar="LMSHEALTH_MAX_MEMORY",
    show_envvar=True,
    metavar="GB",
    callback=lambda ctx, option, gigabytes: 1e9 * gigabytes,
    help="Refuse a log that needs more memory than this to be read (MAT, UFF58, TDMS).",
)


def reading_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options by which logs are read: --columns and --max-memory (bytes)."""
    return _COLUMNS(_MAX_MEMORY(command))


def examples(*lines: str) -> str:
    """Write examples that stand unwrapped at the end of a command's help."""
    # click leaves a paragraph alone that begins with a backspace.
    return "\n".join(["\b", "Examples:", *(f"    lmshealth {line}" for line in lines)])


def checked_band(band: tuple[float, float] | None) -> tuple[float, float] | None:
    """Refuse a band whose ends are not in order."""
    if band and not 0 <= band[0] < band[1]:
        raise click.BadParameter(
            f"needs 0 <= LOW < HIGH, got {band[0]:g} {band[1]:g}", param_hint="--band"
        )
    return band or None


def _detections(
    ctx: click.Context, option: click.Parameter, values: tuple[str, ...]
) -> list[tuple[str, float]]:
    """Read each NAME=LOSS once."""
    pairs = [value.split("=") for value in dict.fromkeys(values)]
    try:
        return [(name, float(loss)) for name, loss in pairs]
    except ValueError as error:
        raise click.BadParameter(f"needs NAME=LOSS with a number, got {values}") from error


DETECT = click.option(
    "--detect",
    "detections",
    multiple=True,
    required=True,
    metavar="NAME=LOSS",
    callback=_detections,
    help="Parameter, and which fraction of it is lost; may be given several times.",
)
