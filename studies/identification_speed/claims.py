"""What identification_speed claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, number

STEP = "identify"


def result(answer: Row) -> Iterator[Claim]:
    """Claim time and memory."""
    record, log = answer["record"], answer["log"]
    yield Claim(
        "three modes in three channels of 60 s at 1 kHz, least time",
        f"{number(record['least_s'])} s",
        f"of {record['n']} turns",
        "0.05 s asked",
        record["least_s"] < 0.05,
    )
    yield Claim(
        "a minute of four channels at 20 kHz, over reading and transforming it",
        number(log["median_ratio"]),
        f"median of {log['n']} turns",
        "3 asked",
        log["median_ratio"] <= 3,
    )
    yield Claim(
        "its memory over that of the record",
        number(log["memory_over_record"]),
        "",
        "3 asked",
        log["memory_over_record"] <= 3,
    )
