"""Spectral lines: where they stand, and what the narrow peaks that are no modes come from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from lmshealth._arrays import FloatArray
from lmshealth.io.log import Channel, Log
from lmshealth.signal.multitaper_test import detect_sinusoids
from lmshealth.signal.segments import Segment, find_segments
from lmshealth.signal.spectra import WANDER, as_acceleration, lag_gain
from lmshealth.stage.description import Stage


@dataclass(frozen=True, slots=True)
class Line:
    """A narrow spectral line that is no mode.

    Attributes
    ----------
    frequency : float
        In Hz.
    amplitude : float
        Of the sine, in the channel's unit.
    unit : str
        SI unit of the amplitude.
    kind : str
        What it was recognised as: a name of the stage's orders, ``mains`` or ``unknown``.
    channel : str
        The channel it was seen in.
    """

    frequency: float
    amplitude: float
    unit: str
    kind: str
    channel: str


# Probability that noise and resonances alone show a line somewhere in the band of one channel.
FALSE_ALARM = 0.01
_MAINS = (50.0, 60.0)
_MOST_HARMONICS = 10
# Two velocities are told apart from this ratio on.
_OTHER_VELOCITY = 1.02


def find_lines(
    channel: Channel,
    segment: Segment,
    sample_rate: float,
    band: tuple[float, float],
    false_alarm: float = FALSE_ALARM,
) -> FloatArray:
    """Find narrow lines in a segment by Thomson's test.

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
        Probability that a segment without lines shows any in the band; see
        `detect_sinusoids` for the resonances that this holds for.

    Returns
    -------
    ndarray
        Frequency in Hz and amplitude in m/s² of each, ascending, shape ``(n_lines, 2)``.

    References
    ----------
    Thomson1982, Riedel1995
    """
    return _find_together(channel, (segment,), sample_rate, band, false_alarm)


def _find_together(
    channel: Channel,
    segments: Sequence[Segment],
    sample_rate: float,
    band: tuple[float, float],
    false_alarm: float,
) -> FloatArray:
    """Find the lines that segments show together."""

    def read(number: int) -> tuple[FloatArray, int]:
        return as_acceleration(channel, segments[number], sample_rate, band[1])

    _, lag = read(0)
    lengths = [max(segment.stop - segment.start - 2 * lag, 0) for segment in segments]
    found = detect_sinusoids(lengths, lambda k: read(k)[0], sample_rate, band, false_alarm)
    if lag:
        found[:, 1] *= lag_gain(found[:, 0], lag, sample_rate)
    return found


def name_lines(
    seen: Sequence[tuple[str, float, float]], log: Log, stage: Stage | None, resolution: float
) -> tuple[Line, ...]:
    """Tell what each line is: an order of the velocity, mains, or unknown.

    Parameters
    ----------
    seen : sequence of (str, float, float)
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
    if not seen:
        return ()
    velocities = [segment.velocity for segment in find_segments(log, 0.0)]
    bases = _bases(stage, velocities)
    named = [
        Line(frequency, amplitude, "m/s²", _kind(frequency, bases, resolution), channel)
        for channel, frequency, amplitude in seen
    ]
    return _once(named, resolution)


@dataclass(frozen=True, slots=True)
class _Sighting:
    """A line at one velocity."""

    line: Line
    velocity: float
    resolution: float


def find_lines_by_velocity(
    log: Log,
    channels: Sequence[Channel],
    stage: Stage | None,
    band: tuple[float, float],
    false_alarm: float = FALSE_ALARM,
) -> tuple[Line, ...]:
    """Find the lines of every velocity and tell them by how they follow it.

    Parameters
    ----------
    log : Log
        Its segments of one velocity, whatever their direction, are searched together: short
        strokes show together what none shows alone. Those not half as long as the longest are
        left out.
    channels : sequence of Channel
        Which channels.
    stage : Stage or None
        Knows the orders. A line that it does not know, but that stands at one wavelength of
        several velocities, is called ``order of … mm``.
    band : (float, float)
        In Hz.
    false_alarm : float
        Probability that a channel without lines shows any, at all its velocities together.

    Returns
    -------
    tuple of Line
        Ascending in frequency, each line once per channel, where it is strongest.
    """
    segments = find_segments(log, 0.0)
    groups = _by_velocity(segments)
    lines: list[Line] = []
    for channel in channels:
        sightings = []
        for group in groups:
            velocity = abs(group[0].velocity)
            resolution = 0.5 * _ordinate(log, group)
            bases = _bases(stage, [velocity])
            share = false_alarm / len(groups)
            found = _find_together(channel, group, log.sample_rate, band, share)
            for frequency, amplitude in found.tolist():
                kind = _kind(frequency, bases, resolution)
                line = Line(frequency, amplitude, "m/s²", kind, channel.name)
                sightings.append(_Sighting(line, velocity, resolution))
        known = [s.line for s in sightings if s.line.kind != "unknown"]
        unknown = [s for s in sightings if s.line.kind == "unknown"]
        lines += _once([*known, *_orders(unknown)], 1.5 * _ordinate(log, segments))
    return tuple(sorted(lines, key=lambda line: (line.frequency, line.channel)))


def _by_velocity(segments: Sequence[Segment]) -> list[list[Segment]]:
    """Group segments of one velocity."""
    groups: list[list[Segment]] = []
    for segment in sorted(segments, key=lambda s: abs(s.velocity)):
        # Without a set point, NaN, all are one group.
        if groups and not abs(segment.velocity) > _OTHER_VELOCITY * abs(groups[-1][0].velocity):
            groups[-1].append(segment)
        else:
            groups.append([segment])
    return groups


def _ordinate(log: Log, segments: Sequence[Segment]) -> float:
    """Distance in Hz of the ordinates of the longest segment."""
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
    resolution = max(resolution, WANDER * frequency)
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
            if abs(other.line.frequency - expected) < blur:
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
