"""Frequency response of an output to an input, over periods or over blocks of a record.

Noise of the lines comes from the sensors and from forces that excite the same modes.
"""

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Self

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter1d
from scipy.optimize import minimize_scalar
from scipy.special import fdtrc

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray, ReadOnly, freeze
from lmshealth.errors import BadLog
from lmshealth.io.log import Log
from lmshealth.modal import constants
from lmshealth.modal.credibility import inverse_bias
from lmshealth.modal.deterministic.periods import cut_periods

_LEAST_RATIO, _LARGEST_RATIO = 1e-6, 1e6


def smooth_noise(power: FloatArray, response: FloatArray, width: int) -> FloatArray:
    """Average the power of noise over ``width`` neighbouring lines, and preserve its resonances.

    It is divided by the shape a + b |H|² of greatest likelihood for exponential variables first;
    ``response`` is |H|² up to a factor, all of shape ``(n_lines,)``.
    """
    relative = response / response.max()
    power = np.maximum(power, np.finfo(float).tiny)

    def cost(ln_ratio: float) -> float:
        shape = 1 + np.exp(ln_ratio) * relative
        return float(power.size * np.log(np.mean(power / shape)) + np.sum(np.log(shape)))

    bounds = (np.log(_LEAST_RATIO), np.log(_LARGEST_RATIO))
    found = minimize_scalar(cost, bounds=bounds, method="bounded")
    shape = 1 + np.exp(found.x) * relative
    width = min(width, power.size)
    return np.asarray(shape * uniform_filter1d(power / shape, width, mode="nearest"))


def average_noise(
    power: FloatArray, response: ComplexArray, freedom: int
) -> tuple[FloatArray, float]:
    """Average the power of noise over neighbours as needed; return it and its degrees of freedom.

    It has ``freedom`` complex ones in each line. The bias of its inverse is corrected.
    """
    width = max(1, 2 * int(np.ceil((_FREEDOM / freedom - 1) / 2)) + 1)
    total = float(width * freedom)
    return smooth_noise(power, np.abs(response) ** 2, width) * inverse_bias(total), total


# Complex degrees of freedom that a variance needs; few periods are supplemented by neighbours.
_FREEDOM = 16
# Blocks of a record, half overlapping, that a coherence is averaged over.
_BLOCKS = 8
_ROUNDING = 1e-9  # share of the largest amplitude


@dataclass(frozen=True, slots=True, eq=False)
class Ordinates(ReadOnly):
    """Spectra of an input and an output at the lines of a band, arrays ``(n_lines,)``."""

    frequency: FloatArray  # in Hz, ascending
    given: ComplexArray  # amplitudes of the input
    answer: ComplexArray  # of the output
    noise: FloatArray  # variance of answer - H given by noise; without periods a start value
    freedom: float  # complex degrees of freedom of each variance; 0 where it is unknown
    periodic: bool  # means over whole periods or blows: no transient, noise from their scatter
    at_rest: bool = False  # at both ends of the record: no transient
    # Spectra of the input and of the output of each blow, (2, n_blows, n_lines); else None
    blows: ComplexArray | None = None

    @property
    def transient(self) -> bool:
        """Whether the answer has a transient."""
        return not (self.periodic or self.at_rest)

    @property
    def scatter(self) -> bool:
        """Whether the noise is that of a scatter; otherwise it is that of the residual."""
        return self.periodic and self.freedom > 0

    @property
    def spacing(self) -> float:
        """Distance of neighbouring lines in Hz."""
        return float(np.median(np.diff(self.frequency)))

    def only(self, keep: BoolArray) -> Self:
        """Keep some of the lines."""
        lines = ("frequency", "given", "answer", "noise")
        blows = None if self.blows is None else self.blows[:, :, keep]
        return replace(self, **{name: getattr(self, name)[keep] for name in lines}, blows=blows)


@dataclass(frozen=True, slots=True, eq=False)
class Frf:
    """Frequency response function with its coherence.

    With a periodic excitation ``response`` is the mean output over the mean input, unbiased by
    noise of either. Otherwise it is H1 from spectra of half overlapping blocks.

    Noise of the input reduces H1 by its share of the input's power, noise of the output raises H2;
    Hv is unbiased where both have the same share of noise (channels are weighted by their mean
    power). In a closed loop all three are biased towards the inverse of the feedback.

    Arrays have shape ``(n_lines,)``.
    """

    input: str  # channel name
    output: str  # channel name
    frequency: FloatArray  # in Hz; with a periodic excitation only excited harmonics
    response: ComplexArray  # SI unit of the output per that of the input
    std: FloatArray  # of the response by noise, sqrt(E|ΔH|²)
    h1: ComplexArray  # from the spectra of all periods or blocks
    h2: ComplexArray
    hv: ComplexArray
    coherence: FloatArray  # over periods or blocks, 0 to 1
    n_averages: float  # periods, or equivalent number of independent blocks
    period: float = float("nan")  # of the excitation in s; NaN where it is not periodic
    # Amplitude of the output beyond noise at harmonics without input over that at excited ones:
    # nonlinear. NaN where the excitation is not periodic or excites all harmonics.
    stray: float = float("nan")
    # How it was measured: means over "periods" or "blows", over "segments" of a record, or before
    # ("measured").
    method: str = "periods"
    note: str = ""  # what the reader must take into account

    def __post_init__(self) -> None:
        freeze(self, ("response std h1 h2 hv coherence", *self.frequency.shape))


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Signals of an input and an output."""

    log: Log
    names: tuple[str, str]  # of input and output
    signals: tuple[FloatArray, FloatArray]  # (n_samples,) each
    lag: int  # in samples of a second difference of both; 0 for none

    def gain(self, frequency: FloatArray) -> FloatArray:
        """Return the gain of the difference at frequencies in Hz."""
        if self.lag == 0:
            return np.ones(frequency.size)
        return np.asarray(4 * np.sin(np.pi * frequency * self.lag / self.log.sample_rate) ** 2)


def from_periods(pair: Pair, band: tuple[float, float], period: float) -> tuple[Frf, Ordinates]:
    """Average whole periods of ``period`` samples; their scatter is the noise.

    `BadLog` if the record holds less than two periods, too few lines of the band are excited, or
    the input differs between periods.
    """
    rate = pair.log.sample_rate
    spectra, period = cut_periods(pair.signals, period)
    if spectra.shape[1] < 2:
        found = f"{pair.signals[0].size / rate:.4g} s hold less than two whole periods of "
        raise BadLog(pair.log.name, "period", f"{found}{period / rate:.4g} s; record longer")
    frequency: FloatArray = np.arange(spectra.shape[2], dtype=np.float64) * (rate / period)
    inside = (frequency >= band[0]) & (frequency <= band[1]) & (frequency > 0)
    strongest = np.abs(spectra[0]).max()
    gain = np.maximum(pair.gain(frequency), _ROUNDING)
    stray = _stray((spectra / gain)[:, spectra.shape[1] > 2 :])
    frequency = frequency[inside]
    spectra = spectra[:, :, inside] / pair.gain(frequency)
    spectra = spectra[:, int(_is_transient(spectra[1])) :]
    n = spectra.shape[1]
    excited = _excited(pair, spectra[0], strongest, period / rate, band)
    frequency, spectra = frequency[excited], spectra[:, :, excited]
    given, answer = spectra.mean(axis=1)
    response = answer / given
    # The scatter of Y - H U includes the noise of both and its correlation.
    noise = np.var(spectra[1] - response * spectra[0], axis=0, ddof=1) / n
    noise, freedom = average_noise(noise, response, n - 1)
    # Simulated records may be free of noise but for rounding.
    noise = np.maximum(noise, (_ROUNDING * np.abs(answer).max()) ** 2)
    power = np.mean(np.abs(spectra) ** 2, axis=1)
    cross = np.mean(spectra[1] * spectra[0].conj(), axis=0)
    h1, h2, hv, coherence = estimates(power[0], power[1], cross)
    std = np.sqrt(noise) / np.abs(given)
    frf = Frf(*pair.names, frequency, response, std, h1, h2, hv, coherence, n, period / rate, stray)
    return frf, Ordinates(frequency, given, answer, noise, freedom, periodic=True)


def _stray(spectra: ComplexArray) -> float:
    """Compare the output at harmonics with and without input, ``(2, n_periods, n_harmonics)``."""
    power = np.abs(spectra.mean(axis=1)[:, 1:]) ** 2
    noise = np.var(spectra[1, :, 1:], axis=0, ddof=1) / spectra.shape[1]
    silent = power[0] < constants.NO_INPUT**2 * power[0].max()
    loud = power[0] >= constants.EXCITED**2 * power[0].max()
    if not silent.any():
        return float("nan")
    # The median, since mains may be harmonics of the excitation.
    beyond = float(np.median((power[1] - noise)[silent]) / power[1, loud].mean())
    return float(np.sqrt(max(beyond, 0.0)))


def _excited(
    pair: Pair, given: ComplexArray, strongest: float, period: float, band: tuple[float, float]
) -> BoolArray:
    """Return which lines are excited beyond the noise, from ``(n_periods, n_lines)``."""
    power = np.abs(given.mean(axis=0)) ** 2
    noise = np.var(given, axis=0, ddof=1) / given.shape[0]
    strong = power >= constants.EXCITED**2 * power.max(initial=0.0)
    strong &= np.abs(given).max(axis=0) > _ROUNDING * strongest
    check_lines(pair, int(strong.sum()), band, constants.FRF_LINES)
    excited = np.asarray(strong & (power > constants.CLEARLY_EXCITED * noise))
    if excited.sum() < constants.FRF_LINES:
        lines = (
            f"of its {strong.sum()} lines {excited.sum()} exceed the differences between periods"
        )
        step = "state another period or none, or excite more"
        detail = f"{pair.names[0]} does not repeat after {period:.4g} s: {lines}; {step}"
        raise BadLog(pair.log.name, "period", detail)
    return excited


def _is_transient(answer: ComplexArray) -> bool:
    """Return whether the first period differs from the others, ``(n_periods, n_lines)``."""
    n, n_lines = answer.shape
    if n < 4 or n_lines == 0:
        return False
    rest = answer[1:]
    scatter = np.var(rest, axis=0, ddof=1)
    apart = np.abs(answer[0] - rest.mean(axis=0)) ** 2 / (1 + 1 / (n - 1))
    # Whitened, so that the few lines of a disturbed resonance do not dominate.
    level = uniform_filter1d(scatter, min(_FREEDOM, n_lines), mode="nearest")
    level = np.maximum(level, np.finfo(float).tiny)
    ratio = np.sum(apart / level) / max(np.sum(scatter / level), np.finfo(float).tiny)
    return bool(fdtrc(2 * n_lines, 2 * n_lines * (n - 2), ratio) < constants.TRANSIENT)


def from_record(pair: Pair, band: tuple[float, float]) -> tuple[Frf, Ordinates]:
    """Average half overlapping blocks for the response; transform the record for its modes.

    `BadLog` if the band holds too few lines, or too many.
    """
    from scipy.signal import csd  # late: it imports scipy.stats, half a second

    size, rate = pair.signals[0].size, pair.log.sample_rate
    step = rate / size
    first, last = max(1, int(np.ceil(band[0] / step))), int(band[1] / step)
    check_lines(pair, last - first + 1, band, constants.FRF_LINES_OF_RECORD)
    lines: FloatArray = np.arange(first, last + 1, dtype=np.float64) * step
    scale = size / 2 * pair.gain(lines)
    whole = (np.asarray(fft.rfft(x - x.mean()), dtype=np.complex128) for x in pair.signals)
    given, answer = (spectrum[first : last + 1] / scale for spectrum in whole)
    length = size // _BLOCKS
    # Of two half overlapping Hann windows the spectra correlate by 1/6.
    n = (2 * size / length - 1) / (1 + 2 / 6**2)
    (frequency, auto_in), (_, cross), (_, auto_out) = (
        csd(x, y, rate, nperseg=length) for x, y in combinations_with_replacement(pair.signals, 2)
    )
    inside = (frequency >= band[0]) & (frequency <= band[1]) & (frequency > 0)
    frequency = frequency[inside]
    weight = pair.gain(frequency) ** -2
    power_in, power_out = auto_in.real[inside] * weight, auto_out.real[inside] * weight
    h1, h2, hv, coherence = estimates(power_in, power_out, cross[inside] * weight)
    unexplained = np.maximum(1 - coherence, _ROUNDING) * power_out * n / (n - 1)
    std = np.sqrt(unexplained / (n * power_in))
    frf = Frf(*pair.names, frequency, h1, std, h1, h2, hv, coherence, n, method="segments")
    noise = np.interp(lines, frequency, unexplained) * (2 * step)
    return frf, Ordinates(lines, given, answer, noise, n - 1, periodic=False)


def estimates(
    power_in: FloatArray, power_out: FloatArray, cross: ComplexArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray, FloatArray]:
    """Return H1, H2, Hv and the coherence from powers and E[Y U*]."""
    h1 = cross / power_in
    h2 = power_out / cross.conj()
    weight = power_out.mean() / power_in.mean()
    apart = power_out / weight - power_in
    hv = (apart + np.sqrt(apart**2 + 4 * np.abs(cross) ** 2 / weight)) / (2 * cross.conj()) * weight
    coherence = np.abs(cross) ** 2 / (power_in * power_out)
    return h1, h2, hv, np.minimum(coherence, 1.0)


def check_lines(pair: Pair, n: int, band: tuple[float, float], fewest: int) -> None:
    """Refuse a band with too few excited lines, or too many."""
    where = f"between {band[0]:.4g} and {band[1]:.4g} Hz"
    if n < fewest:
        reason = "not-excited" if n <= 0 else "band-too-narrow"
        found = f"{pair.names[0]} excites {max(n, 0)} lines {where}; needed are at least {fewest}"
        step = "choose a wider band, or record longer (a longer period has more lines)"
        raise BadLog(pair.log.name, reason, f"{found}: {step}")
    if n > constants.FRF_MOST_LINES:
        detail = f"{n} lines {where}, at most {constants.FRF_MOST_LINES} are fitted; choose a band"
        raise BadLog(pair.log.name, "band-too-wide", detail)
