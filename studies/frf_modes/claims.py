"""What frf_modes claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, covered, number, percents, span

STEP = "identify FRF logs"


def result(answer: Row) -> Iterator[Claim]:
    """Claim coverages, errors beside the bound, benches, and sweeps."""
    parts = [case[q] for case in answer["cases"].values() for q in ("frequency", "damping")]
    exact = [part for part in parts if "rmse_over_cramer_rao" in part]
    narrow = percents(part["control_narrower"]["share"] for part in exact)
    yield covered(
        "95 % intervals of f and ζ, four kinds of driven records",
        [part["coverage"] for part in exact],
        f"1.5 times as narrow: {narrow}",
    )
    yield Claim(
        "root mean square errors over the Cramér-Rao bound",
        span(value for part in exact for value in part["rmse_over_cramer_rao"]),
    )
    bent = [part["coverage"]["share"] for part in parts if part not in exact]
    lost = answer["cases"]["distorting motor"]["n_with_others"]
    yield Claim(
        "coverage with a motor that distorts",
        percents(bent),
        "",
        f"95 % at least asked; {lost} of {answer['n_seeds']} records show another number of modes",
        lost == 0,
    )
    sides = answer["two_inertias"]
    yield Claim(
        "a real bench of two inertias: motor and load side",
        " and ".join(f"{row['frequency_hz']:.3f}" for row in sides.values()) + " Hz",
        f"± {number(max(row['frequency_std_hz'] for row in sides.values()))} Hz",
        "",
        answer["passed"]["bench: sides agree"],
    )
    rows = {name: answer["sweep_rows"][name] for name in answer["sweeps"]}
    for what, wide in (("a band around it", False), ("all that is excited", True)):
        own = [
            sensor
            for name, found in rows.items()
            if name.endswith("wide") == wide
            for row in found
            for sensor in row.values()
            if isinstance(sensor, dict)
        ]
        name = (
            "wide sweeps: z below 2 on average"
            if wide
            else ("sweeps around pitch: z is standard normal")
        )
        yield Claim(
            f"pitch of a sweep of the simulated stages, in {what}: largest error",
            f"{max(abs(s['error_hz']) for s in own):.3f} Hz",
            f"{max(abs(s['z'][0]) for s in own):.1f} σ",
            "",
            answer["passed"][name],
        )
