"""What a terminal shows of single logs: modes, responses, following errors, magnitudes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from lmshealth.cli.terminal import (
    number,
    percent,
    print_refused,
    print_table,
    print_text,
    short_names,
)

if TYPE_CHECKING:  # so that help comes without pandas and scipy
    from lmshealth.report.tables import Row

# So many lines of a frequency response are shown.
_MOST_LINES = 12
# So many harmonics of a channel are shown where several channels or logs are.
_MOST_HARMONICS = 12
# A space at which lines do not break.
_TIE = "\u00a0"
# More velocities than these do not fit beside each other.
_MOST_VELOCITIES = 7


def print_modes(rows: Sequence[Row], refused: Sequence[Row]) -> None:
    """Print modes with their uncertainty."""
    logs = short_names([row["log"] for row in rows])
    cells = [
        (
            logs[row["log"]],
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
    if rows:
        heads = ("frequency Hz", "damping %", "SNR", "note")
        title = "Modes (± one standard deviation)"
        print_table(title, ("log", "mode", "channel"), heads, cells)
    else:
        print_text("No modes found.")
    print_refused(refused)


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
    print_text(_averages(fit))
    if fit["distortion"] > 0:
        print_text(
            f"Beyond the noise (reduced chi-square {fit['chi_square']:.3g}) the fit misses "
            f"{percent(fit['distortion'])} of the response: "
            "nonlinear, or a term is lacking; the standard deviations are widened by it."
        )
    if fit["colour"] > 0:
        print_text(
            f"Errors of neighbouring lines correlate by {fit['colour']:.2f}: standard deviations "
            "are widened."
        )


def _averages(fit: Row) -> str:
    if math.isnan(fit["period_s"]):
        return f"H1 of {fit['n_averages']:.0f} stretches: the input does not repeat."
    return f"Mean of {fit['n_averages']:.0f} periods of {fit['period_s']:.6g} s."


def print_error(rows: Sequence[Row], harmonics: Sequence[Row], refused: Sequence[Row]) -> None:
    """Print the following error: its statistics, then what its harmonics say, then these."""
    if rows:
        _print_readings(rows)
        _print_harmonics(rows, harmonics)
    print_refused(refused)


def _print_readings(rows: Sequence[Row]) -> None:
    several = len({row["channel"] for row in rows}) > 1
    texts = ("log", "channel") if several else ("log",)
    logs = short_names([row["log"] for row in rows])
    names = [(logs[row["log"]], row["channel"])[: len(texts)] for row in rows]

    def show(title: str, heads: Sequence[str], *keys: str) -> None:
        cells = [
            (*name, *(_reading(key, row[key]) for key in keys))
            for name, row in zip(names, rows, strict=True)
        ]
        print_table(title, texts, heads, cells)

    show(
        "Following error (µm)",
        ("mm/s", "s", "min", "max", "std", "mean"),
        *("velocity_mm_s", "duration_s", "min_um", "max_um", "std_um", "mean_um"),
    )
    heads = ("number", "max µm", "at Hz", "wide Hz", "share")
    show(
        "Strongest harmonics",
        heads,
        *("n_harmonics", "max_magnitude_um", "strongest_hz", "bandwidth_hz", "share_explained"),
    )
    show(
        f"Those of them above {rows[0]['floor_nm']:g} nm",
        ("number", "wide Hz", "share"),
        *("n_above_floor", "bandwidth_above_floor_hz", "share_explained_above_floor"),
    )
    print_text("wide: highest minus lowest frequency; share: of the variance that they rebuild.")


def _reading(key: str, value: float) -> str:
    if key.startswith("n_"):
        return str(value)
    return percent(value) if key.startswith("share") else number(value)


def _print_harmonics(rows: Sequence[Row], harmonics: Sequence[Row]) -> None:
    """List harmonics, strongest first: all where one channel was read, else the first of each."""
    logs = short_names([row["log"] for row in rows])
    most = _MOST_HARMONICS if len(rows) > 1 else len(harmonics)
    if harmonics:
        print_text("Strongest harmonics, Hz (amplitude in µm):")
    for row in rows:
        own = [h for h in harmonics if (h["log"], h["channel"]) == (row["log"], row["channel"])]
        told = ", ".join(
            f"{h['frequency_hz']:.5g}{_TIE}({number(h['amplitude_um'])})" for h in own[:most]
        )
        if not own:
            continue
        more = f" and {len(own) - most} more, which json lists" if len(own) > most else ""
        print_text(f"{logs[row['log']]}, {row['channel']}: {told}{more}.")


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
    print_refused(refused)


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
    heads = tuple("unknown" if speed < 0 else f"{speed:g}" for speed in speeds)
    print_table(f"{title}: mm/s² at velocities in mm/s", ("band",), (*heads, "grows"), table)
    _print_places([row for row in rows if row["kind"] == "mode"])


def _print_places(rows: Sequence[Row]) -> None:
    """Say where each mode was read, and where it was strongest there: that need not be the mode."""
    told = []
    for band in dict.fromkeys(row["band"] for row in rows):
        own = [row for row in rows if row["band"] == band]
        ends = _range([row["low_hz"] for row in own] + [row["high_hz"] for row in own])
        found = any(row["placed_by"] == "identified" for row in own)
        how = "around the mode found" if found else "where it is described, not found"
        strongest = _range([row["strongest_hz"] for row in own])
        told.append(f"{band} at {strongest} Hz (read from {ends} Hz, {how})")
    if told:
        print_text(f"Strongest harmonic of {'; '.join(told)}.")
        click.echo()


def _range(values: Sequence[float]) -> str:
    ends = [f"{end:.0f}" for end in (min(values), max(values))]
    return " to ".join(dict.fromkeys(ends))


def _band_name(row: Row) -> str:
    if row["kind"] in ("mode", "grid"):
        return str(row["band"])
    return f"RMS {row['low_hz']:g}-{row['high_hz']:g}"


def _slope(row: Row) -> str:
    if row["grows"] is None:
        return "–"
    return f"{row['slope']:.2f}±{row['slope_std']:.2f}{'*' if row['grows'] else ' '}"


def _mean(values: Sequence[float]) -> str:
    return number(sum(values) / len(values)) if values else ""


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
            number(1e3 * max(row["amplitude"] for row in rows)),
            str(len({row["log"] for row in rows})),
        )
        for (channel, kind, _), rows in sorted(groups.items())
    ]
    print_table("Lines", ("channel", "kind"), ("Hz", "largest mm/s²", "in logs"), cells)
