"""Command line of the simulated stages: ``python -m models``."""

from __future__ import annotations

import codecs
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from models.dynamics.margins import GAIN_MARGIN_DB, PHASE_MARGIN_DEG, TABLE_1, cases, margin_record
from models.dynamics.modal_map import modal_map
from models.dynamics.mode_shapes import body_motions, participation, strain_energy
from models.dynamics.plant import SENSORS, closed_loop_modes
from models.dynamics.stages import NOMINAL, Condition, stage_named
from models.errors import ModelError
from models.lives.faults import FAULTS
from models.lives.further_lives import ALL_LIVES
from models.lives.simulation import UNTIL, Plan, simulate_life
from models.recordings.effects import EFFECTS
from models.recordings.formats import WRITERS, format_of, write_log
from models.recordings.machines import machine_identity, stream
from models.recordings.recording import signal_to_noise
from models.recordings.strokes import VELOCITIES, WINDOW_S
from models.recordings.sweep import Sweep, record_sweep
from models.recordings.velocities import Experiment, drive_velocities

_TABLE_WIDTH = 100
_ERRORS = "models-readable"
_EXAMPLES = {
    "modes": "python -m models modes lms-y --preload 0.8 --format json",
    "map": "python -m models map lms-y --out lms-y.map.csv",
    "margins": "python -m models margins lms-x --format json",
    "simulate": (
        "python -m models simulate lms-y --life both --logs 60 --seconds 20 --seed 1 --out life"
    ),
    "velocities": "python -m models velocities lms-y --out velocities",
    "sweep": "python -m models sweep lms-y --amplitude 0.1 --seconds 20 --out sweep.h5",
}


def _epilog(command: str) -> str:
    """Return the example under a command's help."""
    return f"Example: {_EXAMPLES[command]}"


def _condition_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the two health parameters to a command as options."""
    preload = click.option(
        "--preload", default=1.0, show_default=True, help="Guide preload, 1 as new."
    )
    mount = click.option(
        "--mount", default=1.0, show_default=True, help="Mount stiffness, 1 as new."
    )
    return preload(mount(command))


def _format_option(
    formats: Sequence[str], default: str | None
) -> Callable[..., Callable[..., None]]:
    """Return the option that chooses a format."""
    kinds = click.Choice(list(formats))
    return click.option("--format", "file_format", type=kinds, default=default, show_default=True)


_effects_option = click.option(
    "--effects",
    type=click.Choice(list(EFFECTS)),
    default="linear",
    show_default=True,
    help="disturbed: gusts, hits, bumps, cage orders; full: friction and limits of the drive too.",
)
_shown_as = _format_option(("table", "json"), "table")
_written_as = _format_option(tuple(WRITERS), "hdf5")


@click.group()
def cli() -> None:
    """Simulate the linear-motor stages LMS-X and LMS-Y: modes, modal maps, lives of logs."""


def _mode_records(stage_name: str, condition: Condition) -> list[dict[str, Any]]:
    """Return the modal table of a stage as JSON-ready records."""
    stage = stage_named(stage_name)
    ratios = signal_to_noise(stage, condition)
    return [
        {
            "mode": mode.name,
            "frequency_hz": mode.frequency_hz,
            "damping_ratio": mode.damping_ratio,
            "direction": mode.direction,
            "participation": participation(stage, mode, condition),
            "strain_energy": strain_energy(stage, mode, condition),
            "snr": ratios.get(mode.name),
            "shape": body_motions(stage, mode, condition),
        }
        for mode in closed_loop_modes(stage, condition)
    ]


@cli.command(epilog=_epilog("modes"))
@click.argument("stage")
@_condition_options
@click.option(
    "--temperature", default=NOMINAL.temperature_c, show_default=True, help="Temperature, °C."
)
@click.option(
    "--position", default=0.0, show_default=True, help="On the travel, mm from its middle."
)
@_shown_as
def modes(stage: str, preload: float, mount: float, file_format: str, **state: float) -> None:
    """Print the closed-loop modes of STAGE (lms-x, lms-y, lms-x-full or lms-y-full).

    Participation is the displacement that a signal reads in the mode, as a part of the mode's
    largest; then the share of the strain energy in the isolators, the mount and the guide. JSON
    has that of every joint, the motion of every body and, for roll, pitch and yaw, the modal
    signal-to-noise ratio at 10 mm/s.
    """
    condition = Condition(preload, mount, state["temperature"], position_mm=state["position"])
    records = _mode_records(stage, condition)
    if file_format == "json":
        click.echo(json.dumps({"modes": records}, indent=2))
        return
    joints = ("isolator", "mount", "guide")
    heads = ("mode", "Hz", "damping %", *SENSORS, *joints)
    table = Table(*heads, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for record in records:
        table.add_row(
            record["mode"],
            f"{record['frequency_hz']:.2f}",
            f"{100 * record['damping_ratio']:.2f}",
            *(f"{record['participation'][name]:.4f}" for name in SENSORS),
            *(f"{100 * sum(record['strain_energy'][name]):.1f} %" for name in joints),
        )
    _print_table(table)


def _print_table(table: Table) -> None:
    """Print a table, or where a terminal is too narrow for it a line for each cell."""
    console = Console(highlight=False)
    if not console.is_terminal:  # cut-off names are useless in a file or a pipe
        console.width = max(console.width, _TABLE_WIDTH)
    elif (
        console.measure(table, options=console.options.update(max_width=1000)).maximum
        > console.width
    ):
        for cells in zip(*(column.cells for column in table.columns), strict=True):
            for column, cell in zip(table.columns, cells, strict=True):
                console.print(f"{column.header}: {cell}", overflow="fold")
            console.print()
        return
    console.print(table)


def _loop_table(loops: list[dict[str, Any]]) -> Table:
    """Return one row per loop: stability, peak sensitivity, verdict."""
    table = Table("reading", "structure", "equations", "growth 1/s", "peak |S|", "at Hz", "verdict")
    for loop in loops:
        table.add_row(
            *(loop[name] for name in ("reading", "structure", "equations")),
            f"{loop['growth_per_s']:.2f}",
            f"{loop['peak_sensitivity']:.3f}",
            f"{loop['peak_sensitivity_hz']:.4g}",
            loop["verdict"],
        )
    return table


def _crossover_table(loops: list[dict[str, Any]]) -> Table:
    """Return one row per crossover of each loop; a star marks the smallest margin of its kind."""
    judged = {None: "", True: "enough", False: "too small"}
    table = Table("loop", "crossover", "Hz", "margin", "near mode", "judged")
    for loop in loops:
        name = f"{loop['reading']}, {loop['structure']}, {loop['equations']}"
        for row in loop["crossovers"]:
            phase, gain = row["phase_margin_deg"], row["gain_margin_db"]
            table.add_row(
                name,
                row["crossover"].replace(" crossover", ""),
                f"{row['frequency_hz']:.4g}",
                f"{gain:.1f} dB" if phase is None else f"{phase:.1f}°",
                row["near"] or "",
                judged[row["enough"]] + " *" * row["decides"],
            )
            name = ""
        table.add_section()
    return table


@cli.command(epilog=_epilog("margins"))
@click.argument("stage")
@_condition_options
@_shown_as
def margins(stage: str, preload: float, mount: float, file_format: str) -> None:
    """Print the margins of the position loop of STAGE, as printed, corrected and derived.

    Rigid as in equations (6)-(11), and with the flexible structure inside. Needed are 6 dB and
    30°. A gain margin is the change of the gain that reaches -1: at an upper phase crossover a
    rise, at a lower one a fall. Margins of an unstable loop, or of one without roll-off, are not
    judged.
    """
    loops = [margin_record(case) for case in cases(stage, Condition(preload, mount))]
    names = ("bandwidth_hz", "gain_margin_db", "phase_margin_deg")
    table_1 = dict(zip(names, TABLE_1[stage], strict=True))
    if file_format == "json":
        needed = {"gain_margin_db": GAIN_MARGIN_DB, "phase_margin_deg": PHASE_MARGIN_DEG}
        report = {"stage": stage, "needed": needed, "table_1": table_1, "loops": loops}
        click.echo(json.dumps(report, indent=2))
        return
    _print_table(_loop_table(loops))
    _print_table(_crossover_table(loops))
    lines = (
        "* the smallest of its kind in this loop: it decides.\n"
        "Table 1 of the paper, measured: bandwidth {bandwidth_hz} Hz, gain margin "
        "{gain_margin_db} dB, phase margin {phase_margin_deg}°.".format(**table_1)
    )
    # A pipe gets whole lines, a terminal what fits.
    Console(highlight=False, soft_wrap=not sys.stdout.isatty()).print(lines)


@cli.command("map", epilog=_epilog("map"))
@click.argument("stage")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True)
def map_command(stage: str, out: Path) -> None:
    """Write the modal map of STAGE over guide preload and mount stiffness."""
    modal_map(stage_named(stage)).to_csv(out, index=False, float_format="%.12g")


@cli.command(epilog=_epilog("simulate"))
@click.argument("stage")
@click.option(
    "--life",
    default=None,
    help=f"Name of the life: {', '.join(ALL_LIVES)}. With --plant-seed alone it is drawn.",
)
@click.option("--logs", type=int, required=True, help="Count of logs.")
@click.option("--seconds", type=float, default=20.0, show_default=True, help="Length of each.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option(
    "--plant-seed",
    type=click.IntRange(0),
    default=None,
    help="Draw the machine: geometry, joints, wear, sensors, wander. Without it, the nominal one.",
)
@click.option(
    "--until",
    type=click.Choice(UNTIL),
    default="now",
    show_default=True,
    help="Odometer of the last log: at 1,400 to 2,000 km, or past the first limit crossed.",
)
@click.option(
    "--fault",
    "faults",
    type=click.Choice(list(FAULTS)),
    multiple=True,
    help="Fault of the recording in a tenth of the logs; repeat it for several.",
)
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True)
@_written_as
@_effects_option
@click.option(
    "--workers", type=int, default=None, help="Processes; without it 2 where there are 2 cores."
)
def simulate(
    stage: str,
    life: str | None,
    logs: int,
    seconds: float,
    seed: int,
    plant_seed: int | None,
    until: str,
    faults: tuple[str, ...],
    out: Path,
    file_format: str,
    effects: str,
    workers: int | None,
) -> None:
    """Write a life of STAGE: logs, manifest.csv, maintenance.csv and truth.csv.

    truth.csv has the true condition and every mode's closed-loop frequency and damping at each
    log, the effects, and the odometers at which the limits are crossed, whether or not the logs go
    that far.

    The seed alone draws the laws: with --until failure the same life is seen to its end. With
    --plant-seed that one draws the machine and its laws, and --seed the rest; truth.csv then has
    every number that was drawn.
    """
    if life is None and plant_seed is None:
        needed = "the name of a life, or --plant-seed N, whose life is 'drawn'"
        raise click.UsageError(f"--life is missing; needed: {needed}")
    life = life or "drawn"
    plan = Plan(stage, life, logs, seconds, seed, file_format, until, faults, plant_seed, effects)
    count = min(2, os.cpu_count() or 1) if workers is None else workers
    _with_progress(logs, lambda advance: simulate_life(plan, out, workers=count, progress=advance))


@cli.command(epilog=_epilog("sweep"))
@click.argument("stage")
@click.option("--low", default=20.0, show_default=True, help="Lowest frequency, Hz.")
@click.option("--high", default=1000.0, show_default=True, help="Highest frequency, Hz.")
@click.option("--amplitude", default=0.1, show_default=True, help="Amplitude of the current, A.")
@click.option("--period", default=5.0, show_default=True, help="Duration of one sweep, s.")
@click.option("--law", type=click.Choice(["log", "linear"]), default="log", show_default=True)
@click.option("--seconds", default=20.0, show_default=True, help="Length of the log.")
@click.option(
    "--velocity",
    default=10.0,
    show_default=True,
    help="Velocity of the move, mm/s; lowered to what the travel allows for so long.",
)
@_condition_options
@_effects_option
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True)
@_format_option(tuple(WRITERS), None)
def sweep(stage: str, out: Path, file_format: str | None, **options: Any) -> None:
    """Write an FRF log of STAGE: the motor current holds a sine that sweeps while it moves.

    The sine alone is the column current_excitation_a, with the servo's current it is current_a.
    A response to the first has the poles of the closed loop, as `modes` prints them; one to the
    second has those of the structure without it. Every period is a whole sweep; from the
    difference between periods the noise can be estimated. The suffix of --out selects the format.
    """
    chosen = format_of(out, file_format)
    wave = Sweep(*(options[name] for name in ("low", "high", "amplitude", "period", "law")))
    machine = stage_named(stage)
    recording = record_sweep(
        machine,
        wave,
        Condition(options["preload"], options["mount"]),
        seconds=options["seconds"],
        velocity=options["velocity"] * 1e-3,
        rng=stream(stage, options["seed"], "sweep"),
        effects=EFFECTS[options["effects"]],
    )
    identity = machine_identity(machine, options["seed"])
    write_log(recording.described(stage=identity), out, chosen)


@cli.command(epilog=_epilog("velocities"))
@click.argument("stage")
@click.option(
    "--velocity",
    "velocities",
    type=float,
    multiple=True,
    default=[1e3 * v for v in VELOCITIES],
    show_default=True,
    help="Set velocity, mm/s; repeat it for several.",
)
@click.option("--strokes", default=1, show_default=True, help="Strokes of each move.")
@click.option("--dwell", default=0.5, show_default=True, help="Standstill after a stroke, s.")
@click.option("--seconds", default=WINDOW_S, show_default=True, help="Length of each log.")
@_condition_options
@_effects_option
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True)
@_written_as
def velocities(
    stage: str, velocities: tuple[float, ...], out: Path, file_format: str, **options: Any
) -> None:
    """Write one log of STAGE per set velocity: full strokes with acceleration and braking.

    Each log is a window about the middle of the move: a slow stroke fills it with constant
    velocity, a fast one fits into it with its transients.
    """
    condition = Condition(options["preload"], options["mount"])
    sizes = (options[name] for name in ("strokes", "dwell", "seconds", "seed"))
    experiment = Experiment(stage_named(stage), condition, *sizes)
    experiment = replace(experiment, effects=EFFECTS[options["effects"]])
    wanted = tuple(1e-3 * value for value in velocities)
    _with_progress(
        len(wanted),
        lambda advance: drive_velocities(
            experiment, out, file_format, velocities=wanted, progress=advance
        ),
    )


def _with_progress(total: int, work: Callable[[Callable[[int], None]], None]) -> None:
    """Run work with a progress bar on standard error, shown only on a terminal."""
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("logs", total=total)
        work(lambda done: progress.advance(task, done))


def main() -> None:
    """Run the command line; a named error is one line on standard error and status 1."""
    _open_streams()
    try:
        cli(prog_name="python -m models")
    except (ModelError, OSError) as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(1)


def _open_streams() -> None:
    """Open standard streams that are closed, and let none fail for a character it cannot encode."""
    # Else the next file that is opened has the number of a standard stream.
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for number, name in enumerate(("stdout", "stderr"), 1):
        stream = getattr(sys, name) or os.fdopen(number, "w", closefd=False)
        stream.reconfigure(errors=_ERRORS)
        setattr(sys, name, stream)


def _replace(error: UnicodeError) -> tuple[str, int]:
    """Spell what a stream cannot encode in ASCII."""
    assert isinstance(error, UnicodeEncodeError)
    spelled = {"°": "deg", "±": "+/-", "×": "x"}
    part = error.object[error.start : error.end]
    return "".join(spelled.get(one, "?") for one in part), error.end


codecs.register_error(_ERRORS, _replace)


if __name__ == "__main__":
    main()
