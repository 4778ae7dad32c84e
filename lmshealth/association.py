"""Who is who: estimates of many logs given to the modes of one machine.

Names are strong evidence and not infallible: a finder that names its peaks by frequency gives wrong
names once two modes have crossed. What frequencies, dampings and shapes did before then decides,
and where it does not, the estimate is given to nobody.

Where one explanation of a log is possible, it is taken. Where modes come near each other, all
explanations that are not hopeless are followed [Reid1979]_, and an estimate gets a label once that
label has nearly all of their weight. No label uses later logs.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lmshealth.arrays import FloatArray, expect_shape, freeze
from lmshealth.errors import BadTable, NotEnoughData
from lmshealth.filterbank import LEAST_LOGS, Readings
from lmshealth.identities import SURE, Identities, Verdict

Reason = Literal["ambiguous", "jump", "spurious"]


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """What one log says.

    Attributes
    ----------
    names : tuple of str
        Names that the identification gave, empty where it gave none.
    sources : tuple of str
        What each was seen by. Two estimates of one source are never of one mode.
    ln_frequency, ln_damping : ndarray
        Of each estimate, shape ``(n,)``, of f in Hz and of the ratio ζ; ln ζ is NaN where unknown.
    cov : ndarray
        Covariance of ``[ln f, ln ζ]``, ``(2 n, 2 n)``; NaN where ln ζ is unknown.
    shapes : ndarray
        Real shapes, ``(n, n_channels)``, of any length; NaN where a channel is absent.

    Raises
    ------
    ValueError
        If shapes of arrays do not belong together.
    """

    names: tuple[str, ...]
    sources: tuple[str, ...]
    ln_frequency: FloatArray
    ln_damping: FloatArray
    cov: FloatArray
    shapes: FloatArray

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(self.sources) != n:
            raise ValueError(f"sources has {len(self.sources)} entries, needed {n}")
        expect_shape("ln_frequency", self.ln_frequency, (n,))
        expect_shape("ln_damping", self.ln_damping, (n,))
        expect_shape("cov", self.cov, (2 * n, 2 * n))
        if self.shapes.ndim != 2:
            raise ValueError(f"shapes has {self.shapes.ndim} dimensions, needed 2")
        expect_shape("shapes", self.shapes, (n, self.shapes.shape[1]))
        freeze(self)


@dataclass(frozen=True, slots=True)
class Doubt:
    """An estimate that is given to no mode.

    Attributes
    ----------
    epoch, estimate : int
        Which it is.
    reason : str
        ``ambiguous``, ``jump`` or ``spurious``.
    detail : str
        What is known, in a sentence.
    """

    epoch: int
    estimate: int
    reason: Reason
    detail: str


@dataclass(frozen=True, slots=True)
class Association:
    """Which mode each estimate is of.

    Attributes
    ----------
    modes : tuple of str
        Ascending in first frequency; those without a name are named by frequency.
    assigned : tuple
        For each log and each of its estimates the mode, or None.
    doubts : tuple of Doubt
        One for each None, in order.
    """

    modes: tuple[str, ...]
    assigned: tuple[tuple[str | None, ...], ...]
    doubts: tuple[Doubt, ...]


def associate(
    epochs: Sequence[Estimates],
    clock: FloatArray,
    *,
    offsets: FloatArray,
    prior_std: FloatArray,
    jumps: Collection[int] = (),
) -> Association:
    """Give the estimates of all logs to modes.

    Parameters
    ----------
    epochs : sequence of Estimates
        One for each log, with equally many channels of shapes.
    clock : ndarray
        Ascending odometer or time in any unit, shape ``(n_epochs,)``.
    offsets : ndarray
        Covariates about their references, ``(n_epochs, n_covariates)``; 0 where unknown.
    prior_std : ndarray
        Prior standard deviation of d ln f per unit of each covariate, ``(n_covariates,)``.
    jumps : collection of int
        Epochs at which frequencies may step, as after declared maintenance.

    Returns
    -------
    Association
        The labels of a log rest on it and on earlier logs.

    Raises
    ------
    NotEnoughData
        If there is no log.
    BadTable
        If an estimate is not finite or has no positive variance, logs differ in the number of
        channels, the clock descends, or covariates, their prior or jumps do not fit the logs.

    References
    ----------
    [BarShalom1988]_, [Reid1979]_, [Murty1968]_, [Allemang2003]_
    """
    clock, offsets, prior_std = (np.asarray(a, float) for a in (clock, offsets, prior_std))
    _check(epochs, clock, offsets, prior_std, jumps)
    identities = Identities(prior_std, epochs[0].shapes.shape[1])
    scales = _scales(clock)
    assigned: list[tuple[str | None, ...]] = []
    doubts: list[Doubt] = []
    for k, estimates in enumerate(epochs):
        step = float(clock[k] - clock[k - 1]) if k else 0.0
        identities.move(k, step, scales[k], offsets[k], opened=k in jumps)
        labels: list[str | None] = [None] * len(estimates.names)
        names, readings = estimates.names, _readings(k, estimates)
        for verdict in identities.see(names, estimates.sources, readings):
            for i, (row, mode) in enumerate(zip(verdict.scan.rows, verdict.modes, strict=True)):
                if mode >= 0:
                    labels[row] = identities.names[mode]
                else:
                    doubts.append(_doubt(verdict, i, names[row], identities.names))
        assigned.append(tuple(labels))
    order = np.argsort(identities.first, kind="stable")
    doubts.sort(key=lambda doubt: (doubt.epoch, doubt.estimate))
    return Association(tuple(identities.names[i] for i in order), tuple(assigned), tuple(doubts))


def _doubt(verdict: Verdict, i: int, name: str, modes: list[str]) -> Doubt:
    """Say why an estimate is given to no mode."""
    scan, chances = verdict.scan, verdict.chances[i]
    frequency = float(np.exp(scan.readings.ln_f[i]))
    reason: Reason
    if chances[-1] < SURE:
        reason = "ambiguous"
        told = [*modes[: chances.size - 1], "no known mode"]
        parts = [f"{told[j]} {chances[j]:.0%}" for j in np.argsort(-chances) if chances[j] > 0.005]
        detail = f"{frequency:.5g} Hz may be of {' or '.join(parts)}: the logs so far do not tell"
    elif 0 <= scan.names[i] < chances.size - 1 and scan.names[i] not in verdict.modes:
        reason = "jump"
        expected = float(np.exp(verdict.expected[scan.names[i]]))
        detail = (
            f"{frequency:.5g} Hz named {name}, expected at {expected:.5g} Hz: a jump that the log "
            "before does not show; it is believed once the next log confirms it"
        )
    else:
        reason = "spurious"
        detail = (
            f"{frequency:.5g} Hz is of no known mode; it is believed to be one once three logs "
            "show it"
        )
    return Doubt(scan.epoch, int(scan.rows[i]), reason, detail)


def _check(
    epochs: Sequence[Estimates],
    clock: FloatArray,
    offsets: FloatArray,
    prior_std: FloatArray,
    jumps: Collection[int],
) -> None:
    n = len(epochs)
    if not n:
        raise NotEnoughData("no log to associate: give at least one")
    if clock.shape != (n,) or not np.isfinite(clock).all():
        raise BadTable(f"clock has shape {clock.shape}: needed one finite value for each of {n}")
    back = np.flatnonzero(np.diff(clock) < 0)
    if back.size:
        k = int(back[0]) + 1
        raise BadTable(f"clock descends to {clock[k]:g} at epoch {k}: put the logs in order")
    if prior_std.ndim != 1 or not (np.isfinite(prior_std) & (prior_std >= 0)).all():
        raise BadTable(f"prior_std is {prior_std}: needed one finite value ≥ 0 per covariate")
    if offsets.shape != (n, prior_std.size) or not np.isfinite(offsets).all():
        raise BadTable(
            f"offsets have shape {offsets.shape}: needed finite values of shape "
            f"{(n, prior_std.size)}, 0 where a covariate is unknown"
        )
    channels = {e.shapes.shape[1] for e in epochs}
    if len(channels) > 1:
        raise BadTable(
            f"shapes have {sorted(channels)} channels in different logs: give all logs the "
            "same channels, NaN where one is absent"
        )
    wrong = sorted(k for k in jumps if not 0 <= k < n)
    if wrong:
        raise BadTable(f"jumps at epochs {wrong}: there are epochs 0 to {n - 1}")


def _readings(k: int, estimates: Estimates) -> Readings:
    n = len(estimates.names)
    var = estimates.cov.diagonal()
    var_f, var_zeta = var[:n], var[n:]
    good = np.isfinite(estimates.ln_frequency) & np.isfinite(var_f) & (var_f > 0)
    damped = np.isfinite(estimates.ln_damping)
    good &= ~damped | (np.isfinite(var_zeta) & (var_zeta > 0))
    if not good.all():
        i = int(np.flatnonzero(~good)[0])
        raise BadTable(
            f"epoch {k}, estimate {i} ({estimates.names[i] or 'without a name'}): ln f "
            f"{estimates.ln_frequency[i]:g} with variance {var_f[i]:g}, ln ζ "
            f"{estimates.ln_damping[i]:g} with variance {var_zeta[i]:g}: needed finite values "
            "with positive variances; leave out what has none"
        )
    shapes = estimates.shapes
    if shapes.shape[1]:
        norm = np.sqrt(np.nansum(shapes**2, axis=-1, keepdims=True))
        shapes = shapes / np.where(norm > 0, norm, np.nan)
    if damped.all():
        return Readings(estimates.ln_frequency, var_f, estimates.ln_damping, var_zeta, shapes)
    return Readings(
        estimates.ln_frequency,
        var_f,
        np.where(damped, estimates.ln_damping, 0.0),
        np.where(damped, var_zeta, np.inf),
        shapes,
    )


def _scales(clock: FloatArray) -> list[float]:
    """Length of a life at each log as it is known then: what has passed, or a number of logs."""
    passed = clock - clock[0]
    count = np.maximum(np.arange(clock.size), 1)
    return [float(s) for s in passed * np.maximum(1.0, LEAST_LOGS / count)]
