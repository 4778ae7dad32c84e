"""What install claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, number

STEP = "batch"


def result(answer: Row) -> Iterator[Claim]:
    """Claim what the package costs before it does anything."""
    start, size, passed = answer["start"], answer["size"], answer["passed"]
    own, bare = start["cpu_s"]["import lmshealth"], start["cpu_s"]["import numpy, scipy, pandas"]
    yield Claim(
        "import lmshealth, processor time",
        f"{number(own)} s",
        f"least of {start['turns']} turns",
        f"1.5 s asked; numpy, scipy and pandas {number(bare)} s",
        passed["import in 1.5 s"],
    )
    yield Claim(
        "lmshealth --help, over the import of numpy, scipy and pandas",
        f"{number(start['times_bare']['--help'])} times",
        f"median of {start['turns']} turns",
        "less than once asked",
        passed["so does help"],
    )
    yield Claim(
        "megabytes installed, of all distributions",
        number(size["distributions_mb"]),
        "",
        f"lmshealth itself {number(size['lmshealth_mb'])}",
    )
