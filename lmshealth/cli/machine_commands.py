"""Commands that continue from tables of estimates: track, infer, prognose."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import click
from msgspec.structs import replace
from numpy.linalg import LinAlgError

from lmshealth._private.files import write_draws, write_text
from lmshealth._private.seeds import seed_of
from lmshealth._private.tables import Row
from lmshealth.cli import options, views
from lmshealth.cli.terminal import PATIENCE, print_errors, print_notes, progress_bars
from lmshealth.errors import BadTable, NotConverged, NotEnoughData
from lmshealth.health.inference import epochs_to_infer, infer_together
from lmshealth.health.inference import infer as infer_health
from lmshealth.health.results import Health
from lmshealth.health.verdict import doubt_of_names
from lmshealth.io.log import Refusal
from lmshealth.prognosis.life_posterior import LifePosterior
from lmshealth.prognosis.maintenance_decision import decide, probability_before
from lmshealth.prognosis.remaining_life import prognose_with_posterior
from lmshealth.prognosis.results import Prognosis
from lmshealth.report import tables
from lmshealth.report.assessment import summarise_life
from lmshealth.stage.constants import MOST_COST_RATIO, RISK
from lmshealth.stage.description import Decision, load_stage
from lmshealth.tracking.history import History, missing_mode_notices
from lmshealth.tracking.read_tables import Drifts, read_drifts, read_machines
from lmshealth.tracking.smoother import smooth
from lmshealth.tracking.track import accepted_estimates, outlier_refusals
from lmshealth.tracking.track import track as track_modes

Progress = Callable[[str, int, int], None]
_TABLES = ("track", "track_cov", "effects", "events", "refused")


@options.command(
    "track result/modes.csv --stage lms-y --out track.csv --events events.csv",
    "track other_program.csv --out track.csv --effects effects.csv --smooth",
)
@click.argument("table", metavar="MODES.csv", type=options.TABLE)
@options.stage_option()
@options.out_option(help="Table of the track.")
@options.COV
@options.MAINTENANCE
@options.ALLOW_FUTURE
@click.option("--track-cov", type=options.OUT, help="Table of the covariances of the drifts.")
@click.option("--effects", type=options.OUT, help="Table of effects other than wear.")
@click.option(
    "--events", type=options.OUT, help="Table of steps, changes of servo tuning and alarms."
)
@click.option(
    "--refused", type=options.OUT, help="Table of the estimates assigned to no mode, with reasons."
)
@click.option(
    "--smooth", "smoothed", is_flag=True, help="Add smoothed columns, which also use later logs."
)
def track(table: Path, **given: Any) -> None:
    """Track modes through a table of estimates of lmshealth or another program.

    Required columns: recorded_at, frequency_hz and frequency_std_hz. The clock is travel_km when
    every row has it, else the time. Without mode names the modes are found from the estimates;
    without --stage every covariate column is regressed about its median.
    """
    stage, targets = given["stage"], given | {"track": given["out"]}
    machines, notes = read_machines(table, stage, **_reading(given))
    rows: dict[str, list[Row]] = {name: [] for name in _TABLES}
    tracked = []
    with progress_bars(PATIENCE) as progress:
        for k, (history, _) in enumerate(machines):
            progress("tracking", k, len(machines))
            tracked.append(track_modes(history, stage))
        progress("tracking", len(machines), len(machines))
    for (history, refused), found in zip(machines, tracked, strict=True):
        smoothed = None
        refused += outlier_refusals(history, found)
        if given["smoothed"]:
            smoothed = smooth(accepted_estimates(history, found), found, stage)
        own = tables.track_tables(found, smoothed) | {"refused": tables.refused_rows(refused)}
        for name in _TABLES:
            rows[name] += own[name]
        notes += _notes(history, refused)
        views.print_track(found)
    print_notes(notes)
    for name in _TABLES:
        if targets[name]:
            write_text(targets[name], tables.csv_text(name, rows[name]))


def _reading(given: dict[str, Any]) -> dict[str, Any]:
    """Return the options of `read_machines`."""
    names = {"cross_terms": "cov", "maintenance": "maintenance", "latest": "latest"}
    return {name: given[option] for name, option in names.items()}


def _notes(history: History, refused: list[Refusal]) -> list[str]:
    """Return what the reader of a track must take into account."""
    notes = [notice.what for notice in missing_mode_notices(history, refused)]
    if not history.has_odometer:
        notes.append("not every log has travel_km: the clock is the time")
    if len(history.logs) == 1:
        notes.append("a single log is the baseline: no drift yet")
    reasons = Counter(refusal.reason for refusal in refused)
    if reasons:
        listed = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
        notes.append(f"refused: {listed}; --refused FILE lists them")
    return [f"{history.stage}: {note}" for note in notes]


@options.command(
    "infer result/track.csv --stage lms-y --out health.csv --posterior health.nc",
    "infer y/track.csv --stage lms-y --with x/track.csv lms-x --shared guide_preload "
    "--out health.csv",
)
@click.argument("table", metavar="TRACK.csv", type=options.TABLE)
@options.stage_option(required=True)
@options.out_option(help="Table of the health parameters.")
@click.option(
    "--cov",
    type=options.TABLE,
    help="Covariances of the drifts; default track_cov.csv in the same folder.",
)
@click.option("--posterior", type=options.OUT, help="All draws, as NetCDF for ArviZ.")
@click.option(
    "--with",
    "others",
    type=(options.TABLE, load_stage),
    multiple=True,
    metavar="TRACK.csv STAGE",
    help="Another machine that shares a part with the first; see --shared.",
)
@click.option(
    "--shared",
    multiple=True,
    callback=options.once,
    metavar="PARAMETER",
    help="Parameter that the machines share.",
)
@options.ALLOW_FUTURE
@options.EPOCHS
@options.SEED
@click.pass_context
def infer(ctx: click.Context, /, table: Path, **given: Any) -> None:
    """Infer the health parameters from a track, epoch by epoch.

    Required columns: recorded_at, mode, drift and drift_std, as in track.csv. With --with and
    --shared, machines that share a part (such as one guide in two configurations) are inferred
    together, at the epochs of the first.
    """
    if bool(given["others"]) != bool(given["shared"]):
        raise click.UsageError("--with and --shared need each other: which parameter is shared?")
    tables_of = Counter(path.resolve() for path in (table, *(path for path, _ in given["others"])))
    if repeated := [str(path) for path, times in tables_of.items() if times > 1]:
        raise click.UsageError(f"{', '.join(repeated)} is named twice: its data would count twice.")
    with progress_bars(PATIENCE) as progress:
        found, lost = _infer_machines(table, given, progress)
    for health in found:
        views.print_health(health)
    rows = [row for health in found for row in tables.to_rows(health.to_columns())]
    _finish(ctx, "health", rows, {health.stage: health for health in found}, lost)


def _infer_machines(
    table: Path, given: dict[str, Any], progress: Progress
) -> tuple[list[Health], list[str]]:
    """Infer all machines of a table; return results, and reasons of those that have none."""
    stage, latest = given["stage"], given["latest"]
    machines = _read_drifts(table, given["cov"], latest)
    if given["others"]:
        others = [
            (_single(path, _read_drifts(path, None, latest)), own) for path, own in given["others"]
        ]
        together = [(_single(table, machines), stage), *others]
        names = [f"{drifts.stage}\n{own.digest}" for drifts, own in together]
        seed = seed_of(given["seed"], *names)
        epochs = epochs_to_infer(*together[0], given["epochs"])
        mapper = partial(_counting_map, "together", progress)
        return [infer_together(together, given["shared"], seed, epochs=epochs, mapper=mapper)], []
    found, lost = [], []
    known = {mode.name for mode in stage.modes}
    for drifts in machines:
        strange = sorted(set(drifts.modes) - known)
        if strange and known & set(drifts.modes):  # else health would silently do without them
            why = f"modes {strange} are none of {stage.name}, which has {sorted(known)}"
            lost.append(f"{drifts.stage}: {why}; rename them, or leave their rows out")
            continue
        seed = seed_of(given["seed"], drifts.stage, stage.digest)
        try:
            epochs = epochs_to_infer(drifts, stage, given["epochs"])
            mapper = partial(_counting_map, drifts.stage, progress)
            found.append(infer_health(drifts, stage, seed, epochs=epochs, mapper=mapper))
        except NotEnoughData as why:
            lost.append(str(why))
    return found, lost


def _counting_map(
    name: str, progress: Progress, function: Callable[..., Any], *columns: Sequence[Any]
) -> Iterator[Any]:
    """Map a function as ``map`` does, and report the progress."""
    for k, result in enumerate(map(function, *columns)):
        progress(name, k + 1, len(columns[0]))
        yield result


def _read_drifts(table: Path, cov: Path | None, latest: datetime | None) -> list[Drifts]:
    default = table.with_name("track_cov.csv")
    terms = cov or (default if default.exists() else None)
    found, notes = read_drifts(table, cross_terms=terms, latest=latest)
    print_notes(f"{table}: {note}" for note in notes)
    return found


def _single(table: Path, machines: list[Drifts]) -> Drifts:
    if len(machines) > 1:
        found = f"{len(machines)} machines ({', '.join(m.stage for m in machines)})"
        raise BadTable(f"{table}: {found}; needed is a table of the one that shares a part")
    return machines[0]


@options.command(
    "prognose result/modes.csv --stage lms-y --out prognosis.csv --by 2027-03-01",
    "prognose modes.csv --stage lms-y --out prognosis.csv --cost-ratio 20",
)
@click.argument("table", metavar="MODES.csv", type=options.TABLE)
@options.stage_option(required=True)
@options.out_option(help="Table of the remaining life.")
@options.COV
@options.MAINTENANCE
@options.ALLOW_FUTURE
@click.option(
    "--posterior", type=options.OUT, help="Draws of the degradation laws, as NetCDF for ArviZ."
)
@click.option(
    "--by",
    type=options.day,
    metavar="YYYY-MM-DD",
    help="Also give the probability that a limit is reached before this day.",
)
@click.option(
    "--max-risk", type=options.Finite(*RISK), help="Service on the last day within this risk."
)
@click.option(
    "--cost-ratio",
    type=options.Finite(1, MOST_COST_RATIO, min_open=True),
    help="Service at least cost, for this cost of a failure over that of a planned service.",
)
@options.SEED
@click.pass_context
def prognose(ctx: click.Context, /, table: Path, **given: Any) -> None:
    """Predict the remaining travel and time until each limit, and the service date.

    Modes are tracked first, as by `track`; outliers are left out. Every row needs travel_km.
    --max-risk and --cost-ratio replace [decision] of the stage description.
    """
    stage, by = given["stage"], given["by"]
    decision = _decision(stage.description.decision, given["max_risk"], given["cost_ratio"])
    machines, notes = read_machines(table, stage, **_reading(given))
    print_notes(notes)
    for history, refused in machines:
        missing = missing_mode_notices(history, refused)
        print_notes(f"{history.stage}: {notice.what}" for notice in missing)
    with progress_bars(PATIENCE) as progress:
        progress("prognosing", 0, len(machines))
        found, lost = _prognose_machines([history for history, _ in machines], given, progress)
    rows = []
    for prognosis, _ in found:
        life, service, before = summarise_life(prognosis, stage), decide(prognosis, decision), None
        last = prognosis.recorded_at.date()
        if by is not None and by > last:
            before = by, probability_before(prognosis, by)
        elif by is not None:
            note = f"{life.stage}: --by {by} is not after the last log ({last}): no probability"
            print_notes([f"{note} is given for that day"])
        views.print_life(life, service, before)
        rows += tables.prognosis_rows(life, service, before)
    _finish(ctx, "prognosis", rows, {one.stage: posterior for one, posterior in found}, lost)


def _decision(described: Decision, risk: float | None, ratio: float | None) -> Decision:
    """Return the rule of the service date: of the command line, else of the description."""
    if risk is not None and ratio is not None:
        raise click.UsageError("--max-risk and --cost-ratio each choose a date: give one of them")
    if risk is None and ratio is None:
        return described
    return replace(described, max_risk=risk, cost_ratio=ratio)


def _prognose_machines(
    histories: list[History], given: dict[str, Any], progress: Progress
) -> tuple[list[tuple[Prognosis, LifePosterior | None]], list[str]]:
    """Prognose all machines of a table; return results, and reasons of those that have none."""
    found, lost, stage = [], [], given["stage"]
    for k, history in enumerate(histories):
        try:
            tracked = track_modes(history, stage)
            if doubt := doubt_of_names(stage, history, tracked):
                raise NotEnoughData(f"{history.stage}: {doubt}")
            accepted = accepted_estimates(history, tracked)
            seed = seed_of(given["seed"], history.stage, stage.digest)
            prognosis, posterior = prognose_with_posterior(accepted, stage, seed)
            found.append((prognosis, posterior if given["posterior"] else None))
        except NotEnoughData as why:
            lost.append(str(why))
        except (NotConverged, LinAlgError) as why:
            lost.append(f"{history.stage}: {why}; check the units of odometer and frequencies")
        progress("prognosing", k + 1, len(histories))
    return found, lost


def _finish(
    ctx: click.Context, name: str, rows: list[Row], draws: Mapping[str, Any], lost: Sequence[str]
) -> None:
    """Write the table and the draws of each machine, print why others have none, and exit."""
    print_errors(lost)
    if not rows:
        ctx.exit(1)
    write_text(ctx.params["out"], tables.csv_text(name, rows))
    if ctx.params["posterior"]:
        trees = [posterior.to_arviz() for posterior in draws.values()]
        write_draws(ctx.params["posterior"], list(draws), trees)
    ctx.exit(options.SOME_REFUSED if lost else 0)
