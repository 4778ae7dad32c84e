"""How weak a line may be: alone, beside a strong one, in short strokes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.stats import ncx2

from lmshealth import identify, load_stage, read_log
from lmshealth.io.log import Channel, Log, Metadata
from lmshealth.modal import constants as modal_constants
from lmshealth.signal import constants as signal_constants
from lmshealth.signal.segments import Segment, find_segments
from lmshealth.signal.spectral_lines import find_lines, find_lines_by_velocity
from lmshealth.stage.description import Description, ModeSpec, Order, Stage
from models.dynamics.stages import STAGES, stage_named
from models.recordings.formats import write_log
from models.recordings.strokes import full_stroke, record_strokes
from studies.common.metrics import clopper_pearson
from studies.harness.study import Row

MODE, DAMPING, HEIGHT_DB = 105.0, 0.02, 30.0
SECONDS = 60.0
# Amplitude of the line over that of a sine whose ordinate is as high as the mode's peak.
CROSSINGS = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0)
PLACES_ON_MODE = (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0)  # half-widths from the peak
Array = NDArray[np.float64]
Density = Callable[[Array], Array]
RATE = 1000.0
BAND = (10.0, 450.0)
# One-sided density of the noise under all else, in (m/s²)²/Hz.
FLOOR = 0.01
PEAK = FLOOR * (1 + 10 ** (HEIGHT_DB / 10))
# Where resonances stand, in Hz: none at a round number of ordinates, one or two per octave.
PLACES = (25.3, 61.7, 121.4, 239.8, 388.1)
_CIRCLE = 3  # lengths of the record on the circle that it is cut from
SHORT, LONG = 3.0, 30.0
USUAL = 0.01
LEVEL = 0.99

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
    """Return what the strokes of the simulated stages show together, and each on its own."""
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
    n: int, crossings: tuple[float, ...] = CROSSINGS, places: tuple[float, ...] = PLACES_ON_MODE
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
        patch.object(signal_constants, "TOWERING", np.inf),
        patch.object(modal_constants, "LINE_FALSE_ALARM", 0.0),
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


def resonance(f: Array, place: float, damping: float, height_db: float) -> Array:
    """Density of a resonance whose peak stands so far above the floor."""
    x = f / place
    gain = x**4 / ((1 - x**2) ** 2 + (2 * damping * x) ** 2)
    return np.asarray(FLOOR * 10 ** (height_db / 10) * 4 * damping**2 * gain)


def flat(f: Array) -> Array:
    """Density of white noise."""
    return np.full(f.shape, FLOOR)


def coloured(f: Array) -> Array:
    """Density that falls by 30 dB from the bottom of the band, to a floor."""
    return flat(f) * (1 + (300 / np.maximum(f, 1.0)) ** 2)


def resonant(
    f: Array, damping: float, height_db: float, places: tuple[float, ...] = PLACES
) -> Array:
    """Density of white noise with resonances."""
    return flat(f) + sum(resonance(f, place, damping, height_db) for place in places)


def resonances(damping: float, height_db: float, places: tuple[float, ...] = PLACES) -> Density:
    """Return `resonant` as a function of frequency alone."""
    return partial(resonant, damping=damping, height_db=height_db, places=places)


def noise(rng: np.random.Generator, density: Density, seconds: float) -> Array:
    """Make stationary noise: a stretch of a circle on which its spectrum is exact."""
    n = round(seconds * RATE)
    size = 1 << int(np.ceil(np.log2(_CIRCLE * n)))
    f = np.arange(1, size // 2) * RATE / size
    draws = rng.standard_normal((2, f.size))
    spectrum = np.zeros(size // 2 + 1, dtype=complex)
    spectrum[1:-1] = (draws[0] + 1j * draws[1]) * np.sqrt(density(f) * RATE * size / 4)
    return np.asarray(np.fft.irfft(spectrum, size)[:n])


def amplitude(ratio_db: float, density: float, seconds: float) -> float:
    """Amplitude of a line whose ordinate stands so far above the density: A² T / 2 S."""
    return float(np.sqrt(2 * density / seconds * 10 ** (ratio_db / 10)))


def sine(seconds: float, frequency: float, size: float, phase: float) -> Array:
    """Make a line."""
    time = np.arange(round(seconds * RATE)) / RATE
    return size * np.sin(2 * np.pi * frequency * time + phase)


def make_log(values: Array, velocity: Array | None = None) -> Log:
    """Make a log of one accelerometer."""
    return Log(
        name="made",
        digest="0" * 64,
        metadata=Metadata(),
        sample_rate=RATE,
        channels=(Channel("acc", "acceleration", values),),
        reference_velocity=velocity,
        pieces=((0, values.size),),
        refused=(),
    )


def highest_ordinate(values: Array, declared: float) -> bool:
    """Test the highest ordinate against an exponential about the median of its neighbours.

    What is commonly done; right in white noise, and blind to what a resonance is.
    """
    f = np.fft.rfftfreq(values.size, 1 / RATE)
    inside = (f >= BAND[0]) & (f < BAND[1])
    ordinates = np.abs(np.fft.rfft(values - values.mean())) ** 2
    level = median_filter(ordinates, 65) / np.log(2)
    return bool((ordinates[inside] / level[inside]).max() > np.log(inside.sum() / declared))


def rng_of(*key: int) -> np.random.Generator:
    """Return the generator of a part."""
    return np.random.default_rng([20261121, *key])


def tested(values: Array, declared: float) -> Array:
    """Test a whole record."""
    channel = Channel("acc", "acceleration", values)
    return find_lines(channel, (Segment(0, values.size, np.nan),), RATE, BAND, declared)


def rated(hits: int, n: int, declared: float) -> Row:
    """Put a rate beside the declared one."""
    low, high = clopper_pearson(hits, n, LEVEL)
    return {"declared": declared, "hits": hits, "n": n, "low": low, "high": high,
            "raised": bool(low > declared)}  # fmt: skip
