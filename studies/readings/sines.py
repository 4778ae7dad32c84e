"""`lmshealth error` on sums of known sines, and beside a reading by plain numpy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd

from lmshealth.io.reading import read_log
from lmshealth.signal.following_error import read_error
from studies.common.harmonics import rebuild
from studies.harness.study import Row
from studies.readings.checks import Check, below, command, control

Array = np.ndarray[Any, Any]

RATE = 20_000.0
N_SINES, COUNT, FLOOR_UM = 150, 100, 0.030
MEAN_UM = 0.1
# Of a sine between two harmonics, in parts of their distance.
OFFSETS = (0.001, 0.01, 0.1, 0.25, 0.5)


def read_sums(quick: bool, folder: Path) -> tuple[dict[str, Check], Row]:
    """Read sums of sines from files by the command line, and sines between the harmonics."""
    rng = np.random.default_rng(3)
    # Odd and even records, a second or so each.
    truths = [draw(rng, 20_000 + i % 2) for i in range(4 if quick else 20)]
    for i, truth in enumerate(truths):
        write(folder / f"sum-{i:02d}.h5", truth["samples_um"])
    for i, offset in enumerate(OFFSETS):
        # One sine of 1 µm between two harmonics of a second.
        n = round(RATE)
        write(folder / f"between-{i}.h5", np.cos(2 * np.pi * (500 + offset) * np.arange(n) / n))
    told = command("error", *sorted(folder.glob("*.h5")), "--count", COUNT, "--floor-nm", 30,
                   quick=quick)  # fmt: skip
    rows = {Path(row["log"]).stem: row for row in told["error"]}
    errors: list[dict[str, float]] = []
    for i, truth in enumerate(truths):
        row = rows[f"sum-{i:02d}"]
        listed = [h for h in told["harmonics"] if h["log"] == row["log"]]
        errors.append(compare(row, listed, truth) | rebuilt(Path(row["log"]), listed, truth))
    checks = {
        f"{name}, largest error": below(max(e[name] for e in errors), 1e-9) for name in errors[0]
    }
    leaks = [leak(rows[f"between-{i}"], offset) for i, offset in enumerate(OFFSETS)]
    checks["control: amplitude of a sine half way between two harmonics"] = control(
        below(leaks[-1]["amplitude_error"], 1e-9)
    )
    details = {"logs": len(errors), "sines_each": N_SINES, "between_harmonics": leaks}
    return checks, {"sums_of_sines": details}


def draw(rng: np.random.Generator, n: int) -> Row:
    """Draw sines of whole periods, strongest first, from 3 nm to 3 µm, and their sum in µm."""
    k = rng.choice(np.arange(1, n // 2), N_SINES, replace=False)
    amplitude = np.sort(10 ** rng.uniform(-2.5, 0.5, N_SINES))[::-1]
    phase = rng.uniform(-np.pi, np.pi, N_SINES)
    # Angles are reduced exactly before they are rounded.
    angle = 2 * np.pi * (k[:, None] * np.arange(n) % n) / n + phase[:, None]
    parts = amplitude[:, None] * np.cos(angle)
    above = amplitude[:COUNT] > FLOOR_UM
    return {
        "hertz": k * RATE / n,
        "amplitude": amplitude,
        "phase": phase,
        "above": above,
        "samples_um": MEAN_UM + parts.sum(axis=0),
        "kept_above_um": MEAN_UM + parts[:COUNT][above].sum(axis=0),
    }


def write(path: Path, delta_e_um: Array) -> None:
    """Write a log with a following error and nothing else."""
    with h5py.File(path, "w") as file:
        file["delta_e_um"] = delta_e_um
        file.attrs["sample_rate_hz"] = RATE


def compare(row: Row, harmonics: list[Row], truth: Row) -> dict[str, float]:
    """Return the largest errors of what the command tells of one sum."""
    found = pd.DataFrame(harmonics)
    hertz, amplitude, x = truth["hertz"][:COUNT], truth["amplitude"], truth["samples_um"]
    above, power = truth["above"], amplitude**2 / 2
    turned = np.angle(np.exp(1j * (found["phase_rad"].to_numpy() - truth["phase"][:COUNT])))
    exact = {
        "std_um": np.sqrt(power.sum()),
        "mean_um": MEAN_UM,
        "min_um": x.min(),
        "max_um": x.max(),
        "max_magnitude_um": amplitude[0],
        "strongest_hz": hertz[0],
        "bandwidth_hz": np.ptp(hertz),
        "bandwidth_above_floor_hz": np.ptp(hertz[above]),
        "share_explained": power[:COUNT].sum() / power.sum(),
        "share_explained_above_floor": power[:COUNT][above].sum() / power.sum(),
        "n_harmonics": COUNT,
        "n_above_floor": above.sum(),
    }
    relative = [abs(row[key] / float(value) - 1) for key, value in exact.items()]
    return {
        "frequency of the 100 strongest, in order, relative": float(
            np.abs(found["frequency_hz"] / hertz - 1).max()
        ),
        "amplitude, relative": float(np.abs(found["amplitude_um"] / amplitude[:COUNT] - 1).max()),
        "phase in rad": float(np.abs(turned).max()),
        "minimum, maximum, standard deviation, mean and largest magnitude, relative": max(
            relative[:5]
        ),
        "bandwidths with and without the floor of 30 nm, relative": max(relative[5:8]),
        "share of variance explained, relative": max(relative[8:10]),
        "harmonics kept and above the floor, count and flags wrong": float(
            max(relative[10:]) + np.sum(found["above_floor"] != above)
        ),
    }


def rebuilt(path: Path, harmonics: list[Row], truth: Row) -> dict[str, float]:
    """Compare the rebuilt error with the sines kept, and with the cosines that the command lists.

    Also the share of variance: explained by the rebuilt error, one minus what it leaves.
    """
    (reading,) = read_error(read_log(path))
    ours, exact = 1e6 * rebuild(reading.harmonics, reading.above), truth["kept_above_um"]
    t = np.arange(exact.size) / RATE
    cosines = sum(
        h["amplitude_um"] * np.cos(2 * np.pi * h["frequency_hz"] * t + h["phase_rad"])
        for h in harmonics if h["above_floor"]
    )  # fmt: skip
    x = truth["samples_um"]
    left = float(np.var(x - ours) / np.var(x))
    top = float(np.abs(exact).max())
    return {
        "rebuilt Δe against the known sines, of its largest sample": float(
            np.abs(ours - exact).max() / top
        ),
        "rebuilt Δe against the listed cosines, of its largest sample": float(
            np.abs(ours - MEAN_UM - cosines).max() / top
        ),
        "share explained against one minus the variance left": abs(
            reading.harmonics.share(reading.above) - (1 - left)
        ),
    }


def leak(row: Row, offset: float) -> dict[str, float]:
    """Return how far the reading of such a sine is off, and where its power went."""
    (reading,) = read_error(read_log(Path(row["log"])))
    amplitude = 1e6 * reading.harmonics.amplitude
    return {
        "offset_harmonics": offset,
        "amplitude_error": abs(row["max_magnitude_um"] - 1),
        "frequency_error_hz": abs(row["strongest_hz"] - (500 + offset)),
        "share_outside_the_nearest_two": float(
            1 - np.sum(amplitude[499:501] ** 2) / np.sum(amplitude**2)
        ),
        "share_outside_the_100_strongest": 1 - row["share_explained"],
        "harmonics_above_30_nm": row["n_above_floor"],
        "amplitude_um_ten_harmonics_away": float(amplitude[509]),
    }


def plain_reading(delta_e_um: Array, rate: float) -> dict[str, float]:
    """Read a following error with numpy alone, as the paper says."""
    n = delta_e_um.size
    transform = np.fft.rfft(delta_e_um - np.mean(delta_e_um))[1:] * 2 / n
    if n % 2 == 0:
        transform[-1] /= 2
    hertz, magnitude = np.fft.rfftfreq(n, 1 / rate)[1:], np.abs(transform)
    power = magnitude**2 / 2
    if n % 2 == 0:
        power[-1] *= 2
    kept = np.argsort(-magnitude)[:COUNT]
    above = kept[magnitude[kept] > FLOOR_UM]
    return {
        "min_um": float(np.min(delta_e_um)),
        "max_um": float(np.max(delta_e_um)),
        "std_um": float(np.std(delta_e_um)),
        "mean_um": float(np.mean(delta_e_um)),
        "max_magnitude_um": float(magnitude[kept[0]]),
        "strongest_hz": float(hertz[kept[0]]),
        "bandwidth_hz": float(np.ptp(hertz[kept])),
        "bandwidth_above_floor_hz": float(np.ptp(hertz[above])) if above.size else float("nan"),
        "share_explained": float(power[kept].sum() / np.var(delta_e_um)),
        "share_explained_above_floor": float(power[above].sum() / np.var(delta_e_um)),
        "n_above_floor": float(above.size),
    }
