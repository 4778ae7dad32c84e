"""Growth over velocity and RMS of bands, on noise whose truth is known."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from lmshealth.signal.acceleration_levels import (
    FrequencyBand,
    Growth,
    choose_bands,
    find_growth,
    read_magnitudes,
)
from lmshealth.stage.description import load_stage
from models.recordings.strokes import VELOCITIES
from studies.common.logs import make_log
from studies.harness.study import Row
from studies.readings.checks import Check, control, rate, unbiased

Array = np.ndarray[Any, Any]

RATE, N = 6400.0, 25_600
EXPONENTS = (0.0, 0.5, 1.0)
# Rows of a grid that no band of the description touches: they are independent of each other.
GRID = (410.0, 600.0)
SIGNIFICANCE, COVERAGE = 0.05, 0.95
N_SHOWN = 20
# Density of the noise whose RMS is read, (m/s²)²/Hz: a floor and humps of height, middle and width.
FLOOR = 1e-6
HUMPS = ((4e-5, 40.0, 6.0), (1e-4, 126.4, 4.0), (6e-5, 136.6, 4.0), (3e-5, 270.0, 12.0),
         (2e-6, 2000.0, 20.0), (5e-6, 2900.0, 25.0), (3e-6, 3000.0, 15.0))  # fmt: skip


def wide_bands(name: str) -> tuple[FrequencyBand, ...]:
    """Return the health band and the watched bands of a shipped description."""
    return tuple(b for b in choose_bands(load_stage(name), None, None) if b.kind != "mode")


def known_growth(quick: bool) -> tuple[dict[str, Check], Row]:
    """Read logs whose level is a power of velocity: is slope ± σ what it says?"""
    rng = np.random.default_rng(4)
    bands = (*choose_bands(None, None, GRID), *wide_bands("lms-y"))
    repetitions = 20 if quick else 400
    kinds = {band.name: "magnitude" if band.kind == "grid" else "rms" for band in bands}
    checks: dict[str, Check] = {}
    slopes: list[Row] = []
    for exponent in EXPONENTS:
        found = [fit(rng, exponent, bands) for _ in range(repetitions)]
        for kind in ("magnitude", "rms"):
            mine = [g for one in found for g in one if kinds[g.band] == kind]
            checks |= judge(mine, exponent, f"level ~ velocity^{exponent:g}, {kind}")
        shown = [one[0] for one in found[:N_SHOWN]]
        slopes.append({"exponent": exponent, "slope": [g.slope for g in shown],
                       "half_width": [quantile(g) * g.slope_std for g in shown]})  # fmt: skip
    details = {"repetitions": repetitions, "bands": list(kinds), "shown": slopes}
    return checks, {"known_growth": details}


def fit(
    rng: np.random.Generator, exponent: float, bands: tuple[FrequencyBand, ...]
) -> tuple[Growth, ...]:
    """Read the growth of one series of logs at the paper's velocities."""
    readings = []
    for velocity in VELOCITIES:
        values = rng.standard_normal(N) * (0.1 * velocity**exponent)
        readings += read_magnitudes(make_log({"acc_feed": values}, RATE, velocity=velocity), bands)
    return find_growth(readings)


def quantile(growth: Growth) -> float:
    """Return Student's quantile of the two-sided interval of a slope."""
    return float(student.ppf((1 + COVERAGE) / 2, growth.n_logs - 2))


def judge(found: list[Growth], truth: float, name: str) -> dict[str, Check]:
    """Judge bias and coverage of slopes, and how often they are said to grow."""
    slope, std = np.array([(g.slope, g.slope_std) for g in found]).T
    n, reach = slope.size, quantile(found[0])
    off = np.abs(slope - truth)
    covered, shrunken = int(np.sum(off < reach * std)), int(np.sum(off < 0.5 * reach * std))
    mean_error = float(slope.std(ddof=1) / np.sqrt(n))
    checks = {
        f"{name}: mean slope": unbiased(float(slope.mean()), truth, mean_error),
        f"{name}: coverage of the 95 % interval": rate(covered, n, COVERAGE),
        f"control: {name}: coverage with σ halved": control(rate(shrunken, n, COVERAGE)),
    }
    if truth == 0:
        grows = sum(g.grows is True for g in found)
        # Of a σ half as large, t is twice as large.
        limit = student.ppf(1 - SIGNIFICANCE, found[0].n_logs - 2)
        rashly = int(np.sum(slope / (0.5 * std) > limit))
        checks[f"{name}: said to grow"] = rate(grows, n, SIGNIFICANCE)
        checks[f"control: {name}: said to grow with σ halved"] = control(
            rate(rashly, n, SIGNIFICANCE)
        )
    return checks


def density(frequency: Array) -> Array:
    """Return the density of the noise, one-sided, (m/s²)²/Hz."""
    humps = [a * np.exp(-0.5 * ((frequency - f) / w) ** 2) for a, f, w in HUMPS]
    return FLOOR + np.sum(humps, axis=0)


def mean_square(low: float, high: float) -> float:
    """Return the integral of the density."""
    humps = [
        a * w * np.sqrt(2 * np.pi) * (norm.cdf(high, f, w) - norm.cdf(low, f, w))
        for a, f, w in HUMPS
    ]
    return float(FLOOR * (high - low) + sum(humps))


def coloured(rng: np.random.Generator) -> Array:
    """Return noise of this density: a stretch of a circle three times as long."""
    size = 3 * N
    frequency = np.arange(size // 2 + 1) * RATE / size
    transform = rng.standard_normal((2, frequency.size)) * np.sqrt(
        density(frequency) * RATE * size / 4
    )
    transform[:, [0, -1]] = 0.0
    return np.fft.irfft(transform[0] + 1j * transform[1], size)[:N]


def known_rms(quick: bool) -> tuple[dict[str, Check], Row]:
    """Read the RMS of health and watched bands of noise of known density.

    The harmonics inside a band reach to half their distance from its ends: the integral is asked
    without these ends, and told with them.
    """
    rng = np.random.default_rng(5)
    bands = {(name, b.name): b for name in ("lms-x", "lms-y") for b in wide_bands(name)}
    repetitions = 30 if quick else 600
    square = np.empty((repetitions, len(bands)))
    for i in range(repetitions):
        log = make_log({"acc_feed": coloured(rng)}, RATE, velocity=0.01)
        readings = read_magnitudes(log, bands.values())
        square[i] = [reading.rms**2 for reading in readings]
    half = 0.5 * RATE / N
    checks: dict[str, Check] = {}
    rows = []
    for (stage, name), band, own in zip(bands, bands.values(), square.T, strict=True):
        label = f"{stage}, {band.kind} {name}"
        inside = mean_square(band.low + half, band.high - half)
        whole = mean_square(band.low, band.high)
        mean = float(own.mean() / inside)
        error = float(own.std(ddof=1) / inside / np.sqrt(repetitions))
        checks[f"{label}: mean square over analytic"] = unbiased(mean, 1.0, error)
        checks[f"control: {label}: mean square over half of it, a two-sided density's"] = control(
            unbiased(2 * mean, 1.0, 2 * error)
        )
        rows.append({
            "band": label, "rms_m_s2": float(np.sqrt(own.mean())),
            "analytic_rms_m_s2": whole**0.5, "ratio": float(np.sqrt(own.mean() / whole)),
            "standard_error": 0.5 * error, "lost_at_the_ends": 1 - (inside / whole) ** 0.5,
        })  # fmt: skip
    return checks, {"known_rms": {"repetitions": repetitions, "rows": rows}}
