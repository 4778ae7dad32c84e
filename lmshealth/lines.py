"""Spectral lines: where they stand, and what the narrow peaks that are no modes come from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import fft
from scipy.stats import gamma

from lmshealth.arrays import FloatArray
from lmshealth.logs import Channel, Log
from lmshealth.results import Line
from lmshealth.segments import Segment, find_segments
from lmshealth.spectra import as_acceleration, lag_gain
from lmshealth.stage import Stage

# Probability that noise and resonances alone show a line somewhere in the band of one spectrum.
FALSE_ALARM = 0.01
_MAINS = (50.0, 60.0)
_MOST_HARMONICS = 10
# Tapers of the test: its neighbourhood is half as many ordinates to either side.
_TAPERS = 7
# Frequencies tested per ordinate: between two of them a line loses little of its coherence.
_PER_ORDINATE = 4
_BLOCK = 1 << 15
# So many periods a line keeps its phase for: a resonance of damping 0.2 % is then still four
# ordinates wide.
_COHERENT = 1000.0
# Octaves end at this frequency in Hz, its doubles and halves: away from mains and their harmonics.
_EDGE = 45.0
_MOST_OCTAVES = 40
# Two velocities are told apart from this ratio on.
_OTHER_VELOCITY = 1.02


def find_lines(
    channel: Channel,
    segment: Segment,
    sample_rate: float,
    band: tuple[float, float],
    false_alarm: float = FALSE_ALARM,
) -> FloatArray:
    """Find narrow lines by Thomson's test: what sinusoidal tapers show alike is no noise.

    Under noise that is white within four ordinates the transforms of the tapered segment are
    independent, and the power that a sine explains over that it does not has Fisher's F
    distribution with 2 and 2 (K - 1) degrees of freedom. A resonance is noise too: within its
    width the tapers differ. Real lines keep their phase for a while only (mains wander by some
    10 mHz): each octave is tested in stretches of a thousand periods, and their probabilities are
    combined by Fisher's method. The declared one is shared by all frequencies tested.

    Parameters
    ----------
    channel : Channel
        Displacements are read as accelerations.
    segment : Segment
        Which samples.
    sample_rate : float
        In Hz.
    band : (float, float)
        Where to look, in Hz; the first and last four ordinates cannot be tested.
    false_alarm : float
        Probability that a segment without lines shows any in the band. Resonances that are only a
        few ordinates wide raise it: four of them, two to ten wide, from 1 % to 2 %.

    Returns
    -------
    ndarray
        Frequency in Hz and amplitude in m/s² of each, ascending, shape ``(n_lines, 2)``.

    References
    ----------
    Thomson1982, Riedel1995
    """
    low, high = band
    x, lag = as_acceleration(channel, segment, sample_rate, high)
    scans = [
        _scan(x, sample_rate, *octave)
        for octave in _octaves(max(low, high / 2**_MOST_OCTAVES), high)
    ]
    n_tests = sum(scan.inside.size for scan in scans)
    rows = [row for scan in scans for row in _stand_out(scan, false_alarm / max(n_tests, 1))]
    found = np.array(sorted(set(rows))).reshape(-1, 2)
    if lag:
        found[:, 1] *= lag_gain(found[:, 0], lag, sample_rate)
    return found


def _octaves(low: float, high: float) -> list[tuple[float, float]]:
    """Cut a band at fixed frequencies: what is found does not depend on where the band ends."""
    first, last = np.floor(np.log2(np.array([low, high]) / _EDGE)).astype(int)
    cuts = [low, *(_EDGE * 2.0 ** np.arange(first + 1, last + 1)).tolist(), high]
    return [(a, b) for a, b in pairwise(cuts) if a < b]


@dataclass(frozen=True, slots=True, eq=False)
class _Scan:
    """The test over an octave.

    Attributes
    ----------
    frequency : ndarray
        Of the first index and the step, in Hz, shape ``(2,)``.
    evidence : ndarray
        Sum over the stretches of -ln p, a gamma variable under noise, shape ``(n,)``.
    power : ndarray
        Mean squared amplitude of the best sine, shape ``(n,)``.
    inside : ndarray
        Indices that belong to the octave, the others only tell what stands beside it.
    n_stretches : int
        How many stretches.
    """

    frequency: FloatArray
    evidence: FloatArray
    power: FloatArray
    inside: np.ndarray[tuple[int], np.dtype[np.intp]]
    n_stretches: int


def _scan(x: FloatArray, sample_rate: float, low: float, high: float) -> _Scan:
    """Test an octave in stretches of so many of its periods as a line keeps its phase for."""
    top = _EDGE * 2.0 ** np.ceil(np.log2(high / _EDGE))
    longest = _COHERENT * sample_rate / top
    n_stretches = max(1, int(np.ceil(x.size / longest)))
    # A few samples are left out where that makes the transform fast.
    n = x.size // n_stretches
    n = fft.prev_fast_len(n + 1, real=True) - 1 if n > 4 * _TAPERS else 0
    size = _PER_ORDINATE * (n + 1)
    step = sample_rate / size
    reach = _TAPERS * _PER_ORDINATE // 2
    a, b = int(np.ceil(low / step)), int(np.ceil(high / step))
    first, last = max(reach, a - reach), min(size // 2 + 1 - reach, b + reach)
    evidence, power = np.zeros(max(last - first, 0)), np.zeros(max(last - first, 0))
    for k in range(n_stretches if last > first else 0):
        part = x[k * (x.size // n_stretches) :][:n]
        f, squared = _line_test(fft.rfft(part - part.mean(), size), n, first, last)
        # Tail of F: p = (1 + F / (K - 1))^-(K - 1).
        evidence += (_TAPERS - 1) * np.log1p(f / (_TAPERS - 1))
        power += squared / n_stretches
    inside = np.arange(max(a, first), min(b, last)) - first
    return _Scan(np.array([first, 1.0]) * step, evidence, power, inside, n_stretches)


def _stand_out(scan: _Scan, p_value: float) -> list[tuple[float, float]]:
    """Frequency and amplitude of what passes: each run of indices once, at its strongest."""
    threshold = float(gamma.isf(p_value, scan.n_stretches)) if scan.inside.size else np.inf
    passed = scan.inside[scan.evidence[scan.inside] > threshold]
    reach = _TAPERS * _PER_ORDINATE // 2
    rows = []
    for run in np.split(passed, np.flatnonzero(np.diff(passed) > _PER_ORDINATE) + 1):
        if run.size == 0:
            continue
        at = int(run[np.argmax(scan.power[run])])
        # Beside a strong line its own foot is coherent as well.
        start = max(0, at - reach)
        at = start + int(np.argmax(scan.power[start : at + reach + 1]))
        if scan.inside[0] <= at <= scan.inside[-1]:
            index, squared = _top(scan.power, at)
            rows.append((float(scan.frequency @ [1.0, index]), float(np.sqrt(squared))))
    return rows


def _line_test(
    transform: np.ndarray[tuple[int], np.dtype[np.complex128]], n: int, first: int, last: int
) -> tuple[FloatArray, FloatArray]:
    """F statistic, and squared amplitude of the best sine, at indices of a padded transform.

    A taper sin(πk(j+1)/(n+1)) is the difference of two transforms, k half ordinates apart on
    either side: one padded transform holds all tapers.
    """
    k = np.arange(1, _TAPERS + 1)
    turn = np.exp(1j * np.pi * k / (n + 1))
    norm = np.sqrt(2 / (n + 1))
    # The sum of a taper over its samples; even tapers have none.
    weight = np.where(k % 2 == 1, norm / np.tan(np.pi * k / (2 * (n + 1))), 0.0)
    total = float(weight @ weight)
    shift = k * (_PER_ORDINATE // 2)
    f, power = np.empty(last - first), np.empty(last - first)
    for start in range(first, last, _BLOCK):
        index = np.arange(start, min(start + _BLOCK, last))
        left = transform[index[:, None] - shift] * turn
        tapered = (left - transform[index[:, None] + shift] * turn.conj()) * (norm / 2j)
        mean = tapered @ weight / total
        explained = np.abs(mean) ** 2 * total
        rest = np.sum(np.abs(tapered) ** 2, axis=1) - explained
        part = slice(start - first, start - first + index.size)
        f[part] = (_TAPERS - 1) * explained / rest.clip(1e-12 * explained + 1e-300)
        power[part] = 4 * np.abs(mean) ** 2
    return f, power


def _top(power: FloatArray, at: int) -> tuple[float, float]:
    """Place and height of the parabola through the logarithms of a maximum and its neighbours."""
    if not 0 < at < power.size - 1:
        return float(at), float(power[at])
    a, b, c = np.log(power[at - 1 : at + 2].clip(1e-300)).tolist()
    bend = a - 2 * b + c
    off = 0.5 * (a - c) / bend if bend < 0 else 0.0
    off = min(max(off, -0.5), 0.5)
    return at + off, float(np.exp(b - 0.25 * (a - c) * off))


def name_lines(
    seen: Iterable[tuple[str, float, float]], log: Log, stage: Stage | None, resolution: float
) -> tuple[Line, ...]:
    """Tell what each line is: an order of the velocity, mains, or unknown.

    Parameters
    ----------
    seen : iterable of (str, float, float)
        Channel, frequency in Hz and amplitude in m/s² of each; one line may stand there twice.
    log : Log
        Says how fast the stage moved.
    stage : Stage or None
        Knows the orders.
    resolution : float
        Of the spectrum, in Hz.

    Returns
    -------
    tuple of Line
        Ascending in frequency, each line once per channel.
    """
    velocities = [segment.velocity for segment in find_segments(log, 0.0)]
    bases = _bases(stage, velocities)
    named = [
        Line(frequency, amplitude, "m/s²", _kind(frequency, bases, resolution), channel)
        for channel, frequency, amplitude in seen
    ]
    return _once(named, resolution)


@dataclass(frozen=True, slots=True)
class _Sighting:
    """A line in one segment."""

    line: Line
    velocity: float
    resolution: float


def survey_lines(
    log: Log,
    channels: Sequence[Channel],
    stage: Stage | None,
    band: tuple[float, float],
    false_alarm: float = FALSE_ALARM,
) -> tuple[Line, ...]:
    """Find the lines of every stationary segment and tell them by how they follow the velocity.

    Parameters
    ----------
    log : Log
        Each segment is searched, and named by its own velocity.
    channels : sequence of Channel
        Which channels.
    stage : Stage or None
        Knows the orders. A line that it does not know, but that stands at one wavelength of
        several velocities, is called ``order of … mm``.
    band : (float, float)
        In Hz.
    false_alarm : float
        Probability that a channel without lines shows any, in all its segments together.

    Returns
    -------
    tuple of Line
        Ascending in frequency, each line once per channel, where it is strongest.
    """
    segments = find_segments(log, 0.0)
    lines: list[Line] = []
    for channel in channels:
        sightings = []
        for segment in segments:
            resolution = 1.5 * log.sample_rate / (segment.stop - segment.start)
            bases = _bases(stage, [segment.velocity])
            found = find_lines(channel, segment, log.sample_rate, band, false_alarm / len(segments))
            for frequency, amplitude in found.tolist():
                kind = _kind(frequency, bases, resolution)
                line = Line(frequency, amplitude, "m/s²", kind, channel.name)
                sightings.append(_Sighting(line, abs(segment.velocity), resolution))
        known = [s.line for s in sightings if s.line.kind != "unknown"]
        unknown = [s for s in sightings if s.line.kind == "unknown"]
        lines += _once([*known, *_orders(unknown)], 1.5 * _longest(log, segments))
    return tuple(sorted(lines, key=lambda line: (line.frequency, line.channel)))


def _longest(log: Log, segments: Sequence[Segment]) -> float:
    """Resolution of the longest segment in Hz."""
    return log.sample_rate / max((s.stop - s.start for s in segments), default=1)


def _bases(stage: Stage | None, velocities: Iterable[float]) -> list[tuple[float, str]]:
    orders = () if stage is None else stage.description.order
    return [(mains, "mains") for mains in _MAINS] + [
        (abs(velocity) / (order.wavelength_mm * 1e-3), order.name)
        for order in orders
        for velocity in velocities
    ]


def _kind(frequency: float, bases: list[tuple[float, str]], resolution: float) -> str:
    """Name a line by the base of which it is the lowest harmonic; mains before orders."""
    kind, lowest = "unknown", _MOST_HARMONICS + 1
    # A line that wanders is known no better than the stretches tell that it was found in.
    resolution = max(resolution, 0.5 * frequency / _COHERENT)
    for base, name in bases:
        # High harmonics of a slow order lie so close together that any line would be one.
        n = round(frequency / base) if base > 3 * resolution else 0
        if 1 <= n < lowest and abs(frequency - n * base) < resolution:
            kind, lowest = name, n
    return kind


def _orders(unknown: Sequence[_Sighting]) -> list[Line]:
    """Name the lines that other velocities show at the same wavelength and not where they were."""
    named = []
    for one in unknown:
        kind = "unknown"
        for other in unknown:
            apart = max(one.velocity, other.velocity) > _OTHER_VELOCITY * min(
                one.velocity, other.velocity
            )
            if not (apart and one.velocity > 0 and other.velocity > 0):
                continue
            expected = one.line.frequency * other.velocity / one.velocity
            # What the first does not resolve grows with the ratio of velocities.
            blur = other.resolution + one.resolution * other.velocity / one.velocity
            if abs(other.line.frequency - expected) < 0.5 * blur:
                kind = f"order of {1e3 * one.velocity / one.line.frequency:.3g} mm"
        named.append(replace(one.line, kind=kind))
    return named


def _once(lines: Iterable[Line], resolution: float) -> tuple[Line, ...]:
    """Keep each line once per channel, the strongest, ascending in frequency."""
    kept: list[Line] = []
    for line in sorted(lines, key=lambda s: (s.channel, -s.amplitude)):
        if all(
            other.channel != line.channel or abs(other.frequency - line.frequency) >= 3 * resolution
            for other in kept
        ):
            kept.append(line)
    return tuple(sorted(kept, key=lambda line: (line.frequency, line.channel)))
