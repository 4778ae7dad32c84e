"""Real UFF58 files: one recording in ASCII and in binary, and the mains in a measured vibration."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lmshealth.io.column_map import load_columns
from lmshealth.io.log import Log
from lmshealth.io.reading import read_log
from studies.harness.study import Row
from studies.read_throughput.samples import MAPS
from studies.readings.checks import STANDARD_ERRORS, Check, at_least, below, command, control

Array = np.ndarray[Any, Any]

FOLDER = "uff58_samples"
TWINS = ("Sample_UFF58_ascii.uff", "Sample_UFF58b_bin.uff")
MEASURED = "MPSTD#Set001_2024_10_08_10_27_07.uff"
MAINS, BAND = 50.0, (10.0, 400.0)
# A sample rate that is not the true 3200 Hz moves mains to where none is.
WRONG_RATE = 3000.0
TWINS_AGREE = "ASCII and binary UFF58, largest difference"
# The ASCII file prints 1.47553E-02 and the like.
_DIGITS = 6
NOT_MET = {
    f"{TWINS_AGREE}, over the largest sample": "the ASCII file prints six digits, so that a sample "
    "of 0.1 Pa is known to 5e-7 Pa: nothing can read 1e-6 of it out of this file"
}
# Half widths in Hz that hold a line, and its surroundings.
NEAR, AROUND = 0.15, 1.15
_SHOWN_HZ = 0.5


def read_real(data: Path, quick: bool) -> tuple[dict[str, Check], Row]:
    """Read the samples of a folder of real measurements."""
    checks, details = twins(data / FOLDER)
    more, mains = measured(data / FOLDER / MEASURED, quick)
    return checks | more, details | mains


def twins(folder: Path) -> tuple[dict[str, Check], Row]:
    """Compare one recording in ASCII and in binary."""
    found = []
    with tempfile.TemporaryDirectory() as scratch:
        for name in TWINS:
            columns = Path(scratch) / "map.toml"
            columns.write_text(MAPS[f"{FOLDER}/{name}"])
            log = read_log(folder / name, columns=load_columns(columns))
            found.append(np.asarray(log.channels[0].values[:]))
    one, other = found
    off, top = np.abs(one - other), float(np.abs(other).max())
    late = float(np.abs(one[1:] - other[:-1]).max())
    # Half of the last digit that the ASCII file prints of each sample, half of the last bit that
    # the binary one holds.
    printed = 10.0 ** (np.floor(np.log10(np.abs(one))) - (_DIGITS - 1))
    rounded = 0.5 * (printed + np.spacing(np.abs(other).astype(np.float32)))
    checks = {
        f"{TWINS_AGREE}, in Pa": below(off.max(), 1e-6),
        f"{TWINS_AGREE}, over the largest sample": below(off.max() / top, 1e-6),
        f"{TWINS_AGREE}, over what both round away": below((off / rounded).max(), 1.001),
        f"control: {TWINS_AGREE}, one sample late, in Pa": control(below(late, 1e-6)),
    }
    return checks, {"ascii_and_binary": {"samples": one.size, "largest_sample_pa": top}}


def measured(path: Path, quick: bool) -> tuple[dict[str, Check], Row]:
    """Ask for the lines of a measured vibration, at its true sample rate and at a wrong one."""
    log = read_log(path)
    lines = lines_of(path, quick)
    mains = [line for line in lines if line["kind"] == "mains"]
    for line in mains:
        line |= beside_plain(log, line)
    first = [line for line in mains if abs(line["frequency_hz"] - MAINS) < NEAR]
    with tempfile.TemporaryDirectory() as scratch:
        other = Path(scratch) / "wrong-rate.h5"
        with h5py.File(other, "w") as file:
            file.attrs["sample_rate_hz"] = WRONG_RATE
            for k, channel in enumerate(log.channels):
                file[f"acc_{k}_m_s2"] = np.asarray(channel.values[:])
        moved = [line for line in lines_of(other, quick) if line["kind"] == "mains"]
    known = [n * MAINS for n in range(1, 9)]
    checks = {
        "MPSTD: channels whose line at 50 Hz is called mains": at_least(len(first), 1),
        "MPSTD: lines at 50 Hz with another name": below(
            sum(abs(line["frequency_hz"] - MAINS) < NEAR for line in lines) - len(first), 0.5
        ),
        "MPSTD: mains lines off a multiple of 50 Hz, largest distance in Hz": below(
            max((min(abs(line["frequency_hz"] - f) for f in known) for line in mains),
                default=float("inf")), NEAR
        ),
        "MPSTD: power of 50 Hz beside plain numpy, departure in standard errors": below(
            max((abs(line["departure"]) for line in first), default=float("inf")),
            STANDARD_ERRORS,
        ),
        f"control: MPSTD said to be sampled at {WRONG_RATE:g} Hz, mains lines": below(
            float(len(moved)), 0.5
        ),
    }  # fmt: skip
    shown = max(first or mains, key=lambda line: line["amplitude"])["channel"]
    details = {
        "channels": len(log.channels),
        "duration_s": log.channels[0].values.size / log.sample_rate,
        "band_hz": BAND,
        "lines": lines,
        "spectrum": picture(log, shown),
    }
    return checks, {"mpstd": details}


def lines_of(path: Path, quick: bool) -> list[Row]:
    """Return the lines that the command line tells of."""
    told = command("spectrum", path, "--band", *BAND, quick=quick)
    return [
        {key: line[key] for key in ("channel", "kind", "frequency_hz", "amplitude")}
        for line in told["lines"]
    ]


def power_spectrum(log: Log, name: str) -> tuple[Array, Array]:
    """Return frequency in Hz and mean square of each harmonic of a channel, by numpy alone."""
    (x,) = [np.asarray(c.values[:]) for c in log.channels if c.name == name]
    power = 2 * np.abs(np.fft.rfft(x - x.mean()) / x.size) ** 2
    return np.fft.rfftfreq(x.size, 1 / log.sample_rate), power


def beside_plain(log: Log, line: Row) -> dict[str, float]:
    """Measure a line's amplitude by its power above its surroundings, over the whole record.

    The standard error is that of a sum of ordinates of noise and of their product with the line.
    """
    frequency, power = power_spectrum(log, line["channel"])
    nearest = MAINS * round(line["frequency_hz"] / MAINS)
    off = np.abs(frequency - nearest)
    inside, around = power[off <= NEAR], power[(off > NEAR) & (off <= AROUND)]
    noise = float(around.mean())
    own = max(float(inside.sum()) - inside.size * noise, 0.0)
    error = noise * (inside.size + inside.size**2 / around.size + 2 * own / noise) ** 0.5
    return {
        "plain_amplitude": (2 * own) ** 0.5,
        "departure": (0.5 * line["amplitude"] ** 2 - own) / error,
    }


def picture(log: Log, name: str) -> Row:
    """Return the largest harmonic of every half a hertz, for the figure."""
    frequency, power = power_spectrum(log, name)
    edges = np.arange(BAND[0], BAND[1] + _SHOWN_HZ, _SHOWN_HZ)
    cuts = np.searchsorted(frequency, edges)
    top = np.sqrt(2 * np.maximum.reduceat(power, cuts)[:-1])
    return {
        "channel": name,
        "frequency_hz": (edges[:-1] + _SHOWN_HZ / 2).tolist(),
        "amplitude": [float(f"{a:.3g}") for a in top],
    }
