"""Logs of the roller's rests, and the modal map that two repeats give."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.polynomial import Polynomial
from scipy import ndimage

from lmshealth.signal.segments import Segment
from studies.modes.decays.beam import BEAM, find_dwells, read_beam

MODE, PARAMETER = "beam", "roller_v"
DEGREES = (1, 2, 3, 4)
BEGIN = datetime(2022, 7, 19, 22, 55, tzinfo=UTC)
# The roller creeps at the end of a move. It rests once its sensor, smoothed, stays within two of
# the recorder's steps of the level of the dwell.
_STEP_V, _STEPS, _SMOOTH = 0.00122, 2, 0.02
# So much before the rest, in s, is kept and marked as moving.
_BEFORE = 0.04
# The map reaches beyond the calibrated positions by this share, and has so many points.
_BEYOND, _POINTS = 0.02, 13
_MODE = f"""\
name = "beam"
source = "movable roller, DROPBEAR data set 8"

[match]
stage = "beam"

[[mode]]
name = "{MODE}"
frequency_hz = {BEAM.frequency_hz}
damping_ratio = {BEAM.damping_ratio}
search = {BEAM.search}
"""
_HEALTH = f"""
# The reading of the roller's position sensor; its scale to millimetres is not published. The map is
# made from repeats 0 and 1, the baseline is the mean position of their first dwells that were read.
[[parameter]]
name = "{PARAMETER}"
unit = "V"
baseline = {{baseline:.4f}}
prior = {{{{ kind = "uniform", low = {{low:.4f}}, high = {{high:.4f}} }}}}

[map]
file = "roller.map.csv"
model_std = {{model_std:.6f}}
"""


def write_dwells(folder: Path, repeat: int, out: Path) -> pd.DataFrame:
    """Write one log of the contract per dwell of a repeat of the data set.

    Returned is one row per dwell: log, recorded_at, repeat, dwell, roller_v (mean of the rest),
    roller_v_std (standard deviation of the smoothed sensor over it), seconds.
    """
    trial = read_beam(folder, repeat)
    values = {channel.name: channel.values[:] for channel in trial.channels}
    rate, position = trial.sample_rate, values["delta_e_roller"]
    smooth = ndimage.median_filter(position, 2 * round(_SMOOTH * rate / 2) + 1, mode="nearest")
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for k, (dwell, level) in enumerate(find_dwells(trial)):
        rest = _rest(smooth, dwell, level)
        # The recording begins at rest; what was before is unknown and marked like any move.
        start = max(rest.start, round(_BEFORE * rate))
        part = slice(start - round(_BEFORE * rate), rest.stop)
        moving = np.arange(part.start, part.stop) < start
        table = pd.DataFrame(
            {
                "acc_low_m_s2": values["acc_low"][part],
                "acc_high_m_s2": values["acc_high"][part],
                "reference_velocity_mm_s": np.where(moving, 1.0, 0.0),
            }
        )
        name = out / f"repeat{repeat}-dwell{k:02d}.csv"
        moment = (BEGIN + timedelta(minutes=repeat, seconds=start / rate)).isoformat()
        with name.open("w", encoding="utf-8") as file:
            file.write(f"# stage: beam\n# recorded_at: {moment}\n# sample_rate_hz: {rate:.9g}\n")
            table.to_csv(file, index=False)
        rows.append(
            {
                "log": str(name),
                "recorded_at": moment,
                "repeat": repeat,
                "dwell": k,
                "roller_v": float(np.mean(position[start : rest.stop])),
                "roller_v_std": float(np.std(smooth[start : rest.stop])),
                "seconds": (rest.stop - start) / rate,
            }
        )
    return pd.DataFrame(rows)


def _rest(smooth: np.ndarray, dwell: Segment, level: float) -> Segment:
    """Find the stretch about the middle of a dwell in which the roller stays at its level."""
    off = np.abs(smooth[dwell.start : dwell.stop] - level) > _STEPS * _STEP_V
    middle = off.size // 2
    before, after = np.flatnonzero(off[:middle]), np.flatnonzero(off[middle:])
    start = int(before[-1]) + 1 if before.size else 0
    stop = middle + int(after[0]) if after.size else off.size
    return Segment(dwell.start + start, dwell.start + stop, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Ln frequency as a polynomial of ln position."""

    curve: Polynomial  # ln f (f in Hz) over ln of the roller's volts
    low: float  # Where the map ends, in V
    high: float
    baseline: float  # Position of the first dwell that is read, in V
    model_std: float  # Relative error of a drift that one repeat's curve predicts for the other
    # By degree, rms error of ln f at inner positions that the curve has not seen
    left_out: dict[int, float]
    scatter: float  # Rms of ln f about the curve


def calibrate(read: pd.DataFrame, *, degree: int | None = None) -> Calibration:
    """Fit the curve to dwells (repeat, dwell, roller_v, frequency_hz).

    By default its degree is the one with the least error at positions left out.
    """
    left_out = {d: _left_out(read, d) for d in DEGREES}
    chosen = min(left_out, key=left_out.__getitem__) if degree is None else degree
    curve = _fit(read, chosen)
    first = read[read["dwell"] == read["dwell"].min()]
    return Calibration(
        curve=curve,
        low=(1 - _BEYOND) * float(read["roller_v"].min()),
        high=(1 + _BEYOND) * float(read["roller_v"].max()),
        baseline=float(first["roller_v"].mean()),
        model_std=_across(read, chosen),
        left_out=left_out,
        scatter=_rms(np.log(read["frequency_hz"]) - curve(np.log(read["roller_v"]))),
    )


def write_stage(found: Calibration | None, folder: Path, *, model_std: float | None = None) -> Path:
    """Write a description, with the map of a calibration if there is one; return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path, text = folder / "roller.toml", _MODE
    if found is not None:
        volts = np.geomspace(found.low, found.high, _POINTS)
        hertz = np.exp(found.curve(np.log(volts)))
        table = pd.DataFrame({PARAMETER: volts, "mode": MODE, "frequency_hz": hertz})
        table.to_csv(folder / "roller.map.csv", index=False, float_format="%.9g")
        std = found.model_std if model_std is None else model_std
        text += _HEALTH.format(
            baseline=found.baseline, low=found.low, high=found.high, model_std=std
        )
    path.write_text(text, encoding="utf-8")
    return path


def places(read: pd.DataFrame) -> pd.Series[int]:
    """Count the moves between each dwell and the turning point: up and down have them in common."""
    turn = int(read["dwell"].iloc[read["roller_v"].argmax()])
    return (read["dwell"] - turn).abs()


def _fit(read: pd.DataFrame, degree: int) -> Polynomial:
    return Polynomial.fit(np.log(read["roller_v"]), np.log(read["frequency_hz"]), degree)


def _left_out(read: pd.DataFrame, degree: int) -> float:
    """Rms error of ln f at positions that are left out one by one, all but the outermost."""
    place, errors = places(read), []
    for own in sorted(set(place))[1:-1]:
        seen, unseen = read[place != own], read[place == own]
        errors += list(
            np.log(unseen["frequency_hz"]) - _fit(seen, degree)(np.log(unseen["roller_v"]))
        )
    return _rms(errors)


def _across(read: pd.DataFrame, degree: int) -> float:
    """Rms relative error of the drifts since the first dwell, each repeat by the other's curve.

    The estimates' own errors are in it, which makes it cautious. Back at the first position there
    is no drift that an error could be a share of.
    """
    errors: list[float] = []
    for repeat in sorted(set(read["repeat"])):
        own, others = read[read["repeat"] == repeat], read[read["repeat"] != repeat]
        curve, first, place = _fit(others, degree), own["dwell"].idxmin(), places(own)
        expected = curve(np.log(own["roller_v"])) - curve(np.log(own.loc[first, "roller_v"]))
        drift = np.log(own["frequency_hz"] / own.loc[first, "frequency_hz"])
        errors += list((drift / expected - 1)[place != place[first]])
    return _rms(errors)


def _rms(values: object) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(values, dtype=float)))))
