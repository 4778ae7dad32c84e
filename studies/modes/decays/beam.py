"""The real beam: a cantilever whose stiffness a roller changes in known steps (DROPBEAR, set 8)."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
from scipy import ndimage

from lmshealth import identify_decays, read_log
from lmshealth.io.column_map import load_columns
from lmshealth.io.log import Log
from lmshealth.signal.segments import Segment
from lmshealth.stage.description import Description, ModeSpec, Stage
from studies.harness.data.samples import MAPS
from studies.harness.study import Row

REPEATS = 3
# Volts of the roller and Hz of the beam, and how far an estimate may be off.
TABLE = {1.227: 26.25, 1.648: 28.22, 2.085: 30.81, 2.505: 33.90, 2.935: 37.55, 3.367: 41.98}
TOLERANCE, UP_AND_DOWN = 0.15, 0.1
BEAM = ModeSpec("beam", 33.0, 0.002, search=0.3)
# The position is in volts; it takes the place of a displacement.
COLUMN_MAP = MAPS["dropbear_ds8/open/10steps_test0.txt.gz"].replace(
    "[units]", 'delta_e_roller = "2"\n[units]\ndelta_e_roller = 1.0'
)
# The roller rests where it moves by less than this share of its travel in so many seconds; the
# median over a part of that hides the noise of its sensor.
_STILL, _WHILE, _SMOOTH, _SHORTEST = 0.01, 0.05, 0.02, 0.3


def read_beam(folder: Path, repeat: int) -> Log:
    """Read one repeat of the ramp and its return."""
    with tempfile.TemporaryDirectory() as scratch:
        path, columns = Path(scratch) / "steps.csv.gz", Path(scratch) / "columns.toml"
        shutil.copy(folder / f"dropbear_ds8/open/10steps_test{repeat}.txt.gz", path)
        columns.write_text(COLUMN_MAP, encoding="utf-8")
        return read_log(path, columns=load_columns(columns))


def find_dwells(log: Log) -> list[tuple[Segment, float]]:
    """Find where the roller rests, and at which volts, in order of time."""
    position = next(c.values for c in log.channels if c.name == "delta_e_roller")[:]
    rate = log.sample_rate
    smooth = ndimage.median_filter(position, 2 * round(_SMOOTH * rate / 2) + 1, mode="nearest")
    size = round(_WHILE * rate)
    moved = ndimage.maximum_filter1d(smooth, size) - ndimage.minimum_filter1d(smooth, size)
    still = moved < _STILL * (smooth.max() - smooth.min())
    # Noise may lift single samples over the threshold.
    still = ndimage.binary_closing(still, np.ones(size, dtype=bool), border_value=1)
    labels, n = ndimage.label(still)
    found = []
    for where in ndimage.find_objects(labels, n):
        start, stop = where[0].start, where[0].stop
        if stop - start >= _SHORTEST * rate:
            place = float(np.median(position[start:stop]))
            found.append((Segment(start, stop, 0.0), place))
    return found


def one_beam(folder: Path, repeat: int, some: slice = slice(None)) -> list[Row]:
    """Identify the beam in every dwell of one repeat, or in some."""
    log = read_beam(folder, repeat)
    stage = Stage(Description(name="beam", mode=(BEAM,)), None, "0" * 64)
    rows = []
    for k, (dwell, volts) in list(enumerate(find_dwells(log)))[some]:
        found = identify_decays(log, stage, segments=[dwell], channels=("acc_low", "acc_high"))
        reference = TABLE[min(TABLE, key=lambda v: abs(v - volts))]
        seconds = round((dwell.stop - dwell.start) / log.sample_rate, 3)
        row: Row = {"repeat": repeat, "dwell": k, "roller_v": round(volts, 4), "seconds": seconds,
                    "reference_hz": reference, "f_hz": None, "refused": ""}  # fmt: skip
        if found.names:
            row |= {"f_hz": float(found.frequency[0]), "f_std_hz": float(found.frequency_std[0]),
                    "off_hz": float(found.frequency[0] - reference),
                    "zeta": float(found.damping_ratio[0]),
                    "zeta_std": float(found.damping_ratio_std[0])}  # fmt: skip
        else:
            row["refused"] = found.refused[-1].reason
        rows.append(row)
    return rows


def judge_beam(beam: list[Row]) -> dict[str, bool]:
    """Return whether every dwell is right or refused, and the first one refused."""
    seen = [row for row in beam if row["f_hz"] is not None]
    places: dict[tuple[int, float], list[float]] = {}
    for row in seen:
        places.setdefault((row["repeat"], row["reference_hz"]), []).append(row["f_hz"])
    excited = [row for row in beam if row["dwell"] > 0]
    return {
        "every dwell is within 0.15 Hz or refused": all(
            abs(row["off_hz"]) < TOLERANCE for row in seen
        ),
        "the unexcited first dwell is refused": all(
            row["f_hz"] is None for row in beam if row["dwell"] == 0
        ),
        "up and down agree within 0.1 Hz": all(
            max(f) - min(f) < UP_AND_DOWN for f in places.values()
        ),
        "most dwells are told": len(seen) > 0.8 * len(excited),
    }
