"""The command line: what a user types, and nothing else."""

from __future__ import annotations

import os

# Matrices here are small: threads inside linear algebra only get in the way of the processes.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lmshealth.cli import logview, planview, terminal
from lmshealth.cli.batchcommands import report, run
from lmshealth.cli.commands import COMMANDS
from lmshealth.cli.options import (
    DETECT,
    FORMAT,
    LOGS,
    PART,
    SHARE,
    STAGE,
    checked_band,
    examples,
    reading_options,
)
from lmshealth.errors import BadLog, LmshealthError
from lmshealth.io.log import Log, Refusal

if TYPE_CHECKING:
    from lmshealth.io.column_map import ColumnMap
    from lmshealth.io.manifest import Manifest
    from lmshealth.stage.description import Stage

Result = TypeVar("Result")

_DONE, _FAILED, _SOME_REFUSED = 0, 1, 3


_NO_BAND = (
    "Without a band or a description close modes may be merged or missed; look closer with --band "
    "LOW HIGH. Names hold for this call only."
)


class _Group(click.Group):
    """Turn our errors into one line on standard error and exit status 1."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except LmshealthError as error:
            click.echo(f"lmshealth: {error}", err=True)
            ctx.exit(_FAILED)
        except OSError as error:
            click.echo(f"lmshealth: {error.filename or 'output'}: {error.strerror}", err=True)
            ctx.exit(_FAILED)
        except KeyboardInterrupt:
            click.echo("lmshealth: interrupted; run again to go on", err=True)
            ctx.exit(_FAILED)


@click.group(
    cls=_Group,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit status: 0 done, 1 failed (one line on standard error says why), 2 wrong usage, "
    "3 done but some logs were refused.",
)
@click.version_option(package_name="lmshealth")
def main() -> None:
    """Tell how much guide preload and mount stiffness a linear-motor stage has left."""


@main.command(
    epilog=examples(
        "modes log.h5 --stage lms-y",
        "modes export.csv --columns map.toml --band 80 200 --format json",
        "modes moves.h5 --stage lms-y --part settling",
    )
)
@LOGS
@STAGE
@click.option(
    "--part",
    type=click.Choice(["constant", "settling"]),
    default="constant",
    show_default=True,
    help="Use what vibrates at constant velocity, or all of a log that never moves; or what "
    "decays after the moves.",
)
@reading_options
@click.option("--channels", help="Use only these channels, separated by commas.")
@click.option("--band", nargs=2, type=float, metavar="LOW HIGH", help="Use only this band, in Hz.")
@FORMAT
@click.pass_context
def modes(ctx: click.Context, /, logs: tuple[Path, ...], style: str, **options: Any) -> None:
    """Identify the modes of single logs: frequency and damping with their uncertainty."""
    from lmshealth.modal.free_decay.identification import identify_decays
    from lmshealth.modal.identification import identify
    from lmshealth.report.tables import COLUMNS, frame, lines_rows, modes_rows, refused_rows
    from lmshealth.signal.following_error import loop_error
    from lmshealth.tracking.history import LogEstimates

    look = identify_decays if options["part"] == "settling" else identify
    stage, columns = _loaded(options["stage"], options["columns"])
    band = checked_band(options["band"])
    channels = (
        [name.strip() for name in options["channels"].split(",")] if (options["channels"]) else None
    )
    found, lost = _each(
        logs,
        columns,
        lambda log: LogEstimates(
            log.name,
            log.digest,
            log.metadata,
            look(log, stage, channels=channels, band=band),
            loop_error(log),
        ),
    )
    rows = [row for reading in found for row in modes_rows(reading)]
    doubted = [r for reading in found for r in reading.modes.refused]
    refused = refused_rows([*lost, *doubted])
    if style == "csv":
        click.echo(frame(COLUMNS["modes"], rows).to_csv(index=False), nl=False)
    elif style == "json":
        lines = [{"log": r.log, **row} for r in found for row in lines_rows(r.modes.lines)]
        terminal.print_json({"modes": rows, "lines": lines, "refused": refused})
    elif found:
        logview.print_modes(rows, refused_rows(doubted))
        if rows and stage is None and band is None:
            terminal.print_text(_NO_BAND)
    _exit(ctx, found, lost)


@main.command(
    epilog=examples(
        "error velocities/*.h5",
        "error log.h5 --count 20 --floor-nm 50 --part settling --format json",
    )
)
@LOGS
@click.option(
    "--count",
    type=click.IntRange(1),
    default=100,
    show_default=True,
    help="Keep so many of the strongest harmonics.",
)
@click.option(
    "--floor-nm",
    type=click.FloatRange(0),
    default=30.0,
    show_default=True,
    help="Then count those above this amplitude.",
)
@PART
@reading_options
@FORMAT
@click.pass_context
def error(ctx: click.Context, /, logs: tuple[Path, ...], style: str, **options: Any) -> None:
    """Read the following error: statistics, strongest harmonics, bandwidth, maximum magnitude.

    Statistics are those of all samples, harmonics those of the longest stretch without gaps; json
    lists each of them. Their cosines, added up, rebuild the following error.
    """
    from lmshealth.report.tables import LOG_COLUMNS, error_row, frame, harmonics_rows, refused_rows
    from lmshealth.signal.following_error import read_error

    _, columns = _loaded(None, options["columns"])
    count, floor = options["count"], 1e-9 * options["floor_nm"]
    found, lost = _each(
        logs,
        columns,
        lambda log: (
            log.name,
            log.refused,
            read_error(log, count=count, floor=floor, part=options["part"]),
        ),
    )
    rows = [error_row(log, item) for log, _, own in found for item in own]
    kept = [row for log, _, own in found for item in own for row in harmonics_rows(log, item)]
    doubted = [refusal for _, its, _ in found for refusal in its]
    refused = refused_rows([*lost, *doubted])
    if style == "csv":
        click.echo(frame(LOG_COLUMNS["error"], rows).to_csv(index=False), nl=False)
    elif style == "json":
        terminal.print_json({"error": rows, "harmonics": kept, "refused": refused})
    else:
        logview.print_error(rows, kept, refused_rows(doubted))
    _exit(ctx, found, lost)


@main.command(
    epilog=examples(
        "spectrum velocities/*.h5 --stage lms-y",
        "spectrum velocities/*.h5 --band 10 400 --format csv",
    )
)
@LOGS
@STAGE
@click.option(
    "--band",
    nargs=2,
    type=float,
    metavar="LOW HIGH",
    help="Only modes, grid and lines of this band, in Hz; default 10 to 400 without a stage.",
)
@PART
@reading_options
@FORMAT
@click.pass_context
def spectrum(ctx: click.Context, /, logs: tuple[Path, ...], style: str, **options: Any) -> None:
    """Read the accelerometers: magnitude per modal frequency and velocity, and which grow.

    With a stage its modes are read, and RMS in its health band and watched bands; without one a
    grid of every 10 Hz. A magnitude is the amplitude of the strongest harmonic of a band. Lines
    are found by a test that shows one where there is none in 1 % of channels.
    """
    from lmshealth.modal.acceleration_survey import survey
    from lmshealth.report.tables import (
        LOG_COLUMNS,
        frame,
        growth_rows,
        lines_rows,
        magnitudes_rows,
        refused_rows,
    )
    from lmshealth.signal.acceleration_levels import find_growth

    stage, columns = _loaded(options["stage"], options["columns"])
    band = checked_band(options["band"])
    found, lost = _each(logs, columns, lambda log: survey(log, stage, band, part=options["part"]))
    magnitudes = [item for own in found for item in own.magnitudes]
    growth = find_growth(magnitudes)
    known = [(own.log, line) for own in found for line in own.lines]
    rows = magnitudes_rows(magnitudes, growth, known)
    lines = [{"log": own.log, **row} for own in found for row in lines_rows(own.lines)]
    doubted = [refusal for own in found for refusal in own.refused]
    refused = refused_rows([*lost, *doubted])
    if style == "csv":
        click.echo(frame(LOG_COLUMNS["magnitudes"], rows).to_csv(index=False), nl=False)
    elif style == "json":
        content = {"magnitudes": rows, "growth": growth_rows(growth), "lines": lines}
        terminal.print_json({**content, "refused": refused})
    else:
        logview.print_magnitudes(rows, lines, refused_rows(doubted))
    _exit(ctx, found, lost)


@main.command(
    epilog=examples(
        "frf sweep.h5 --input current_excitation --output acc_pitch --band 95 175",
        "frf bench.mat --columns map.toml --input current --output delta_e --period 1",
        "frf sweeps/*.h5 --input current_excitation --output acc_pitch --stage lms-y "
        "--format csv > modes.csv",
    )
)
@LOGS
@click.option("--input", "source", required=True, metavar="NAME", help="Channel of the excitation.")
@click.option("--output", required=True, metavar="NAME", help="Channel of the answer.")
@STAGE
@click.option(
    "--band",
    nargs=2,
    type=float,
    metavar="LOW HIGH",
    help="Use only this band, in Hz; default where the input is excited.",
)
@click.option(
    "--period",
    type=click.FloatRange(0, min_open=True),
    metavar="S",
    help="Period of the excitation in s, to 1 %; default found from the input, if it repeats.",
)
@reading_options
@FORMAT
@click.pass_context
def frf(ctx: click.Context, /, logs: tuple[Path, ...], style: str, **options: Any) -> None:
    """Measure the response of single logs from one channel to another, and identify its modes.

    An input that repeats is averaged over whole periods, any other over stretches. csv lists the
    modes; json has the response with H1, H2, Hv and coherence too. With a stage modes are named as
    it names them, wherever one alone lies where it is looked for.
    """
    from lmshealth.modal.frf.identification import name_modes, read_frf, why_unnamed
    from lmshealth.report.tables import (
        COLUMNS,
        fit_row,
        frame,
        frf_rows,
        lines_rows,
        modes_rows,
        refused_rows,
    )
    from lmshealth.tracking.history import LogEstimates

    stage, columns = _loaded(options["stage"], options["columns"])
    band, period = checked_band(options["band"]), options["period"]
    names = (options["source"], options["output"])
    found, lost = _each(
        logs, columns, lambda it: (it, read_frf(it, *names, band=band, period=period))
    )
    readings = [
        LogEstimates(
            it.name, it.digest, it.metadata, name_modes(own.modes, stage) if stage else own.modes
        )
        for it, own in found
    ]
    rows = [row for reading in readings for row in modes_rows(reading)]
    fits = [fit_row(it.name, own) for it, own in found]
    response = [row for it, own in found for row in frf_rows(it.name, own)]
    doubted = [r for _, own in found for r in own.modes.refused]
    refused = refused_rows([*lost, *doubted])
    if style == "csv":
        click.echo(frame(COLUMNS["modes"], rows).to_csv(index=False), nl=False)
    elif style == "json":
        lines = [{"log": it.name, **r} for it, own in found for r in lines_rows(own.modes.lines)]
        content = {"modes": rows, "fit": fits, "frf": response, "lines": lines}
        terminal.print_json({**content, "refused": refused})
    elif found:
        logview.print_frf(fits, response, rows, refused_rows(doubted))
    if stage and style != "json":
        for reading in readings:
            for why in why_unnamed(reading.modes, stage):
                click.echo(f"note: {reading.log}: {why}", err=True)
    _exit(ctx, found, lost)


@main.command(
    epilog=examples(
        "plan --stage lms-y --detect guide_preload=0.05",
        "plan --stage lms-y --detect guide_preload=0.1 --detect mount_stiffness=0.1 --seconds 45",
    )
)
@click.option("--stage", required=True, help="Stage description: a .toml file or a shipped name.")
@DETECT
@click.option("--power", type=SHARE, default=0.95, show_default=True, help="To see that loss.")
@click.option(
    "--false-alarm",
    type=SHARE,
    default=0.01,
    show_default=True,
    help="Probability to call a loss where there is none.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(0, min_open=True),
    multiple=True,
    help="Length of a log; may be given several times. Default 10 to 600 s.",
)
@click.option(
    "--format", "style", type=click.Choice(["table", "json"]), default="table", show_default=True
)
def plan(stage: str, detections: list[tuple[str, float]], style: str, **options: Any) -> None:
    """Plan logs: how long and how many they must be for a loss to be seen.

    The best that can be had from vibration at constant velocity, by the Cramér-Rao bound: logs of
    now are compared with those of the baseline, as long, at the same temperature.
    """
    from lmshealth.report.tables import plan_rows
    from lmshealth.stage.constants import DURATIONS
    from lmshealth.stage.description import load_stage
    from lmshealth.stage.planning import plan as make_plan

    loaded = load_stage(stage)
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
        planview.print_plans(**content)


def _loaded(stage: str | None, columns: Path | None) -> tuple[Stage | None, ColumnMap | None]:
    from lmshealth.io.column_map import load_columns
    from lmshealth.stage.description import load_stage

    return (
        load_stage(stage) if stage else None,
        load_columns(columns) if columns else None,
    )


def _each(
    logs: Iterable[Path], columns: ColumnMap | None, look: Callable[[Log], Result]
) -> tuple[list[Result], list[Refusal]]:
    """Look at one log after the other; one that cannot be used is told and left out."""
    from lmshealth.io.manifest import NOT_LOGS, read_manifest_beside
    from lmshealth.io.reading import read_log

    found: list[Result] = []
    lost: list[Refusal] = []
    manifests: dict[Path, Manifest] = {}
    max_memory = click.get_current_context().params["max_memory"]
    named = tuple(logs)
    # Who says *.csv does not mean the manifest beside the logs.
    for path in [path for path in named if path.name not in NOT_LOGS] or named:
        try:
            if path.parent not in manifests:
                manifests[path.parent] = _noted(read_manifest_beside(path))
            overrides = manifests[path.parent].overrides(path)
            log = read_log(path, columns=columns, overrides=overrides, max_memory=max_memory)
            found.append(look(log))
        except BadLog as why:
            lost.append(Refusal(why.log, why.reason, why.detail))
    return found, lost


def _noted(manifest: Manifest) -> Manifest:
    """Say where a manifest as a whole, or a row that names no log, is not understood."""
    from lmshealth.io.manifest import MANIFEST

    for refusal in manifest.refused:
        if refusal.log == MANIFEST:
            click.echo(f"note: {refusal.log}: {refusal.reason}: {refusal.detail}", err=True)
    return manifest


def _exit(ctx: click.Context, found: Sequence[object], lost: Sequence[Refusal]) -> None:
    for refusal in lost:
        click.echo(f"lmshealth: {refusal.log}: {refusal.reason}: {refusal.detail}", err=True)
    ctx.exit(_DONE if not lost else _SOME_REFUSED if found else _FAILED)


for _command in (run, *COMMANDS, report):
    main.add_command(_command)
