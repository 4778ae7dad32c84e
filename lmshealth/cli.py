"""The command line: what a user types, and nothing else."""

from __future__ import annotations

import os

# Matrices here are small: threads inside linear algebra only get in the way of the processes.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from lmshealth.errors import BadLog, LmshealthError
from lmshealth.logs import Metadata, Refusal
from lmshealth.results import Modes

if TYPE_CHECKING:
    from lmshealth.pipeline import RunResult
    from lmshealth.readers import ColumnMap
    from lmshealth.stage import Stage

_DONE, _FAILED, _SOME_REFUSED = 0, 1, 3


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


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="lmshealth")
def main() -> None:
    r"""Tell how much guide preload and mount stiffness a linear-motor stage has left.

    \b
    Exit status: 0 done, 1 failed (one line on standard error says why),
    2 wrong usage, 3 done but some logs were refused.
    """


@main.command()
@click.argument("logs", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--stage",
    "stages",
    multiple=True,
    required=True,
    help="Stage description: a .toml file or a shipped name; may be given several times.",
)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    help="Folder for tables and report.",
)
@click.option("--store", help="SQLAlchemy URL of the store; default a SQLite file in --out.")
@click.option("--workers", type=click.IntRange(1), help="Processes; default one per processor.")
@click.option(
    "--epochs",
    type=click.IntRange(1),
    default=40,
    show_default=True,
    help="Infer health at no more than this many epochs per stage.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.pass_context
def run(
    ctx: click.Context, /, logs: Path, stages: tuple[str, ...], out: Path, **options: Any
) -> None:
    r"""Analyse a folder of logs: tables, verdict and report. Run again to go on.

    \b
    Example:
        lmshealth run logs/ --stage lms-y --out result/
    """
    from lmshealth.pipeline import Settings
    from lmshealth.pipeline import run as run_pipeline
    from lmshealth.stage import load_stage

    settings = Settings(
        store=options["store"],
        workers=options["workers"] or len(os.sched_getaffinity(0)),
        epochs=options["epochs"],
        seed=options["seed"],
    )
    loaded = [load_stage(reference) for reference in stages]
    with _progress() as progress:
        result = run_pipeline(logs, loaded, out, settings, progress)
    _tell(result)
    ctx.exit(_SOME_REFUSED if result.n_refused else _DONE)


@main.command()
@click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--stage", help="Stage description: a .toml file or a shipped name.")
@click.option("--columns", type=click.Path(path_type=Path), help="Column map of the export.")
@click.option("--channels", help="Use only these channels, separated by commas.")
@click.option("--band", nargs=2, type=float, metavar="LOW HIGH", help="Use only this band, in Hz.")
@click.option(
    "--format",
    "style",
    type=click.Choice(["table", "csv", "json"]),
    default="table",
    show_default=True,
)
@click.pass_context
def modes(ctx: click.Context, /, logs: tuple[Path, ...], style: str, **options: Any) -> None:
    r"""Identify the modes of single logs: frequency and damping with their uncertainty.

    \b
    Examples:
        lmshealth modes log.h5 --stage lms-y
        lmshealth modes export.csv --columns map.toml --band 80 200 --format json
    """
    from lmshealth.readers import load_columns
    from lmshealth.stage import load_stage

    stage = load_stage(options["stage"]) if options["stage"] else None
    columns = load_columns(options["columns"]) if options["columns"] else None
    band = _checked_band(options["band"])
    channels = (
        [name.strip() for name in options["channels"].split(",")] if (options["channels"]) else None
    )
    found: list[tuple[str, Metadata, Modes]] = []
    lost: list[Refusal] = []
    for path in logs:
        try:
            found.append(_identify(path, stage, columns, channels, band))
        except BadLog as error:
            lost.append(Refusal(error.log, error.reason, error.detail))
    _show_modes(found, lost, style)
    for refusal in lost:
        click.echo(f"lmshealth: {refusal.log}: {refusal.reason}: {refusal.detail}", err=True)
    ctx.exit(_DONE if not lost else _SOME_REFUSED if found else _FAILED)


def _checked_band(band: tuple[float, float] | None) -> tuple[float, float] | None:
    if band and not 0 <= band[0] < band[1]:
        raise click.BadParameter(
            f"needs 0 <= LOW < HIGH, got {band[0]:g} {band[1]:g}", param_hint="--band"
        )
    return band or None


def _identify(
    path: Path,
    stage: Stage | None,
    columns: ColumnMap | None,
    channels: Sequence[str] | None,
    band: tuple[float, float] | None,
) -> tuple[str, Metadata, Modes]:
    from lmshealth.modal import identify
    from lmshealth.readers import read_log

    log = read_log(path, columns=columns)
    return log.name, log.metadata, identify(log, stage, channels=channels, band=band)


def _show_modes(found: list[tuple[str, Metadata, Modes]], lost: list[Refusal], style: str) -> None:
    from lmshealth.tables import frame, lines_rows, modes_rows, refused_rows

    rows = [row for log, metadata, own in found for row in modes_rows(log, metadata, own)]
    refused = refused_rows([*lost, *(refusal for _, _, own in found for refusal in own.refused)])
    if style == "csv":
        click.echo(frame("modes", rows).to_csv(index=False), nl=False)
    elif style == "json":
        lines = [{"log": log, **row} for log, _, own in found for row in lines_rows(own)]
        content = {"modes": rows, "lines": lines, "refused": refused}
        click.echo(json.dumps(_without_nan(content), indent=1, allow_nan=False))
    else:
        _print_tables(rows, refused)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and value != value else value


def _print_tables(rows: list[dict[str, Any]], refused: list[dict[str, Any]]) -> None:
    console = Console()
    table = Table(title="Modes (± one standard deviation)" if rows else "No modes found")
    for name in ("log", "mode", "channel", "frequency Hz", "damping %", "SNR"):
        table.add_column(name, justify="left" if name in ("log", "mode", "channel") else "right")
    for row in rows:
        table.add_row(
            row["log"],
            row["mode"],
            row["channel"],
            f"{row['frequency_hz']:.4g} ± {row['frequency_std_hz']:.2g}"
            if row["frequency_std_hz"] >= 1
            else f"{row['frequency_hz']:.3f} ± {row['frequency_std_hz']:.3f}",
            f"{100 * row['damping_ratio']:.2f} ± {100 * row['damping_ratio_std']:.2f}",
            f"{row['snr']:.3g}",
        )
    console.print(table)
    if refused:
        table = Table(title="Refused")
        for name in ("log", "channel", "mode", "reason", "detail"):
            table.add_column(name, overflow="fold")
        for row in refused:
            table.add_row(*(row[name] for name in ("log", "channel", "mode", "reason", "detail")))
        console.print(table)


@contextmanager
def _progress() -> Iterator[Any]:
    """Show bars on a terminal's standard error, and nothing anywhere else."""
    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description:<12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not sys.stderr.isatty(),
    ) as bars:
        known: dict[str, Any] = {}

        def tell(what: str, done: int, total: int) -> None:
            if what not in known:
                known[what] = bars.add_task(what, total=total)
            bars.update(known[what], completed=done, total=total)

        yield tell


def _tell(result: RunResult) -> None:
    used = result.n_logs - result.n_refused
    again = f", {result.n_remembered} of them known from before" if result.n_remembered else ""
    click.echo(f"{used} of {result.n_logs} logs analysed{again}.")
    for assessment in result.assessments:
        judgement = assessment.judgement
        sure = (
            ""
            if judgement.probability != judgement.probability
            else (f" ({100 * judgement.probability:.0f} %)")
        )
        click.echo(f"{judgement.stage}: {judgement.verdict}{sure}. {judgement.why}")
    click.echo(f"Report: {result.index}")
