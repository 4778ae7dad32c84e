"""What sampling_speed claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Older, Row, number

STEP = "infer"
OLDER = {
    "result": Older("38ea0d4464b9", "the courses of a life were weighed, which its times are of")
}


def result(answer: Row) -> Iterator[Claim]:
    """Claim draws a second beside other programs, and times of epochs and lives."""
    epoch, life = answer["epoch"], answer["life"]
    rows = {row["program"]: row for row in epoch["programs"]}
    beside = ", ".join(
        f"{number(row['ours_is_times_faster'])} times {name}"
        for name, row in rows.items()
        if name != "lmshealth"
    )
    ours = rows["lmshealth"]
    yield Claim(
        "effective draws of an epoch a second",
        number(ours["ess_per_s"]),
        f"median of {epoch['turns']} turns",
        f"2,000 asked; {beside}",
        ours["ess_per_s"] >= 2000
        and all(row["ours_is_times_faster"] >= 1 for row in rows.values()),
    )
    one = answer["converged_epoch"]
    yield Claim(
        "a converged epoch",
        f"{number(one['cpu_s'])} s",
        f"median of {one['turns']} turns",
        "3 s asked",
        one["cpu_s"] < 3,
    )
    walker = life["likelihood"]
    yield Claim(
        "a walker of a life, with the likelihood of a loop over filterpy",
        f"{number(walker['us_per_walker'])} µs, {number(walker['times_faster'])} times faster",
        "",
        f"20 times asked; likelihoods differ by {number(walker['largest_difference'])}",
        walker["times_faster"] >= 20,
    )
    yield Claim(
        f"the posterior of a life of {walker['logs']} logs",
        f"{number(life['cpu_s'])} s",
        f"median of {len(life['runs'])} turns" if "runs" in life else "",
        "10 s asked",
        life["cpu_s"] < 10,
    )
