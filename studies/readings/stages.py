"""Simulated stages at the paper's velocities: Δe beside plain numpy, growth beside Figure 18."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.stats import mannwhitneyu, spearmanr

from lmshealth.io.log import Log
from lmshealth.io.reading import read_log
from lmshealth.report.tables import error_row
from lmshealth.signal.acceleration_levels import (
    FrequencyBand,
    Growth,
    Magnitude,
    choose_bands,
    find_growth,
    read_magnitudes,
)
from lmshealth.signal.following_error import read_error
from lmshealth.stage.description import load_stage
from models.dynamics.stages import STAGES
from models.recordings.velocities import Experiment, drive_velocities
from studies.harness.study import Row
from studies.paper_tables.tables import FILES, PRINTED_GROWING, printed
from studies.readings.checks import Check, below, command
from studies.readings.sines import plain_reading

Array = np.ndarray[Any, Any]

TABLES = {"x": 6, "y": 7}
EITHER = "the larger of both accelerometers"
SHUFFLES = 200
# By chance one row in twenty is said to grow; rows of one series are shuffled together, so that
# their share scatters.
RASH = 0.1


def read_stages(quick: bool) -> tuple[dict[str, Check], Row]:
    """Drive both stages, read their logs, compare with numpy and with the paper."""
    seeds = 1 if quick else 5
    departures: list[dict[str, float]] = []
    details: Row = {"seeds": seeds, "accelerometer": EITHER}
    shares, spectra = [], []
    for axis, name in [("y", FILES["y"])] if quick else FILES.items():
        bands = (*choose_bands(None, None, None), *choose_bands(load_stage(name), None, None))
        series = []
        for seed in range(seeds):
            with tempfile.TemporaryDirectory() as folder:
                drive_velocities(Experiment(STAGES[name], seed=seed), Path(folder), "hdf5")
                paths = sorted(Path(folder).glob("velocity-*.h5"))
                logs = [read_log(path) for path in paths]
                if seed == 0:
                    departures += [beside_numpy(*pair) for pair in zip(paths, logs, strict=True)]
                    spectra.append(spectrum_beside_numpy(paths, quick))
                series.append([m for log in logs for m in larger(read_magnitudes(log, bands))])
        details[name] = beside_paper(axis, series)
        shares.append(shuffled(series[0], {f"{hertz} Hz" for hertz in table(axis)}))
    checks = {
        f"error on {len(departures)} simulated moves beside numpy alone, {kind}": below(
            max(d[kind] for d in departures), 1e-9
        )
        for kind in departures[0]
    }
    checks |= {
        f"spectrum of simulated moves beside numpy alone, {kind}": below(
            max(own[kind] for own in spectra), 1e-9
        )
        for kind in spectra[0]
    }
    checks["control: rows of Tables 6 and 7 said to grow, velocities shuffled, share"] = below(
        np.mean(shares), RASH
    )
    return checks, {"simulated_stages": details}


def beside_numpy(path: Path, log: Log) -> dict[str, float]:
    """Return the largest relative departure of statistics, bandwidths and shares of one move."""
    with h5py.File(path) as file:
        plain = plain_reading(np.asarray(file["delta_e_um"], dtype=float), log.sample_rate)
    (reading,) = read_error(log)
    row = error_row(log.name, reading)
    off = {
        key: 0.0 if np.isnan(value) and np.isnan(row[key]) else abs(row[key] / value - 1)
        for key, value in plain.items()
    }
    del off["n_above_floor"]
    wrong = float(row["n_above_floor"] != plain["n_above_floor"])
    return {"all figures, relative": max(off.values()), "harmonics above the floor, count": wrong}


def spectrum_beside_numpy(paths: list[Path], quick: bool) -> dict[str, float]:
    """Return the largest departures of what the command line tells of a series of moves.

    Magnitudes of every 10 Hz of each accelerometer, and the slopes of a straight line through
    their logarithms.
    """
    content = command("spectrum", *paths, "--band", 10, 400, quick=quick)
    plain: dict[tuple[str, str], list[tuple[float, float]]] = {}
    off = []
    levels = {(m["log"], m["channel"], m["band"]): m for m in content["magnitudes"]}
    for path in paths:
        for channel, (hertz, amplitude) in plain_amplitudes(path).items():
            for middle in range(10, 401, 10):
                inside = (middle - 5 < hertz) & (hertz < middle + 5)
                level, band = 1e3 * float(amplitude[inside].max()), f"{middle} Hz"
                row = levels[str(path), channel, band]
                off.append(row["magnitude_mm_s2"] / level - 1)
                plain.setdefault((channel, band), []).append((row["velocity_mm_s"], level))
    lines = {key: np.polyfit(*np.log(points).T, 1)[0] for key, points in plain.items()}
    slopes = [g["slope"] - lines[g["channel"], g["band"]] for g in content["growth"]]
    return {"magnitudes, relative": float(np.abs(off).max()), "slopes": float(np.abs(slopes).max())}


def plain_amplitudes(path: Path) -> dict[str, tuple[Array, Array]]:
    """Return frequency and amplitude of the harmonics of each accelerometer, by numpy alone."""
    found = {}
    with h5py.File(path) as file:
        for column in (name for name in file if name.startswith("acc_")):
            x = np.asarray(file[column], dtype=float)
            hertz = np.fft.rfftfreq(x.size, 1 / float(file.attrs["sample_rate_hz"]))
            amplitude = np.abs(np.fft.rfft(x - x.mean())) * 2 / x.size
            found[column.removesuffix("_m_s2")] = (hertz, amplitude)
    return found


def larger(readings: Iterable[Magnitude]) -> list[Magnitude]:
    """Keep per band the accelerometer that reads more: the paper does not say which it shows."""
    best: dict[FrequencyBand, Magnitude] = {}
    for m in readings:
        if m.band not in best or m.level > best[m.band].level:
            best[m.band] = replace(m, channel=EITHER)
    return list(best.values())


def table(axis: str) -> dict[int, list[float]]:
    """Return the printed magnitudes in mm/s² over velocity by frequency in Hz."""
    return {
        int(row["frequency_hz"]): row.iloc[2:].tolist()
        for _, row in printed(TABLES[axis]).iterrows()
    }


def printed_growth(axis: str, moves: list[Magnitude]) -> dict[str, Growth]:
    """Judge the printed magnitudes by the rule that logs are judged by."""
    velocities = sorted({m.velocity for m in moves})
    some = moves[0]
    readings = [
        replace(some, velocity=v, magnitude=1e-3 * level,
                band=FrequencyBand(f"{hertz} Hz", "grid", 0.0, 1.0))
        for hertz, levels in table(axis).items()
        for v, level in zip(velocities, levels, strict=True)
    ]  # fmt: skip
    return {g.band: g for g in find_growth(readings)}


def beside_paper(axis: str, series: list[list[Magnitude]]) -> Row:
    """Compare which frequencies grow: named by the paper, printed, simulated."""
    growth = [{g.band: g for g in find_growth(readings)} for readings in series]
    of_paper = printed_growth(axis, series[0])
    rows = []
    for hertz in table(axis):
        band = f"{hertz} Hz"
        mine = [one[band] for one in growth]
        named = hertz in PRINTED_GROWING[axis]
        rows.append({"frequency_hz": hertz, "named_by_the_paper": named,
                     "printed": told(of_paper[band]), "simulated": average(mine)})  # fmt: skip
    others = {
        band: average([one[band] for one in growth])
        for band in growth[0] if band not in {f"{hertz:g} Hz" for hertz in range(10, 401, 10)}
    }  # fmt: skip
    return {**agreement(rows), "modes_and_wide_bands": others, "rows": rows}


def told(growth: Growth) -> Row:
    """Return a slope as JSON."""
    return {"slope": growth.slope, "slope_std": growth.slope_std, "grows": bool(growth.grows)}


def average(growth: list[Growth]) -> Row:
    """Return the mean slope over seeds, its mean σ, and whether most seeds say that it grows."""
    grown = sum(g.grows is True for g in growth)
    return {
        "slope": float(np.mean([g.slope for g in growth])),
        "slope_std": float(np.mean([g.slope_std for g in growth])),
        "grows": 2 * grown > len(growth),
        "seeds_that_grow": grown,
    }


def agreement(rows: list[Row]) -> Row:
    """Count where names, printed numbers and simulation agree and where they do not."""

    def count(hits: Array) -> str:
        return f"{hits.sum()} of {hits.size}"

    kinds = ("printed", "simulated")
    slopes = np.array([[row[kind]["slope"] for kind in kinds] for row in rows])
    printed, simulated = np.array([[row[kind]["grows"] for row in rows] for kind in kinds])
    named = np.array([row["named_by_the_paper"] for row in rows])
    hertz = np.array([row["frequency_hz"] for row in rows])
    # Share of pairs of a named and an unnamed row in which the named one has the larger slope.
    above = mannwhitneyu(slopes[named], slopes[~named]).statistic
    above = above / (named.sum() * (~named).sum())
    return {
        "named_grow_in_simulation": count(simulated[named]),
        "named_grow_in_print": count(printed[named]),
        "unnamed_do_not_grow_in_simulation": count(~simulated[~named]),
        "unnamed_do_not_grow_in_print": count(~printed[~named]),
        "print_and_simulation_say_the_same": count(printed == simulated),
        "grow_in_print_only_hz": hertz[printed & ~simulated].tolist(),
        "grow_in_simulation_only_hz": hertz[simulated & ~printed].tolist(),
        "median_slope": {"printed": float(np.median(slopes[:, 0])),
                         "simulated": float(np.median(slopes[:, 1]))},
        "named_steeper_than_unnamed": {"printed": float(above[0]), "simulated": float(above[1])},
        "rank_correlation_of_slopes": float(spearmanr(*slopes.T).statistic),
    }  # fmt: skip


def shuffled(readings: list[Magnitude], bands: set[str]) -> float:
    """Return the share of rows said to grow when the logs' velocities are shuffled."""
    rng = np.random.default_rng(6)
    mine = [m for m in readings if m.band.name in bands]
    velocities = sorted({m.velocity for m in mine})
    grown = []
    for _ in range(SHUFFLES):
        other = dict(zip(velocities, rng.permutation(velocities).tolist(), strict=True))
        found = find_growth(replace(m, velocity=other[m.velocity]) for m in mine)
        grown += [g.grows is True for g in found]
    return float(np.mean(grown))
