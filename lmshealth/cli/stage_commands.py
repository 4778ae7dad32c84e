"""Commands on stage descriptions: stage, plan, check-calibration."""

from contextlib import closing
from pathlib import Path
from typing import Any

import click

from lmshealth.calibration.constants import LEAST_LOGS
from lmshealth.cli import options, terminal, views
from lmshealth.errors import NotEnoughData
from lmshealth.life.constants import MAX_LOGS
from lmshealth.machine.constants import JSON_SCHEMA
from lmshealth.report.tables import plan_rows, stage_rows
from lmshealth.stage.check import check_stage, diagnose
from lmshealth.stage.constants import DURATIONS, KM_PER_DAY
from lmshealth.stage.description import Stage
from lmshealth.stage.identifiability import plan as make_plan


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


def _detection(value: str) -> tuple[str, float]:
    """Parse NAME=LOSS."""
    name, _, loss = value.partition("=")
    try:
        return name, float(loss)
    except ValueError as error:
        raise click.BadParameter(f"needs NAME=LOSS with a number, got {value!r}") from error


@options.command(
    "plan --stage lms-y --detect guide_preload=0.05",
    "plan --stage lms-y --detect guide_preload=0.1 --detect mount_stiffness=0.1 --seconds 45",
)
@options.stage_option(required=True)
@click.option(
    "--detect",
    "detections",
    type=_detection,
    multiple=True,
    required=True,
    metavar="NAME=LOSS",
    callback=options.unique,
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
    callback=options.unique,
    help="Length of a log in s; may be given several times. Default 10 to 600 s.",
)
@options.format_option("table", "json")
def plan(
    stage: Stage,
    detections: list[tuple[str, float]],
    seconds: list[float],
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


@options.command(
    "check-calibration my-stage.toml --out calibration/",
    "check-calibration lms-y --logs 60 --every 3.5 --km-per-day 12 --lives 200",
)
@click.argument("described", metavar="STAGE", type=options.described)
@options.FOLLOW_LINKS
@click.option("--out", type=options.FOLDER, help="Folder for CSV, JSON and the page.")
@click.option(
    "--lives",
    type=click.IntRange(1, 100_000),
    default=100,
    help="Lives drawn from the description; each kind of life gets at least a quarter as many.",
)
@click.option(
    "--logs", type=click.IntRange(LEAST_LOGS, MAX_LOGS), default=40, help="Logs of a life."
)
@click.option(
    "--every",
    type=options.Finite(0, 1000, min_open=True),
    default=7.0,
    help="Days from log to log.",
)
@click.option(
    "--seconds",
    type=options.Finite(0, 1e9, min_open=True),
    default=60.0,
    help="Length of a log in s.",
)
@click.option(
    "--km-per-day",
    type=options.Finite(*KM_PER_DAY),
    help="Travel; default [usage] of the description, or that of machines in the middle of life.",
)
@click.option(
    "--frequency-std",
    type=options.Finite(0, 1, min_open=True),
    metavar="SHARE",
    help="Standard deviation of a natural frequency in one log, as a share of it; default the "
    "Cramér-Rao bound with the SNR of the description.",
)
@options.SEED
@options.WORKERS
@options.format_option("table", "json")
def check_calibration(
    described: Stage,
    out: Path | None,
    lives: int,
    seed: int,
    workers: int,
    style: str,
    **schedule: Any,
) -> int:
    """Check which coverage, detection and dates a stage description leads to.

    Lives are drawn from the description STAGE (its map, priors, laws, sensors), as modal estimates
    of each log, and analysed as real logs are: track, health, service date. Reports by kind of life
    how often intervals hold the truth, which losses are detected after how many logs, false alarms,
    and how wide dates are. Exit status 1 if something is not as stated. After Ctrl-C the results of
    the lives that are done are there.
    """
    from lmshealth.calibration import check, page
    from lmshealth.calibration.lives import Schedule

    resolved = Schedule(**schedule).resolved(described)
    drawn = check.draw_outcomes(described, resolved, lives=lives, seed=seed, workers=workers)
    outcomes, interrupted = [], None
    try:
        with terminal.progress_bars() as progress, closing(drawn):
            for outcome, total in drawn:
                outcomes.append(outcome)
                progress("lives", len(outcomes), total)
    except KeyboardInterrupt as error:
        interrupted = error
    if not outcomes and interrupted:
        raise interrupted
    found = check.summarise(described, resolved, outcomes, seed=seed)
    without = [f"{n} lives have no result: {why}" for why, n in found.without_result.items()]
    if not found.coverage:
        raise NotEnoughData(f"{found.stage}: {'; '.join(without)}; correct description or schedule")
    terminal.print_notes(without)
    report = page.write_results(out, found) if out else None
    if style == "json":
        terminal.print_json(page.document(found))
    else:
        views.print_calibration(found)
        if report:
            terminal.print_line(f"Report: {report}")
    if interrupted:
        done = f"{len(outcomes)} of {total} lives are done"
        terminal.print_notes([f"{done}; lives that take long are too few among them"])
        raise interrupted
    if page.verdict_of(found)[0] == "bad":
        terminal.print_errors([f"{found.stage}: {len(found.wrong)} checks are not as stated"])
        return 1
    return 0
