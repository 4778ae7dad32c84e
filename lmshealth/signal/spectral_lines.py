"""Spectral lines: detection, and naming by their sources (README.md, "Lines")."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from lmshealth._private.arrays import FloatArray
from lmshealth.io.log import Channel, Log
from lmshealth.signal import constants
from lmshealth.signal.multitaper_test import detect_sinusoids
from lmshealth.signal.segments import Segment, find_segments
from lmshealth.signal.spectra import as_acceleration, lag_gain
from lmshealth.stage.description import Stage


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
) -> tuple[Line, ...]:
    """Find the lines at every velocity of a log, and name those that are proportional to it.

    Segments of one speed are searched together, those less than half as long as the longest are
    omitted. A line that is no order of the description, but at one wavelength of several
    velocities, is named ``order of … mm``. The band is in Hz; `false_alarm` is the probability that
    a channel without lines shows any, at all velocities together. The result is ascending in
    frequency, each line once per channel, at its strongest.
    """
    segments = find_segments(log, 0.0)
    groups = _by_velocity(segments)
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
    """Name the unknown lines that have the same wavelength at another velocity.

    Each line has its velocity in m/s and the resolution of its frequency in Hz.
    """
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
