"""Commands on archives and stores: run, report."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lmshealth.cli import terminal, views
from lmshealth.cli.options import (
    EPOCHS,
    PDF,
    SCHEDULER,
    SEED,
    SOME_REFUSED,
    WORKERS,
    examples,
    reading_options,
    store_option,
)
from lmshealth.cli.progress import progress_bars
from lmshealth.report.pdf import write_pdfs

if TYPE_CHECKING:
    from lmshealth.batch.run import RunResult


@click.command(
    epilog=examples(
        "run logs/ --stage lms-y --out result/",
        "run exports/ --columns map.toml --stage my-stage.toml --out result/",
        "run archive/ --stage lms-x --stage lms-y --out result/ "
        "--store postgresql://me@host/fleet --scheduler tcp://host:8786",
    )
)
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
@store_option(
    help="Store of results: sqlite:///PATH or a PostgreSQL database; default a file in --out."
)
@reading_options
@WORKERS
@SCHEDULER
@EPOCHS
@SEED
@PDF
@click.pass_context
def run(
    ctx: click.Context, /, logs: Path, stages: tuple[str, ...], out: Path, **options: Any
) -> None:
    """Analyse a folder of logs: tables, verdicts and report. Run again to continue."""
    from lmshealth.batch.run import Settings
    from lmshealth.batch.run import run as run_pipeline
    from lmshealth.io.column_map import load_columns
    from lmshealth.stage.description import load_stage

    settings = Settings(
        store=options["store"],
        workers=options["workers"] or _processors(),
        scheduler=options["scheduler"],
        epochs=options["epochs"],
        seed=options["seed"],
        columns=load_columns(options["columns"]) if options["columns"] else None,
        max_memory=options["max_memory"],
    )
    loaded = [load_stage(reference) for reference in stages]
    with progress_bars() as progress:
        result = run_pipeline(logs, loaded, out, settings, progress)
    _print_result(result)
    if options["pdf"]:
        write_pdfs(result.pages)
    ctx.exit(SOME_REFUSED if result.n_refused or result.n_unread or result.failed else 0)


def _print_result(result: RunResult) -> None:
    used = result.n_logs - result.n_refused
    again = f", {result.n_remembered} of them in an earlier run" if result.n_remembered else ""
    click.echo(f"{used} of {result.n_logs} logs analysed{again}.")
    if result.n_unread:
        click.echo(f"{result.n_unread} invalid tables or table rows: see refused.csv.")
    views.print_summaries(result.rows)
    terminal.print_failed(result.failed)
    click.echo(f"Report: {result.index}")


@click.command(
    epilog=examples(
        "report --store sqlite:///result/lmshealth.sqlite --out pages/",
        "report --store postgresql://me@host/fleet --out pages/ --pdf",
    )
)
@store_option(required=True, help="Store that `run` has filled.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    help="Folder of the pages.",
)
@WORKERS
@PDF
@click.pass_context
def report(ctx: click.Context, /, store: str, out: Path, workers: int | None, pdf: bool) -> None:
    """Write the pages of all machines in a store, without their logs.

    The pages are those that `run` wrote last for each machine, byte for byte.
    """
    from lmshealth.batch.run import Settings
    from lmshealth.batch.run import report as write_pages
    from lmshealth.batch.store import Store

    settings = Settings(workers=workers or _processors())
    with progress_bars() as progress, closing(Store(store, create=False)) as opened:
        result = write_pages(opened, out, settings, progress)
    click.echo(f"Report: {result.index}")
    terminal.print_failed(result.failed)
    if pdf:
        write_pdfs(result.pages)
    ctx.exit(SOME_REFUSED if result.failed else 0)


def _processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
