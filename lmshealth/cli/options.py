"""Options that several commands share, and the types of their values."""

import logging
import math
import os
import shlex
from collections.abc import Callable
from datetime import date, datetime
from functools import partial, reduce
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click
from msgspec.structs import replace

from lmshealth.batch.constants import LOG_SECONDS, NOTIFY
from lmshealth.cli import terminal
from lmshealth.errors import LmshealthError
from lmshealth.io.column_map import ColumnMap, Layout, load_columns, load_layouts
from lmshealth.io.constants import FIRST_MOMENT, LAST_MOMENT, MAX_MEMORY
from lmshealth.io.log import MOMENTS
from lmshealth.report.language import LANGUAGES
from lmshealth.signal.segments import PARTS
from lmshealth.stage.description import Stage, load_stage

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

# Exit status: done, but some logs or machines were refused.
SOME_REFUSED = 3
# Largest values of options: seeds are stored in 64 bits with a sign, days are those of a century,
# and 60 bits address so many GB.
_MOST_SEED, _MOST_DAYS, _MOST_GB = (1 << 63) - 1, 36_525, 1e9
_MOST_EPOCHS, _MOST_WORKERS = 1_000_000, 1_000


def _processors() -> int:
    from loky import cpu_count  # late: --help needs no workers

    return int(cpu_count())


class Finite(click.FloatRange):
    """Finite number in a range."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Reject NaN and infinity."""
        if not math.isfinite(click.FLOAT.convert(value, param, ctx)):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return float(super().convert(value, param, ctx))


def day(value: str) -> date:
    """Read a day of the calendar; any other text is wrong usage."""
    try:
        found = datetime.strptime(value, "%Y-%m-%d").date()
    except ValueError as error:
        detail = f"{value!r} is not a day; needed is YYYY-MM-DD, such as 2027-03-01."
        raise click.BadParameter(detail) from error
    if not FIRST_MOMENT.date() <= found < LAST_MOMENT.date():
        raise click.BadParameter(f"{value!r} is not a day {MOMENTS}.")
    return found


def unique(ctx: click.Context, option: click.Parameter, values: tuple[Any, ...]) -> list[Any]:
    """Return the values of an option, each once."""
    return list(dict.fromkeys(values))


def _band(
    ctx: click.Context, option: click.Parameter, bands: tuple[tuple[float, float], ...]
) -> tuple[float, float] | None:
    """Reject a band whose ends are not in ascending order, and a second one."""
    given = dict.fromkeys(bands)
    if len(given) > 1:
        raise click.BadParameter("is given several times; needed is one band", param_hint="--band")
    for low, high in given:
        if low >= high:
            detail = f"needs LOW < HIGH, got {low:g} {high:g}"
            raise click.BadParameter(detail, param_hint="--band")
    return next(iter(given), None)


def _words(ctx: click.Context, option: click.Parameter, command: str | None) -> tuple[str, ...]:
    """Split a command into program and arguments: no shell reads it."""
    try:
        words = tuple(shlex.split(command or ""))
    except ValueError as error:
        raise click.BadParameter(f"{error} in {command!r}") from error
    if command is not None and not words:
        raise click.BadParameter("names no program")
    return words


def _notify(ctx: click.Context, option: click.Parameter, given: bool) -> bool:
    """Require apprise, and an address, before the first log is read."""
    if given and not os.environ.get(NOTIFY, "").split():
        raise click.BadParameter(f"the environment variable {NOTIFY} holds no address")
    if given and find_spec("apprise") is None:
        raise LmshealthError("--notify needs apprise: pip install 'lmshealth[notify]'")
    return given


TABLE = click.Path(exists=True, dir_okay=False, path_type=Path)
OUT = click.Path(dir_okay=False, path_type=Path)
FOLDER = click.Path(file_okay=False, path_type=Path)
SHARE = Finite(0, 1, min_open=True, max_open=True)

LOGS = click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path))
# Read before the others: it may decide how they are read.
eager_option = partial(click.option, is_eager=True, expose_value=False)
FOLLOW_LINKS = eager_option(
    "--follow-links",
    is_flag=True,
    callback=lambda ctx, option, given: ctx.meta.update({__name__: given}),
    help="Follow links out of the folder of logs, and maps out of that of a description.",
)


def _inputs() -> list[Path]:
    """Return the files that options of this command were read from."""
    found: list[Path] = click.get_current_context().meta.setdefault(_INPUTS, [])
    return found


def follow_links() -> bool:
    """Return whether ``--follow-links`` is set."""
    return bool(click.get_current_context().meta.get(__name__))


def described(reference: str) -> Stage:
    """Load a stage description as ``--follow-links`` allows."""
    _inputs().append(Path(reference))
    return load_stage(reference, follow_links=follow_links())


def combined(*added: Decorator) -> Decorator:
    """Return one decorator for arguments and options, in the order of the help."""
    return lambda command: reduce(lambda inner, option: option(inner), reversed(added), command)


def stage_option(
    *name: str, help: str = "Stage description: a .toml file or a shipped name.", **settings: Any
) -> Decorator:
    """Return the options ``--stage`` and ``--follow-links``."""
    option = click.option("--stage", *name, type=described, metavar="TEXT", help=help, **settings)
    return combined(option, FOLLOW_LINKS)


out_option = partial(click.option, "--out", required=True, type=OUT)
# Of the store; addresses in arguments are visible to all users.
store_option = partial(
    click.option, "--store", envvar="LMSHEALTH_STORE", show_envvar=True, metavar="URL"
)


def layouts(given: dict[str, Any]) -> tuple[Layout, ...]:
    """Load the layouts of ``--layouts``."""
    folder = given["layouts"]
    return load_layouts(folder) if folder else ()


def _columns(ctx: click.Context, option: click.Parameter, path: Path | None) -> ColumnMap | None:
    """Load a column map, with the layouts of ``--layouts``; None without both."""
    own = layouts(ctx.params)
    if path is None:
        return replace(ColumnMap(), layouts=own) if own else None
    _inputs().append(path)
    return replace(load_columns(path), layouts=own)


_INPUTS, _LOG = (f"{__name__}.{name}" for name in ("inputs", "log"))
LAYOUTS = click.option(
    "--layouts",
    type=FOLDER,
    metavar="FOLDER",
    is_eager=True,
    help="Folder of layouts (*.toml), by which text of further programs is read.",
)
_COLUMNS = click.option(
    "--columns", type=TABLE, callback=_columns, help="Column map of the export."
)
MOST_MEMORY = click.option(
    "--max-memory",
    type=Finite(0, _MOST_GB, min_open=True),
    default=MAX_MEMORY / 1e9,
    envvar="LMSHEALTH_MAX_MEMORY",
    show_envvar=True,
    metavar="GB",
    callback=lambda ctx, option, gigabytes: 1e9 * gigabytes,
    help="Refuse a log that needs more memory than this to be read (MAT, UFF58, TDMS).",
)
SECONDS_PER_LOG = click.option(
    "--seconds-per-log",
    type=Finite(0, 1e6, min_open=True),
    default=LOG_SECONDS,
    metavar="S",
    help="Refuse a log whose identification takes more processor time than this.",
)
ALLOW_FUTURE = click.option(
    "--allow-future",
    "latest",
    is_flag=True,
    callback=lambda ctx, option, given: LAST_MOMENT if given else None,
    help="Accept logs and maintenance that are dated after tomorrow.",
)
# By which logs are read.
reading_options = combined(_COLUMNS, LAYOUTS, MOST_MEMORY, ALLOW_FUTURE)
TODAY = click.option(
    "--today",
    type=day,
    metavar="DAY",
    help="Judge status and silence as on this day, for runs that repeat; default now.",
)
PART = click.option(
    "--part",
    type=click.Choice(PARTS),
    default="record",
    help="Use the whole log, or one motion phase, derived from the set point.",
)
COV = click.option(
    "--cov", type=TABLE, help="Covariances of estimates; default modes_cov.csv in the same folder."
)
MAINTENANCE = click.option(
    "--maintenance", type=TABLE, help="Table of maintenance, like maintenance.csv."
)
EPOCHS = click.option(
    "--epochs",
    type=click.IntRange(1, _MOST_EPOCHS),
    default=40,
    help="Infer health at this many logs per machine at most.",
)
SEED = click.option(
    "--seed",
    type=click.IntRange(0, _MOST_SEED),
    default=0,
    help="Seed of all random numbers: results repeat.",
)
WORKERS = click.option(
    "--workers",
    type=click.IntRange(1, _MOST_WORKERS),
    callback=lambda ctx, option, count: count or _processors(),
    help="Number of processes; default one per processor (in Python: 1).",
)
# The fields of `Alerts`.
alert_options = combined(
    click.option(
        "--silent-days",
        type=Finite(0, _MOST_DAYS, min_open=True),
        metavar="N",
        help="A machine is unknown after N days without a log; default five of its own intervals.",
    ),
    click.option(
        "--alert-command",
        "command",
        metavar="CMD",
        callback=_words,
        help="Run a program with the changes since the last run as JSON on standard input.",
    ),
    click.option(
        "--notify",
        is_flag=True,
        callback=_notify,
        help=f"Send the changes to the addresses of apprise in {NOTIFY}.",
    ),
)
LANGUAGE = click.option(
    "--language",
    type=click.Choice(LANGUAGES),
    default="en",
    help="Language of the pages; tables and messages are English.",
)
PDF = click.option("--pdf", is_flag=True, help="Also write the page of each stage as PDF.")


def format_option(*styles: str) -> Decorator:
    """Return the option of the output format; the first is the default."""
    return click.option("--format", "style", type=click.Choice(styles), default=styles[0])


def band_option(text: str) -> Decorator:
    """Return the option of a frequency band."""
    return click.option(
        "--band",
        nargs=2,
        type=Finite(0),
        multiple=True,
        metavar="LOW HIGH",
        callback=_band,
        help=text,
    )


def _verbose(ctx: click.Context, option: click.Parameter, given: bool) -> None:
    """Begin to log to standard error."""
    if given:
        handler = logging.StreamHandler()
        handler.addFilter(lambda record: not hasattr(record, "printed"))
        terminal.start_log(ctx, handler)


_OUTPUT = combined(
    eager_option(
        "--log-file",
        type=OUT,
        callback=lambda ctx, option, path: ctx.meta.update({_LOG: path}),  # opened by `_Command`
        help="Append events, notes and errors to a file.",
    ),
    eager_option(
        *("-v", "--verbose"),
        is_flag=True,
        callback=_verbose,
        help="Print a line per event on standard error, with its time.",
    ),
    eager_option(
        *("-q", "--quiet"),
        is_flag=True,
        callback=lambda ctx, option, given: ctx.meta.update({terminal.__name__: given}),
        help="Print results and errors only: no notes and no progress.",
    ),
)


class _Command(click.Command):
    """A command that returns its exit status, and writes no file over another of its files."""

    def invoke(self, ctx: click.Context) -> None:
        """Run the command; one that returns None is done."""
        ctx.exit(super().invoke(ctx) or 0)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Require that each output is a file of its own, then begin the log in its file."""
        words = list(args)
        try:
            left = super().parse_args(ctx, args)
        except LmshealthError:  # such as of a description: the log has it too
            log = ctx.meta.get(_LOG)
            # Words behind that of the error are not parsed, and may name the same file.
            files = [Path(word.removeprefix("--log-file=")).resolve() for word in words]
            if log and files.count(log.resolve()) > 1:
                detail = f"{log} is also the input; needed is another file"
                raise click.BadParameter(detail, ctx, param_hint="--log-file") from None
            self._begin_log(ctx)
            raise
        self._begin_log(ctx)
        return left

    def _begin_log(self, ctx: click.Context) -> None:
        """Refuse an output that is another file of the command; open the log if it is none."""
        log, names = ctx.meta.get(_LOG), {path.resolve(): "the input" for path in _inputs()}
        params = {**ctx.params, "log_file": log}
        for option in sorted(self.params, key=lambda one: one.type is OUT):
            given = params.get(option.name or "")
            for path in given if isinstance(given, tuple) else (given,):
                if not isinstance(path, Path) or (path.exists() and not path.is_file()):
                    continue  # several outputs may be discarded into one device
                name = names.setdefault(path.resolve(), option.opts[0])
                if option.type is OUT and name != option.opts[0]:
                    name = name if name.startswith("-") else "the input"
                    detail = f"{path} is also {name}; needed is another file"
                    raise click.BadParameter(detail, ctx, option)
        if log:
            terminal.start_log(ctx, logging.FileHandler(log, encoding="utf-8"))


def command(*examples: str) -> Callable[[Callable[..., Any]], click.Command]:
    """Return the decorator of a command; the examples are the end of its help."""
    # click does not wrap a paragraph that begins with a backspace.
    lines = ["\b", "Examples:", *(f"    lmshealth {example}" for example in examples)]
    made = click.command(cls=_Command, epilog="\n".join(lines))
    return lambda function: made(_OUTPUT(function))
