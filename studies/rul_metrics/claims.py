"""What rul_metrics claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, counted, measured, number

STEP = "prognose, beside others"


def result(answer: Row) -> Iterator[Claim]:
    """Claim accuracy and score beside a line, progpy and the Cramér-Rao bound."""
    for cut in answer["cuts"]:
        ways, share = cut["ways"], f"{100 * cut['share']:.0f} % of life"
        ours, line = ways["lmshealth"], ways["line"]
        bound = ours["over_bound"]["map right"]
        yield counted(
            f"median within a fifth of the truth at {share}",
            ours["accurate"]["hits"],
            ours["accurate"]["n"],
            f"{bound[0]:.2f} times ({bound[1]:.2f} to {bound[2]:.2f}) as often as at the "
            f"Cramér-Rao bound; a line {line['accurate']['hits']}",
        )
        others, better = [], False
        for name in ("line", "progpy"):
            if name in ways:
                apart = ways[name]["crps_more_than_ours_km"]
                better |= apart["mean"] < -2 * apart["se"]
                more = " ".join(measured(apart.values(), "km"))
                others.append(f"{name} {number(ways[name]['crps_km'])} km ({more} more)")
        yield Claim(
            f"score (CRPS) at {share}",
            f"{number(ours['crps_km'])} km",
            "",
            "; ".join(others),
            ours["crps_km"] <= line["crps_km"] and not better,
        )
        for level, (inside, wrong) in zip(
            (50, 90), zip(ours["coverage"], line["coverage"], strict=True), strict=True
        ):
            yield counted(
                f"{level} % intervals hold the truth at {share}",
                inside["hits"],
                inside["n"],
                f"a line's {wrong['hits']}" + ("" if inside["holds"] else "; ours are too wide"),
                met=inside["holds"],
            )
    seconds = answer["seconds"]
    yield Claim(
        "10,000 draws after the posterior",
        f"{1e3 * seconds['lmshealth']['median']:.0f} ms",
        f"{1e3 * seconds['lmshealth']['largest']:.0f} ms at most",
        f"1,000 of progpy: {number(seconds['progpy']['median'])} s" if "progpy" in seconds else "",
        answer["passed"]["10,000 draws in 0.1 s after the posterior"],
    )
    healthy = answer["healthy"]
    yield Claim(
        "remaining life of healthy lives: probability past the horizon",
        number(healthy["lmshealth"]["beyond"]),
        f"{healthy['lmshealth']['n']} lives",
        f"progpy: median {number(healthy['progpy']['median_km'])} km in {healthy['progpy']['n']}"
        if "progpy" in healthy
        else "",
    )
