"""Do intervals from free decays cover, and what do they say of a real beam?

Question
    After every stop a machine rings, while something still shakes it: do 95 % intervals of
    natural frequency and damping ratio from `identify_decays` cover 95 of 100 truths, how near
    does their scatter come to the Cramér-Rao bound, and does a real beam whose stiffness is
    changed in known steps give the frequencies known of it?
Method
    Decays of one to three modes after one to eight stops, with the ambient response of the same
    modes and white noise, 400 logs of each case with seeds of their own. A coverage passes when
    its 99.9 % Clopper-Pearson interval holds 95 %. Negative controls that must fail on the same
    logs: the same intervals halved; least squares in white noise, which knows nothing of the
    ambient response. Scatter is set against `decay_bound`, which knows each mode to be alone.
    The beam is the movable-roller testbed DROPBEAR (data set 8): its dwells are cut from the
    measured position of the roller, and the beam's mode is sought in each within 30 % of 33 Hz
    with a damping of 0.2 % within a factor of six; frequencies to compare with were estimated by
    another method (Welch and least squares) and are good to 0.15 Hz.
Run time
    About five minutes on two processors.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
import zlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize

from lmshealth import read_log
from lmshealth.bounds import decay_bound
from lmshealth.decay import identify_decays
from lmshealth.logs import Channel, Log, Metadata
from lmshealth.readers import load_columns
from lmshealth.stage import Description, ModeSpec, Stage
from studies.decays.dwells import COLUMN_MAP, find_dwells
from studies.record import Stopwatch, clopper_pearson, keep

HERE = Path(__file__).parent
LEVEL, Z = 0.999, 1.959963984540054
NOMINAL = 0.95
RATE, NOISE = 400.0, 0.02
# Volts of the roller and Hz of the beam, and how far an estimate may be off.
TABLE = {1.227: 26.25, 1.648: 28.22, 2.085: 30.81, 2.505: 33.90, 2.935: 37.55, 3.367: 41.98}
TOLERANCE, UP_AND_DOWN = 0.15, 0.1
BEAM = ModeSpec("beam", 33.0, 0.002, search=0.3)


@dataclass(frozen=True)
class Case:
    """Stops of a machine.

    Attributes
    ----------
    name : str
        What it is about.
    modes : tuple of (float, float)
        Natural frequency in Hz and damping ratio.
    n_stops : int
        Decays in a log.
    seconds : float
        Length of each.
    ambient : float
        Standard deviation of the ambient response over the amplitude right after a stop.
    n_channels : int
        Channels with independent noise; shapes alternate in sign.
    """

    name: str
    modes: tuple[tuple[float, float], ...]
    n_stops: int = 1
    seconds: float = 1.0
    ambient: float = 0.03
    n_channels: int = 1

    def shapes(self) -> np.ndarray:
        """Amplitude of each mode in each channel, shape ``(n_modes, n_channels)``."""
        return np.array([
            [(-1.0) ** (i * c) * (1 - 0.2 * c) for c in range(self.n_channels)]
            for i in range(len(self.modes))
        ])  # fmt: skip


CASES = (
    Case("0.1 %, one stop", ((60.37, 0.001),)),
    Case("1 %, one stop", ((60.37, 0.01),)),
    Case("3 %, one stop", ((60.37, 0.03),)),
    Case("0.1 %, five stops", ((60.37, 0.001),), n_stops=5, ambient=0.1),
    Case("1 %, five stops", ((60.37, 0.01),), n_stops=5, ambient=0.1),
    Case("two modes 2 Hz apart, 0.5 %", ((60.37, 0.005), (62.4, 0.005)), n_stops=4, n_channels=2),
    Case(
        "three guide modes, half a second",
        ((105.0, 0.015), (120.0, 0.02), (135.0, 0.025)),
        n_stops=8, seconds=0.5, n_channels=2,
    ),
)  # fmt: skip
# Without an ambient response: to be told, not to be passed. One stop cannot rule it out.
QUIET = (Case("1 %, one stop", ((60.37, 0.01),), ambient=0.0),
         Case("1 %, five stops", ((60.37, 0.01),), n_stops=5, ambient=0.0))  # fmt: skip


def main() -> None:
    """Run the study; ``--quick`` does 48 logs of two cases and records nothing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seeds", type=int, default=400)
    options = parser.parse_args()
    watch = Stopwatch()
    cases = (CASES[1], CASES[5]) if options.quick else CASES
    n_seeds = 48 if options.quick else options.seeds
    # Two workers fill two cores: threads inside linear algebra would get in their way.
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = {case: pool.map(one_log, [case] * n_seeds, range(n_seeds), chunksize=8)
                 for case in cases}  # fmt: skip
        quiet = {case: pool.map(one_log, [case] * n_seeds, range(n_seeds), chunksize=8)
                 for case in (() if options.quick else QUIET)}  # fmt: skip
        coverage = {case.name: summarise(case, list(rows)) for case, rows in found.items()}
        without = {case.name: summarise(case, list(rows)) for case, rows in quiet.items()}
    folder = os.environ.get("LMSHEALTH_DATA")
    repeats = range(1 if options.quick else 3)
    beam = [row for k in repeats for row in one_beam(Path(folder), k)] if folder else []
    answer = {
        "n_seeds": n_seeds,
        "coverage": coverage,
        "without_ambient_response": without,
        "beam": beam,
        "passed": judge(coverage, beam, recorded=not options.quick),
    }
    print(json.dumps(answer, indent=1))
    if not options.quick:
        keep(HERE / "result.json", __doc__.split("\n")[0], answer, watch)
    if not all(answer["passed"].values()):
        raise SystemExit(f"not as asked: {answer['passed']}")


def judge(
    coverage: dict[str, Any], beam: list[dict[str, Any]], *, recorded: bool
) -> dict[str, bool]:
    """Say what holds of the intervals, of their negative controls, and of the beam."""
    parts = [m[q] for case in coverage.values() for m in case["modes"] for q in ("f", "zeta")]
    passed = {
        "intervals cover": all(part["holds"] for part in parts),
        "halved intervals do not": not any(part["halved_holds"] for part in parts),
    }
    if recorded:
        squares = [part["least_squares"] for part in parts if "least_squares" in part]
        passed["white-noise least squares do not"] = not any(part["holds"] for part in squares)
    return passed | (judge_beam(beam) if beam else {})


def judge_beam(beam: list[dict[str, Any]]) -> dict[str, bool]:
    """Say whether every dwell is right or refused, and the first one refused."""
    seen = [row for row in beam if row["f_hz"] is not None]
    places = {(row["repeat"], row["reference_hz"]): [] for row in seen}
    for row in seen:
        places[row["repeat"], row["reference_hz"]].append(row["f_hz"])
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
        "most dwells are told": len(seen) > 0.8 * (len(beam) - len({r["repeat"] for r in beam})),
    }


def simulate(case: Case, rng: np.random.Generator) -> np.ndarray:
    """Make the accelerations after each stop, shape ``(n_stops, n_channels, n_samples)``."""
    n = round(case.seconds * RATE)
    t = np.arange(n) / RATE
    x = NOISE * rng.standard_normal((case.n_stops, case.n_channels, n))
    for shape, (f, zeta) in zip(case.shapes(), case.modes, strict=True):
        omega = 2 * np.pi * f
        for stop in x:
            phase = rng.uniform(0, 2 * np.pi)
            wave = np.exp(-zeta * omega * t)
            wave *= np.cos(omega * np.sqrt(1 - zeta**2) * t + phase)
            stop += np.outer(shape, wave + shaken(rng, f, zeta, case.ambient, n))
    return x


def shaken(rng: np.random.Generator, f: float, zeta: float, std: float, n: int) -> np.ndarray:
    """Make the response of a mode to a white force: a stretch of a circle longer than its memory."""
    size = 1 << int(np.ceil(np.log2(3 * n + 2 * RATE / (zeta * f))))
    hertz = np.arange(size // 2 + 1) * RATE / size
    response = hertz**2 / (f**2 - hertz**2 + 2j * zeta * f * hertz)
    force = rng.standard_normal((2, hertz.size))
    circle = np.fft.irfft(response * (force[0] + 1j * force[1]), size)
    # The variance of the part around the resonance is π f S / (4 ζ).
    psd = 2 * 2 / (size * RATE)
    return np.asarray(circle[:n] * std / np.sqrt(np.pi * f * psd / (4 * zeta)))


def to_log(x: np.ndarray) -> Log:
    """Join stops to a log whose pieces are one decay each."""
    n_stops, n_channels, n = x.shape
    return Log(
        name="simulated",
        digest="0" * 64,
        metadata=Metadata(),
        sample_rate=RATE,
        channels=tuple(
            Channel(f"acc_{c}", "acceleration", x[:, c].ravel()) for c in range(n_channels)
        ),
        reference_velocity=None,
        pieces=tuple((k * n, (k + 1) * n) for k in range(n_stops)),
        refused=(),
    )


def one_log(case: Case, seed: int) -> dict[str, Any]:
    """Identify one log; return estimates, standard deviations or the reason of each mode."""
    rng = np.random.default_rng([seed, zlib.crc32(f"{case.name}/{case.ambient}".encode())])
    x = simulate(case, rng)
    # The description is off by what wear and other people's estimates are off by.
    description = Description(
        name="decays",
        mode=tuple(ModeSpec(f"mode {f}", 1.01 * f, 1.4 * zeta, search=0.1)
                   for f, zeta in case.modes),
    )  # fmt: skip
    found = identify_decays(to_log(x), Stage(description, None, "0" * 64))
    n = len(found.names)
    std = np.sqrt(np.diag(found.cov))
    row: dict[str, Any] = {refusal.mode: refusal.reason for refusal in found.refused}
    for i, name in enumerate(found.names):
        row[name] = [found.ln_frequency[i], found.ln_damping[i], std[i], std[n + i]]
    if len(case.modes) == 1 and case.n_channels == 1:
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
    std = np.sqrt(variance * np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    return [*fit.x.tolist(), *std.tolist()]


def summarise(case: Case, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Count what intervals cover, and set scatter against the bound."""
    shapes, modes = case.shapes(), []
    for i, (f, zeta) in enumerate(case.modes):
        kept = [row[f"mode {f}"] for row in rows if not isinstance(row[f"mode {f}"], str)]
        reasons = [row[f"mode {f}"] for row in rows if isinstance(row[f"mode {f}"], str)]
        mode: dict[str, Any] = {
            "f_hz": f,
            "zeta": zeta,
            "refused": {reason: reasons.count(reason) for reason in sorted(set(reasons))},
        }
        bound = np.sqrt(np.diag(bound_of(case, shapes[i], f, zeta)))
        for k, quantity in enumerate(("f", "zeta")):
            truth = np.log((f, zeta)[k])
            mode[quantity] = judged(np.array(kept)[:, [k, 2 + k]], truth)
            mode[quantity]["rmse_over_bound"] = mode[quantity]["rmse"] / float(bound[k])
            if "least squares" in rows[0]:
                squares = np.array([row["least squares"] for row in rows])[:, [k, 2 + k]]
                mode[quantity]["least_squares"] = judged(squares, truth)
        modes.append(mode)
    return {"ambient": case.ambient, "stops": case.n_stops, "seconds": case.seconds, "modes": modes}


def bound_of(case: Case, shape: np.ndarray, f: float, zeta: float) -> np.ndarray:
    """Bound the covariance of a mode that is alone in its band."""
    amplitude = np.tile(shape + 0j, (case.n_stops, 1))
    # Decays begin at random phases, of which the bound is nearly free: one in the middle is taken.
    amplitude *= np.exp(1j * np.linspace(0, np.pi, case.n_stops, endpoint=False))[:, None]
    reach = max(20.0, 8 * zeta * f)
    return decay_bound(
        f, zeta, amplitude, np.full(case.n_channels, NOISE**2 * 2 / RATE),
        case.ambient**2 * 4 * zeta / (np.pi * f),
        duration=case.seconds, band=(f - reach, min(f + reach, 0.48 * RATE)),
    )  # fmt: skip


def judged(found: np.ndarray, truth: float) -> dict[str, Any]:
    """Count how many intervals hold the truth, whole and halved."""
    off, std = found[:, 0] - truth, found[:, 1]
    hits, halved = (int(np.sum(np.abs(off) < Z * share * std)) for share in (1.0, 0.5))
    interval = clopper_pearson(hits, off.size, LEVEL)
    low, high = clopper_pearson(halved, off.size, LEVEL)
    return {
        "n": off.size,
        "coverage": hits / off.size,
        "coverage_interval": interval,
        "holds": bool(interval[0] <= NOMINAL <= interval[1]),
        "halved_coverage": halved / off.size,
        "halved_holds": bool(low <= NOMINAL <= high),
        "rmse": float(np.sqrt(np.mean(off**2))),
        "median_std": float(np.median(std)),
        "bias_over_std": float(np.mean(off / std)),
    }


def one_beam(folder: Path, repeat: int) -> list[dict[str, Any]]:
    """Identify the beam in every dwell of one repeat."""
    with tempfile.TemporaryDirectory() as scratch:
        path, columns = Path(scratch) / "steps.csv.gz", Path(scratch) / "columns.toml"
        shutil.copy(folder / f"dropbear_ds8/open/10steps_test{repeat}.txt.gz", path)
        columns.write_text(COLUMN_MAP, encoding="utf-8")
        log = read_log(path, columns=load_columns(columns))
    stage = Stage(Description(name="beam", mode=(BEAM,)), None, "0" * 64)
    rows = []
    for k, (dwell, volts) in enumerate(find_dwells(log)):
        found = identify_decays(log, stage, segments=[dwell], channels=("acc_low", "acc_high"))
        reference = TABLE[min(TABLE, key=lambda v: abs(v - volts))]
        row: dict[str, Any] = {
            "repeat": repeat,
            "dwell": k,
            "roller_v": round(volts, 4),
            "seconds": round((dwell.stop - dwell.start) / log.sample_rate, 3),
            "reference_hz": reference,
        }
        if found.names:
            row |= {
                "f_hz": float(found.frequency[0]),
                "f_std_hz": float(found.frequency_std[0]),
                "off_hz": float(found.frequency[0] - reference),
                "zeta": float(found.damping_ratio[0]),
                "zeta_std": float(found.damping_ratio_std[0]),
                "refused": "",
            }
        else:
            row |= {"f_hz": None, "refused": found.refused[-1].reason}
        rows.append(row)
    return rows


if __name__ == "__main__":
    main()
