"""What decays claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, percents, span

STEP = "identify, after stops"


def result(answer: Row) -> Iterator[Claim]:
    """Claim coverages, scatter beside the bound, machines, and a real beam."""
    parts = [
        mode[quantity]
        for case in answer["cases"].values()
        for mode in case["modes"]
        for quantity in ("f", "zeta")
    ]
    held = sum(part["coverage"]["holds"] for part in parts)
    squares = [part["least_squares"]["share"] for part in parts if "least_squares" in part]
    shares = [part["coverage"]["share"] for part in parts]
    yield Claim(
        "cases whose 95 % intervals of f and ζ cover",
        f"{held} of {len(parts)} ({percents(shares)})",
        f"99.9 %, {answer['n_seeds']} logs each",
        f"least squares cover {percents(squares)}",
        held == len(parts),
    )
    yield Claim(
        "root mean square error over the Cramér-Rao bound",
        span(part["rmse_over_bound"] for part in parts),
    )
    for width, told in (("narrow", "1.5 times as narrow"), ("wide", "1.5 times as wide")):
        found = answer["controls_found_out"][width]
        caught, of = found.split(" of ")
        yield Claim(
            f"cases in which intervals {told} are found out (control)", found, met=caught == of
        )
    machines = answer["machines"]
    yield Claim(
        "95 % intervals of f and ζ of stopped machines hold the truth",
        percents(machines[q]["share"] for q in ("f", "zeta")),
        f"{percents(machines['f']['interval'])} (f, 99.9 %)",
        f"{machines['n_taken_for_another']} of {machines['n_modes']} modes taken for another",
        all(machines[q]["holds"] for q in ("f", "zeta")),
    )
    seen = [row for row in answer["beam"] if row["f_hz"] is not None]
    off = max(abs(row["f_hz"] - row["reference_hz"]) for row in seen)
    yield Claim(
        "a real beam: dwells told, and how far they are off at most",
        f"{len(seen)} of {len(answer['beam'])}, {off:.2f} Hz",
        "",
        "0.15 Hz asked",
        off < 0.15,
    )
