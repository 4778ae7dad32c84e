"""Faults of samples: overflows, bad and lost samples, lost signs, missing levels, empty fits."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

from studies.inputs.outside_faults.case import Case, Program, Seen, is_traceback, last_line

RATE, SECONDS, FREQUENCY, DAMPING = 2000, 30, 96.0, 0.02
Array = np.ndarray


def vibration(seed: int = 0) -> tuple[Array, Array]:
    """Make a mode of 96 Hz and 2 % in two channels with noise, ``(n_samples,)`` each."""
    rng = np.random.default_rng(seed)
    pole = np.exp(2 * np.pi * FREQUENCY / RATE * (-DAMPING + 1j * math.sqrt(1 - DAMPING**2)))
    x = lfilter([1], np.poly([pole, pole.conj()]), rng.standard_normal(RATE * SECONDS))
    x = x / x.std()
    one, other = (0.1 * rng.standard_normal(x.size) for _ in range(2))
    return x + one, -0.6 * x + other


def write(path: Path, channels: dict[str, Array], time: Array | None = None) -> Path:
    """Write a log of accelerations in m/s²."""
    columns = {f"acc_{name}_m_s2": values for name, values in channels.items()}
    if time is not None:
        columns = {"time_s": time, **columns}
    head = ("" if time is not None else f"# sample_rate_hz: {RATE}\n") + ",".join(columns)
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=head, comments="")
    return path


def ask(program: Program, path: Path, reason: str, channel: str = "") -> Seen:
    """Ask for the mode: right within 3 standard deviations, with the reason in the answer.

    Where a channel is named it must be refused, or the mode have the reason as a flag.
    """
    answer = program.json("modes", path, "--band", "60", "150")
    found = [one for one in answer.get("modes", []) if abs(one["frequency_hz"] - FREQUENCY) < 3]
    reasons = {row["reason"] for row in answer.get("refused", [])}
    if not found:
        return Seen(reason in reasons and bool(channel), f"no mode; {', '.join(sorted(reasons))}")
    best = found[0]
    z = (best["damping_ratio"] - DAMPING) / best["damping_ratio_std"]
    text = f"{100 * best['damping_ratio']:.2f} ± {100 * best['damping_ratio_std']:.2f} %"
    named = reason in reasons or (not reason and not reasons)
    others = len(answer["modes"]) - 1
    return Seen(named and abs(z) < 3 and not others, f"{text}, {others} more; {sorted(reasons)}")


Damage = Callable[[Array, Array], dict[str, Array]]


def _case(name: str, right: str, reason: str, damage: Damage, channel: str = "") -> Case:
    def fault(program: Program, folder: Path) -> Seen:
        return ask(program, write(folder / "log.csv", damage(*vibration())), reason, channel)

    return Case("samples", name, right, fault, control)


def control(program: Program, folder: Path) -> Seen:
    """Ask for the mode of the log without fault, in steps of a converter of 14 bits."""
    x, y = vibration()
    steps = np.round(x / 1e-3) * 1e-3
    return ask(program, write(folder / "log.csv", {"x": steps, "y": y}), "")


def wrapped(bits: int, turns: float) -> Damage:
    """Let a counter overflow whose range is so many times too small."""

    def damage(x: Array, y: Array) -> dict[str, Array]:
        whole = 2**bits
        step = 2 * np.abs(x).max() / whole / turns
        counts = np.round(x / step).astype(np.int64)
        return {"x": ((counts + whole // 2) % whole - whole // 2) * step, "y": y}

    return damage


def spiked(x: Array, y: Array) -> dict[str, Array]:
    """Add thirty single bad samples to each channel."""
    rng = np.random.default_rng(1)
    for own in (x, y):
        at = rng.choice(own.size, 30, replace=False)
        own[at] += 20 * rng.choice([-1.0, 1.0], 30)
    return {"x": x, "y": y}


def lost(share: float, length: int, *, each: bool) -> Damage:
    """Lose samples at random in gaps of a length, in each channel elsewhere or in all."""

    def damage(x: Array, y: Array) -> dict[str, Array]:
        rng = np.random.default_rng(2)
        n = int(share * x.size / length)
        starts = rng.integers(0, x.size - length, (2, n))
        for own, at in zip((x, y), starts if each else starts[[0, 0]], strict=True):
            for start in at.tolist():
                own[start : start + length] = np.nan
        return {"x": x, "y": y}

    return damage


def dropped(program: Program, folder: Path) -> Seen:
    """Drop samples in gaps of one to three, with time stamps."""
    rng = np.random.default_rng(3)
    x, y = vibration()
    kept = np.ones(x.size, dtype=bool)
    for start in rng.integers(0, x.size - 3, 250).tolist():
        kept[start : start + int(rng.integers(1, 4))] = False
    time = np.flatnonzero(kept) / RATE
    return ask(program, write(folder / "log.csv", {"x": x[kept], "y": y[kept]}, time), "gaps")


def outside(name: str, judge: Callable[[dict[str, Any]], bool], *options: str) -> Any:
    """Ask for the modes of a file of `LMSHEALTH_DATA`."""

    def fault(program: Program, folder: Path) -> Seen:
        path = Path(os.environ["LMSHEALTH_DATA"]) / "outside_faults" / name
        done = program("modes", path, *options)
        if is_traceback(done):
            return Seen(False, last_line(done.stderr))
        answer = program.json("modes", path, *options)
        damping = [
            f"{100 * m['damping_ratio']:.2f} ± {100 * m['damping_ratio_std']:.2f} %"
            for m in answer["modes"]
        ]
        return Seen(judge(answer), ", ".join(damping) or last_line(done.stdout))

    return fault


def is_klipper_right(answer: dict[str, Any]) -> bool:
    """Return whether the upper mode has the right damping, and no absurd signal-to-noise ratio."""
    upper = [m for m in answer["modes"] if 70 < m["frequency_hz"] < 85]
    return all(
        abs(m["damping_ratio"] - 0.0238) < 3 * m["damping_ratio_std"] and m["snr"] < 1e5
        for m in upper
    ) and bool(upper)


RIGHT = "2.00 % within 3 σ"
CASES: tuple[Case, ...] = (
    _case("a 16 bit counter overflows a few times", RIGHT, "unwrapped", wrapped(16, 1.05)),
    _case("a 12 bit counter overflows often", RIGHT, "unwrapped", wrapped(12, 1.6)),
    _case("thirty bad samples", RIGHT, "spikes", spiked),
    _case("0.5 % lost, single, each channel", RIGHT, "gaps", lost(0.005, 1, each=True)),
    _case("3 % lost in gaps of 5, both", RIGHT, "gaps", lost(0.03, 5, each=False)),
    Case("samples", "dropped samples with stamps", RIGHT, dropped, control),
    _case(
        "magnitude of one channel", "refused: rectified", "rectified",
        lambda x, y: {"x": np.abs(x), "y": y},
    ),
    _case(
        "magnitude beside its axes", "refused: dependent", "dependent",
        lambda x, y: {"x": x, "y": y + 9.81, "r": np.round(np.hypot(x, y + 9.81), 4)},
    ),
    _case(
        "a third of a step of noise", "flagged or refused: levels", "levels",
        lambda x, y: {"x": np.round(x * 0.3), "y": y}, "x",
    ),
    Case(
        "samples", "many short pieces", "2.38 % within 3 σ, SNR below 1e5",
        outside("klipper_lost_random.csv", is_klipper_right), control,
    ),
    Case(
        "samples", "a band with nothing to fit", "modes, or none; no traceback",
        outside("crash_zero_weights.csv", lambda answer: True, "--band", "22", "45"), control,
    ),
)  # fmt: skip
