"""Command line: the group of all commands, and its exit status."""

import atexit
import gc
import os

# Matrices are small: threads of the linear algebra library only slow down the worker processes.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# In worker processes arrays of megabytes follow one another: glibc would return their memory to the
# system each time, and wait for it to be cleared again.
os.environ.setdefault("MALLOC_TRIM_THRESHOLD_", str(1 << 28))
os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", str(1 << 26))

import signal
from importlib import import_module
from typing import Any

from lmshealth.cli.interrupts import Interrupted, ended_by_signals, loading
from lmshealth.errors import LmshealthError

with loading():  # both take most of the time of a start
    import click

    from lmshealth.cli.terminal import print_errors, standard_streams

# What is imported and drawn stays: looking for cycles more often takes an eighth of its time, and
# freeing what is left at the end half a second.
gc.set_threshold(50_000)
atexit.register(gc.freeze)

# Module of each command, and the text of the list of commands, which is printed without scipy.
_COMMANDS = {
    "check-calibration": ("stage_commands", "Check coverage and detection on simulated lives."),
    "error": ("log_commands", "Analyse the following error."),
    "frf": ("log_commands", "Measure a frequency response and identify its modes."),
    "infer": ("machine_commands", "Infer the health parameters from estimates or drifts."),
    "init": ("log_commands", "Propose column map, manifest and description from logs."),
    "modes": ("log_commands", "Identify the modes of single logs."),
    "plan": ("stage_commands", "Plan the logs that are needed to detect a loss."),
    "prognose": ("machine_commands", "Predict the remaining life and the service date."),
    "report": ("archive_commands", "Write the pages of all machines in a store."),
    "run": ("archive_commands", "Analyse a folder of logs: tables, verdicts and report."),
    "spectrum": ("log_commands", "Measure accelerations per mode and velocity."),
    "stage": ("stage_commands", "Check a stage description."),
    "track": ("machine_commands", "Track modes through a table of estimates."),
    "watch": ("archive_commands", "Run over a folder of logs whenever logs arrive."),
}


class _Group(click.Group):
    """Group that reports errors in one line on standard error, with exit status 1."""

    def main(self, *arguments: Any, **options: Any) -> Any:
        with ended_by_signals(), standard_streams():
            return super().main(*arguments, **options)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        module = import_module(f"lmshealth.cli.{_COMMANDS[cmd_name][0]}")
        command: click.Command = getattr(module, cmd_name.replace("-", "_"))
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in _COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except LmshealthError as error:
            print_errors([str(error)])
        except OSError as error:
            print_errors([f"{error.filename or 'output'}: {error.strerror}"])
        except KeyboardInterrupt as error:
            asked = isinstance(error, Interrupted)
            number = error.args[0] if asked else signal.SIGINT
            if ctx.invoked_subcommand == "watch" and number == signal.SIGTERM:
                ctx.exit(0)  # as a service ends
            by = f" by {signal.Signals(number).name}" if asked else ""
            keeps = ctx.invoked_subcommand in ("run", "watch")  # what is finished
            print_errors([f"interrupted{by}{'; run again to continue' if keeps else ''}"])
            ctx.exit(128 + number)  # as shells report it
        ctx.exit(1)


@click.group(
    cls=_Group,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
    epilog="Exit status: 0 done, 1 failed (one line on standard error gives the reason), 2 wrong "
    "usage, 3 done but some logs were refused, 130 interrupted (129 by SIGHUP, 143 by SIGTERM).",
)
@click.version_option(package_name="lmshealth")
def main() -> None:
    """Estimate the remaining guide preload and mount stiffness of linear-motor stages."""
