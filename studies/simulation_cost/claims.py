"""What simulation_cost claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, span

STEP = "simulated plants"


def result(answer: Row) -> Iterator[Claim]:
    """Claim time and memory of a simulated minute."""
    rows = answer["stages"].values()
    passed = answer["passed"]
    peers = span(row["peer_over_ours"] for row in rows)
    yield Claim(
        "60 s of four signals, processor time",
        span((row["record_60s_cpu_s"] for row in rows), "s"),
        "least of three turns",
        f"{answer['bound_s']} s asked; stepping by python-control takes {peers} times",
        passed["time"],
    )
    yield Claim(
        "its memory",
        span((row["peak_mb"] for row in rows), "MB"),
        "",
        f"{answer['bound_mb']:.0f} MB asked",
        passed["memory"],
    )
