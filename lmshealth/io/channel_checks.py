"""Faults of channels that their samples show, and what is repaired (CHECKS.md).

Missing samples, constant value, clipping, linear dependence; wrapped counters, single bad samples,
lost signs, coarse levels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, IntArray, pivots
from lmshealth.io import buffers, constants
from lmshealth.io.buffers import BLOCK, NO_RANGES, Samples, Spool, blocks, count, places
from lmshealth.io.refusal import Unusable
from lmshealth.io.time_axis import too_many

# Samples of each of the places from which the model is estimated, frequencies at which the error of
# filled samples is compared, and share of the sample rate up to which that is done.
_PLACE, _N_FREQUENCIES, _USABLE = 1 << 13, 129, 0.45
_ORDER = constants.PREDICTION_ORDER


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Autoregressive model of a channel, x_t = Σ φ_k x_{t-k} + e_t with white e of variance σ².

    With a = (1, -φ) the missing samples of least Σ e² are their conditional expectation given all
    others, and σ² B⁻¹ is its error, B the Toeplitz matrix of b_l = Σ a_k a_{k+l} [Janssen1986].
    """

    mean: float
    filter: FloatArray  # a, ``(order + 1,)``
    variance: float  # of the prediction error

    def precision(self, places: IntArray) -> FloatArray:
        """Return B of unknown samples at some places, ``(n, n)``."""
        b = np.correlate(self.filter, self.filter, "full")[_ORDER:]
        apart = np.minimum(np.abs(places[:, None] - places), _ORDER + 1)
        return np.asarray(np.append(b, 0.0)[apart])

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
        change = np.linalg.solve(self.precision(unknown), lack[unknown - _ORDER])
        return np.asarray(self.mean - change)

    def error_shares(self, lengths: Sequence[int], n_samples: int) -> FloatArray:
        """Return the largest share of the power spectral density that errors of filled gaps have.

        Those of all gaps up to each one, by ascending lengths, ``(n_gaps,)``.
        """
        turn = np.exp(-2j * np.pi * np.linspace(0, _USABLE, _N_FREQUENCIES))
        inverse = np.abs(np.polynomial.polynomial.polyval(turn, self.filter)) ** 2
        each: dict[int, FloatArray] = {}
        for size in set(lengths):
            powers = turn[:, None] ** np.arange(size)
            error = np.linalg.inv(self.precision(np.arange(size)))
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
    gram, n_rows = np.zeros((_ORDER + 1, _ORDER + 1)), 0
    for x, good in usable:
        whole = np.convolve(~good, np.ones(_ORDER + 1), "valid") < 0.5
        window = np.lib.stride_tricks.sliding_window_view(x - mean, _ORDER + 1)[whole]
        gram += window.T @ window
        n_rows += len(window)
    if n_rows <= constants.PREDICTION_SAMPLES:
        return None
    # Columns from the oldest sample to the newest.
    phi = np.linalg.lstsq(gram[:-1, :-1], gram[:-1, -1], rcond=1e-13)[0]
    a = np.concatenate([[1.0], -phi[::-1]])
    variance = float(a[::-1] @ gram @ a[::-1]) / n_rows
    return Prediction(mean, a, variance) if variance > 0 else None


def within(ranges: IntArray, at: int, size: int) -> BoolArray:
    """Return which of the samples from ``at`` on lie in half-open ranges."""
    steps = np.zeros(size + 1)
    there = ranges[(ranges[:, 1] > at) & (ranges[:, 0] < at + size)] - at
    np.add.at(steps, there[:, 0].clip(0), 1)
    np.add.at(steps, there[:, 1].clip(max=size), -1)
    return np.asarray(np.cumsum(steps)[:-1] > 0)


def filled(values: Samples, missing: IntArray, breaks: IntArray) -> tuple[Samples, IntArray]:
    """Replace short gaps of a channel by the expectation of their samples (CHECKS.md, "Method").

    ``missing`` are ascending half-open ranges, ``(n_ranges, 2)``; time is interrupted before the
    samples ``breaks``. Return the samples and the ranges that remain missing.
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


# Missing samples, constant value, clipping, dependence

# Standard deviation of normal noise over the median of its magnitude, and samples of a block from
# which the usual second difference is taken.
_NORMAL, _SAMPLE = 1.4826, 1 << 12
_Ranges = Sequence[tuple[int, int]]


def missing_ranges(values: Samples, added: IntArray = NO_RANGES) -> tuple[IntArray, str]:
    """Find the missing samples (NaN, infinite or absurd) of a channel, ``(n_samples,)`` in SI.

    Return half-open ranges in which every sample is missing, ascending, ``(n_ranges, 2)``, and
    their counts as a text, empty if nothing is missing. `Unusable` (``missing-samples``) where they
    are so many that they would cut the other channels to pieces.
    """
    most = constants.LARGEST_MAGNITUDE
    marked = np.concatenate([~(np.abs(block) < most) for _, block in blocks(values)])
    if not marked.any():
        return NO_RANGES, ""
    ranges = buffers.runs(marked)
    n_missing, n_ranges = count(ranges), len(ranges)
    note = f"{n_missing} of {values.size} samples are missing (NaN) in {n_ranges} ranges"
    # Gaps of the time are common to all channels, and were counted there.
    many = too_many(n_ranges - len(added), values.size)
    if n_missing - count(added) > constants.LARGEST_MISSING * values.size or many:
        raise Unusable("missing-samples", note)
    return ranges, note


class Roughness(NamedTuple):
    """Range of a channel, its largest first and second differences, and the usual second one."""

    low: float
    high: float
    step: float  # largest |x_t - x_{t-1}|
    bend: float  # largest |x_{t-1} - 2 x_t + x_{t+1}|
    usual: float  # robust standard deviation of the latter


def roughness(values: Samples) -> Roughness:
    """Measure a channel, ``(n_samples,)``, in one pass; missing samples are left out."""
    low, high, step, bend, usual = np.inf, -np.inf, 0.0, 0.0, [0.0]
    for _, block in blocks(values, overlap=2):
        if np.isnan(block.min(initial=0.0)):
            block = block[np.isfinite(block)]
        low = min(low, float(block.min(initial=low)))
        high = max(high, float(block.max(initial=high)))
        if block.size < 3:
            continue
        first = np.diff(block)
        second = np.diff(first)
        step = max(step, float(first.max()), -float(first.min()))
        bend = max(bend, float(second.max()), -float(second.min()))
        some = np.abs(second[:_SAMPLE])
        usual.append(float(max(_NORMAL * np.median(some), some.mean())))
    return Roughness(low, high, step, bend, float(np.median(usual[1:] or usual)))


def check_signal(values: Samples) -> Roughness:
    """Refuse a constant (``flat``) or ``clipped`` channel, ``(n_samples,)`` in SI units."""
    rough = roughness(values)
    low, high = rough.low + 0.0, rough.high  # no −0
    if low == high:
        raise Unusable("flat", f"all {values.size} samples are {low:.6g} (SI); check the sensor")
    if high - low < constants.SMALLEST_RANGE:
        found = f"all {values.size} samples are within {high - low:.3g} (SI)"
        raise Unusable("flat", f"{found}; check the sensor and its unit")
    at_high, at_low = _stuck(values, low, high, 1.0), _stuck(values, -high, -low, -1.0)
    if at_high + at_low >= constants.CLIPPED_SHARE * values.size:
        found = f"{at_low} samples are at the minimum {low:.6g} and {at_high} at the maximum"
        found += f" {high:.6g} (SI) of {values.size}"
        raise Unusable("clipped", f"{found}; widen the range of the sensor")
    return rough


def independent(columns: Sequence[Samples], ranges: _Ranges, most: int) -> list[int]:
    """Order channels by what each adds to those before, by a pivoted Cholesky decomposition.

    Columns of ``(n_samples,)`` without missing samples in the half-open ranges. Return the indices
    of at most so many; a channel that the others determine is not among them.
    """
    gram = np.zeros((len(columns), len(columns)))
    length = constants.COMPARED // 8
    for start, stop in ranges:
        for at in range(start, stop, BLOCK):
            end = min(at + BLOCK, stop)
            # A coarse channel is constant for as long as the machine rests.
            for k in places(end - at, length):
                part = np.stack([c[at + k : min(at + k + length, end)] for c in columns])
                part -= part[:, :1]  # the mean of equal samples may be rounded
                part -= part.mean(axis=1, keepdims=True)
                gram += part @ part.T
    size = np.diagonal(gram)
    scale = np.sqrt(size.clip(np.finfo(float).tiny))
    order = pivots(gram / scale[:, None] / scale, most, least=constants.DEPENDENT)
    # Channels that are constant in all stretches may differ elsewhere.
    return [*order, *np.flatnonzero(size == 0).tolist()][:most]


def magnitudes(columns: Sequence[Samples], ranges: _Ranges) -> dict[int, list[int]]:
    """Find channels that are the magnitude of others, each with the indices of these.

    With r = (x² + y² + z²)^½ - g the square of r is linear in r, x², y² and z², which have equal
    weights. Arguments as in `independent`, in one unit.
    """
    found = dict[int, list[int]]()
    start, stop = max(ranges, key=lambda one: one[1] - one[0])
    if len(columns) < 3 or stop - start < constants.FEWEST_FOR_SHAPE:
        return found
    x = np.stack([c[start : min(start + constants.COMPARED, stop)] for c in columns])
    x = x / np.abs(x).max().clip(np.finfo(float).tiny)
    (squares, scale), (x, _) = _standardised(x**2), _standardised(x)
    # Of a regression on all others, 1 / (P)_kk of the inverse of the correlations is unexplained;
    # that of the squares is extended by r itself.
    ridge = constants.DEPENDENT * np.eye(len(x))
    linear = 1 / np.diagonal(np.linalg.inv(x @ x.T + ridge))
    inverse, cross = np.linalg.inv(squares @ squares.T + ridge), squares @ x.T
    by = inverse @ cross
    left = 1 + constants.DEPENDENT - np.sum(cross * by, axis=0)
    for k, unexplained in enumerate(linear):
        row = inverse[k] + by[k, k] * by[:, k] / left[k]
        if 1 / row[k] < min(constants.MAGNITUDE, 0.1 * unexplained):
            own = -row / scale
            own[k] = 0.0
            axes = own > own.max() / 2
            if axes.sum() > 1 and own[axes].min() > 0.95 * own.max():
                found[k] = np.flatnonzero(axes).tolist()
    return found


def _standardised(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rows of mean 0 and length 1, ``(n_rows, n)``, and their lengths, ``(n_rows,)``."""
    x = x - x.mean(axis=1, keepdims=True)
    length = np.sqrt(np.sum(x**2, axis=1)).clip(np.finfo(float).tiny)
    return x / length[:, None], length


def _stuck(values: Samples, low: float, high: float, sign: float) -> int:
    """Count the samples at the maximum that clipping explains (CHECKS.md, "Method"), else 0."""
    # A signal of few steps is accepted. ``sign`` -1 examines the minimum.
    n_at = n_adjacent = 0
    below = low
    for _, block in blocks(values):
        block = block[np.isfinite(block)]
        at = block == sign * high
        n_at += int(np.count_nonzero(at))
        n_adjacent += int(np.count_nonzero(at[1:] & at[:-1]))
        below = max(below, float(np.max(sign * block, where=~at, initial=low)))
    step = high - below
    few = n_at < max(constants.FEWEST_STUCK, constants.CLIPPED_SHARE / 2 * values.size)
    few |= n_adjacent < constants.ADJACENT_SHARE * n_at
    if few or high - low < constants.FEWEST_LEVELS * step:
        return 0
    floor = high - (constants.LEVELS_BELOW + 0.5) * step
    n_below = sum(int(np.count_nonzero(sign * b > floor)) for _, b in blocks(values)) - n_at
    return n_at if n_at > constants.CLIPPING_RATIO * n_below else 0


# Counters, bad samples, lost signs, levels

# Samples over which what follows a blow is one with it.
_BLOW = 10 * _ORDER
# Differences of levels below this share of the range are rounding of floats; a level is a whole
# number of steps within the second.
_ROUNDING, _WHOLE = 1e-9, 0.05
# Samples among which the next overflow is searched at once.
_STRIDE = 256
# A step may be the smallest difference of levels over a number up to this: of many not all occur.
_MOST_SKIPPED = 4


def level_step(values: Samples) -> float | None:
    """Return the step between the levels of a quantised channel; None where it has none."""
    some = values[:BLOCK]
    levels = np.unique(some[np.isfinite(some)])
    if levels.size < 2:
        return None
    off, apart = levels - levels[0], np.diff(levels)
    apart = apart[apart > _ROUNDING * off[-1]]
    for part in range(1, _MOST_SKIPPED + 1):
        step = float(apart.min()) / part
        reach = 16 * step
        while reach < 2 * off[-1]:  # refined over ever more steps
            near = off[off <= reach]
            n = np.rint(near / step)
            step = float(n @ near / (n @ n)) if n.any() else step
            reach *= 2
        if (np.abs(off / step - np.rint(off / step)) < _WHOLE).all():
            return step
    return None


def unwrapped(values: Samples, missing: IntArray, rough: Roughness) -> tuple[Samples, str]:
    """Undo the overflows of a counter: return samples and a note, which is empty without any.

    After an overflow samples are off their linear prediction by 2^bits steps of the levels of the
    channel, which span less. `Unusable` (``wrapped``) where that number is not whole, or the
    overflows are too many to be undone. ``missing`` are half-open ranges, ``(n_ranges, 2)``.
    """
    span = rough.high - rough.low
    largest = float(np.sqrt(2 * np.log(values.size))) + constants.WRAP_BEND
    if rough.step <= span / 2 or rough.bend <= largest * rough.usual:
        return values, ""
    jumps = _beyond(values, 1, span / 2)
    bad = np.concatenate([missing, np.stack([jumps, jumps + 1], axis=1)])
    model = fit_prediction(values, bad)
    step = level_step(values)
    bits = 0 if step is None else int(np.ceil(np.log2(span / step)))
    whole = 0.0 if step is None or bits not in constants.WRAP_BITS else step * 2.0**bits
    if model is None or 0 < whole < 2 * constants.WRAP_SIGMAS * model.variance**0.5:
        _refuse_full(values, rough, whole - span, bits)
        return values, ""
    if whole > span:
        undone, n = _without_turns(values, model, whole)
        if n:
            steps = f"{2**bits} steps of {bits} bits of a counter that overflows"
            return undone, f"{n} samples are off by the {steps}: undone"
    _refuse_unknown(values, jumps, model, span)
    return values, ""


def _refuse_unknown(values: Samples, jumps: IntArray, model: Prediction, span: float) -> None:
    """Refuse (``wrapped``) a channel that jumps by its range, which is no whole number of steps."""
    std = model.variance**0.5
    first = jumps[np.diff(jumps, prepend=-_ORDER) >= _ORDER]
    some = first[first >= _ORDER][:: max(1, first.size // 1000)].tolist()
    sizes = [abs(float(model.errors(values[i - _ORDER : i + 1])[0])) for i in some]
    odd = np.array([size for size in sizes if size > constants.ORDINARY * std])
    if odd.size < max(constants.FEWEST_WRAPS, len(some) / 2):
        return
    alike = np.abs(odd - np.median(odd)) < constants.ORDINARY * std
    # A square wave has noise beyond both its levels.
    if np.median(odd) > span - 3 * std and alike.mean() > constants.WRAPS_UNDONE:
        found = f"{jumps.size} jumps of its range: a counter overflows by no whole number of steps"
        needed = "export its values without rounding, or record it with more bits"
        raise Unusable("wrapped", f"{found}; {needed}")


def _beyond(values: Samples, order: int, limit: float) -> IntArray:
    """Return the samples whose difference from the one before, or from both beside it, is larger.

    These are of first and second order.
    """
    each = ((at, np.abs(np.diff(block, order))) for at, block in blocks(values, overlap=order))
    return np.unique(np.concatenate([np.flatnonzero(size > limit) + at + 1 for at, size in each]))


def _without_turns(values: Samples, model: Prediction, whole: float) -> tuple[Samples, int]:
    """Bring each sample within half a turn of its prediction; return how many were off."""
    # None is changed, and 0 returned, unless all are then as the prediction expects.
    spool, a, squares, n = Spool(values.size), model.filter, 0.0, 0
    before = np.full(_ORDER, model.mean)
    for _, block in blocks(values):
        x = np.concatenate([before, block])
        gone = ~np.isfinite(x)
        x[gone] = model.mean
        errors = model.errors(x)
        i = 0
        while i < errors.size:
            lacks = gone[i + _ORDER : i + _ORDER + _STRIDE]
            off = (np.abs(errors[i : i + _STRIDE]) > whole / 2) | lacks
            if not off.any():
                i += _STRIDE
                continue
            i += int(off.argmax())
            lacking = bool(gone[i + _ORDER])
            if not abs(errors[i]) < constants.MOST_TURNS * whole:
                return values, 0  # the model follows its own corrections
            turn = float(errors[i]) if lacking else whole * round(float(errors[i]) / whole)
            reached = errors[i : i + _ORDER + 1]
            reached -= turn * a[: reached.size]
            x[i + _ORDER] -= turn
            if not lacking:
                squares, n = squares + float(errors[i]) ** 2, n + 1
            i += 1
        before = x[-_ORDER:].copy()
        x[gone] = np.nan
        spool.append(x[_ORDER:])
    if n and squares < constants.WRAPS_SPREAD**2 * n * model.variance:
        return spool.samples(), n
    return values, 0


def _refuse_full(values: Samples, rough: Roughness, left: float, bits: int) -> None:
    """Refuse (``wrapped``) a channel that holds all levels of a counter but for a few."""
    # Unlike vibration it has as many samples at both ends of its range as elsewhere.
    near = (rough.high - rough.low) / 100
    x = _sample(values, constants.SHAPE_SAMPLES)
    if x.size < constants.FEWEST_FOR_SHAPE or not 0 < left < near:
        return
    if min(np.mean(x < rough.low + near), np.mean(x > rough.high - near)) > constants.WRAP_ENDS:
        found = f"its levels are all of {bits} bits, and as frequent at both ends as inside"
        needed = "the counter overflows; record it with more bits, or faster"
        raise Unusable("wrapped", f"{found}: {needed}")


def spikes(
    values: Samples, missing: IntArray, rough: Roughness, breaks: IntArray = NO_RANGES[:, 0]
) -> IntArray:
    """Find single samples, or two in a row, that are no part of the signal.

    The signal itself is as its linear prediction expects it after and before them; a blow instead
    goes on in it. ``missing`` are ascending half-open ranges, and so is the result, ``(n, 2)``.
    Near samples before which time is interrupted, ascending ``breaks``, there is nothing to expect.
    """
    if rough.bend <= constants.SUSPECT * rough.usual:
        return NO_RANGES
    suspects = _beyond(values, 2, constants.SUSPECT * rough.usual)
    reach = 2 * _ORDER
    suspects = suspects[
        np.searchsorted(breaks, suspects - reach) == np.searchsorted(breaks, suspects + reach + 1)
    ]
    if not suspects.size or suspects.size > 3 * constants.MOST_SPIKES * values.size:
        return NO_RANGES
    bad = np.concatenate([missing, np.stack([suspects - 1, suspects + 2], axis=1)])
    model = fit_prediction(values, bad)
    if model is None:
        return NO_RANGES
    least = constants.SPIKE_LEVELS * buffers.smallest_step(values[:BLOCK])
    found, others, last = [], 0, -_BLOW
    for place in np.split(suspects, np.flatnonzero(np.diff(suspects) > 3) + 1):
        if (one := _spike(values, missing, model, place, least)) is not None:
            found.append(one)
        elif place[0] - last > _BLOW:
            others, last = others + 1, int(place[0])
    # In white noise nothing goes on after a blow: there only outliers that stand alone are spikes.
    if others or any(gain <= constants.SPIKE_ALONE**2 for *_, gain, clear in found if not clear):
        found = [one for one in found if one[-1]]
    energy = sum(gain for *_, gain, _ in found)
    # Noise of heavy tails has a few that stand alone among many that do not.
    if len(found) < others or energy < constants.SPIKE_ENERGY * values.size:
        return NO_RANGES
    return np.array([one[:2] for one in found], dtype=np.int64)


def _spike(
    values: Samples, missing: IntArray, model: Prediction, suspects: IntArray, least: float
) -> tuple[int, int, float, bool] | None:
    """Return a spike of more than the least size: its half-open range and energy over the variance.

    The last is whether what a blow would leave is not there.
    """
    first, last = int(suspects[0]) - 2 * _ORDER, int(suspects[-1]) + 2 * _ORDER + 1
    if suspects[-1] - suspects[0] > 3 or first < 0 or last > values.size:
        return None
    x = values[first:last].copy()
    gone = np.flatnonzero(within(missing, first, x.size))
    if gone.size and (gone[0] < _ORDER or gone[-1] >= x.size - _ORDER):
        return None
    x[gone] = model.expected(x, gone)
    errors = model.errors(x) ** 2 / model.variance
    for n in (1, 2):
        tried = []
        for k in range(int(suspects[0]) + 1 - n, int(suspects[-1]) + 1):
            own, y = np.arange(k, k + n) - first, x.copy()
            unknown = np.union1d(own, gone)
            y[unknown] = model.expected(y, unknown)
            rest = model.errors(y) ** 2 / model.variance
            tried.append((float(rest.sum()), float(rest.max()), own, y))
        after, largest, own, y = min(tried, key=lambda one: one[0])
        gain = float(errors.sum()) - after
        if largest < constants.ORDINARY**2 and gain > constants.SPIKE**2:
            if np.abs(x[own] - y[own]).min() <= least:
                return None
            # What as many innovations, such as those of a blow, would leave.
            blow = float(np.sort(errors)[:-n].sum())
            start, stop = int(own[0]) + first, int(own[-1]) + first + 1
            return start, stop, gain, after < constants.CLEARLY * blow
    return None


def check_sign(values: Samples, rough: Roughness) -> None:
    """Refuse a channel of magnitudes (``rectified``): vibration has both signs.

    The density of |x| is largest at a sharp edge; that of (x² + y² + z²)^½ begins at zero.
    """
    x = _sample(values, constants.LEVEL_SAMPLES)
    middle, reach = float(np.median(x)), constants.EDGE_REACH * float(x.std())
    if min(middle - rough.low, rough.high - middle) > reach:
        return
    x = _sample(values, constants.SHAPE_SAMPLES)
    if x.size < constants.FEWEST_FOR_SHAPE or np.unique(x).size < constants.FEWEST_LEVELS:
        return
    for own, low, high in ((x, rough.low, rough.high), (-x, -rough.high, -rough.low)):
        q = np.quantile(own, [0.001, 0.01, 0.05, 0.5, 0.95, 0.99, 0.999])
        below, above = q - low, high - q
        # Quantiles above an edge are proportional to their probability, those of a tail are not.
        edge = below[0] > 0 and below[1] > constants.EDGE * below[0]
        # Most samples are at the edge; the other end, unlike that of a sine, has none.
        edge &= below[2] < constants.AT_EDGE * below[3]
        edge &= above[5] <= constants.EDGE / 2 * above[6]
        # A sine that decays, with one sample beyond an end, is as wide above its median as below;
        # so may be the magnitude of a sine with noise, whose edge is at zero.
        at_zero = 0 <= low < constants.NEAR_ZERO * q[3]
        sides = sorted((float(q[4] - q[3]), float(q[3] - q[2])))
        edge &= at_zero or sides[1] > constants.LOPSIDED * sides[0]
        scale = float(own.std())
        skew = float(np.mean((own - own.mean()) ** 3)) / scale**3
        from_zero = at_zero and skew > constants.MAGNITUDE_SKEW
        if (edge or from_zero) and _reaches(values, own is x, low, float(q[3])):
            end = f"below {rough.low:.4g}" if own is x else f"above {rough.high:.4g}"
            found = f"no sample is {end} (SI), as of a magnitude"
            modes = "which shows modes at sums and doubles of their frequencies"
            raise Unusable("rectified", f"{found}, {modes}; record its sign")


def _reaches(values: Samples, is_lower: bool, low: float, middle: float) -> bool:
    """Return whether a channel comes near its edge throughout; a drift is there for a while."""
    n, sign = constants.LEVEL_SAMPLES // 8, 1 if is_lower else -1
    parts = (sign * values[at : at + n] for at in places(values.size, n))
    nearest = (np.nanmin(x) for x in parts if np.isfinite(x).any())
    return all(least - low <= (middle - low) / 2 for least in nearest)


def coarse_levels(values: Samples) -> str:
    """Return what is wrong with the levels of a channel; empty if nothing."""
    x = _sample(values, constants.LEVEL_SAMPLES)
    levels = np.unique(x)
    if levels.size < 3:
        return ""
    gaps, std = np.diff(levels), float(x.std())
    step = float(np.median(gaps))
    if std < constants.LEAST_STEPS * step and levels.size < constants.FEWEST_LEVELS:
        found = f"its standard deviation is {std / step:.2f} steps of {step:.3g} (SI)"
        return f"{found}: levels and standard deviations of its modes may be wrong; widen its gain"
    # A bit that is stuck leaves bands of levels apart that are as wide as the bands.
    wide = np.flatnonzero((gaps > max(constants.WIDE_GAP * std, 3 * step)) & (gaps < std))
    bands = levels[wide[1:]] - levels[wide[:-1] + 1]
    stuck = np.abs(bands / gaps[wide[:-1]] - 1) < constants.STUCK_BAND
    if stuck.sum() > 0.5 * bands.size:
        below, above = levels[wide[0] : wide[0] + 2].tolist()
        found = f"no sample lies between {below:.6g} and {above:.6g} (SI), nor in gaps like it"
        return f"{found}: a bit of the converter is stuck; check it"
    return ""


def _sample(values: Samples, most: int) -> FloatArray:
    """Return so many samples of eight places at most, without the missing ones."""
    n = most // 8
    x = np.concatenate([values[at : at + n] for at in places(values.size, n)])
    return np.asarray(x[np.isfinite(x)])
