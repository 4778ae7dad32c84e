"""What the parts of scale claim."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, number

STEP = "batch"


def cost(answer: Row) -> Iterator[Claim]:
    """Claim that a log costs the same in archives of any size."""
    passed = answer["passed"]
    sizes = [row["logs"] for row in answer["sizes"]]
    yield Claim(
        f"cost of one more log between {sizes[1]:,} and {sizes[2]:,}, over that from {sizes[0]:,}",
        f"{answer['marginal_ratio']:.3f}",
        "",
        f"0.9 to 1.1 asked; where logs get longer {answer['control_ratio']:.2f} of a log",
        passed["flat"] and passed["control is seen"],
    )
    memory = [f"{row['memory_mb']:.0f}" for row in answer["sizes"]]
    yield Claim("largest memory", f"{memory[0]} to {memory[-1]} MB", "", "", passed["memory stays"])
    yield Claim(
        "reading, store and bookkeeping over the identification",
        f"{100 * answer['overhead']:.1f} %",
        "",
        "15 % asked",
        passed["little beside identification"],
    )


def index(answer: Row) -> Iterator[Claim]:
    """Claim that the front page of many machines is light."""
    passed = answer["passed"]
    yield Claim(
        f"{answer['stages']:,} stages on one page load, over a bare table of the same text",
        f"{answer['to_bare']:.2f} times",
        f"median of {answer['loads']} loads",
        f"4 asked; with every row laid out {answer['control_to_bare']:.1f}",
        all(passed.values()),
    )
    yield Claim(
        "a stage on it",
        f"{answer['bytes_per_stage']:,} bytes",
        "",
        "1,500 asked",
        answer["bytes_per_stage"] <= 1500,
    )


def speedup(answer: Row) -> Iterator[Claim]:
    """Claim how much faster two workers are than one."""
    low, middle, high = answer["bound"]
    for kind, what in (("local", "two processes"), ("dask", "two workers of Dask")):
        least, median, most = answer[kind]
        yield Claim(
            f"{what} identify an archive, over one",
            f"{median:.2f} times",
            f"{least:.2f} to {most:.2f} in {answer['turns']} turns",
            f"the machine gives two bare processes {middle:.2f} ({low:.2f} to {high:.2f}); "
            f"{answer['of the bound'][kind]:.2f} of it, 0.9 asked",
            answer["passed"][f"{kind}: 1.8 of 2"],
        )


def plan(answer: Row) -> Iterator[Claim]:
    """Claim, by what one stage costs, how long a million logs take."""
    for row in answer["plans"]:
        yield Claim(
            f"a million logs of ten thousand stages, {row['workers']:,} workers, reckoned",
            f"{number(row['hours'])} h",
            "",
            f"waits for {row['waits_for']}",
        )
