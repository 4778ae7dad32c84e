"""Autoregressive model of a channel: expectation of missing samples, and of single bad ones.

x_t = Σ φ_k x_{t-k} + e_t with white e of variance σ²; a = (1, -φ). The missing samples of least
Σ e² are their conditional expectation given all others, and σ² B⁻¹ is its error, B the Toeplitz
matrix of b_l = Σ a_k a_{k+l} [Janssen1986]. README.md, "Missing samples".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, IntArray
from lmshealth.io import constants
from lmshealth.io.buffers import Samples, Spool, blocks, places

# Samples of each of the places from which the model is estimated, frequencies at which the error of
# filled samples is compared, and share of the sample rate up to which that is done.
_PLACE, _N_FREQUENCIES, _USABLE = 1 << 13, 129, 0.45
_ORDER = constants.PREDICTION_ORDER


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Linear prediction of a channel from its last samples."""

    mean: float
    filter: FloatArray  # a, ``(order + 1,)``
    variance: float  # of the prediction error

    @property
    def correlation(self) -> FloatArray:
        """b_l for l from 0 to the order, shape ``(order + 1,)``."""
        return np.asarray(np.correlate(self.filter, self.filter, "full")[_ORDER:])

    def errors(self, x: FloatArray) -> FloatArray:
        """Return the prediction errors of samples ``(n,)`` from the order on, ``(n - order,)``."""
        return np.convolve(x - self.mean, self.filter, "valid")

    def expected(self, x: FloatArray, unknown: IntArray) -> FloatArray:
        """Return the expectation of unknown samples given the others.

        Indices ascend and lie at least the order from both ends of x, which is zero-based there.
        """
        known = x - self.mean
        known[unknown] = 0.0
        # Σ_t a_{t-i} e_t, e the errors with zeros at the unknown samples.
        lack = np.correlate(np.convolve(known, self.filter, "valid"), self.filter, "valid")
        apart = np.abs(unknown[:, None] - unknown)
        b = np.append(self.correlation, 0.0)[np.minimum(apart, _ORDER + 1)]
        return np.asarray(self.mean - np.linalg.solve(b, lack[unknown - _ORDER]))

    def error_shares(self, lengths: Sequence[int], n_samples: int) -> FloatArray:
        """Return the largest share of the power spectral density that errors of gaps have.

        For filling all gaps of up to each of their ascending lengths, ``(n_gaps,)``.
        """
        turn = np.exp(-2j * np.pi * np.linspace(0, _USABLE, _N_FREQUENCIES))
        inverse = np.abs(np.polynomial.polynomial.polyval(turn, self.filter)) ** 2
        each: dict[int, FloatArray] = {}
        for size in set(lengths):
            powers = turn[:, None] ** np.arange(size)
            place = np.arange(size)
            error = np.linalg.inv(self.correlation[np.abs(place[:, None] - place)])
            each[size] = np.einsum("fi,ij,fj->f", powers.conj(), error, powers).real * inverse
        total = np.cumsum([each[size] for size in lengths], axis=0) / n_samples
        return np.asarray(total.max(axis=1))


def fit_prediction(values: Samples, bad: IntArray) -> Prediction | None:
    """Fit the model by least squares where no sample in the window is missing or bad.

    ``bad`` are ascending half-open ranges, ``(n_ranges, 2)``; None where too few windows remain.
    """
    if values.size <= constants.PREDICTION_SAMPLES:
        return None
    parts = [(at, values[at : at + _PLACE]) for at in places(values.size, _PLACE)]
    usable = [(x, ~within(bad, at, x.size)) for at, x in parts]
    n = sum(int(good.sum()) for _, good in usable)
    mean = float(sum(x[good].sum() for x, good in usable) / max(n, 1))
    gram, rows = np.zeros((_ORDER + 1, _ORDER + 1)), 0
    for x, good in usable:
        whole = np.convolve(~good, np.ones(_ORDER + 1), "valid") < 0.5
        window = np.lib.stride_tricks.sliding_window_view(x - mean, _ORDER + 1)[whole]
        gram += window.T @ window
        rows += len(window)
    if rows <= constants.PREDICTION_SAMPLES:
        return None
    # Columns from the oldest sample to the newest.
    phi = np.linalg.lstsq(gram[:-1, :-1], gram[:-1, -1], rcond=1e-13)[0]
    a = np.concatenate([[1.0], -phi[::-1]])
    variance = float(a[::-1] @ gram @ a[::-1]) / rows
    return Prediction(mean, a, variance) if variance > 0 else None


def within(ranges: IntArray, at: int, size: int) -> BoolArray:
    """Return which of the samples from ``at`` on lie in half-open ranges."""
    steps = np.zeros(size + 1)
    there = ranges[(ranges[:, 1] > at) & (ranges[:, 0] < at + size)] - at
    np.add.at(steps, there[:, 0].clip(0), 1)
    np.add.at(steps, there[:, 1].clip(max=size), -1)
    return np.asarray(np.cumsum(steps)[:-1] > 0)


def filled(values: Samples, missing: IntArray, breaks: IntArray) -> tuple[Samples, IntArray]:
    """Replace short gaps of a channel by the expectation of their samples.

    ``missing`` are ascending half-open ranges, ``(n_ranges, 2)``; time is interrupted before the
    samples ``breaks``. Filled are gaps of up to `LONGEST_FILLED` samples, as far as their errors
    have at most `FILLED_ERROR` of the power spectral density at any frequency, which lie in
    ordinary surroundings. Return the samples and the ranges that remain missing.
    """
    size = missing[:, 1] - missing[:, 0]
    short = size <= constants.LONGEST_FILLED
    model = fit_prediction(values, missing) if short.any() else None
    if model is None:
        return values, missing
    order = np.sort(size[short])
    refused = ~(model.error_shares(order.tolist(), values.size) <= constants.FILLED_ERROR)
    # Of equal lengths all are filled, or none.
    short &= size < order[refused].min(initial=constants.LONGEST_FILLED + 1)
    if not short.any():
        return values, missing
    blocked = np.concatenate([missing[~short], np.stack([breaks, breaks], axis=1)])
    where, what, left = [], [], [missing[~short]]
    # Gaps that lie less than the order from each other are filled together.
    gaps = missing[short]
    apart = np.flatnonzero(gaps[1:, 0] - gaps[:-1, 1] >= _ORDER) + 1
    for group in np.split(gaps, apart):
        first, last = int(group[0, 0]) - _ORDER, int(group[-1, 1]) + _ORDER
        inside = first >= 0 and last <= values.size
        if inside and not ((blocked[:, 0] < last) & (blocked[:, 1] > first)).any():
            x = values[first:last].copy()
            unknown = np.concatenate([np.arange(a, b) for a, b in group - first])
            x[unknown] = model.expected(x, unknown)
            if (model.errors(x) ** 2).max() < constants.ORDINARY**2 * model.variance:
                where.append(first + unknown)
                what.append(x[unknown])
                continue
        left.append(group)
    rest = np.concatenate(left)
    if where:
        values = _replaced(values, np.concatenate(where), np.concatenate(what))
    return values, rest[np.argsort(rest[:, 0], kind="stable")]


def _replaced(values: Samples, where: IntArray, what: FloatArray) -> Samples:
    """Return samples of which those of ascending indices are replaced."""
    spool = Spool(values.size)
    for at, block in blocks(values):
        part = block.copy()
        own = slice(*np.searchsorted(where, [at, at + block.size]))
        part[where[own] - at] = what[own]
        spool.append(part)
    return spool.samples()
