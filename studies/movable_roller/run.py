"""Is the position of a roller under a real beam where the posterior says it is?

Question
    A roller makes a cantilever stiffer in five known steps and softer again: ln f rises by 40 %
    and falls back. With a modal map made from two repeats of that, does the command line find
    where the roller is in a third one, with intervals that hold, on the way up and on the way back?
Method
    The movable-roller testbed DROPBEAR (data set 8). Every rest of the roller is written as one log
    of the contract, from where it has stopped creeping; a velocity marks what is before. The dwells
    of repeats 0 and 1 go through ``lmshealth modes``; ln f over ln position is a polynomial, whose
    degree is the one with the least error at positions left out. It is the modal map. Its
    ``model_std`` is the relative error with which the curve of either repeat predicts the drifts of
    the other. Of repeat 2 nothing enters map or description. It goes through ``modes``, ``track``
    and ``infer``; its first dwell that can be read is the baseline, where the position is the
    parameter's baseline by definition, so that nine of ten dwells are inferred. Controls: the map
    taken for exact and drifts for four times as well known; a straight line for a map.
Answer
    Yes. In repeat 2 all ten excited dwells are read and the first is refused. Nine of nine
    measured positions lie inside their 90 % intervals of ±7 to ±25 mV, on a travel of 2.14 V.
    They are off by 8 mV at most, half a standard deviation in rms: the intervals are cautious. Most
    of that is hysteresis: at inner positions the same frequency reads 3 to 6 mV higher on the way
    back, which a map of one curve takes for its own error of 0.8 %. Up and down agree within half
    of what their intervals allow. A map taken for exact, with drifts said to be four times as well
    known, holds five of nine; a straight line holds one.
Run time
    Two minutes of a busy processor.
Data
    Folder ``dropbear_ds8`` of LMSHEALTH_DATA, needed.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from studies.decays.beam import REPEATS
from studies.harness.claims import Claim, counted, number
from studies.harness.command_line import call
from studies.harness.study import Row, Study
from studies.movable_roller.calibration import (
    PARAMETER,
    Calibration,
    calibrate,
    places,
    write_look,
    write_stage,
)
from studies.movable_roller.dwells import write_dwells

STEP = "infer"

NEW = 2  # the repeat that map and description do not know
LEAST_INSIDE = 8
ALL_EPOCHS, QUICK_EPOCHS = 40, 3  # more than there are, and few
QUICK_DWELLS = (0, 1, 3, 5, 7, 9)  # the first is not excited
_SIGMAS_90 = 1.645  # half a 90 % interval of a normal distribution
_TOO_SURE = 0.25  # factor on standard deviations of the control


def main() -> None:
    """Run the study; ``--quick`` infers three dwells, with one control, and records nothing.

    What was read of the repeats that make the map it takes from the record.
    """
    study = Study(__file__, __doc__)
    with tempfile.TemporaryDirectory() as scratch:
        answer = answered(Path(os.environ["LMSHEALTH_DATA"]), Path(scratch), quick=study.quick)
    study.conclude(answer)


def answered(folder: Path, scratch: Path, *, quick: bool) -> Row:
    """Calibrate with two repeats and infer the third.

    Parameters
    ----------
    folder : Path
        With the data sets.
    scratch : Path
        For logs and tables.
    quick : bool
        Whether few dwells are inferred.
    """
    epochs = QUICK_EPOCHS if quick else ALL_EPOCHS
    known = recorded() if quick else read_known(folder, scratch)
    used = known.dropna(subset="frequency_hz")
    found = calibrate(used)
    stage = write_stage(found, scratch / "map")
    dwells = write_dwells(folder, NEW, scratch / f"repeat{NEW}")
    if quick:
        dwells = dwells[dwells["dwell"].isin(QUICK_DWELLS)]
    new = read_modes(dwells, stage, quick=quick)
    track = follow(scratch / f"repeat{NEW}", stage, quick=quick)
    rows = compare(new, track, infer(track, stage, epochs, quick=quick))
    sure = {} if quick else {"exact map, quarter of the std": too_sure(new, track, found)}
    line = straight_line(new, track, used, found.model_std, epochs, quick=quick)
    answer = {
        "calibration": describe(found, used),
        "dwells": rows,
        "refused": [
            {"repeat": int(row.repeat), "dwell": int(row.dwell), "reason": row.refused}
            for row in pd.concat([known, new]).itertuples()
            if row.refused
        ],
        "doubted_by_tracker": len(pd.read_csv(track.with_name("refused.csv"))),
        "events": pd.read_csv(track.with_name("events.csv"))[["kind", "size", "std"]].to_dict(
            "records"
        ),
        "inside": count(rows),
        "up_and_down": up_and_down(rows),
        "controls": sure | {"straight line for a map": line},
    }
    return answer | {"passed": judge(answer)}


def read_known(folder: Path, scratch: Path) -> pd.DataFrame:
    """Read the dwells of all repeats but the new one, without a map."""
    look = write_look(scratch)
    dwells = [write_dwells(folder, k, scratch / f"repeat{k}") for k in range(NEW)]
    return pd.concat([read_modes(own, look, quick=False) for own in dwells], ignore_index=True)


def recorded() -> pd.DataFrame:
    """Take from the record what `read_known` gave; for the quick form, which has no time for it."""
    record = json.loads(Path(__file__).with_name("result.json").read_text(encoding="utf-8"))
    refused = [row for row in record["refused"] if row["repeat"] < NEW]
    rows = [{**row, "refused": ""} for row in record["calibration"]["dwells"]]
    rows += [{"repeat": r["repeat"], "dwell": r["dwell"], "refused": r["reason"]} for r in refused]
    return pd.DataFrame(rows).sort_values(["repeat", "dwell"], ignore_index=True)


def read_modes(dwells: pd.DataFrame, stage: Path, *, quick: bool) -> pd.DataFrame:
    """Identify the beam in dwells by the command line; NaN and a reason where it is refused.

    Parameters
    ----------
    dwells : DataFrame
        As `write_dwells` returns it; ``modes.csv`` is written with its logs.
    stage : Path
        Description that says what to look for.
    quick : bool
        As in `call`.
    """
    command = ("modes", *dwells["log"], "--stage", stage, "--part", "settling", "--format", "json")
    told = json.loads(call("lmshealth", *command, quick=quick, some_refused=True))
    modes = pd.DataFrame(told["modes"])
    modes.to_csv(Path(dwells["log"].iloc[0]).with_name("modes.csv"), index=False)
    reasons = {row["log"]: row["reason"] for row in told["refused"]}
    read = dwells.merge(modes[["log", "frequency_hz", "frequency_std_hz"]], on="log", how="left")
    return read.assign(refused=[reasons.get(log, "") for log in read["log"]])


def follow(folder: Path, stage: Path, *, quick: bool) -> Path:
    """Track ``modes.csv`` of a folder by the command line, and return the track's path."""
    out = {name: folder / f"{name}.csv" for name in ("track", "track_cov", "events", "refused")}
    call(
        "lmshealth",
        "track",
        folder / "modes.csv",
        *("--stage", stage, "--out", out["track"], "--track-cov", out["track_cov"]),
        *("--events", out["events"], "--refused", out["refused"]),
        quick=quick,
        some_refused=True,
    )
    return out["track"]


def infer(track: Path, stage: Path, epochs: int, *, quick: bool) -> pd.DataFrame:
    """Infer the roller's position by the command line, one row per epoch after the baseline."""
    out = track.with_name("health.csv")
    how = ("--stage", stage, "--out", out, "--epochs", epochs)
    call("lmshealth", "infer", track, *how, quick=quick, some_refused=True)
    return pd.read_csv(out)


def compare(read: pd.DataFrame, track: Path, health: pd.DataFrame) -> list[Row]:
    """Line up what was measured in each dwell with what was inferred.

    Parameters
    ----------
    read : DataFrame
        As `read_modes` returns it.
    track : Path
        Table of the drifts.
    health : DataFrame
        As `infer` returns it.
    """
    moment = {"recorded_at": lambda t: pd.to_datetime(t["recorded_at"])}
    drift = pd.read_csv(track).assign(**moment)[["recorded_at", "drift", "drift_std", "widening"]]
    own = health[health["parameter"] == PARAMETER].assign(**moment)
    columns = ["recorded_at", "median", "q05", "q95", "ess", "r_hat", "converged"]
    both = read.assign(move=places(read)).dropna(subset="frequency_hz").assign(**moment)
    both = both.merge(drift, on="recorded_at", how="left")
    both = both.merge(own[columns], on="recorded_at", how="left")
    both["inside"] = (both["q05"] <= both["roller_v"]) & (both["roller_v"] <= both["q95"])
    both = both.drop(columns=["log", "recorded_at", "refused"])
    return [
        {name: None if pd.isna(value) else value for name, value in row.items()}
        for row in both.astype(object).to_dict("records")
    ]


def count(rows: list[Row]) -> Row:
    """Count the dwells whose measured position lies inside the interval, and size their errors."""
    inferred = [row for row in rows if row["median"] is not None]
    errors = [
        (row["median"] - row["roller_v"]) / (row["q95"] - row["q05"]) * 2 * _SIGMAS_90
        for row in inferred
    ]
    return {
        "inside": sum(row["inside"] for row in inferred),
        "inferred": len(inferred),
        "rms_error_in_std": float(np.sqrt(np.mean(np.square(errors)))),
    }


def up_and_down(rows: list[Row]) -> list[Row]:
    """Compare positions inferred on the way up with those inferred on the way back.

    The interval of a difference is that of two independent ones; where the baseline is one of the
    two it has none of its own.
    """
    found = []
    for move in sorted({row["move"] for row in rows} - {0}, reverse=True):
        pair = [row for row in rows if row["move"] == move]
        if len(pair) < 2:
            continue
        halves = [((row["q95"] or 0.0) - (row["q05"] or 0.0)) / 2 for row in pair]
        up, down = (row["median"] or row["roller_v"] for row in pair)
        found.append(
            {
                "up": pair[0]["dwell"],
                "down": pair[1]["dwell"],
                "difference_v": down - up,
                "measured_difference_v": pair[1]["roller_v"] - pair[0]["roller_v"],
                "half_interval_v": float(np.hypot(*halves)),
            }
        )
    return found


def too_sure(read: pd.DataFrame, track: Path, found: Calibration) -> Row:
    """Infer with the map taken for exact and the drifts for much better known than they are."""
    stage = write_stage(found, track.parent / "exact", model_std=0.0)
    sure = stage.with_name("track.csv")
    table = pd.read_csv(track)
    table["drift_std"] *= _TOO_SURE
    table.to_csv(sure, index=False)
    return count(compare(read, sure, infer(sure, stage, ALL_EPOCHS, quick=False)))


def straight_line(
    read: pd.DataFrame,
    track: Path,
    known: pd.DataFrame,
    model_std: float,
    epochs: int,
    *,
    quick: bool,
) -> Row:
    """Infer with a map that is a straight line through the same dwells, assumed as much."""
    line = calibrate(known, degree=1)
    stage = write_stage(line, track.parent / "line", model_std=model_std)
    return count(compare(read, track, infer(track, stage, epochs, quick=quick)))


def describe(found: Calibration, known: pd.DataFrame) -> Row:
    """Return what the map is and how good it is."""
    columns = ["repeat", "dwell", "roller_v", "frequency_hz", "frequency_std_hz"]
    volts = np.linspace(found.low, found.high, 60)
    return {
        "dwells": known[columns].to_dict("records"),
        "degree": found.curve.degree(),
        "error_left_out": {str(degree): error for degree, error in found.left_out.items()},
        "scatter": found.scatter,
        "model_std": found.model_std,
        "baseline_v": found.baseline,
        "curve_v": volts.tolist(),
        "curve_hz": np.exp(found.curve(np.log(volts))).tolist(),
    }


def judge(answer: Row) -> dict[str, bool]:
    """Return whether the positions are found, and whether the controls lose them."""
    rows = answer["dwells"]
    inferred = [row for row in rows if row["median"] is not None]
    travel = max(row["roller_v"] for row in rows) - min(row["roller_v"] for row in rows)
    return {
        "the dwell that is not excited is refused in every repeat, and no other is": [
            (row["repeat"], row["dwell"]) for row in answer["refused"]
        ]
        == [(repeat, 0) for repeat in range(REPEATS)],
        "at least 8 of 10 positions lie inside their 90 % intervals": answer["inside"]["inside"]
        >= min(LEAST_INSIDE, len(inferred)),
        "up and down agree within their intervals": all(
            abs(pair["difference_v"] - pair["measured_difference_v"]) <= pair["half_interval_v"]
            for pair in answer["up_and_down"]
        ),
        "no interval is wider than 3 % of the travel": all(
            row["q95"] - row["q05"] <= 0.03 * travel for row in inferred
        ),
        "all chains converged": all(row["converged"] for row in inferred),
        "the tracker believes every dwell": answer["doubted_by_tracker"] == 0,
        "controls cover too little": all(
            control["inside"] < min(LEAST_INSIDE, control["inferred"])
            for control in answer["controls"].values()
        ),
    }


def claims(answer: Row) -> Iterator[Claim]:
    """Claim where a roller under a real beam stands."""
    inside, passed = answer["inside"], answer["passed"]
    controls = "; ".join(
        f"{name}: {row['inside']} of {row['inferred']}" for name, row in answer["controls"].items()
    )
    yield counted(
        "positions inside their 90 % intervals",
        inside["inside"],
        inside["inferred"],
        controls,
        met=all(passed.values()),
    )
    ends = [row["roller_v"] for row in answer["dwells"]]
    width = [row["q95"] - row["q05"] for row in answer["dwells"] if row["q95"] is not None]
    share = [100 * value / (max(ends) - min(ends)) for value in width]
    yield Claim(
        "width of the intervals, of the travel",
        f"{number(min(share))} to {number(max(share))} %",
        "",
        "3 % required",
        passed["no interval is wider than 3 % of the travel"],
    )
    apart = max(abs(row["difference_v"]) / row["half_interval_v"] for row in answer["up_and_down"])
    yield Claim(
        "up and down differ, over half their interval, at most",
        number(apart),
        met=passed["up and down agree within their intervals"],
    )


if __name__ == "__main__":
    main()
