"""Textbook versions, written for reading and not for speed, that tests compare with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray
from scipy import stats
from scipy.linalg import cho_factor, cho_solve

from lmshealth._private.arrays import FloatArray
from lmshealth.tracking.history import History, Series

# The model of a mode: prior standard deviations, and the walk of ln damping in a life.
LEVEL_STD, DAMPING_STD, DAMPING_WALK = 0.1, 1.0, 0.5
# Logs in a life, and until ln f has settled; what modes have in common of the variances of rates
# and of wander.
LIFE, SETTLING_LOGS, COMMON_RATE, COMMON_WANDER = 150, 1.0, 0.9, 0.3
KNOWN_RATE_LOGS = 10  # from which on a rate keeps its value when the mean distance changes
BIAS = (0.005, 0.2)
UNSEEN_STD = 0.03  # of ln f by a covariate of which no value is known yet
# Standard deviations of the jumps of ln f and ln ζ.
JUMPS = {
    "step": (0.03, 0.3),
    "regreasing": (0.0, 0.3),
    "servo": (0.01, 0.2),
    "sensor": (0.005, 0.2),
    "reset": (0.05, 0.5),
}


@dataclass(frozen=True)
class Wander:
    """One setting: walks and rate of ln f in a life, factors on the std of each source.

    A rate decays by ``decay`` per life. Readings wander by ``size`` of their first scaled errors,
    with the correlation ``keep`` from log to log. In the first logs ln f of all modes walks by
    ``settling``.
    """

    level: float
    rate: float
    bend: float
    scales: Mapping[str, float]
    decay: float = 0.0
    size: float = 0.0
    keep: float = 0.0
    settling: float = 0.0

    def settled(self, history: History) -> FloatArray:
        """Give the variance by which ln f has settled up to each log, since every baseline anew."""
        gone, total, start = lives(history) * LIFE / SETTLING_LOGS, [0.0], 0.0
        for k in range(1, gone.size):
            more = np.exp(start - gone[k - 1]) - np.exp(start - gone[k])
            if k in history.baselines:
                more, start = 0.0, gone[k]
            total.append(total[-1] + self.settling**2 * more)
        return np.array(total)

    def moved(self, t: FloatArray) -> FloatArray:
        """Give the change of ln f after so many lives, per initial rate."""
        return (1 - np.exp(-self.decay * t)) / self.decay if self.decay else t

    def stds(self, history: History) -> FloatArray:
        """Give the standard deviation of the wander of each mode."""
        std = []
        for mode in history.modes:
            own = [c for c, one in enumerate(history.series) if one.mode == mode]
            std.append(_first(np.sqrt(np.array([np.diag(c)[own] for c in history.cov]))))
        scale = stats.gmean(list(self.scales.values())) if self.scales else 1.0
        return self.size * scale * np.array(std)


@dataclass(frozen=True)
class Known:
    """What a stage says: covariates ``(name, reference, std, curvature)``.

    Rates are unknown anew in front of the logs in ``reopened``.
    """

    covariates: Sequence[tuple[str, float, float, float]] = ()
    reopened: Sequence[int] = ()


@dataclass(frozen=True)
class Followed:
    """What a tracker says: means and variances by quantity, the log evidence so far, and NIS.

    ``mean`` is ``(n, 3, m)`` and ``cov`` ``(n, 3, m, 3, m)`` of ln f, ln ζ and the drift.
    """

    mean: FloatArray
    cov: FloatArray
    log_evidence: FloatArray
    nis: FloatArray


def distances(history: History) -> list[float]:
    """Give the mean distance of the logs so far, at each log."""
    clock, means, count = history.clock() - history.clock()[0], [0.0], 0
    for k in range(1, clock.size):
        there = bool(np.isfinite(history.ln_frequency[k]).any())
        count += there
        means.append(float(clock[k]) / count if there else means[-1])
    return means


def lives(history: History) -> FloatArray:
    """Give the lives gone by at each log: their unit is the mean distance of logs so far."""
    clock, gone, before = history.clock() - history.clock()[0], [0.0], 0.0
    for k, mean in enumerate(distances(history)[1:], start=1):
        more = 0.0
        if np.isfinite(history.ln_frequency[k]).any():
            more, before = (clock[k] - before) / mean / LIFE if mean else 0.0, clock[k]
        gone.append(gone[-1] + more)
    return np.array(gone, dtype=np.longdouble)


def longer(history: History) -> list[float]:
    """Give by how much a life of each log is longer than one of the log before: so are rates."""
    means, found = distances(history), [1.0]
    for k in range(1, len(means)):
        n = np.count_nonzero(np.isfinite(history.ln_frequency[1:k]).any(axis=1))
        known = n >= KNOWN_RATE_LOGS and means[k] and means[k - 1]
        found.append(means[k] / means[k - 1] if known else 1.0)
    return found


def by_rate(t: FloatArray, more: Sequence[float], wander: Wander, start: int) -> np.ndarray:
    """Give the change of ln f at each log per rate at a log, which is per life of that log."""
    moved, rate = np.zeros(t.size, dtype=np.longdouble), 1.0
    for k in range(start + 1, moved.size):
        rate *= more[k]
        moved[k] = moved[k - 1] + rate * wander.moved(t[k] - t[k - 1])
        rate *= float(np.exp(-wander.decay * (t[k] - t[k - 1])))
    return moved


def bent(t: FloatArray, more: Sequence[float]) -> np.ndarray:
    """Give the covariance of ln f by a random walk of rates of variance 1 per life, ``(n, n)``."""
    n, steady = t.size, Wander(0.0, 0.0, 0.0, {})
    total = np.zeros((n, n), dtype=np.longdouble)
    for j in range(1, n):  # what begins between two logs goes on with the rate that it has then
        tick, since = t[j] - t[j - 1], by_rate(t, more, steady, j)
        there = (np.arange(n) >= j).astype(np.longdouble)
        total += tick**3 / 3 * np.outer(there, there) + tick * np.outer(since, since)
        total += tick**2 / 2 * (np.outer(there, since) + np.outer(since, there))
    return total


def _alike(common: float, n: int) -> FloatArray:
    return np.array([[1.0 if i == j else common for i in range(n)] for j in range(n)])


def _unknown(history: History, known: Known, k: int) -> float:
    """Variance of ln f in a log for want of its covariates."""
    total = 0.0
    for name, _, std, _ in known.covariates:
        values = history.covariates[name]
        if np.isnan(values[k]):
            so_far = values[:k][~np.isnan(values[:k])]
            spread = float(np.std(so_far)) if so_far.size else 0.0
            total += (std * max(spread, 1.0)) ** 2 if so_far.size else UNSEEN_STD**2
    return total


def _offset(history: History, name: str, reference: float, k: int, power: int = 1) -> float:
    """Give a power of a covariate about its reference: its mean so far where it is unknown."""
    powers = [(float(value) - reference) ** power for value in history.covariates[name][: k + 1]]
    so_far = [one for one in powers if not np.isnan(one)]
    return powers[-1] if not np.isnan(powers[-1]) else float(np.mean(so_far or [0.0]))


def _first(table: FloatArray) -> float:
    """Give the first value that is there, log by log, series by series."""
    return next(float(value) for row in table for value in row if not np.isnan(value))


def _reference(history: History, mode: str) -> Series:
    """Series of a mode that the others are measured against: the one that is seen first."""
    for row in history.ln_frequency:
        for one, value in zip(history.series, row, strict=True):
            if one.mode == mode and not np.isnan(value):
                return one
    raise AssertionError(f"{mode} is never seen")


def _data(
    history: History, known: Known, wander: Wander, k: int
) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
    """Values of one log that exist, their covariance, and their rows in [ln f, ln ζ]."""
    r = len(history.series)
    values = np.r_[history.ln_frequency[k], history.ln_damping[k]]
    cov = np.array(history.cov[k])
    for a in range(2 * r):
        for c in range(2 * r):
            cov[a, c] *= wander.scales[history.series[a % r].source]
            cov[a, c] *= wander.scales[history.series[c % r].source]
    for a in range(r):
        for c in range(r):
            alike = history.series[a].mode == history.series[c].mode
            cov[a, c] += _unknown(history, known, k) if alike else 0.0
    rows = np.flatnonzero(~np.isnan(values))
    return values[rows], cov[np.ix_(rows, rows)], rows


class Textbook:
    """The state space written out by names of its entries, one log and one entry at a time."""

    def __init__(self, history: History, wander: Wander, known: Known) -> None:
        self.history, self.wander, self.known = history, wander, known
        self.longer = longer(history)
        parts = ("level", "rate", "damping", "base", "wander")
        self.names: list[tuple[object, ...]] = [(p, i) for i in history.modes for p in parts]
        for name, _, _, curvature in known.covariates:
            self.names += [(name, i) for i in history.modes]
            self.names += [(name + "^2", i) for i in history.modes if curvature]
        for one in history.series:
            if one != _reference(history, one.mode):
                self.names += [("bias f", one), ("bias z", one)]
        for j in range(len(history.steps)):
            self.names += [(part, j, i) for i in history.modes for part in ("jump f", "jump z")]
        self.at = {name: k for k, name in enumerate(self.names)}

    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance before the first log; jumps have not happened yet."""
        history, x, p = self.history, np.zeros(len(self.names)), np.zeros(len(self.names))
        for i in history.modes:
            own = [c for c, one in enumerate(history.series) if one.mode == i]
            for part, table, std in (
                ("level", history.ln_frequency, LEVEL_STD),
                ("damping", history.ln_damping, DAMPING_STD),
            ):
                x[self.at[part, i]] = _first(table[:, own])
                p[self.at[part, i]] = std**2
            for name, _, std, curvature in self.known.covariates:
                p[self.at[name, i]] = std**2
                if curvature:
                    p[self.at[name + "^2", i]] = curvature**2
        for key in self.names:
            if key[0] == "bias f":
                p[self.at[key]] = BIAS[0] ** 2
            if key[0] == "bias z":
                p[self.at[key]] = BIAS[1] ** 2
        cov, m = np.diag(p), len(history.modes)
        rates, wanders = self.all("rate"), self.all("wander")
        cov[np.ix_(rates, rates)] = self.wander.rate**2 * _alike(COMMON_RATE, m)
        stds = self.wander.stds(history)
        cov[np.ix_(wanders, wanders)] = np.outer(stds, stds) * _alike(COMMON_WANDER, m)
        return x, cov

    def all(self, part: str) -> list[int]:
        """Give the places of a part of the state, mode by mode."""
        return [self.at[part, i] for i in self.history.modes]

    def moved(self, k: int) -> tuple[FloatArray, FloatArray]:
        """Transition into log k and its noise: first time goes by, then steps, then the copy."""
        history, at, wander = self.history, self.at, self.wander
        f, q = np.eye(len(at)), np.zeros((len(at), len(at)))
        if k > 0:
            gone, m = lives(history), len(history.modes)
            tick = float(gone[k] - gone[k - 1])
            level, rate, own = self.all("level"), self.all("rate"), self.all("wander")
            # A rate is that per life of the log before.
            more = self.longer[k]
            far = more * float(wander.moved(np.array(tick)))
            left = more * np.exp(-wander.decay * tick)
            # A rate that is unknown anew is so from the log before on.
            anew = wander.rate**2 * (k in self.known.reopened)
            alike = _alike(COMMON_RATE, m)
            bend = wander.bend**2
            f[level, rate], f[rate, rate] = far, left
            settled = float(np.diff(wander.settled(history)[k - 1 : k + 1])[0])
            q[np.ix_(level, level)] = (bend * tick**3 / 3 + anew * far**2 + settled) * alike
            q[level, level] += wander.level**2 * tick
            q[np.ix_(level, rate)] = (bend * tick**2 / 2 + anew * far * left) * alike
            q[np.ix_(rate, level)] = q[np.ix_(level, rate)]
            q[np.ix_(rate, rate)] = (bend * tick + anew * left**2) * alike
            q[self.all("damping"), self.all("damping")] = DAMPING_WALK**2 * tick
            keep = wander.keep if np.isfinite(history.ln_frequency[k]).any() else 1.0
            std = (1 - keep**2) * np.outer(wander.stds(history), wander.stds(history))
            f[own, own] = keep
            q[np.ix_(own, own)] = std * _alike(COMMON_WANDER, m)
        q += self._begun(k)
        if k in history.baselines:
            copy = np.eye(len(at))
            for i in history.modes:
                copy[at["base", i], at["base", i]] = 0
                copy[at["base", i], at["level", i]] = 1
            f, q = copy @ f, copy @ q @ copy.T
        return f, q

    def _begun(self, k: int) -> FloatArray:
        """Give the noise of the steps that begin at log k."""
        q = np.zeros((len(self.at), len(self.at)))
        for j, step in enumerate(self.history.steps):
            if step.first != k:
                continue
            for i in self.history.modes:
                for part, moved, std in zip(
                    ("jump f", "jump z"), ("level", "damping"), JUMPS[step.kind], strict=True
                ):
                    pushed = [self.at[part, j, i]]
                    if step.kind in ("step", "regreasing", "reset"):
                        pushed.append(self.at[moved, i])
                    q[np.ix_(pushed, pushed)] += std**2
        return q

    def seen(self, k: int) -> FloatArray:
        """Give the measurement matrix of log k, all rows."""
        history, at, r = self.history, self.at, len(self.history.series)
        h = np.zeros((2 * r, len(at)))
        for a, one in enumerate(history.series):
            h[a, at["level", one.mode]] = h[r + a, at["damping", one.mode]] = 1
            h[a, at["wander", one.mode]] = 1
            for name, reference, _, curvature in self.known.covariates:
                offset = _offset(history, name, reference, k)
                h[a, at[name, one.mode]] = offset
                if curvature:
                    h[a, at[name + "^2", one.mode]] = _offset(history, name, reference, k, 2)
            if ("bias f", one) in at:
                h[a, at["bias f", one]] = h[r + a, at["bias z", one]] = 1
            for j, step in enumerate(history.steps):
                everywhere = step.kind == "servo"
                here = step.kind == "sensor" and step.source == one.source
                if (everywhere or here) and step.there[k]:
                    h[a, at["jump f", j, one.mode]] = h[r + a, at["jump z", j, one.mode]] = 1
        return h

    def observed(self) -> FloatArray:
        """Give the contrasts that make ln f, ln ζ and drift of a state."""
        c = np.zeros((3, len(self.history.modes), len(self.at)))
        for i, mode in enumerate(self.history.modes):
            c[0, i, self.at["level", mode]] = c[1, i, self.at["damping", mode]] = 1
            c[2, i, self.at["level", mode]] = 1
            c[2, i, self.at["base", mode]] = -1
        return c


def kalman(history: History, wander: Wander, known: Known) -> Followed:
    """Filter by the five textbook equations."""
    book = Textbook(history, wander, known)
    (x, p), observed, evidence = book.prior(), book.observed(), 0.0
    out = []
    for k in range(len(history.logs)):
        f, q = book.moved(k)
        x, p = f @ x, f @ p @ f.T + q
        y, r, rows = _data(history, known, wander, k)
        nis = 0.0
        if rows.size:
            h = book.seen(k)[rows]
            s = h @ p @ h.T + r
            gain = np.linalg.solve(s, h @ p).T
            innovation = y - h @ x
            nis = float(innovation @ np.linalg.solve(s, innovation))
            evidence += float(stats.multivariate_normal.logpdf(innovation, cov=s))
            x, p = x + gain @ innovation, p - gain @ h @ p
        out.append(
            (observed @ x, np.einsum("pia,ab,qjb->piqj", observed, p, observed), evidence, nis)
        )
    return Followed(*(np.array(part) for part in zip(*out, strict=True)))


def filterpy_loop(history: History, wander: Wander, known: Known) -> Followed:
    """Filter by filterpy, log by log."""
    book = Textbook(history, wander, known)
    kalman = KalmanFilter(dim_x=len(book.names), dim_z=1)
    (kalman.x, kalman.P), observed, evidence = book.prior(), book.observed(), 0.0
    out = []
    for k in range(len(history.logs)):
        f, q = book.moved(k)
        kalman.predict(F=f, Q=q)
        y, r, rows = _data(history, known, wander, k)
        nis = 0.0
        if rows.size:
            kalman.update(y, R=r, H=book.seen(k)[rows])
            nis, evidence = float(kalman.mahalanobis) ** 2, evidence + float(kalman.log_likelihood)
        cov = np.einsum("pia,ab,qjb->piqj", observed, kalman.P, observed)
        out.append((observed @ kalman.x, cov, evidence, nis))
    return Followed(*(np.array(part) for part in zip(*out, strict=True)))


def _levels(history: History, wander: Wander, known: Known) -> list[np.ndarray]:
    """Covariance of ln f, of ln ζ, and between ln f of two modes, over all logs, ``(n, n)`` each.

    With t the lives since the first log, and c the change by a rate, that of ln f is
    σ² + σ_r² c c' + walk min(t, t') + bend + Σ jump² where both come after it.
    """
    t, more = lives(history), longer(history)
    low, moved = np.minimum.outer(t, t), by_rate(t, more, wander, 0)
    rates = wander.rate**2 * np.outer(moved, moved) + wander.bend**2 * bent(t, more)
    settled = wander.settled(history)
    rates += np.minimum.outer(settled, settled)
    level = LEVEL_STD**2 + wander.level**2 * low
    damping = DAMPING_STD**2 + DAMPING_WALK**2 * low
    for k in known.reopened:
        since = by_rate(t, more, wander, k - 1)
        rates += wander.rate**2 * np.outer(since, since)
    for step in history.steps:
        if step.kind in ("step", "regreasing", "reset"):
            then = np.arange(t.size) >= step.first
            level += JUMPS[step.kind][0] ** 2 * np.outer(then, then)
            damping += JUMPS[step.kind][1] ** 2 * np.outer(then, then)
    return [level + rates, damping, COMMON_RATE * rates]


def _readings(history: History, known: Known, a: Series, c: Series, part: int) -> np.ndarray:
    """Covariance of how two series of a mode are read wrongly in common, ``(n, n)``."""
    n = len(history.logs)
    read = np.zeros((n, n), dtype=np.longdouble)
    for name, reference, std, curvature in known.covariates if part == 0 else ():
        for power, size in ((1, std), (2, curvature)):
            offset = [_offset(history, name, reference, k, power) for k in range(n)]
            read += np.longdouble(size) ** 2 * np.outer(offset, offset)
    if a == c and a != _reference(history, a.mode):
        read += BIAS[part] ** 2
    for step in history.steps:
        one_sensor = step.kind == "sensor" and {a.source, c.source} == {step.source}
        if step.kind == "servo" or one_sensor:
            there = step.there.astype(float)
            read += JUMPS[step.kind][part] ** 2 * np.outer(there, there)
    return read


def _between(
    history: History,
    wander: Wander,
    shared: np.ndarray,
    tables: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Fill in what the series of all modes have in common: rates and wander of ln f."""
    total, cross, own = tables
    mode_of = history.mode_of()
    logs, std = np.cumsum(np.isfinite(history.ln_frequency).any(axis=1)), wander.stds(history)
    kept = wander.keep ** np.abs(np.subtract.outer(logs, logs)) * (1.0 if wander.size else 0.0)
    for i in range(len(history.modes)):
        for c, j in enumerate(mode_of):
            if i != j:
                own[:, 0, i, :, 0, j] = cross[:, 0, i, :, 0, c] = shared
            alike = std[i] * std[j] * (1.0 if i == j else COMMON_WANDER) * kept
            for a in np.flatnonzero(mode_of == i):
                total[:, 0, a, :, 0, c] = alike + (shared if i != j else 0.0)


def batch(history: History, wander: Wander, known: Known, *, smoothed: bool = False) -> Followed:
    """Condition the whole joint Gaussian on the logs so far, or on all, without any recursion.

    Wide priors under sharp estimates cost eleven digits: sums are made with extended precision.
    """
    n, m, r = len(history.logs), len(history.modes), len(history.series)
    # Data in the order (log, [ln f, ln ζ] of all series); truth in the order (log, part, mode).
    total: np.ndarray = np.zeros((n, 2, r, n, 2, r), dtype=np.longdouble)
    cross: np.ndarray = np.zeros((n, 2, m, n, 2, r), dtype=np.longdouble)
    own: np.ndarray = np.zeros((n, 2, m, n, 2, m), dtype=np.longdouble)
    centre: np.ndarray = np.zeros((n, 2, r))
    prior: np.ndarray = np.zeros((n, 2, m))
    values = np.stack([history.ln_frequency, history.ln_damping], axis=1)
    *truths, shared = _levels(history, wander, known)
    _between(history, wander, shared, (total, cross, own))
    for part, truth in enumerate(truths):
        for i, mode in enumerate(history.modes):
            series = [(a, one) for a, one in enumerate(history.series) if one.mode == mode]
            first = _first(values[:, part, [a for a, _ in series]])
            own[:, part, i, :, part, i], prior[:, part, i] = truth, first
            for a, one in series:
                centre[:, part, a], cross[:, part, i, :, part, a] = first, truth
                for c, other in series:
                    read = _readings(history, known, one, other, part)
                    total[:, part, a, :, part, c] += truth + read
    total = total.reshape(n * 2 * r, -1)
    for k in range(n):
        _, noise, rows = _data(history, known, wander, k)
        total[np.ix_(rows + 2 * r * k, rows + 2 * r * k)] += noise
    cross, own = cross.reshape(n * 2 * m, -1), own.reshape(n * 2 * m, -1)
    off, prior = (values - centre).ravel(), prior.ravel()
    out = []
    for k in range(n):
        use = np.flatnonzero(~np.isnan(off) & (smoothed | (np.arange(off.size) < 2 * r * (k + 1))))
        solved, log_det = _solve(total[np.ix_(use, use)], np.c_[off[use], cross[:, use].T])
        mean = prior + cross[:, use] @ solved[:, 0]
        cov = own - cross[:, use] @ solved[:, 1:]
        base = max([b for b in history.baselines if b <= k], default=0)
        observed = np.zeros((3, m, n, 2, m))
        for i in range(m):
            observed[0, i, k, 0, i] = observed[1, i, k, 1, i] = observed[2, i, k, 0, i] = 1
            observed[2, i, base, 0, i] -= 1
        flat = observed.reshape(3 * m, -1)
        evidence = -0.5 * (off[use] @ solved[:, 0] + log_det + use.size * np.log(2 * np.pi))
        out.append(
            (
                (flat @ mean).reshape(3, m),
                (flat @ cov @ flat.T).reshape(3, m, 3, m),
                evidence,
                np.nan,
            )
        )
    return Followed(*(np.array(part, dtype=float) for part in zip(*out, strict=True)))


def _solve(matrix: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, float]:
    """Solve in extended precision, by refining what a Cholesky factor gives, and the log det."""
    factor = cho_factor(matrix.astype(float), lower=True)
    solved = np.zeros_like(right, dtype=np.longdouble)
    for _ in range(4):
        solved += cho_solve(factor, (right - matrix @ solved).astype(float))
    return solved, 2 * float(np.log(np.diag(factor[0])).sum())


@dataclass(frozen=True)
class LifeBelief:
    """What is believed of a whole life: errors that do not depend on its course.

    ``slopes`` is ``(n_parameters, n_modes)``, what ln health does to ln frequency at the baseline.
    """

    slopes: FloatArray
    model_std: float
    intercept_std: float
    common_std: float = 0.0
    reference: float = 21.0
    b_std: float = 1e-3


@dataclass(frozen=True)
class LifeSetting:
    """A point of the grid: walk, factor on standard deviations, deviation over the history.

    And the index of a mode that moves alone, if one does, the standard deviation of a wander that
    all have in common, and whether the first log is in error: in each mode or in all alike.
    """

    walk: float
    scale: float
    deviation: float
    prior: float = 1.0
    lone: int | None = None
    common: float = 0.0
    error: Literal["", "each", "alike"] = ""


def lone_drift(t: float, u: float, now: float, steps: Sequence[float] = ()) -> float:
    """Covariance of the drift of a mode that moves alone, between two travels.

    Equal parts: powers ½, 1 and 2 of the travel, an integrated random walk, a jump at each step.
    """
    before = [min(t, u) < step for step in steps]
    t, u = t / now, u / now
    low, high = min(t, u), max(t, u)
    parts = [(t * u) ** 0.5, t * u, (t * u) ** 2, low**2 * (3 * high - low) / 2]
    parts += [0.0 if one else 1.0 for one in before]
    return 0.02**2 * sum(parts) / len(parts)


def _life_data(history: History) -> tuple[list[tuple[int, int]], FloatArray, FloatArray]:
    """Where there are data since the baseline, these about the mean of their mode, and travel."""
    first = history.baseline
    ln_f = history.ln_frequency[first:]
    n, m = ln_f.shape
    temperature = history.covariates["temperature_c"][first:]
    used = [not np.isnan(t) or np.isnan(temperature[k:]).all() for k, t in enumerate(temperature)]
    ln_f = np.where(np.array(used)[:, None], ln_f, np.nan)
    where = [(k, i) for k in range(n) for i in range(m) if not np.isnan(ln_f[k, i])]
    centre = [np.mean(ln_f[~np.isnan(ln_f[:, i]), i]) for i in range(m)]
    values = np.array([ln_f[k, i] - centre[i] for k, i in where])
    return where, values, (history.travel - history.travel[first])[first:]


def _steps(history: History) -> list[float]:
    """Travel since the baseline of each step of the modes: midway between two logs."""
    clock = history.travel - history.travel[history.baseline]
    return [(clock[s.first - 1] + clock[s.first]) / 2 for s in history.steps if s.kind == "step"]


def life_covariance(
    history: History, alone: FloatArray, belief: LifeBelief, setting: LifeSetting
) -> FloatArray:
    """Covariance of all data of a life, entry by entry.

    ``alone`` (n_parameters, n_logs, n_modes) is what each parameter does alone. The relative error
    of each contribution is an explicit Gaussian: V Vᵀ is added to the covariance.
    """
    where, _, clock = _life_data(history)
    first = history.baseline
    unknown = np.isnan(history.covariates["temperature_c"][first:])
    logs = range(first, len(history.logs))
    offset = [_offset(history, "temperature_c", belief.reference, k) for k in logs]
    known = Known((("temperature_c", belief.reference, belief.b_std, 0.0),))
    number = {k: n for n, k in enumerate(sorted({k for k, _ in where}))}
    cov = np.zeros((len(where), len(where)))
    for a, (k, i) in enumerate(where):
        for c, (o, j) in enumerate(where):
            shared = min(clock[k], clock[o])
            for slope in belief.slopes:
                cov[a, c] += slope[i] * slope[j] * setting.deviation**2 * shared / clock.max()
            for own in alone:
                cov[a, c] += belief.common_std**2 * own[k, i] * own[o, j]
            lasting = [np.exp(-abs(number[k] - number[o]) / n) for n in (2.0, 8.0)]
            cov[a, c] += setting.common**2 * sum(lasting) / 2
            if k == o:
                cov[a, c] += setting.scale**2 * history.cov[first + k][i, j]
                cov[a, c] += (i == j) * unknown[k] * _unknown(history, known, first + k)
            if k == o == 0 and {i, j} <= {*history.in_doubt}:
                cov[a, c] += 0.03**2 * {"": 0, "each": i == j, "alike": 1}[setting.error]
            if i == j:
                cov[a, c] += belief.intercept_std**2 + belief.b_std**2 * offset[k] * offset[o]
                cov[a, c] += setting.walk**2 * shared / clock.max()
                if i == setting.lone:
                    cov[a, c] += lone_drift(clock[k], clock[o], clock.max(), _steps(history))
                for own in alone:
                    cov[a, c] += belief.model_std**2 * own[k, i] * own[o, i]
    return cov


def life_log_likelihood(
    history: History,
    predicted: FloatArray,
    alone: FloatArray,
    belief: LifeBelief,
    grid: Sequence[LifeSetting],
) -> float:
    """Log likelihood of a whole life as one dense multivariate normal, over a grid of settings.

    ``predicted`` (n_logs, n_modes) is the drift of the laws since the baseline, ``alone`` as in
    `life_covariance`.
    """
    where, values, _ = _life_data(history)
    r = values - np.array([predicted[k, i] for k, i in where])
    logs = [
        np.log(setting.prior)
        + stats.multivariate_normal.logpdf(r, cov=life_covariance(history, alone, belief, setting))
        for setting in grid
    ]
    return float(np.logaddexp.reduce(logs))


def life_deviation(
    history: History,
    predicted: FloatArray,
    alone: FloatArray,
    belief: LifeBelief,
    setting: LifeSetting,
    moment: float,
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance between parameters of ln health about its laws, by conditioning."""
    where, values, clock = _life_data(history)
    r = values - np.array([predicted[k, i] for k, i in where])
    inverse = np.linalg.inv(life_covariance(history, alone, belief, setting))
    unit = setting.deviation**2 / clock.max()
    p = belief.slopes.shape[0]
    cross = np.zeros((p, len(where)))
    for j in range(p):
        for c, (k, i) in enumerate(where):
            cross[j, c] = unit * min(moment, clock[k]) * belief.slopes[j, i]
    return cross @ inverse @ r, unit * moment * np.eye(p) - cross @ inverse @ cross.T


def life_lone_drift(
    history: History,
    predicted: FloatArray,
    alone: FloatArray,
    belief: LifeBelief,
    setting: LifeSetting,
) -> tuple[float, float]:
    """Mean and variance of the drift now of the mode that moves alone, by conditioning."""
    where, values, clock = _life_data(history)
    r = values - np.array([predicted[k, i] for k, i in where])
    inverse = np.linalg.inv(life_covariance(history, alone, belief, setting))
    now = clock.max()
    cross = np.zeros(len(where))
    for c, (k, i) in enumerate(where):
        if i == setting.lone:
            cross[c] = lone_drift(now, clock[k], now)
    return float(cross @ inverse @ r), float(lone_drift(now, now, now) - cross @ inverse @ cross)


def binomial_band(hits: int, n: int, level: float = 0.999) -> tuple[float, float]:
    """Clopper-Pearson interval of a proportion."""
    tail = (1 - level) / 2
    low = 0.0 if hits == 0 else float(stats.beta.ppf(tail, hits, n - hits + 1))
    high = 1.0 if hits == n else float(stats.beta.ppf(1 - tail, hits + 1, n - hits))
    return low, high


def check_coverage(levels_of_truth: FloatArray, calibrated: bool) -> None:
    """Hold the coverage of central 50 and 90 % intervals to its band, or outside of it.

    Parameters
    ----------
    levels_of_truth : ndarray
        Posterior probability below the truth, one per life.
    calibrated : bool
        Whether both coverages have to agree, or the 90 % one must be too low.
    """
    for level in (0.5, 0.9):
        hits = int(np.sum(np.abs(levels_of_truth - 0.5) < level / 2))
        low, high = binomial_band(hits, levels_of_truth.size)
        if calibrated:
            assert low <= level <= high, f"{level:.0%} intervals cover {low:.3f} to {high:.3f}"
        elif level == 0.9:
            assert high < level, f"{level:.0%} intervals cover {low:.3f} to {high:.3f}"


def cdf_at(axis: FloatArray, density: FloatArray, truth: float) -> float:
    """Probability below the truth of a density on an even axis."""
    total = np.cumsum(density) - 0.5 * density
    return float(np.interp(truth, axis, total / density.sum()))


def channel_covariance(
    frequency: FloatArray,
    *,
    resonances: FloatArray,
    floors: Sequence[FloatArray],
    root: FloatArray,
    shapes: FloatArray,
) -> np.ndarray[tuple[int, int, int], np.dtype[np.complex128]]:
    """Covariance of the transforms of all channels under white forces, force by force.

    Each ``resonance`` is a natural frequency in Hz, a damping ratio and a static response, which
    adds to that to the force, each ``floor`` a real response ``(n_frequencies,)``; row i of
    ``root`` says how strongly each force drives resonance or floor i, row c of ``shapes`` how
    strongly each resonance moves channel c.
    """
    n_channels, m = shapes.shape
    cov = np.zeros((frequency.size, n_channels, n_channels), dtype=complex)
    for k, f in enumerate(frequency):
        w = 2 * np.pi * f
        moves = np.zeros((n_channels, root.shape[1]), dtype=complex)
        for i, (natural, zeta, static) in enumerate(resonances.tolist()):
            w_n = 2 * np.pi * natural
            # Of x¨ + 2ζω_n x˙ + ω_n² x = force under exp(iωt), as an acceleration.
            response = static - w**2 / (w_n**2 - w**2 + 2j * zeta * w_n * w)
            for c in range(n_channels):
                moves[c] += shapes[c, i] * response * root[i]
        for c in range(n_channels):
            moves[c] += floors[c][k] * root[m + c]
        for force in range(root.shape[1]):
            cov[k] += np.outer(moves[:, force], moves[:, force].conj())
    return cov


def complex_normal_log_density(
    ordinates: np.ndarray[tuple[int, int], np.dtype[np.complex128]],
    cov: np.ndarray[tuple[int, int, int], np.dtype[np.complex128]],
) -> float:
    """Log density of independent circular complex normal vectors, one covariance each."""
    total = 0.0
    for vector, matrix in zip(ordinates, cov, strict=True):
        # Real and imaginary parts as one real normal vector of twice the size.
        real = np.block([[matrix.real, -matrix.imag], [matrix.imag, matrix.real]]) / 2
        parts = np.concatenate([vector.real, vector.imag])
        total += float(stats.multivariate_normal.logpdf(parts, cov=real))
    return float(total)


def planned_std(slopes: FloatArray, noise: FloatArray, column: int, *, prior_std: float) -> float:
    """Invert the joint information for the standard deviation of one of two parameters.

    ``slopes`` is ``(n_modes, 2)``, ``noise`` the variance of each mode's drift; the other
    parameter has a prior, this one has none.
    """
    information = np.zeros((2, 2))
    for row, variance in zip(slopes, noise, strict=True):
        information += np.outer(row, row) / variance
    information[1 - column, 1 - column] += prior_std**-2
    return float(np.sqrt(np.linalg.inv(information)[column, column]))
