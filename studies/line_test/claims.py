"""What line_test claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, counted, percents

STEP = "lines"


def result(answer: Row) -> Iterator[Claim]:
    """Claim false alarms, what is found, and what lines do to a mode."""
    rates = [rate for row in answer["false_alarms"] for rate in row["rates"]]
    controls = answer["controls"]
    yield Claim(
        "declared rates of false alarms that are raised",
        f"{sum(rate['raised'] for rate in rates)} of {len(rates)}",
        "99 % intervals",
        "two tests that must raise theirs do"
        if all(row["raised"] for row in controls)
        else "controls are not found out",
        not any(rate["raised"] for rate in rates),
    )
    found = answer["detection"]["white, 3 s"]
    for row in found:
        if row["ratio_db"] in (16, 18, 20, 24):
            yield counted(
                f"lines of {row['ratio_db']} dB found in white noise of 3 s",
                round(row["share_found"] * row["n"]),
                row["n"],
                f"{percents([row['best_any_frequency']])} by who knows the density",
            )
    moved = answer["modes"]["strengths"]
    hits = [round(row["share_in_place"] * row["n"]) for row in moved]
    yield counted(
        "a mode stays within σ under lines of 0.3 to 1000 times its peak",
        sum(hits),
        sum(row["n"] for row in moved),
    )
    worst = min(moved, key=lambda row: row["share_in_place"])
    yield counted(
        f"the same at {worst['times_peak']:g} times the peak, where it is worst",
        round(worst["share_in_place"] * worst["n"]),
        worst["n"],
        "95 % asked; with lines left in " + percents([worst["share_in_place_with_lines_left_in"]]),
        met=worst["share_in_place"] >= 0.95,
    )
