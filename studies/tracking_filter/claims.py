"""What tracking_filter claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, at_level, covered, number, percents, span

STEP = "track"


def result(answer: Row) -> Iterator[Claim]:
    """Claim sizes of errors, coverage, agreement with other filters, and time."""
    known, passed = answer["known_setting"], answer["passed"]
    stated, halved = known["as reported"], known["halved"]
    band = stated["drift"]
    yield Claim(
        "mean squared errors of ln f, ln ζ, drift and innovations over what they are said to be",
        span(row["mean"] for row in stated.values()),
        f"band of drifts {number(band['low'])} to {number(band['high'])} (99.9 %), "
        f"{known['lives']:,} lives",
        f"half the covariance: {span(row['mean'] for row in halved.values())}",
        all(row["holds"] for row in stated.values()),
    )
    coverage = answer["averaged"]["coverage"]
    shown = [row for name, rows in coverage.items() if "halved" not in name for row in rows]
    for nominal in (0.5, 0.9):
        control = at_level(coverage["drift, R halved"], nominal)
        yield covered(
            f"published intervals of {100 * nominal:.0f} % cover",
            at_level(shown, nominal),
            f"covariances halved: {percents(row['share'] for row in control)}",
        )
    off = answer["deviation"]
    yield Claim(
        "largest difference from filterpy, of ln f, its standard deviation and drift",
        span(off[name] for name in ("ln f", "std of ln f", "drift")),
        f"{off['lives']} lives",
        met=passed["numbers are those of filterpy"],
    )
    speed = answer["speed"]
    rows = {row["program"]: row for row in speed["programs"]}
    others = ", ".join(
        f"{name} {row['times_filterpy']:.2f}"
        for name, row in rows.items()
        if name != "track, all settings"
    )
    ours = rows["track, all settings"]
    yield Claim(
        f"{speed['epochs']:,} epochs of {speed['modes']} modes, all settings",
        f"{ours['cpu_s']:.2f} s, {ours['times_filterpy']:.1f} times filterpy with one setting",
        "",
        f"2 s asked; {others} times",
        ours["cpu_s"] < 2,
    )
