"""Commands on stage descriptions: stage, plan."""

from typing import Any

import click

from lmshealth.cli import options, terminal, views
from lmshealth.machine.constants import JSON_SCHEMA
from lmshealth.report.tables import plan_rows, stage_rows
from lmshealth.stage.check import check_stage, diagnose
from lmshealth.stage.constants import DURATIONS
from lmshealth.stage.description import Stage
from lmshealth.stage.planning import plan as make_plan


@options.command("stage lms-y", "stage my-stage.toml --format json")
@click.argument("described", metavar="STAGE", type=options.described)
@options.FOLLOW_LINKS
@options.format_option("table", "json")
def stage(described: Stage, style: str) -> None:
    """Check a stage description and the identifiability of its parameters.

    STAGE is a .toml file or a shipped name. Reports errors with their key; else the range and
    surrogate error of the modal map, the sensitivities of the modes, and which parameters logs can
    determine at best (Cramér-Rao bound of vibration at constant velocity).
    """
    checked = check_stage(described)
    content = stage_rows(checked, diagnose(checked))
    if style == "json":
        terminal.print_json({"schema": JSON_SCHEMA, **content})
    else:
        views.print_stage(content)


def _detections(
    ctx: click.Context, option: click.Parameter, values: tuple[str, ...]
) -> list[tuple[str, float]]:
    """Parse NAME=LOSS, without duplicates."""
    pairs = [value.split("=") for value in values]
    try:
        return list(dict.fromkeys((name, float(loss)) for name, loss in pairs))
    except ValueError as error:
        raise click.BadParameter(f"needs NAME=LOSS with a number, got {values}") from error


@options.command(
    "plan --stage lms-y --detect guide_preload=0.05",
    "plan --stage lms-y --detect guide_preload=0.1 --detect mount_stiffness=0.1 --seconds 45",
)
@options.stage_option(required=True)
@click.option(
    "--detect",
    "detections",
    multiple=True,
    required=True,
    metavar="NAME=LOSS",
    callback=_detections,
    help="Parameter and the fraction of it that is lost; may be given several times.",
)
@click.option("--power", type=options.SHARE, default=0.95, help="Probability to detect the loss.")
@click.option(
    "--false-alarm",
    type=options.SHARE,
    default=0.01,
    help="Probability to report a loss when there is none.",
)
@click.option(
    "--seconds",
    type=options.Finite(0, 1e9, min_open=True),
    multiple=True,
    callback=options.once,
    help="Length of a log in s; may be given several times. Default 10 to 600 s.",
)
@options.format_option("table", "json")
def plan(
    stage: Stage,
    detections: list[tuple[str, float]],
    seconds: tuple[float, ...],
    style: str,
    **given: Any,
) -> None:
    """Plan the length and number of logs that are needed to detect a loss.

    Lower bound for vibration at constant velocity (Cramér-Rao): logs of the present are compared
    with baseline logs of equal length, at the same temperature.
    """
    durations = seconds or DURATIONS
    plans = [make_plan(stage, *one, durations=durations, **given) for one in detections]
    content = plan_rows(plans)
    if style == "json":
        terminal.print_json(content)
    else:
        views.print_plans(**content)
