"""Histories made shorter: logs close to each other are taken for one that knows what all know.

The likelihood of a whole life grows with the third power of the number of logs. A life moves
little from log to log: of very many, neighbours say the same, each with its own error.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.tracks import History


def condensed(history: History, most: int) -> History:
    """Take neighbouring logs together until there are about so many.

    Estimates are averaged by generalised least squares over the logs, series and their cross terms
    together, so that independent errors average out as they must; moments, odometer and covariates
    are plain means. The first log of a baseline and the last log stay alone, and no group reaches
    across a step.

    Parameters
    ----------
    history : History
        Any number of logs.
    most : int
        A history of no more logs than that is given back as it is.

    Returns
    -------
    History
        Named by the last log of each group.
    """
    n = len(history.logs)
    if n <= most:
        return history
    begins = _begins(history, -(-n // most))
    ends = np.append(begins[1:], n)
    group_of = np.repeat(np.arange(begins.size), ends - begins)
    parts = [slice(begin, end) for begin, end in zip(begins, ends, strict=True)]
    found = [_together(history, part) for part in parts]
    seconds = np.array([moment.timestamp() for moment in history.recorded_at])
    r = len(history.series)
    return replace(
        history,
        logs=tuple(history.logs[end - 1] for end in ends),
        recorded_at=tuple(datetime.fromtimestamp(seconds[part].mean(), UTC) for part in parts),
        travel=_means(history.travel, parts),
        covariates={name: _means(own, parts) for name, own in history.covariates.items()},
        ln_frequency=np.array([mean[:r] for mean, _ in found]),
        ln_damping=np.array([mean[r:] for mean, _ in found]),
        cov=np.array([cov for _, cov in found]),
        loop_error=_means(history.loop_error, parts),
        baselines=tuple(int(group_of[k]) for k in history.baselines),
        steps=tuple(
            replace(step, first=int(group_of[step.first]), there=step.there[begins])
            for step in history.steps
        ),
    )


def _begins(history: History, size: int) -> np.ndarray:
    """Give the indices of the logs with which groups of at most so many begin."""
    n = len(history.logs)
    parted = np.zeros(n, dtype=bool)
    parted[[0, n - 1]] = True
    for k in history.baselines:
        parted[[k, min(k + 1, n - 1)]] = True
    for step in history.steps:
        parted[step.first] = True
        parted[1:] |= np.diff(step.there.astype(int)) != 0
    begins = np.flatnonzero(parted)
    lengths = np.diff(begins, append=n)
    within = np.concatenate([np.arange(length) for length in lengths])
    return np.flatnonzero(within % size == 0)


def _means(values: FloatArray, parts: list[slice]) -> FloatArray:
    """Mean of what is known in each group, NaN where nothing is."""
    known = np.isfinite(values)
    filled = np.where(known, values, 0.0)
    counts = np.array([known[part].sum() for part in parts])
    sums = np.array([filled[part].sum() for part in parts])
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _together(history: History, part: slice) -> tuple[FloatArray, FloatArray]:
    """Average the estimates of a group: mean ``(2 n_series,)`` and covariance, NaN if missing."""
    values = np.hstack([history.ln_frequency[part], history.ln_damping[part]])
    precision, weighted = np.zeros((values.shape[1],) * 2), np.zeros(values.shape[1])
    for own, cov in zip(values, history.cov[part], strict=True):
        there = np.flatnonzero(np.isfinite(own))
        if there.size:
            block = np.linalg.inv(cov[np.ix_(there, there)])
            precision[np.ix_(there, there)] += block
            weighted[there] += block @ own[there]
    seen = np.flatnonzero(np.isfinite(values).any(axis=0))
    mean, total = np.full(values.shape[1], np.nan), np.full_like(precision, np.nan)
    if seen.size:
        cov = np.linalg.inv(precision[np.ix_(seen, seen)])
        mean[seen] = cov @ weighted[seen]
        total[np.ix_(seen, seen)] = (cov + cov.T) / 2
    return mean, total
