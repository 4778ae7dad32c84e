"""Do intervals from free decays cover, and are decays of real and simulated machines right?

Method
    Decays of one to three modes after one to eight stops, with ambient response and white noise at
    three levels, 400 logs of each case. A coverage passes if its 99.9 % Clopper-Pearson interval
    contains 95 %. Controls that must fail: intervals 1.5 times as wide and as narrow; least
    squares that assume white noise. Errors are compared with `decay_bound`. Intervals without
    ambient response may be too wide and are not judged.
    The stages X and Y of `models` stop from 100 and 400 mm/s with loop, mains, orders and
    accelerometers; coverage is judged over all modes.
    The beam is the movable-roller testbed DROPBEAR (data set 8). Dwells follow from the measured
    roller position; the mode is searched within 30 % of 33 Hz with a damping of 0.2 % within a
    factor of ten. Reference frequencies come from Welch spectra and least squares, good to 0.15
    Hz.
Run time
    13 minutes on one processor. The beam needs ``dropbear_ds8`` in LMSHEALTH_DATA.
"""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy import optimize

from lmshealth import identify_decays
from lmshealth.calibration.ranks import clopper_pearson
from lmshealth.signal.segments import Segment
from lmshealth.stage.description import Description, ModeSpec, Stage
from studies.harness.claims import Claim, percents, span
from studies.harness.study import Row, Study, Trials
from studies.modes.decays.beam import REPEATS, judge_beam, one_beam
from studies.modes.decays.cases import CASES, QUIET, RATE, Case, one_machine, simulate, to_log

LEVEL, Z = 0.999, 1.959963984540054
NOMINAL = 0.95
# Factors on the intervals: the second and third are negative controls.
WIDTHS = {"coverage": 1.0, "wide": 1.5, "narrow": 1 / 1.5}
SEEDS, QUIET_SEEDS, MACHINES = 400, 100, 10
STAGES = ("lms-x", "lms-y")
QUICK_SEEDS = 10
# What does not hold, and why.
NOT_MET = {
    "wide intervals do not": "0.1 %, one stop: few ordinates give its ambient response, tails are "
    "heavier than normal ones, and 400 logs do not distinguish 98 % from 95 %"
}


def main() -> None:
    """Run the study; ``--quick`` does few logs of one case and one stage, records nothing."""
    study = Study(__file__, __doc__)
    quick, trials = study.quick, study.trials
    n_seeds = QUICK_SEEDS if quick else SEEDS
    cases, quiet = (CASES[1:2], ()) if quick else (CASES, QUIET)
    data = os.environ.get("LMSHEALTH_DATA")
    answer: Row = {
        "n_seeds": n_seeds,
        "cases": {case.name: run_case(case, n_seeds, trials) for case in cases},
        "quiet": {case.name: run_case(case, QUIET_SEEDS, trials) for case in quiet},
        "machines": judge_machines(1, STAGES[:1]) if quick else judge_machines(MACHINES, STAGES),
        "beam": [
            row
            for repeat in range(REPEATS if data and not quick else 0)
            for row in one_beam(Path(str(data)), repeat)
        ],
    }
    answer |= judge(answer, quick=quick)
    study.conclude(answer, not_met=NOT_MET)
    # A check that is documented as not met and is met must be noticed, too.
    if met := [name for name in NOT_MET if answer["passed"].get(name)]:
        raise SystemExit(f"met after all: {met}")


def judge(answer: Row, *, quick: bool) -> Row:
    """Return what holds of the intervals, of their negative controls, of machines and beam."""
    modes = [mode for case in answer["cases"].values() for mode in case["modes"]]
    parts = [mode[quantity] for mode in modes for quantity in ("f", "zeta")]
    machines = answer["machines"]
    passed = {
        "intervals cover": all(part["coverage"]["holds"] for part in parts),
        "machines: no mode is taken for another": machines["n_taken_for_another"] == 0,
        "machines: all within four standard deviations": machines["largest_z"] < 4,
    }
    if not quick:
        squares = [part["least_squares"] for part in parts if "least_squares" in part]
        passed |= {
            "narrow intervals do not": not any(part["narrow"]["holds"] for part in parts),
            "wide intervals do not": not any(part["wide"]["holds"] for part in parts),
            "white-noise least squares do not": not any(part["holds"] for part in squares),
            "machines: intervals cover": all(machines[q]["holds"] for q in ("f", "zeta")),
        }
    passed |= judge_beam(answer["beam"]) if answer["beam"] else {}
    return {
        "passed": passed,
        "controls_found_out": {
            width: f"{sum(not part[width]['holds'] for part in parts)} of {len(parts)}"
            for width in ("narrow", "wide")
        },
    }


def run_case(case: Case, n_seeds: int, trials: Trials) -> Row:
    """Identify logs of a case; count what intervals cover, set scatter against the bound."""
    rows = trials.collect(one_log, [(case.name, seed) for seed in range(n_seeds)])
    bound, modes = case.bound(), []
    for i, (f, zeta) in enumerate(case.modes):
        kept = [row[f"mode {f}"] for row in rows if not isinstance(row[f"mode {f}"], str)]
        reasons = [row[f"mode {f}"] for row in rows if isinstance(row[f"mode {f}"], str)]
        mode: Row = {"f_hz": f, "zeta": zeta, "refused": Counter(sorted(reasons))}
        for k, (quantity, truth) in enumerate((("f", np.log(f)), ("zeta", np.log(zeta)))):
            own = np.array(kept)[:, [k, 2 + k]] - [truth, 0.0]
            mode[quantity] = {name: coverage(own, width) for name, width in WIDTHS.items()} | {
                "rmse": float(np.sqrt(np.mean(own[:, 0] ** 2))),
                "median_std": float(np.median(own[:, 1])),
                "bias_over_std": float(np.mean(own[:, 0] / own[:, 1])),
                "rmse_over_bound": float(np.sqrt(np.mean(own[:, 0] ** 2)) / bound[k, i]),
            }
            if "least squares" in rows[0] and case.ambient:
                squares = np.array([row["least squares"] for row in rows])[:, [k, 2 + k]]
                mode[quantity]["least_squares"] = coverage(squares - [truth, 0.0])
        modes.append(mode)
    return {"stops": case.n_stops, "seconds": case.seconds, "ambient": case.ambient,
            "noise": case.noise, "modes": modes}  # fmt: skip


def one_log(name: str, seed: int) -> Row:
    """Identify one log; return estimates, standard deviations or the reason of each mode."""
    (case,) = (case for case in (*CASES, *QUIET) if case.name == name)
    rng = np.random.default_rng([seed, zlib.crc32(case.name.encode())])
    x = simulate(case, rng)
    # The description is off by what wear and other people's estimates are off by.
    description = Description(
        name="decays",
        mode=tuple(ModeSpec(f"mode {f}", 1.01 * f, 1.4 * zeta, search=0.1)
                   for f, zeta in case.modes),
    )  # fmt: skip
    log = to_log(x)
    decays = [Segment(start, stop, 0.0) for start, stop in log.pieces]
    found = identify_decays(log, Stage(description, None, "0" * 64), segments=decays)
    n = len(found.names)
    std = np.sqrt(np.diag(found.cov))
    row: Row = {refusal.mode: refusal.reason for refusal in found.refused}
    for i, name in enumerate(found.names):
        row[name] = [found.ln_frequency[i], found.ln_damping[i], std[i], std[n + i]]
    if len(case.modes) == 1:
        row["least squares"] = least_squares(x[:, 0], *case.modes[0])
    return row


def least_squares(x: np.ndarray, f: float, zeta: float) -> list[float]:
    """Fit decays as if noise were white: estimates and what that takes for their deviations."""
    t = np.arange(x.shape[1]) / RATE

    def left(q: np.ndarray) -> np.ndarray:
        damping = np.exp(q[1])
        exponent = 2 * np.pi * np.exp(q[0]) * (-damping + 1j * np.sqrt(1 - damping**2))
        wave = np.exp(exponent * t)
        columns = np.stack([wave.real, wave.imag], axis=1)
        return np.ravel(x.T - columns @ np.linalg.lstsq(columns, x.T)[0])

    fit = optimize.least_squares(left, np.log([f, zeta]), x_scale=[1e-4, 1e-1])
    variance = 2 * fit.cost / (x.size - 2 * x.shape[0] - 2)
    slopes = np.asarray(fit.jac)
    std = np.sqrt(variance * np.diag(np.linalg.inv(slopes.T @ slopes)))
    return [*fit.x.tolist(), *std.tolist()]


def judge_machines(n_seeds: int, names: tuple[str, ...]) -> Row:
    """Stop simulated stages; count what the intervals of all their modes cover."""
    rows = [row for name in names for k in range(n_seeds) for row in one_machine(name, k)]
    seen = [row for row in rows if row["f_hz"] is not None]
    reasons = [row["refused"] for row in rows if row["f_hz"] is None]
    return {
        "n_modes": len(rows),
        "refused": Counter(sorted(reasons)),
        "n_taken_for_another": sum(row["nearest"] != row["mode"] for row in seen),
        "largest_z": max(abs(row[z]) for row in seen for z in ("z_f", "z_zeta")),
        "f": coverage(np.array([[row["z_f"], 1.0] for row in seen])),
        "zeta": coverage(np.array([[row["z_zeta"], 1.0] for row in seen])),
        "rows": rows,
    }


def coverage(off: np.ndarray, width: float = 1.0) -> Row:
    """Count how many intervals hold the truth, from deviations and standard deviations."""
    hits, n = int(np.sum(np.abs(off[:, 0]) < Z * width * off[:, 1])), len(off)
    low, high = clopper_pearson(hits, n, LEVEL)
    holds = low <= NOMINAL <= high
    return {"n": n, "share": hits / n, "interval": [low, high], "holds": holds}


def claims(answer: Row) -> Iterator[Claim]:
    """Claim coverages, errors over their bound, simulated machines and a real beam."""
    modes = [mode for case in answer["cases"].values() for mode in case["modes"]]
    parts = [mode[quantity] for mode in modes for quantity in ("f", "zeta")]
    held = sum(part["coverage"]["holds"] for part in parts)
    squares = [part["least_squares"]["share"] for part in parts if "least_squares" in part]
    shares = [part["coverage"]["share"] for part in parts]
    yield Claim(
        "cases whose 95 % intervals of f and ζ cover",
        f"{held} of {len(parts)} ({percents(shares)})",
        f"99.9 %, {answer['n_seeds']} logs each",
        f"least squares cover {percents(squares)}",
        held == len(parts),
    )
    yield Claim(
        "root mean square error over the Cramér-Rao bound",
        span(part["rmse_over_bound"] for part in parts),
    )
    for width, label in (("narrow", "1.5 times as narrow"), ("wide", "1.5 times as wide")):
        found = answer["controls_found_out"][width]
        caught, of = found.split(" of ")
        yield Claim(
            f"cases in which intervals {label} are detected (control)", found, met=caught == of
        )
    machines = answer["machines"]
    yield Claim(
        "95 % intervals of f and ζ of stopped machines hold the truth",
        percents(machines[q]["share"] for q in ("f", "zeta")),
        f"{percents(machines['f']['interval'])} (f, 99.9 %)",
        f"{machines['n_taken_for_another']} of {machines['n_modes']} modes taken for another",
        all(machines[q]["holds"] for q in ("f", "zeta")),
    )
    seen = [row for row in answer["beam"] if row["f_hz"] is not None]
    off = max(abs(row["f_hz"] - row["reference_hz"]) for row in seen)
    yield Claim(
        "a real beam: dwells identified, and their largest error",
        f"{len(seen)} of {len(answer['beam'])}, {off:.2f} Hz",
        "",
        "0.15 Hz required",
        off < 0.15,
    )


if __name__ == "__main__":
    main()
