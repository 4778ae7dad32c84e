"""The line test: what sinusoidal tapers show alike is a line, and neither noise nor resonance.

Under noise that is white within four ordinates the transforms of a tapered stretch are
independent. The power that a sine explains, over that it does not, then has Fisher's F
distribution with 2 and 2 (K - 1) degrees of freedom. Within a resonance the tapers differ as well,
but the fewer ordinates wide it is, the less.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy import fft
from scipy.linalg import toeplitz
from scipy.stats import f as fisher
from scipy.stats import gamma

from lmshealth._arrays import ComplexArray, FloatArray

# Tapers of the test: its neighbourhood is half as many ordinates to either side.
_TAPERS = 7
# Frequencies tested per ordinate: between two of them a line loses little of its coherence.
_PER_ORDINATE = 4
_REACH = _TAPERS * _PER_ORDINATE // 2
_BLOCK = 1 << 14
# So many periods a line keeps its phase for.
_COHERENT = 1000.0
# Damping ratio of the narrowest resonance that may be taken for noise.
_LEAST_DAMPING = 0.002
# Probability that a line in flat noise has to stand out as much as one on a resonance.
_MISTAKEN = 0.02
# Ordinates that are cut out around a line, and how far from it weaker ones are sought.
_WINDOW = 128
_BESIDE = 32
_MOST_BESIDE = 40
# Octaves end at this frequency in Hz, its doubles and halves: away from mains and their harmonics.
_EDGE = 45.0
_MOST_OCTAVES = 40


def detect_sinusoids(
    lengths: Sequence[int],
    read: Callable[[int], FloatArray],
    sample_rate: float,
    band: tuple[float, float],
    false_alarm: float,
) -> FloatArray:
    """Find lines that several segments show together, by Thomson's test.

    Real lines keep their phase for a while only (mains wander by some 10 mHz): each octave is
    tested in stretches of a thousand periods, and the probabilities of all stretches of all
    segments are combined by Fisher's method. The declared one is shared by all frequencies
    tested. Where the noise rises towards a frequency, the probability is that under the narrowest
    resonance, of damping 0.2 %. A line that is found is taken out, and weaker ones are sought
    beside it.

    What no test of one record can tell: a resonance narrower than an ordinate whose skirts drown
    in the noise is a line. Of damping 0.2 % in 3 s, one of half an ordinate, 15 to 25 dB high, is
    called one in 5 to 8 % of spectra where 1 % is declared, one of a quarter in up to 23 %; from
    40 dB on it gives itself away. A line whose amplitude halves within a stretch is often missed.

    Parameters
    ----------
    lengths : sequence of int
        Samples of each segment. Those not half as long as the longest are left out.
    read : callable
        Gives the samples of a segment by its number, shape ``(n,)``.
    sample_rate : float
        In Hz.
    band : (float, float)
        Where to look, in Hz; the first and last four ordinates cannot be tested.
    false_alarm : float
        Probability that segments without lines show any in the band; kept, but for what is said
        above, in white and coloured noise and in resonances of damping 0.2 % or more.

    Returns
    -------
    ndarray
        Frequency in Hz and amplitude of each, ascending, shape ``(n_lines, 2)``.

    References
    ----------
    Thomson1982, Riedel1995
    """
    low, high = band
    cuts = _octaves(max(low, high / 2**_MOST_OCTAVES), high)
    octaves = [_plan(lengths, sample_rate, *cut) for cut in cuts]
    n_tests = sum(max(octave.stop - octave.start, 0) for octave in octaves)
    rows: list[tuple[float, float]] = []
    for octave in octaves:
        if octave.start < octave.stop:
            rows += _search(octave, read, false_alarm / n_tests)
    return np.array(sorted(rows)).reshape(-1, 2)


def _octaves(low: float, high: float) -> list[tuple[float, float]]:
    """Cut a band at fixed frequencies: what is found does not depend on where the band ends."""
    first, last = np.floor(np.log2(np.array([low, high]) / _EDGE)).astype(int)
    cuts = [low, *(_EDGE * 2.0 ** np.arange(first + 1, last + 1)).tolist(), high]
    return [(a, b) for a, b in pairwise(cuts) if a < b]


@dataclass(frozen=True, slots=True)
class _Octave:
    """How an octave is tested.

    Attributes
    ----------
    sample_rate : float
        In Hz.
    n : int
        Samples of a stretch; 0 where the segments are too short.
    stretches : list of range
        Where the stretches of each segment begin.
    start, stop : int
        Half-open range of indices of the padded transform of a stretch.
    """

    sample_rate: float
    n: int
    stretches: list[range]
    start: int
    stop: int

    @property
    def ordinates(self) -> float:
        """How many ordinates there are per index."""
        return self.n / (_PER_ORDINATE * (self.n + 1))

    def each(self, read: Callable[[int], FloatArray]) -> Iterator[FloatArray]:
        """Read stretch after stretch, less its mean."""
        for number, starts in enumerate(self.stretches):
            values = read(number) if starts else np.empty(0)
            for a in starts:
                part = values[a : a + self.n]
                yield part - part.mean()


def _plan(lengths: Sequence[int], sample_rate: float, low: float, high: float) -> _Octave:
    """Cut segments into stretches of one length, as long as a line keeps its phase."""
    top = _EDGE * 2.0 ** np.ceil(np.log2(high / _EDGE))
    counts = [max(1, round(length * top / (_COHERENT * sample_rate))) for length in lengths]
    room = min(
        length // count
        for length, count in zip(lengths, counts, strict=True)
        if 2 * length >= max(lengths)
    )
    # A few samples are left out where that makes the transform fast.
    n = fft.prev_fast_len(room + 1, real=True) - 1 if room > 4 * _TAPERS else 0
    stretches = [
        range(0, length - n + 1, length // count) if n and 2 * length >= max(lengths) else range(0)
        for length, count in zip(lengths, counts, strict=True)
    ]
    size = _PER_ORDINATE * (n + 1)
    start, stop = (int(np.ceil(edge * size / sample_rate)) for edge in (low, high))
    start, stop = max(start, _REACH), min(stop, size // 2 + 1 - _REACH)
    return _Octave(sample_rate, n, stretches, start, stop)


def _search(
    octave: _Octave, read: Callable[[int], FloatArray], p_value: float
) -> list[tuple[float, float]]:
    """Frequency in Hz and amplitude of the lines of an octave: scan it, then look closer."""
    evidence, power = np.zeros((2, octave.stop - octave.start))
    count = 0
    for part in octave.each(read):
        count += 1
        transform = fft.rfft(part, _PER_ORDINATE * (octave.n + 1))
        for first in range(octave.start, octave.stop, _BLOCK):
            stop = min(first + _BLOCK, octave.stop)
            ratio, squared = _line_test(transform, octave.n, first, stop)
            here = slice(first - octave.start, stop - octave.start)
            evidence[here] += _white(ratio)
            power[here] += squared
    threshold = float(gamma.isf(p_value, count))
    passed = np.flatnonzero(evidence > threshold)
    centres: list[int] = []
    for index in passed[np.argsort(-power[passed])].tolist():
        centre = round((octave.start + index) * octave.ordinates)
        if all(abs(centre - other) > _BESIDE - _TAPERS for other in centres):
            centres.append(centre)
    low, high = octave.start * octave.ordinates, octave.stop * octave.ordinates
    found: list[tuple[float, float]] = []
    for first, window in _windows(octave.each(read), centres):
        for ordinate, amplitude in _clean(window, first, threshold):
            # Windows overlap.
            new = all(abs(ordinate - other) > _TAPERS / 2 for other, _ in found)
            if new and low <= ordinate < high:
                found.append((ordinate, amplitude))
    return [(ordinate * octave.sample_rate / octave.n, amplitude) for ordinate, amplitude in found]


def _windows(
    stretches: Iterator[FloatArray], centres: list[int]
) -> Iterator[tuple[int, ComplexArray]]:
    """First ordinate, and series ``(n_stretches, _WINDOW)`` of the ordinates, around centres."""
    starts = [centre - _WINDOW // 2 for centre in centres]
    cut: list[list[ComplexArray]] = [[] for _ in centres]
    for part in stretches if centres else ():
        transform = fft.fft(part, norm="forward")
        for own, start in zip(cut, starts, strict=True):
            # Below zero and above Nyquist the transform repeats itself.
            index = np.arange(start, start + _WINDOW)
            own.append(fft.ifft(transform.take(index, mode="wrap"), norm="forward"))
    for own, start in zip(cut, starts, strict=True):
        yield start, np.array(own)


def _line_test(
    transform: ComplexArray, n: int, first: int, stop: int
) -> tuple[FloatArray, FloatArray]:
    """Power that a sine explains over that it does not, and its squared amplitude, at indices.

    A taper sin(πk(j+1)/(n+1)) is the difference of two transforms, k half ordinates apart on
    either side: one padded transform, shape ``(..., size)``, holds all tapers.
    """
    norm = np.sqrt(0.5 / (n + 1))
    mean: ComplexArray = np.zeros(1, dtype=complex)
    total, weights = np.zeros(1), 0.0
    for k in range(1, _TAPERS + 1):
        shift, turn = k * (_PER_ORDINATE // 2), norm * np.exp(1j * np.pi * k / (n + 1))
        tapered = transform[..., first - shift : stop - shift] * turn
        tapered -= transform[..., first + shift : stop + shift] * turn.conjugate()
        total = total + tapered.real**2 + tapered.imag**2
        if k % 2 == 1:
            # The sum of a taper over its samples; even tapers have none.
            weight = 2 * norm / np.tan(np.pi * k / (2 * (n + 1)))
            mean, weights = mean + weight * tapered, weights + weight**2
    explained = (mean.real**2 + mean.imag**2) / weights
    return explained / _rest(total, explained), 4 * explained / weights


def _rest(total: FloatArray, explained: FloatArray) -> FloatArray:
    """Power that a sine does not explain, not below what rounding leaves."""
    return np.asarray((total - explained).clip(1e-12 * explained + 1e-300))


def _white(ratio: FloatArray) -> FloatArray:
    """-ln p of F / (K - 1) in white noise."""
    return (_TAPERS - 1) * np.log1p(ratio)


def _narrow(ratio: FloatArray, width: float) -> FloatArray:
    """-ln p of F / (K - 1) at the peak of a resonance of this half-power bandwidth in ordinates.

    Beside the peak, in wider resonances and in more noise it is less probable. Of independent
    exponential variables e, Σ λ e > 0 has probability Π λ₊ / (λ₊ + |λⱼ|) where all λ but one are
    negative.
    """
    correlation = toeplitz(np.exp(-np.pi * width * np.arange(_WINDOW) / _WINDOW))
    root = np.linalg.cholesky(_tapers() @ correlation @ _tapers().T)
    weight = _tapers().sum(axis=1)
    line = np.outer(weight, weight) / (weight @ weight)
    # Above 1e9 the eigenvalues are lost to rounding.
    form = line - ratio[:, None, None].clip(max=1e9) * (np.eye(_TAPERS) - line)
    values = np.linalg.eigvalsh(root.T @ form @ root)
    return np.asarray(np.log1p(-values[:, :-1].clip(max=0) / values[:, -1:]).sum(axis=1))


@lru_cache(maxsize=1)
def _tapers() -> FloatArray:
    """Tapers of a window, shape ``(_TAPERS, _WINDOW)``."""
    k, j = np.arange(1, _TAPERS + 1), np.arange(1, _WINDOW + 1)
    norm = np.sqrt(2 / (_WINDOW + 1))
    return np.asarray(norm * np.sin(np.pi * np.outer(k, j) / (_WINDOW + 1)))


def _clean(window: ComplexArray, first: int, threshold: float) -> list[tuple[float, float]]:
    """Ordinate and amplitude of the lines of a window: strongest first, each taken out."""
    size = _PER_ORDINATE * (_WINDOW + 1)
    start, stop = size // 2 - _PER_ORDINATE * _BESIDE, size // 2 + _PER_ORDINATE * _BESIDE
    # The scan found that the centre passes; a grid that differs a little might tell otherwise.
    known = np.abs(np.arange(start, stop) - size // 2) <= _PER_ORDINATE // 2
    free = np.ones(stop - start, dtype=bool)
    found = []
    for _ in range(_MOST_BESIDE):
        ratio, squared = _line_test(fft.fft(window, size), _WINDOW, start, stop)
        power = squared.sum(axis=0)
        passed = np.flatnonzero(free & (known | (_white(ratio).sum(axis=0) > threshold)))
        if passed.size == 0:
            break
        # Beside a strong line its own foot is coherent as well.
        at = int(passed[np.argmax(power[passed])])
        foot = max(0, at - _REACH)
        top = foot + int(np.argmax(power[foot : at + _REACH + 1]))
        for place in (at, top):
            free[max(0, place - _REACH) : place + _REACH + 1] = False
        ordinate = (start + _peak(power, top)) * _WINDOW / size
        line = _Line.fit(window, ordinate)
        if line.stands_out(abs(first + ordinate), threshold):
            found.append((first + ordinate, line.amplitude))
            window = line.taken_out()
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """A sine in a window.

    Attributes
    ----------
    base : ndarray
        The window turned so that the sine stands still, shape ``(n_stretches, _WINDOW)``.
    turn : ndarray
        What turned it, shape ``(_WINDOW,)``.
    mean : ndarray
        Amplitude of the sine that the tapers see, shape ``(n_stretches,)``.
    ratio : ndarray
        Power that it explains over that it does not, shape ``(n_stretches,)``.
    """

    base: ComplexArray
    turn: ComplexArray
    mean: ComplexArray
    ratio: FloatArray

    @classmethod
    def fit(cls, window: ComplexArray, ordinate: float) -> _Line:
        """Fit the sine of a frequency in ordinates."""
        turn = np.exp(-2j * np.pi * ordinate * np.arange(_WINDOW) / _WINDOW)
        weight = _tapers().sum(axis=1)
        tapered = window * turn @ _tapers().T
        mean = tapered @ weight / (weight @ weight)
        explained = np.abs(mean) ** 2 * (weight @ weight)
        rest = _rest(np.sum(np.abs(tapered) ** 2, axis=1), explained)
        return cls(window * turn, turn, mean, explained / rest)

    @property
    def amplitude(self) -> float:
        """Root mean square over the stretches, less what noise adds to it."""
        squared = np.abs(self.mean) ** 2 * (1 - 1 / (_TAPERS - 1) / self.ratio.clip(1e-300))
        return float(2 * np.sqrt(np.mean(squared).clip(0)))

    def stands_out(self, periods: float, threshold: float) -> bool:
        """Tell whether noise is flat here, or else the sine too strong for a resonance."""
        # At one period no resonance is told from a line.
        width = 2 * _LEAST_DAMPING * max(periods, 1.0)
        evidence = _narrow(self.ratio, width).sum()
        return bool(evidence > threshold) or not self._noise_rises(periods)

    def _noise_rises(self, periods: float) -> bool:
        """Tell whether noise within eight ordinates is stronger than beyond, on both sides."""
        noise = self.base - self.mean[:, None]
        time = np.arange(_WINDOW) / (_WINDOW + 1)

        def level(ordinate: float) -> float:
            tapers = _tapers() * np.exp(-2j * np.pi * ordinate * time)
            return float(np.mean(np.abs(noise @ tapers.T) ** 2))

        # Of two levels beyond either may be the lower: another resonance can stand there. Below
        # zero frequency stands the mirror image.
        dof = 2 * _TAPERS * len(noise)
        limit = float(fisher.isf(np.sqrt(_MISTAKEN) / 2, dof, dof))
        sides = (-1, 1) if periods > 24 else (1,)
        return all(level(4 * k) > limit * min(level(12 * k), level(20 * k)) for k in sides)

    def taken_out(self) -> ComplexArray:
        """Give the window without the sine, whose phase and amplitude may change a little."""
        basis, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, _WINDOW), 3))
        return np.asarray((self.base - self.base @ basis @ basis.T) * self.turn.conj())


def _peak(power: FloatArray, at: int) -> float:
    """Place of the parabola through the logarithms of a maximum and its neighbours."""
    if not 0 < at < power.size - 1:
        return float(at)
    a, b, c = np.log(power[at - 1 : at + 2].clip(1e-300)).tolist()
    bend = a - 2 * b + c
    off = 0.5 * (a - c) / bend if bend < 0 else 0.0
    return at + min(max(off, -0.5), 0.5)
