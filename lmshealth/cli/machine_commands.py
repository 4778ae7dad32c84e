"""Commands that continue from tables of estimates: track, infer, prognose."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from msgspec.structs import replace
from numpy.linalg import LinAlgError

from lmshealth._private.files import write_draws, write_text
from lmshealth._private.serialize import seed_of
from lmshealth._private.tables import Row
from lmshealth.cli import options, views
from lmshealth.cli.terminal import (
    PATIENCE,
    Report,
    counted,
    print_errors,
    print_notes,
    progress_bars,
)
from lmshealth.errors import NotConverged, NotEnoughData
from lmshealth.io.log import Refusal, utc_day
from lmshealth.life.health import Health, epochs_to_publish, health_of, infer_drifts
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.life.prognosis import prognosis_of
from lmshealth.life.verdict import doubt_of_names
from lmshealth.machine.service import decide, probability_before, without_limits
from lmshealth.machine.summary import prognosis_rows, summarise_life
from lmshealth.report import tables
from lmshealth.stage.constants import MOST_COST_RATIO, RISK
from lmshealth.stage.description import Decision
from lmshealth.tracking.contradictions import LEFT_OUT
from lmshealth.tracking.covariates import covariate_notices
from lmshealth.tracking.history import (
    History,
    contradiction_notices,
    doubt_of_clock,
    missing_mode_notices,
)
from lmshealth.tracking.maintenance import Maintenance, maintenance_notices, read_work, restored
from lmshealth.tracking.read_tables import has_drifts, read_drifts, read_machines
from lmshealth.tracking.track import accepted_estimates, outlier_refusals, smooth
from lmshealth.tracking.track import track as track_modes

Machine = tuple[History, list[Refusal]]


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
def track(table: Path, **given: Any) -> int:
    """Track modes through a table of estimates of lmshealth or another program.

    Required columns: recorded_at, frequency_hz and frequency_std_hz. The clock is travel_km when
    every row has it, else the time. Without mode names the modes are found from the estimates;
    without --stage every covariate column is regressed about its median.
    """
    stage, targets = given["stage"], given | {"track": given["out"]}
    machines, notes, _ = _read(table, given)
    made: list[dict[str, list[Row]]] = []
    with progress_bars(PATIENCE) as progress:
        each = counted(progress, "tracking", machines)
        tracked = [track_modes(history, stage) for history, _ in each]
    for (history, refused), found in zip(machines, tracked, strict=True):
        smoothed = None
        refused += outlier_refusals(history, found, stage)
        if given["smoothed"]:
            smoothed = smooth(accepted_estimates(history, found), found, stage)
        made.append(
            tables.track_tables(found, smoothed) | {"refused": tables.refused_rows(refused)}
        )
        notes += _notes(history, refused)
        views.print_track(found)
    print_notes(notes)
    for name in ("track", "track_cov", "effects", "events", "refused"):
        if targets[name]:
            rows = [row for own in made for row in own[name]]
            write_text(targets[name], tables.csv_text(name, rows))
    return options.SOME_REFUSED if _some_left_out(machines) else 0


def _some_left_out(machines: Sequence[Machine]) -> bool:
    """Return whether a log as a whole was refused."""
    return any(one.reason in LEFT_OUT for _, refused in machines for one in refused)


def _read(table: Path, given: dict[str, Any]) -> tuple[list[Machine], list[str], Maintenance]:
    """Read the machines of a table of estimates, notes on them, and the maintenance of all."""
    latest = given["latest"]
    work = read_work(given["maintenance"], latest)
    how = {"cross_terms": given["cov"], "work": work, "latest": latest}
    return *read_machines(table, given["stage"], **how), work


def _notes(history: History, refused: list[Refusal]) -> list[str]:
    """Return what the reader of a track must take into account."""
    notes = [notice.what for notice in missing_mode_notices(history, refused)]
    notes += map(str, contradiction_notices(history, refused))
    if not history.has_odometer:
        notes.append("not every log has travel_km: the clock is the time")
    if len(history.logs) == 1:
        notes.append("a single log is the baseline: no drift yet")
    if reasons := Counter(refusal.reason for refusal in refused):
        listed = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
        notes.append(f"refused: {listed}; --refused FILE lists them")
    return [f"{history.stage}: {note}" for note in notes]


@options.command(
    "infer result/modes.csv --stage lms-y --out health.csv --posterior health.nc",
    "infer drifts.csv --stage lms-y --out health.csv",
)
@click.argument("table", metavar="MODES.csv", type=options.TABLE)
@options.stage_option(required=True)
@options.out_option(help="Table of the health parameters.")
@options.COV
@options.MAINTENANCE
@click.option("--posterior", type=options.OUT, help="All draws, as NetCDF for ArviZ.")
@options.ALLOW_FUTURE
@options.EPOCHS
@options.SEED
def infer(table: Path, **given: Any) -> int:
    """Infer the health parameters from a table of estimates, by all logs of a life.

    Modes are tracked first, as by `track`; outliers are left out. Every row needs travel_km. From a
    table with the columns drift and drift_std, as of track.csv, each epoch is inferred from its own
    drifts alone, since they are filtered; --cov has their covariances, by default track_cov.csv in
    the same folder.
    """
    with progress_bars(PATIENCE) as progress:
        machines: list[Machine] = []
        if has_drifts(table):
            found, lost = _infer_drifts(table, given, progress)
        else:
            machines, _ = _machines(table, given)
            lives, lost = _lives(machines, given, progress)
            found = []
            for history, life in lives:
                epochs = epochs_to_publish(history, given["stage"], given["epochs"])
                found.append(health_of(life, history, given["stage"], epochs))
    for health in found:
        views.print_health(health)
    rows = [row for health in found for row in tables.to_rows(health.to_columns())]
    return _finish(
        given, "health", rows, {health.stage: health for health in found}, lost, machines
    )


def _infer_drifts(
    table: Path, given: dict[str, Any], progress: Report
) -> tuple[list[Health], list[str]]:
    """Infer all machines of a table of drifts; return results, and reasons of those without."""
    stage, found, lost = given["stage"], [], []
    if given["maintenance"]:
        raise click.UsageError("--maintenance belongs to a table of estimates: this has drifts")
    default = table.with_name("track_cov.csv")
    terms = given["cov"] or (default if default.exists() else None)
    machines, notes = read_drifts(table, cross_terms=terms, latest=given["latest"])
    print_notes(f"{table}: {note}" for note in notes)
    known = {mode.name for mode in stage.modes}
    for drifts in counted(progress, "inferring", machines):
        strange = sorted(set(drifts.modes) - known)
        if strange and known & set(drifts.modes):  # else health would silently do without them
            why = f"modes {strange} are none of {stage.name}, which has {sorted(known)}"
            lost.append(f"{drifts.stage}: {why}; rename them, or leave their rows out")
            continue
        seed = seed_of(given["seed"], drifts.stage, stage.digest)
        try:
            found.append(infer_drifts(drifts, stage, seed, epochs=given["epochs"]))
        except (NotEnoughData, NotConverged) as why:
            lost.append(str(why))
    return found, lost


def _machines(table: Path, given: dict[str, Any]) -> tuple[list[Machine], Maintenance]:
    """Read machines and their maintenance, and print what the table of estimates lacks."""
    machines, notes, work = _read(table, given)
    print_notes(notes)
    for history, refused in machines:
        found = maintenance_notices(work.of(history.stage), history.recorded_at)
        found += missing_mode_notices(history, refused)
        found += contradiction_notices(history, refused)
        found += covariate_notices(history.covariates, given["stage"])
        # What is serious is printed as the reason why there is no life.
        print_notes(f"{history.stage}: {one}" for one in found if one.severity != "serious")
    return machines, work


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
def prognose(table: Path, **given: Any) -> int:
    """Predict the remaining travel and time until each limit, and the service date.

    Modes are tracked first, as by `track`; outliers are left out. Every row needs travel_km. Limits
    that work after the last log has restored are left out (--maintenance), unless these are all.
    --max-risk and --cost-ratio replace [decision] of the stage description.
    """
    stage, by = given["stage"], given["by"]
    decision = _decision(stage.description.decision, given["max_risk"], given["cost_ratio"])
    with progress_bars(PATIENCE) as progress:
        machines, work = _machines(table, given)
        lives, lost = _lives(machines, given, progress)
    found, rows = [], []
    for history, posterior in lives:
        try:
            found.append((prognosis_of(posterior, history, stage), posterior))
        except NotEnoughData as why:
            lost.append(str(why))
    words = {one.name: one.word for one in stage.parameters}
    for prognosis, _ in found:
        done = work.of(prognosis.stage).since(prognosis.recorded_at)
        left = without_limits(prognosis, restored(words, done))
        shown, last = left or prognosis, utc_day(prognosis.recorded_at)
        life, service = summarise_life(shown, stage, whole=prognosis), decide(left, decision)
        before = None
        if by is not None and by > last:
            before = by, probability_before(shown, by)
        elif by is not None:
            note = f"{life.stage}: --by {by} is not after the last log ({last}): no probability"
            print_notes([f"{note} is given for that day"])
        views.print_life(life, service, before)
        rows += prognosis_rows(life, service, before)
    draws = {prognosis.stage: posterior for prognosis, posterior in found}
    return _finish(given, "prognosis", rows, draws, lost, machines)


def _decision(described: Decision, risk: float | None, ratio: float | None) -> Decision:
    """Return the rule of the service date: of the command line, else of the description."""
    if risk is not None and ratio is not None:
        raise click.UsageError("--max-risk and --cost-ratio each choose a date: give one of them")
    if risk is None and ratio is None:
        return described
    return replace(described, max_risk=risk, cost_ratio=ratio)


def _lives(
    machines: list[Machine], given: dict[str, Any], progress: Report
) -> tuple[list[tuple[History, LifePosterior]], list[str]]:
    """Fit the lives of all machines; return them with accepted logs, and reasons of the others."""
    found, lost, stage = [], [], given["stage"]
    for history, refused in counted(progress, "sampling", machines):
        try:
            tracked = track_modes(history, stage)
            doubt = doubt_of_clock(history, refused) or doubt_of_names(stage, history, tracked)
            if doubt:
                raise NotEnoughData(f"{history.stage}: {doubt}")
            accepted = accepted_estimates(history, tracked, doubtful=True)
            seed = seed_of(given["seed"], history.stage, stage.digest)
            found.append((accepted, fit_life(accepted, stage, seed)))
        except NotEnoughData as why:
            lost.append(str(why))
        except (NotConverged, LinAlgError) as why:
            lost.append(f"{history.stage}: {why}; check the units of odometer and frequencies")
    return found, lost


def _finish(
    given: dict[str, Any],
    name: str,
    rows: list[Row],
    draws: Mapping[str, Any],
    lost: Sequence[str],
    machines: Sequence[Machine],
) -> int:
    """Write the table and the draws of each machine, and print why others have none.

    Return the exit status.
    """
    print_errors(lost)
    if not rows:
        return 1
    write_text(given["out"], tables.csv_text(name, rows))
    if given["posterior"]:
        trees = [posterior.to_arviz() for posterior in draws.values()]
        write_draws(given["posterior"], list(draws), trees)
    return options.SOME_REFUSED if lost or _some_left_out(machines) else 0
