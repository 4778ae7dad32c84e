"""Commands that analyse single logs: modes, error, spectrum, frf."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lmshealth.cli import terminal, views
from lmshealth.cli.options import (
    BAND,
    FORMAT,
    LOGS,
    PART,
    SOME_REFUSED,
    STAGE,
    band_help,
    checked_band,
    examples,
    load_columns_and_stage,
    reading_options,
)
from lmshealth.errors import BadLog
from lmshealth.io.log import Log, Refusal

if TYPE_CHECKING:
    from lmshealth.io.column_map import ColumnMap
    from lmshealth.io.manifest import Manifest
    from lmshealth.report.tables import Row
    from lmshealth.tracking.history import LogEstimates

Result = TypeVar("Result")

_NO_BAND = (
    "Without a band or a description close modes may be merged or missed; select them with --band "
    "LOW HIGH. The mode names are valid for this call only."
)


@click.command(
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
    help="Segments of constant velocity (or a whole log at rest), or free decays after moves.",
)
@reading_options
@click.option("--channels", help="Use only these channels, separated by commas.")
@BAND
@FORMAT
@click.pass_context
def modes(ctx: click.Context, /, logs: tuple[Path, ...], style: str, **options: Any) -> None:
    """Identify the modes of single logs: natural frequency and damping ratio."""
    from lmshealth.modal.free_decay.identification import identify_decays
    from lmshealth.modal.identification import identify
    from lmshealth.report.tables import COLUMNS, modes_rows
    from lmshealth.signal.following_error import loop_error
    from lmshealth.tracking.history import LogEstimates

    method = identify_decays if options["part"] == "settling" else identify
    columns, stage = load_columns_and_stage(options)
    band, channels = checked_band(options["band"]), options["channels"]
    names = [name.strip() for name in channels.split(",")] if channels else None

    def estimate(log: Log) -> LogEstimates:
        found = method(log, stage, channels=names, band=band)
        return LogEstimates(log.name, log.digest, log.metadata, found, loop_error(log))

    found, lost = _each(logs, columns, estimate)
    rows = [row for one in found for row in modes_rows(one)]
    refused = [r for one in found for r in one.modes.refused]
    content = {"modes": rows, "lines": _line_rows((r.log, r.modes.lines) for r in found)}

    def show(rejected: list[Row]) -> None:
        if found:
            views.print_modes(rows, rejected)
            if rows and stage is None and band is None:
                terminal.print_text(_NO_BAND)

    _publish(style, COLUMNS["modes"], content, (lost, refused), show)
    _exit(ctx, found, lost)


@click.command(
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
    help="Number of strongest harmonics.",
)
@click.option(
    "--floor-nm",
    type=click.FloatRange(0),
    default=30.0,
    show_default=True,
    help="Amplitude in nm above which harmonics are counted separately.",
)
@PART
@reading_options
@FORMAT
@click.pass_context
def error(ctx: click.Context, /, logs: tuple[Path, ...], style: str, **options: Any) -> None:
    """Analyse the following error: statistics, strongest harmonics, bandwidth.

    Statistics are of all samples, harmonics of the longest segment without gaps. The sum of the
    listed harmonics (json) reconstructs the following error.
    """
    from lmshealth.report.tables import LOG_COLUMNS, error_row, harmonics_rows
    from lmshealth.signal.following_error import FollowingError, read_error

    columns, _ = load_columns_and_stage(options)
    count, floor = options["count"], 1e-9 * options["floor_nm"]

    def analyse(log: Log) -> tuple[Log, Sequence[FollowingError]]:
        return log, read_error(log, count=count, floor=floor, part=options["part"])

    found, lost = _each(logs, columns, analyse)
    rows = [error_row(log.name, one) for log, own in found for one in own]
    harmonics = [row for log, own in found for one in own for row in harmonics_rows(log.name, one)]
    refused = [refusal for log, _ in found for refusal in log.refused]
    content = {"error": rows, "harmonics": harmonics}
    _publish(
        style,
        LOG_COLUMNS["error"],
        content,
        (lost, refused),
        lambda rejected: views.print_error(rows, harmonics, rejected),
    )
    _exit(ctx, found, lost)


@click.command(
    epilog=examples(
        "spectrum velocities/*.h5 --stage lms-y",
        "spectrum velocities/*.h5 --band 10 400 --format csv",
    )
)
@LOGS
@STAGE
@band_help("Only modes, grid and lines in this band, in Hz; default 10 to 400 without a stage.")
@PART
@reading_options
@FORMAT
@click.pass_context
def spectrum(ctx: click.Context, /, logs: tuple[Path, ...], style: str, **options: Any) -> None:
    """Measure accelerations per mode and velocity, and which of them grow with velocity.

    With a stage: its modes, and the RMS in its health band and watched bands; without: a grid of
    10 Hz. The magnitude is the amplitude of the strongest harmonic of a band. The test for spectral
    lines has a false-alarm probability of 1 % per channel.
    """
    from lmshealth.modal.acceleration_survey import survey
    from lmshealth.report.tables import LOG_COLUMNS, growth_rows, magnitudes_rows
    from lmshealth.signal.acceleration_levels import find_growth

    columns, stage = load_columns_and_stage(options)
    band = checked_band(options["band"])
    found, lost = _each(logs, columns, lambda log: survey(log, stage, band, part=options["part"]))
    magnitudes = [item for own in found for item in own.magnitudes]
    growth = find_growth(magnitudes)
    rows = magnitudes_rows(
        magnitudes, growth, [(own.log, line) for own in found for line in own.lines]
    )
    lines = _line_rows((own.log, own.lines) for own in found)
    refused = [refusal for own in found for refusal in own.refused]
    content = {"magnitudes": rows, "growth": growth_rows(growth), "lines": lines}
    _publish(
        style,
        LOG_COLUMNS["magnitudes"],
        content,
        (lost, refused),
        lambda rejected: views.print_magnitudes(rows, lines, rejected),
    )
    _exit(ctx, found, lost)


@click.command(
    epilog=examples(
        "frf sweep.h5 --input current_excitation --output acc_pitch --band 95 175",
        "frf bench.mat --columns map.toml --input current --output delta_e --period 1",
        "frf sweeps/*.h5 --input current_excitation --output acc_pitch --stage lms-y "
        "--format csv > modes.csv",
    )
)
@LOGS
@click.option("--input", "source", required=True, metavar="NAME", help="Channel of the excitation.")
@click.option("--output", required=True, metavar="NAME", help="Channel of the response.")
@STAGE
@band_help("Use only this band, in Hz; default: the excited band.")
@click.option(
    "--period",
    type=click.FloatRange(0, min_open=True),
    metavar="S",
    help="Period of the excitation in s, to 1 %; default: found from a periodic input.",
)
@reading_options
@FORMAT
@click.pass_context
def frf(ctx: click.Context, /, logs: tuple[Path, ...], style: str, **options: Any) -> None:
    """Measure the frequency response between two channels and identify its modes.

    A periodic input is averaged over whole periods, any other over segments. csv lists the modes;
    json also the response with H1, H2, Hv and coherence. With a stage, a mode gets its name there
    when it is the only one in its search band.
    """
    from lmshealth.modal.frf.identification import read_frf
    from lmshealth.modal.naming import name_response, why_unnamed
    from lmshealth.report.tables import COLUMNS, fit_row, frf_rows, modes_rows
    from lmshealth.tracking.history import LogEstimates

    columns, stage = load_columns_and_stage(options)
    band, period = checked_band(options["band"]), options["period"]
    names = (options["source"], options["output"])
    found, lost = _each(
        logs, columns, lambda log: (log, read_frf(log, *names, band=band, period=period))
    )
    estimates = [
        LogEstimates(
            log.name,
            log.digest,
            log.metadata,
            name_response(own.modes, stage) if stage else own.modes,
        )
        for log, own in found
    ]
    rows = [row for one in estimates for row in modes_rows(one)]
    content = {
        "modes": rows,
        "fit": [fit_row(log.name, own) for log, own in found],
        "frf": [row for log, own in found for row in frf_rows(log.name, own)],
        "lines": _line_rows((log.name, own.modes.lines) for log, own in found),
    }
    refused = [refusal for _, own in found for refusal in own.modes.refused]

    def show(rejected: list[Row]) -> None:
        if found:
            views.print_frf(content["fit"], content["frf"], rows, rejected)

    _publish(style, COLUMNS["modes"], content, (lost, refused), show)
    if stage and style != "json":
        for one in estimates:
            for why in why_unnamed(one.modes, stage):
                click.echo(f"note: {one.log}: {why}", err=True)
    _exit(ctx, found, lost)


def _publish(
    style: str,
    columns: str,
    content: dict[str, list[Row]],
    refused: tuple[Sequence[Refusal], Sequence[Refusal]],
    show: Callable[[list[Row]], None],
) -> None:
    """Print results as csv (the first table of the content), as json, or as tables.

    ``refused`` holds refused logs and refused parts of the others; tables list only the latter.
    """
    from lmshealth.report.tables import frame, refused_rows

    lost, parts = refused
    if style == "csv":
        rows = next(iter(content.values()))
        click.echo(frame(columns, rows).to_csv(index=False), nl=False)
    elif style == "json":
        terminal.print_json({**content, "refused": refused_rows([*lost, *parts])})
    else:
        show(refused_rows(parts))


def _line_rows(lines: Iterable[tuple[str, Any]]) -> list[Row]:
    """Return the spectral lines of logs, with the log in the first column."""
    from lmshealth.report.tables import lines_rows

    return [{"log": log, **row} for log, own in lines for row in lines_rows(own)]


def _each(
    logs: Iterable[Path], columns: ColumnMap | None, analyse: Callable[[Log], Result]
) -> tuple[list[Result], list[Refusal]]:
    """Analyse one log after the other; return results and refused logs."""
    from lmshealth.io.manifest import NOT_LOGS, read_manifest_beside
    from lmshealth.io.reading import read_log

    found: list[Result] = []
    lost: list[Refusal] = []
    manifests: dict[Path, Manifest] = {}
    max_memory = click.get_current_context().params["max_memory"]
    named = tuple(logs)
    # A pattern such as *.csv does not mean the manifest in the same folder.
    for path in [path for path in named if path.name not in NOT_LOGS] or named:
        try:
            if path.parent not in manifests:
                manifests[path.parent] = _noted(read_manifest_beside(path))
            overrides = manifests[path.parent].overrides(path)
            log = read_log(path, columns=columns, overrides=overrides, max_memory=max_memory)
            found.append(analyse(log))
        except BadLog as why:
            lost.append(Refusal(why.log, why.reason, why.detail))
    return found, lost


def _noted(manifest: Manifest) -> Manifest:
    """Print faults of a manifest as a whole, or of rows that name no log."""
    from lmshealth.io.manifest import MANIFEST

    for refusal in manifest.refused:
        if refusal.log == MANIFEST:
            click.echo(f"note: {refusal.log}: {refusal.reason}: {refusal.detail}", err=True)
    return manifest


def _exit(ctx: click.Context, found: Sequence[object], lost: Sequence[Refusal]) -> None:
    for refusal in lost:
        click.echo(f"lmshealth: {refusal.log}: {refusal.reason}: {refusal.detail}", err=True)
    ctx.exit(0 if not lost else SOME_REFUSED if found else 1)
