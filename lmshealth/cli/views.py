"""Terminal output of results: logs, stage descriptions, plans, tracks, health, remaining life."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from datetime import date
from itertools import combinations, zip_longest
from typing import TYPE_CHECKING

from lmshealth._private.arrays import FloatArray
from lmshealth._private.tables import TABLES, Row, spell
from lmshealth.cli.terminal import (
    print_line,
    print_refused,
    print_table,
    print_text,
    print_view,
    short_names,
)
from lmshealth.machine.constants import RUL_LEVELS
from lmshealth.report import constants, text
from lmshealth.report.tables import events_rows, to_rows, track_rows
from lmshealth.report.text import GAP
from lmshealth.signal.segments import distinct_velocities

if TYPE_CHECKING:  # so that single logs need nothing of lives
    from lmshealth.calibration.check import CalibrationCheck
    from lmshealth.life.health import Health
    from lmshealth.machine.service import Service
    from lmshealth.machine.summary import Life, ParameterHealth, Summary
    from lmshealth.tracking.track import Track

_MATRIX = 6  # columns of a matrix that fit on a terminal


# --- Single logs ---


def print_modes(rows: Sequence[Row], refused: Sequence[Row], off: Sequence[Row] = ()) -> None:
    """Print modes with their standard deviations, and logs that differ from the description."""
    shown = short_names(rows)
    for row in shown:
        frequency, std = row["frequency_hz"], row["frequency_std_hz"]
        row["frequency"] = f"{text.fixed(frequency, 3)} ± {text.fixed(std, 3)}"
        if std >= 1:
            row["frequency"] = f"{text.number(frequency, 4)} ± {text.number(std, 2)}"
    if rows:
        print_view("Modes (± one standard deviation)", "modes", shown)
        for flag in sorted({flag for row in rows for flag in row["flags"].split()}):
            print_text(f"{flag}: {TABLES['modes'].values['flags'][flag]}")
    else:
        print_text("No modes found.")
    if off:
        shown = [
            row | {"off": 100 * (row["found_hz"] / row["declared_hz"] - 1)}
            for row in short_names(off, rows)
        ]
        title = "Warning: the description differs; a mode may have a wrong name"
        print_view(title, "off_description", shown)
        print_text(
            "A new machine agrees with its description: correct it, or describe the modes that it "
            "lacks. Compare a worn machine with its baseline."
        )
    print_refused(refused)


def print_shapes(rows: Sequence[Row], pairs: Sequence[Row]) -> None:
    """Print complex mode shapes, their collinearity and the MAC of the modes of each log."""
    if not rows:
        print_text("No mode shapes: they need the fit of segments of constant velocity.")
    rows, pairs = short_names(rows), short_names(pairs, rows)
    shapes = []
    for row in rows:
        for key, amplitude in row.items():
            if key.startswith("amplitude_") and amplitude is not None:
                channel = key.removeprefix("amplitude_")
                phase = row[f"phase_deg_{channel}"]
                shapes.append(row | {"channel": channel, "size": amplitude, "phase": round(phase)})
    if shapes:
        print_view("Mode shapes (accelerations relative to the largest)", "shapes", shapes)
    mac = {(one["log"], frozenset((one["mode_a"], one["mode_b"]))): one["mac"] for one in pairs}
    title = "Phase collinearity (MPC) and modal assurance criterion (MAC)"
    for log in dict.fromkeys(row["log"] for row in rows):
        own = [row for row in rows if row["log"] == log]
        names = [row["mode"] for row in own]
        for first in range(0, len(own), _MATRIX):
            shown = names[first : first + _MATRIX]
            matrix = [
                {"log": log, "mode": row["mode"], "MPC": _criterion(row["mpc"])}
                | {n: _criterion(mac.get((log, frozenset((row["mode"], n))), 1.0)) for n in shown}
                for row in own
            ]
            print_table(title, matrix, 2)


def _criterion(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def print_frf(
    fits: Sequence[Row], frf: Sequence[Row], rows: Sequence[Row], refused: Sequence[Row]
) -> None:
    """Print frequency responses at some of their lines, their averages and their modes."""
    for fit in fits:
        if len(fits) > 1:
            print_line(fit["log"])
        _print_response(fit, [row for row in frf if row["log"] == fit["log"]])
    print_modes(rows, refused)


def _print_response(fit: Row, frf: Sequence[Row]) -> None:
    step = max(1, -(-len(frf) // constants.TERMINAL_LINES))
    gain = "gain" if fit["method"] == "measured" else "gain (SI)"
    lines = [
        row
        | {
            "phase": math.degrees(row["phase_rad"]),
            "seen": "" if math.isnan(row["coherence"]) else f"{row['coherence']:.4f}",
        }
        for row in frf[step // 2 :: step]
    ]
    title = f"Response of {fit['output']} to {fit['input']}, {len(lines)} of {len(frf)} lines"
    print_view(title, "frf", lines, headings={"gain": gain})
    n = fit["n_averages"]
    noise = "its noise is unknown and taken from the residual of the fit."
    if math.isfinite(fit["chi_square"]):
        noise = f"its noise follows from the coherence of {n:.0f} averages."
    methods = {
        "segments": f"H1 of {n:.0f} segments: the input is not periodic.",
        "periods": f"Mean of {n:.0f} periods of {fit['period_s']:.6g} s.",
        "blows": f"H1 of {fit['note']}",
        "measured": f"Measured response in the units of the file; {noise}",
    }
    print_text(methods[fit["method"]])
    if fit["distortion"] > 0:
        print_text(
            f"The fit misses {text.percent(fit['distortion'], 1)} of the response beyond the noise "
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
        rows, harmonics = short_names(rows), short_names(harmonics, rows)
        alone = len({row["channel"] for row in rows}) == 1
        for title, view in (
            ("Following error (µm)", "statistics"),
            ("Strongest harmonics", "strongest"),
            (f"Those above {rows[0]['floor_nm']:g} nm", "above_floor"),
        ):
            print_view(title, "error", rows, view, {"channel": None} if alone else {})
        print_text(TABLES["error"].legend)
        if harmonics:
            _print_harmonics(rows, harmonics)
    print_refused(refused)


def _print_harmonics(rows: Sequence[Row], harmonics: Sequence[Row]) -> None:
    """Print harmonics, strongest first: all of a single channel, else the first of each."""
    most = constants.TERMINAL_HARMONICS if len(rows) > 1 else len(harmonics)
    print_text("Strongest harmonics, Hz (amplitude in µm):")
    for row in rows:
        own = [h for h in harmonics if (h["log"], h["channel"]) == (row["log"], row["channel"])]
        pairs = ((f"{h['frequency_hz']:.5g}", text.number(h["amplitude_um"])) for h in own[:most])
        texts = [f"{frequency}{GAP}({amplitude})" for frequency, amplitude in pairs]
        more = f" and {len(own) - most} more (see --format json)" if len(own) > most else ""
        if own:
            print_text(f"{row['log']}, {row['channel']}: {', '.join(texts)}{more}.")


def print_magnitudes(rows: Sequence[Row], lines: Sequence[Row], refused: Sequence[Row]) -> None:
    """Print magnitudes against velocity, one table per machine and accelerometer, then lines."""
    for stage, channel in dict.fromkeys((row["stage"], row["channel"]) for row in rows):
        own = [row for row in rows if (row["stage"], row["channel"]) == (stage, channel)]
        _print_channel(f"{stage or 'unknown machine'}, {channel}", own)
    if rows:
        print_line(TABLES["magnitudes"].legend)
    groups: dict[tuple[str, str, float], list[Row]] = {}
    for row in lines:  # each spectral line once for all logs
        groups.setdefault((row["channel"], row["kind"], round(row["frequency_hz"])), []).append(row)
    shown = []
    for _, of_line in sorted(groups.items()):
        largest = 1e3 * max(row["amplitude"] for row in of_line)
        n_logs = len({row["log"] for row in of_line})
        shown.append(of_line[0] | {"largest": largest, "n_logs": n_logs})
    if shown:
        print_view("Lines", "lines", shown)
    print_refused(refused)


def _print_channel(title: str, rows: Sequence[Row]) -> None:
    """Print a table of bands by velocities: magnitudes, or RMS of health and watched bands."""
    at: dict[tuple[str, float], list[Row]] = {}
    known = [row["velocity_mm_s"] for row in rows if not math.isnan(row["velocity_mm_s"])]
    distinct = [-1.0, *distinct_velocities(known)]
    for row in rows:
        exact = row["velocity_mm_s"]
        speed = distinct[0 if math.isnan(exact) else bisect_right(distinct, exact) - 1]
        at.setdefault((row["band"], speed), []).append(row)
    speeds = sorted({speed for _, speed in at})
    left_out = len(speeds) - constants.TERMINAL_VELOCITIES
    if left_out > 0:
        step = (len(speeds) - 1) / (constants.TERMINAL_VELOCITIES - 1)
        speeds = [speeds[round(k * step)] for k in range(constants.TERMINAL_VELOCITIES)]
        title += f" ({left_out} more velocities in csv and json)"
    table = []
    for band, row in {row["band"]: row for row in rows}.items():
        name, key = band, "magnitude_mm_s2"
        if row["kind"] in ("health", "watch"):
            name, key = f"RMS {row['low_hz']:g}-{row['high_hz']:g}", "rms_mm_s2"
        cell = {"band": name}
        for speed in speeds:
            own = at.get((band, speed), [])
            is_line = key == "magnitude_mm_s2" and any(row["line"] for row in own)
            mean = sum(row[key] for row in own) / max(len(own), 1)
            level = text.number(mean, 3 if mean >= 0.1 else 2) if own else ""
            cell["unknown" if speed < 0 else f"{float(f'{speed:.3g}'):g}"] = level + (
                "~" if is_line else " "
            )
        cell["grows"] = "–"
        if row["grows"] is not None:
            star = "*" if row["grows"] else " "
            cell["grows"] = f"{row['slope']:.2f}±{row['slope_std']:.2f}{star}"
        table.append(cell)
    print_table(f"{title}: mm/s² at velocities in mm/s", table)
    _print_places([row for row in rows if row["kind"] == "mode"])


def _print_places(rows: Sequence[Row]) -> None:
    """Print the band of each mode and its strongest frequency, which need not be the mode."""
    found = []
    for band in dict.fromkeys(row["band"] for row in rows):
        own = [row for row in rows if row["band"] == band]
        ends = _range([row[end] for row in own for end in ("low_hz", "high_hz")])
        identified = any(row["placed_by"] == "identified" for row in own)
        how = "around the identified mode" if identified else "as described; mode not identified"
        strongest = _range([row["strongest_hz"] for row in own])
        found.append(f"{band} at {strongest} Hz (band {ends} Hz, {how})")
    if found:
        print_text(f"Strongest harmonic of {'; '.join(found)}.\n")


def _range(values: Sequence[float]) -> str:
    return " to ".join(dict.fromkeys(f"{end:.0f}" for end in (min(values), max(values))))


# --- Stage descriptions and plans ---


def print_stage(content: dict[str, list[Row]]) -> None:
    """Print the modes, parameters, sensitivities and findings of a stage description."""
    (stage,) = content["stage"]
    print_view(f"{stage['name']}: modes", "stage_modes", content["modes"])
    parameters = []
    for row in content["parameters"]:
        outside = row["prior_below_map"] + row["prior_above_map"]
        parameters.append(row | {"outside": outside, "answer": row["verdict"].replace("-", " ")})
    if parameters:
        print_view("Health parameters", "stage_parameters", parameters, "coverage")
        title = "Standard deviation of the parameters"
        print_view(title, "stage_parameters", parameters, "identifiability")
        print_text(TABLES["stage_parameters"].legend.format_map(stage))
        modes: dict[str, dict[str, str]] = {}
        for row in content["sensitivities"]:
            ends = [text.number(row[key], 2) for key in ("at_baseline", "at_limits")]
            own = modes.setdefault(row["mode"], {"mode": row["mode"]})
            own[row["parameter"]] = " → ".join(ends)
        title = "Sensitivity d ln f / d ln parameter, at the baseline → at the limits"
        print_table(title, list(modes.values()))
        for row in content["correlations"]:
            pair = f"{row['parameter_a']} and {row['parameter_b']}"
            print_line(f"Correlation of {pair} after these logs: {row['correlation']:+.2f}")
        print_line("")
    for row in content["findings"]:
        print_text(row["text"], "+ " if row["good"] else "! ")


def print_plans(detect: Sequence[Row], plan: Sequence[Row]) -> None:
    """Print the number of logs needed per length of log, one table per loss to detect."""
    meanings = TABLES["plan"].values["hindrance"]
    hindrances = {kind: meaning.split(": ") for kind, meaning in meanings.items()}
    for asked in detect:
        name = asked["parameter"]
        rows = [
            row | ({"n_logs": hindrances[row["hindrance"]][0]} if row["hindrance"] else {})
            for row in plan
            if row["parameter"] == name and row["loss"] == asked["loss"]
        ]
        title = (
            f"{name}: to detect a loss of {text.percent(asked['loss'], 1)} with power "
            f"{asked['power']:g}, false-alarm probability {asked['false_alarm']:g}"
        )
        head = "loss, N logs"
        print_view(title, "plan", rows, headings={head: f"loss, {asked['n_baseline']} logs"})
        alone = asked["seconds_for_one_log"]
        enough = "A single log of up to an hour is not enough."
        print_line(f"One log is enough from {alone} s on.\n" if alone else f"{enough}\n")
    for kind in dict.fromkeys(row["hindrance"] for row in plan if row["hindrance"]):
        print_text(": ".join(hindrances[kind]))
    print_text(TABLES["plan"].legend)


# --- Machines ---


def print_track(track: Track) -> None:
    """Print the latest modes of a machine, its events and the consistency of the filter."""
    title = f"{track.stage}: modes after {len(track.logs)} logs (± one standard deviation)"
    print_view(title, "track", track_rows(track)[-len(track.modes) :])
    if track.events:
        print_view("Events", "events", events_rows(track))
    found = track.consistency()
    values = (
        f"normalised innovations squared {found.nis:.2f} (expected 1, p = {found.p_value:.2g}), "
        f"autocorrelation {found.autocorrelation:+.2f} (p = {found.autocorrelation_p_value:.2g})"
    )
    if found.holds:
        less = {"below": " (they vary less than expected)", "above": " (they vary more)"}
        print_text(f"The filter is consistent with its logs{less.get(found.side, '')}: {values}.")
        return
    remedy = "The logs vary less than expected: its standard deviations are too large."
    if track.widening[-1] > 1:
        remedy = (
            f"Its standard deviations are multiplied by {track.widening[-1]:.2f}. A cause may be "
            "missing: a covariate, a change of servo tuning, or wrong standard deviations in the "
            "table."
        )
    print_text(f"The filter is NOT consistent with its logs: {values}. {remedy}")


def print_health(health: Health) -> None:
    """Print the health parameters at the last epoch with their diagnostics, and what limits use."""
    rows = to_rows(health.to_columns())[-len(health.parameters) :]
    for row in rows:
        row["interval"] = "{q05:.3f} to {q95:.3f}".format(**row)
    when, n_epochs = text.day(health.recorded_at[-1]), len(health.recorded_at)
    title = f"{health.stage}: health at {when}, the last of {n_epochs} epochs"
    print_view(title, "health", rows)
    print_text(TABLES["health"].legend)
    for one, other in combinations(rows, 2):
        first, second = one["parameter"], other["parameter"]
        rho = one[f"correlation_{second}"]
        print_text(f"Correlation of {first} and {second}: {rho:+.2f}.")
    if not health.explained:
        print_text(
            f"No life of the parameters on the map explains these logs (p = {health.fit[-1]:.1g}): "
            "no health is reported. Check for other causes of the drifts and errors of the map."
        )
    for row, publishable in zip(rows, health.publishable_parameters(), strict=True):
        name = row["parameter"]
        if row["at_edge"]:
            edge = "the posterior ends at the edge of the map; this is a bound. Extend the map."
            print_text(f"{name}: {edge}")
        if not row["identifiable"]:
            print_text(f"{name}: not identifiable from the tracked modes; see `lmshealth stage`.")
        elif health.explained and not publishable:
            print_text(f"{name}: not determined by these drifts.")


# Steps whose sentence is about what is only on the page.
_ON_TERMINAL = {"record": "Record further logs; the page has the reasons."}


def print_summaries(summaries: Sequence[Summary]) -> None:
    """Print the results of a run, most urgent first: a few machines in full, many in a table."""
    if len(summaries) <= constants.TERMINAL_MACHINES:
        for one in summaries:
            print_text(f"{one.identity}: {_verdict(one)}. {one.why}")
            if to_do := _ON_TERMINAL.get(one.step.kind) or text.next_step(one.step):
                print_text(f"  {to_do}")
            for parameter in one.health:
                print_text(f"  {_parameter(parameter)}")
            if one.life is not None:
                print_life(one.life, one.service, when=text.service_on_day(one), today=one.today)
        return
    shown = [
        {
            "stage": one.identity,
            "verdict": _verdict(one),
            "health": "\n".join(map(_parameter, one.health)),
            "remaining life": _travel_left(one.life),
            "service": text.service_on_day(one),
        }
        for one in summaries[: constants.TERMINAL_ROWS]
    ]
    n = text.count(len(summaries), "stage")
    title = f"{n}, most urgent first (medians with 90 % intervals)"
    print_table(title, shown, 5)
    if rest := len(summaries) - len(shown):
        print_line(f"{text.count(rest, 'more stage')}; verdict.csv and prognosis.csv list all.")


def _verdict(one: Summary) -> str:
    """Return the verdict of a machine with its probability, and whether its last log is too old."""
    found = one.verdict + text.in_brackets(one.probability)
    return f"{text.headline(one)}; at the last log {found}" if one.unknown else found


def _parameter(one: ParameterHealth) -> str:
    if not one.determined:
        return f"{spell(one.name)} not determined"
    return f"{spell(one.name)} {text.percent(one.median, 0)} ({text.interval(one.low, one.high)})"


def _travel_left(life: Life | None) -> str:
    if life is None:
        return "–"
    low, middle, high = (text.travel_left(life.any.travel[k], life.horizon) for k in (0, 3, 6))
    return middle if low == high else f"{middle} ({low} to {high})"


def print_life(
    life: Life,
    service: Service,
    before: tuple[date, FloatArray] | None = None,
    *,
    when: str = "",
    today: date | None = None,
) -> None:
    """Print the quantiles of the remaining life for each limit and any, then the service.

    ``before`` is a day with the probabilities that each limit is reached before it; ``when`` is the
    service as of the day ``today``, by default that at the last log.
    """
    blocks = [list(_limit_cells(life, k, before)) for k in range(len(life.limits))]
    # Rows of any limit that are those of one limit, but for its name, are not repeated.
    *each, last = ([("", *rows[0][1:]), *rows[1:]] for rows in blocks)
    same = blocks[each.index(last)][0][0] if last in each else None
    place = f"{text.day(life.recorded_at)}, at {text.whole_km(life.travel)}"
    title = f"{life.stage}: remaining life after {place} (horizon {text.km(life.horizon)})"
    heads = ("until", "probability %", "travel", "time", "date")
    rows = [row for block in (blocks if same is None else blocks[:-1]) for row in block]
    print_table(title, [dict(zip_longest(heads, row, fillvalue="")) for row in rows])
    if same is not None:
        print_text(f"Any limit: the same as {same}.")
    for name in dict.fromkeys(law.parameter for law in life.laws):
        laws = []
        for law in life.laws:
            if law.parameter == name and law.probability >= constants.LAW_SHOWN:
                begin = f" from {text.km(law.begin)} after the baseline" if law.begin else ""
                laws.append(f"{law.kind}{begin} {text.probability(law.probability)}")
        print_text(f"Law of {spell(name)}: {', '.join(laws)}.")
    for left_out, why in (
        (life.undetermined, "the modes cannot determine"),
        (life.restored, "later work has restored"),
    ):
        if left_out:
            names = ", ".join(map(spell, left_out))
            print_text(f"Not included: the limit of {names}, which {why}.")
    for sentence in _advice(life, service, when, today):
        print_text(sentence)
    print_line("")


def _limit_cells(
    life: Life, index: int, before: tuple[date, FloatArray] | None
) -> Iterator[tuple[str, ...]]:
    """Yield one row per quantile, then the probabilities of the limit, one row each."""
    one, levels = life.limits[index], RUL_LEVELS
    name = one.name if one.parameter == "any" else f"{one.name} below {text.percent(one.share)}"
    for level, travel, days, when in zip(levels, one.travel, one.days, one.dates, strict=True):
        share = f"{100 * level:.0f}"
        if math.isinf(days):
            share = share if level == levels[-1] else f"{share} to {100 * levels[-1]:.0f}"
            yield name, share, text.travel_left(travel, life.horizon), "–", "–"
            break
        calendar = "out of range" if when is None else when.isoformat()
        yield name, share, text.travel_left(travel, life.horizon), text.time_left(days), calendar
        name = ""
    yield (f"  already: {text.probability(one.already_past)}",)
    yield (f"  beyond horizon: {text.probability(one.beyond_horizon)}",)
    if before is not None:
        asked, bounds = before
        yield (f"  before {asked}: {text.probability_range(bounds[:, index].tolist())}",)


def _advice(life: Life, service: Service, when: str, today: date | None) -> Iterator[str]:
    """Yield when to service, by which rule, and the risk of a planned service."""
    if math.isnan(service.wait):
        yield "Service: not known before a log shows the effect of the work that was entered."
        return
    if service.max_risk:
        rule = f"accepted risk {text.percent(service.max_risk)}"
    else:
        rule = f"least cost, where a failure costs {service.cost_ratio:.3g} times a service"
    plain = text.service_text(service)
    yield f"Service: {when or plain} ({rule})."
    risk = text.probability(service.risk) if service.risk >= 0 else ""
    if service.kind == "later":
        if when not in ("", plain, text.NONE_SHOWN):  # something else is to be done first
            return
        shown = " for what the modes show" if life.undetermined else ""
        yield f"No service is needed within {text.km(life.horizon)}{shown}."
    elif service.by is None:
        yield "The usage is too low for a calendar date."
    elif service.kind == "now":
        yield f"Probability that a limit has already been reached, at most: {risk}."
    elif not service.max_risk or risk != text.percent(service.max_risk):
        yield f"Probability that a limit is reached before that day, at most: {risk}."
    if service.inspect_by is not None:
        yield from _inspection(service, service.inspect_by, today)
    if service.planned is not None:
        planned = text.probability_range(service.planned_risk)
        yield f"Before the service planned for {service.planned}: {planned}."


def _inspection(service: Service, by: date, today: date | None) -> Iterator[str]:
    """Yield when to record a log; nothing where a log was due, but the service is due now."""
    every = service.inspect_every
    often = f", then every {text.whole_km(every)}" if math.isfinite(every) else ""
    if today is None or by >= today:
        yield f"Inspect (record a log) by {by}{often}."
    elif service.kind != "now":
        yield f"A log was due by {by}: record one now{often}."


def print_calibration(check: CalibrationCheck) -> None:
    """Print coverage, detection and the verdict of a check of calibration."""
    from lmshealth.calibration import page  # late: it imports all that draws

    print_table(check.title(), page.expectation_rows(check), 2)
    print_line("")
    print_table("Detection, false alarms and dates", page.rate_rows(check.rates), 2)
    print_line("")
    _, headline, reasons = page.verdict_of(check)
    print_text(f"{headline}. {' '.join(reasons)}")
