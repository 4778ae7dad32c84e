"""What a terminal shows of an examined stage description."""

from __future__ import annotations

from collections.abc import Sequence

import click

from lmshealth.cli.terminal import or_dash, percent, print_table, print_text
from lmshealth.report.tables import Row

_VERDICTS = {
    "told": "identifiable",
    "longer-logs": "longer logs",
    "together": "together",
    "not-told": "not identifiable",
}


def print_stage(content: dict[str, list[Row]]) -> None:
    """Print what a stage description covers and can tell, then what that comes to."""
    (stage,), parameters = content["stage"], content["parameters"]
    _print_modes(stage, content["modes"])
    if parameters:
        _print_coverage(parameters)
        _print_tellings(stage, parameters)
        _print_sensitivities(content)
    for row in content["findings"]:
        print_text(row["text"], "+ " if row["good"] else "! ")


def _print_modes(stage: Row, rows: Sequence[Row]) -> None:
    cells = [
        (
            row["mode"],
            "yes" if row["tracked"] else "no",
            f"{row['frequency_hz']:.1f}",
            f"{row['searched_low_hz']:.0f}-{row['searched_high_hz']:.0f}",
            *(or_dash(row[key], ".1f") for key in ("map_hz", "map_at_limits_hz")),
            *(or_dash(row[key], ".1e") for key in ("surrogate_error_ln_f", "logs_reach_ln_f")),
        )
        for row in rows
    ]
    heads = ("Hz", "searched", "map Hz", "at limits", "map error", "logs reach")
    print_table(f"{stage['name']}: modes", ("mode", "tracked"), heads, cells)


def _print_coverage(parameters: Sequence[Row]) -> None:
    cells = [
        (
            row["parameter"],
            f"{row['baseline']:g}",
            "–" if row["limit"] is None else f"{row['limit']:g}",
            f"{row['prior_q05']:.3g}-{row['prior_q95']:.3g}",
            f"{row['map_low']:.3g}-{row['map_high']:.3g}",
            percent(row["prior_below_map"] + row["prior_above_map"]),
        )
        for row in parameters
    ]
    heads = ("baseline", "limit", "prior 90 %", "map", "prior beyond")
    print_table("Health parameters", ("parameter",), heads, cells)


def _print_tellings(stage: Row, parameters: Sequence[Row]) -> None:
    cells = [
        (
            row["parameter"],
            *(percent(row[f"{key}_std_ln"]) for key in ("prior", "logs", "endless_logs")),
            percent(row["informed"]),
            _VERDICTS[row["verdict"]],
        )
        for row in parameters
    ]
    heads = ("prior", "logs", "endless logs", "informed", "")
    title = "What is known of them (one standard deviation)"
    print_table(title, ("parameter",), heads, cells)
    print_text(
        f"logs: {stage['n_logs']} of {stage['seconds_per_log']:g} s and as many at the baseline, "
        "on average over the priors, at best. logs reach, map error: of ln f. informed: share of "
        "the prior's variance that the logs take away; told from a half on."
    )
    click.echo()


def _print_sensitivities(content: dict[str, list[Row]]) -> None:
    names = [row["parameter"] for row in content["parameters"]]
    cells: dict[str, list[str]] = {}
    for row in content["sensitivities"]:
        ends = [or_dash(row[key], ".2g") for key in ("at_baseline", "at_limits")]
        cells.setdefault(row["mode"], []).append(" → ".join(ends))
    title = "Sensitivity d ln f / d ln parameter, at the baseline → at the limits"
    print_table(title, ("mode",), names, [(mode, *own) for mode, own in cells.items()])
    for row in content["correlations"]:
        pair = f"{row['parameter_a']} and {row['parameter_b']}"
        click.echo(f"Correlation of {pair} after such logs: {row['correlation']:+.2f}")
    click.echo()
