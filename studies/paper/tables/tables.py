"""The paper's tables on the simulated stages: cells of simulated beside printed, row by row."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.signal import find_peaks

from models.dynamics.equations import controller
from models.dynamics.margins import cases, margin_record
from models.dynamics.plant import closed_loop_modes
from models.dynamics.servo import MEASURED
from models.dynamics.stages import Stage, stage_named
from models.recordings.recording import Recording, record
from models.recordings.strokes import VELOCITIES, full_stroke, record_strokes
from models.recordings.sweep import Sweep, record_sweep

Array = NDArray[np.float64]

PRINTED = Path(__file__).parent / "printed"
FILES = {"x": "lms-x", "y": "lms-y"}
# Rigid bodies on springs; and with elastic parts inside the loop as measured.
PLANTS = ("rigid", "full")
COUNT, FLOOR_UM = 100, 0.030
# A resonance stands out of the smoothed response by this much.
PROMINENCE_DB = 0.5
# Rows of Tables 6 and 7 that belong to a mode of three rigid bodies.
MODE_ROWS = {
    "x": {10: "granite_feed", 50: "granite_pitch", 100: "roll", 150: "yaw", 250: "pitch"},
    "y": {10: "granite_feed", 40: "granite_vertical", 50: "granite_pitch", 130: "roll",
          140: "pitch", 160: "yaw", 380: "vertical"},
}  # fmt: skip
# Section 4 of the paper, from its Figure 18.
PRINTED_GROWING = [
    *("x 10 Hz", "x 50 Hz", "x 150 Hz", "y 10 Hz", "y 90 Hz", "y 110 Hz", "y 120 Hz", "y 140 Hz"),
    *("y 150 Hz", "y 160 Hz", "y 260 Hz", "y 290 Hz", "y 310 Hz", "y 380 Hz", "y 390 Hz"),
]


@dataclass(frozen=True, slots=True)
class TableRow:
    """A row of a table: printed and simulated cells (NaN = none), scatter over seeds."""

    table: str
    name: str
    printed: tuple[float, ...]
    simulated: tuple[float, ...]
    scatter: tuple[float, ...] = ()
    mode: str | None = None


def stage_of(axis: str, plant: str) -> Stage:
    """Return the simulated stage of an axis: a plant of `PLANTS`."""
    return stage_named(FILES[axis] + "-full" * (plant == "full"))


def printed(number: int) -> pd.DataFrame:
    """Return a table as the paper prints it."""
    return pd.read_csv(PRINTED / f"table{number}.csv")


def amplitude_spectrum(values: Array) -> Array:
    """Return amplitudes of the FFT's harmonics, the mean left out."""
    return np.abs(np.fft.rfft(values - values.mean())) * 2 / values.size


def error_reading(recording: Recording) -> dict[str, float]:
    """Read Δe as the paper: statistics, 100 strongest harmonics, those above 30 nm (µm, Hz)."""
    error = recording.columns["delta_e_um"].astype(float)
    magnitude = amplitude_spectrum(error)
    hertz = np.fft.rfftfreq(error.size, 1 / recording.metadata["sample_rate_hz"])
    strongest = np.argsort(magnitude)[-COUNT:]
    above = strongest[magnitude[strongest] > FLOOR_UM]
    return {
        "min_um": float(error.min()),
        "max_um": float(error.max()),
        "std_um": float(error.std()),
        "mean_um": float(error.mean()),
        "bandwidth_hz": float(np.ptp(hertz[strongest])),
        "bandwidth_above_30nm_hz": float(np.ptp(hertz[above])) if above.size else 0.0,
        "max_magnitude_um": float(magnitude.max()),
    }


def acceleration_reading(recording: Recording, bands: Iterable[Array]) -> list[float]:
    """Return the largest harmonic (mm/s²) of either accelerometer within each row's bands (Hz).

    The paper does not say which of its two directions a magnitude belongs to.
    """
    both = [recording.columns[f"acc_{name}_m_s2"].astype(float) for name in ("feed", "pitch")]
    magnitude = np.max([1e3 * amplitude_spectrum(values) for values in both], axis=0)
    hertz = np.fft.rfftfreq(both[0].size, 1 / recording.metadata["sample_rate_hz"])
    inside = (
        np.any([(low < hertz) & (hertz < high) for low, high in row], axis=0) for row in bands
    )
    return [float(magnitude[row].max()) for row in inside]


def bands_of(axis: str, plant: str) -> list[Array]:
    """Return the bands (band, 2) in Hz in which each row of Table 6 or 7 is read.

    A row without a mode: ±5 Hz about its number.  A row with a mode: ±4 Hz about the simulated
    mode, and, where the number is a multiple of 50 Hz, the mains line that stands in it.
    """
    modes = {m.name: m.frequency_hz for m in closed_loop_modes(stage_of(axis, plant))}
    bands = []
    for hertz in printed(6 if axis == "x" else 7)["frequency_hz"]:
        if hertz not in MODE_ROWS[axis]:
            bands.append([(hertz - 5.0, hertz + 5.0)])
            continue
        at = modes[MODE_ROWS[axis][hertz]]
        mains = [(hertz - 0.5, hertz + 0.5)] if hertz % 50 == 0 else []
        bands.append([(at - 4.0, at + 4.0), *mains])
    return [np.array(row) for row in bands]


def recorded(stage: Stage, velocity: float, seed: int, constant: float | None) -> Recording:
    """Return the record of a full stroke, or of so many s of its constant part alone."""
    rng = np.random.default_rng([seed, round(velocity * 1e6)])
    move = full_stroke(stage, velocity)
    if constant is None:
        return record_strokes(stage, profile=move, rng=rng)
    return record(stage, seconds=min(constant, move.constant_s), velocity=velocity, rng=rng)


def velocity_rows(
    axis: str,
    plant: str,
    seeds: int,
    constant: float | None = None,
    columns: Sequence[int] = range(len(VELOCITIES)),
) -> list[TableRow]:
    """Return the rows of Tables 3, 4 and 6 or 7 of one configuration, NaN beside the columns."""
    bands, number = bands_of(axis, plant), 6 if axis == "x" else 7
    readings = []
    for seed, column in product(range(seeds), columns):
        one = recorded(stage_of(axis, plant), VELOCITIES[column], seed, constant)
        readings.append([*error_reading(one).values(), *acceleration_reading(one, bands)])
    found = np.array(readings).reshape(seeds, len(columns), -1)
    mean, spread = np.full((2, len(VELOCITIES), found.shape[2]), np.nan)
    mean[columns] = found.mean(axis=0)
    if seeds > 1:
        spread[columns] = found.std(axis=0, ddof=1)
    # The tables have the error's columns in the order of its reading.
    rows: list[tuple[str, str, Any, str | None]] = [
        (f"Table {n}", f"{axis} {key[2:]}", printed(n)[key], None)
        for n in (3, 4) for key in map(str, printed(n)) if key.startswith(axis)
    ]  # fmt: skip
    for _, hertz, *cells in printed(number).to_numpy().tolist():
        mode = MODE_ROWS[axis].get(int(hertz))
        rows.append((f"Table {number}", f"{axis} {hertz:g} Hz", cells, mode))
    return [
        TableRow(table, name, tuple(map(float, cells)), tuple(simulated), tuple(scatter), mode)
        for (table, name, cells, mode), simulated, scatter in zip(
            rows, mean.T.tolist(), spread.T.tolist(), strict=True
        )
    ]


def loop_rows(plant: str) -> list[TableRow]:
    """Return Table 1: margins with the flexible modes inside, and settings of the controller.

    Of the rigid stages the loop is that of the corrected equations, with the settings of equations
    8 and 9; of the full that of the drive, with its settings.

    The velocity loop's P stands in the equations only as a product with a scale, so that I/P alone
    follows from them.
    """
    table = printed(1).set_index("parameter")
    ratio = table.loc["velocity_loop_i"] / table.loc["velocity_loop_p"]
    table.loc["velocity_loop_i_over_p"] = ratio
    found: dict[str, list[float]] = {}
    for axis in FILES:
        name = stage_of(axis, plant).name
        (loop,) = (
            row
            for row in map(margin_record, cases(name))
            if row["structure"] == "flexible" and row["reading"] in ("corrected", "measured")
        )
        gain = next(c for c in loop["crossovers"] if c["phase_margin_deg"] is not None)
        upper = [c for c in loop["crossovers"] if c["crossover"].startswith("upper")]
        margins = {
            "bandwidth_hz": gain["frequency_hz"],
            "gain_margin_db": min(c["gain_margin_db"] for c in upper),
            "phase_margin_deg": gain["phase_margin_deg"],
        }
        for key, value in (margins | _controller_numbers(name)).items():
            found.setdefault(key, []).append(value)
    order = [key for key in table.index if key in found]
    return [
        TableRow("Table 1", key, tuple(map(float, table.loc[key])), tuple(found[key]))
        for key in order
    ]


def _controller_numbers(stage: str) -> dict[str, float]:
    """Return Table 1's settings: of a full stage those of its drive, else by the equations.

    Those of a rigid stage are computed from the roots of the corrected equations (8) and (9).
    """
    if stage in MEASURED:
        tuning = MEASURED[stage]
        return {
            "lpf_cutoff_hz": tuning.low_pass_hz,
            "notch_frequency_hz": min(section.frequency_hz for section in tuning.sections),
            "position_loop_p": tuning.position_gain,
            "velocity_loop_i_over_p": tuning.velocity_i / tuning.velocity_p,
        }
    law = controller(stage, "corrected")
    zeros, poles = np.asarray(law.zeros()), np.asarray(law.poles())
    real = np.sort(np.abs(zeros[np.abs(zeros.imag) < 1e-3 * np.abs(zeros)].real))
    hertz = np.abs(zeros[zeros.imag > 1]) / (2 * np.pi)
    filters = np.abs(poles[poles.imag > 1]) / (2 * np.pi)
    # What has no zero beside it is the low pass; of Y's two other sections the notch is the lower.
    alone = [f for f in filters if np.min(np.abs(np.log(hertz / f))) > 0.01]
    return {
        "lpf_cutoff_hz": float(alone[0]),
        "notch_frequency_hz": float(hertz.min()),
        "position_loop_p": float(real[1]),
        "velocity_loop_i_over_p": float(real[0]),
    }


def _feed_response(stage: Stage, sweep: Sweep, logs: int) -> tuple[Array, Array]:
    """Return frequencies (Hz) and |acceleration of Δe over motor current| of averaged sweeps."""
    total = np.zeros((2, sweep.samples // 2 + 1), dtype=complex)
    for seed in range(logs):
        rng = np.random.default_rng(seed)
        log = record_sweep(stage, sweep, seconds=2 * sweep.period, velocity=0.028, rng=rng)
        for i, name in enumerate(("delta_e_um", "current_a")):
            # Whole periods of the sweep: every harmonic of the period is one bin.
            blocks = log.columns[name].astype(float).reshape(2, -1)
            total[i] += np.fft.rfft(blocks, axis=1).sum(axis=0)
    hertz = np.fft.rfftfreq(sweep.samples, 1 / log.metadata["sample_rate_hz"])
    inside = (hertz > sweep.low_hz) & (hertz < sweep.high_hz)
    return hertz[inside], np.abs(total[0] / total[1])[inside] * hertz[inside] ** 2


def feed_resonances(stage: Stage, logs: int = 4) -> Array:
    """Return resonances (Hz) along the feed: peaks of acceleration over current while moving.

    Two sweeps: what moves the stage enough at 900 Hz would turn it back at 10 Hz.  At 28 mm/s the
    encoder's period stands at 1400 Hz, above both.
    """
    sweeps = (Sweep(8.0, 60.0, 0.2, 5.0), Sweep(50.0, 1200.0, 1.0, 5.0))
    parts = [_feed_response(stage, sweep, logs) for sweep in sweeps]
    low = parts[0][0] < 55
    hertz = np.concatenate([parts[0][0][low], parts[1][0][parts[1][0] >= 55]])
    level = np.concatenate([parts[0][1][low], parts[1][1][parts[1][0] >= 55]])
    # Even in the logarithm of frequency and smoothed over half a mode's width of damping 1.5 %.
    grid = np.geomspace(hertz[0], hertz[-1], 4000)
    kernel = np.hanning(17) / np.hanning(17).sum()
    smooth = np.convolve(20 * np.log10(np.interp(grid, hertz, level)), kernel, mode="same")
    inner = slice(20, -20)
    peaks, _ = find_peaks(smooth[inner], prominence=PROMINENCE_DB)
    return np.asarray(grid[inner][peaks])


def resonance_rows(plant: str) -> list[TableRow]:
    """Return Table 2: each printed resonance beside a simulated one within 10 % (our tolerance).

    A resonance that the simulated sweep shows comes first; else a mode of the structure that has
    the frequency and hardly moves along the feed, then with its name.  Each serves one row only,
    the nearest.
    """
    table = printed(2)
    rows = []
    for axis in FILES:
        stage = stage_of(axis, plant)
        wanted = table[f"{axis}_hz"].dropna().to_numpy(dtype=float)
        modes = {m.name: m.frequency_hz for m in closed_loop_modes(stage)}
        seen = _nearest(wanted, dict.fromkeys(feed_resonances(stage)))
        missing = np.setdiff1d(wanted, list(seen))
        hidden = _nearest(missing, {f: n for n, f in modes.items()}) if missing.size else {}
        for hertz in wanted.tolist():
            value, owner = seen.get(hertz) or hidden.get(hertz) or (np.nan, None)
            label = f"{axis} {hertz:g} Hz"
            rows.append(TableRow("Table 2", label, (hertz,), (float(value),), mode=owner))
    return rows


def _nearest(
    wanted: Array, offered: dict[float, str | None]
) -> dict[float, tuple[float, str | None]]:
    """Pair each offered frequency with the nearest wanted one within 10 %, each once."""
    pairs: dict[float, tuple[float, str | None]] = {}
    for value, name in offered.items():
        hertz = float(min(wanted, key=lambda w: abs(np.log(w / value))))
        near = abs(np.log(hertz / value))
        before = abs(np.log(hertz / pairs[hertz][0])) if hertz in pairs else np.log(1.1)
        if near < before:
            pairs[hertz] = (float(value), name)
    return pairs


def modal_rows(plant: str) -> list[TableRow]:
    """Return Table 5; labels 1 and 3 are swapped between X and Y, so modes go by frequency."""
    table = printed(5)
    order = ("granite_feed", "granite_yaw", "granite_vertical", "roll", "pitch")
    rows = []
    for axis in FILES:
        modes = {m.name: m.frequency_hz for m in closed_loop_modes(stage_of(axis, plant))}
        for line, mode in zip(table.itertuples(), order, strict=True):
            value = float(getattr(line, f"{axis}_hz"))
            label = f"{axis} {getattr(line, f'{axis}_direction')}"
            rows.append(TableRow("Table 5", label, (value,), (modes[mode],), mode=mode))
    return rows
