"""Estimates of a cluster, and modes of it that the data do not separate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from lmshealth._private.arrays import ComplexArray, FloatArray
from lmshealth.io.log import Refusal
from lmshealth.modal import constants
from lmshealth.modal.modes import Modes, Rejection
from lmshealth.signal.spectra import CrossSpectrum


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
    expected: ComplexArray  # of its matrix, by the fit; infinite at lines


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

    def rename(self, names: dict[str, str]) -> ClusterModes:
        """Keep the modes that get a new name."""
        kept = self.keep(names)
        named = replace(kept.modes, names=tuple(names[name] for name in kept.names))
        return replace(kept, modes=named)


@dataclass(frozen=True, slots=True, eq=False)
class ClusterFit:
    """Result of the fit of a cluster."""

    # those published, possibly only lines; None where nothing was fitted
    modes: ClusterModes | None
    rejected: dict[str, Rejection]  # by the names of the modes that are not published

    def refusals(self, log: str) -> list[Refusal]:
        """Return the rejections as refusals of a log, except of names that were assigned."""
        assigned = () if self.modes is None else self.modes.names
        return [
            Refusal(log, why.reason, why.detail, mode=name, frequency=why.frequency)
            for name, why in self.rejected.items()
            if name not in assigned
        ]


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
        rejected = rejected | dict.fromkeys(
            names, Rejection("too-close", detail, float(mean.frequency[0]))
        )
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
    shapes = found.modes.shapes / found.fitted.unit
    shapes = shapes / np.linalg.norm(shapes, axis=1, keepdims=True)
    for i, j in combinations(range(f.size), 2):
        apart = abs(f[i] - f[j]) / (zeta[i] * f[i] + zeta[j] * f[j])
        alike = float(shapes[i] @ shapes[j]) ** 2 > constants.ALIKE_MAC
        if apart < (constants.SEPARATION_ALIKE if alike else constants.SEPARATION):
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
    apart = np.zeros(2 * m)
    apart[[i, m + i]] = half**2
    cov = mean @ modes.cov @ mean.T
    ln_f, ln_zeta = np.split(mean @ modes.estimate, 2)
    flags = [f"{flag} cluster".strip() if k == i else flag for k, flag in enumerate(modes.flags)]
    common = replace(modes, ln_frequency=ln_f, ln_damping=ln_zeta, cov=cov, flags=tuple(flags))
    return replace(found, modes=common.widened("cluster", cov + np.diag(apart)))


def drop_duplicates(found: list[ClusterModes]) -> list[ClusterModes]:
    """Drop modes within half a half-power bandwidth of a clearer one of another cluster."""
    rows = [
        (float(clarity), float(ln_f), float(zeta), name)
        for one in found
        for clarity, ln_f, zeta, name in zip(
            one.clarity, one.modes.ln_frequency, one.modes.damping_ratio, one.names, strict=True
        )
    ]
    kept: list[tuple[float, float, float, str]] = []
    for row in sorted(rows, reverse=True):
        if all(abs(row[1] - other[1]) > 0.5 * (row[2] + other[2]) for other in kept):
            kept.append(row)
    return [one.keep(row[3] for row in kept) for one in found]
