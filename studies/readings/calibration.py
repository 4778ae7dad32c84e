"""Spectra: a sine of amplitude A reads A, noise of density S reads S, ordinates are χ² of 2 dof."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2, expon, kstest

from lmshealth.io.log import Channel
from lmshealth.signal.harmonics import decompose
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectra import ResonanceRange, transform_segment
from studies.harness.study import Row
from studies.readings.checks import Check, below, control, likely, unbiased

Array = np.ndarray[Any, Any]

RATE = 20_000.0
# From here on `transform_segment` promises that its trend takes less than 1e-6.
FROM = 780
ORDINATES = (1, 2, 5, 10, 20, 50, 100, 200, 400, FROM, 1500, 3000, 7000)
PHASES = np.pi * np.arange(8) / 8
LEVEL = 3.7e-4
# Displacements: highest frequency of interest in Hz, and where the figure is asked from.
TOP, LOW = 250.0, 10.0
DISPLACEMENT_RATE = 4000.0
BAND = (100.0, 150.0)
# No sinusoid is removed where a resonance may be as narrow.
ANYWHERE = (ResonanceRange(0.0, np.inf, 0.0),)


def calibrate(quick: bool) -> tuple[dict[str, Check], Row]:
    """Check gain and distribution of spectra."""
    rng = np.random.default_rng(1)
    checks, curves = sines()
    for part in (expected_noise(2000 if quick else 4000), displacements(quick),
                 sampled(rng, (1 << 16 if quick else 1 << 20) - 1),
                 freedom(rng, 1000 if quick else 4000)):  # fmt: skip
        checks |= part[0]
        curves |= part[1]
    return checks, curves


class Spectrum(NamedTuple):
    """Periodogram of one channel."""

    frequency: Array  # in Hz
    periodogram: Array
    duration: float  # in s

    def amplitude(self, k: int) -> float:
        """Return the amplitude of a sine of k periods: I = A² T / 2."""
        return float(np.sqrt(2 * self.periodogram[k - 1] / self.duration))


def spectrum(
    values: Array, kind: str = "acceleration", rate: float = RATE, top: float = np.inf
) -> Spectrum:
    """Return the periodogram of all samples."""
    channel = Channel("x", kind, np.array(values))  # type: ignore[arg-type]
    segment = Segment(0, values.size, float("nan"))
    own = transform_segment([channel], segment, rate, top, resonances=ANYWHERE)
    return Spectrum(own.frequency, own.powers()[:, 0], own.duration)


def mean_ordinate(found: Spectrum, low: float, high: float) -> tuple[float, int]:
    """Return the mean ordinate of a band, and its degrees of freedom."""
    own = found.periodogram[(found.frequency >= low) & (found.frequency < high)]
    return float(own.mean()) if own.size else float("nan"), 2 * own.size


def cosine(k: int, n: int, phase: float, size: int) -> Array:
    """Return k whole periods in n samples; the angle is reduced exactly before it is rounded."""
    return np.cos(2 * np.pi * (k * np.arange(size) % n) / n + phase)


def sines() -> tuple[dict[str, Check], Row]:
    """Read sines of whole numbers of periods: odd and even records, eight phases."""
    read = [
        [(spectrum(x).amplitude(k), decompose(x, RATE).amplitude[k - 1])
         for n in (16_000, 16_001) for x in (cosine(k, n, phase, n) for phase in PHASES)]
        for k in ORDINATES
    ]  # fmt: skip
    worst = np.abs(np.array(read) - 1).max(axis=1)
    at = np.array(ORDINATES)
    stated = 6 / (np.pi * at) ** 2
    windowed = spectrum(hann(16_000) * cosine(FROM, 16_000, 0.3, 16_000))
    checks = {
        f"periodogram: sine of amplitude A reads A from ordinate {FROM} on, relative": below(
            worst[at >= FROM, 0].max(), 1e-6
        ),
        "periodogram: below it less is lost than the stated 6/(πk)², largest share of it": below(
            (worst[:, 0] / stated)[at < FROM].max(), 1.01
        ),
        "harmonics: sine of amplitude A reads A at every ordinate, relative": below(
            worst[:, 1].max(), 1e-6
        ),
        "control: a Hann window left uncorrected, sine reads A": control(
            below(abs(windowed.amplitude(FROM) - 1), 1e-6)
        ),
    }
    curve = {"ordinate": list(ORDINATES), "sines_each": 2 * PHASES.size,
             "periodogram": worst[:, 0].tolist(), "harmonics": worst[:, 1].tolist()}  # fmt: skip
    return checks, {"sine_error": curve}


def hann(n: int) -> Array:
    """Return a periodic Hann window."""
    return np.hanning(n + 1)[:-1]


def expected_noise(n: int) -> tuple[dict[str, Check], Row]:
    """Read the expectation for white noise exactly, without sampling any.

    An ordinate is a quadratic form of the samples. For independent samples of variance σ² its
    expectation is σ² times its trace: the sum of what n impulses of height σ read, one by one.
    """
    rng = np.random.default_rng(2)
    x, y = rng.standard_normal((2, n))
    form = spectrum(x + y).periodogram + spectrum(x - y).periodogram
    form -= 2 * (spectrum(x).periodogram + spectrum(y).periodogram)
    ratio = np.zeros((2, (n - 1) // 2))
    for j in range(n):
        impulse = np.zeros(n)
        impulse[j] = np.sqrt(LEVEL * RATE / 2)
        harmonics = decompose(impulse, RATE)
        ratio[0] += spectrum(impulse).periodogram / LEVEL
        ratio[1] += harmonics.power[: ratio.shape[1]] * harmonics.duration / LEVEL
    at = np.arange(1, ratio.shape[1] + 1)
    lost = np.abs(ratio - 1)
    kept = np.unique(np.geomspace(1, at[-1], 60).round().astype(int)) - 1
    checks = {
        "periodogram is a quadratic form of the samples (parallelogram law), relative": below(
            np.abs(form).max() / spectrum(x).periodogram.mean(), 1e-12
        ),
        f"periodogram: noise of density S reads S from ordinate {FROM} on, expectation": below(
            lost[0, at >= FROM].max(), 1e-6
        ),
        "periodogram: below it the stated share 3/(πk)² is lost, largest departure": below(
            np.abs(lost[0] - 3 / (np.pi * at) ** 2).max(), 1e-6
        ),
        "harmonics: noise of density S reads S/T at every ordinate, expectation": below(
            lost[1].max(), 1e-6
        ),
    }
    return checks, {
        "noise_error": {"ordinate": at[kept].tolist(), "periodogram": lost[0, kept].tolist()}
    }


def displacements(quick: bool) -> tuple[dict[str, Check], Row]:
    """Read displacements as acceleration: sines, noise of white acceleration, encoder noise."""
    rate, n = DISPLACEMENT_RATE, 3200 if quick else 12_800
    # Samples that the second difference takes.
    lost = n - round(spectrum(np.zeros(n), "displacement", rate, TOP).duration * rate)
    size = n + lost
    off = []
    # One longer record, so that ordinate 780 stands within the band.
    period = 12_800
    for k in range(FROM, round(TOP * period / rate) + 1, 5):
        for phase in PHASES[::2]:
            x = cosine(k, period, phase, period + lost)
            read = spectrum(x, "displacement", rate, TOP).amplitude(k)
            off.append(read / (2 * np.pi * k * rate / period) ** 2 - 1)
    # Impulses of acceleration, twice summed; beside it impulses of the encoder.
    frequency = spectrum(np.zeros(size), "displacement", rate, TOP).frequency
    total = np.zeros((2, frequency.size))
    sigma = np.sqrt(LEVEL * rate / 2)
    t = np.arange(size)
    for j in range(size):
        moved = np.maximum(t - j, 0) * (sigma / rate**2)
        still = np.where(t == j, sigma, 0.0)
        total += [spectrum(x, "displacement", rate, TOP).periodogram for x in (moved, still)]
    half = np.pi * frequency / rate
    truth = LEVEL * np.array([(half / np.sin(half)) ** 4, (2 * np.pi * frequency) ** 4])
    ratio = total / truth
    inside = (frequency >= LOW) & (frequency <= TOP)
    trend = 3 / (np.pi * np.arange(1, frequency.size + 1)) ** 2
    name = f"displacement, band to {TOP:g} Hz"
    checks = {
        f"{name}: sine of amplitude A reads ω²A from ordinate {FROM} on, relative": below(
            np.abs(off).max(), 1e-6
        ),
        f"{name}: white acceleration of density S reads S (1 - 3/(πk)²), expectation": below(
            np.abs(ratio[0] - 1 + trend)[inside].max(), 1e-3
        ),
    }
    edges = [LOW, 20.0, 40.0, 80.0, 160.0, TOP]
    return checks, {
        "encoder_noise_read_over_true": {
            "note": "white displacement noise: what its steep end leaks downwards; falls as 1/T",
            "duration_s": n / rate,
            "frequency_hz": edges,
            "ratio": [float(ratio[1, np.argmin(np.abs(frequency - f))]) for f in edges],
        }
    }


def sampled(rng: np.random.Generator, n: int) -> tuple[dict[str, Check], Row]:
    """Read one long record of noise: Parseval's identity, mean, variance and distribution."""
    n = 3 ** int(np.log(n) / np.log(3))  # odd, and of a length to which no long record is cut
    x = rng.standard_normal(n) * np.sqrt(LEVEL * RATE / 2)
    whole = spectrum(x)
    t = np.arange(n) - (n - 1) / 2
    rest = x - x.mean() - t * (t @ x / (t @ t))
    total = float(whole.periodogram.sum() / whole.duration)
    ratio = whole.periodogram[FROM:] / LEVEL
    windowed = spectrum(hann(n) * x).periodogram[FROM:] / LEVEL
    m = ratio.size
    distribution = "exponential, Kolmogorov-Smirnov"
    checks = {
        "ordinates add up to the variance (Parseval), relative": below(
            abs(total / float(rest.var()) - 1), 1e-12
        ),
        "mean of ordinates over S, one long record": unbiased(float(ratio.mean()), 1.0, m**-0.5),
        "variance of ordinates over S²": unbiased(float(ratio.var()), 1.0, (8 / m) ** 0.5),
        "distribution of ordinates over S": likely(
            float(kstest(ratio, expon.cdf).pvalue), distribution
        ),
        "control: a Hann window left uncorrected, mean of ordinates over S": control(
            unbiased(float(windowed.mean()), 1.0, m**-0.5)
        ),
        "control: a Hann window left uncorrected, distribution": control(
            likely(float(kstest(windowed, expon.cdf).pvalue), distribution)
        ),
    }
    cuts = np.geomspace(20.0, RATE / 2, 17)
    bands = [mean_ordinate(whole, low, high) for low, high in pairwise(cuts)]
    tail = np.geomspace(1.0, 5 / m, 60)
    return checks, {
        "noise_bands": {
            "duration_s": whole.duration,
            "low_hz": cuts[:-1].tolist(),
            "high_hz": cuts[1:].tolist(),
            "ratio": [level / LEVEL for level, _ in bands],
            "standard_error": [(2 / dof) ** 0.5 for _, dof in bands],
        },
        "ordinates": {
            "n": m,
            "probability_above": tail.tolist(),
            "quantile": np.quantile(ratio, 1 - tail).tolist(),
            "quantile_hann": np.quantile(windowed, 1 - tail).tolist(),
        },
    }


def freedom(rng: np.random.Generator, records: int) -> tuple[dict[str, Check], Row]:
    """Read the mean ordinate of a band over many records: its degrees of freedom."""
    n = 8000
    window = hann(n) / np.sqrt(np.mean(hann(n) ** 2))
    found = np.empty((2, records))
    for i in range(records):
        x = rng.standard_normal(n) * np.sqrt(LEVEL * RATE / 2)
        found[0, i], dof = mean_ordinate(spectrum(x), *BAND)
        found[1, i], _ = mean_ordinate(spectrum(window * x), *BAND)
    ratio = found / LEVEL

    def agrees(values: Array, freedom: float) -> Check:
        result = kstest(freedom * values, chi2(freedom).cdf)
        return likely(float(result.pvalue), f"χ² of {freedom:g} degrees of freedom")

    checks = {
        "mean ordinate of a band has the degrees of freedom that it says": agrees(ratio[0], dof),
        "control: half the degrees of freedom": control(agrees(ratio[0], dof / 2)),
        "control: a Hann window whose gain is corrected, whose freedom is not": control(
            agrees(ratio[1], dof)
        ),
    }
    variance = {"stated": 2 / dof, "measured": float(ratio[0].var()),
                "with_hann_window": float(ratio[1].var())}  # fmt: skip
    return checks, {"variance_of_a_band": {"records": records, "dof": dof, **variance}}
