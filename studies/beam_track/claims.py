"""What beam_track claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, span

STEP = "track"


def result(answer: Row) -> Iterator[Claim]:
    """Claim how far a beam goes, and that it is said to return."""
    repeats, passed = answer["repeats"], answer["passed"]
    ways = [(row, way) for row in repeats for way in ("blind", "told")]
    off = [abs(row[way]["off_in_std"]) for row, way in ways]
    far = [max(row["blind"]["drift"]) for row in repeats]
    yield Claim(
        "a real beam, stiffened and released, returns to its start within, standard deviations",
        span(off),
        f"{len(repeats)} repeats, told and not told of the roller",
        f"2 asked; it went {span(far)} in ln f away",
        all(passed.values()),
    )
