"""Commands that read single logs: init, modes, error, spectrum, frf."""

import math
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import click
from msgspec.structs import replace

from lmshealth._private.files import write_text
from lmshealth._private.tables import TABLES, Row
from lmshealth._private.toml import decode
from lmshealth.cli import options, terminal, views
from lmshealth.errors import BadLog, BadStage
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.constants import RANGES
from lmshealth.io.log import Log, Refusal
from lmshealth.io.manifest import MANIFEST, NOT_LOGS, Manifest, read_manifest_beside
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import shown
from lmshealth.modal.deterministic.frequency_response import FrfReading, read_frf, read_measured
from lmshealth.modal.deterministic.measured import MeasuredResponse, read_responses
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.mode_shapes import mode_shapes
from lmshealth.modal.naming import compare, name_response, why_unnamed
from lmshealth.report import tables
from lmshealth.signal.readings import find_growth, loop_error, read_error
from lmshealth.stage.description import ModeSpec
from lmshealth.stage.proposal import moment_of, propose, searches, write_skeleton

Result = TypeVar("Result")

_NO_BAND = (
    "Without a band or a description close modes may be merged or missed; select them with --band "
    "LOW HIGH. The mode names are valid for this call only."
)
# Most harmonics or averages; longest period or time constant in s, and amplitude in nm.
_MOST_LINES, _LONGEST = 1_000_000, 1e12
_TRIED = 2  # channels in which `init` looks for modes
# Signal-to-noise ratio of the modes in the band that it proposes, and factor to its ends.
_CLEAR, _BESIDE = 3.0, 1.3
_FORMAT = options.format_option("table", "csv", "json")
_OVERWRITE = click.option("--overwrite", is_flag=True, help="Replace files that exist.")
_PLOT = click.option(
    "--plot",
    type=options.OUT,
    metavar="FILE",
    help="Draw what was measured in one log, with modes, lines and refusals: svg, png or html.",
)


@options.command("init logs/*.csv", "init export.txt --sample-rate 5000 --out machine-7")
@options.LOGS
@click.option(
    "--out", type=options.FOLDER, default=Path(), metavar="FOLDER", help="Where to write the files."
)
@click.option(
    "--sample-rate",
    "rate",
    type=options.Finite(*RANGES["sample_rate_hz"]),
    metavar="HZ",
    help="Sample rate of logs that state neither times nor a rate.",
)
@_OVERWRITE
@options.LAYOUTS
@options.MOST_MEMORY
@options.ALLOW_FUTURE
def init(logs: tuple[Path, ...], out: Path, **given: Any) -> int:
    """Propose map.toml, manifest.csv and my-stage.toml from logs.

    The column map is proposed from the first log, with the reason of each guess, and tried on all.
    The description has the modes of the first log that is read. Check and edit all three.
    """
    logs = tuple(path for path in logs if path.name not in NOT_LOGS) or logs
    map_file, sheet, stage = files = out / "map.toml", out / MANIFEST, out / "my-stage.toml"
    there = [str(path) for path in files if path.exists()]
    if there and not given["overwrite"]:
        raise click.UsageError(f"{', '.join(there)} would be replaced; set --overwrite or --out.")
    layouts, how = options.layouts(given), ("rate", "max_memory", "latest")
    text, guesses = propose(logs[0], **{name: given[name] for name in how}, layouts=layouts)
    rows = [{"column": g.source, "read as": g.target or "-", "why": g.why} for g in guesses]
    terminal.print_table(f"Columns of {logs[0]}", rows, 3)
    columns = replace(decode(text.encode(), ColumnMap), layouts=layouts)
    given |= {"logs": logs, "columns": columns}
    first: list[Log] = []
    paths = {shown(path): path for path in logs}

    def tried(log: Log) -> Row:
        first[:] = first or [log]
        path, own = paths[log.name], log.metadata
        moment, remark = moment_of(path, log, layouts)
        return {
            "file": path.absolute(),
            "stage": own.stage or path.absolute().parent.name,
            "recorded_at": moment,
            "travel_km": None if own.travel is None else own.travel / 1e3,
            "temperature_c": own.covariates.get("temperature_c"),
            "remark": f"recorded_at: {remark or 'not found'}",
        }

    found, lost = _each(given, tried)
    if found:
        write_text(map_file, text)
        terminal.print_notes([f"{map_file}: column map, tried on {len(found)} logs"])
        _propose_manifest(sheet, found)
        odometer = any(row["travel_km"] is not None for row in found)
        band = _propose_stage(stage, first[0], odometer)
        terminal.print_notes(_next_steps(first[0], map_file, given["layouts"], band))
    return _status(found, lost)


def _propose_manifest(sheet: Path, rows: list[Row]) -> None:
    """Write a manifest with what the files state; a manifest names no file out of its folder."""
    import pandas as pd  # late: only this needs it

    folder = sheet.absolute().parent
    if outside := [row["file"] for row in rows if not row["file"].is_relative_to(folder)]:
        why = f"not written, {outside[0]} is not in its folder: choose --out with the logs in it"
        terminal.print_notes([f"{sheet}: {why}"])
        return
    table = pd.DataFrame(rows)
    table["file"] = [path.relative_to(folder).as_posix() for path in table["file"]]
    write_text(sheet, table.to_csv(index=False))
    why = "stage is the folder where the file names none; fill in what is empty (see remark)"
    terminal.print_notes([f"{sheet}: {why}"])


def _next_steps(
    log: Log, map_file: Path, layouts: Path | None, band: tuple[int, int] | None
) -> Iterator[str]:
    """Name the commands that read a log by its proposed map."""
    by = {one.kind: one.name for one in reversed(log.channels)}
    what = f"{shlex.quote(log.name)} --columns {shlex.quote(str(map_file))}"
    what += f" --layouts {shlex.quote(str(layouts))}" if layouts else ""
    yield f"next: lmshealth modes {what}" + (f" --band {band[0]} {band[1]}" if band else "")
    if "current" in by:
        ends = f"--input {by['current']} --output {by.get('acceleration', by.get('displacement'))}"
        yield f"or, where a current excites: lmshealth frf {what} {ends}"


def _propose_stage(path: Path, log: Log, odometer: bool) -> tuple[int, int] | None:
    """Write a description of the modes of a log, where it has some.

    Its clock is the time if no log has an odometer. Return a band in Hz around those that are clear
    in few channels, which is quick; all channels are searched in it, as by `modes`.
    """
    from lmshealth.modal.identification import read_modes

    used, band = [one.name for one in log.channels if one.kind != "current"][:_TRIED], None
    try:
        with terminal.progress_bars(terminal.PATIENCE) as report:
            find = partial(read_modes, log, progress=report)
            modes = find(channels=used).modes
            clear = modes.frequency[modes.snr >= _CLEAR]
            if clear.size:
                band = int(clear.min() / _BESIDE), math.ceil(clear.max() * _BESIDE)
                with suppress(BadLog):  # those of few channels then
                    modes = find(band=band).modes
        _save(path, LogEstimates(log.name, log.digest, log.metadata, modes), odometer=odometer)
    except (BadLog, BadStage) as why:
        terminal.print_notes([f"{path.name}: {why}"])
        return None
    return band


def _channels(
    ctx: click.Context, option: click.Parameter, given: tuple[str, ...]
) -> list[str] | None:
    """Return the names of lists with commas, each once."""
    names = dict.fromkeys(name.strip() for listed in given for name in listed.split(","))
    if "" in names:
        detail = f"{','.join(given)!r} has an empty name"
        raise click.BadParameter(detail, param_hint="--channels")
    return list(names) or None


@options.command(
    "modes log.h5 --stage lms-y",
    "modes export.csv --columns map.toml --band 80 200 --format json",
    "modes moves.h5 --stage lms-y --part settling",
    "modes log.h5 --band 80 200 --save my-stage.toml --plot modes.html",
)
@options.LOGS
@options.stage_option()
@click.option(
    "--part",
    type=click.Choice(["constant", "settling"]),
    help="Use segments of constant velocity (or a whole log at rest), or free decays after moves; "
    "default: the response to a measured excitation, else the first that can be used.",
)
@options.reading_options
@click.option(
    "--channels",
    multiple=True,
    callback=_channels,
    help="Use only these channels, separated by commas; may be given several times.",
)
@options.band_option("Use only this band, in Hz.")
@click.option(
    "--save",
    type=options.OUT,
    metavar="FILE.toml",
    help="Write a stage description with the modes found in one log, ready to edit.",
)
@_OVERWRITE
@_PLOT
@click.option("--shapes", is_flag=True, help="Print mode shapes, their complexity and their MAC.")
@click.option(
    "--merge",
    is_flag=True,
    help="Merge logs of several set-ups of one machine, whose sensors rove, to one shape per mode.",
)
@_FORMAT
def modes(**given: Any) -> int:
    """Identify the modes of single logs: natural frequency and damping ratio.

    json also lists complex mode shapes, their phase collinearity (MPC), the modal assurance
    criterion (MAC) of each pair of modes, spectral lines, and the factors that make up std_factor.
    """
    stage, band = given["stage"], given["band"]
    _check_outputs(given)
    chosen: Any = {"channels": given["channels"], "band": band}

    def estimate(log: Log) -> LogEstimates:
        # Late: help and refusals of files need none of it.
        from lmshealth.modal.identification import read_ambient, read_decays, read_modes

        if given["part"] == "settling":
            reading = read_decays(log, stage, **chosen)
        else:
            read = read_ambient if given["part"] == "constant" else read_modes
            reading = read(log, stage, **chosen, progress=given["progress"])
        if given["plot"]:
            from lmshealth.report import log_figures  # late: most commands draw nothing

            figure = log_figures.modes_figure(log, reading, stage, band=band)
            log_figures.write_figure(given["plot"], figure)
        shapes = mode_shapes(reading.modes, reading.fitted)
        own = log.name, log.digest, log.metadata, reading.modes, loop_error(log)
        return LogEstimates(*own, shapes=shapes, sample_rate=log.sample_rate)

    found, lost = _each(given, estimate)
    if given["merge"] and found:
        from lmshealth.modal.setups import merge_setups

        found = [merge_setups(found)]
    shapes = [tables.shapes_rows(one.log, one.shapes) for one in found if one.shapes]
    of_shapes, of_mac = ([row for own in shapes for row in own[k]] for k in (0, 1))
    content = _estimates_content(found, shapes=of_shapes, mac=of_mac)
    off = TABLES["off_description"]
    differing = [
        row for one in found if stage for row in off.rows_of(compare(one.modes, stage), log=one.log)
    ]
    content |= {"off_description": differing} if differing else {}
    refused = [refusal for one in found for refusal in one.modes.refused]

    def show(rejected: list[Row]) -> None:
        views.print_modes(content["modes"], rejected, differing)
        if given["shapes"]:
            views.print_shapes(of_shapes, of_mac)
        if content["modes"] and stage is None and band is None:
            terminal.print_text(_NO_BAND)

    return _finish(given, content, refused, found, lost, show)


def _estimates_content(
    estimates: Sequence[LogEstimates], **shapes: list[Row]
) -> dict[str, list[Row]]:
    """Return the rows of estimates, and those of their shapes, by table."""
    return {
        "modes": [row for one in estimates for row in tables.modes_rows(one)],
        "lines": [row for one in estimates for row in tables.lines_rows(one.log, one.modes.lines)],
        **shapes,
        "std_factors": [row for one in estimates for row in tables.factor_rows(one.log, one.modes)],
    }


def _check_outputs(given: dict[str, Any]) -> None:
    """Refuse outputs that cannot be written, before a log is analysed."""
    if given.get("save") and given["stage"] is not None:
        raise click.UsageError("--save writes a first description; with --stage there is one.")
    for option, endings in (("save", ".toml"), ("plot", ".svg, .png or .html")):
        path, n_logs = given.get(option), len(given["logs"])
        if path is None:
            continue
        if n_logs != 1 and not (option == "save" and given["merge"]):
            raise click.UsageError(f"--{option} needs exactly one log; got {n_logs}.")
        if path.suffix not in re.findall(r"\.\w+", endings):
            raise click.BadParameter(f"{path} must end in {endings}", param_hint=f"--{option}")
        if option == "save" and path.exists() and not given["overwrite"]:
            detail = f"{path} exists; set --overwrite, or choose another name"
            raise click.BadParameter(detail, param_hint="--save")


def _save(path: Path, found: LogEstimates, *, odometer: bool = True) -> None:
    modes, specs = found.modes, []
    for k, search in enumerate(searches(modes.frequency.tolist())):
        frequency, damping = float(modes.frequency[k]), float(modes.damping_ratio[k])
        snr = float(modes.snr[k])
        spec = ModeSpec(modes.names[k], frequency, damping, snr=snr, search=search)
        comment = f"± {modes.frequency_std[k]:.2g}, clearest in {modes.channels[k]}"
        specs.append((spec, comment))
    source = f"identified in {found.log}"
    write_skeleton(path, source, found.metadata.stage, specs, odometer=odometer)
    terminal.print_notes([f"{path}: description of {len(specs)} modes, ready to edit"])


@options.command(
    "error velocities/*.h5", "error log.h5 --count 20 --floor-nm 50 --part settling --format json"
)
@options.LOGS
@click.option(
    "--count",
    type=click.IntRange(1, _MOST_LINES),
    default=100,
    help="Number of strongest harmonics.",
)
@click.option(
    "--floor-nm",
    type=options.Finite(0, _LONGEST),
    default=30.0,
    help="Amplitude in nm above which harmonics are counted separately.",
)
@options.PART
@options.reading_options
@_FORMAT
def error(**given: Any) -> int:
    """Analyse the following error: statistics, strongest harmonics, bandwidth.

    Statistics are of all samples, harmonics of the longest segment without gaps. The sum of the
    listed harmonics (json) reconstructs the following error.
    """
    analysis = {"count": given["count"], "floor": 1e-9 * given["floor_nm"], "part": given["part"]}
    found, lost = _each(given, lambda log: (log, read_error(log, **analysis)))
    pairs = [(log.name, one) for log, own in found for one in own]
    rows = [tables.error_row(*pair) for pair in pairs]
    harmonics = [row for pair in pairs for row in tables.harmonics_rows(*pair)]
    refused = [refusal for log, _ in found for refusal in log.refused]
    show = partial(views.print_error, rows, harmonics)
    return _finish(given, {"error": rows, "harmonics": harmonics}, refused, found, lost, show)


@options.command(
    "spectrum velocities/*.h5 --stage lms-y", "spectrum velocities/*.h5 --band 10 400 --format csv"
)
@options.LOGS
@options.stage_option()
@options.band_option(
    "Only modes, grid and lines in this band, in Hz; default 10 to 400 without a stage."
)
@options.PART
@options.reading_options
@_FORMAT
def spectrum(**given: Any) -> int:
    """Measure accelerations per mode and velocity, and which of them grow with velocity.

    With a stage: its modes, and the RMS in its health band and watched bands; without: a grid of
    10 Hz. The magnitude is the amplitude of the strongest harmonic of a band. The test for spectral
    lines has a false-alarm probability of 1 % per channel.
    """
    from lmshealth.modal.acceleration_survey import survey

    stage, band, part = given["stage"], given["band"], given["part"]
    found, lost = _each(given, lambda log: survey(log, stage, band, part=part))
    magnitudes = [item for own in found for item in own.magnitudes]
    growth = find_growth(magnitudes)
    of_logs = [(own.log, line) for own in found for line in own.lines]
    rows = tables.magnitudes_rows(magnitudes, growth, of_logs)
    lines = [row for own in found for row in tables.lines_rows(own.log, own.lines)]
    refused = [refusal for own in found for refusal in own.refused]
    content = {"magnitudes": rows, "growth": tables.growth_rows(growth), "lines": lines}
    show = partial(views.print_magnitudes, rows, lines)
    return _finish(given, content, refused, found, lost, show)


@options.command(
    "frf sweep.h5 --input current_excitation --output acc_pitch --band 95 175",
    "frf bench.mat --columns map.toml --input current --output delta_e --period 1",
    "frf hammer.csv --input current_force --output acc_tool",
    "frf analyser.uff --output 2+Z --plot response.html",
    "frf sweeps/*.h5 --input current_excitation --output acc_pitch --stage lms-y "
    "--format csv > modes.csv",
)
@options.LOGS
@click.option("--input", "source", metavar="NAME", help="Channel of the excitation.")
@click.option(
    "--output", metavar="NAME", help="Channel of the response; of measured responses, which one."
)
@options.stage_option()
@options.band_option("Use only this band, in Hz; default: the excited band.")
@click.option(
    "--period",
    type=options.Finite(0, _LONGEST, min_open=True),
    metavar="S",
    help="Period of the excitation in s, to 1 %; default: found from a periodic input.",
)
@click.option(
    "--impact/--no-impact",
    default=None,
    help="Blows of a hammer, which are averaged; default: recognised from the input.",
)
@click.option(
    "--averages",
    type=click.IntRange(2, _MOST_LINES),
    metavar="N",
    help="Averages of a measured response: with its coherence they give the noise.",
)
@click.option(
    "--exponential",
    type=options.Finite(1e-12, _LONGEST),
    metavar="S",
    help="Time constant of the exponential window on a measured response; its damping is removed.",
)
@options.reading_options
@_PLOT
@_FORMAT
def frf(**given: Any) -> int:
    """Measure the frequency response between two channels and identify its modes.

    A periodic input is averaged over whole periods, blows of a hammer over blows (double hits and
    overloads are refused), any other input over segments. Measured responses
    (UFF58, or a table with frequency_hz, real, imag) need no channels. csv lists the modes;
    json also the response with H1, H2, Hv and coherence. With a stage, a mode is named
    if it is the only one in its search band.
    """
    stage, band, period = given["stage"], given["band"], given["period"]
    source, output = given["source"], given["output"]
    _check_outputs(given)
    if given["impact"] and period is not None:
        raise click.UsageError("--period has no effect on blows of a hammer (--impact).")

    def analyse(log: Log | MeasuredResponse) -> tuple[Log | MeasuredResponse, FrfReading]:
        is_measured = isinstance(log, MeasuredResponse)
        unused = ("period", "impact") if is_measured else ("averages", "exponential")
        if any(given[option] is not None for option in unused):
            what = "a measured response" if is_measured else "a log"
            names = " and ".join(f"--{option}" for option in unused)
            raise click.UsageError(f"{log.name} is {what}, on which {names} have no effect.")
        if isinstance(log, MeasuredResponse):
            averages, window = given["averages"], given["exponential"]
            return log, read_measured(log, band=band, averages=averages, window=window)
        impact = given["impact"]
        return log, read_frf(log, source, output, band=band, period=period, impact=impact)

    found, lost = _each(given, analyse, partial(_responses, source, output))
    if given["plot"] and len(found) > 1:
        raise click.UsageError(f"--plot draws one of {len(found)} responses; choose by --output.")
    estimates = []
    for log, own in found:
        named = name_response(own.modes, stage) if stage else own.modes
        estimates.append(LogEstimates(log.name, log.digest, log.metadata, named))
        if given["plot"]:
            from lmshealth.report import log_figures  # late: most commands draw nothing

            figure = log_figures.response_figure(log, own, named, stage)
            log_figures.write_figure(given["plot"], figure)
    fits = [tables.fit_row(log.name, own) for log, own in found]
    responses = [row for log, own in found for row in tables.frf_rows(log.name, own)]
    # The first table is that of csv.
    content = {"modes": [], "fit": fits, "frf": responses} | _estimates_content(estimates)
    refused = [refusal for _, own in found for refusal in own.modes.refused]
    if stage and given["style"] != "json":
        notes = [f"{one.log}: {why}" for one in estimates for why in why_unnamed(one.modes, stage)]
        terminal.print_notes(notes)
    show = partial(views.print_frf, fits, responses, content["modes"])
    return _finish(given, content, refused, found, lost, show)


def _responses(
    source: str | None, output: str | None, path: Path, **reading: Any
) -> list[Log | MeasuredResponse]:
    """Read the measured responses of a file that are asked for, or its log."""
    named = source is not None and output is not None
    measured = read_responses(path, **reading)
    used = [r for r in measured if output in (None, r.output) and source in (None, r.input)]
    if used:
        return list(used)
    if measured:
        there = ", ".join(f"{r.output} to {r.input}" for r in measured)
        why = f"no response of {output or 'any'} to {source or 'any'}; there: {there}"
        raise BadLog(str(path), "channel", why)
    if named:
        return [read_log(path, **reading)]
    raise click.UsageError(
        f"{path} has no column frequency_hz (or data set of function type 4), so it is a log: "
        "needed are --input NAME and --output NAME."
    )


def _finish(
    given: dict[str, Any],
    content: dict[str, list[Row]],
    refused: Sequence[Refusal],
    found: Sequence[Any],
    lost: Sequence[Refusal],
    show: Callable[[list[Row]], None],
) -> int:
    """Print results as csv (the first table of the content), json, or tables; save them.

    Tables list refused parts of logs, but not lost logs. Return the exit status.
    """
    if given["style"] == "csv":
        name, rows = next(iter(content.items()))
        click.echo(tables.csv_text(name, rows), nl=False)
    elif given["style"] == "json":
        terminal.print_json({**content, "refused": tables.refused_rows([*lost, *refused])})
    elif found:
        show(tables.refused_rows(refused))
    if given.get("save") and found:
        _save(given["save"], found[0])
    return _status(found, lost)


def _each(
    given: dict[str, Any],
    analyse: Callable[[Any], Result],
    read: Callable[..., list[Any]] = lambda path, **reading: [read_log(path, **reading)],
) -> tuple[list[Result], list[Refusal]]:
    """Analyse one log after the other; return results and refused logs.

    ``read`` reads what a file holds. ``given["progress"]`` is set to report progress.
    """
    found: list[Result] = []
    lost: list[Refusal] = []
    manifests: dict[Path, Manifest] = {}
    reading = {name: given[name] for name in ("columns", "max_memory", "latest")}
    named = given["logs"]
    # A pattern such as *.csv does not mean the manifest in the same folder.
    paths = [path for path in named if path.name not in NOT_LOGS] or named
    paths = list({path.absolute(): path for path in paths}.values())  # a log is used once

    def items(path: Path) -> list[Any]:
        if path.parent not in manifests:
            beside = manifests[path.parent] = read_manifest_beside(path)
            faults = [refusal for refusal in beside.refused if refusal.log == MANIFEST]
            terminal.print_notes(_sentences(faults))
        logs = read(path, **reading, overrides=manifests[path.parent].overrides(path))
        for log in logs:
            if isinstance(log, Log):
                terminal.print_notes(_remarks(log, *(given.get("band") or (0.0, 0.0))))
        return logs

    with terminal.progress_bars(terminal.PATIENCE) as given["progress"]:
        for path in terminal.counted(given["progress"], "logs", paths):
            with _refusing(lost):
                for item in items(path):
                    with _refusing(lost):
                        found.append(analyse(item))
    return found, lost


def _remarks(log: Log, low: float, high: float) -> Iterator[str]:
    """Yield what was guessed of a log, and whether a band in Hz ends above what it shows."""
    if log.guessed:
        yield f"{log.name} is read with {', '.join(log.guessed)}; [csv] of a column map overrides"
    if low < (most := log.sample_rate / 2) < high:
        yield (
            f"{log.name}: the band {low:g} to {high:g} Hz ends above {most:g} Hz, half the sample "
            "rate: nothing is seen there"
        )


@contextmanager
def _refusing(lost: list[Refusal]) -> Iterator[None]:
    """Note a log that cannot be used, and go on."""
    try:
        yield
    except BadLog as why:
        lost.append(Refusal(why.log, why.reason, why.detail))


def _sentences(refused: Sequence[Refusal]) -> list[str]:
    return [f"{refusal.log}: {refusal.reason}: {refusal.detail}" for refusal in refused]


def _status(found: Sequence[object], lost: Sequence[Refusal]) -> int:
    """Print which logs are lost, and why; return the exit status."""
    terminal.print_errors(_sentences(lost))
    return 0 if not lost else options.SOME_REFUSED if found else 1
