"""Commands on archives and stores: run, report."""

from contextlib import closing
from pathlib import Path
from typing import Any

import click

from lmshealth.batch.run import Settings
from lmshealth.batch.run import report as write_pages
from lmshealth.batch.run import run as run_pipeline
from lmshealth.batch.store import Store
from lmshealth.cli import options, terminal, views
from lmshealth.report.rendering import write_pdfs
from lmshealth.stage.description import Stage


@options.command(
    "run logs/ --stage lms-y --out result/",
    "run exports/ --columns map.toml --stage my-stage.toml --out result/",
    "run archive/ --stage lms-x --stage lms-y --out result/ "
    "--store postgresql://me@host/fleet --scheduler tcp://host:8786",
)
@click.argument("logs", type=click.Path(exists=True, file_okay=False, path_type=Path))
@options.stage_option(
    "stages",
    multiple=True,
    required=True,
    help="Stage description: a .toml file or a shipped name; may be given several times.",
)
@options.out_option(type=options.FOLDER, help="Folder for tables and report.")
@options.store_option(
    help="Store of results: sqlite:///PATH or a PostgreSQL database; default a file in --out."
)
@options.reading_options
@options.WORKERS
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Run on the Dask cluster with this scheduler. It needs the same version of lmshealth, and "
    "its workers access to the logs under the same paths.",
)
@options.EPOCHS
@options.SEED
@options.PDF
@click.pass_context
def run(
    ctx: click.Context, /, logs: Path, stages: tuple[Stage, ...], out: Path, **given: Any
) -> None:
    """Analyse a folder of logs: tables, verdicts and report. Run again to continue."""
    pdf = given.pop("pdf")
    with terminal.progress_bars() as progress:
        result = run_pipeline(
            logs, stages, out, Settings(**given, follow_links=options.follow_links()), progress
        )
    used = result.n_logs - result.n_refused
    again = f", {result.n_remembered} of them in an earlier run" if result.n_remembered else ""
    click.echo(f"{used} of {result.n_logs} logs analysed{again}.")
    if result.n_unread:
        click.echo(f"{result.n_unread} invalid tables or table rows: see refused.csv.")
    views.print_summaries(result.rows)
    terminal.print_errors(f"{machine}: {why}" for machine, why in result.failed.items())
    click.echo(f"Report: {result.index}")
    if pdf:
        write_pdfs(result.pages)
    some = result.n_refused or result.n_unread or result.failed
    ctx.exit(options.SOME_REFUSED if some else 0)


@options.command(
    "report --store sqlite:///result/lmshealth.sqlite --out pages/",
    "report --store postgresql://me@host/fleet --out pages/ --pdf",
)
@options.store_option(required=True, help="Store that `run` has filled.")
@options.out_option(type=options.FOLDER, help="Folder of the pages.")
@options.WORKERS
@options.PDF
@click.pass_context
def report(ctx: click.Context, /, store: str, out: Path, workers: int, pdf: bool) -> None:
    """Write the pages of all machines in a store, without their logs.

    The pages are those that `run` wrote last for each machine, byte for byte.
    """
    with terminal.progress_bars() as progress, closing(Store(store, create=False)) as opened:
        result = write_pages(opened, out, Settings(workers=workers), progress)
    click.echo(f"Report: {result.index}")
    terminal.print_errors(f"{machine}: {why}" for machine, why in result.failed.items())
    if pdf:
        write_pdfs(result.pages)
    ctx.exit(options.SOME_REFUSED if result.failed else 0)
