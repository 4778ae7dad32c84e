"""What three_methods claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, number

STEP = "simulated plants"


def result(answer: Row) -> Iterator[Claim]:
    """Claim that three methods agree, and which mode which of them shows."""
    for name, stage in answer["stages"].items():
        controls = all(row["disagrees"] for row in stage["controls"].values())
        for mode, row in stage["modes"].items():
            seen = ", ".join(f"{method} {own['n_seen']}" for method, own in row["methods"].items())
            least = [min(pair["p"], pair["p_of_mean"]) for pair in row["pairs"].values()]
            yield Claim(
                f"{name}: methods that show {mode} agree, of {answer['n_seeds']} logs each",
                f"{row['verdict']} ({seen})",
                f"smallest p {number(min(least))}, refused below 0.001" if least else "",
                "both controls disagree" if controls else "controls are not found out",
                row["verdict"] != "disagree" and controls,
            )
