"""What read_throughput claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, span

STEP = "read"


def result(answer: Row) -> Iterator[Claim]:
    """Claim times and memory beside the bare libraries, and what becomes of real files."""
    times, memory = answer["times"], answer["memory"]
    bounded = [times[name]["ratio"] for name in answer["passed"]]
    yield Claim(
        "processor time of a reader over that of the bare library, six formats",
        span(bounded),
        "least of nine turns",
        f"{answer['bound']} asked",
        max(bounded) <= answer["bound"],
    )
    yield Claim(
        "the same of compressed CSV and UFF58",
        span(row["ratio"] for name, row in times.items() if name not in answer["passed"]),
    )
    yield Claim(
        f"memory for a log of {answer['memory_minutes']} minutes, in minutes of the log",
        span(row["minutes_of_reader"] for row in memory.values()),
        "",
        f"the libraries take {span(row['minutes_of_library'] for row in memory.values())}",
        all(answer["memory_passed"].values()),
    )
    samples = answer["samples"].values()
    told = sum(any(text.startswith("read") for text in sample.values()) for sample in samples)
    yield Claim(
        "real files that are read, as they are or by a column map",
        f"{told} of {len(samples)}",
        "",
        "the others are refused with a reason",
    )
