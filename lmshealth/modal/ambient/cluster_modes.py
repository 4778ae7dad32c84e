"""Estimates of a cluster from its posterior: diagnostics, credibility, and close modes.

`conclude` marginalises the nuisance parameters and rejects estimates that are not credible.
`refuse_close_modes` and `merge_close_modes` treat modes that the data do not separate.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from lmshealth._arrays import ComplexArray, FloatArray
from lmshealth.io.log import Refusal
from lmshealth.modal import constants
from lmshealth.modal.ambient.log_spectra import ClusterData, LogSpectra
from lmshealth.modal.ambient.whittle import Likelihood, marginalise
from lmshealth.modal.modes import Modes, Rejection, estimates_only, paired
from lmshealth.modal.targets import Target
from lmshealth.signal.constants import LINE_WIDTH
from lmshealth.signal.spectra import Spectrum

# Ordinates that a line covers to either side.
_LINE_BINS = 2


class LineEstimate(NamedTuple):
    """A line: channel, frequency in Hz, amplitude in m/s²."""

    channel: str
    frequency: float
    amplitude: float


@dataclass(frozen=True, slots=True, eq=False)
class ClusterModes:
    """Estimates of the modes of a cluster.

    Attributes
    ----------
    modes : Modes
        With shapes over the channels that show any of them.
    unit : ndarray
        Root of the noise of these channels in (m/s²)/Hz^½, shape ``(n_channels,)``.
    clarity : ndarray
        Gain in log likelihood of the binned spectra by each mode at its start, ``(n_modes,)``.
    lines : tuple of LineEstimate
        Lines excluded from the fit.
    residual : Spectrum
        Ordinates of the longest observation over their expectation, mean over the channels: one
        on average where the model fits; exactly one where a line was masked.
    """

    modes: Modes
    unit: FloatArray
    clarity: FloatArray
    lines: tuple[LineEstimate, ...]
    residual: Spectrum

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the modes."""
        return self.modes.names

    def keep(self, names: Iterable[str]) -> ClusterModes:
        """Keep the named modes; the others are marginalised."""
        kept = set(names)
        index = [i for i, name in enumerate(self.names) if name in kept]
        return replace(self, modes=self.modes.select(index), clarity=self.clarity[index])


@dataclass(frozen=True, slots=True, eq=False)
class ClusterFit:
    """Result of the fit of a cluster.

    Attributes
    ----------
    modes : ClusterModes or None
        Published modes, possibly none of them but lines; None where nothing was fitted.
    rejected : dict of str to Rejection
        Reason of each mode that is not published, by name.
    """

    modes: ClusterModes | None
    rejected: dict[str, Rejection]

    def refusals(self, log: str) -> list[Refusal]:
        """Return the rejections as refusals of a log, except of names that were assigned."""
        assigned = () if self.modes is None else self.modes.names
        return [
            Refusal(log=log, mode=name, reason=reason, detail=detail)
            for name, (reason, detail) in self.rejected.items()
            if name not in assigned
        ]


def conclude(
    data: ClusterData,
    targets: tuple[Target, ...],
    posterior: tuple[Likelihood, FloatArray],
    expected: list[ComplexArray],
    gains: dict[str, float],
) -> ClusterFit:
    """Marginalise the posterior, and publish the modes whose estimates are credible.

    ``posterior`` is the likelihood with its mode, shape ``(n_unknowns,)``; ``expected`` the
    expectation of each spectrum, ``(n_ordinates, n_channels, n_channels)``; ``gains`` the gain in
    log likelihood of the binned spectra by each mode.
    """
    likelihood, p = posterior
    estimate, cov, decrement = marginalise(likelihood, p)
    if not decrement < constants.WORST_DECREMENT:
        detail = f"the fit did not converge (Newton decrement {decrement:.2g}); record longer"
        return ClusterFit(
            None, dict.fromkeys((t.name for t in targets), Rejection("not-identified", detail))
        )
    f, zeta = np.exp(estimate).reshape(2, -1)
    ratio = likelihood.signal_to_noise(p)
    residual = _residual(data, expected)
    dispersion = _dispersion(residual, f, zeta)
    each = zip(targets, f.tolist(), zeta.tolist(), dispersion.tolist(), strict=True)
    channels = data.spectra.channels
    best = [channels[c] for c in ratio.argmax(axis=0)]
    sources = [data.spectra.source] * len(targets)
    modes = replace(
        estimates_only(estimate, cov, ratio.sum(axis=0), sources, best),
        names=tuple(target.name for target in targets),
        dispersion=dispersion,
        flags=tuple(_flags(*one, residual.duration) for one in each),
        shape_channels=channels,
        shapes=_unit_shapes(data.unit * likelihood.shapes(p).T),
    )
    clarity = np.array([gains[target.name] for target in targets])
    found = ClusterModes(modes, data.unit, clarity, masked_lines(data), residual)
    return _accept(found, targets, data.spectra)


def _unit_shapes(shapes: FloatArray) -> FloatArray:
    """Scale shapes, ``(n_modes, n_channels)``, to unit norm, the largest component positive."""
    shapes = shapes / np.linalg.norm(shapes, axis=1, keepdims=True)
    largest = np.take_along_axis(shapes, np.abs(shapes).argmax(axis=1, keepdims=True), axis=1)
    return np.asarray(shapes * np.sign(largest))


def _residual(data: ClusterData, expected: list[ComplexArray]) -> Spectrum:
    """Divide the ordinates of the longest observation by their expectation: tr E⁻¹ W."""
    spectrum, mask = data.spectra.spectra[data.longest], data.masks[data.longest]
    n_channels = len(data.binned)
    ratio = np.ones(mask.size)
    white = np.linalg.solve(expected[data.longest][mask], spectrum.matrix[mask])
    ratio[mask] = np.trace(white, axis1=1, axis2=2).real / n_channels
    return replace(spectrum.channel(0), periodogram=ratio, count=spectrum.count * n_channels)


def _dispersion(residual: Spectrum, f: FloatArray, zeta: FloatArray) -> FloatArray:
    """Return the variance of the residual within two half-power bandwidths over that of noise."""
    off = np.abs(residual.frequency - f[:, None])
    near = (off < 2 * (zeta * f)[:, None]) & (residual.periodogram != 1.0)
    squares = residual.count * (residual.periodogram - 1.0) ** 2
    n = near.sum(axis=1)
    return np.where(n >= constants.LEAST_ORDINATES, near @ squares / n.clip(1), np.nan)


def _flags(target: Target, f: float, zeta: float, dispersion: float, duration: float) -> str:
    """Return the flags of a mode in segments of this duration."""
    shift = abs(np.log(f / (target.nominal or target.frequency))) / np.log1p(target.search)
    low, high = _damping_bounds(target)
    bound = constants.AT_BOUND
    flags = {
        "resolution-limited": 2 * zeta * f * duration < constants.RESOLVED,
        "at-bound": shift > bound or not low / bound < zeta < high * bound,
        "loose-fit": dispersion > constants.LOOSE_FIT,
    }
    return " ".join(name for name, raised in flags.items() if raised)


def _damping_bounds(target: Target) -> tuple[float, float]:
    zeta, span = target.damping_ratio, constants.DAMPING_SPAN
    return zeta / span, min(zeta * span, max(constants.MOST_DAMPING, 2 * zeta))


def masked_lines(data: ClusterData) -> tuple[LineEstimate, ...]:
    """Return the masked lines of the longest observation, each in its strongest channel."""
    masked = data.spectra.spectra[data.longest].free & ~data.masks[data.longest]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], masked.astype(int), [0]])))
    return tuple(
        _read_line(data.spectra, data.unit, int(a), int(b))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    )


def _read_line(spectra: LogSpectra, unit: FloatArray, first: int, last: int) -> LineEstimate:
    """Read a line within some ordinates of the longest observation."""
    spectrum = max(spectra.spectra, key=lambda s: s.observed)
    power = np.diagonal(spectrum.matrix[first:last], axis1=1, axis2=2).real.sum(axis=0)
    c = int(np.argmax(power))
    frequency, amplitude = spectrum.channel(c).sine(first, last)
    return LineEstimate(spectra.channels[c], frequency, amplitude * float(unit[c]))


def _accept(found: ClusterModes, targets: tuple[Target, ...], spectra: LogSpectra) -> ClusterFit:
    """Reject estimates that are not credible; those that are lines are added to the lines."""
    longest = max(spectra.spectra, key=lambda s: s.observed)
    rejected: dict[str, Rejection] = {}
    lines = list(found.lines)
    for i, target in enumerate(targets):
        why = _incredible(found.modes, i, target, longest.duration)
        if why is None:
            continue
        rejected[target.name] = why
        if why.reason == "line-not-mode":
            k = int(np.searchsorted(longest.frequency, found.modes.frequency[i]))
            first, last = max(0, k - _LINE_BINS), k + _LINE_BINS + 1
            lines.append(_read_line(spectra, found.unit, first, last))
    kept = found.keep(name for name in found.names if name not in rejected)
    return ClusterFit(replace(kept, lines=tuple(lines)), rejected)


def _incredible(modes: Modes, i: int, target: Target, duration: float) -> Rejection | None:
    """Return why an estimate is not credible; None if it is."""
    channel = modes.channels[i]
    f, zeta = float(modes.frequency[i]), float(modes.damping_ratio[i])
    std_f, std_zeta = np.sqrt(np.diag(modes.cov))[paired([i], len(modes.names))].tolist()
    low, high = _damping_bounds(target)
    if 2 * zeta * f * duration < 1:
        return Rejection(
            "line-not-mode",
            f"{f:.5g} Hz in {channel} is narrower ({2 * zeta * f:.2g} Hz) than a record of "
            f"{duration:.3g} s resolves",
        )
    if target.nominal is None and 2 * zeta < LINE_WIDTH:
        return Rejection(
            "line-not-mode", f"{f:.5g} Hz in {channel} is as narrow as a line that wanders"
        )
    if modes.dispersion[i] > constants.POOR_FIT:
        return Rejection(
            "poor-fit",
            f"the residual near {f:.5g} Hz scatters {modes.dispersion[i]:.1f} times as much as "
            "noise: lines, unsteady operation or an impact; choose a steadier part of the log",
        )
    described = target.nominal or target.frequency
    if abs(np.log(f / described)) > np.log1p(target.search) or not low < zeta < high:
        return Rejection(
            "outside-search",
            f"the fit in {channel} converged to {f:.5g} Hz, damping {zeta:.2g}; the search is "
            f"within {100 * target.search:.0f} % of {described:.5g} Hz, damping from {low:.2g} "
            f"to {high:.2g}",
        )
    if std_f > constants.WORST_STD_LN_F or std_zeta > constants.WORST_STD_LN_ZETA:
        return Rejection(
            "too-uncertain",
            f"{f:.5g} Hz in {channel} has a standard deviation of {100 * std_f:.2g} %, its damping "
            f"of {100 * std_zeta:.0f} %; record longer or excite more",
        )
    return None


def refuse_close_modes(fit: ClusterFit) -> ClusterFit:
    """Reject pairs of named modes that the data do not separate.

    The rejection quotes their common frequency and damping with a standard deviation that covers
    both.
    """
    modes, rejected = fit.modes, fit.rejected
    while modes is not None and (pair := _closest(modes)) is not None:
        i, j = pair
        names = [modes.names[k] for k in pair]
        f = np.sort(modes.modes.frequency[[i, j]])
        mean = _common(modes, i, j).modes.select([i])
        detail = (
            f"resonances at {f[0]:.5g} and {f[1]:.5g} Hz cannot be separated; their mean is "
            f"{mean.frequency[0]:.5g} ± {mean.frequency_std[0]:.2g} Hz, damping "
            f"{100 * mean.damping_ratio[0]:.2g} %: record longer, or in a channel that they move "
            "differently"
        )
        rejected = rejected | dict.fromkeys(names, Rejection("too-close", detail))
        modes = modes.keep(name for name in modes.names if name not in names)
    return ClusterFit(modes, rejected)


def merge_close_modes(modes: ClusterModes) -> ClusterModes:
    """Replace pairs that the data do not separate by one mode with the flag ``cluster``."""
    while (pair := _closest(modes)) is not None:
        second = modes.names[pair[1]]
        modes = _common(modes, *pair).keep(name for name in modes.names if name != second)
    return modes


def _closest(found: ClusterModes) -> tuple[int, int] | None:
    """Return a pair of modes that are too close; None where there is none."""
    f, zeta = found.modes.frequency, found.modes.damping_ratio
    shapes = found.modes.shapes / found.unit
    shapes = shapes / np.linalg.norm(shapes, axis=1, keepdims=True)
    for i, j in combinations(range(f.size), 2):
        apart = abs(f[i] - f[j]) / (zeta[i] * f[i] + zeta[j] * f[j])
        alike = float(shapes[i] @ shapes[j]) ** 2 > constants.ALIKE
        if apart < (constants.APART_ALIKE if alike else constants.APART):
            return i, j
    return None


def _common(found: ClusterModes, i: int, j: int) -> ClusterModes:
    """Put the mean of two modes in the place of the first, its covariance covering both."""
    modes = found.modes
    m = len(modes.names)
    mean = np.eye(2 * m)
    for a, b in ((i, j), (m + i, m + j)):
        mean[a, [a, b]] = 0.5
    half = (modes.estimate[[i, m + i]] - modes.estimate[[j, m + j]]) / 2
    cov = mean @ modes.cov @ mean.T
    cov[[i, m + i], [i, m + i]] += half**2
    ln_f, ln_zeta = np.split(mean @ modes.estimate, 2)
    flags = [f"{flag} cluster".strip() if k == i else flag for k, flag in enumerate(modes.flags)]
    common = replace(modes, ln_frequency=ln_f, ln_damping=ln_zeta, cov=cov, flags=tuple(flags))
    return replace(found, modes=common)
