"""What a terminal shows: tables for people, JSON for programs, bars while they wait."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from lmshealth.wording import LEVELS, change

if TYPE_CHECKING:  # so that help comes without pandas and scipy
    from lmshealth.results import Health
    from lmshealth.tables import Row
    from lmshealth.tracks import Track

# So many lines of a frequency response are shown.
_MOST_LINES = 12
# More velocities than these do not fit beside each other.
_MOST_VELOCITIES = 7
# A posterior this far from its Laplace approximation, in mean and ln width, is worth a word.
_ODD_SHIFT, _ODD_RATIO = 0.5, 0.3


def print_json(content: dict[str, list[Row]]) -> None:
    """Print JSON with null where a number is missing."""
    click.echo(json.dumps(_without_nan(content), indent=1, allow_nan=False))


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def print_modes(rows: Sequence[Row], refused: Sequence[Row]) -> None:
    """Print modes with their uncertainty."""
    cells = [
        (
            row["log"],
            row["mode"],
            row["channel"],
            f"{row['frequency_hz']:.4g} ± {row['frequency_std_hz']:.2g}"
            if row["frequency_std_hz"] >= 1
            else f"{row['frequency_hz']:.3f} ± {row['frequency_std_hz']:.3f}",
            f"{100 * row['damping_ratio']:.2f} ± {100 * row['damping_ratio_std']:.2f}",
            f"{row['snr']:.3g}",
            row["flags"],
        )
        for row in rows
    ]
    title = "Modes (± one standard deviation)" if rows else "No modes found"
    print_table(
        title, ("log", "mode", "channel"), ("frequency Hz", "damping %", "SNR", "note"), cells
    )
    _print_refused(refused)


def print_failed(failed: dict[str, str]) -> None:
    """Say on standard error of which machines nothing can be told, and why."""
    for machine, why in failed.items():
        click.echo(f"lmshealth: {machine}: {why}", err=True)


def print_track(track: Track) -> None:
    """Print where the modes of a machine stand, what happened to it, and whether to believe it."""
    std = np.sqrt(np.einsum("kii->ki", track.drift_cov))
    cells: list[tuple[str, ...]] = [
        (
            mode,
            f"{np.exp(level):.3f} ± {np.exp(level) * track.ln_frequency_std[-1, i]:.3f}",
            "{:+.3f} ± {:.3f}".format(*change(track.drift[-1, i], std[-1, i])),
            f"{100 * np.exp(zeta):.2f} ± {100 * np.exp(zeta) * track.ln_damping_std[-1, i]:.2f}"
            if np.isfinite(zeta)
            else "–",
        )
        for i, (mode, level, zeta) in enumerate(
            zip(track.modes, track.ln_frequency[-1], track.ln_damping[-1], strict=True)
        )
    ]
    title = f"{track.stage}: modes after {len(track.logs)} logs (± one standard deviation)"
    print_table(title, ("mode",), ("frequency Hz", "drift %", "damping %"), cells)
    happened = [
        (
            f"{track.recorded_at[event.epoch]:%Y-%m-%d}",
            event.kind,
            event.mode,
            "{:+.2f} ± {:.2f}".format(*change(event.size, event.std)),
            f"{event.evidence:.1f}",
            "declared" if event.declared else "found",
        )
        for event in track.events
    ]
    if happened:
        numbers = ("size %", "ln Bayes factor")
        cells = [(*row[:3], row[5], *row[3:5]) for row in happened]
        print_table("What happened", ("since", "kind", "mode", ""), numbers, cells)
    click.echo(_consistent(track))


def print_health(health: Health) -> None:
    """Print what is left of each parameter at the last epoch, and on what that rests."""
    low, middle, high = health.latest(LEVELS)
    cells = [
        (
            name,
            f"{middle[j]:.3f}",
            f"{low[j]:.3f} to {high[j]:.3f}" if health.converged[-1] else "not converged",
            f"{100 * health.informed[-1, j]:.0f}",
            "–"
            if math.isnan(health.prior_ratio[-1, j])
            else f"{health.prior_shift[-1, j]:+.2f} σ × {health.prior_ratio[-1, j]:.2f}",
            or_dash(health.ess[-1, j], ".0f"),
            or_dash(health.r_hat[-1, j], ".3f"),
        )
        for j, name in enumerate(health.parameters)
    ]
    numbers = ("median", "90 % interval", "data %", "prior × 2", "ESS", "R-hat")
    title = (
        f"{health.stage}: health at {health.recorded_at[-1]:%Y-%m-%d}, the last of "
        f"{len(health.recorded_at)} epochs"
    )
    print_table(title, ("parameter",), numbers, cells)
    click.echo(
        "data: share of the prior's variance that they removed; prior × 2: how far the median "
        "moves, and how much wider the interval gets, with priors twice as wide, as far as the "
        "map reaches."
    )
    for j, k in combinations(range(len(health.parameters)), 2):
        rho = health.correlation[-1, j, k]
        click.echo(f"Correlation of {health.parameters[j]} and {health.parameters[k]}: {rho:+.2f}.")
    if not health.explained:
        click.echo(
            f"No state of the parameters on the map explains these drifts (p = {health.fit[-1]:.1g}"
            "): nothing is claimed. Look for what else moved the modes, or for a wrong map."
        )
    for j, name in enumerate(health.parameters):
        if health.at_edge[-1, j]:
            click.echo(f"{name} stands at the edge of the map: this is a bound; widen the map.")
        shift, ratio = health.laplace_shift[-1, j], health.laplace_ratio[-1, j]
        if abs(shift) > _ODD_SHIFT or abs(np.log(ratio)) > _ODD_RATIO:
            click.echo(
                f"{name}: far from normal; Laplace's approximation lies {shift:+.1f} σ lower, and "
                f"the posterior is {ratio:.2f} times as wide."
            )
        if not health.identifiable[-1, j]:
            click.echo(f"{name}: not identifiable by the tracked modes; see lmshealth stage.")
        elif health.explained and not health.told()[j]:
            click.echo(f"{name}: these drifts tell too little of it for a claim.")
    for when in np.flatnonzero(~health.converged):
        click.echo(f"The sampler did not converge at {health.recorded_at[when]:%Y-%m-%d}.")


def _consistent(track: Track) -> str:
    """Say whether the filter's innovations are what it expects."""
    found = track.consistency()
    told = (
        f"normalised innovations squared {found.nis:.2f} (expected 1, p = {found.p_value:.2g}), "
        f"autocorrelation {found.autocorrelation:+.2f} (p = {found.autocorrelation_p_value:.2g})"
    )
    if found.holds:
        how = {"inside": "", "below": ", which vary rather less than it expects",
               "above": ", which vary rather more than it expects"}[found.side]  # fmt: skip
        return f"The filter agrees with its logs{how}: {told}."
    if track.widening[-1] > 1:
        meant = (
            f"its standard deviations are widened {track.widening[-1]:.2f} times. A cause may be "
            "missing: a covariate, a retuning, or standard deviations that are not what they say."
        )
    else:
        meant = "the logs vary less than it expects, so that its own are rather too wide."
    return f"The filter does NOT agree with its logs: {told}; {meant}"


def print_frf(
    fits: Sequence[Row], frf: Sequence[Row], rows: Sequence[Row], refused: Sequence[Row]
) -> None:
    """Print frequency responses at some of their lines, what they were read from, and modes."""
    for fit in fits:
        if len(fits) > 1:
            click.echo(fit["log"])
        _print_response(fit, [row for row in frf if row["log"] == fit["log"]])
    print_modes(rows, refused)


def _print_response(fit: Row, frf: Sequence[Row]) -> None:
    step = max(1, -(-len(frf) // _MOST_LINES))
    cells = [
        (
            f"{row['frequency_hz']:.5g}",
            f"{row['gain']:.4g} ± {row['gain_std']:.2g}",
            f"{math.degrees(row['phase_rad']):.1f}",
            f"{row['coherence']:.4f}",
            f"{row['fit_gain']:.4g}",
        )
        for row in frf[step // 2 :: step]
    ]
    title = f"Response of {fit['output']} to {fit['input']}, {len(cells)} of {len(frf)} lines"
    print_table(title, (), ("Hz", "gain (SI)", "phase °", "coherence", "fit"), cells)
    click.echo(_averages(fit))
    if fit["distortion"] > 0:
        click.echo(
            f"Beyond the noise (reduced chi-square {fit['chi_square']:.3g}) the fit misses "
            f"{_percent(fit['distortion'])} of the response:\n"
            "nonlinear, or a term is lacking; the standard deviations are widened by it."
        )
    if fit["colour"] > 0:
        click.echo(
            f"Errors of neighbouring lines correlate by {fit['colour']:.2f}: standard deviations "
            "are widened."
        )


def _averages(fit: Row) -> str:
    if math.isnan(fit["period_s"]):
        return f"H1 of {fit['n_averages']:.0f} stretches: the input does not repeat."
    return f"Mean of {fit['n_averages']:.0f} periods of {fit['period_s']:.6g} s."


def print_error(rows: Sequence[Row], refused: Sequence[Row]) -> None:
    """Print the following error: its statistics, then what its harmonics say."""
    if not rows:
        _print_refused(refused)
        return
    several = len({row["channel"] for row in rows}) > 1
    texts = ("log", "channel") if several else ("log",)
    first = [
        (
            *_labels(row, several),
            *(_number(row[key]) for key in ("velocity_mm_s", "duration_s")),
            *(_number(row[key]) for key in ("min_um", "max_um", "std_um", "mean_um")),
        )
        for row in rows
    ]
    print_table("Following error (µm)", texts, ("mm/s", "s", "min", "max", "std", "mean"), first)
    second = [
        (
            *_labels(row, several),
            *(_number(row[key]) for key in ("max_magnitude_um", "strongest_hz", "bandwidth_hz")),
            _percent(row["share_explained"]),
            str(row["n_above_floor"]),
            _number(row["bandwidth_above_floor_hz"]),
            _percent(row["share_explained_above_floor"]),
        )
        for row in rows
    ]
    count, floor = max(row["n_harmonics"] for row in rows), rows[0]["floor_nm"]
    title = f"Strongest harmonics: {count}, and those of them above {floor:g} nm"
    heads = ("max µm", "at Hz", "wide Hz", "share", "above", "wide Hz", "share")
    print_table(title, texts, heads, second)
    click.echo("wide: highest minus lowest frequency; share: of the variance that they rebuild.")
    _print_refused(refused)


def print_magnitudes(rows: Sequence[Row], lines: Sequence[Row], refused: Sequence[Row]) -> None:
    """Print magnitudes over velocity, one table per machine and accelerometer, then lines."""
    for stage, channel in dict.fromkeys((row["stage"], row["channel"]) for row in rows):
        own = [row for row in rows if (row["stage"], row["channel"]) == (stage, channel)]
        _print_channel(f"{stage or 'unknown machine'}, {channel}", own)
    if rows:
        click.echo(
            "grows: slope of ln level over ln velocity ± its standard deviation;\n"
            "* positive beyond chance (one-sided, 5 % per row);\n"
            "– fewer than two velocities or three logs: no slope;\n"
            "~ the strongest harmonic is a line, no mode. RMS: of a band, in Hz."
        )
    if lines:
        _print_lines(lines)
    _print_refused(refused)


_HINDRANCES = {
    "too-short": ("log too short", "its modes cannot be identified."),
    "baseline": ("baseline too short", "more logs now do not help, more or longer ones there do."),
    "parameters": ("hidden", "other parameters change the modes alike; track further modes."),
}


def print_plans(detect: Sequence[Row], plan: Sequence[Row]) -> None:
    """Print what logs of several lengths can do, one table per loss to be seen."""
    for asked in detect:
        name, n_baseline = asked["parameter"], asked["n_baseline"]
        cells = [
            (
                f"{row['seconds_per_log']:g}",
                _HINDRANCES[row["hindrance"]][0] if row["hindrance"] else str(row["n_logs"]),
                _share(row["power_of_one_log"]),
                _share(row["smallest_loss_of_one_log"]),
                _share(row["smallest_loss"]),
            )
            for row in plan
            if row["parameter"] == name and row["loss"] == asked["loss"]
        ]
        heads = ("s per log", "logs", "power, 1 log", "loss, 1 log", f"loss, {n_baseline} logs")
        print_table(
            f"{name}: to see a loss of {_percent(asked['loss'])} with power {asked['power']:g}, "
            f"false alarms {asked['false_alarm']:g}",
            (),
            heads,
            cells,
        )
        alone = asked["seconds_for_one_log"]
        click.echo(
            f"One log is enough from {alone} s on.\n"
            if alone
            else "No one log of an hour is enough.\n"
        )
    for kind in dict.fromkeys(row["hindrance"] for row in plan if row["hindrance"]):
        click.echo(": ".join(_HINDRANCES[kind]))
    click.echo(
        "At best. Baseline and logs now are of one length; loss: the smallest seen.\n"
        "Not counted: temperature, wander between logs, errors of the map."
    )


def _share(value: float) -> str:
    return "–" if math.isnan(value) else _percent(value)


def _print_lines(lines: Sequence[Row]) -> None:
    """Print each line once for all logs."""
    groups: dict[tuple[str, str, float], list[Row]] = {}
    for row in lines:
        groups.setdefault((row["channel"], row["kind"], round(row["frequency_hz"])), []).append(row)
    cells = [
        (
            channel,
            kind,
            f"{rows[0]['frequency_hz']:.2f}",
            _number(1e3 * max(row["amplitude"] for row in rows)),
            str(len({row["log"] for row in rows})),
        )
        for (channel, kind, _), rows in sorted(groups.items())
    ]
    print_table("Lines", ("channel", "kind"), ("Hz", "largest mm/s²", "in logs"), cells)


def _print_channel(title: str, rows: Sequence[Row]) -> None:
    """Print a table of bands by velocities: magnitudes, of wide bands RMS."""
    cells: dict[str, dict[float, list[float]]] = {}
    lines: set[tuple[str, float]] = set()
    for row in rows:
        key = "rms_mm_s2" if row["kind"] in ("health", "watch") else "magnitude_mm_s2"
        speed = row["velocity_mm_s"]
        speed = -1.0 if math.isnan(speed) else float(f"{speed:.2g}")
        cells.setdefault(row["band"], {}).setdefault(speed, []).append(row[key])
        if row["line"] and key == "magnitude_mm_s2":
            lines.add((row["band"], speed))
    speeds = sorted({speed for own in cells.values() for speed in own})
    left_out = len(speeds) - _MOST_VELOCITIES
    if left_out > 0:
        step = (len(speeds) - 1) / (_MOST_VELOCITIES - 1)
        speeds = [speeds[round(k * step)] for k in range(_MOST_VELOCITIES)]
        title += f" ({left_out} more velocities in csv and json)"
    kinds = {row["band"]: row for row in rows}
    table = [
        (
            _band_name(kinds[band]),
            *(_mean(own.get(v, [])) + ("~" if (band, v) in lines else " ") for v in speeds),
            _slope(kinds[band]),
        )
        for band, own in cells.items()
    ]
    heads = tuple("?" if speed < 0 else f"{speed:g}" for speed in speeds)
    print_table(f"{title}: mm/s² at velocities in mm/s", ("band",), (*heads, "grows"), table)


def _band_name(row: Row) -> str:
    kind = row["kind"]
    if kind == "mode":
        return f"{row['band']} {(row['low_hz'] + row['high_hz']) / 2:.0f} Hz"
    if kind == "grid":
        return str(row["band"])
    return f"RMS {row['low_hz']:g}-{row['high_hz']:g}"


def _slope(row: Row) -> str:
    if row["grows"] is None:
        return "–"
    return f"{row['slope']:.2f}±{row['slope_std']:.2f}{'*' if row['grows'] else ' '}"


def _mean(values: Sequence[float]) -> str:
    return _number(sum(values) / len(values)) if values else ""


def _labels(row: Row, several: bool) -> tuple[str, ...]:
    name = Path(row["log"]).name
    return (name, row["channel"]) if several else (name,)


def or_dash(value: float, form: str) -> str:
    """Write a number in a form, and a dash where there is none."""
    return "–" if math.isnan(value) else f"{value:{form}}"


def _number(value: float) -> str:
    """Write three significant digits without an exponent where that is short."""
    if math.isnan(value):
        return "–"
    if 100 <= abs(value) < 1e5:
        return f"{value:.0f}"
    return f"{value:.3g}" if abs(value) >= 0.1 else f"{value:.2g}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _print_refused(rows: Sequence[Row]) -> None:
    names = ("log", "channel", "mode", "reason", "detail")
    if rows:
        print_table("Refused", names, (), [tuple(row[name] for name in names) for row in rows])


def print_table(
    title: str, texts: Sequence[str], numbers: Sequence[str], cells: Sequence[Sequence[str]]
) -> None:
    """Print a table: columns of text to the left, columns of numbers to the right."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for name in texts:
        table.add_column(name, overflow="fold")
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True)
    for row in cells:
        table.add_row(*row)
    click.echo(title)
    # What stands in the cells is text: brackets in it are no markup.
    Console(markup=False, emoji=False, highlight=False).print(table)
