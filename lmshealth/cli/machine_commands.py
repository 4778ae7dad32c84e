"""Commands that continue from tables of estimates: track, infer, prognose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from numpy.linalg import LinAlgError

from lmshealth._files import write_draws, write_text
from lmshealth.cli import views
from lmshealth.cli.options import (
    COV,
    EPOCHS,
    MAINTENANCE,
    OUT,
    REQUIRED_STAGE,
    SEED,
    SHARE,
    SOME_REFUSED,
    STAGE,
    TABLE,
    Day,
    Finite,
    examples,
    out_option,
)
from lmshealth.cli.progress import progress_bars
from lmshealth.errors import BadTable, NotConverged, NotEnoughData

if TYPE_CHECKING:
    from lmshealth.health.results import Health
    from lmshealth.io.log import Refusal
    from lmshealth.prognosis.life_posterior import LifePosterior
    from lmshealth.prognosis.results import Prognosis
    from lmshealth.report.tables import Row
    from lmshealth.stage.description import Decision, Stage
    from lmshealth.tracking.history import History
    from lmshealth.tracking.read_tables import Drifts, Table

    Prognosed = tuple[Prognosis, LifePosterior | None]
    Machines = Table[tuple[History, list[Refusal]]]

_TABLES = ("track", "track_cov", "effects", "events", "refused")


@click.command(
    epilog=examples(
        "track result/modes.csv --stage lms-y --out track.csv --events events.csv",
        "track other_program.csv --out track.csv --effects effects.csv --smooth",
    )
)
@click.argument("table", metavar="MODES.csv", type=TABLE)
@STAGE
@out_option("Table of the track.")
@COV
@MAINTENANCE
@click.option("--track-cov", type=OUT, help="Table of the covariances of the drifts.")
@click.option("--effects", type=OUT, help="Table of effects other than wear.")
@click.option("--events", type=OUT, help="Table of steps, changes of servo tuning and alarms.")
@click.option("--refused", type=OUT, help="Table of the estimates of no mode, with reasons.")
@click.option("--smooth", "smoothed", is_flag=True, help="Add smoothed columns (later logs too).")
def track(table: Path, out: Path, **options: Any) -> None:
    """Track modes through a table of estimates of lmshealth or another program.

    Required columns: recorded_at, frequency_hz and frequency_std_hz. The clock is travel_km when
    every row has it, else the time. Without mode names the modes are found from the estimates;
    without --stage every covariate column is regressed about its median.
    """
    from lmshealth.report import tables
    from lmshealth.stage.description import load_stage
    from lmshealth.tracking.smoother import smooth
    from lmshealth.tracking.track import accepted_estimates, outlier_refusals
    from lmshealth.tracking.track import track as track_modes

    stage = load_stage(options["stage"]) if options["stage"] else None
    read = _read_machines(table, stage, options)
    rows: dict[str, list[Row]] = {name: [] for name in _TABLES}
    notes = list(read.notes)
    for history, refused in read.entries:
        found = track_modes(history, stage)
        refused += outlier_refusals(history, found)
        smoothed = None
        if options["smoothed"]:
            smoothed = smooth(accepted_estimates(history, found), found, stage)
        rows["track"] += tables.track_rows(found, smoothed)
        rows["track_cov"] += tables.track_cov_rows(found)
        rows["effects"] += tables.effects_rows(found)
        rows["events"] += tables.events_rows(found)
        rows["refused"] += tables.refused_rows(refused)
        notes += _notes(history, refused)
        views.print_track(found)
    _print_notes(notes)
    for name, target in {"track": out, **{name: options[name] for name in _TABLES[1:]}}.items():
        if target is not None:
            frame = tables.frame(tables.COLUMNS[name], rows[name])
            write_text(target, frame.to_csv(index=False))


def _notes(history: History, refused: list[Refusal]) -> list[str]:
    """Return what the reader of a track must take into account."""
    from lmshealth.tracking.history import missing_mode_notes

    notes = missing_mode_notes(history, refused)
    if not history.has_odometer:
        notes.append("not every log has travel_km: the clock is the time")
    if len(history.logs) == 1:
        notes.append("a single log is the baseline: no drift yet")
    reasons = Counter(refusal.reason for refusal in refused)
    if reasons:
        listed = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
        notes.append(f"refused: {listed}; --refused FILE lists them")
    return [f"{history.stage}: {note}" for note in notes]


@click.command(
    epilog=examples(
        "infer result/track.csv --stage lms-y --out health.csv --posterior health.nc",
        "infer y/track.csv --stage lms-y --with x/track.csv lms-x --shared guide_preload "
        "--out health.csv",
    )
)
@click.argument("table", metavar="TRACK.csv", type=TABLE)
@REQUIRED_STAGE
@out_option("Table of the health parameters.")
@click.option(
    "--cov", type=TABLE, help="Covariances of the drifts; default track_cov.csv in the same folder."
)
@click.option("--posterior", type=OUT, help="All draws, as NetCDF for ArviZ.")
@click.option(
    "--with",
    "others",
    type=(TABLE, str),
    multiple=True,
    metavar="TRACK.csv STAGE",
    help="Another machine that shares a part with the first; see --shared.",
)
@click.option(
    "--shared", multiple=True, metavar="PARAMETER", help="Parameter that the machines share."
)
@EPOCHS
@SEED
@click.pass_context
def infer(ctx: click.Context, /, table: Path, **options: Any) -> None:
    """Infer the health parameters from a track, epoch by epoch.

    Required columns: recorded_at, mode, drift and drift_std, as in track.csv. With --with and
    --shared, machines that share a part (such as one guide in two configurations) are inferred
    together, at the epochs of the first.
    """
    from lmshealth.report.tables import COLUMNS, frame, health_rows

    if bool(options["others"]) != bool(options["shared"]):
        raise click.UsageError("--with and --shared need each other: which parameter is shared?")
    with progress_bars() as progress:
        found, lost = _infer_machines(table, options, progress)
    for health in found:
        views.print_health(health)
    _exit_if_none(ctx, found, lost)
    rows = [row for health in found for row in health_rows(health)]
    write_text(options["out"], frame(COLUMNS["health"], rows).to_csv(index=False))
    if options["posterior"]:
        trees = [health.to_arviz() for health in found]
        write_draws(options["posterior"], [health.stage for health in found], trees)
    ctx.exit(SOME_REFUSED if lost else 0)


def _infer_machines(
    table: Path, options: dict[str, Any], progress: Callable[[str, int, int], None]
) -> tuple[list[Health], list[str]]:
    """Infer all machines of a table; return results, and reasons of those that have none."""
    from lmshealth.health.ensemble_sampling import seed_of
    from lmshealth.health.inference import epochs_to_infer, infer_together
    from lmshealth.health.inference import infer as infer_one
    from lmshealth.stage.description import load_stage

    stage = load_stage(options["stage"])
    machines = _read_drifts(table, options["cov"])
    if options["others"]:
        together = [(_single(table, machines), stage)]
        for path, reference in options["others"]:
            together.append((_single(path, _read_drifts(path, None)), load_stage(reference)))
        names = [f"{drifts.stage}\n{own.digest}" for drifts, own in together]
        epochs = epochs_to_infer(*together[0], options["epochs"])
        seed = seed_of(options["seed"], *names)
        mapper = _counting_map("together", progress)
        shared = options["shared"]
        return [infer_together(together, shared, seed, epochs=epochs, mapper=mapper)], []
    found, lost = [], []
    for drifts in machines:
        seed = seed_of(options["seed"], drifts.stage, stage.digest)
        try:
            epochs = epochs_to_infer(drifts, stage, options["epochs"])
            mapper = _counting_map(drifts.stage, progress)
            found.append(infer_one(drifts, stage, seed, epochs=epochs, mapper=mapper))
        except NotEnoughData as why:
            lost.append(str(why))
    return found, lost


def _counting_map(
    name: str, progress: Callable[[str, int, int], None]
) -> Callable[..., Iterator[Any]]:
    """Return a ``map`` that reports its progress."""

    def mapper(function: Callable[..., Any], *columns: Sequence[Any]) -> Iterator[Any]:
        total = len(columns[0])
        for k, result in enumerate(map(function, *columns)):
            progress(name, k + 1, total)
            yield result

    return mapper


def _read_drifts(table: Path, cov: Path | None) -> tuple[Drifts, ...]:
    from lmshealth.tracking.read_tables import read_drifts

    default = table.with_name("track_cov.csv")
    read = read_drifts(table, cross_terms=cov or (default if default.exists() else None))
    _print_notes([f"{table}: {note}" for note in read.notes])
    return read.entries


def _single(table: Path, machines: tuple[Drifts, ...]) -> Drifts:
    if len(machines) > 1:
        raise BadTable(
            f"{table}: {len(machines)} machines ({', '.join(m.stage for m in machines)}); needed "
            "is a table of the one that shares a part"
        )
    return machines[0]


@click.command(
    epilog=examples(
        "prognose result/modes.csv --stage lms-y --out prognosis.csv --by 2027-03-01",
        "prognose modes.csv --stage lms-y --out prognosis.csv --cost-ratio 20",
    )
)
@click.argument("table", metavar="MODES.csv", type=TABLE)
@REQUIRED_STAGE
@out_option("Table of the remaining life.")
@COV
@MAINTENANCE
@click.option("--posterior", type=OUT, help="Draws of the degradation laws, as NetCDF for ArviZ.")
@click.option(
    "--by",
    type=Day(),
    metavar="YYYY-MM-DD",
    help="Also give the probability that a limit is reached before this day.",
)
@click.option("--max-risk", type=SHARE, help="Service on the last day within this risk.")
@click.option(
    "--cost-ratio",
    type=Finite(1, min_open=True),
    help="Service at least cost, for this cost of a failure over that of a planned service.",
)
@SEED
@click.pass_context
def prognose(ctx: click.Context, /, table: Path, **options: Any) -> None:
    """Predict the remaining travel and time until each limit, and the service date.

    Modes are tracked first, as by `track`; outliers are left out. Every row needs travel_km.
    --max-risk and --cost-ratio replace [decision] of the stage description.
    """
    from lmshealth.prognosis.maintenance_decision import decide, probability_before
    from lmshealth.report.assessment import summarise_life
    from lmshealth.report.tables import COLUMNS, frame, prognosis_rows
    from lmshealth.stage.description import load_stage
    from lmshealth.tracking.history import missing_mode_notes

    stage = load_stage(options["stage"])
    decision = _decision(stage.description.decision, options)
    read = _read_machines(table, stage, options)
    _print_notes(read.notes)
    for history, refused in read.entries:
        _print_notes([f"{history.stage}: {n}" for n in missing_mode_notes(history, refused)])
    with progress_bars() as progress:
        histories = [history for history, _ in read.entries]
        found, lost = _prognose_machines(histories, stage, options, progress)
    rows = []
    for prognosis, _ in found:
        life, service = summarise_life(prognosis, stage), decide(prognosis, decision)
        day = _day_ahead(options["by"], prognosis)
        before = None if day is None else (day, probability_before(prognosis, day))
        views.print_life(life, service, before)
        rows += prognosis_rows(life, service, before)
    _exit_if_none(ctx, found, lost)
    write_text(options["out"], frame(COLUMNS["prognosis"], rows).to_csv(index=False))
    if options["posterior"]:
        trees = [posterior.to_arviz() for _, posterior in found if posterior is not None]
        write_draws(options["posterior"], [one.stage for one, _ in found], trees)
    ctx.exit(SOME_REFUSED if lost else 0)


def _day_ahead(by: datetime | None, prognosis: Prognosis) -> date | None:
    """Return the requested day; None, with a note, when it is not after the last log."""
    if by is None or by.date() > prognosis.recorded_at.date():
        return None if by is None else by.date()
    _print_notes(
        [
            f"{prognosis.stage}: --by {by.date()} is not after the last log "
            f"({prognosis.recorded_at.date()}): no probability is given for that day"
        ]
    )
    return None


def _decision(described: Decision, options: dict[str, Any]) -> Decision:
    """Return the rule of the service date: of the command line, else of the description."""
    from lmshealth.stage.description import Decision

    risk, ratio = options["max_risk"], options["cost_ratio"]
    if risk is not None and ratio is not None:
        raise click.UsageError("--max-risk and --cost-ratio each choose a date: give one of them")
    if risk is None and ratio is None:
        return described
    return Decision(max_risk=risk, cost_ratio=ratio, next_service=described.next_service)


def _prognose_machines(
    histories: list[History],
    stage: Stage,
    options: dict[str, Any],
    progress: Callable[[str, int, int], None],
) -> tuple[list[Prognosed], list[str]]:
    """Prognose all machines of a table; return results, and reasons of those that have none."""
    from lmshealth.health.ensemble_sampling import seed_of
    from lmshealth.prognosis.remaining_life import prognose_with_posterior
    from lmshealth.tracking.track import accepted_estimates
    from lmshealth.tracking.track import track as track_modes

    found: list[Prognosed] = []
    lost = []
    for k, history in enumerate(histories):
        try:
            if not history.has_odometer:
                raise NotEnoughData(
                    f"{history.stage}: not every log has travel_km; a remaining life is a travel, "
                    "so every row needs the odometer"
                )
            accepted = accepted_estimates(history, track_modes(history, stage))
            seed = seed_of(options["seed"], history.stage, stage.digest)
            prognosis, posterior = prognose_with_posterior(accepted, stage, seed)
            found.append((prognosis, posterior if options["posterior"] else None))
        except NotEnoughData as why:
            lost.append(str(why))
        except (NotConverged, LinAlgError) as why:
            lost.append(f"{history.stage}: {why}; check the units of odometer and frequencies")
        progress("prognosing", k + 1, len(histories))
    return found, lost


def _read_machines(table: Path, stage: Stage | None, options: dict[str, Any]) -> Machines:
    from lmshealth.tracking.read_tables import read_machines

    cov, maintenance = options["cov"], options["maintenance"]
    return read_machines(table, stage, cross_terms=cov, maintenance=maintenance)


def _print_notes(notes: Sequence[str]) -> None:
    for note in notes:
        click.echo(f"note: {note}", err=True)


def _exit_if_none(ctx: click.Context, found: Sequence[object], lost: Sequence[str]) -> None:
    """Print the reasons of machines without a result; exit with status 1 if none has one."""
    for why in lost:
        click.echo(f"lmshealth: {why}", err=True)
    if not found:
        ctx.exit(1)
