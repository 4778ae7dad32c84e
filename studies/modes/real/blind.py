"""Which modes of records that others made are found without a description, and what else is?

Method
    The sets of `run` are searched in a band that a user would choose, each record as one log: a
    timber building (first half hour), a three-storey frame on a shaking table (flexible and stiff,
    floor by floor), a weak mode beside the mains, and two that are simulated by others: a shear
    frame (as its integration makes it) and a light frame, once also with all six channels, which
    two recorders took. A mode is found within its published tolerance. What else is reported is
    false in simulated sets; a real structure may have more modes than are published. Beside:
    presets of pyOMA2's clustering, the automatic selections of pyoma-toolbox, and koma, with the
    settings of `without_description`.
Run time
    About two minutes on one processor. Needs the extra ``peers``.
Data
    As `run`.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lmshealth import identify, read_log
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.log import Log
from studies.harness.claims import Claim
from studies.harness.cost import one_thread
from studies.harness.data.samples import MAPS
from studies.harness.study import Row, Study, real_data
from studies.modes.real.sets import (
    FLOORS,
    KOMA_RATE,
    MPSTD,
    MPSTD_BAND,
    MPSTD_MODE,
    SHAKE,
    WEIMAR,
    WEIMAR_CHANNELS,
    WEIMAR_RATE,
    to_log,
)
from studies.modes.without_description.peers import koma, pyoma2, toolbox
from studies.modes.without_description.worlds import World

HALF_HOUR, BUILDING_RATE, BUILDING = 180_000, 100.0, (1.882, 2.422, 2.687)

# Name, log, band, known frequencies and tolerances in Hz, and whether nothing else is there.
Set = tuple[str, Log, tuple[float, float], list[float], list[float], bool]


def main() -> None:
    """Run the study; ``--quick`` leaves the other programs out and records nothing."""
    study, data = Study(__file__, __doc__), real_data()
    os.environ.update(one_thread() | {"TQDM_DISABLE": "1"})
    if not study.quick and not all(map(find_spec, ("pyoma2", "pyOMA", "koma"))):
        raise SystemExit("pyOMA-2, pyoma-toolbox or koma not installed: pip install '.[peers]'")
    rows = [examine(one, peers=not study.quick) for one in sets(data)]
    study.conclude({"sets": rows, "passed": verdicts(rows)})


def sets(data: Path) -> Iterator[Set]:
    """Read the sets."""
    building = np.load(data / "palisaden_building/Palisaden_dataset.npy", mmap_mode="r")
    log = to_log(building[:HALF_HOUR], BUILDING_RATE)
    yield "building", log, (1.2, 3.5), [*BUILDING], [0.005 * f for f in BUILDING], False
    for frame, known in SHAKE.items():
        f, reach = [(a + b) / 2 for a, b, _ in known], [(b - a) / 2 + t for a, b, t in known]
        for floor in FLOORS:
            name = f"shake_3storey/open/{frame}_BonusEvent_{floor}.csv"
            log = read_log(
                data / name, columns=msgspec.convert(tomllib.loads(MAPS[name]), ColumnMap)
            )
            yield f"frame, {frame.lower()}, {floor} floor", log, (2.0, 30.0), f, reach, False
    f_weak = MPSTD_MODE[0]
    yield "weak mode", read_log(data / MPSTD), MPSTD_BAND, [f_weak], [0.01 * f_weak], False
    folder = data / "SIMULATED_koma_shearframe"
    omega = np.load(folder / "omega_n.npy")
    f = np.arctan(omega / (2 * KOMA_RATE)) * KOMA_RATE / np.pi
    log = to_log(np.load(folder / "data_shearframe.npy"), KOMA_RATE)
    yield "shear frame", log, (0.1, 1.4), f.tolist(), (0.01 * f).tolist(), True
    record = np.load(data / "SIMULATED_weimar_frame/measurement_2.npy")
    reach = [0.0015 * f for f in WEIMAR]
    log = to_log(record[:, WEIMAR_CHANNELS], WEIMAR_RATE)
    yield "light frame", log, (3.0, 13.2), [*WEIMAR], reach, True
    log = to_log(record, WEIMAR_RATE)
    yield "light frame, all channels", log, (3.0, 13.2), [*WEIMAR], reach, True


def examine(one: Set, *, peers: bool) -> Row:
    """Search one set, and compare with what is known."""
    name, log, band, known, reach, complete = one
    modes = identify(log, band=band)
    row: Row = {
        "set": name,
        "known": len(known),
        "complete": complete,
        **count(modes.frequency, known, reach),
        "f_hz": modes.frequency.tolist(),
        "f_std_hz": modes.frequency_std.tolist(),
        "zeta": modes.damping_ratio.tolist(),
        "left_out": [r.channel for r in modes.refused if r.reason == "unlike-others"],
        "wandering_hz": [line.frequency for line in modes.lines if line.kind == "wandering"],
    }
    if peers:
        accelerations = [c for c in log.channels if c.kind == "acceleration"]
        samples = np.stack([c.values[:] for c in accelerations], axis=1)
        nothing = np.zeros(len(known))
        world = World(name, log.sample_rate, samples, 0, band, np.array(known), nothing)
        found = pyoma2(world) | koma(world)
        found |= toolbox(world, method="SSI") | toolbox(world, method="VarPLSCF")
        row["others"] = {tool: count(one.frequency, known, reach) for tool, one in found.items()}
    return row


def count(f: np.ndarray, known: list[float], reach: list[float]) -> dict[str, int]:
    """Count the known modes that are found, and all other estimates."""
    found = sum(bool((np.abs(f - k) <= r).any()) for k, r in zip(known, reach, strict=True))
    return {"found": found, "else": int(f.size) - found}


def verdicts(rows: list[Row]) -> dict[str, bool]:
    """Return the checks."""
    alone = {row["set"]: row for row in rows}
    frames = [row for row in rows if row["set"].startswith("frame")]
    return {
        "all modes of the building and no other": alone["building"]["found"] == 3
        and not alone["building"]["else"],
        "simulated sets: all modes": all(r["found"] == r["known"] for r in rows if r["complete"]),
        "simulated sets: no false one": not any(r["else"] for r in rows if r["complete"]),
        "the weak mode, and the mains are none": alone["weak mode"]["found"] == 1
        and all(abs(f - 50) > 1 for f in alone["weak mode"]["f_hz"]),
        "every mode of the frame on a floor at least": all(
            any(row["found"] == row["known"] for row in frames if kind in row["set"])
            for kind in ("flexible", "stiff")
        ),
        "channels that the modes do not explain are named": len(
            alone["light frame, all channels"]["left_out"]
        )
        > 0,
    }


def claims(record: Mapping[str, Any]) -> Iterator[Claim]:
    """Claim what is found in each set, beside other programs."""
    for row in record["sets"]:
        others = row["others"]
        best = max(others, key=lambda k: others[k]["found"] - others[k]["else"] / 10)
        what = "false" if row["complete"] else "others"
        made = ", simulated by others" if row["complete"] else ", measured"
        yield Claim(
            f"known modes found without a description: {row['set']}{made}",
            f"{row['found']} of {row['known']}, {row['else']} {what}",
            beside=f"best preset ({best}): {others[best]['found']}, {others[best]['else']} {what}",
            met=row["found"] == row["known"] and not (row["complete"] and row["else"]),
        )


if __name__ == "__main__":
    main()
