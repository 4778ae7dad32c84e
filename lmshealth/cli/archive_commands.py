"""Commands on archives and stores: run, watch, report.

What runs is imported by each command: their help needs no database, no workers and no scipy.
"""

from __future__ import annotations

from contextlib import closing
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lmshealth.cli import options, terminal
from lmshealth.errors import LmshealthError
from lmshealth.machine.constants import JSON_SCHEMA
from lmshealth.report.constants import TERMINAL_ROWS

if TYPE_CHECKING:
    from lmshealth.batch.ingest import Settings
    from lmshealth.batch.run import RunResult
    from lmshealth.stage.description import Stage


_run_options = options.combined(
    click.argument("logs", type=click.Path(exists=True, file_okay=False, path_type=Path)),
    options.stage_option(
        "stages",
        multiple=True,
        required=True,
        help="Stage description: a .toml file or a shipped name; may be given several times.",
    ),
    options.out_option(type=options.FOLDER, help="Folder for tables and report."),
    options.store_option(
        help="Store of results: sqlite:///PATH or a PostgreSQL database; default a file in --out."
    ),
    options.reading_options,
    options.SECONDS_PER_LOG,
    options.WORKERS,
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Run on the Dask cluster with this scheduler. It needs the same version of lmshealth, "
        "and its workers access to the logs under the same paths.",
    ),
    options.EPOCHS,
    options.SEED,
    options.alert_options,
    options.LANGUAGE,
    options.PDF,
    options.format_option("table", "json"),
)


def _settings(given: dict[str, Any]) -> Settings:
    from lmshealth.batch.alerts import Alerts
    from lmshealth.batch.ingest import Settings

    del given["layouts"]  # a part of the column map
    alerts = Alerts(**{name: given.pop(name) for name in ("silent_days", "command", "notify")})
    return Settings(**given, alerts=alerts, follow_links=options.follow_links())


def _document(result: RunResult) -> dict[str, Any]:
    """Return the result of a run for other programs."""
    counts = ["n_logs", "n_refused", "n_remembered", "n_unlisted", "n_unread"]
    names = [*counts, "failed", "unsent", "notes", "changes"]
    head = {"schema": JSON_SCHEMA, "report": str(result.index.absolute())}
    return {**head, **{name: getattr(result, name) for name in names}, "machines": result.statuses}


def _finish(result: RunResult, pdf: bool, prefix: str = "") -> None:
    """Print what failed, and write the pages as PDF where that is asked for."""
    failed = (*result.failed.items(), *result.unsent.items())
    errors = [*result.notes, *(f"{name}: {why}" for name, why in failed)]
    terminal.print_errors(prefix + error for error in errors)
    if pdf:
        from lmshealth.report.rendering import write_pdfs

        write_pdfs(result.pages)


def _status(result: RunResult) -> int:
    """Return the exit status of a run or a report."""
    if result.failed and not result.rows:  # every machine
        return 1
    lost = result.n_refused or result.n_unlisted or result.n_unread or result.failed
    return options.SOME_REFUSED if lost else 0


@options.command(
    "run logs/ --stage lms-y --out result/",
    "run exports/ --columns map.toml --stage my-stage.toml --out result/",
    "run archive/ --stage lms-x --stage lms-y --out result/ "
    "--store postgresql://me@host/fleet --scheduler tcp://host:8786",
    "run logs/ --stage lms-y --out result/ --silent-days 7 --alert-command 'mail -s lms me@host'",
)
@_run_options
@options.TODAY
def run(logs: Path, stages: tuple[Stage, ...], out: Path, **given: Any) -> int:
    """Analyse a folder of logs: tables, verdicts and report. Run again to continue."""
    from lmshealth.batch.run import run as run_pipeline
    from lmshealth.cli import views

    pdf, style = given.pop("pdf"), given.pop("style")
    with terminal.progress_bars() as progress:
        result = run_pipeline(logs, stages, out, _settings(given), progress)
    if style == "json":
        terminal.print_json(_document(result))
    else:
        used = result.n_logs - result.n_refused
        again = f"; results of {result.n_remembered} are of an earlier run"
        again = again if result.n_remembered else ""
        terminal.print_line(f"{used} of {result.n_logs} logs analysed{again}.")
        if result.n_unlisted:
            terminal.print_line(
                f"{result.n_unlisted} logs are not listed in manifest.csv: see refused.csv."
            )
        if result.n_unread:
            terminal.print_line(f"{result.n_unread} invalid tables or table rows: see refused.csv.")
        views.print_summaries(result.rows)
        for change in result.changes[:TERMINAL_ROWS]:
            terminal.print_text(f"Changed: {change}")
        if rest := len(result.changes[TERMINAL_ROWS:]):
            terminal.print_line(f"{rest} more changes; changes.csv lists all.")
        terminal.print_line(f"Report: {result.index}")
    _finish(result, pdf)
    return _status(result)


@options.command(
    "watch logs/ --stage lms-y --out result/",
    "watch /mnt/logs/ --stage lms-y --out result/ --silent-days 7 --notify --interval 60",
)
@_run_options
@click.option(
    "--interval",
    type=options.Finite(0, 86_400, min_open=True),  # a run on every new day
    default=30.0,
    metavar="SECONDS",
    help="Time between polls; a file is analysed when it is the same at two of them.",
)
def watch(logs: Path, stages: tuple[Stage, ...], out: Path, interval: float, **given: Any) -> None:
    """Run over a folder of logs whenever logs have arrived; ends by SIGTERM or Ctrl-C.

    Prints one line for each run, change and failure; with --format json one document a line.
    """
    from lmshealth.batch.run import watch as watch_folder

    pdf, style = given.pop("pdf"), given.pop("style")
    how: Any = {"interval": interval, "progress": terminal.log_progress}
    for result in watch_folder(logs, stages, out, _settings(given), **how):
        now = f"{datetime.now().astimezone().isoformat(timespec='seconds')} "
        if isinstance(result, LmshealthError):
            terminal.print_errors([now + str(result)])
            continue
        if style == "json":
            terminal.print_json(_document(result), indent=-1)
        else:
            used = f"{result.n_logs - result.n_refused} of {result.n_logs} logs analysed"
            more = f", {result.n_unlisted} not in manifest.csv" if result.n_unlisted else ""
            terminal.print_line(
                f"{now}{used}; results of {result.n_remembered} are of an earlier run{more}"
            )
            for change in result.changes:
                terminal.print_line(f"{now}{change}")
        try:
            _finish(result, pdf, now)
        except LmshealthError as error:
            terminal.print_errors([now + str(error)])


@options.command(
    "report --store sqlite:///result/lmshealth.sqlite --out pages/",
    "report --store postgresql://me@host/fleet --out pages/ --pdf",
    "report --store sqlite:///result/lmshealth.sqlite --out seiten/ --language de",
)
@options.store_option(required=True, help="Store that `run` has filled.")
@options.out_option(type=options.FOLDER, help="Folder of the pages.")
@options.WORKERS
@options.LANGUAGE
@options.PDF
@options.TODAY
def report(store: str, out: Path, pdf: bool, **given: Any) -> int:
    """Write the pages of all machines in a store, without their logs.

    They are those that `run` writes on the same day in the same language, byte for byte.
    """
    from lmshealth.batch.ingest import Settings
    from lmshealth.batch.run import report as write_pages
    from lmshealth.batch.store import Store

    with terminal.progress_bars() as progress, closing(Store(store, create=False)) as opened:
        result = write_pages(opened, out, Settings(**given), progress)
    terminal.print_line(f"Report: {result.index}")
    _finish(result, pdf)
    return _status(result) or (options.SOME_REFUSED if result.notes else 0)
