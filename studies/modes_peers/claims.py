"""What modes_peers claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, span

STEP = "identify"
OURS = "lmshealth"


def result(answer: Row) -> Iterator[Claim]:
    """Claim errors, coverage and time beside other programs on the same records."""
    cases = answer["cases"]
    ours = _errors(cases, OURS)
    yield Claim(
        "root mean square errors over the Cramér-Rao bound",
        span(ours),
        f"± {max(_errors(cases, OURS, 'its_error')):.2f} at most",
    )
    for name in dict.fromkeys(tool for case in cases for tool in case["tools"]):
        if name == OURS or "no intervals" in name:
            continue
        own = [case["tools"][name] for case in cases if name in case["tools"]]
        told = [x["it_is"] for tool in own for x in tool["against_ours"].values()]
        covers = [bool(tool["coverage"]) for tool in own]
        yield Claim(
            f"the same of {name}, and how often it is ahead of us, even, or behind",
            f"{span(found)}" if (found := _errors(cases, name)) else "no mode",
            "",
            f"{told.count('ahead')}, {told.count('even')}, {told.count('behind')} of {len(told)}; "
            f"{span(tool['time_over_ours'] for tool in own)} times our time"
            + ("" if any(covers) else ", without intervals"),
            "ahead" not in told,
        )
    bare = [
        c["tools"][name]["time_over_ours"]
        for c in cases
        for name in c["tools"]
        if "no intervals" in name
    ]
    yield Claim("time of SSI-cov without intervals, over ours", span(bare))
    held = {
        name: [
            c["holds"]
            for case in cases
            for c in case["tools"].get(name, {}).get("coverage", {}).values()
        ]
        for name in dict.fromkeys(tool for case in cases for tool in case["tools"])
    }
    yield Claim(
        "cases in which 95 % intervals cover",
        f"{sum(held[OURS])} of {len(held[OURS])}",
        "99.9 %",
        ", ".join(
            f"{name} {sum(own)} of {len(own)}" for name, own in held.items() if own and name != OURS
        ),
        all(held[OURS]),
    )


def _errors(cases: list[Row], name: str, what: str = "rmse_over_bound") -> list[float]:
    return [
        mode[what]
        for case in cases
        for mode in case["tools"].get(name, {}).get("modes", [])
        if mode.get(what) is not None
    ]
