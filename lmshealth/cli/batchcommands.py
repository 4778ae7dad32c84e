"""Commands that do a whole archive, or tell a whole store."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lmshealth.cli import terminal
from lmshealth.cli.options import (
    EPOCHS,
    PDF,
    SCHEDULER,
    SEED,
    WORKERS,
    examples,
    reading_options,
)
from lmshealth.cli.progress import progress_bars
from lmshealth.report.pdf import write_pdfs

if TYPE_CHECKING:
    from lmshealth.batch.run import RunResult

# An address on the command line is seen by everybody on the machine, with its password.
STORE_VARIABLE = "LMSHEALTH_STORE"


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
@click.option(
    "--store",
    envvar=STORE_VARIABLE,
    show_envvar=True,
    metavar="URL",
    help="Where results are kept: sqlite:///PATH, or a PostgreSQL database; default a file in "
    "--out.",
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
    """Analyse a folder of logs: tables, verdict and report. Run again to go on."""
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
    _tell(result)
    if options["pdf"]:
        write_pdfs(result.pages)
    ctx.exit(3 if result.n_refused or result.n_unread or result.failed else 0)


def _tell(result: RunResult) -> None:
    from lmshealth.cli.lifeview import print_briefs

    used = result.n_logs - result.n_refused
    again = f", {result.n_remembered} of them known from before" if result.n_remembered else ""
    click.echo(f"{used} of {result.n_logs} logs analysed{again}.")
    if result.n_unread:
        click.echo(f"{result.n_unread} rows or tables beside them not understood: see refused.csv.")
    print_briefs([row.brief for row in result.rows])
    terminal.print_failed(result.failed)
    click.echo(f"Report: {result.index}")


@click.command(
    epilog=examples(
        "report --store sqlite:///result/lmshealth.sqlite --out pages/",
        "report --store postgresql://me@host/fleet --out pages/ --pdf",
    )
)
@click.option(
    "--store",
    envvar=STORE_VARIABLE,
    show_envvar=True,
    required=True,
    metavar="URL",
    help="What `run` has filled, by its URL.",
)
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

    They are those that `run` wrote last for each machine, byte for byte.
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
    ctx.exit(3 if result.failed else 0)


def _processors() -> int:
    """Count the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # where no system call tells
