"""Commands on stage descriptions: stage, plan."""

from __future__ import annotations

from typing import Any

import click

from lmshealth.cli import terminal, views
from lmshealth.cli.options import DETECT, REQUIRED_STAGE, SHARE, TABLE_OR_JSON, examples


@click.command(epilog=examples("stage lms-y", "stage my-stage.toml --format json"))
@click.argument("reference", metavar="STAGE")
@TABLE_OR_JSON
def stage(reference: str, style: str) -> None:
    """Check a stage description and the identifiability of its parameters.

    STAGE is a .toml file or a shipped name. Reports errors with line and key; else the range and
    surrogate error of the modal map, the sensitivities of the modes, and which parameters logs can
    determine at best (Cramér-Rao bound of vibration at constant velocity).
    """
    from lmshealth.report.tables import stage_rows
    from lmshealth.stage.check import check_stage, diagnose
    from lmshealth.stage.description import load_stage

    checked = check_stage(load_stage(reference))
    content = stage_rows(checked, diagnose(checked))
    if style == "json":
        terminal.print_json(content)
    else:
        views.print_stage(content)


@click.command(
    epilog=examples(
        "plan --stage lms-y --detect guide_preload=0.05",
        "plan --stage lms-y --detect guide_preload=0.1 --detect mount_stiffness=0.1 --seconds 45",
    )
)
@REQUIRED_STAGE
@DETECT
@click.option(
    "--power", type=SHARE, default=0.95, show_default=True, help="Probability to detect the loss."
)
@click.option(
    "--false-alarm",
    type=SHARE,
    default=0.01,
    show_default=True,
    help="Probability to report a loss when there is none.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(0, min_open=True),
    multiple=True,
    help="Length of a log in s; may be given several times. Default 10 to 600 s.",
)
@TABLE_OR_JSON
def plan(detections: list[tuple[str, float]], style: str, **options: Any) -> None:
    """Plan the length and number of logs that are needed to detect a loss.

    Lower bound for vibration at constant velocity (Cramér-Rao): logs of the present are compared
    with baseline logs of equal length, at the same temperature.
    """
    from lmshealth.report.tables import plan_rows
    from lmshealth.stage.constants import DURATIONS
    from lmshealth.stage.description import load_stage
    from lmshealth.stage.planning import plan as make_plan

    loaded = load_stage(options["stage"])
    plans = [
        make_plan(
            loaded,
            *detection,
            power=options["power"],
            false_alarm=options["false_alarm"],
            durations=options["seconds"] or DURATIONS,
        )
        for detection in detections
    ]
    content = plan_rows(plans)
    if style == "json":
        terminal.print_json(content)
    else:
        views.print_plans(**content)
