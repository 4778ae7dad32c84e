"""Spectral lines: multitaper test, detection, and naming by their sources (README.md, "Lines")."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Self

import numpy as np
from scipy import fft
from scipy.linalg import toeplitz
from scipy.special import fdtri, gammainccinv

from lmshealth._private.arrays import ComplexArray, FloatArray
from lmshealth.io.log import Channel, Log
from lmshealth.signal import constants
from lmshealth.signal.segments import Part, Segment, find_segments, select_segments
from lmshealth.signal.spectra import as_acceleration, lag_gain
from lmshealth.stage.description import Stage

# Sine tapers: the test uses half as many ordinates to either side.
_TAPERS = 7
# Frequencies tested per ordinate: between two of them a line loses little of its coherence.
_PER_ORDINATE = 4
_REACH = _TAPERS * _PER_ORDINATE // 2
# Ordinates of the window around a line, distance up to which weaker lines are searched, and most
# lines of a window.
_WINDOW, _VICINITY, _MOST_LINES = 128, 32, 40
# Octaves end at this frequency in Hz times powers of two: away from harmonics of the mains.
_EDGE, _MOST_OCTAVES = 45.0, 40
# Share of the largest ordinate below which an amplitude may be an error of rounding.
_ROUNDING = 1e-9


def detect_sinusoids(
    lengths: Sequence[int],
    read: Callable[[int], FloatArray],
    sample_rate: float,
    band: tuple[float, float],
    false_alarm: float,
) -> FloatArray:
    """Detect the sinusoids that several segments have in common [Thomson1982], [Riedel1995].

    Lengths are the samples of each segment; those less than half as long as the longest are
    omitted. ``read`` returns the samples of a segment by its number, shape ``(n,)``. Sample rate
    and band are in Hz; the first and last four ordinates cannot be tested. ``false_alarm`` is the
    probability that segments without lines show any in the band, shared by all frequencies; it is
    valid in white and coloured noise, and in resolved resonances of damping 0.2 % or more. The
    result is frequency in Hz and amplitude of each, ascending, shape ``(n_lines, 2)``.
    """
    low, high = band
    cuts = _octaves(max(low, high / 2**_MOST_OCTAVES), high)
    octaves = [_plan(lengths, sample_rate, *cut) for cut in cuts]
    tested = [octave for octave in octaves if octave.start < octave.stop]
    n_tests = sum(octave.stop - octave.start for octave in tested)
    found: list[tuple[float, float]] = []
    for octave in tested:
        # Windows overlap, and a line near a cut is seen from both sides.
        near = _TAPERS / 2 * sample_rate / octave.n
        for f, amplitude in _search(octave, read, false_alarm / n_tests):
            if low <= f < high and all(abs(f - other) > near for other, _ in found):
                found.append((f, amplitude))
    return np.array(sorted(found)).reshape(-1, 2)


def _octaves(low: float, high: float) -> list[tuple[float, float]]:
    """Cut a band at fixed frequencies, so that results do not depend on its ends."""
    first, last = np.floor(np.log2(np.array([low, high]) / _EDGE)).astype(int)
    cuts = [low, *(_EDGE * 2.0 ** np.arange(first + 1, last + 1)).tolist(), high]
    return [(a, b) for a, b in pairwise(cuts) if a < b]


@dataclass(frozen=True, slots=True)
class _Octave:
    """Blocks and frequencies by which an octave is tested.

    `n` are the samples of a block, 0 where the segments are too short; `blocks` the first
    samples of those of each segment. Of the ordinates of a block `size` are used, from the
    number `first` on: the octave, from `low` to `high`, and half a window on either side, at most
    all. `start` and `stop` are a half-open range of indices of the padded transform of the series
    of these ordinates.
    """

    sample_rate: float
    n: int
    blocks: list[range]
    low: float
    high: float
    first: int
    size: int
    start: int
    stop: int

    def ordinate(self, index: int) -> float:
        """Return the ordinate of a block at an index of the padded transform."""
        return self.first + index * self.size / (_PER_ORDINATE * (self.size + 1))

    def transformed(self, read: Callable[[int], FloatArray]) -> tuple[ComplexArray, float]:
        """Return the ordinates of the blocks without their means, shape ``(n_blocks, size)``.

        Returns also the largest of all ordinates.
        """
        # The transform is periodic, and that of real samples its own mirror image.
        index = np.arange(self.first, self.first + self.size) % max(self.n, 1)
        mirrored = index > self.n // 2
        index[mirrored] = self.n - index[mirrored]
        rows, largest = list[ComplexArray](), 0.0
        for number, starts in enumerate(self.blocks):
            values = read(number) if starts else np.empty(0)
            for a in starts:
                part = values[a : a + self.n]
                transform = fft.rfft(part - part.mean(), norm="forward")
                rows.append(transform[index])
                largest = max(largest, float(np.abs(transform).max()))
        found = np.array(rows).reshape(-1, self.size)
        return np.where(mirrored, found.conj(), found), largest


def _plan(lengths: Sequence[int], sample_rate: float, low: float, high: float) -> _Octave:
    """Cut segments into blocks of one length, in which a line keeps its phase."""
    top = _EDGE * 2.0 ** np.ceil(np.log2(high / _EDGE))
    coherent = (1 / constants.LINE_WIDTH) * sample_rate
    apart = [length // max(1, round(length * top / coherent)) for length in lengths]
    room = min(own for own, size in zip(apart, lengths, strict=True) if 2 * size >= max(lengths))
    # A few samples are omitted for a fast transform.
    n = fft.prev_fast_len(room, real=True) if room > 4 * _TAPERS else 0
    blocks = [
        range(0, length - n + 1, own) if n and 2 * length >= max(lengths) else range(0)
        for length, own in zip(lengths, apart, strict=True)
    ]
    least = _REACH / _PER_ORDINATE
    low, high = max(low * n / sample_rate, least), min(high * n / sample_rate, n / 2 - least)
    first = int(low) - _WINDOW // 2
    size = fft.next_fast_len(max(int(high) + 1 + _WINDOW // 2 - first, 1))
    first, size = (first, size) if size < n else (0, n)
    # From the index before the first frequency to that after the last: a line between two is seen.
    per = _PER_ORDINATE * (size + 1) / max(size, 1)
    start, stop = int((low - first) * per), int((high - first) * per) + 2
    return _Octave(sample_rate, n, blocks, low, high, first, size, start, stop)


def _search(
    octave: _Octave, read: Callable[[int], FloatArray], p_value: float
) -> list[tuple[float, float]]:
    """Return frequency in Hz and amplitude of the lines of an octave."""
    evidence, power = np.zeros((2, octave.stop - octave.start))
    blocks, largest = octave.transformed(read)
    for ordinates in blocks:
        series = fft.ifft(ordinates, norm="forward")
        padded = fft.fft(series, _PER_ORDINATE * (octave.size + 1))
        ratio, squared = _line_test(padded, octave.size, octave.start, octave.stop)
        evidence += _noise_evidence(ratio)
        power += squared
    threshold = float(gammainccinv(len(blocks), p_value))
    # Without noise the errors of rounding would have lines.
    real = power > len(blocks) * (_ROUNDING * largest) ** 2
    passed = np.flatnonzero((evidence > threshold) & real)
    centres: list[int] = []
    for index in passed[np.argsort(-power[passed])].tolist():
        centre = round(octave.ordinate(octave.start + index))
        if all(abs(centre - other) > _VICINITY - _TAPERS for other in centres):
            centres.append(centre)
    found: list[tuple[float, float]] = []
    for centre in centres:
        begin = centre - _WINDOW // 2
        index = np.arange(begin, begin + _WINDOW) - octave.first
        window = fft.ifft(blocks.take(index, axis=1, mode="wrap"), norm="forward")
        found += [
            (ordinate * octave.sample_rate / octave.n, amplitude)
            for ordinate, amplitude in _window_lines(window, begin, threshold)
            if octave.low - 1 <= ordinate < octave.high + 1 and amplitude > _ROUNDING * largest
        ]
    return found


def _line_test(
    transform: ComplexArray, n: int, first: int, stop: int
) -> tuple[FloatArray, FloatArray]:
    """Return the ratio of the power explained by a sine to the rest, and its squared amplitude."""
    # A taper sin(πk(j+1)/(n+1)) is the difference of two transforms, k half ordinates apart
    # on either side: one padded transform, shape ``(..., size)``, holds all tapers.
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
    """Return the power that a sine does not explain, not below the rounding error."""
    return np.asarray((total - explained).clip(1e-12 * explained + 1e-300))


def _noise_evidence(ratio: FloatArray) -> FloatArray:
    """Return -ln p of the ratio F / (K - 1) in white noise."""
    return (_TAPERS - 1) * np.log1p(ratio)


def _resonance_evidence(ratio: FloatArray, width: float) -> FloatArray:
    """Return -ln p of the ratio at the peak of a resonance, its width in ordinates (README.md)."""
    # Off the peak, in wider resonances and in more noise p is smaller.
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
    """Return the tapers of a window, shape ``(_TAPERS, _WINDOW)``."""
    k, j = np.arange(1, _TAPERS + 1), np.arange(1, _WINDOW + 1)
    norm = np.sqrt(2 / (_WINDOW + 1))
    return np.asarray(norm * np.sin(np.pi * np.outer(k, j) / (_WINDOW + 1)))


def _window_lines(window: ComplexArray, first: int, threshold: float) -> list[tuple[float, float]]:
    """Return ordinate and amplitude of the lines of a window, removed strongest first."""
    size = _PER_ORDINATE * (_WINDOW + 1)
    start, stop = size // 2 - _PER_ORDINATE * _VICINITY, size // 2 + _PER_ORDINATE * _VICINITY
    # The centre has passed the scan; on this slightly different grid it might fail.
    known = np.abs(np.arange(start, stop) - size // 2) <= _PER_ORDINATE // 2
    free = np.ones(stop - start, dtype=bool)
    found = []
    for _ in range(_MOST_LINES):
        ratio, squared = _line_test(fft.fft(window, size), _WINDOW, start, stop)
        power = squared.sum(axis=0)
        passed = np.flatnonzero(free & (known | (_noise_evidence(ratio).sum(axis=0) > threshold)))
        if passed.size == 0:
            break
        # The foot of a strong line is coherent as well.
        at = int(passed[np.argmax(power[passed])])
        foot = max(0, at - _REACH)
        top = foot + int(np.argmax(power[foot : at + _REACH + 1]))
        for place in (at, top):
            free[max(0, place - _REACH) : place + _REACH + 1] = False
        ordinate = (start + _peak(power, top)) * _WINDOW / size
        line = _LineFit.fit(window, ordinate)
        if line.is_significant(abs(first + ordinate), threshold):
            found.append((first + ordinate, line.amplitude))
            window = line.removed()
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _LineFit:
    """Fit of a sine to a window.

    The window demodulated by the sine, shape ``(n_blocks, _WINDOW)``; the conjugate of the sine
    ``(_WINDOW,)``; its complex amplitude, and its power over the rest, ``(n_blocks,)``.
    """

    base: ComplexArray
    carrier: ComplexArray
    mean: ComplexArray
    ratio: FloatArray

    @classmethod
    def fit(cls, window: ComplexArray, ordinate: float) -> Self:
        """Fit the sine of a frequency in ordinates."""
        carrier = np.exp(-2j * np.pi * ordinate * np.arange(_WINDOW) / _WINDOW)
        weight = _tapers().sum(axis=1)
        tapered = window * carrier @ _tapers().T
        mean = tapered @ weight / (weight @ weight)
        explained = np.abs(mean) ** 2 * (weight @ weight)
        rest = _rest(np.sum(np.abs(tapered) ** 2, axis=1), explained)
        return cls(window * carrier, carrier, mean, explained / rest)

    @property
    def amplitude(self) -> float:
        """RMS amplitude over the blocks, corrected for noise."""
        squared = np.abs(self.mean) ** 2 * (1 - 1 / (_TAPERS - 1) / self.ratio.clip(1e-300))
        return float(2 * np.sqrt(np.mean(squared).clip(0)))

    def is_significant(self, periods: float, threshold: float) -> bool:
        """Return whether neither noise nor the narrowest resonance explains the sine."""
        # Below one period a resonance cannot be distinguished from a line.
        width = 2 * constants.LEAST_DAMPING * max(periods, 1.0)
        evidence = _resonance_evidence(self.ratio, width).sum()
        return bool(evidence > threshold) or not self._noise_rises(periods)

    def _noise_rises(self, periods: float) -> bool:
        """Return whether noise within eight ordinates exceeds that further away, on both sides."""
        noise = self.base - self.mean[:, None]
        time = np.arange(_WINDOW) / (_WINDOW + 1)

        def level(ordinate: float) -> float:
            tapers = _tapers() * np.exp(-2j * np.pi * ordinate * time)
            return float(np.mean(np.abs(noise @ tapers.T) ** 2))

        # The lower of two levels further away: another resonance may raise either. Below zero
        # frequency the spectrum is its mirror image.
        dof = 2 * _TAPERS * len(noise)
        # The upper quantile of F is the inverse of the lower one.
        limit = float(1 / fdtri(dof, dof, np.sqrt(constants.RISE_FALSE_ALARM) / 2))
        sides = (-1, 1) if periods > 24 else (1,)
        return all(level(4 * k) > limit * min(level(12 * k), level(20 * k)) for k in sides)

    def removed(self) -> ComplexArray:
        """Return the window without the sine, whose amplitude and phase may vary slowly."""
        basis, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, _WINDOW), 3))
        return np.asarray((self.base - self.base @ basis @ basis.T) * self.carrier.conj())


def _peak(power: FloatArray, at: int) -> float:
    """Return the vertex of the parabola through the logarithms around a maximum."""
    if not 0 < at < power.size - 1:
        return float(at)
    a, b, c = np.log(power[at - 1 : at + 2].clip(1e-300)).tolist()
    bend = a - 2 * b + c
    off = 0.5 * (a - c) / bend if bend < 0 else 0.0
    return at + min(max(off, -0.5), 0.5)


# Lines


@dataclass(frozen=True, slots=True)
class Line:
    """A narrow spectral line of a channel that is not a mode.

    Its frequency is in Hz and the amplitude of its sine in `unit`; `kind` is the name of an order
    of the stage, ``order of … mm``, ``mains`` or ``unknown``. modal/ambient/README.md, "Lines", has
    who decides what is one.
    """

    frequency: float
    amplitude: float
    unit: str
    kind: str
    channel: str


def find_lines(
    channel: Channel,
    segments: Sequence[Segment],
    sample_rate: float,
    band: tuple[float, float],
    false_alarm: float = constants.LINE_TEST_FALSE_ALARM,
) -> FloatArray:
    """Find the narrow lines that segments, at least one, have in common; see `detect_sinusoids`.

    Displacements are read as accelerations: frequency in Hz and amplitude in m/s² of each line,
    ascending, shape ``(n_lines, 2)``.
    """

    def read(number: int) -> tuple[FloatArray, int]:
        return as_acceleration(channel, segments[number], sample_rate, band[1])

    _, lag = read(0)
    lengths = [max(segment.stop - segment.start - 2 * lag, 0) for segment in segments]
    found = detect_sinusoids(lengths, lambda k: read(k)[0], sample_rate, band, false_alarm)
    if lag:
        found[:, 1] *= lag_gain(found[:, 0], lag, sample_rate)
    return found


def name_lines(
    seen: Sequence[tuple[str, float, float]],
    velocities: Iterable[float],
    stage: Stage | None,
    resolution: float,
) -> tuple[Line, ...]:
    """Name the source of each line: an order of the velocity, mains, or unknown.

    Seen are channel, frequency in Hz and amplitude in m/s² of each, which may occur twice; set
    velocities of the log are in m/s, the resolution of the spectrum in Hz. The result is ascending
    in frequency, each line once per channel.
    """
    fundamentals = _fundamentals(stage, velocities)
    named = [
        Line(frequency, amplitude, "m/s²", _kind(frequency, fundamentals, resolution), channel)
        for channel, frequency, amplitude in seen
    ]
    return _without_duplicates(named, resolution)


def expected_orders(
    stage: Stage, velocities: Iterable[float], band: tuple[float, float]
) -> list[tuple[float, str]]:
    """Return frequency in Hz and name of the described orders in a band, at velocities in m/s.

    Up to the harmonic that `name_lines` names.
    """
    bases = [(f, name) for f, name in _fundamentals(stage, velocities) if name != "mains"]
    harmonics = range(1, constants.MOST_HARMONICS + 1)
    found = {(n * base, name) for base, name in bases for n in harmonics if base > 0}
    return sorted(one for one in found if band[0] <= one[0] <= band[1])


def find_lines_by_velocity(
    log: Log,
    channels: Sequence[Channel],
    stage: Stage | None,
    band: tuple[float, float],
    false_alarm: float = constants.LINE_TEST_FALSE_ALARM,
    *,
    part: Part = "record",
) -> tuple[Line, ...]:
    """Find the lines at every velocity of a log, and name those that are proportional to it.

    `part` is a motion phase; of the whole record the stationary segments are searched. Segments of
    one speed are searched together, those less than half as long as the longest are omitted. A line
    that is no order of the description, but at one wavelength of several velocities, is named
    ``order of … mm``. The band is in Hz; `false_alarm` is the probability that
    a channel without lines shows any, at all velocities together. The result is ascending in
    frequency, each line once per channel, at its strongest.
    """
    segments = find_segments(log, 0.0) if part == "record" else select_segments(log, part)
    groups = [list(segments)] if part in ("settling", "idle") else _by_velocity(segments)
    lines: list[Line] = []
    for channel in channels:
        detections = []
        for group in groups:
            velocity, resolution = abs(group[0].velocity), 0.5 * _ordinate(log, group)
            fundamentals, share = _fundamentals(stage, [velocity]), false_alarm / len(groups)
            found = find_lines(channel, group, log.sample_rate, band, share)
            for frequency, amplitude in found.tolist():
                kind = _kind(frequency, fundamentals, resolution)
                line = Line(frequency, amplitude, "m/s²", kind, channel.name)
                detections.append((line, velocity, resolution))
        named = _with_orders(detections)
        lines += _without_duplicates(named, 1.5 * _ordinate(log, segments))
    return tuple(sorted(lines, key=lambda line: (line.frequency, line.channel)))


def _by_velocity(segments: Sequence[Segment]) -> list[list[Segment]]:
    """Group segments of one speed."""
    groups: list[list[Segment]] = []
    for segment in sorted(segments, key=lambda s: abs(s.velocity)):
        # Without a set point velocities are NaN: one group.
        slowest = abs(groups[-1][0].velocity) if groups else 0.0
        if groups and not abs(segment.velocity) > constants.OTHER_VELOCITY * slowest:
            groups[-1].append(segment)
        else:
            groups.append([segment])
    return groups


def _ordinate(log: Log, segments: Sequence[Segment]) -> float:
    """Return the spacing in Hz of the ordinates of the longest segment."""
    return log.sample_rate / max((s.stop - s.start for s in segments), default=1)


def _fundamentals(stage: Stage | None, velocities: Iterable[float]) -> list[tuple[float, str]]:
    orders = () if stage is None else stage.description.order
    return [(mains, "mains") for mains in constants.MAINS] + [
        (abs(velocity) / (order.wavelength_mm * 1e-3), order.name)
        for order in orders
        for velocity in velocities
    ]


def _kind(frequency: float, fundamentals: list[tuple[float, str]], resolution: float) -> str:
    """Name a line by the base with the lowest matching harmonic; mains before orders."""
    kind, lowest = "unknown", constants.MOST_HARMONICS + 1
    resolution = max(resolution, constants.LINE_WIDTH * frequency)
    for base, name in fundamentals:
        # The harmonics of a base below three resolutions would match any line.
        n = round(frequency / base) if base > 3 * resolution else 0
        if 1 <= n < lowest and abs(frequency - n * base) < resolution:
            kind, lowest = name, n
    return kind


def _with_orders(detections: Sequence[tuple[Line, float, float]]) -> list[Line]:
    """Name the unknown lines that have the same wavelength at another velocity."""
    # Each line has its velocity in m/s and the resolution of its frequency in Hz.
    named = []
    for line, velocity, resolution in detections:
        kind = line.kind
        for other, at, width in detections:
            slow, fast = sorted((velocity, at))
            is_other = slow > 0 and fast > constants.OTHER_VELOCITY * slow
            if line.kind != "unknown" or other.kind != "unknown" or not is_other:
                continue
            # The resolution of the first scales with the ratio of velocities.
            ratio = at / velocity
            if abs(other.frequency - line.frequency * ratio) < width + resolution * ratio:
                kind = f"order of {1e3 * velocity / line.frequency:.3g} mm"
        named.append(replace(line, kind=kind))
    return named


def _without_duplicates(lines: Iterable[Line], resolution: float) -> tuple[Line, ...]:
    """Keep the strongest of equal lines of a channel, ascending in frequency."""
    kept: list[Line] = []
    for line in sorted(lines, key=lambda s: (s.channel, -s.amplitude)):
        stronger = (other.frequency for other in kept if other.channel == line.channel)
        if all(abs(frequency - line.frequency) >= 3 * resolution for frequency in stronger):
            kept.append(line)
    return tuple(sorted(kept, key=lambda line: (line.frequency, line.channel)))
