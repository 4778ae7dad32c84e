"""Estimates of a cluster, and modes of it that the data do not separate."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from lmshealth._private.arrays import FloatArray
from lmshealth.modal import constants
from lmshealth.modal.modes import Modes, Rejection
from lmshealth.signal.spectra import CrossSpectrum

# Reasons of rejections that leave a resonance.
_RESONANT = ("poor-fit", "too-uncertain")


class LineEstimate(NamedTuple):
    """A line: channel, frequency in Hz, amplitude in m/s²."""

    channel: str
    frequency: float
    amplitude: float


@dataclass(frozen=True, slots=True, eq=False)
class FittedSpectrum:
    """Cross spectrum of the longest observation that a cluster was fitted to."""

    channels: tuple[str, ...]
    unit: FloatArray  # root of the noise of the channels in (m/s²)/Hz^½, (n_channels,)
    spectrum: CrossSpectrum  # in these units
    density: FloatArray  # of the channels by the fit, infinite at lines, (n_ordinates, n_channels)
    residual: FloatArray  # ordinates over their expectation, NaN at lines, (n_ordinates,)
    count: int  # exponential variables that it is the mean of


@dataclass(frozen=True, slots=True, eq=False)
class ClusterModes:
    """Estimates of the modes of a cluster."""

    modes: Modes  # with shapes over the channels that show any of them
    clarity: FloatArray  # loss of log likelihood without each, the others fixed, (n_modes,)
    lines: tuple[LineEstimate, ...]  # excluded from the fit
    fitted: FittedSpectrum

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
    """Result of the fit of a cluster."""

    modes: ClusterModes | None  # all that were fitted, possibly only lines; None if none was
    rejected: dict[str, Rejection]  # by the names of the modes that are not credible

    @property
    def credible(self) -> ClusterModes | None:
        """Modes that are not rejected."""
        if self.modes is None:
            return None
        return self.modes.keep(name for name in self.modes.names if name not in self.rejected)

    @property
    def resonances(self) -> ClusterModes | None:
        """Modes that are credible, or would be with more data: those that compete for names."""
        if self.modes is None:
            return None
        none = [name for name, why in self.rejected.items() if why.reason not in _RESONANT]
        return self.modes.keep(name for name in self.modes.names if name not in none)

    def keep(self, names: Iterable[str]) -> ClusterFit:
        """Forget modes, and their rejections."""
        kept = set(names)
        rejected = {name: why for name, why in self.rejected.items() if name in kept}
        return ClusterFit(None if self.modes is None else self.modes.keep(kept), rejected)


def separate(fit: ClusterFit, described: Container[str]) -> ClusterFit:
    """Leave no pair of modes that the data do not separate.

    Two described modes are rejected: the rejection quotes their common frequency and damping with a
    standard deviation that covers both. Any other pair is replaced by one mode with the flag
    ``cluster``, under the name of the described one.
    """
    while (pair := _closest(fit)) is not None:
        one, other = sorted(pair, key=lambda name: name not in described)
        if other in described:
            too_close = dict.fromkeys(pair, _too_close(fit, one, other))
            fit = replace(fit, rejected=fit.rejected | too_close)
        else:
            fit = _joined(fit, one, other)
    return fit


def join_surplus(fits: Sequence[ClusterFit], most: int) -> list[ClusterFit]:
    """Join pairs that the data do not separate while there are more modes than described ones."""
    fits = list(fits)
    n = sum(len(one.names) for fit in fits if (one := fit.credible) is not None)
    for k, fit in enumerate(fits):
        while n > most and (pair := _closest(fit)) is not None:
            fit = _joined(fit, *pair)
            n -= 1
        fits[k] = fit
    return fits


def _joined(fit: ClusterFit, one: str, other: str) -> ClusterFit:
    """Put the mean of two modes in the place of the first."""
    assert fit.modes is not None
    names = fit.modes.names
    common = _common(fit.modes, names.index(one), names.index(other))
    return replace(fit, modes=common).keep({*names, *fit.rejected} - {other})


def _too_close(fit: ClusterFit, one: str, other: str) -> Rejection:
    assert fit.modes is not None
    i, j = (fit.modes.names.index(name) for name in (one, other))
    f = np.sort(fit.modes.modes.frequency[[i, j]])
    mean = _common(fit.modes, i, j).modes.select([i])
    detail = (
        f"resonances at {f[0]:.5g} and {f[1]:.5g} Hz cannot be separated; their mean is "
        f"{mean.frequency[0]:.5g} ± {mean.frequency_std[0]:.2g} Hz, damping "
        f"{100 * mean.damping_ratio[0]:.2g} %: record longer, or in a channel that they move "
        "differently"
    )
    return Rejection("too-close", detail, float(mean.frequency[0]))


def _closest(fit: ClusterFit) -> tuple[str, str] | None:
    """Return the names of a pair of credible modes that are too close; None without one."""
    found = fit.credible
    if found is None:
        return None
    f, zeta = found.modes.frequency, found.modes.damping_ratio
    shapes = found.modes.shapes / found.fitted.unit
    shapes = shapes / np.linalg.norm(shapes, axis=1, keepdims=True)
    for i, j in combinations(range(f.size), 2):
        apart = abs(f[i] - f[j]) / (zeta[i] * f[i] + zeta[j] * f[j])
        alike = float(shapes[i] @ shapes[j]) ** 2 > constants.ALIKE_MAC
        if apart < (constants.SEPARATION_ALIKE if alike else constants.SEPARATION):
            return found.names[i], found.names[j]
    return None


def _common(found: ClusterModes, i: int, j: int) -> ClusterModes:
    """Put the mean of two modes in the place of the first, its covariance covering both."""
    modes = found.modes
    m = len(modes.names)
    mean = np.eye(2 * m)
    for a, b in ((i, j), (m + i, m + j)):
        mean[a, [a, b]] = 0.5
    half = (modes.estimate[[i, m + i]] - modes.estimate[[j, m + j]]) / 2
    apart = np.zeros(2 * m)
    apart[[i, m + i]] = half**2
    cov = mean @ modes.cov @ mean.T
    ln_f, ln_zeta = np.split(mean @ modes.estimate, 2)
    flags = [f"{flag} cluster".strip() if k == i else flag for k, flag in enumerate(modes.flags)]
    common = replace(modes, ln_frequency=ln_f, ln_damping=ln_zeta, cov=cov, flags=tuple(flags))
    return replace(found, modes=common.widened("cluster", cov + np.diag(apart)))


def drop_duplicates(fits: Sequence[ClusterFit]) -> list[ClusterFit]:
    """Drop modes within half a half-power bandwidth of a clearer one of another cluster.

    Two modes of one cluster are those that its fit separates; a narrow mode on a broad one is
    another mode.
    """
    rows = [
        (float(clarity), float(ln_f), float(zeta), k, name)
        for k, fit in enumerate(fits)
        if (one := fit.credible) is not None
        for clarity, ln_f, zeta, name in zip(
            one.clarity, one.modes.ln_frequency, one.modes.damping_ratio, one.names, strict=True
        )
    ]
    kept: list[tuple[float, float, float, int, str]] = []
    dropped: set[str] = set()
    for row in sorted(rows, reverse=True):
        if all(
            row[3] == other[3]
            or abs(row[1] - other[1]) > 0.5 * (row[2] + other[2])
            or abs(np.log(row[2] / other[2])) > np.log(constants.DUPLICATE_DAMPING)
            for other in kept
        ):
            kept.append(row)
        else:
            dropped.add(row[4])
    return [
        fit if fit.modes is None else fit.keep({*fit.modes.names, *fit.rejected} - dropped)
        for fit in fits
    ]
