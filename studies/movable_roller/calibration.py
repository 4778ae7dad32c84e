"""What two repeats tell of the beam: a modal map of the roller's position and how good it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.polynomial import Polynomial

from studies.decays.beam import BEAM

MODE, PARAMETER = "beam", "roller_v"
DEGREES = (1, 2, 3, 4)
# The map reaches beyond the calibrated positions by this share, and has so many points.
_BEYOND, _POINTS = 0.02, 13
_LOOK = """\
name = "beam"
source = "movable roller, DROPBEAR data set 8"

[match]
stage = "beam"

[[mode]]
name = "{mode}"
frequency_hz = {hz}
damping_ratio = {zeta}
search = {search}
"""
_HEALTH = """
# The reading of the roller's position sensor; its scale to millimetres is not told. The map is
# made from repeats 0 and 1, the baseline is the mean position of their first dwells that were read.
[[parameter]]
name = "{parameter}"
unit = "V"
baseline = {baseline:.4f}
prior = {{ kind = "uniform", low = {low:.4f}, high = {high:.4f} }}

[map]
file = "roller.map.csv"
model_std = {model_std:.6f}
"""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """ln frequency as a polynomial of ln position."""

    curve: Polynomial  # ln f (f in Hz) over ln of the roller's volts
    low: float  # Where the map ends, in V
    high: float
    baseline: float  # Position of the first dwell that is read, in V
    model_std: float  # Relative error of a drift that one repeat's curve predicts for the other
    # By degree, rms error of ln f at inner positions that the curve has not seen
    left_out: dict[int, float]
    scatter: float  # Rms of ln f about the curve


def calibrate(read: pd.DataFrame, *, degree: int | None = None) -> Calibration:
    """Fit the curve, and judge it by what it has not seen.

    Parameters
    ----------
    read : DataFrame
        One row per dwell that was read: repeat, dwell, roller_v, frequency_hz.
    degree : int, optional
        Of the polynomial; by default the one with the least error at positions left out.
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


def write_look(folder: Path) -> Path:
    """Write a description that says what to look for only, and return its path."""
    path = folder / "look.toml"
    path.write_text(_look(), encoding="utf-8")
    return path


def write_stage(calibration: Calibration, folder: Path, *, model_std: float | None = None) -> Path:
    """Write a stage description and its map beside it, and return the description's path."""
    folder.mkdir(parents=True, exist_ok=True)
    volts = np.geomspace(calibration.low, calibration.high, _POINTS)
    rows = {
        PARAMETER: volts,
        "mode": MODE,
        "frequency_hz": np.exp(calibration.curve(np.log(volts))),
    }
    pd.DataFrame(rows).to_csv(folder / "roller.map.csv", index=False, float_format="%.9g")
    path = folder / "roller.toml"
    health = _HEALTH.format(
        parameter=PARAMETER,
        baseline=calibration.baseline,
        low=calibration.low,
        high=calibration.high,
        model_std=calibration.model_std if model_std is None else model_std,
    )
    path.write_text(_look() + health, encoding="utf-8")
    return path


def _look() -> str:
    return _LOOK.format(
        mode=MODE, hz=BEAM.frequency_hz, zeta=BEAM.damping_ratio, search=BEAM.search
    )


def places(read: pd.DataFrame) -> pd.Series[int]:
    """Count the moves between each dwell and the turning point: up and down have them in common."""
    turn = int(read.loc[read["roller_v"].idxmax(), "dwell"])
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
