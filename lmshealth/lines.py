"""Spectral lines: what the narrow peaks that are no modes come from."""

from __future__ import annotations

from collections.abc import Iterable

from lmshealth.logs import Log
from lmshealth.results import Line
from lmshealth.spectra import find_segments
from lmshealth.stage import Stage

_MAINS = (50.0, 60.0)
_MOST_HARMONICS = 10


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
    orders = () if stage is None else stage.description.order
    bases = [(mains, "mains") for mains in _MAINS] + [
        (abs(segment.velocity) / (order.wavelength_mm * 1e-3), order.name)
        for order in orders
        for segment in find_segments(log, 0.0)
    ]
    lines: list[Line] = []
    for channel, frequency, amplitude in sorted(seen, key=lambda s: (s[0], -s[2])):
        known = any(
            line.channel == channel and abs(line.frequency - frequency) < 3 * resolution
            for line in lines
        )
        if not known:
            kind = "unknown"
            for base, name in bases:
                if _is_harmonic(frequency, base, resolution):
                    kind = name
            lines.append(Line(frequency, amplitude, "m/s²", kind, channel))
    return tuple(sorted(lines, key=lambda line: (line.frequency, line.channel)))


def _is_harmonic(frequency: float, base: float, resolution: float) -> bool:
    # High harmonics of a slow order lie so close together that any line would be one.
    if not base > 0 or not 1 <= (n := round(frequency / base)) <= _MOST_HARMONICS:
        return False
    return abs(frequency - n * base) < resolution
