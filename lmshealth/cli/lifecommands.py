"""The command that foretells: from a table of estimates to remaining life and service."""

from __future__ import annotations

from collections.abc import Callable
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from numpy.linalg import LinAlgError

from lmshealth._files import write_draws, write_text
from lmshealth.cli.options import (
    COV,
    MAINTENANCE,
    OUT,
    SEED,
    SHARE,
    TABLE,
    Day,
    Finite,
    examples,
)
from lmshealth.cli.progress import progress_bars
from lmshealth.errors import NotConverged, NotEnoughData

if TYPE_CHECKING:
    from lmshealth.prognosis.life_posterior import LifePosterior
    from lmshealth.prognosis.results import Prognosis
    from lmshealth.stage.description import Decision, Stage
    from lmshealth.tracking.history import History

    Life = tuple[Prognosis, LifePosterior | None]


@click.command(
    epilog=examples(
        "prognose result/modes.csv --stage lms-y --out prognosis.csv --by 2027-03-01",
        "prognose modes.csv --stage lms-y --out prognosis.csv --cost-ratio 20",
    )
)
@click.argument("table", metavar="MODES.csv", type=TABLE)
@click.option("--stage", required=True, help="Stage description: a .toml file or a shipped name.")
@click.option("--out", required=True, type=OUT, help="Where the remaining life goes.")
@COV
@MAINTENANCE
@click.option(
    "--posterior", type=OUT, help="Where the draws of the laws go, as NetCDF that ArviZ reads."
)
@click.option(
    "--by",
    type=Day(),
    metavar="YYYY-MM-DD",
    help="How probable is it that a limit is reached before this day?",
)
@click.option("--max-risk", type=SHARE, help="Service by the last day within this risk.")
@click.option(
    "--cost-ratio",
    type=Finite(1, min_open=True),
    help="Service at least costs, where a failure costs so many times a planned service.",
)
@SEED
@click.pass_context
def prognose(ctx: click.Context, /, table: Path, **options: Any) -> None:
    """Foretell the travel and time left to each limit, and when to service.

    Modes are tracked first, as by `track`, and estimates that the track does not believe are left
    out. The odometer is needed in every row. --max-risk and --cost-ratio stand in for [decision]
    of the stage description.
    """
    from lmshealth.cli.lifeview import print_life
    from lmshealth.prognosis.maintenance_decision import decide, probability_before
    from lmshealth.report.brief import life_brief
    from lmshealth.report.tables import COLUMNS, frame, prognosis_rows
    from lmshealth.stage.description import load_stage
    from lmshealth.tracking.history import missing_mode_notes
    from lmshealth.tracking.read_tables import read_machines

    stage = load_stage(options["stage"])
    decision = _decision(stage.description.decision, options)
    read = read_machines(
        table, stage, cross_terms=options["cov"], maintenance=options["maintenance"]
    )
    notes = [
        f"{own.stage}: {note}"
        for own, gone in read.machines
        for note in missing_mode_notes(own, gone)
    ]
    for note in (*read.notes, *notes):
        click.echo(f"note: {note}", err=True)
    with progress_bars() as progress:
        histories = [history for history, _ in read.machines]
        found, lost = _foretold(histories, stage, options, progress)
    rows = []
    for life, _ in found:
        day = _ahead(options["by"], life)
        before = None if day is None else (day, probability_before(life, day))
        service = decide(life, decision)
        own = prognosis_rows(life, service, before)
        print_life(life_brief(life, service, own))
        rows += own
    for why in lost:
        click.echo(f"lmshealth: {why}", err=True)
    if not found:
        ctx.exit(1)
    write_text(options["out"], frame(COLUMNS["prognosis"], rows).to_csv(index=False))
    if options["posterior"]:
        trees = [posterior.to_arviz() for _, posterior in found if posterior is not None]
        write_draws(options["posterior"], [life.stage for life, _ in found], trees)
    ctx.exit(3 if lost else 0)


def _ahead(by: datetime | None, life: Prognosis) -> date | None:
    """Give the day that is asked for; for one that does not lie ahead nothing is foretold."""
    if by is None or by.date() > life.recorded_at.date():
        return None if by is None else by.date()
    click.echo(
        f"note: {life.stage}: its last log is of {life.recorded_at.date()}; --by {by.date()} is "
        "not after it, so that nothing is foretold for that day",
        err=True,
    )
    return None


def _decision(described: Decision, options: dict[str, Any]) -> Decision:
    """Let the command line choose the day otherwise than the description does."""
    from lmshealth.stage.description import Decision

    risk, ratio = options["max_risk"], options["cost_ratio"]
    if risk is not None and ratio is not None:
        raise click.UsageError("--max-risk and --cost-ratio each choose a date: give one of them")
    if risk is None and ratio is None:
        return described
    return Decision(max_risk=risk, cost_ratio=ratio, next_service=described.next_service)


def _foretold(
    histories: list[History],
    stage: Stage,
    options: dict[str, Any],
    progress: Callable[[str, int, int], None],
) -> tuple[list[Life], list[str]]:
    """Foretell all machines of a table; one that cannot be is told and left out."""
    found, lost = [], []
    for k, history in enumerate(histories):
        try:
            found.append(_life(history, stage, options["seed"], options["posterior"] is not None))
        except NotEnoughData as why:
            lost.append(str(why))
        except (NotConverged, LinAlgError) as why:
            lost.append(f"{history.stage}: {why}; are odometer and frequencies in their units?")
        progress("foretelling", k + 1, len(histories))
    return found, lost


def _life(history: History, stage: Stage, seed: int, keep_posterior: bool) -> Life:
    """Track one machine and foretell it from what its track believes, as a run does."""
    from lmshealth.health.ensemble_sampling import seed_of
    from lmshealth.prognosis.remaining_life import prognose_with_posterior
    from lmshealth.tracking.track import accepted_estimates, track

    if not history.has_odometer:
        raise NotEnoughData(
            f"{history.stage}: not every log has travel_km; a remaining life is a travel, so every "
            "row needs the odometer"
        )
    seeds = seed_of(seed, history.stage, stage.digest)
    trusted = accepted_estimates(history, track(history, stage))
    prognosis, posterior = prognose_with_posterior(trusted, stage, seeds)
    return prognosis, posterior if keep_posterior else None
