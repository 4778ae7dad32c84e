"""Textbook versions, written for reading and not for speed, that tests compare with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from lmshealth.arrays import FloatArray
from lmshealth.tracks import History


@dataclass(frozen=True)
class Wander:
    """Process noises over a history and the factor on the reported standard deviations."""

    level: float
    rate: float
    scale: float = 1.0


@dataclass(frozen=True)
class Followed:
    """What a tracker says: drifts ``(n, m)``, their covariances, and the log evidence so far."""

    ln_frequency: FloatArray
    ln_frequency_std: FloatArray
    drift: FloatArray
    drift_cov: FloatArray
    log_evidence: FloatArray
    nis: FloatArray


# The model of a mode: prior standard deviations, and the walk of ln damping over a history.
LEVEL_STD, DAMPING_STD, RATE_STD, DAMPING_WALK = 0.1, 1.0, 0.3, 0.3


def _covariate(history: History, reference: float) -> tuple[FloatArray, FloatArray, float]:
    """Offset of the temperature (0 where unknown), where it is unknown, and its spread."""
    values = history.covariates["temperature_c"]
    unknown = np.isnan(values)
    return (
        np.where(unknown, 0.0, values - reference),
        unknown,
        max(float(np.std(values[~unknown])), 1.0),
    )


def _data(
    history: History, k: int, scale: float, extra: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Values of one log that exist, their covariance, and their rows in [ln f, ln ζ]."""
    m = len(history.modes)
    values = np.r_[history.ln_frequency[k], history.ln_damping[k]]
    cov = np.array(history.cov[k]) * scale**2
    for i in range(m):
        cov[i, i] += extra
    rows = np.flatnonzero(~np.isnan(values))
    return values[rows], cov[np.ix_(rows, rows)], rows


def kalman(
    history: History, wander: Wander, *, reference: float = 21.0, b_std: float = 1e-3
) -> Followed:
    """Filter by the five textbook equations, with one joint state for all modes.

    The state is [ℓ, ℓ̇, ln ζ, b, ℓ₀], each for all modes. ℓ₀ is unknown, and without meaning, until
    the baseline log is reached, where it becomes equal to ℓ.
    """
    n, m = len(history.logs), len(history.modes)
    span = history.travel[-1] - history.travel[0]
    offset, unknown, spread = _covariate(history, reference)
    level, rate, damping, b, base = (np.arange(m) + part * m for part in range(5))
    x, p = np.zeros(5 * m), np.zeros((5 * m, 5 * m))
    for i in range(m):
        seen = np.flatnonzero(~np.isnan(history.ln_frequency[:, i]))[0]
        x[level[i]], x[damping[i]] = history.ln_frequency[seen, i], history.ln_damping[seen, i]
        p[level[i], level[i]] = LEVEL_STD**2
        p[rate[i], rate[i]] = (RATE_STD / span) ** 2
        p[damping[i], damping[i]] = DAMPING_STD**2
        p[b[i], b[i]] = b_std**2
    out: dict[str, list[FloatArray]] = {name: [] for name in ("f", "s", "d", "c", "e", "n")}
    evidence = 0.0
    for k in range(n):
        if k > 0:
            step = history.travel[k] - history.travel[k - 1]
            f, q = np.eye(5 * m), np.zeros((5 * m, 5 * m))
            walk, bend = wander.level**2 / span, wander.rate**2 / span**3
            for i in range(m):
                f[level[i], rate[i]] = step
                q[level[i], level[i]] = walk * step + bend * step**3 / 3
                q[level[i], rate[i]] = q[rate[i], level[i]] = bend * step**2 / 2
                q[rate[i], rate[i]] = bend * step
                q[damping[i], damping[i]] = DAMPING_WALK**2 / span * step
            x, p = f @ x, f @ p @ f.T + q
        if k == history.baseline:
            copy = np.eye(5 * m)
            copy[base, base] = 0
            copy[base, level] = 1
            x, p = copy @ x, copy @ p @ copy.T
        h = np.zeros((2 * m, 5 * m))
        for i in range(m):
            h[i, level[i]], h[i, b[i]], h[m + i, damping[i]] = 1, offset[k], 1
        extra = (b_std * spread) ** 2 if unknown[k] else 0.0
        y, r, rows = _data(history, k, wander.scale, extra)
        nis = 0.0
        if rows.size:
            h = h[rows]
            s = h @ p @ h.T + r
            gain = p @ h.T @ np.linalg.inv(s)
            innovation = y - h @ x
            nis = float(innovation @ np.linalg.inv(s) @ innovation)
            evidence += stats.multivariate_normal.logpdf(innovation, cov=s)
            x, p = x + gain @ innovation, p - gain @ s @ gain.T
        contrast = np.zeros((m, 5 * m))
        contrast[np.arange(m), level], contrast[np.arange(m), base] = 1, -1
        out["f"].append(x[level])
        out["s"].append(np.sqrt(np.diag(p)[level]))
        out["d"].append(contrast @ x)
        out["c"].append(contrast @ p @ contrast.T)
        out["e"].append(np.array(evidence))
        out["n"].append(np.array(nis))
    return Followed(*(np.array(out[name]) for name in ("f", "s", "d", "c", "e", "n")))


def batch(
    history: History, wander: Wander, *, reference: float = 21.0, b_std: float = 1e-3
) -> Followed:
    """Condition the whole joint Gaussian on the logs so far, without any recursion.

    ℓ has the covariance σ² + σ_r² t t' + walk min(t, t') + bend min²(3 max − min)/6, t from the
    first log; the data are ℓ + b ΔT and ln ζ with noise.
    """
    n, m = len(history.logs), len(history.modes)
    t = history.travel - history.travel[0]
    span = t[-1]
    offset, unknown, spread = _covariate(history, reference)
    low, high = np.minimum.outer(t, t), np.maximum.outer(t, t)
    level = LEVEL_STD**2 + (RATE_STD / span) ** 2 * np.outer(t, t)
    level += wander.level**2 / span * low + wander.rate**2 / span**3 * low**2 * (3 * high - low) / 6
    damping = DAMPING_STD**2 + DAMPING_WALK**2 / span * low
    # Data in the order (log, [ln f, ln ζ] of all modes); levels in the order (log, mode).
    signal = np.zeros((n, 2 * m, n, 2 * m))
    cross, own = np.zeros((n, m, n, 2 * m)), np.zeros((n, m, n, m))
    noise = np.zeros_like(signal)
    centre, values = np.zeros((n, 2 * m)), np.full((n, 2 * m), np.nan)
    for i in range(m):
        signal[:, i, :, i] = level + b_std**2 * np.outer(offset, offset)
        signal[:, m + i, :, m + i] = damping
        cross[:, i, :, i] = level
        own[:, i, :, i] = level
        seen = np.flatnonzero(~np.isnan(history.ln_frequency[:, i]))[0]
        centre[:, i], centre[:, m + i] = history.ln_frequency[seen, i], history.ln_damping[seen, i]
    for k in range(n):
        extra = (b_std * spread) ** 2 if unknown[k] else 0.0
        y, r, rows = _data(history, k, wander.scale, extra)
        values[k, rows] = y
        noise[k, rows[:, None], k, rows] = r
    total = (signal + noise).reshape(2 * n * m, -1)
    cross, own = cross.reshape(n * m, -1), own.reshape(n * m, -1)
    off = (values - centre).ravel()
    results = []
    for k in range(n):
        rows = np.flatnonzero(~np.isnan(values.ravel()) & (np.arange(off.size) < 2 * m * (k + 1)))
        gain = cross[:, rows] @ np.linalg.inv(total[np.ix_(rows, rows)])
        mean = (centre[:, :m].ravel() + gain @ off[rows]).reshape(n, m)
        cov = (own - gain @ cross[:, rows].T).reshape(n, m, n, m)
        base = history.baseline
        drift_cov = (
            cov[k, :, k, :] - cov[k, :, base, :] - cov[base, :, k, :] + cov[base, :, base, :]
        )
        evidence = stats.multivariate_normal.logpdf(off[rows], cov=total[np.ix_(rows, rows)])
        std = np.sqrt(np.diag(cov[k, :, k, :]))
        results.append((mean[k], std, mean[k] - mean[base], drift_cov, evidence, np.nan))
    return Followed(*(np.array(part) for part in zip(*results, strict=True)))


def epoch_log_posterior(
    x: FloatArray,
    drift: FloatArray,
    cov: FloatArray,
    *,
    predicted: FloatArray,
    alone: FloatArray,
    model_std: float,
    medians: Sequence[float],
    sigmas: Sequence[float],
) -> float:
    """Log posterior of ln parameters at one point, lognormal priors, up to a constant.

    ``predicted`` is the drift of the modes there, ``alone`` (n_parameters, n_modes) the drift with
    one parameter at a time away from its baseline.
    """
    error = np.zeros(drift.size)
    for i in range(drift.size):
        for j in range(x.size):
            error[i] += (model_std * alone[j, i]) ** 2
    value = stats.multivariate_normal.logpdf(drift, mean=predicted, cov=cov + np.diag(error))
    for j in range(x.size):
        value += stats.norm.logpdf(x[j], loc=np.log(medians[j]), scale=sigmas[j])
    return float(value)


def life_log_likelihood(
    history: History,
    predicted: FloatArray,
    alone: FloatArray,
    *,
    model_std: float,
    walks: Sequence[float],
    scales: Sequence[float],
    scale_prior: Sequence[float],
    intercept_std: float,
    reference: float = 21.0,
    b_std: float = 1e-3,
) -> float:
    """Log likelihood of a whole life as one dense multivariate normal, entry by entry.

    ``predicted`` (n_logs, n_modes) is the drift of the law since the baseline, ``alone``
    (n_parameters, n_logs, n_modes) what each parameter does alone. The relative error of each
    contribution is an explicit Gaussian: V Vᵀ is added to the covariance.
    """
    first, m = history.baseline, len(history.modes)
    clock = (history.travel - history.travel[first])[first:]
    values = history.covariates["temperature_c"][first:]
    unknown = np.isnan(values)
    offset = np.where(unknown, 0.0, values - reference)
    spread = max(float(np.std(values[~unknown])), 1.0)
    ln_f = history.ln_frequency[first:]
    where = [(k, i) for k in range(clock.size) for i in range(m) if not np.isnan(ln_f[k, i])]
    centre = [np.mean(ln_f[~np.isnan(ln_f[:, i]), i]) for i in range(m)]
    r = np.array([ln_f[k, i] - centre[i] - predicted[k, i] for k, i in where])
    logs = []
    for walk in walks:
        for scale, prior in zip(scales, scale_prior, strict=True):
            cov = np.zeros((r.size, r.size))
            for a, (k, i) in enumerate(where):
                for c, (o, j) in enumerate(where):
                    if k == o:
                        cov[a, c] += scale**2 * history.cov[first + k][i, j]
                    if k == o and i == j and unknown[k]:
                        cov[a, c] += (b_std * spread) ** 2
                    if i == j:
                        cov[a, c] += intercept_std**2 + b_std**2 * offset[k] * offset[o]
                        cov[a, c] += walk**2 * min(clock[k], clock[o]) / clock.max()
                        for own in alone:
                            cov[a, c] += model_std**2 * own[k, i] * own[o, i]
            logs.append(np.log(prior) + stats.multivariate_normal.logpdf(r, cov=cov))
    return float(np.logaddexp.reduce(logs))


def binomial_band(hits: int, n: int, level: float = 0.999) -> tuple[float, float]:
    """Clopper-Pearson interval of a proportion."""
    tail = (1 - level) / 2
    low = 0.0 if hits == 0 else float(stats.beta.ppf(tail, hits, n - hits + 1))
    high = 1.0 if hits == n else float(stats.beta.ppf(1 - tail, hits + 1, n - hits))
    return low, high


def channel_covariance(
    frequency: FloatArray,
    *,
    resonances: Sequence[tuple[float, float]],
    floors: Sequence[FloatArray],
    root: FloatArray,
    shapes: FloatArray,
) -> np.ndarray[tuple[int, int, int], np.dtype[np.complex128]]:
    """Covariance of the transforms of all channels under white forces, force by force.

    Each ``resonance`` is a natural frequency in Hz and a damping ratio, each ``floor`` a real
    response ``(n_frequencies,)``; row i of ``root`` says how strongly each force drives resonance
    or floor i, row c of ``shapes`` how strongly each resonance moves channel c.
    """
    n_channels, m = shapes.shape
    cov = np.zeros((frequency.size, n_channels, n_channels), dtype=complex)
    for k, f in enumerate(frequency):
        w = 2 * np.pi * f
        moves = np.zeros((n_channels, root.shape[1]), dtype=complex)
        for i, (natural, zeta) in enumerate(resonances):
            w_n = 2 * np.pi * natural
            # Of x¨ + 2ζω_n x˙ + ω_n² x = force under exp(iωt), as an acceleration.
            response = -(w**2) / (w_n**2 - w**2 + 2j * zeta * w_n * w)
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
        total += stats.multivariate_normal.logpdf(parts, cov=real)
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
