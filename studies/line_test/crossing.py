"""How far lines on a mode move its frequency, with lines kept out and without."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np

from lmshealth import identify
from lmshealth.modal import constants
from lmshealth.signal import tone_removal as tones
from lmshealth.stage.description import Description, ModeSpec, Order, Stage
from studies.harness.study import Row
from studies.line_test.signals import (
    FLOOR,
    RATE,
    Array,
    amplitude,
    make_log,
    noise,
    resonances,
    sine,
)
from studies.line_test.trials import rng_of

MODE, DAMPING, HEIGHT_DB = 105.0, 0.02, 30.0
PEAK = FLOOR * (1 + 10 ** (HEIGHT_DB / 10))
SECONDS = 60.0
# Amplitude of the line over that of a sine whose ordinate is as high as the mode's peak.
CROSSINGS = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0)
PLACES_ON_MODE = (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0)  # half-widths from the peak


def mode_log(rng: np.random.Generator) -> Array:
    """Make a minute of a mode 30 dB above the noise."""
    return noise(rng, resonances(DAMPING, HEIGHT_DB, (MODE,)), SECONDS)


def stage() -> Stage:
    """Return a description that looks for the mode."""
    spec = ModeSpec("mode", MODE, DAMPING, search=0.15)
    description = Description(name="study", mode=(spec,), order=(Order("ball pass", 4.0),))
    return Stage(description, None, "0" * 64)


def estimate(values: Array, velocity: Array | None = None) -> tuple[float, float]:
    """Return ln f of the mode and its standard deviation; NaN where it is refused."""
    found = identify(make_log(values, velocity), stage())
    if found.names != ("mode",):
        return np.nan, np.nan
    return float(found.ln_frequency[0]), float(np.sqrt(found.cov[0, 0]))


def modes(
    n: int,
    crossings: tuple[float, ...] = CROSSINGS,
    places: tuple[float, ...] = PLACES_ON_MODE,
) -> Row:
    """Tell by how many σ lines on a mode move it, with lines kept out and without."""
    rows = []
    for seed in range(n):
        rng = rng_of(7, seed)
        clean = mode_log(rng)
        at, std = estimate(clean)
        for times in crossings:
            # As strong as so many times a sine whose ordinate is the mode's peak.
            size = times * amplitude(0.0, PEAK, SECONDS)
            for offset in places:
                f = MODE * (1 + offset * DAMPING) + rng.uniform(-0.5, 0.5) / SECONDS
                values = clean + sine(SECONDS, f, size, rng.uniform(0, 2 * np.pi))
                rows.append({"times_peak": times, "half_widths": offset, "seed": seed,
                             **moves(values, at, std)})  # fmt: skip
    sweep = [orders(seed, times) for seed in range(n) for times in crossings]
    return {
        "strengths": [strength_of_moves(rows + sweep, times) for times in crossings],
        "rows": rows,
        "orders": sweep,
    }


def strength_of_moves(rows: list[Row], times: float) -> Row:
    """Sum up the moves by lines of one strength; a mode that is refused is not in its place."""
    own = [row for row in rows if row["times_peak"] == times]
    answer: Row = {"times_peak": times, "n": len(own)}
    for suffix in ("", "_with_lines_left_in"):
        moved = [row["moved" + suffix] for row in own]
        kept = np.abs([move for move in moved if move is not None])
        answer["refused" + suffix] = len(own) - kept.size
        answer["share_in_place" + suffix] = float(np.sum(kept < 1) / len(own))
        answer["rms" + suffix] = float(np.sqrt(np.mean(kept**2))) if kept.size else None
        answer["largest" + suffix] = float(kept.max()) if kept.size else None
    return answer


def moves(values: Array, at: float, std: float, velocity: Array | None = None) -> Row:
    """Return how many σ a mode has moved, with lines kept out and without."""
    moved = (estimate(values, velocity)[0] - at) / std
    # Strong lines are taken out of the transforms, and weak ones masked.
    with (
        patch.object(tones, "_TOWERING", np.inf),
        patch.object(constants, "LINE_FALSE_ALARM", 0.0),
    ):
        bare = (estimate(values, velocity)[0] - at) / std
    return {
        "moved": None if np.isnan(moved) else moved,
        "moved_with_lines_left_in": None if np.isnan(bare) else bare,
    }


def orders(seed: int, times: float) -> Row:
    """Let an order of the velocity cross the mode: six moves, each a little faster."""
    rng = rng_of(8, seed, round(10 * times))
    speeds = 0.004 * MODE * np.linspace(0.96, 1.04, 6)
    part = SECONDS / speeds.size
    velocity = np.repeat(speeds, round(part * RATE))
    clean = mode_log(rng)
    at, std = estimate(clean, velocity)
    size = times * amplitude(0.0, PEAK, part)
    line = np.concatenate([sine(part, v / 0.004, size, 1.0) for v in speeds.tolist()])
    return {"times_peak": times, "seed": seed, **moves(clean + line, at, std, velocity)}
