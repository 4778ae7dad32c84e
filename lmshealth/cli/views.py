"""Terminal output of results: logs, stage descriptions, plans, tracks, health, remaining life."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from datetime import date
from itertools import combinations
from typing import TYPE_CHECKING

import click

from lmshealth.cli.terminal import print_refused, print_table, print_text, short_names
from lmshealth.report import constants
from lmshealth.report.text import (
    GAP,
    change,
    fixed,
    interval,
    number,
    percent,
    probability,
    probability_range,
    spell,
)

if TYPE_CHECKING:  # so that --help does not import pandas and scipy
    from lmshealth.health.results import Health
    from lmshealth.prognosis.maintenance_decision import ProbabilityBounds, Service
    from lmshealth.report.assessment import Life, ParameterHealth, Summary
    from lmshealth.report.tables import Row
    from lmshealth.tracking.track import Track

_KM = 1000.0
_HINDRANCES = {
    "too-short": ("log too short", "its modes cannot be identified."),
    "baseline": ("baseline too short", "more or longer baseline logs are needed."),
    "parameters": ("hidden", "other parameters change the modes alike; track further modes."),
}
_VERDICTS = {
    "told": "identifiable",
    "longer-logs": "longer logs",
    "together": "together",
    "not-told": "not identifiable",
}


# --- Single logs ---


def print_modes(rows: Sequence[Row], refused: Sequence[Row]) -> None:
    """Print modes with their standard deviations."""
    logs = short_names([row["log"] for row in rows])
    cells = [
        (
            logs[row["log"]],
            row["mode"],
            row["channel"],
            f"{number(row['frequency_hz'], 4)} ± {number(row['frequency_std_hz'], 2)}"
            if row["frequency_std_hz"] >= 1
            else f"{fixed(row['frequency_hz'], 3)} ± {fixed(row['frequency_std_hz'], 3)}",
            f"{100 * row['damping_ratio']:.2f} ± {100 * row['damping_ratio_std']:.2f}",
            number(row["snr"]),
            row["flags"],
        )
        for row in rows
    ]
    if rows:
        heads = ("frequency Hz", "damping %", "SNR", "flags")
        title = "Modes (± one standard deviation)"
        print_table(title, ("log", "mode", "channel"), heads, cells)
    else:
        print_text("No modes found.")
    print_refused(refused)


def print_frf(
    fits: Sequence[Row], frf: Sequence[Row], rows: Sequence[Row], refused: Sequence[Row]
) -> None:
    """Print frequency responses at some of their lines, their averages and their modes."""
    for fit in fits:
        if len(fits) > 1:
            click.echo(fit["log"])
        _print_response(fit, [row for row in frf if row["log"] == fit["log"]])
    print_modes(rows, refused)


def _print_response(fit: Row, frf: Sequence[Row]) -> None:
    step = max(1, -(-len(frf) // constants.TERMINAL_LINES))
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
    if math.isnan(fit["period_s"]):
        print_text(f"H1 of {fit['n_averages']:.0f} segments: the input is not periodic.")
    else:
        print_text(f"Mean of {fit['n_averages']:.0f} periods of {fit['period_s']:.6g} s.")
    if fit["distortion"] > 0:
        print_text(
            f"The fit misses {percent(fit['distortion'], 1)} of the response beyond the noise "
            f"(reduced chi-square {fit['chi_square']:.3g}): nonlinearity or a missing mode; the "
            "standard deviations are widened accordingly."
        )
    if fit["colour"] > 0:
        print_text(
            f"Errors of neighbouring lines are correlated ({fit['colour']:.2f}): the standard "
            "deviations are widened."
        )


def print_error(rows: Sequence[Row], harmonics: Sequence[Row], refused: Sequence[Row]) -> None:
    """Print the following error: statistics and strongest harmonics."""
    if rows:
        _print_statistics(rows)
        _print_harmonics(rows, harmonics)
    print_refused(refused)


def _print_statistics(rows: Sequence[Row]) -> None:
    several = len({row["channel"] for row in rows}) > 1
    texts = ("log", "channel") if several else ("log",)
    logs = short_names([row["log"] for row in rows])

    def show(title: str, columns: dict[str, str]) -> None:
        cells = [
            (
                *(logs[row["log"]], row["channel"])[: len(texts)],
                *(_statistic(key, row[key]) for key in columns.values()),
            )
            for row in rows
        ]
        print_table(title, texts, tuple(columns), cells)

    show(
        "Following error (µm)",
        {
            "mm/s": "velocity_mm_s", "s": "duration_s", "min": "min_um", "max": "max_um",
            "std": "std_um", "mean": "mean_um",
        },
    )  # fmt: skip
    show(
        "Strongest harmonics",
        {
            "number": "n_harmonics", "max µm": "max_magnitude_um", "at Hz": "strongest_hz",
            "bandwidth Hz": "bandwidth_hz", "share": "share_explained",
        },
    )  # fmt: skip
    show(
        f"Those above {rows[0]['floor_nm']:g} nm",
        {
            "number": "n_above_floor", "bandwidth Hz": "bandwidth_above_floor_hz",
            "share": "share_explained_above_floor",
        },
    )  # fmt: skip
    print_text("bandwidth: highest minus lowest frequency; share: of the variance they explain.")


def _statistic(key: str, value: float) -> str:
    if key.startswith("n_"):
        return str(value)
    if key.startswith("share"):
        return percent(value, 1)
    return number(value, 4 if key.endswith("_hz") else 3)


def _print_harmonics(rows: Sequence[Row], harmonics: Sequence[Row]) -> None:
    """Print harmonics, strongest first: all of a single channel, else the first of each."""
    logs = short_names([row["log"] for row in rows])
    most = constants.TERMINAL_HARMONICS if len(rows) > 1 else len(harmonics)
    if harmonics:
        print_text("Strongest harmonics, Hz (amplitude in µm):")
    for row in rows:
        own = [h for h in harmonics if (h["log"], h["channel"]) == (row["log"], row["channel"])]
        listed = ", ".join(
            f"{h['frequency_hz']:.5g}{GAP}({number(h['amplitude_um'])})" for h in own[:most]
        )
        more = f" and {len(own) - most} more (see --format json)" if len(own) > most else ""
        if own:
            print_text(f"{logs[row['log']]}, {row['channel']}: {listed}{more}.")


def print_magnitudes(rows: Sequence[Row], lines: Sequence[Row], refused: Sequence[Row]) -> None:
    """Print magnitudes against velocity, one table per machine and accelerometer, then lines."""
    for stage, channel in dict.fromkeys((row["stage"], row["channel"]) for row in rows):
        own = [row for row in rows if (row["stage"], row["channel"]) == (stage, channel)]
        _print_channel(f"{stage or 'unknown machine'}, {channel}", own)
    if rows:
        click.echo(
            "grows: slope of ln level over ln velocity ± its standard deviation;\n"
            "* significantly positive (one-sided, 5 % per row);\n"
            "– fewer than two velocities or three logs: no slope;\n"
            "~ the strongest harmonic is a spectral line, not a mode. RMS: of a band, in Hz."
        )
    if lines:
        _print_lines(lines)
    print_refused(refused)


def _print_channel(title: str, rows: Sequence[Row]) -> None:
    """Print a table of bands by velocities: magnitudes, or RMS of health and watched bands."""
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
    left_out = len(speeds) - constants.TERMINAL_VELOCITIES
    if left_out > 0:
        step = (len(speeds) - 1) / (constants.TERMINAL_VELOCITIES - 1)
        speeds = [speeds[round(k * step)] for k in range(constants.TERMINAL_VELOCITIES)]
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
    """Print the band of each mode and its strongest frequency, which need not be the mode."""
    found = []
    for band in dict.fromkeys(row["band"] for row in rows):
        own = [row for row in rows if row["band"] == band]
        ends = _range([row["low_hz"] for row in own] + [row["high_hz"] for row in own])
        identified = any(row["placed_by"] == "identified" for row in own)
        how = "around the identified mode" if identified else "as described; mode not identified"
        strongest = _range([row["strongest_hz"] for row in own])
        found.append(f"{band} at {strongest} Hz (band {ends} Hz, {how})")
    if found:
        print_text(f"Strongest harmonic of {'; '.join(found)}.")
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
    mean = sum(values) / len(values) if values else 0.0
    return number(mean, 3 if mean >= 0.1 else 2) if values else ""


def _print_lines(lines: Sequence[Row]) -> None:
    """Print each spectral line once for all logs."""
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


# --- Stage descriptions and plans ---


def print_stage(content: dict[str, list[Row]]) -> None:
    """Print the modes, parameters, sensitivities and findings of a stage description."""
    (stage,), parameters = content["stage"], content["parameters"]
    cells = [
        (
            row["mode"],
            "yes" if row["tracked"] else "no",
            f"{row['frequency_hz']:.1f}",
            f"{row['searched_low_hz']:.0f}-{row['searched_high_hz']:.0f}",
            *(fixed(row[key], 1) for key in ("map_hz", "map_at_limits_hz")),
            *(_exponent(row[key]) for key in ("surrogate_error_ln_f", "logs_reach_ln_f")),
        )
        for row in content["modes"]
    ]
    heads = ("Hz", "search band", "map Hz", "at limits", "map error", "log std")
    print_table(f"{stage['name']}: modes", ("mode", "tracked"), heads, cells)
    if parameters:
        _print_coverage(parameters)
        _print_identifiability(stage, parameters)
        _print_sensitivities(content)
    for row in content["findings"]:
        print_text(row["text"], "+ " if row["good"] else "! ")


def _exponent(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.1e}"


def _print_coverage(parameters: Sequence[Row]) -> None:
    cells = [
        (
            row["parameter"],
            f"{row['baseline']:g}",
            "–" if row["limit"] is None else f"{row['limit']:g}",
            f"{row['prior_q05']:.3g}-{row['prior_q95']:.3g}",
            f"{row['map_low']:.3g}-{row['map_high']:.3g}",
            percent(row["prior_below_map"] + row["prior_above_map"], 1),
        )
        for row in parameters
    ]
    heads = ("baseline", "limit", "prior 90 %", "map", "prior outside")
    print_table("Health parameters", ("parameter",), heads, cells)


def _print_identifiability(stage: Row, parameters: Sequence[Row]) -> None:
    cells = [
        (
            row["parameter"],
            *(percent(row[f"{key}_std_ln"], 1) for key in ("prior", "logs", "endless_logs")),
            percent(row["informed"], 1),
            _VERDICTS[row["verdict"]],
        )
        for row in parameters
    ]
    heads = ("prior", "logs", "endless logs", "informed", "")
    print_table("Standard deviation of the parameters", ("parameter",), heads, cells)
    print_text(
        f"logs: {stage['n_logs']} logs of {stage['seconds_per_log']:g} s now and at the baseline, "
        "averaged over the priors (Cramér-Rao bound). map error, log std: of ln f. informed: share "
        "of the prior variance that the logs remove; identifiable from 50 % on."
    )
    click.echo()


def _print_sensitivities(content: dict[str, list[Row]]) -> None:
    names = [row["parameter"] for row in content["parameters"]]
    cells: dict[str, list[str]] = {}
    for row in content["sensitivities"]:
        ends = [number(row[key], 2) for key in ("at_baseline", "at_limits")]
        cells.setdefault(row["mode"], []).append(" → ".join(ends))
    title = "Sensitivity d ln f / d ln parameter, at the baseline → at the limits"
    print_table(title, ("mode",), names, [(mode, *own) for mode, own in cells.items()])
    for row in content["correlations"]:
        pair = f"{row['parameter_a']} and {row['parameter_b']}"
        click.echo(f"Correlation of {pair} after these logs: {row['correlation']:+.2f}")
    click.echo()


def print_plans(detect: Sequence[Row], plan: Sequence[Row]) -> None:
    """Print the number of logs needed per length of log, one table per loss to detect."""
    for asked in detect:
        name, n_baseline = asked["parameter"], asked["n_baseline"]
        cells = [
            (
                f"{row['seconds_per_log']:g}",
                _HINDRANCES[row["hindrance"]][0] if row["hindrance"] else str(row["n_logs"]),
                percent(row["power_of_one_log"], 1),
                percent(row["smallest_loss_of_one_log"], 1),
                percent(row["smallest_loss"], 1),
            )
            for row in plan
            if row["parameter"] == name and row["loss"] == asked["loss"]
        ]
        heads = ("s per log", "logs", "power, 1 log", "loss, 1 log", f"loss, {n_baseline} logs")
        title = (
            f"{name}: to detect a loss of {percent(asked['loss'], 1)} with power "
            f"{asked['power']:g}, false-alarm probability {asked['false_alarm']:g}"
        )
        print_table(title, (), heads, cells)
        alone = asked["seconds_for_one_log"]
        click.echo(
            f"One log is enough from {alone} s on.\n"
            if alone
            else "A single log of up to an hour is not enough.\n"
        )
    for kind in dict.fromkeys(row["hindrance"] for row in plan if row["hindrance"]):
        print_text(": ".join(_HINDRANCES[kind]))
    print_text(
        "Lower bound. Logs now and at the baseline have equal length; loss: the smallest that is "
        "detected.\nNot included: temperature, scatter between logs, errors of the map."
    )


# --- Machines ---


def print_track(track: Track) -> None:
    """Print the latest modes of a machine, its events and the consistency of the filter."""
    from lmshealth.report.tables import track_rows

    cells: list[tuple[str, ...]] = [
        (
            row["mode"],
            f"{fixed(row['frequency_hz'], 3)} ± {fixed(row['frequency_std_hz'], 3)}",
            change(row["drift"], row["drift_std"], 3),
            f"{fixed(100 * row['damping_ratio'], 2)} ± {percent(row['damping_ratio_std'], 2)}"
            if row["damping_ratio"] >= 0
            else "–",
        )
        for row in track_rows(track, epochs=[len(track.logs) - 1])
    ]
    title = f"{track.stage}: modes after {len(track.logs)} logs (± one standard deviation)"
    print_table(title, ("mode",), ("frequency Hz", "drift", "damping ratio"), cells)
    cells = [
        (
            f"{track.recorded_at[event.epoch]:%Y-%m-%d}",
            event.kind,
            event.mode,
            "declared" if event.declared else "detected",
            change(event.size, event.std),
            f"{event.evidence:.1f}",
        )
        for event in track.events
    ]
    if cells:
        print_table("Events", ("since", "kind", "mode", ""), ("size", "ln Bayes factor"), cells)
    print_text(_consistency(track))


def _consistency(track: Track) -> str:
    """Return whether the innovations of the filter agree with its model."""
    found = track.consistency()
    values = (
        f"normalised innovations squared {found.nis:.2f} (expected 1, p = {found.p_value:.2g}), "
        f"autocorrelation {found.autocorrelation:+.2f} (p = {found.autocorrelation_p_value:.2g})"
    )
    if found.holds:
        less = {"below": " (they vary less than expected)", "above": " (they vary more)"}
        return f"The filter is consistent with its logs{less.get(found.side, '')}: {values}."
    if track.widening[-1] > 1:
        return (
            f"The filter is NOT consistent with its logs: {values}. Its standard deviations are "
            f"multiplied by {track.widening[-1]:.2f}. A cause may be missing: a covariate, a "
            "change of servo tuning, or wrong standard deviations in the table."
        )
    return (
        f"The filter is NOT consistent with its logs: {values}. The logs vary less than expected: "
        "its standard deviations are too large."
    )


def print_health(health: Health) -> None:
    """Print the health parameters at the last epoch with their diagnostics."""
    low, middle, high = (health.latest(level) for level in constants.LEVELS)
    cells = [
        (
            name,
            f"{middle[j]:.3f}",
            f"{low[j]:.3f} to {high[j]:.3f}" if health.converged[-1] else "not converged",
            percent(health.informed[-1, j], 0),
            "–"
            if math.isnan(health.prior_ratio[-1, j])
            else f"{health.prior_shift[-1, j]:+.2f} σ × {health.prior_ratio[-1, j]:.2f}",
            fixed(health.ess[-1, j], 0),
            fixed(health.r_hat[-1, j], 3),
        )
        for j, name in enumerate(health.parameters)
    ]
    numbers = ("median", "90 % interval", "informed", "prior × 2", "ESS", "R-hat")
    title = (
        f"{health.stage}: health at {health.recorded_at[-1]:%Y-%m-%d}, the last of "
        f"{len(health.recorded_at)} epochs"
    )
    print_table(title, ("parameter",), numbers, cells)
    print_text(
        "informed: share of the prior variance that the data remove; prior × 2: shift of the "
        "median and factor on the interval with priors twice as wide, within the map."
    )
    for j, k in combinations(range(len(health.parameters)), 2):
        rho = health.correlation[-1, j, k]
        print_text(f"Correlation of {health.parameters[j]} and {health.parameters[k]}: {rho:+.2f}.")
    _print_doubts(health)


def _print_doubts(health: Health) -> None:
    """Print what limits the use of a posterior."""
    if not health.explained:
        print_text(
            f"No state of the parameters on the map explains these drifts (p = {health.fit[-1]:.1g}"
            "): no health is reported. Check for other causes of the drifts and errors of the map."
        )
    for j, name in enumerate(health.parameters):
        if health.at_edge[-1, j]:
            print_text(
                f"{name}: the posterior ends at the edge of the map; this is a bound. Extend the "
                "map."
            )
        shift, ratio = health.laplace_shift[-1, j], health.laplace_ratio[-1, j]
        if (
            abs(shift) > constants.LAPLACE_SHIFT
            or abs(math.log(ratio)) > constants.LAPLACE_LN_RATIO
        ):
            print_text(
                f"{name}: the posterior is not normal; Laplace's approximation lies {shift:+.1f} σ "
                f"lower, and the posterior is {ratio:.2f} times as wide."
            )
        if not health.identifiable[-1, j]:
            print_text(f"{name}: not identifiable from the tracked modes; see `lmshealth stage`.")
        elif health.explained and not health.informed_parameters()[j]:
            print_text(f"{name}: not determined by these drifts.")
    for when, converged in zip(health.recorded_at, health.converged, strict=True):
        if not converged:
            print_text(f"The sampler did not converge at {when:%Y-%m-%d}.")


def print_summaries(summaries: Sequence[Summary]) -> None:
    """Print the results of a run: a few machines in full, many in a table.

    Parameters
    ----------
    summaries : sequence of Summary
        Of all machines, most urgent first.
    """
    if len(summaries) > constants.TERMINAL_MACHINES:
        _print_fleet(summaries)
        return
    for one in summaries:
        print_text(f"{one.identity}: {_verdict(one)}. {one.why}")
        for parameter in one.health:
            print_text(f"  {_parameter(parameter)}")
        if one.life is not None:
            print_life(one.life, one.service)


def _print_fleet(summaries: Sequence[Summary]) -> None:
    shown = summaries[: constants.TERMINAL_ROWS]
    cells = [
        (
            one.identity,
            _verdict(one),
            "\n".join(map(_parameter, one.health)),
            _travel_left(one.life),
            service_text(one.service),
        )
        for one in shown
    ]
    title = f"{len(summaries)} stages, most urgent first (medians with 90 % intervals)"
    print_table(title, ("stage", "verdict", "health", "km left", "service"), (), cells)
    rest = len(summaries) - len(shown)
    if rest > 0:
        click.echo(f"{rest} more stages; verdict.csv and prognosis.csv list all.")


def _verdict(one: Summary) -> str:
    sure = f" ({probability(one.probability)})" if one.probability >= 0 else ""
    return one.verdict + sure


def _parameter(one: ParameterHealth) -> str:
    if not one.determined:
        return f"{spell(one.name)} not determined"
    return f"{spell(one.name)} {percent(one.median, 0)} ({interval(one.low, one.high)})"


def _travel_left(life: Life | None) -> str:
    if life is None:
        return "–"
    low, middle, high = (
        f"beyond {_km(life.horizon)}" if math.isinf(metres) else _km(metres)
        for metres in (life.any.travel[k] for k in (0, 3, 6))
    )
    return middle if low == high else f"{middle} ({low} to {high})"


def service_text(service: Service) -> str:
    """Return when to service, in a few words."""
    if service.by is not None and service.kind == "by":
        return f"by {service.by.isoformat()}"
    return {"now": "now", "later": "no service needed yet"}.get(service.kind, "no date")


def print_life(
    life: Life, service: Service, before: tuple[date, ProbabilityBounds] | None = None
) -> None:
    """Print the quantiles of the remaining life for each limit and any, then the service.

    Parameters
    ----------
    life : Life
        The remaining life.
    service : Service
        When to service.
    before : tuple of date and ProbabilityBounds, optional
        A day, and the probabilities that a limit is reached before it.
    """
    blocks = [tuple(_limit_cells(life, k, before)) for k in range(len(life.limits))]
    same = _same_as_any(blocks)
    title = (
        f"{life.stage}: remaining life after {life.recorded_at:%Y-%m-%d}, at {_km(life.travel)} km "
        f"(horizon {_km(life.horizon)} km)"
    )
    heads = ("chance %", "km", "hours", "days", "date")
    cells = [cell for block in (blocks if same is None else blocks[:-1]) for cell in block]
    print_table(title, ("until",), heads, cells)
    if same is not None:
        print_text(f"Any limit: the same as {same}.")
    for name in dict.fromkeys(law.parameter for law in life.laws):
        laws = [
            f"{law.kind}{f' from {_km(law.begin)} km after the baseline' if law.begin else ''} "
            f"{probability(law.probability)}"
            for law in life.laws
            if law.parameter == name and law.probability >= constants.LAW_SHOWN
        ]
        print_text(f"Law of {spell(name)}: {', '.join(laws)}.")
    if life.undetermined:
        names = ", ".join(map(spell, life.undetermined))
        print_text(f"Not included: the limit of {names}, which the modes cannot determine.")
    for sentence in _advice(life, service):
        print_text(sentence)
    click.echo()


def _limit_cells(
    life: Life, index: int, before: tuple[date, ProbabilityBounds] | None
) -> Iterator[tuple[str, ...]]:
    """Yield one row per quantile, then the probabilities of the limit, one row each."""
    one = life.limits[index]
    any_limit = one.parameter == "any"
    text = "any limit" if any_limit else f"{spell(one.parameter)} below {one.limit:g}"
    last = constants.RUL_LEVELS[-1]
    for k, level in enumerate(constants.RUL_LEVELS):
        share, days = f"{100 * level:.0f}", one.days[k]
        if math.isinf(days):
            share = share if level == last else f"{share} to {100 * last:.0f}"
            yield text, share, f"beyond {_km(life.horizon)}", "–", "–", "–"
            break
        day = one.dates[k]
        calendar = "out of range" if day is None else day.isoformat()
        yield text, share, _km(one.travel[k]), f"{24 * days:,.0f}", f"{days:,.1f}", calendar
        text = ""
    notes = {
        "already": probability(one.already_past),
        "beyond horizon": probability(one.beyond_horizon),
    }
    if before is not None:
        asked, bounds = before
        notes[f"before {asked}"] = probability_range(
            (bounds.at_least[index], bounds.at_most[index])
        )
    for what, chance in notes.items():
        yield f"  {what}: {chance}", "", "", "", "", ""


def _same_as_any(blocks: Sequence[tuple[tuple[str, ...], ...]]) -> str | None:
    """Return the limit whose rows equal those of any limit."""
    *each, last = blocks
    for block in each:
        if [b[1:] for b in block] == [b[1:] for b in last] and [b[0] for b in block[1:]] == [
            b[0] for b in last[1:]
        ]:
            return block[0][0]
    return None


def _advice(life: Life, service: Service) -> Iterator[str]:
    """Yield when to service, by which rule, and the risk of a planned service."""
    rule = (
        f"accepted risk {percent(service.max_risk)}"
        if service.max_risk
        else f"least cost, where a failure costs {service.cost_ratio:.3g} times a service"
    )
    yield f"Service: {service_text(service)} ({rule})."
    risk = probability(service.risk) if service.risk >= 0 else ""
    if service.kind == "later":
        yield f"No service is needed within {_km(life.horizon)} km."
    elif service.by is None:
        yield "The usage is too low for a calendar date."
    elif service.kind == "now":
        yield f"Probability that a limit has already been reached, at most: {risk}."
    elif not service.max_risk or risk != percent(service.max_risk):
        yield f"Probability that a limit is reached before that day, at most: {risk}."
    if service.planned is not None:
        planned = probability_range(service.planned_risk)
        yield f"Before the service planned for {service.planned}: {planned}."


def _km(metres: float) -> str:
    return f"{metres / _KM:,.0f}"
