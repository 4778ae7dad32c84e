"""What tracking_lives claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, counted, covered, number

STEP = "track"
DAMAGED = ("preload-wear", "mount-loosening", "both", "sudden-loosening", "crash")
EVENTS = (
    "crash",
    "sudden-loosening",
    "servo-retuning, undeclared",
    "regreasing, undeclared",
)


def result(answer: Row) -> Iterator[Claim]:
    """Claim coverage, alarms, delays and events of drawn lives."""
    yield from _lives(answer)
    yield covered(
        "the same, 90 %, where covariances are halved (control)",
        [answer["halved"]["90"]],
        met=not answer["halved"]["90"]["holds"],
    )
    power = answer["power"]
    alarms, learns = power["alarms"], number(power["over_best_that_learns"])
    yield counted(
        "5 % of preload lost over 60 logs is told",
        alarms["hits"],
        alarms["n"],
        "95 % asked",
        met=alarms["share"] >= 0.95,
    )
    delays = power["delays"]
    spread = [delays["tracker"][q] for q in ("q5", "q95")]
    yield Claim(
        "logs until it is told, over those of the best that must learn as much",
        learns,
        f"{number(delays['tracker']['mean'])} logs in the mean, 90 % of lives "
        f"{number(spread[0])} to {number(spread[1])}",
        f"{number(power['over_best_that_knows'])} times those of who knows all",
    )
    hits = [row["alarms"] for row in answer["controls"]]
    yield counted(
        "lives alarm of which temperature, payload or a retuning is hidden (control)",
        sum(row["hits"] for row in hits),
        sum(row["n"] for row in hits),
    )


def raw(answer: Row) -> Iterator[Claim]:
    """Claim the same of lives that were simulated and identified."""
    yield from _lives(answer)


def _lives(answer: Row) -> Iterator[Claim]:
    rows, passed = answer["lives"], answer["passed"]
    damaged = [row for row in rows if row["kind"] in DAMAGED]
    healthy = [row for row in rows if row not in damaged]
    for nominal in ("90", "50"):
        yield covered(
            f"intervals of {nominal} % hold the drift of damaged lives",
            [row["coverage"][nominal] for row in damaged],
        )
    yield covered(
        "intervals of 90 % hold the drift of healthy lives",
        [row["coverage"]["90"] for row in healthy],
        "wider than asked" if any(not r["coverage"]["90"]["holds"] for r in healthy) else "",
        met=passed["intervals of healthy lives cover at least"],
    )
    for what, own, asked in (
        ("healthy lives that alarm", healthy, "healthy lives alarm as declared"),
        ("damaged lives that alarm", damaged, "damage alarms"),
    ):
        hits = sum(row["alarms"]["hits"] for row in own)
        n = sum(row["n"] for row in own)
        yield counted(what, hits, n, "1 % declared" if own is healthy else "", met=passed[asked])
    for name in EVENTS:
        own = [row["events"]["found_right"] for row in rows if row["name"] == name]
        each = " (" + ", ".join(f"{row['hits']} of {row['n']}" for row in own) + ")"
        yield counted(
            f"told for what it is: {name}",
            sum(row["hits"] for row in own),
            sum(row["n"] for row in own),
            each.strip(" ()") if len(own) > 1 else "",
        )
