"""What paper_tables claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, percents

STEP = "simulated plants"
COUNTS = {
    "table_3_std_within_1.5": "standard deviations of Δe within a factor 1.5 (Table 3)",
    "table_4_max_magnitude_within_1.5": "largest harmonics within a factor 1.5 (Table 4)",
    "table_6_7_mode_rows_within_3": "accelerations at the modes within a factor 3 (Tables 6, 7)",
    "table_6_7_mode_rows_without_mains_within_3": "the same where no mains line was fitted",
}


def result(answer: Row) -> Iterator[Claim]:
    """Claim which cells of the paper's tables are reproduced."""
    rows, control = answer["rows"], answer["control_constant_velocity_only"]
    modal = [x for row in rows if row["table"] == "Table 5" for x in row["ratio"]]
    off = [abs(x - 1) for x in modal if x is not None]
    yield Claim(
        "Table 5, all cells, off at most", percents([max(off)]), "", "3 % asked", max(off) <= 0.03
    )
    for key, what in COUNTS.items():
        yield Claim(
            what,
            answer["summary"][key],
            f"means over {answer['seeds']} seeds",
            f"constant velocity alone: {control[key]}",
        )
    for table, what in (("Table 1", "margins"), ("Table 2", "resonances")):
        own = [row["verdict"] != "not reproduced" for row in rows if row["table"] == table]
        yield Claim(f"{what} of {table} that are there", f"{sum(own)} of {len(own)}", met=all(own))
    for axis, row in answer["growing_with_velocity"].items():
        found, named = row["named_and_simulated"].split(" of ")
        yield Claim(
            f"frequencies said to grow with velocity that do ({axis.upper()})",
            row["named_and_simulated"],
            met=found == named,
        )
