"""Commands that go on from tables instead of logs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lmshealth._files import write_draws, write_text
from lmshealth.cli import machineview, terminal
from lmshealth.cli.lifecommands import prognose
from lmshealth.cli.options import (
    COV,
    EPOCHS,
    MAINTENANCE,
    OUT,
    SEED,
    STAGE,
    TABLE,
    examples,
)
from lmshealth.cli.progress import progress_bars
from lmshealth.errors import BadTable, NotEnoughData

if TYPE_CHECKING:
    from lmshealth.health.results import Health
    from lmshealth.io.log import Refusal
    from lmshealth.report.tables import Row
    from lmshealth.tracking.history import History
    from lmshealth.tracking.read_tables import Drifts
    from lmshealth.tracking.smoother import Smoothed
    from lmshealth.tracking.track import Track

_TABLES = ("track", "track_cov", "effects", "events", "refused")


@click.command(
    epilog=examples(
        "track result/modes.csv --stage lms-y --out track.csv --events events.csv",
        "track other_program.csv --out track.csv --effects effects.csv --smooth",
    )
)
@click.argument("table", metavar="MODES.csv", type=TABLE)
@STAGE
@click.option("--out", required=True, type=OUT, help="Where the track goes.")
@COV
@MAINTENANCE
@click.option("--track-cov", type=OUT, help="Where the covariances of the drifts go.")
@click.option("--effects", type=OUT, help="Where go the effects of what is no wear.")
@click.option("--events", type=OUT, help="Where go steps, retunings and alarms.")
@click.option("--refused", type=OUT, help="Where goes what was given to no mode, and why.")
@click.option("--smooth", "smoothed", is_flag=True, help="Add columns that know of later logs.")
def track(table: Path, out: Path, **options: Any) -> None:
    """Follow modes through a table of estimates, ours or another program's.

    Needed are the columns recorded_at, frequency_hz and frequency_std_hz. The clock is travel_km
    where every row has it, else the time. Without a mode name modes are born from the estimates;
    without --stage every covariate column is regressed, about its median.
    """
    from lmshealth.stage.description import load_stage
    from lmshealth.tracking.read_tables import read_machines
    from lmshealth.tracking.smoother import smooth
    from lmshealth.tracking.track import accepted_estimates, outlier_refusals
    from lmshealth.tracking.track import track as follow

    stage = load_stage(options["stage"]) if options["stage"] else None
    read = read_machines(
        table, stage, cross_terms=options["cov"], maintenance=options["maintenance"]
    )
    rows: dict[str, list[Row]] = {name: [] for name in _TABLES}
    notes = list(read.notes)
    for history, lost in read.machines:
        followed = follow(history, stage)
        lost += outlier_refusals(history, followed)
        later = None
        if options["smoothed"]:
            later = smooth(accepted_estimates(history, followed), followed, stage)
        for name, found in _rows(followed, later, lost).items():
            rows[name] += found
        notes += _notes(history, lost)
        machineview.print_track(followed)
    for note in notes:
        click.echo(f"note: {note}", err=True)
    _write(rows, {"track": out} | {name: options[name] for name in _TABLES[1:]})


def _rows(track: Track, smoothed: Smoothed | None, refused: list[Refusal]) -> dict[str, list[Row]]:
    """Give the rows of all tables that can be asked for."""
    from lmshealth.report import tables

    return {
        "track": tables.track_rows(track, smoothed),
        "track_cov": tables.track_cov_rows(track),
        "effects": tables.effects_rows(track),
        "events": tables.events_rows(track),
        "refused": tables.refused_rows(refused),
    }


def _notes(history: History, refused: list[Refusal]) -> list[str]:
    """Say what the reader of a track must know of its machine."""
    from lmshealth.tracking.history import missing_mode_notes

    notes = [f"{history.stage}: {note}" for note in missing_mode_notes(history, refused)]
    if not history.has_odometer:
        notes.append(f"{history.stage}: not every log has travel_km, so the clock is the time")
    if len(history.logs) == 1:
        notes.append(f"{history.stage}: one log is the baseline; nothing can have drifted yet")
    reasons = Counter(refusal.reason for refusal in refused)
    if reasons:
        told = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
        notes.append(f"{history.stage}: not believed: {told}; --refused FILE lists them")
    return notes


def _write(rows: dict[str, list[Row]], targets: dict[str, Path | None]) -> None:
    """Write the tables that were asked for."""
    from lmshealth.report.tables import COLUMNS, frame

    for name, target in targets.items():
        if target is None:
            continue
        write_text(target, frame(COLUMNS[name], rows[name]).to_csv(index=False))


@click.command(
    epilog=examples(
        "infer result/track.csv --stage lms-y --out health.csv --posterior health.nc",
        "infer y/track.csv --stage lms-y --with x/track.csv lms-x --shared guide_preload "
        "--out health.csv",
    )
)
@click.argument("table", metavar="TRACK.csv", type=TABLE)
@click.option("--stage", required=True, help="Stage description: a .toml file or a shipped name.")
@click.option("--out", required=True, type=OUT, help="Where the health goes.")
@click.option("--cov", type=TABLE, help="Cross terms; default track_cov.csv beside TRACK.csv.")
@click.option("--posterior", type=OUT, help="Where all draws go, as NetCDF that ArviZ reads.")
@click.option(
    "--with",
    "others",
    type=(TABLE, str),
    multiple=True,
    metavar="TRACK.csv STAGE",
    help="Another machine that shares a part with the first; see --shared.",
)
@click.option(
    "--shared", multiple=True, metavar="PARAMETER", help="What the machines have in common."
)
@EPOCHS
@SEED
@click.pass_context
def infer(ctx: click.Context, /, table: Path, **options: Any) -> None:
    """Infer what is left of the health parameters, epoch by epoch, from a track.

    Needed are the columns recorded_at, mode, drift and drift_std of a table in the form of
    track.csv. With --with and --shared, machines that share a part, such as one guide in two
    configurations, are inferred together at the epochs of the first.
    """
    from lmshealth.report.tables import COLUMNS, frame, health_rows

    if bool(options["others"]) != bool(options["shared"]):
        raise click.UsageError("--with and --shared need each other: which parameter is shared?")
    with progress_bars() as progress:
        found, lost = _inferred(table, options, progress)
    for health in found:
        machineview.print_health(health)
    for why in lost:
        click.echo(f"lmshealth: {why}", err=True)
    if not found:
        ctx.exit(1)
    rows = [row for health in found for row in health_rows(health)]
    write_text(options["out"], frame(COLUMNS["health"], rows).to_csv(index=False))
    if options["posterior"]:
        trees = [health.to_arviz() for health in found]
        write_draws(options["posterior"], [health.stage for health in found], trees)
    ctx.exit(3 if lost else 0)


def _inferred(
    table: Path, options: dict[str, Any], progress: Callable[[str, int, int], None]
) -> tuple[list[Health], list[str]]:
    """Infer all machines of a table; one that cannot be is told and left out."""
    from lmshealth.health.ensemble_sampling import seed_of
    from lmshealth.health.inference import epochs_to_infer, infer_together
    from lmshealth.health.inference import infer as infer_one
    from lmshealth.stage.description import load_stage

    stage = load_stage(options["stage"])
    machines = _drifts(table, options["cov"])
    if options["others"]:
        together = [(_only(table, machines), stage)]
        for path, reference in options["others"]:
            together.append((_only(path, _drifts(path, None)), load_stage(reference)))
        names = [f"{drifts.stage}\n{own.digest}" for drifts, own in together]
        epochs = epochs_to_infer(*together[0], options["epochs"])
        seed = seed_of(options["seed"], *names)
        mapper = _counted("together", progress)
        shared = options["shared"]
        return [infer_together(together, shared, seed, epochs=epochs, mapper=mapper)], []
    found, lost = [], []
    for drifts in machines:
        seed = seed_of(options["seed"], drifts.stage, stage.digest)
        try:
            epochs = epochs_to_infer(drifts, stage, options["epochs"])
            mapper = _counted(drifts.stage, progress)
            found.append(infer_one(drifts, stage, seed, epochs=epochs, mapper=mapper))
        except NotEnoughData as why:
            lost.append(str(why))
    return found, lost


def _counted(what: str, progress: Callable[[str, int, int], None]) -> Callable[..., Iterator[Any]]:
    """Make a ``map`` that tells how much of it is done."""

    def mapper(function: Callable[..., Any], *columns: Sequence[Any]) -> Iterator[Any]:
        total = len(columns[0])
        for k, result in enumerate(map(function, *columns)):
            progress(what, k + 1, total)
            yield result

    return mapper


def _drifts(table: Path, cov: Path | None) -> tuple[Drifts, ...]:
    from lmshealth.tracking.read_tables import read_drifts

    beside = table.with_name("track_cov.csv")
    read = read_drifts(table, cross_terms=cov or (beside if beside.exists() else None))
    for note in read.notes:
        click.echo(f"note: {table}: {note}", err=True)
    return read.machines


def _only(table: Path, machines: tuple[Drifts, ...]) -> Drifts:
    if len(machines) > 1:
        raise BadTable(
            f"{table}: {len(machines)} machines ({', '.join(m.stage for m in machines)}); needed "
            "is a table of the one that shares a part"
        )
    return machines[0]


@click.command(epilog=examples("stage lms-y", "stage my-stage.toml --format json"))
@click.argument("reference", metavar="STAGE")
@click.option(
    "--format", "style", type=click.Choice(["table", "json"]), default="table", show_default=True
)
def stage(reference: str, style: str) -> None:
    """Check a stage description, and say what its modes can tell.

    STAGE is a .toml file or a shipped name. A slip is told with its line and key. Else: how far the
    modal map reaches, how good its surrogate is, what the parameters do to the modes, and which of
    them logs can tell, at best (the Cramér-Rao bound of vibration at constant velocity).
    """
    from lmshealth.cli.stageview import print_stage
    from lmshealth.report.tables import stage_rows
    from lmshealth.stage.check import check_stage, diagnose
    from lmshealth.stage.description import load_stage

    examined = check_stage(load_stage(reference))
    content = stage_rows(examined, diagnose(examined))
    if style == "json":
        terminal.print_json(content)
    else:
        print_stage(content)


COMMANDS: Sequence[click.Command] = (track, infer, prognose, stage)
