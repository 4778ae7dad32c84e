"""Cut trials of the roller into logs: one for every rest, with what comes just before it."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import ndimage

from lmshealth.signal.segments import Segment
from studies.decays.beam import find_dwells, read_beam

BEGIN = datetime(2022, 7, 19, 22, 55, tzinfo=UTC)
# The roller creeps at the end of a move. It rests once its sensor, smoothed, stays within two of
# the recorder's steps of the level of the dwell.
_STEP_V, _STEPS, _SMOOTH = 0.00122, 2, 0.02
# So much of what is before the rest, in s, is kept and marked as moving.
_BEFORE = 0.04


def write_dwells(folder: Path, repeat: int, out: Path) -> pd.DataFrame:
    """Write one log per dwell of a repeat in the contract.

    Parameters
    ----------
    folder : Path
        With the data sets.
    repeat : int
        Which trial.
    out : Path
        Folder for the logs; made if missing.

    Returns
    -------
    DataFrame
        One row per dwell: log, repeat, dwell, roller_v (mean of the rest), roller_v_std (standard
        deviation of the smoothed sensor over it), seconds.
    """
    trial = read_beam(folder, repeat)
    values = {channel.name: channel.values[:] for channel in trial.channels}
    rate, position = trial.sample_rate, values["delta_e_roller"]
    smooth = ndimage.median_filter(position, 2 * round(_SMOOTH * rate / 2) + 1, mode="nearest")
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for k, (dwell, level) in enumerate(find_dwells(trial)):
        rest = _rest(smooth, dwell, level)
        first = max(rest.start - round(_BEFORE * rate), 0)
        name = out / f"repeat{repeat}-dwell{k:02d}.csv"
        # The recording begins at rest; what was before is not known and marked like any move.
        start = max(rest.start, round(_BEFORE * rate))
        table = pd.DataFrame(
            {
                "acc_low_m_s2": values["acc_low"][first : rest.stop],
                "acc_high_m_s2": values["acc_high"][first : rest.stop],
                "reference_velocity_mm_s": np.where(np.arange(first, rest.stop) < start, 1.0, 0.0),
            }
        )
        moment = BEGIN + timedelta(minutes=repeat, seconds=start / rate)
        with name.open("w", encoding="utf-8") as file:
            file.write(f"# stage: beam\n# recorded_at: {moment.isoformat()}\n")
            file.write(f"# sample_rate_hz: {rate:.9g}\n")
            table.to_csv(file, index=False)
        rows.append(
            {
                "log": str(name),
                "recorded_at": moment.isoformat(),
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
