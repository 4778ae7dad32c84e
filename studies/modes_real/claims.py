"""What modes_real claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, number, percents

STEP = "identify"


def result(answer: Row) -> Iterator[Claim]:
    """Claim what is known of a building, frames and a weak mode."""
    building = answer["building"]
    modes = building["modes"].values()
    off = [abs(row["median_frequency_hz"] / row["published_hz"] - 1) for row in modes]
    n = building["n_windows"]
    yield Claim(
        f"a timber building: logs of five minutes in which each of {len(off)} modes is told",
        f"{min(row['n_windows'] for row in modes)} of {n}",
        met=all(row["n_windows"] == n for row in modes),
    )
    yield Claim(
        "its median frequencies off the published ones, at most",
        f"{100 * max(off):.2f} %",
        "",
        "0.5 % asked",
        max(off) < 0.005,
    )
    low = min(row["frequency_hz_coverage_95_interval"][0] for row in modes)
    high = max(row["frequency_hz_coverage_95_interval"][1] for row in modes)
    half = [row["frequency_hz_coverage_95_control_half_std"] for row in modes]
    yield Claim(
        "95 % intervals of its windows hold the frequency of the whole record",
        percents(row["frequency_hz_coverage_95"] for row in modes),
        f"{percents([low, high])} (95 %)",
        f"95 % asked; half the standard deviations {percents(half)}",
        all(row["frequency_hz_coverage_95_interval"][1] >= 0.95 for row in modes)
        and answer["passed"]["building: intervals of each third hold the whole"],
    )
    light = answer["light_frame"]
    off = [abs(row["f_hz"] / row["known_f_hz"] - 1) for row in light]
    yield Claim(
        f"a light frame: {len(light)} frequencies off the known ones, at most",
        f"{100 * max(off):.3f} %",
        "",
        "0.1 % asked",
        max(off) < 1e-3,
    )
    frame, weak = answer["shear_frame"], answer["weak_mode"]
    for what in ("documented", "stepped"):
        held = sum(row[f"holds_{what}_f"] for row in frame)
        more = "" if what == "documented" else ", as its integration in steps has them"
        yield Claim(
            f"a shear frame: frequencies inside their 95 % intervals, {what}{more}",
            f"{held} of {len(frame)}",
            met=held == len(frame),
        )
    yield Claim(
        "a mode beside the mains lies where it is known to be, which are no mode",
        f"{number(weak['f_hz'])} Hz",
        f"± {number(weak['f_std_hz'])} Hz",
        "40.5 Hz known",
        weak["holds_f"] and not weak["modes_at_mains"],
    )
