"""Is the state of measured machines estimated right, where it is known?

Method
    Three sets of measurements go through ``lmshealth run``, each with a description whose map is
    mechanics and not a fit to its data. Beam: the roller under a steel cantilever is moved towards
    the clamp, by a known distance; the map is the beam theory of its dimensions. Frame: a model
    of three storeys on stiff and on flexible columns; frequencies go with the root of stiffness
    over mass, which fell to what the authors' periods state. Building: a timber building that
    nobody changed. A machine has the logs of one state first, then those of another, or
    of the same one (``same``: the control, of which no loss may be stated). ``beyond`` are changes
    that the description does not hold: five steps of the roller at once, a map that ends before the
    new place, columns whose modes leave every search. No value may be certified of these.
Run time
    Twenty minutes of a busy processor.
Data
    Folders ``dropbear_ds8``, ``shake_3storey`` and ``palisaden_building`` of LMSHEALTH_DATA;
    ``python -m studies.health.measured.fetch`` names and fetches them, with the further recordings
    of the first two (11 repeats, 5 events), all of which the full form needs.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pandas as pd

from studies.harness.claims import Claim, counted, number
from studies.harness.command_line import call
from studies.harness.study import Row, Study, real_data
from studies.health.measured.sets import BEGIN, Machine, beam, building, check_recordings, frame
from studies.modes.real.sets import SHAKE

EPOCHS, KINDS = 2, ("change", "same", "beyond")
CHANGED, HELD = "every known change is held by its interval", "no control loses the state it has"
NO_STEP, REFUSED = "no control is called changed", "no value is certified beyond the description"
REFERENCE = "frequencies of the frame are those of another method"
SEEN = "no change is called healthy"
NOT_MET = {
    CHANGED: "beside the clamp the theory of a rigid support overstates the effect of a step by "
    "16 %, the map's stated error is 5 %",
    NO_STEP: "in the frame on flexible columns the first mode alone is 3.8 ± 0.6 % lower in a "
    "strong earthquake, which no state of the stiffness does; why only that one is not known",
}


def main() -> None:
    """Run the study; ``--quick`` runs two machines of the beam and records nothing."""
    study, data = Study(__file__, __doc__), real_data()
    if not study.quick:
        check_recordings(data)
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        machines = beam(data, scratch, quick=study.quick)
        if not study.quick:
            machines += [*frame(data, scratch), *building(data, scratch)]
        rows = [one_machine(one, scratch, quick=study.quick) for one in machines]
    study.conclude({"machines": rows, "passed": judge(rows)}, not_met=NOT_MET)


def one_machine(machine: Machine, scratch: Path, *, quick: bool) -> Row:
    """Run a machine, and return what is estimated beside what is known."""
    out = scratch / f"{machine.name}-result"
    days = len(list(machine.logs.iterdir()))
    today = (BEGIN + timedelta(days=days)).date()
    how = ("--out", out, "--epochs", EPOCHS, "--workers", 1, "--today", today)
    call("lmshealth", *machine.words, *how, quick=quick, some_refused=True)
    status = json.loads(next(out.glob("*.status.json")).read_text(encoding="utf-8"))
    health, modes = (pd.read_csv(out / f"{name}.csv") for name in ("health", "modes"))
    told = ("set", "name", "kind", "parameter", "unit", "before", "after")
    row: Row = {key: getattr(machine, key) for key in told} | {
        "logs": len(list(machine.logs.glob("*.csv" if machine.set != "building" else "*.h5")))
        - (machine.set != "building"),
        # Of a machine of which no log can be used for days nothing is known any more.
        "verdict": "unknown" if status["unknown_since"] else status["verdict"],
        "verdict_at_last_log": status["verdict_at_last_log"],
        "why": status["why"],
        # Only of these a value is stated on the page.
        "certified": not status["unknown_since"]
        and any(one["parameter"] == machine.parameter for one in status["health"]),
        "warnings": sorted(status["warnings"]),
        "estimates": int(modes["log"].nunique()),
        "frequency_hz": modes.groupby("mode")["frequency_hz"].median().to_dict(),
    }
    if len(health):
        last = health[health["parameter"] == machine.parameter].iloc[-1]
        row |= {key: float(last[key]) for key in ("q05", "median", "q95", "fit")}
        # Of a machine that keeps its state all draws may be the baseline, but for rounding.
        low, high = row["q05"] * (1 - 1e-9), row["q95"] * (1 + 1e-9)
        row["inside"] = low <= machine.after <= high
    return row


def judge(rows: list[Row]) -> dict[str, bool]:
    """Return what holds of changes, of controls, and beyond the descriptions."""
    change, same, beyond = ([r for r in rows if r["kind"] == k] for k in KINDS)
    return {
        CHANGED: all(row["certified"] and row["inside"] for row in change),
        SEEN: all(row["verdict"] != "healthy" for row in [*change, *beyond]),
        HELD: all(row["certified"] and row["inside"] for row in same),
        NO_STEP: all(row["verdict"] == "healthy" for row in same),
        REFUSED: not any(row["certified"] for row in beyond),
        REFERENCE: all(off <= tolerance for off, tolerance in off_reference(same)),
    }


def off_reference(rows: list[Row]) -> list[tuple[float, float]]:
    """Return how far modes of the frame are off Welch's spectra, and their tolerance, in Hz."""
    return [
        (max(low - f, f - high, 0.0), tolerance)
        for row in rows
        if row["set"] == "frame"
        for (low, high, tolerance), f in zip(
            SHAKE[row["name"].split("-")[1].title()], row["frequency_hz"].values(), strict=False
        )
    ]


def claims(answer: Row) -> Iterator[Claim]:
    """Claim, machine by machine, what is estimated beside what is known."""
    rows, passed = answer["machines"], answer["passed"]
    for row in rows:
        unit = f" {row['unit']}" if row["unit"] else ""
        before, after = number(row["before"]), number(row["after"])
        state = f"{before}{unit}, then {after}{unit}" if before != after else f"{before}{unit}"
        value = f"no value: {row['verdict']}"
        if row["certified"]:
            value = f"{row['median']:.4g}{unit}, {row['verdict']}"
        interval = f"{row['q05']:.4g} to {row['q95']:.4g} (90 %)" if row["certified"] else ""
        if row["certified"] and row["q95"] - row["q05"] < 1e-6 * row["before"]:
            interval = "the state before: no change is detected"
        right = {
            "change": row["certified"] and row.get("inside") and row["verdict"] != "healthy",
            "same": row["certified"] and row.get("inside") and row["verdict"] == "healthy",
            "beyond": not row["certified"] and row["verdict"] != "healthy",
        }[row["kind"]]
        what = f"{row['set']}: {row['parameter'].removesuffix('_mm')} known, {state}"
        beside = f"{row['estimates']} of {row['logs']} logs"
        if row["verdict"] != row["verdict_at_last_log"]:
            beside += f"; at the last that could be used it was {row['verdict_at_last_log']}"
        if row["kind"] == "beyond":
            beside += "; the description does not hold it"
        yield Claim(what, value, interval, beside, bool(right))
    change, same, beyond = ([r for r in rows if r["kind"] == k] for k in KINDS)
    yield Claim(
        "frame: median frequencies of its modes off those of another method, at most",
        f"{number(max(off for off, _ in off_reference(same)))} Hz",
        beside="0.15 to 0.3 Hz required",
        met=passed[REFERENCE],
    )
    inside = sum(bool(row["certified"] and row["inside"]) for row in change)
    before = sum(row["q05"] <= row["before"] <= row["q95"] for row in change if "q05" in row)
    controls = sum(row["verdict"] == "healthy" for row in same)
    yield counted(
        "known changes inside their 90 % intervals",
        inside,
        len(change),
        f"the state before inside: {before}",
        met=passed[CHANGED] and not before,
    )
    yield counted("unchanged machines judged healthy", controls, len(same), met=passed[NO_STEP])
    yield counted(
        "changes beyond the description of which no value is certified",
        sum(not row["certified"] for row in beyond),
        len(beyond),
        met=passed[REFUSED],
    )


if __name__ == "__main__":
    main()
