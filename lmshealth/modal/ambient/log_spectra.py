"""Spectra of all channels of a log, and binned ones that are robust to lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log
from lmshealth.modal.targets import Target
from lmshealth.signal.segments import find_segments
from lmshealth.signal.spectra import (
    ANY_RESONANCE,
    CrossSpectrum,
    ResonanceRange,
    Spectrum,
    cross_spectra,
    median_ordinate,
)


@dataclass(frozen=True, slots=True, eq=False)
class BinnedSpectrum:
    """Spectrum of one channel, binned by medians.

    Attributes
    ----------
    frequency, level, count : ndarray
        Mean frequency in Hz, density from the median in (m/s²)²/Hz, and number of ordinates of
        single segments, shape ``(n_bins,)``.
    neighbours : tuple of Target
        Modes outside the band whose flanks reach into it.
    """

    frequency: FloatArray
    level: FloatArray
    count: FloatArray
    neighbours: tuple[Target, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class LogSpectra:
    """Cross spectra of the segments of a log.

    Attributes
    ----------
    channels, sources : tuple of str
        Channel names, and ``acc`` or ``delta_e`` of each.
    spectra : tuple of CrossSpectrum
        Of segments, or means over several.
    """

    channels: tuple[str, ...]
    sources: tuple[str, ...]
    spectra: tuple[CrossSpectrum, ...]

    @property
    def source(self) -> str:
        """Source of all channels, or ``joint``."""
        return self.sources[0] if len(set(self.sources)) == 1 else "joint"

    @property
    def duration(self) -> float:
        """Duration of the longest segment in s."""
        return max(spectrum.duration for spectrum in self.spectra)

    @property
    def removed_lines(self) -> list[tuple[str, float, float]]:
        """Channel, frequency in Hz and amplitude in m/s² of lines subtracted from the samples."""
        return [(self.channels[c], f, a) for s in self.spectra for c, f, a in s.lines]

    def channel(self, index: int) -> tuple[Spectrum, ...]:
        """Return the spectra of one channel."""
        return tuple(spectrum.channel(index) for spectrum in self.spectra)

    def select(self, index: Sequence[int]) -> LogSpectra:
        """Keep some channels."""
        rows, columns = np.ix_(index, index)
        return LogSpectra(
            tuple(self.channels[c] for c in index),
            tuple(self.sources[c] for c in index),
            tuple(replace(s, matrix=s.matrix[:, rows, columns]) for s in self.spectra),
        )

    def band(self, low: float, high: float) -> LogSpectra:
        """Cut out a band in Hz."""
        cut = (spectrum.band(low, high) for spectrum in self.spectra)
        return replace(self, spectra=tuple(s for s in cut if s.frequency.size))

    def without(self, frequencies: Sequence[float]) -> LogSpectra:
        """Exclude the ordinates that lines at these frequencies in Hz may reach."""
        return replace(self, spectra=tuple(s.without(frequencies) for s in self.spectra))

    def binned(
        self, low: float, high: float, width: float, neighbours: tuple[Target, ...] = ()
    ) -> tuple[BinnedSpectrum, ...]:
        """Bin every channel; all have the same bins.

        Parameters
        ----------
        low, high : float
            Band in Hz.
        width : float
            Bin width in Hz; widened until a bin holds at least four ordinates.
        neighbours : tuple of Target
            Modes outside the band whose flanks reach into it.
        """
        cut = [spectrum.band(low, high) for spectrum in self.spectra]
        frequency = np.concatenate([s.frequency for s in cut])
        count = np.concatenate([np.full(s.frequency.size, float(s.count)) for s in cut])
        order = np.argsort(frequency, kind="stable")
        n_bins = max(3, min(int((high - low) / width), frequency.size // 4))
        # The first bins hold one ordinate more than the others.
        size, n_larger = divmod(frequency.size, n_bins)
        larger, smaller = np.split(order, [n_larger * (size + 1)])
        parts = [larger.reshape(n_larger, size + 1), smaller.reshape(n_bins - n_larger, size)]
        means = np.concatenate([frequency[part].mean(axis=1) for part in parts])
        counts = np.concatenate([count[part].sum(axis=1) for part in parts])
        binned = []
        for c in range(len(self.channels)):
            ordinates = np.concatenate(
                [s.matrix[:, c, c].real / median_ordinate(s.count) for s in cut]
            )
            level = np.concatenate([np.median(ordinates[part], axis=1) for part in parts])
            binned.append(BinnedSpectrum(means, level.clip(1e-300), counts, neighbours))
        return tuple(binned)


@dataclass(frozen=True, slots=True, eq=False)
class ClusterData:
    """Data that a cluster is fitted to.

    Attributes
    ----------
    spectra : LogSpectra
        The band, of the channels that show any of the modes, in units of their noise.
    unit : ndarray
        Root of the noise in (m/s²)/Hz^½, shape ``(n_channels,)``.
    binned : tuple of BinnedSpectrum
        The binned spectra in the same units.
    masks : tuple of ndarray of bool
        Ordinates of each spectrum without lines.
    """

    spectra: LogSpectra
    unit: FloatArray
    binned: tuple[BinnedSpectrum, ...]
    masks: tuple[BoolArray, ...]

    @property
    def longest(self) -> int:
        """Index of the spectrum with the longest observation."""
        return int(np.argmax([s.observed for s in self.spectra.spectra]))

    @property
    def n_ordinates(self) -> int:
        """Number of ordinates of single segments without lines."""
        pairs = zip(self.spectra.spectra, self.masks, strict=True)
        return sum(spectrum.count * int(mask.sum()) for spectrum, mask in pairs)


def transform(
    log: Log,
    channels: Sequence[Channel],
    top: float,
    *,
    shortest: float,
    ceiling: float,
    highest: float = 0.0,
    resonances: Sequence[ResonanceRange] = ANY_RESONANCE,
) -> LogSpectra:
    """Transform the stationary segments of a log.

    Parameters
    ----------
    log : Log
        Any.
    channels : sequence of Channel
        Its displacements and accelerations.
    top, ceiling, resonances : float, float, sequence of ResonanceRange
        As in `cross_spectra`.
    shortest : float
        Shorter segments are left out, in s.
    highest : float
        Frequency in Hz that the sample rate must resolve.

    Raises
    ------
    BadLog
        If the sample rate is too low, or no segment is long enough.
    """
    segments = find_segments(log, shortest)
    if highest > log.sample_rate / 2:
        raise BadLog(
            log.name,
            "sample-rate",
            f"{log.sample_rate:g} Hz cannot show modes up to {highest:.0f} Hz; "
            f"needed is at least {2 * highest:.0f} Hz",
        )
    if not segments:
        longest = max((b - a for a, b in log.pieces), default=0) / log.sample_rate
        raise BadLog(
            log.name,
            "too-short",
            f"no segment of constant velocity without gaps lasts {shortest:.3g} s, which the modes "
            f"need; the longest piece without gaps has {longest:.3g} s",
        )
    return LogSpectra(
        tuple(channel.name for channel in channels),
        tuple("delta_e" if c.kind == "displacement" else "acc" for c in channels),
        cross_spectra(
            channels, segments, log.sample_rate, top, ceiling=ceiling, resonances=resonances
        ),
    )
