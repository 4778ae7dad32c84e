"""The time axis: sample rate, interruptions, resampling, and the set velocity of a set position.

Samples are never sorted; `channel_checks` fills short gaps only (README.md, "Time").
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np

from lmshealth._private.arrays import FloatArray, IntArray
from lmshealth.io import buffers, constants
from lmshealth.io.buffers import BLOCK, NO_RANGES, Samples, Spool, blocks, count, runs
from lmshealth.io.log import expect_possible
from lmshealth.io.refusal import Unusable

Ranges = tuple[tuple[int, int], ...]
# Time in s of samples, by their index, and its derivatives.
Clock = Callable[..., FloatArray]

# Intervals of which the median is the local interval; most decimals of rounded stamps, and knots
# of a clock.
_GROUP, _MOST_DIGITS, _MOST_KNOTS = 128, 10, 1 << 14
# Steps of rounding that the residuals of stamps may span (the clock is estimated), and probability
# exp(-x) with which the highest line of white jitter exceeds its expectation.
_ROUNDING, _CHANCE = 1.2, 7.0
# Resampled at once, and the kernel: zeros to either side, and its window, which damps by 100 dB.
_OUTPUT, ZEROS, _WINDOW = 1 << 12, 32, 10.0


class TimeAxis(NamedTuple):
    """Sample rate in Hz, samples before which a record is interrupted, ``(n_breaks,)``.

    ``note`` counts the interruptions; it is empty if there are none. ``dropped`` samples, a few,
    belong before each break, 0 where that is uncertain, ``(n_breaks,)``. Samples whose stamps do
    not keep to the clock are ``lost``, half-open ranges, ``(n_ranges, 2)``. Where the rate varies
    there is a clock for each stretch between breaks, and `resampled` makes ``sample_rate`` of it.
    """

    sample_rate: float
    breaks: IntArray
    note: str
    lost: IntArray = NO_RANGES
    clocks: tuple[Clock, ...] = ()
    dropped: IntArray = np.empty(0, dtype=np.int64)

    def completed(self) -> tuple[Self, IntArray]:
        """Return the axis with dropped samples in their places, and their half-open ranges."""
        shift = np.concatenate([[0], np.cumsum(self.dropped)])
        if not self.dropped.any():
            return self, NO_RANGES
        known = self.dropped > 0
        start = (self.breaks + shift[:-1])[known]
        added = np.stack([start, start + self.dropped[known]], axis=1)
        # A range ends with the sample before its end.
        before = np.searchsorted(self.breaks, self.lost - [0, 1], side="right")
        lost = self.lost + shift[before]
        breaks = (self.breaks + shift[1:])[~known]
        note = f"{self.note}; short ones are inserted, and filled where the channel allows it"
        return self._replace(breaks=breaks, lost=lost, note=note, dropped=breaks * 0), added


def too_many(n_interruptions: int, n_samples: int) -> bool:
    """Return whether a record is interrupted too often to be cut into pieces."""
    return n_interruptions > max(constants.ALWAYS_ALLOWED, constants.INTERRUPTED_SHARE * n_samples)


def time_axis(time: Samples | None, rate: float | None) -> TimeAxis:
    """Find the sample rate, its variation and the interruptions of a record.

    From time stamps in s as recorded, ``(n_samples,)``, and the sample rate in Hz of the metadata.
    `Unusable` (``time``) where both are absent or disagree, where time stamps are missing, repeated
    or descending, and where the intervals are not uniform enough to resample the record.
    """
    if time is None:
        if rate is None:
            detail = "neither a column time_s nor the metadata sample_rate_hz; needed one"
            raise Unusable("time", detail)
        return TimeAxis(rate, np.empty(0, dtype=np.int64), "")
    n_repeated = _check_order(time)
    step = resolution(time)
    span = float(time[time.size - 1 :][0] - time[:1][0])
    coarse = 0 < 0.2 * span < (time.size - 1) * step
    if n_repeated and not coarse:
        found = f"time_s repeats {n_repeated} times in {time.size} samples"
        raise Unusable("time", f"{found}; needed increasing time stamps")
    # Rounding to a step near the interval makes intervals unlike: the clock decides.
    attempts = (0.0, step) if coarse else (0.0,)
    refused: dict[float, Unusable] = {}
    for slack in reversed(attempts) if n_repeated else attempts:
        try:
            return _axis(time, rate, step, slack)
        except Unusable as error:
            refused[slack] = error
    raise refused[attempts[-1]]


def _axis(time: Samples, rate: float | None, step: float, slack: float) -> TimeAxis:
    """Find the axis of stamps, rounded to a step in s; ``slack`` in s widens tolerances."""
    breaks, lengths, note, scatter = _interruptions(time, slack)
    scatter = max(scatter, slack)
    interval, rounding = _mean_interval(time, breaks), _ROUNDING * max(step, slack)
    # Stamps cut to whole steps lie on their line, which long runs of either step turn a little.
    whole = slack * round(interval / slack) if slack else 0.0
    is_whole = abs(whole / interval - 1) < constants.AGREEMENT and not breaks.size
    if is_whole and _off_line(time, (0, time.size), whole) <= rounding:
        interval = whole
    if rate is not None and abs(interval * rate - 1) > constants.AGREEMENT:
        found = f"time_s gives {1 / interval:.8g} Hz, sample_rate_hz is {rate:.8g}"
        raise Unusable("time", f"{found}; needed agreement within {constants.AGREEMENT:g}")
    least = max(_GROUP, int(scatter / (interval * constants.AGREEMENT)))
    least = min(max(least, time.size // _MOST_KNOTS), max(1, time.size // 8))
    clocks, lost, slopes, varies = [], [], [interval], False
    for start, stop in pairwise([0, *breaks.tolist(), time.size]):
        clock, slope = _clock(time, start, stop, least)
        allowed = constants.AGREEMENT + scatter / (interval * min(least, (stop - start) / 2))
        # In a stretch this short a rate cannot be measured.
        if stop - start >= _GROUP and _off_line(time, (start, stop), interval) > rounding:
            varies |= bool((np.abs(slope / interval - 1) > allowed).any())
            slopes += slope.tolist()
            lost.append(_residual(time, (start, stop), clock, interval, max(step, slack)))
        clocks.append(clock)
    gone = np.concatenate([NO_RANGES, *lost])
    n_lost = count(gone)
    notes = [note] if note else []
    if n_lost:
        notes.append(f"{n_lost} samples have no certain time, left out")
    lowest, highest = 1 / max(slopes), 1 / max(min(slopes), 1e-9 * interval)
    own = rate or float(f"{1 / interval:.10g}")  # 20000.000000000004 Hz is one of the division
    if varies:
        notes.append(f"the sample rate varies from {lowest:.6g} to {highest:.6g} Hz")
        own = float(f"{lowest:.10g}")
    note = " and ".join(notes)
    # Each of the two is known within the tolerance.
    spread = highest > constants.LARGEST_SPREAD * (1 + 2 * constants.AGREEMENT) * lowest
    if n_lost > constants.LARGEST_MISSING * time.size or (varies and spread):
        needed = "export samples of one clock, or cut the record where the rate changes"
        raise Unusable("time", f"{note}; {needed}")
    try:
        expect_possible("sample_rate_hz", own)
    except ValueError as error:
        raise Unusable("time", f"time_s: {error}") from error
    if varies:
        return TimeAxis(own, breaks, f"{note}: resampled to the lowest", gone, tuple(clocks))
    # Coarse stamps do not count the samples of a gap.
    is_whole = abs(interval / step - round(interval / step)) < constants.AGREEMENT
    is_coarse = slack > 0 or (step > constants.JITTER * interval and not is_whole)
    lacking = np.where(is_coarse, 0.0, lengths / interval - 1)
    dropped = np.rint(lacking).astype(np.int64)
    certain = np.abs(lacking - dropped) < constants.JITTER
    few = (dropped > 0) & (dropped <= constants.LONGEST_FILLED)
    return TimeAxis(own, breaks, note, gone, (), np.where(certain & few, dropped, 0))


def _mean_interval(time: Samples, breaks: IntArray) -> float:
    """Return the slope in s of parallel least-squares lines through the stretches between breaks.

    The mean of the intervals would depend on the rounding of the first and the last stamp alone.
    """
    moment = size = 0.0
    for start, stop in pairwise([0, *breaks.tolist(), time.size]):
        first, n = float(time[start : start + 1][0]), stop - start
        size += n * (n**2 - 1) / 12
        for at, stamps in blocks(time, start, stop):
            index = np.arange(at, at + stamps.size) - (start + stop - 1) / 2
            moment += float(index @ (stamps - first))
    return moment / size if size else float(np.median(np.diff(time[:])))


def _interruptions(time: Samples, slack: float) -> tuple[IntArray, FloatArray, str, float]:
    """Find gaps and odd intervals by the median interval of a group and of its neighbours."""
    # Return breaks, the intervals before them in s, their counts as a text, and four times
    # the usual deviation of an interval from its group in s.
    middles, spreads = [], []
    starts = range(0, time.size - 1, BLOCK)  # in whole groups but the last
    for steps in (np.diff(time[at : at + BLOCK + 1]) for at in starts):
        whole = steps.size - steps.size % _GROUP
        for groups in (steps[:whole].reshape(-1, _GROUP), steps[None, whole:]):
            if groups.size:
                # Stamps that are coarser than the interval have no useful median.
                middle = (np.mean if slack else np.median)(groups, axis=1)
                middles.append(middle)
                spreads.append(np.sqrt(np.mean((groups - middle[:, None]) ** 2, axis=1)))
    median, spread = np.concatenate(middles), np.concatenate(spreads)
    if median.min() <= 0:
        raise Unusable("time", f"time_s repeats over {_GROUP} samples; needed finer time stamps")
    local = np.pad(median, 1, mode="edge")
    n_gaps, n_missing = 0, 0.0
    breaks, lengths = [np.empty(0, dtype=np.int64)], [np.empty(0)]
    for at in starts:
        steps = np.diff(time[at : at + BLOCK + 1])
        own = 1 + (at + np.arange(steps.size)) // _GROUP
        near = np.stack([local[own - 1], local[own], local[own + 1]])
        odd = (np.abs(steps - near) > constants.JITTER * near + slack).all(axis=0)
        gap = odd & (steps > constants.GAP * near[1])
        n_gaps += int(gap.sum())
        n_missing += float(np.round(steps[gap] / near[1, gap] - 1).sum())
        breaks.append(np.flatnonzero(odd) + at + 1)
        lengths.append(steps[odd])
    where: IntArray = np.concatenate(breaks)
    notes = [f"{n_gaps} gaps with {n_missing:.0f} dropped samples"] if n_gaps else []
    if n_odd := where.size - n_gaps:
        found = f"{n_odd} of {time.size - 1} intervals differ by more than {constants.JITTER:.0%}"
        notes.append(f"{found} from the median {np.median(median):.6g} s")
    note = " and ".join(notes)
    if too_many(where.size, time.size):
        raise Unusable("time", f"{note}; needed uniform samples, export them at the sampling clock")
    return where, np.concatenate(lengths), note, 4 * float(np.median(spread))


def _clock(time: Samples, start: int, stop: int, least: int) -> tuple[Clock, FloatArray]:
    """Fit the clock of a stretch: a spline through means of at least so many stamps."""
    # Return time over the index of a sample, and the mean intervals in s between the knots.
    from scipy.interpolate import make_interp_spline

    n = stop - start
    edges = np.linspace(start, stop, min(n, max(2, n // least)) + 1).astype(int)
    mean = np.array([float(np.mean(time[a:b])) for a, b in pairwise(edges)])
    if mean.size == 1:  # of a single sample, which is left out
        return np.polynomial.Polynomial([mean[0], 1.0]), np.empty(0)
    centre = (edges[:-1] + edges[1:] - 1) / 2
    spline = make_interp_spline(centre, mean, k=min(3, mean.size - 1))
    return spline, np.diff(mean) / np.diff(centre)


def with_dropped(values: Samples, added: IntArray, *, linear: bool) -> Samples:
    """Insert samples at the half-open ranges that they have in the result.

    They are missing (NaN), or interpolated as those of a set point are.
    """
    if not added.size:
        return values
    spool, taken = Spool(values.size + count(added)), 0
    for start, stop in [*added.tolist(), (values.size + count(added),) * 2]:
        following = taken + start - spool.size
        for _, block in blocks(values, taken, following):
            spool.append(block)
        if start < stop:
            first, last = values[following - 1 : following + 1] if linear else (np.nan, np.nan)
            spool.append(np.linspace(first, last, stop - start + 2)[1:-1])
        taken = following
    return spool.samples()


def _off_line(time: Samples, stretch: tuple[int, int], interval: float) -> float:
    """Return the range in s of the deviations of stamps from those of one interval."""
    low, high = np.inf, -np.inf
    for at, stamps in blocks(time, *stretch):
        error = stamps - interval * np.arange(at, at + stamps.size)
        low, high = min(low, float(error.min())), max(high, float(error.max()))
    return high - low


def _residual(
    time: Samples, stretch: tuple[int, int], clock: Clock, interval: float, step: float
) -> IntArray:
    """Find the ranges of samples whose stamps are off the clock; refuse periodic jitter."""
    found = [NO_RANGES]
    for at, stamps in blocks(time, *stretch):
        error = stamps - clock(np.arange(at, at + stamps.size))
        if np.ptp(error) <= _ROUNDING * step:
            continue
        off = np.abs(error) > constants.JITTER * interval + step / 2
        found.append(runs(off, at))
        error[off] = 0
        line = 2 * np.abs(np.fft.rfft(error - error.mean())).max() / error.size
        by_chance = 2 * error.std() * np.sqrt((np.log(error.size) + _CHANCE) / error.size)
        if line > max(constants.PERIODIC * interval, by_chance):
            detail = f"time stamps jitter periodically by {line / interval:.1%} of the interval"
            raise Unusable("time", f"{detail}; needed uniform samples, or stamps of their clock")
    return np.concatenate(found)


def resampled(
    columns: Sequence[tuple[Samples, bool]], ranges: Ranges, axis: TimeAxis
) -> tuple[list[Samples], Ranges]:
    """Resample the pieces of columns of a varying rate to the rate of the axis.

    Signals by a windowed sinc that passes up to 0.45 of the rate; the others (second entry false)
    linearly. Return columns of the pieces one after another, and these.
    """
    spools, pieces, rate = [Spool() for _ in columns], [], axis.sample_rate
    for start, stop in ranges:
        clock = axis.clocks[int(np.searchsorted(axis.breaks, start, side="right"))]
        knots = np.linspace(start, stop - 1, 2 + (stop - start) // _GROUP)
        at = clock(knots)
        half = int(np.ceil(ZEROS * max(1.0, float((np.diff(knots) / np.diff(at)).max() / rate))))
        begin, end = clock(np.array([start + half, stop - 1 - half]))
        n = int((end - begin) * rate) + 1 if stop - start > 2 * half else 0
        if n < constants.SHORTEST_PIECE:
            continue
        pieces.append((spools[0].size, spools[0].size + n))
        for k in range(0, n, _OUTPUT):
            wanted = begin + np.arange(k, min(k + _OUTPUT, n)) / rate
            place = np.interp(wanted, at, knots)
            for _ in range(3):
                place -= (clock(place) - wanted) / clock(place, 1)
            weights, index = sinc_weights(place, clock(place, 1) * rate, half)
            low = int(index.min())
            for (samples, is_signal), spool in zip(columns, spools, strict=True):
                part = samples[low : int(index.max()) + 1]
                if is_signal:
                    spool.append(np.einsum("ij,ij->i", weights, part[index - low]))
                else:
                    spool.append(np.interp(place - low, np.arange(part.size), part))
    return [spool.samples() for spool in spools], tuple(pieces)


def sinc_weights(place: FloatArray, density: FloatArray, half: int) -> tuple[FloatArray, IntArray]:
    """Return weights and indices of the samples around fractional places, ``(n, 2 half)``.

    They are a windowed sinc of `ZEROS` zeros to either side; ``density``, ``(n,)``, is the interval
    between samples over that of the zeros. Up to 0.45 of the rate of the zeros its error is 1e-4.
    """
    index = np.floor(place).astype(np.int64)[:, None] + np.arange(1 - half, half + 1)
    x = (index - place[:, None]) * density[:, None]
    inside = np.sqrt(np.clip(1 - (x / ZEROS) ** 2, 0, None))
    grid = np.linspace(0, 1, 1 << 14)
    weights = np.sinc(x) * np.interp(inside, grid, np.i0(_WINDOW * grid)) * (inside > 0)
    return weights / weights.sum(axis=1, keepdims=True), index


def pieces(n_samples: int, missing: Sequence[IntArray], breaks: IntArray) -> Ranges:
    """Cut a record into half-open ranges without gaps; single samples are left out.

    ``missing`` holds for each channel the half-open ranges in which it has no samples, shape
    ``(n, 2)``; ``breaks`` the samples before which time is interrupted, ascending.
    """
    gone = np.concatenate([NO_RANGES, *missing])
    gone = gone[np.argsort(gone[:, 0], kind="stable")]
    # A piece begins where all missing ranges so far have ended.
    start = np.concatenate([[0], np.maximum.accumulate(gone[:, 1])])
    stop = np.concatenate([gone[:, 0], [n_samples]])
    there = start < stop
    start, stop = start[there], stop[there]
    inside = breaks[np.searchsorted(start, breaks) > np.searchsorted(stop, breaks, side="right")]
    start, stop = np.sort(np.append(start, inside)), np.sort(np.append(stop, inside))
    keep = stop - start >= constants.SHORTEST_PIECE
    return tuple(zip(start[keep].tolist(), stop[keep].tolist(), strict=True))


def _check_order(time: Samples) -> int:
    """Require that time stamps are numbers and do not decrease; return how many repeat."""
    unknown, repeated, backwards = 0, 0, [np.empty(0, dtype=np.int64)]
    for at, stamps in blocks(time, overlap=1):
        steps = np.diff(stamps)
        unknown += int(np.count_nonzero(~(np.abs(stamps[at > 0 :]) < constants.LARGEST_MAGNITUDE)))
        backwards.append(np.flatnonzero(steps < 0) + at + 1)
        repeated += int(np.count_nonzero(steps == 0))
    if unknown:
        raise Unusable("time", f"{unknown} of {time.size} time stamps are no numbers")
    if (where := np.concatenate(backwards)).size:
        found = f"time_s runs backwards {where.size} times and repeats {repeated} times"
        found += f" in {time.size} samples, first at sample {where[0]}"
        raise Unusable("time", f"{found}; needed increasing time stamps")
    return repeated


def resolution(time: Samples, relative: float = 0.0) -> float:
    """Return the step to which values, such as time stamps in s, are rounded: decimals or floats.

    ``relative`` is their least relative step, such as that of float32 in another unit.
    """
    stamps = time[:BLOCK]
    largest = float(np.abs(stamps).max())
    float32 = np.array_equal(stamps.astype(np.float32), stamps)
    floating = float(np.spacing(np.float32(largest) if float32 else largest))
    floating = max(floating, relative * largest)
    for digits in range(_MOST_DIGITS):
        scaled = stamps * 10.0**digits
        if (np.abs(scaled - np.rint(scaled)) < max(1e-6, 4 * floating * 10.0**digits)).all():
            return max(10.0**-digits, floating)
    return floating


def set_velocity(position: Samples, pieces: Ranges, sample_rate: float) -> Samples:
    """Differentiate a set position piece by piece, never across a gap.

    The difference spans so many samples that the steps in which positions are stored do not show.
    Position in m, velocity in m/s, both ``(n_samples,)``; NaN outside the pieces, which ascend.
    """
    reach, velocity = _reach(position, pieces, sample_rate), Spool()
    for start, stop in pieces:
        velocity.append(np.broadcast_to(np.nan, (start - velocity.size,)))
        for at, block in blocks(position, start, stop):
            low, high = max(start, at - reach), min(stop, at + block.size + reach)
            around = position[low:high]
            index = np.arange(at - low, at - low + block.size)
            # Towards the ends of a piece the difference is one-sided.
            after = np.minimum(index + reach, high - low - 1)
            before = np.maximum(index - reach, 0)
            velocity.append((around[after] - around[before]) * sample_rate / (after - before))
    velocity.append(np.broadcast_to(np.nan, (position.size - velocity.size,)))
    return velocity.samples()


def _reach(position: Samples, pieces: Ranges, sample_rate: float) -> int:
    """Compute how many samples to either side the difference must span to hide the steps."""
    most = max(1, int(constants.LONGEST_REACH * sample_rate))
    step = fastest = 0.0
    for start, stop in pieces:
        for _, block in blocks(position, start, stop, overlap=2):
            if block.size > 2 * most:
                uneven, smallest = np.abs(np.diff(block, 2)), buffers.smallest_step(block)
                # At a velocity of a whole number of steps per sample few differences are uneven.
                visible = smallest if float(uneven.max()) > 0.5 * smallest else 0.0
                # Most are at most a step and an acceleration.
                step = max(step, visible, float(np.quantile(uneven, 0.9)))
                average = (block[most:] - block[:-most]) * sample_rate / most
                fastest = max(fastest, float(np.abs(average).max()))
    if fastest == 0:
        return 1
    return int(np.clip(np.ceil(step * sample_rate / (2 * constants.STEP_SHARE * fastest)), 1, most))
