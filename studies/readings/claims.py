"""What readings claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, number, percents, span

STEP = "spectra, following error, accelerations"


def result(answer: Row) -> Iterator[Claim]:
    """Claim what is read of known signals, slopes of growth, and real files."""
    checks = answer["checks"]
    sines = [
        c["measured"]
        for name, c in checks["spectra"].items()
        if "sine of amplitude A" in name and c["asked"] == "below 1e-06"
    ]
    yield Claim(
        "spectra: error of the amplitude of a sine, relative, at most",
        number(max(sines)),
        "",
        "10⁻⁶ asked",
        max(sines) < 1e-6,
    )
    sums = [c["measured"] for c in checks["error"].values() if c["asked"] == "below 1e-09"]
    yield Claim(
        "following error: largest error of a sum of sines",
        number(max(sums)),
        "",
        "10⁻⁹ asked",
        max(sums) < 1e-9,
    )
    growth = checks["growth"]
    for what, ending, control in (
        (
            "95 % intervals of slopes of growth cover",
            "coverage of the 95 % interval",
            "coverage with σ halved",
        ),
        (
            "what does not depend on velocity is said to grow",
            "said to grow",
            "said to grow with σ halved",
        ),
    ):
        own, others = (
            [c for name, c in growth.items() if name.endswith(text)] for text in (ending, control)
        )
        margin = max((c["interval"][1] - c["interval"][0]) / 2 for c in own)
        yield Claim(
            what,
            f"{percents(c['measured'] for c in own)} ({span(c['trials'] for c in own)} each)",
            f"± {100 * margin:.1f} % at most (99.9 %)",
            f"σ halved: {percents(c['measured'] for c in others)}",
            all(c["passed"] for c in own),
        )
    passed = answer["passed"]
    yield Claim(
        "checks of readings that hold, with their controls",
        f"{sum(passed.values())} of {len(passed)}",
        met=all(passed.values()),
    )
