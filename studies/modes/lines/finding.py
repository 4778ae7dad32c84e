"""How weak a line may be, alone and in company, and how far lines move a mode."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
from scipy.stats import ncx2

from lmshealth import identify
from lmshealth.modal import constants as modal_constants
from lmshealth.modal import identification
from lmshealth.modal.ambient import cluster_fit
from lmshealth.signal import constants as signal_constants
from lmshealth.signal.segments import find_segments
from lmshealth.signal.spectral_lines import find_lines, find_lines_by_velocity
from lmshealth.stage.description import Description, ModeSpec, Order, Stage
from studies.harness.study import Row
from studies.modes.lines.signals import (
    BAND,
    FLOOR,
    RATE,
    SHORT,
    USUAL,
    Array,
    Density,
    amplitude,
    flat,
    make_log,
    noise,
    rated,
    resonances,
    rng_of,
    sine,
    tested,
)

STRENGTHS = tuple(range(8, 33, 2))
CONTRASTS, GAPS = (20, 30), (4.5, 6.0, 8.0, 10.0, 14.0, 20.0)
STROKES, STROKE, STROKE_DB = (1, 2, 4, 8, 16, 32), 0.5, 8.0
MODE, DAMPING, HEIGHT_DB, SECONDS = 105.0, 0.02, 30.0, 60.0
PEAK = FLOOR * (1 + 10 ** (HEIGHT_DB / 10))
# Amplitude of the line over that of a sine whose ordinate is as high as the mode's peak.
CROSSINGS = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0)
PLACES_ON_MODE = (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0)  # half-widths from the peak
_ORDER_STEP = 0.004  # the line "ball pass" has a period of 4 mm


def detection(n: int, long: float) -> dict[str, list[Row]]:
    """Find a line of every strength in three kinds of noise, with its errors."""
    on_peak = resonances(0.002, 40, (166.7,))
    kinds = {
        "white, 3 s": (SHORT, flat, None),
        f"white, {long:g} s": (long, flat, None),
        "peak of a resonance of 0.2 %, 3 s": (SHORT, on_peak, 166.7),
    }
    return {
        name: [strength(n, k, ratio_db, *kind) for ratio_db in STRENGTHS]
        for k, (name, kind) in enumerate(kinds.items())
    }


def strength(
    n: int, k: int, ratio_db: float, seconds: float, density: Density, place: float | None
) -> Row:
    """Find lines of one strength, somewhere in the band or within an ordinate of a place."""
    rng, off = rng_of(3, k, round(ratio_db)), []
    for _ in range(n):
        f = rng.uniform(30, 400) if place is None else place + rng.uniform(-0.5, 0.5) / seconds
        size = amplitude(ratio_db, float(density(np.array([f]))[0]), seconds)
        values = noise(rng, density, seconds) + sine(seconds, f, size, rng.uniform(0, 2 * np.pi))
        found = tested(values, USUAL)
        near = found[np.abs(found[:, 0] - f) < 1 / seconds]
        if near.size:
            off.append(((near[0, 0] - f) * seconds, near[0, 1] / size - 1))
    ratio = 10 ** (ratio_db / 10)
    n_tests = 4 * (BAND[1] - BAND[0]) * seconds
    error = np.sqrt(np.mean(np.square(off), axis=0)).tolist() if len(off) > 1 else [None, None]
    return {
        "ratio_db": ratio_db,
        "n": n,
        "share_found": len(off) / n,
        # Of |X|² / S, exponential under noise, for a detector that knows the density: one that
        # knows the frequency, and one that has as many to test.
        "best_known_frequency": float(ncx2.sf(-2 * np.log(USUAL), 2, 2 * ratio)),
        "best_any_frequency": float(ncx2.sf(-2 * np.log(USUAL / n_tests), 2, 2 * ratio)),
        "rms_error_ordinates": error[0],
        "bound_error_ordinates": float(np.sqrt(6 / ratio) / (2 * np.pi)),
        "rms_error_amplitude": error[1],
        "bound_error_amplitude": float(np.sqrt(0.5 / ratio)),
    }


def beside(n: int) -> list[Row]:
    """Find a line of 25 dB so many ordinates beside a stronger one."""
    rows = []
    for i, contrast in enumerate(CONTRASTS):
        for k, gap in enumerate(GAPS):
            rng, hits = rng_of(4, i, k), 0
            for _ in range(n):
                f = rng.uniform(60, 350)
                values = noise(rng, flat, SHORT)
                for ratio_db, at in ((25.0 + contrast, f), (25.0, f + gap / SHORT)):
                    size = amplitude(ratio_db, FLOOR, SHORT)
                    values += sine(SHORT, at, size, rng.uniform(0, 2 * np.pi))
                away = np.abs(tested(values, USUAL)[:, 0] - f - gap / SHORT)
                hits += bool(np.any(away < 0.5 / SHORT))
            rows.append({"contrast_db": contrast, "gap": gap, "n": n, "share_found": hits / n})
    return rows


def satellites(n: int) -> list[Row]:
    """Count how often a strong line that does not quite keep frequency or size shows a second."""
    time = np.arange(round(SHORT * RATE)) / RATE
    steady = np.ones(time.size)
    # Mains wander by 20 mHz in 25 s; the drift is a quarter of an ordinate.
    drift = 2 * np.pi * 0.125 * (time / SHORT) ** 2
    kinds = {
        "steady": lambda start: (0 * time, steady),
        "wanders": lambda start: (0.5 * np.sin(2 * np.pi * time / 25 + start), steady),
        "drifts": lambda start: (drift, steady),
        "fades": lambda start: (0 * time, 1 - 0.1 * time / SHORT),
        "halves": lambda start: (0 * time, 0.5 ** (time / SHORT)),
    }
    rows = []
    for i, (kind, unsteady) in enumerate(kinds.items()):
        for k, ratio_db in enumerate((40.0, 80.0)):
            rng, n_found = rng_of(5, i, k), []
            for _ in range(n):
                values, start = noise(rng, flat, SHORT), rng.uniform(0, 2 * np.pi)
                phase, size = unsteady(start)
                line = size * np.sin(2 * np.pi * rng.uniform(60, 350) * time + phase + start)
                values += amplitude(ratio_db, FLOOR, SHORT) * line
                n_found.append(len(tested(values, USUAL)))
            rate = rated(int(np.sum(np.array(n_found) > 1)), n, USUAL)
            rows.append({"line": kind, "ratio_db": ratio_db, **rate})
    return rows


def strokes(n: int) -> list[Row]:
    """Find a line in strokes of half a second, together and each alone."""
    rows = []
    rest, moving = np.zeros(round(0.3 * RATE)), np.ones(round(STROKE * RATE))
    size = amplitude(STROKE_DB, FLOOR, STROKE)
    for count in STROKES:
        rng, together, alone = rng_of(6, count), 0, 0
        for _ in range(n):
            f = rng.uniform(60, 350)
            velocity, line = [rest], [rest]
            for k in range(count):
                velocity += [0.2 * (-1) ** k * moving, rest]
                line += [sine(STROKE, f, size, rng.uniform(0, 2 * np.pi)), rest]
            values = np.concatenate(line)
            log = make_log(noise(rng, flat, values.size / RATE) + values, np.concatenate(velocity))
            segments = find_segments(log, 0.2)
            found = find_lines_by_velocity(log, log.channels, None, BAND, USUAL)
            together += any(abs(line.frequency - f) < 0.5 / STROKE for line in found)
            own = (
                find_lines(log.channels[0], (segment,), RATE, BAND, USUAL / len(segments))
                for segment in segments
            )
            alone += any(np.any(np.abs(lines[:, 0] - f) < 0.5 / STROKE) for lines in own)
        shares = {"together": together / n, "alone": alone / n}
        rows.append({"strokes": count, "ratio_db": STROKE_DB, "n": n, **shares})
    return rows


def mode_log(rng: np.random.Generator) -> Array:
    """Make a minute of a mode 30 dB above the noise."""
    return noise(rng, resonances(DAMPING, HEIGHT_DB, (MODE,)), SECONDS)


def estimate(values: Array, velocity: Array | None = None) -> tuple[float, float]:
    """Return ln f of the mode and its standard deviation; NaN where it is refused."""
    spec, order = ModeSpec("mode", MODE, DAMPING, search=0.15), Order("ball pass", 4.0)
    stage = Stage(Description(name="study", mode=(spec,), order=(order,)), None, "0" * 64)
    found = identify(make_log(values, velocity), stage)
    if found.names != ("mode",):
        return np.nan, np.nan
    return float(found.ln_frequency[0]), float(np.sqrt(found.cov[0, 0]))


def moves(values: Array, at: float, std: float, velocity: Array | None = None) -> Row:
    """Return by how many σ a mode has moved, with lines removed and left in."""
    moved = (estimate(values, velocity)[0] - at) / std
    # Strong lines are removed from the transforms, and weak ones masked.
    with (
        patch.object(signal_constants, "SINUSOID_CONTRAST", np.inf),
        patch.object(modal_constants, "LINE_FALSE_ALARM", 0.0),
        patch.object(identification, "_thomson_lines", lambda *_: []),
        patch.object(cluster_fit, "_COLLAPSED", 0.0),
    ):
        bare = (estimate(values, velocity)[0] - at) / std
    both = {"moved": moved, "moved_with_lines_left_in": bare}
    return {name: None if np.isnan(move) else move for name, move in both.items()}


def modes(
    n: int, crossings: tuple[float, ...] = CROSSINGS, places: tuple[float, ...] = PLACES_ON_MODE
) -> Row:
    """Measure by how many σ lines on a mode move it, with lines removed and left in."""
    rows = []
    for seed in range(n):
        rng = rng_of(7, seed)
        clean = mode_log(rng)
        at, std = estimate(clean)
        for times in crossings:
            size = times * amplitude(0.0, PEAK, SECONDS)
            for offset in places:
                f = MODE * (1 + offset * DAMPING) + rng.uniform(-0.5, 0.5) / SECONDS
                values = clean + sine(SECONDS, f, size, rng.uniform(0, 2 * np.pi))
                rows.append({"times_peak": times, **moves(values, at, std)})
    sweep = [orders(seed, times) for seed in range(n) for times in crossings]
    strengths = [strength_of_moves(rows + sweep, times) for times in crossings]
    return {"strengths": strengths, "rows": rows, "orders": sweep}


def orders(seed: int, times: float) -> Row:
    """Let an order of the velocity cross the mode: six moves, each a little faster."""
    rng = rng_of(8, seed, round(10 * times))
    speeds = _ORDER_STEP * MODE * np.linspace(0.96, 1.04, 6)
    part = SECONDS / speeds.size
    velocity = np.repeat(speeds, round(part * RATE))
    clean = mode_log(rng)
    at, std = estimate(clean, velocity)
    size = times * amplitude(0.0, PEAK, part)
    line = np.concatenate([sine(part, v / _ORDER_STEP, size, 1.0) for v in speeds.tolist()])
    return {"times_peak": times, **moves(clean + line, at, std, velocity)}


def strength_of_moves(rows: list[Row], times: float) -> Row:
    """Summarise the moves by lines of one strength; a refused mode is not in its place."""
    own = [row for row in rows if row["times_peak"] == times]
    answer: Row = {"times_peak": times, "n": len(own)}
    for suffix in ("", "_with_lines_left_in"):
        kept = [abs(row["moved" + suffix]) for row in own if row["moved" + suffix] is not None]
        answer["refused" + suffix] = len(own) - len(kept)
        answer["share_in_place" + suffix] = sum(move < 1 for move in kept) / len(own)
    return answer
