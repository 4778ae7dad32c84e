"""How weak a line may be: alone, beside a strong one, in short strokes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.stats import ncx2

from lmshealth import load_stage, read_log
from lmshealth.io.log import Log
from lmshealth.signal.segments import find_segments
from lmshealth.signal.spectral_lines import find_lines, find_lines_by_velocity
from models.dynamics.stages import STAGES, stage_named
from models.recordings.formats import write_log
from models.recordings.strokes import full_stroke, record_strokes
from studies.harness.study import Row
from studies.line_test.signals import (
    BAND,
    FLOOR,
    RATE,
    Array,
    Density,
    amplitude,
    flat,
    make_log,
    noise,
    resonances,
    sine,
)
from studies.line_test.trials import SHORT, USUAL, rated, rng_of, tested

STRENGTHS = tuple(range(8, 33, 2))
CONTRASTS, GAPS = (20, 30), (4.5, 6.0, 8.0, 10.0, 14.0, 20.0)
STROKES, STROKE, STROKE_DB = (1, 2, 4, 8, 16, 32), 0.5, 8.0


def detection(n: int, long: float) -> dict[str, list[Row]]:
    """Find a line of every strength in three kinds of noise, and tell its errors."""
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
    rng = rng_of(3, k, round(ratio_db))
    off: list[tuple[float, float]] = []
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
    error = np.sqrt(np.mean(np.square(off), axis=0)) if len(off) > 1 else np.full(2, np.nan)
    return {
        "ratio_db": ratio_db,
        "n": n,
        "share_found": len(off) / n,
        # Of |X|² / S, exponential under noise, for a detector that knows the density: one that
        # knows the frequency, and one that has as many to look at.
        "best_known_frequency": float(ncx2.sf(-2 * np.log(USUAL), 2, 2 * ratio)),
        "best_any_frequency": float(ncx2.sf(-2 * np.log(USUAL / n_tests), 2, 2 * ratio)),
        "rms_error_ordinates": None if len(off) < 2 else float(error[0]),
        "bound_error_ordinates": float(np.sqrt(6 / ratio) / (2 * np.pi)),
        "rms_error_amplitude": None if len(off) < 2 else float(error[1]),
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
                hits += bool(away.size) and away.min() < 0.5 / SHORT
            rows.append({"contrast_db": contrast, "gap": gap, "n": n, "share_found": hits / n})
    return rows


def unsteady(rng: np.random.Generator, kind: str, ratio_db: float) -> Array:
    """Make a strong line that does not quite keep frequency or amplitude."""
    time = np.arange(round(SHORT * RATE)) / RATE
    start = rng.uniform(0, 2 * np.pi)
    phase, size = np.zeros(time.size), np.ones(time.size)
    if kind == "wanders":
        # As mains do: by 20 mHz in 25 s.
        phase = 0.5 * np.sin(2 * np.pi * time / 25 + start)
    elif kind == "drifts":
        phase = 2 * np.pi * 0.125 * (time / SHORT) ** 2  # by a quarter of an ordinate
    elif kind == "fades":
        size = 1 - 0.1 * time / SHORT
    elif kind == "halves":
        size = 0.5 ** (time / SHORT)
    f = rng.uniform(60, 350)
    line = size * np.sin(2 * np.pi * f * time + phase + start)
    return np.asarray(amplitude(ratio_db, FLOOR, SHORT) * line)


def satellites(n: int) -> list[Row]:
    """Count how often a strong line alone shows a second one."""
    rows = []
    for i, kind in enumerate(("steady", "wanders", "drifts", "fades", "halves")):
        for k, ratio_db in enumerate((40.0, 80.0)):
            rng, hits, none = rng_of(5, i, k), 0, 0
            for _ in range(n):
                values = noise(rng, flat, SHORT) + unsteady(rng, kind, ratio_db)
                found = len(tested(values, USUAL))
                hits, none = hits + (found > 1), none + (found == 0)
            rows.append({"line": kind, "ratio_db": ratio_db, "share_missed": none / n,
                         **rated(hits, n, USUAL)})  # fmt: skip
    return rows


def strokes(n: int) -> list[Row]:
    """Find an order of the velocity in strokes of half a second, together and each alone."""
    rows = []
    for count in STROKES:
        rng, together, alone = rng_of(6, count), 0, 0
        for _ in range(n):
            log, f = stroke_log(rng, count)
            (channel,), segments = log.channels, find_segments(log, 0.2)
            found = find_lines_by_velocity(log, log.channels, None, BAND, USUAL)
            together += any(abs(line.frequency - f) < 0.5 / STROKE for line in found)
            for segment in segments:
                own = find_lines(channel, (segment,), RATE, BAND, USUAL / len(segments))
                if np.any(np.abs(own[:, 0] - f) < 0.5 / STROKE):
                    alone += 1
                    break
        rows.append({"strokes": count, "ratio_db": STROKE_DB, "n": n,
                     "together": together / n, "alone": alone / n})  # fmt: skip
    return rows


def stroke_log(rng: np.random.Generator, count: int) -> tuple[Log, float]:
    """Make strokes to and fro, at rest between, with a line of one frequency in all of them."""
    f = rng.uniform(60, 350)
    rest = np.zeros(round(0.3 * RATE))
    moving = np.ones(round(STROKE * RATE))
    velocity = [rest]
    line = [rest]
    for k in range(count):
        velocity += [0.2 * (-1) ** k * moving, rest]
        size = amplitude(STROKE_DB, FLOOR, STROKE)
        line += [sine(STROKE, f, size, rng.uniform(0, 2 * np.pi)), rest]
    sweep = np.concatenate(velocity)
    values = noise(rng, flat, sweep.size / RATE) + np.concatenate(line)
    return make_log(values, sweep), f


def simulated_strokes() -> list[Row]:
    """Tell what the strokes of the simulated stages show together, and each on its own."""
    rows = []
    for name in STAGES:
        for speed in (0.2, 0.4):
            profile = replace(full_stroke(stage_named(name), speed), strokes=40, dwell=0.3)
            rng = rng_of(9, round(10 * speed), len(rows))
            with TemporaryDirectory() as folder:
                path = Path(folder) / "log.h5"
                recording = record_strokes(
                    stage_named(name), profile=profile, seconds=20.0, rng=rng
                )
                write_log(recording, path, "hdf5")
                log = read_log(path)
            channels = [c for c in log.channels if c.kind == "acceleration"]
            segments, alone = find_segments(log, 0.2), []
            for channel in channels:
                for segment in segments:
                    share = USUAL / len(segments)
                    found = find_lines(channel, (segment,), log.sample_rate, (10.0, 400.0), share)
                    alone += [(channel.name, round(f, 2)) for f, _ in found.tolist()]
            together = find_lines_by_velocity(log, channels, load_stage(name), (10.0, 400.0), USUAL)
            rows.append(
                {
                    "stage": name,
                    "velocity_m_s": speed,
                    "strokes": len(segments),
                    "alone": alone,
                    "together": [(x.channel, round(x.frequency, 2), x.kind) for x in together],
                }
            )
    return rows
