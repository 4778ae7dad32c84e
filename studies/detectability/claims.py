"""What detectability claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, covered, percents, span

STEP = "plan"
SHORT, LONG = (1, 20.0), (20, 300.0)  # logs, and seconds of each


def result(answer: Row) -> Iterator[Claim]:
    """Claim smallest losses, and that the posterior has the planned power and false alarms."""
    for asked in answer["maps"]:
        losses = [
            asked["smallest_loss"][answer["logs"].index(n)][answer["durations_s"].index(seconds)]
            for n, seconds in (SHORT, LONG)
        ]
        yield Claim(
            f"smallest loss of {asked['parameter']} of {asked['stage']} that one log of 20 s shows",
            f"{100 * losses[0]:.1f} %",
            f"power {100 * answer['power']:.0f} %, "
            f"false alarms {100 * answer['false_alarm']:.0f} %",
            f"twenty of 300 s show {100 * losses[1]:.1f} %",
        )
    planned = [row for row in answer["checks"] if row["arm"] == "as planned"]
    yield covered(
        f"power of the posterior, {len(planned)} points",
        [row["power"] for row in planned],
        f"{100 * answer['power']:.0f} % planned",
    )
    yield covered(
        "its false alarms",
        [row["false_alarms"] for row in planned],
        f"{100 * answer['false_alarm']:.0f} % planned",
    )
    free = [
        row["power"]["share"]
        for row in answer["checks"]
        if row["arm"] == "as shipped, the other from its prior" and row["stage"] == "lms-y"
    ]
    yield Claim(
        "power in Y where the other parameter has moved and the map has its error",
        percents(free),
        "",
        "no part of the plan",
    )
    over = [m["stated_over_bound"] for row in answer["identified"] for m in row["modes"].values()]
    yield Claim("standard deviations of identification over the bound of the plan", span(over))
