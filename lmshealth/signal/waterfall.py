"""Waterfall of a life: relative spectra of all logs in the band of the tracked modes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import fft

from lmshealth._arrays import FloatArray, freeze
from lmshealth.io.log import Log
from lmshealth.signal import constants
from lmshealth.signal.segments import Segment, find_segments
from lmshealth.signal.spectra import Spectrum, periodogram
from lmshealth.signal.spectral_lines import Line
from lmshealth.stage.description import Stage

# Power below this share of a channel's median is rounding.
_LEAST_SHARE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class RelativeSpectrum:
    """Spectrum of a log relative to its median in the band of the tracked modes.

    Ends of the band in Hz, and level in dB in bins of equal width in ln f, NaN above half the
    sample rate, shape ``(n_bins,)``.
    """

    low: float
    high: float
    level: FloatArray

    def __post_init__(self) -> None:
        freeze(self, ("level", self.level.size))

    @property
    def edges(self) -> FloatArray:
        """Edges of the bins in Hz, shape ``(n_bins + 1,)``."""
        return np.geomspace(self.low, self.high, self.level.size + 1)


@dataclass(frozen=True, slots=True, eq=False)
class Waterfall:
    """Relative spectra and lines of the logs of a machine.

    Edges of the bins in Hz, shape ``(n_bins + 1,)``; levels in dB, NaN where a log has none,
    ``(n_logs, n_bins)``; and the lines of each log within the band.
    """

    edges: FloatArray
    level: FloatArray
    lines: tuple[tuple[Line, ...], ...]

    def __post_init__(self) -> None:
        freeze(self, ("level", len(self.lines), self.edges.size - 1))

    @classmethod
    def stack(cls, logs: Sequence[tuple[RelativeSpectrum | None, Sequence[Line]]]) -> Self | None:
        """Stack logs of one description; None without any spectrum."""
        first = next((levels for levels, _ in logs if levels is not None), None)
        if first is None:
            return None
        missing = np.full(first.level.size, np.nan)
        return cls(
            edges=first.edges,
            level=np.stack([missing if own is None else own.level for own, _ in logs]),
            lines=tuple(
                tuple(line for line in lines if first.low <= line.frequency <= first.high)
                for _, lines in logs
            ),
        )


def shown_band(stage: Stage) -> tuple[float, float]:
    """Return the band in Hz in which the tracked modes of a stage are searched."""
    modes = [mode for mode in stage.modes if mode.tracked] or stage.modes
    low = min(mode.frequency_hz * (1 - mode.search) for mode in modes)
    return low, max(mode.frequency_hz * (1 + mode.search) for mode in modes)


def relative_spectrum(
    log: Log, stage: Stage, *, n_bins: int = constants.WATERFALL_BINS
) -> RelativeSpectrum | None:
    """Compute the spectrum of a log relative to its median in the band of the tracked modes.

    Periodograms of parts of the constant-velocity segments are averaged within bins. Each channel,
    also a displacement as acceleration, is divided by its median over the band, and the mean of all
    channels is returned: logs of different velocity, load or sensors then differ in their
    resonances only. None without a channel, a segment of twenty periods, or a sufficient sample
    rate.
    """
    low, high = shown_band(stage)
    edges = np.geomspace(low, high, n_bins + 1)
    channels = [c for c in log.channels if c.kind in ("displacement", "acceleration")]
    stationary = find_segments(log, constants.WATERFALL_PERIODS / low)
    segments = _cut(stationary, log.sample_rate / np.diff(edges)[0])
    below = edges[1:] < log.sample_rate / 2
    if not channels or not segments or not below.any():
        return None
    total = np.zeros(n_bins)
    for channel in channels:
        spectra = [
            periodogram(channel, s, log.sample_rate, high, ceiling=1.1 * high) for s in segments
        ]
        duration = np.array([spectrum.duration for spectrum in spectra])
        binned = np.array([bin_density(spectrum, edges) for spectrum in spectra])
        density = duration @ binned / duration.sum()
        middle = float(np.median(density[below]))
        if middle > 0:
            total += density / middle
    if not total[below].any():
        return None
    decibel = 10 * np.log10((total / len(channels)).clip(_LEAST_SHARE))
    return RelativeSpectrum(low, high, np.where(below, decibel, np.nan))


def _cut(segments: Sequence[Segment], size: float) -> list[Segment]:
    """Cut segments into parts that just resolve the bins; the rest of a segment is omitted."""
    n = fft.next_fast_len(int(np.ceil(size)), real=True)
    parts = []
    for segment in segments:
        starts = range(segment.start, segment.stop - n + 1, n)
        parts += [replace(segment, start=at, stop=at + n) for at in starts] or [segment]
    return parts


def bin_density(spectrum: Spectrum, edges: FloatArray) -> FloatArray:
    """Average a spectrum within bins, shape ``(n_bins,)``.

    An ordinate is the density within half a spacing: narrow bins have a value, and power is kept.
    """
    half = 0.5 / spectrum.duration
    places = np.append(spectrum.frequency - half, spectrum.frequency[-1] + half)
    power = np.append(0.0, np.cumsum(spectrum.periodogram)) / spectrum.duration
    return np.asarray(np.diff(np.interp(edges, places, power)) / np.diff(edges))
