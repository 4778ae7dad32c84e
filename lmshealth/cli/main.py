"""Command line: the group of all commands, and its exit status."""

from __future__ import annotations

import os

# Matrices are small: threads of the linear algebra library only slow down the worker processes.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from typing import Any

import click

from lmshealth.cli.archive_commands import report, run
from lmshealth.cli.log_commands import error, frf, modes, spectrum
from lmshealth.cli.machine_commands import infer, prognose, track
from lmshealth.cli.stage_commands import plan, stage
from lmshealth.cli.terminal import print_errors
from lmshealth.errors import LmshealthError


class _Group(click.Group):
    """Group that reports errors in one line on standard error, with exit status 1."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except LmshealthError as error:
            print_errors([str(error)])
        except OSError as error:
            print_errors([f"{error.filename or 'output'}: {error.strerror}"])
        except KeyboardInterrupt:
            print_errors(["interrupted; run again to continue"])
        ctx.exit(1)


@click.group(
    cls=_Group,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
    epilog="Exit status: 0 done, 1 failed (one line on standard error gives the reason), 2 wrong "
    "usage, 3 done but some logs were refused.",
)
@click.version_option(package_name="lmshealth")
def main() -> None:
    """Estimate the remaining guide preload and mount stiffness of linear-motor stages."""


for _command in (run, modes, error, spectrum, frf, stage, plan, track, infer, prognose, report):
    main.add_command(_command)
