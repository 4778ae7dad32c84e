"""Faults of a channel that its samples show: wrapped counters, single bad samples, lost signs."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.io import constants
from lmshealth.io.buffers import BLOCK, Samples, Spool, blocks
from lmshealth.io.channel_checks import Roughness
from lmshealth.io.prediction import Prediction, fit_prediction, within
from lmshealth.io.refusal import Unusable
from lmshealth.io.time_axis import IntArray

_ORDER = constants.PREDICTION_ORDER
# Samples over which what follows a blow is one with it.
_BLOW = 10 * _ORDER
# Differences of levels below this share of the range are rounding of floats; a level is a whole
# number of steps within the second.
_ROUNDING, _WHOLE = 1e-9, 0.05
# A step may be the smallest difference of levels over a number up to this: of many not all occur.
_MOST_SKIPPED = 4


def level_step(values: Samples) -> float | None:
    """Return the step between the levels of a quantised channel; None where it has none."""
    some = values[:BLOCK]
    levels = np.unique(some[np.isfinite(some)])
    apart = np.diff(levels)
    apart = apart[apart > _ROUNDING * np.ptp(levels)] if levels.size > 1 else apart
    if not apart.size:
        return None
    off = levels - levels[0]
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


def unwrapped(values: Samples, rough: Roughness) -> tuple[Samples, str]:
    """Undo the overflows of a counter: return samples and a note, which is empty without any.

    A wrapped channel jumps from one end of its range to the other, by 2^bits steps of its levels
    less what a sample moves. `Unusable` (``wrapped``) where the jumps are those of a counter, but
    no whole number of steps.
    """
    span = rough.high - rough.low
    if rough.step <= constants.WRAP_JUMP * span:
        return values, ""
    jumps, other = _jumps(values, constants.WRAP_JUMP * span)
    if not 0 < other <= constants.WRAP_SMOOTH * span or jumps.size > values.size / 100:
        return values, ""
    inner = np.clip(jumps, 2, values.size - 2)
    x = np.array([values[i - 2 : i + 2] for i in inner.tolist()]).T
    down = x[2] < x[1]
    ends = np.where(down, rough.high - x[1], x[1] - rough.low)
    ends = np.maximum(ends, np.where(down, x[2] - rough.low, rough.high - x[2]))
    size = np.abs(x[2] - x[1])
    if not (ends <= 2 * other).all():
        return values, ""
    found = f"{jumps.size} jumps from one end of its range to the other, by {np.median(size):.6g}"
    step = level_step(values)
    bits = 0 if step is None else round(float(np.log2(np.median(size) / step)))
    if step is not None and bits in constants.WRAP_BITS:
        whole = step * 2.0**bits
        if span < whole and (np.abs(whole - size) <= 2 * other).all():
            turns = np.where(down, whole, -whole)
            return _shifted(values, jumps, turns), f"{found}: overflows of {bits} bits, undone"
    # Before and after an overflow the signal moves the same way, unlike at a step of a square wave.
    same = ((x[1] - x[0] > 0) == down) & ((x[3] - x[2] > 0) == down)
    if jumps.size >= constants.FEWEST_WRAPS and same.all():
        needed = "export the values of the counter without rounding, or record it with more bits"
        raise Unusable("wrapped", f"{found}: overflows of no whole number of steps; {needed}")
    return values, ""


def _jumps(values: Samples, limit: float) -> tuple[IntArray, float]:
    """Return the samples that jump by more than a limit, and the largest other difference."""
    found, other = [np.empty(0, dtype=np.int64)], 0.0
    for at, block in blocks(values, overlap=1):
        size = np.abs(np.diff(block))
        jump = size > limit
        found.append(np.flatnonzero(jump) + at + 1)
        other = max(other, float(size[size <= limit].max(initial=0.0)))
    return np.unique(np.concatenate(found)), other


def _shifted(values: Samples, jumps: IntArray, turns: FloatArray) -> Samples:
    """Add to all samples the turns up to them."""
    spool, total = Spool(values.size), np.append(0.0, np.cumsum(turns))
    for at, block in blocks(values):
        count = np.searchsorted(jumps, np.arange(at, at + block.size), side="right")
        spool.append(block + total[count])
    return spool.samples()


def spikes(values: Samples, missing: IntArray, rough: Roughness) -> IntArray:
    """Find single samples, or two in a row, that are no part of the signal.

    The signal itself is as its linear prediction expects it after and before them; a blow instead
    goes on in it. ``missing`` are ascending half-open ranges, and so is the result, ``(n, 2)``.
    """
    none = np.empty((0, 2), dtype=np.int64)
    if rough.bend <= constants.SUSPECT * rough.usual:
        return none
    suspects = _suspects(values, constants.SUSPECT * rough.usual)
    if not suspects.size or suspects.size > 3 * constants.MOST_SPIKES * values.size:
        return none
    bad = np.concatenate([missing, np.stack([suspects - 1, suspects + 2], axis=1)])
    model = fit_prediction(values, bad)
    if model is None:
        return none
    sample = np.unique(values[:BLOCK])
    apart = np.diff(sample[np.isfinite(sample)])
    least = constants.SPIKE_LEVELS * float(apart.min(initial=np.inf) if apart.size else 0.0)
    starts = np.flatnonzero(np.diff(suspects, prepend=-_ORDER) > 3)
    found: list[_Spike] = []
    doubtful: list[_Spike] = []
    others, last = 0, -_BLOW
    for a, b in pairwise([*starts.tolist(), suspects.size]):
        one = _spike(values, missing, model, suspects[a:b], least)
        if one is not None:
            (found if one.clear else doubtful).append(one)
            continue
        if suspects[a] - last > _BLOW:
            others, last = others + 1, int(suspects[a])
    # In white noise nothing goes on after a blow: there only outliers that stand alone are spikes.
    if not others and all(one.size > constants.SPIKE_ALONE for one in doubtful):
        found += doubtful
    energy = sum(one.energy for one in found)
    few = len(found) < constants.SPIKE_SHARE * others
    if few or energy < constants.SPIKE_ENERGY * values.size:
        return none
    ranges = np.array([one.samples for one in found], dtype=np.int64)
    return ranges[np.argsort(ranges[:, 0])]


class _Spike(NamedTuple):
    """Half-open range, size in standard deviations of its expectation, energy over the variance.

    ``clear`` if what a blow would leave is not there.
    """

    samples: tuple[int, int]
    size: float
    energy: float
    clear: bool


def _suspects(values: Samples, limit: float) -> IntArray:
    """Return the samples whose second difference exceeds a limit."""
    found = [np.empty(0, dtype=np.int64)]
    for at, block in blocks(values, overlap=2):
        found.append(np.flatnonzero(np.abs(np.diff(block, 2)) > limit) + at + 1)
    return np.unique(np.concatenate(found))


def _spike(
    values: Samples, missing: IntArray, model: Prediction, suspects: IntArray, least: float
) -> _Spike | None:
    """Judge one place: a spike of more than the least size, or None."""
    first, last = int(suspects[0]) - _ORDER - 1, int(suspects[-1]) + _ORDER + 2
    if suspects[-1] - suspects[0] > 3 or first < 0 or last > values.size:
        return None
    x = values[first:last].copy()
    gone = np.flatnonzero(within(missing, first, x.size))
    if gone.size and (gone[0] < _ORDER or gone[-1] >= x.size - _ORDER):
        return None
    x[gone] = 0.0
    if gone.size:
        x[gone] = model.expected(x, gone)
    errors = model.errors(x) ** 2 / model.variance
    for n in (1, 2):
        tried = []
        for k in range(int(suspects[0]) + 1 - n, int(suspects[-1]) + 1):
            own = np.arange(k, k + n) - first
            y = x.copy()
            unknown = np.union1d(own, gone)
            y[unknown] = model.expected(y, unknown)
            tried.append((float((model.errors(y) ** 2).sum()) / model.variance, own, y))
        after, own, y = min(tried, key=lambda one: one[0])
        rest = model.errors(y) ** 2 / model.variance
        gain = float(errors.sum()) - after
        if rest.max() < constants.ORDINARY**2 and gain > constants.SPIKE**2:
            if np.abs(x[own] - y[own]).min() <= least:
                return None
            # What as many innovations, such as those of a blow, would leave.
            blow = float(np.sort(errors)[:-n].sum())
            span = int(own[0]) + first, int(own[-1]) + first + 1
            return _Spike(span, gain**0.5, gain, after < constants.CLEARLY * blow)
    return None


def check_sign(values: Samples, rough: Roughness) -> None:
    """Refuse a channel of magnitudes (``rectified``): vibration has both signs.

    The density of |x| is largest at a sharp edge; that of (x² + y² + z²)^½ begins at zero.
    """
    x = _sample(values)
    if x.size < constants.FEWEST_FOR_SHAPE or np.unique(x).size < constants.FEWEST_LEVELS:
        return
    for own, low, high in ((x, rough.low, rough.high), (-x, -rough.high, -rough.low)):
        q = np.quantile(own, [0.001, 0.01, 0.05, 0.5, 0.99, 0.999])
        below, above = q - low, high - q
        # Quantiles above an edge are proportional to their probability, those of a tail are not.
        edge = below[0] > 0 and below[1] > constants.EDGE * below[0]
        # Most samples are at the edge; the other end, unlike that of a sine, has none.
        edge &= below[2] < constants.AT_EDGE * below[3]
        edge &= above[4] <= constants.EDGE / 2 * above[5]
        scale = float(own.std())
        skew = float(np.mean((own - own.mean()) ** 3)) / scale**3
        from_zero = 0 <= low < constants.NEAR_ZERO * q[3] and skew > constants.MAGNITUDE_SKEW
        if edge or from_zero:
            end = f"below {rough.low:.4g}" if own is x else f"above {rough.high:.4g}"
            detail = f"no sample is {end} (SI), as of a magnitude, which shows modes at sums and "
            raise Unusable("rectified", f"{detail}doubles of their frequencies; record its sign")


def coarse_levels(values: Samples) -> str:
    """Return what is wrong with the levels of a channel; empty if nothing."""
    x = _sample(values)
    levels, count = np.unique(x, return_counts=True)
    if levels.size < 3:
        return ""
    gaps, std = np.diff(levels), float(x.std())
    step = float(np.median(gaps))
    if std < constants.LEAST_STEPS * step and levels.size < constants.FEWEST_LEVELS:
        found = f"its standard deviation is {std / step:.2f} steps of {step:.3g} (SI)"
        return f"{found}: levels and standard deviations of its modes may be wrong; widen its gain"
    upto = np.cumsum(count) / x.size
    inner = (upto[:-1] > 0.1) & (upto[:-1] < 0.9)
    least = max(constants.WIDE_GAP * std, 3 * step)
    wide = inner & (gaps > least) & (gaps < 2 * constants.WIDE_GAP * std)
    for k in np.flatnonzero(wide).tolist():
        # Between two humps of the distribution there are few samples beside the gap.
        below, above = levels[k : k + 2].tolist()
        reach = (above - below) / 4
        n_below = int(np.count_nonzero((x > below - reach) & (x <= below)))
        n_above = int(np.count_nonzero((x >= above) & (x < above + reach)))
        n = min(n_below, n_above)
        if n > 0.25 * max(n_below, n_above) and 4 * n > constants.GAP_EXPECTED:
            found = f"no sample lies between {below:.6g} and {above:.6g} (SI)"
            return f"{found}, {(above - below) / std:.2f} standard deviations; check the converter"
    return ""


def _sample(values: Samples) -> FloatArray:
    """Return samples of eight places, without the missing ones."""
    n = constants.SHAPE_SAMPLES // 8
    starts = np.unique(np.linspace(0, max(0, values.size - n), 8).astype(int)).tolist()
    x = np.concatenate([values[at : at + n] for at in starts])
    return np.asarray(x[np.isfinite(x)])
