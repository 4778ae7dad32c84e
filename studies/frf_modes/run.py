"""Are the modes of a frequency response, and their uncertainties, true?

Question
    Do 95 % intervals of f and ζ from driven logs cover 95 %, are the estimates as good as the data
    allow, and do two real benches and a simulated stage give what is known of them?
Method
    (1) Machines of two modes in the band and two beside it, driven by a multisine of random phases
    (eight periods; sensor noise, a random disturbance that shakes the machine, noise of the
    measured input) or by white noise, one record: share of intervals that hold the truth over all
    seeds and both modes, judged by its 99.9 % Clopper-Pearson interval. Negative control: halved
    intervals must fail. Efficiency: root mean square error over the Cramér-Rao bound of poles,
    residues and the same residual terms at the true densities of noise, by numerical derivatives.
    (2) A sine sweeps through the current of the simulated stage Y while it moves: pitch from three
    sensors against the eigenvalue of the closed loop; z must be standard normal.
    (3) A linear guide with friction (two experiments, two encoders) and a bench of two inertias
    (motor and load side): against the values of the data's readers, sides and experiments against
    each other, noise-only uncertainty against scatter over groups of periods.
Run time
    About six minutes on two free processors.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from lmshealth import read_frf, read_log
from lmshealth.frf import FrfReading
from lmshealth.logs import Channel, Log, Metadata
from lmshealth.readers import load_columns
from models.formats import write_log
from models.stages import stage_named
from models.sweep import Sweep, record_sweep, without_loop
from studies.frf_modes.records import (
    BAND,
    EXCITED,
    MAPS,
    MODES,
    RATE,
    Array,
    Machine,
    at_random,
    periodic,
)
from studies.record import Stopwatch, clopper_pearson, keep

HERE = Path(__file__).parent
SIZE, PERIODS = 1600, 8
MACHINES = {
    "multisine": Machine(white=0.1, process=0.1, input_noise=0.05),
    "white noise": Machine(white=0.1, process=0.1),
}
Z, LEVEL = 1.959963984540054, 0.999
SWEEP, SWEEP_SECONDS = Sweep(100.0, 175.0, amplitude=0.3, period=3.5), 14.0
SENSORS = ("delta_e", "acc_feed", "acc_pitch")
GUIDE = ("lsb250_linear_guide/open/exp1.mat", "lsb250_linear_guide/open/exp2.mat")
BENCH = "fditools_two_inertia_bench/open/MultisineTypeA.mat"
# So many periods of the bench make a group whose estimates scatter.
GROUP = 3


def main() -> None:
    """Run the study; ``--quick`` does few seeds, leaves the sweeps out and records nothing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seeds", type=int, default=400)
    options = parser.parse_args()
    watch = Stopwatch()
    seeds = 12 if options.quick else options.seeds
    # Two workers fill two cores: threads inside linear algebra would get in their way.
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        tasks = list(product(MACHINES, range(seeds)))
        rows = list(pool.map(one_seed, *zip(*tasks, strict=True), chunksize=5))
        swept = [] if options.quick else list(pool.map(one_sweep, range(8)))
    cases = {name: summarise(name, [r for r in rows if r["case"] == name]) for name in MACHINES}
    answer: dict[str, Any] = {"n_seeds": seeds, "cases": cases}
    if swept:
        answer["sweeps"] = summarise_sweeps(swept)
    benches, pictures = read_benches(Path(os.environ["LMSHEALTH_DATA"]))
    answer |= benches
    answer["passed"] = judge(answer)
    print(json.dumps(answer, indent=1))
    if not options.quick:
        keep(HERE / "result.json", __doc__.split("\n")[0],
             {**answer, "pictures": pictures, "sweep_rows": swept}, watch)  # fmt: skip
    if not all(answer["passed"].values()):
        raise SystemExit(f"not as asked: {answer['passed']}")


def make_log(given: Array, answer: Array) -> Log:
    """Return a log of a current and an accelerometer."""
    channels = (Channel("current", "current", given), Channel("acc_x", "acceleration", answer))
    return Log("simulated", "0" * 64, Metadata(), RATE, channels, None, ((0, given.size),), ())


def one_seed(name: str, seed: int) -> dict[str, Any]:
    """Return estimates and standard deviations of ln f and ln ζ of both modes, (2, 2) each."""
    rng = np.random.default_rng([seed, list(MACHINES).index(name)])
    machine = MACHINES[name]
    repeats = name == "multisine"
    signals = (
        periodic(rng, machine, SIZE, PERIODS)
        if repeats
        else at_random(rng, machine, SIZE * PERIODS // 2)
    )
    modes = read_frf(make_log(*signals), "current", "acc_x", band=BAND).modes
    found = {"case": name, "seed": seed, "n_modes": len(modes.names)}
    if len(modes.names) == 2:
        std = np.sqrt(np.diag(modes.cov)).reshape(2, 2)
        found |= {"value": [modes.ln_frequency.tolist(), modes.ln_damping.tolist()],
                  "std": std.tolist()}  # fmt: skip
    return found


def bound(name: str) -> Array:
    """Return the Cramér-Rao bound of std of ln f and ln ζ of the modes in the band, (2, 2).

    Unknown are poles, complex residues and nine powers of s; the noise is known. White noise as
    an input is taken at its mean power, its transient as known.
    """
    machine = MACHINES[name]
    everywhere = np.abs(machine.response(np.arange(1, SIZE // 2) * RATE / SIZE)) ** 2
    if name == "multisine":
        hertz = np.arange(BAND[0], BAND[1] + 1e-9, RATE / SIZE)
        excited = np.arange(EXCITED[0], EXCITED[1] + 1e-9, RATE / SIZE)
        moved = np.mean(np.abs(machine.response(excited)) ** 2)
        # All of the power in the lines that are excited, over white noise of the same.
        power = PERIODS * SIZE / (2 * excited.size)
    else:
        hertz = np.arange(BAND[0], BAND[1], RATE / (SIZE * PERIODS // 2))
        moved, power = np.mean(everywhere), 1.0
    shaken = machine.process**2
    white = machine.white**2 * (moved + shaken * np.mean(everywhere))
    response = np.abs(machine.response(hertz)) ** 2
    variance = (white + response * (shaken + machine.input_noise**2)) / power
    s = 1j * hertz / np.sqrt(BAND[0] * BAND[1])
    theta = _true_unknowns(machine, s)

    def stacked(unknowns: Array) -> Array:
        value = _rational(unknowns, s) * np.sqrt(2 / variance)
        return np.concatenate([value.real, value.imag])

    steps = 1e-6 * np.diag(np.maximum(np.abs(theta), 1e-3))
    jacobian = np.array(
        [(stacked(theta + d) - stacked(theta - d)) / (2 * d.sum()) for d in steps]
    ).T
    scale = np.linalg.norm(jacobian, axis=0)
    cov = np.linalg.inv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    return np.sqrt(np.diag(cov)[:4]).reshape(2, 2)


def _rational(unknowns: Array, s: Array) -> Array:
    """Return two modes, f over the band's centre, and nine powers of s."""
    f, zeta = np.exp(unknowns[:2]), np.exp(unknowns[2:4])
    pole = f * (-zeta + 1j * np.sqrt(1 - zeta**2))
    residue = unknowns[4:6] + 1j * unknowns[6:8]
    modal = residue / (s[:, None] - pole) + residue.conj() / (s[:, None] - pole.conj())
    return np.asarray(modal.sum(axis=1) + (s[:, None] ** np.arange(-4, 5)) @ unknowns[8:])


def _true_unknowns(machine: Machine, s: Array) -> Array:
    """Return the truth in the unknowns of `_rational`: what is left over as powers of s."""
    centre = np.sqrt(BAND[0] * BAND[1])
    f, zeta, part = (np.array([m[k] for m in machine.modes[:2]]) for k in range(3))
    w = f / centre
    pole = w * (-zeta + 1j * np.sqrt(1 - zeta**2))
    # Of s²/((s - p)(s - p*)), whose residue at p is p²/(p - p*).
    residue = part * pole**2 / (pole - pole.conj())
    poles = np.concatenate([np.log(w), np.log(zeta), residue.real, residue.imag])
    rest = machine.response(np.abs(s) * centre) - _rational(np.append(poles, np.zeros(9)), s)
    columns = s[:, None] ** np.arange(-4, 5)
    powers = np.linalg.lstsq(np.concatenate([columns.real, columns.imag]),
                             np.concatenate([rest.real, rest.imag]), rcond=None)[0]  # fmt: skip
    return np.concatenate([poles, powers])


def summarise(name: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return coverage, its negative control and efficiency of f and ζ."""
    kept = [row for row in rows if row["n_modes"] == 2]
    truth = np.log([[m[k] for m in MODES[:2]] for k in range(2)])
    error = np.array([row["value"] for row in kept]) - truth
    z = error / np.array([row["std"] for row in kept])
    efficiency = np.sqrt(np.mean(error**2, axis=0)) / bound(name)
    case: dict[str, Any] = {"n_with_both_modes": len(kept), "n_with_others": len(rows) - len(kept)}
    case["coverage_halved"] = covered(z.ravel(), Z / 2)
    for k, what in enumerate(("frequency", "damping")):
        case[what] = {
            "coverage": covered(z[:, k], Z),
            "z_mean": float(z[:, k].mean()),
            "z_std": float(z[:, k].std()),
            "rmse_over_cramer_rao": efficiency[k].round(3).tolist(),
            "std_over_cramer_rao": (
                np.median([row["std"][k] for row in kept], axis=0) / bound(name)[k]
            )
            .round(3)
            .tolist(),
        }
    return case


def covered(z: Array, reach: float) -> dict[str, Any]:
    """Return a coverage, its exact interval, and whether that holds 95 %."""
    hits = int(np.count_nonzero(np.abs(z) < reach))
    low, high = clopper_pearson(hits, z.size, LEVEL)
    return {"share": hits / z.size, "low": low, "high": high, "holds": low <= 0.95 <= high}


def one_sweep(seed: int) -> dict[str, Any]:
    """Return pitch of stage Y by each sensor: Hz and damping with their deviations in σ."""
    stage = stage_named("lms-y")
    mode, _ = without_loop(stage)["pitch"]
    rng = np.random.default_rng([seed, 42])
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "log.h5"
        write_log(record_sweep(stage, SWEEP, seconds=SWEEP_SECONDS, rng=rng), path, "hdf5")
        log = read_log(path)
    row: dict[str, Any] = {"seed": seed}
    for sensor in SENSORS:
        modes = read_frf(log, "current_excitation", sensor).modes
        i = int(np.argmin(np.abs(modes.frequency - mode.frequency_hz)))
        error = np.array([modes.ln_frequency[i], modes.ln_damping[i]])
        error -= np.log([mode.frequency_hz, mode.damping_ratio])
        std = np.sqrt(np.diag(modes.cov))[[i, i + len(modes.names)]]
        row[sensor] = {
            "error_hz": float(modes.frequency[i] - mode.frequency_hz),
            "std_hz": float(modes.frequency_std[i]),
            "z": (error / std).tolist(),
        }
    return row


def summarise_sweeps(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Test the deviations of each sensor over the seeds."""
    found = {}
    for sensor in SENSORS:
        z = np.array([row[sensor]["z"] for row in rows])
        found[sensor] = {
            "n": len(rows),
            "median_std_hz": float(np.median([row[sensor]["std_hz"] for row in rows])),
            "z_rms": np.sqrt(np.mean(z**2, axis=0)).tolist(),
            "p": chi2.sf(np.sum(z**2, axis=0), len(rows)).tolist(),
        }
    return found


def read_benches(data: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what the benches say, and pictures of two of their responses."""
    guide = {}
    pictures = {}
    for name in GUIDE:
        log = mapped(data, name)
        for output in ("delta_e_motor", "delta_e_load"):
            reading = read_frf(log, "current_input", output, period=5.0)
            guide[f"{Path(name).stem} {output}"] = told(reading)
            if output == "delta_e_load":
                pictures[f"linear guide, {Path(name).stem}"] = pictured(reading)
    log = mapped(data, BENCH)
    bench = {}
    for output in ("delta_e_motor", "delta_e_load"):
        reading = read_frf(log, "current", output)
        bench[output] = told(reading)
        pictures[f"two inertias, {output.removeprefix('delta_e_')}"] = pictured(reading)
        frequency = reading.fit.ordinates.frequency
        inside = (frequency > 40) & (frequency < 70)
        lowest = np.argmin(np.abs(reading.fit.response[inside]))
        bench[output]["antiresonance_hz"] = float(frequency[inside][lowest])
    bench["scatter_over_groups"] = scatter_over_groups(log)
    return {"linear_guide": guide, "two_inertias": bench}, pictures


def mapped(data: Path, name: str) -> Log:
    """Read a real log with its column map."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "map.toml"
        path.write_text(MAPS[name], encoding="utf-8")
        return read_log(data / name, columns=load_columns(path))


def told(reading: FrfReading) -> dict[str, Any]:
    """Return the one mode of a reading."""
    modes, fit = reading.modes, reading.fit
    if len(modes.names) != 1:
        raise SystemExit(f"{modes.frequency} Hz in {reading.frf.output}, expected one mode")
    i = int(np.argmin(np.abs(fit.estimate - modes.ln_frequency[0])))
    return {
        "frequency_hz": float(modes.frequency[0]),
        "frequency_std_hz": float(modes.frequency_std[0]),
        "damping_ratio": float(modes.damping_ratio[0]),
        "damping_ratio_std": float(modes.damping_ratio_std[0]),
        "noise_only_std_hz": float(np.sqrt(fit.noise_cov[i, i]) * modes.frequency[0]),
        "distortion": fit.distortion,
        "chi_square": fit.chi_square,
        "period_s": reading.frf.period,
        "refused": [[r.mode, r.reason] for r in modes.refused],
    }


def pictured(reading: FrfReading) -> dict[str, list[float]]:
    """Return a response and its fit, for the figure."""
    columns: dict[str, Array] = {
        "frequency_hz": reading.frf.frequency,
        "gain": np.abs(reading.frf.response),
        "std": reading.frf.std,
        "fit_hz": reading.fit.ordinates.frequency,
        "fit": np.abs(reading.fit.response),
    }
    return {key: [float(f"{x:.5g}") for x in values] for key, values in columns.items()}


def scatter_over_groups(log: Log) -> dict[str, float]:
    """Compare the scatter of f over groups of periods with what one group says of its noise."""
    size = round(log.sample_rate) * GROUP
    n_groups = log.channels[0].values.size // size
    found, stated = [], []
    for k in range(n_groups):
        cut = slice(k * size, (k + 1) * size)
        channels = tuple(Channel(c.name, c.kind, c.values[cut]) for c in log.channels)
        part = replace(log, channels=channels, pieces=((0, size),))
        row = told(read_frf(part, "current", "delta_e_load", band=(60.0, 100.0)))
        found.append(row["frequency_hz"])
        stated.append(row["noise_only_std_hz"])
    scatter = float(np.std(found, ddof=1))
    ratio = scatter**2 / float(np.mean(np.square(stated)))
    return {
        "n_groups": n_groups,
        "scatter_hz": scatter,
        "stated_hz": float(np.sqrt(np.mean(np.square(stated)))),
        "p_below": float(chi2.cdf(ratio * (n_groups - 1), n_groups - 1)),
    }


def judge(answer: dict[str, Any]) -> dict[str, bool]:
    """Tell what was asked for and what came out."""
    parts = [case[what] for case in answer["cases"].values() for what in ("frequency", "damping")]
    guide, bench = list(answer["linear_guide"].values()), answer["two_inertias"]
    sides = [bench["delta_e_motor"], bench["delta_e_load"]]
    passed = {
        "coverage": all(part["coverage"]["holds"] for part in parts),
        "halved intervals fail": not any(
            case["coverage_halved"]["holds"] for case in answer["cases"].values()
        ),
        "both modes always": not any(case["n_with_others"] for case in answer["cases"].values()),
        "guide: 13.2 to 14.1 Hz": all(13.2 < row["frequency_hz"] < 14.1 for row in guide),
        "guide: experiments agree": agree(guide[0], guide[2]) and agree(guide[1], guide[3]),
        "bench: 76.3 ± 0.4 Hz": all(abs(row["frequency_hz"] - 76.3) < 0.4 for row in sides),
        "bench: 1.2 to 2 %": all(0.012 < row["damping_ratio"] < 0.02 for row in sides),
        "bench: sides agree": agree(*sides),
        "bench: noise is the scatter over periods":
            0.001 < bench["scatter_over_groups"]["p_below"] < 0.999,
    }  # fmt: skip
    if "sweeps" in answer:
        passed["sweeps: z is standard normal"] = all(
            p > 0.001 for row in answer["sweeps"].values() for p in row["p"]
        )
    return passed


def agree(one: dict[str, float], other: dict[str, float]) -> bool:
    """Tell whether two estimates are within twice the standard deviation of their difference."""
    return all(
        abs(one[key] - other[key]) < 2 * np.hypot(one[std], other[std])
        for key, std in (
            ("frequency_hz", "frequency_std_hz"),
            ("damping_ratio", "damping_ratio_std"),
        )
    )


if __name__ == "__main__":
    main()
