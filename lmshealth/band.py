"""The band of a cluster: what of a log it is fitted to, and the lines that are kept out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import gamma

from lmshealth.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.blocks import Block, make_block
from lmshealth.spectra import CrossSpectrum, Spectrum, median_ordinate
from lmshealth.starts import Coarse, Target, misfits, strengths

# Probability that noise alone makes a line somewhere in the band.
_LINE_FALSE_ALARM = 1e-3
LINE_BINS = 2
_BESIDE = 41  # ordinates: a line is less than half as wide
# Binned log likelihood gained by a mode below which it is absent.
ABSENT = 3.0
# A shape begins by the sign it has within so many damping ratios of the resonance.
_NEAR = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A log in the frequency domain.

    Attributes
    ----------
    channels, sources : tuple of str
        Names, and ``acc`` or ``delta_e``.
    spectra : tuple of CrossSpectrum
        Of its segments, or means over several.
    """

    channels: tuple[str, ...]
    sources: tuple[str, ...]
    spectra: tuple[CrossSpectrum, ...]

    @property
    def source(self) -> str:
        """The source of all channels, or ``joint``."""
        return self.sources[0] if len(set(self.sources)) == 1 else "joint"

    def single(self, index: int) -> tuple[Spectrum, ...]:
        """Give the spectra of one channel."""
        return tuple(spectrum.channel(index) for spectrum in self.spectra)

    def only(self, index: Sequence[int]) -> View:
        """Keep some channels."""
        rows, columns = np.ix_(index, index)
        return View(
            tuple(self.channels[c] for c in index),
            tuple(self.sources[c] for c in index),
            tuple(replace(s, matrix=s.matrix[:, rows, columns]) for s in self.spectra),
        )

    def band(self, low: float, high: float) -> View:
        """Cut out a band in Hz."""
        cut = (spectrum.band(low, high) for spectrum in self.spectra)
        return replace(self, spectra=tuple(s for s in cut if s.frequency.size))


@dataclass(frozen=True, slots=True)
class Sighting:
    """A line in a channel: frequency in Hz, amplitude in m/s²."""

    channel: str
    frequency: float
    amplitude: float


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """What a cluster is fitted to; its masks grow as lines are found.

    Attributes
    ----------
    view : View
        The band, of the channels that see any of the modes, each in units of its noise.
    unit : ndarray
        Root of the noise in (m/s²)/Hz^½, shape ``(n_channels,)``.
    coarse : tuple of Coarse
        Their binned spectra in the same units.
    masks : list of ndarray of bool
        Ordinates of each spectrum that hold no line.
    """

    view: View
    unit: FloatArray
    coarse: tuple[Coarse, ...]
    masks: list[BoolArray]


def prepare(view: View, coarse: tuple[Coarse, ...], seen: tuple[Target, ...]) -> Band:
    """Choose the channels that see any of the modes, and put each in units of its noise."""
    gains = misfits(coarse, ()) - misfits(coarse, seen)
    index = [c for c, gain in enumerate(gains) if gain >= ABSENT] or [int(np.argmax(gains))]
    used = [coarse[c] for c in index]
    noise = np.maximum(strengths(used, seen)[1], [1e-2 * c.level.min() for c in used])
    unit = np.sqrt(noise)
    chosen = view.only(index)
    spectra = tuple(replace(s, matrix=s.matrix / np.outer(unit, unit)) for s in chosen.spectra)
    return Band(
        replace(chosen, spectra=spectra),
        unit,
        tuple(replace(c, level=c.level / n) for c, n in zip(used, noise, strict=True)),
        [s.free.copy() for s in spectra],
    )


def alike(spectra: Sequence[CrossSpectrum]) -> list[list[int]]:
    """Group the indices of spectra that have the same frequencies."""
    groups: dict[tuple[float, int], list[int]] = {}
    for i, spectrum in enumerate(spectra):
        groups.setdefault((spectrum.duration, spectrum.frequency.size), []).append(i)
    return list(groups.values())


def make_blocks(
    band: Band, bandwidth: float, near: Sequence[float] | None = None
) -> tuple[Block, ...]:
    """Prepare the ordinates for the likelihood; ``bandwidth`` and ``near`` as in `make_block`."""
    spectra = band.view.spectra
    return tuple(
        make_block(
            [spectra[i] for i in group], [band.masks[i] for i in group], bandwidth, near=near
        )
        for group in alike(spectra)
    )


def sign(blocks: tuple[Block, ...], target: Target, channel: int, reference: int) -> float:
    """Tell whether two channels move alike where a mode stands."""
    low, high = target.band(_NEAR)
    alike = 0.0
    for block in blocks:
        near = (block.frequency >= low) & (block.frequency <= high)
        alike += float(block.count[near] @ block.matrix[near, channel, reference].real)
    return 1.0 if alike >= 0 else -1.0


def mask_towers(band: Band) -> None:
    """Mask lines that tower over the medians around them, before a mode can settle on one.

    A mode that takes a strong line for its resonance leaves its own to its neighbour, which then
    bears the wrong name. Twice the threshold leaves room for what the bins do not resolve. A lone
    mode whose damping is below about 1/15 of its nominal one stands as narrow as a line, and may
    lose its own peak.
    """
    levels = [
        np.stack([np.interp(s.frequency, c.frequency, c.level) for c in band.coarse], axis=-1)
        for s in band.view.spectra
    ]
    _mask_above(band, [2 * level for level in levels])


def mask_lines(band: Band, expected: list[ComplexArray]) -> bool:
    """Mask ordinates that noise would not reach; tell whether there were new ones."""
    levels = [
        _beside(spectrum, np.diagonal(e, axis1=1, axis2=2).real)
        for spectrum, e in zip(band.view.spectra, expected, strict=True)
    ]
    return _mask_above(band, levels)


def _beside(spectrum: CrossSpectrum, expected: FloatArray) -> FloatArray:
    """Raise what a mean is expected to be to the level about it: what a fit lacks is no line.

    A single periodogram scatters too much for that, and lines tower over what its fit lacks.
    """
    if spectrum.count == 1:
        return expected
    ordinates = np.diagonal(spectrum.matrix, axis1=1, axis2=2).real
    ratio = ordinates / expected / median_ordinate(spectrum.count)
    return np.asarray(expected * median_filter(ratio, (_BESIDE, 1)).clip(1.0))


def _mask_above(band: Band, levels: list[FloatArray]) -> bool:
    """Mask lines with their feet, wherever a channel shows one; tell whether there were any.

    ``levels`` holds what noise would have in the mean, shape ``(n_ordinates, n_channels)`` each.
    """
    n_tests = len(band.coarse) * sum(int(mask.sum()) for mask in band.masks)
    kept = [mask.copy() for mask in band.masks]
    found = False
    for spectrum, keep, level in zip(band.view.spectra, kept, levels, strict=True):
        highest = gamma.isf(_LINE_FALSE_ALARM / n_tests, spectrum.count) / spectrum.count
        ordinates = np.diagonal(spectrum.matrix, axis1=1, axis2=2).real
        lines = keep & (ordinates > highest * level).any(axis=1)
        found = found or bool(lines.any())
        for k in np.flatnonzero(lines).tolist():
            keep[max(0, k - LINE_BINS) : k + LINE_BINS + 1] = False
    # A band that is mostly lines is no band of modes: keep at least half of it.
    if sum(int(keep.sum()) for keep in kept) < sum(int(mask.sum()) for mask in band.masks) // 2:
        return False
    band.masks[:] = kept
    return found


def index_of_most(spectra: Sequence[CrossSpectrum]) -> int:
    """Index of the spectrum that saw most."""
    return int(np.argmax([s.observed for s in spectra]))


def find_sightings(band: Band) -> tuple[Sighting, ...]:
    """Tell what was masked where most was seen, in the channels that show it best."""
    most = index_of_most(band.view.spectra)
    masked = band.view.spectra[most].free & ~band.masks[most]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], masked.astype(int), [0]])))
    return tuple(
        read_sighting(band.view, band.unit, int(a), int(b))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    )


def read_sighting(view: View, unit: FloatArray, first: int, last: int) -> Sighting:
    """Read a line within some ordinates, from the channel in which it stands out most."""
    spectrum = view.spectra[index_of_most(view.spectra)]
    power = np.diagonal(spectrum.matrix[first:last], axis1=1, axis2=2).real.sum(axis=0)
    c = int(np.argmax(power))
    frequency, amplitude = spectrum.channel(c).sine(first, last)
    return Sighting(view.channels[c], frequency, amplitude * float(unit[c]))
