"""Consistency: what a log states more than once is compared (CHECKS.md, "Consistency").

The sample rate with the set position and the set velocity; the set position with itself, which
jumps where samples were dropped; the samples with themselves, where a buffer was recorded twice.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, IntArray
from lmshealth.io import constants
from lmshealth.io.buffers import BLOCK, NO_RANGES, Samples, blocks, count, runs
from lmshealth.io.channel_checks import within
from lmshealth.io.refusal import Unusable
from lmshealth.io.time_axis import resolution, too_many

# Samples per block of displacement; blocks that are joined; fewest of them in motion that a rate is
# computed from; standard error at which it is exact enough.
_LENGTH, _JOINED, _FEWEST, _EXACT = 32, (64, 8, 1), 8, 1e-4
# Samples from which the step of a position is found, and blocks from which that of a velocity is.
_STRETCH, _MOST_RAMPS = 4096, 64
# Samples whose hash selects one of so many, samples of a key, and odd factors of the hashes.
_SELECTED, _KEY = 32, 8
_FACTORS = 2 * np.random.default_rng(7).integers(1 << 62, 1 << 63, _KEY, dtype=np.uint64) + 1
# Lags at which a repeated stretch must differ from itself.
_LAGS = (1, 2, 3, 5, 7, 8, 16)
_NEEDED = "record again, or map no set position if it is sampled by another clock"
_NONE = np.empty(0, dtype=np.int64)


class Findings(NamedTuple):
    """Samples before which some were dropped, and half-open ranges that repeat others, ``(n, 2)``.

    ``notes`` are reason, channel and detail of each warning.
    """

    dropped: IntArray
    repeated: IntArray
    notes: tuple[tuple[str, str, str], ...]


class _Blocks(NamedTuple):
    """Displacements in m over consecutive blocks, by position and by velocity, ``(n_blocks,)``.

    In m: the step in which the position is stored, and its usual increment; zero without motion.
    """

    way: FloatArray
    expected: FloatArray
    step: float = 0.0
    usual: float = 0.0


def compare(
    position: Samples | None,
    velocity: Samples | None,
    nominal: float | None,
    measured: Sequence[Samples],
    sample_rate: float,
    breaks: IntArray,
) -> Findings:
    """Compare what a log states more than once.

    Set position and set velocity are in m and m/s, ``(n_samples,)`` each, as the usable channels
    are; ``nominal`` is the speed of the metadata in m/s, the sample rate that of time stamps or
    metadata in Hz; before the samples ``breaks`` time stamps are interrupted. `Unusable`: ``rate``
    where the set velocity contradicts the sample rate; ``dropped`` or ``repeated`` where that
    happens too often to cut the record.
    """
    size = measured[0].size
    ranges = np.concatenate([_repeats(measured), _held(measured, breaks)])
    copies = runs(within(ranges, 0, size)) if len(ranges) else NO_RANGES
    notes: list[tuple[str, str, str]] = []
    if n_lost := count(copies):
        found = f"{n_lost} samples repeat earlier ones in all channels, in {len(copies)} ranges"
        if n_lost > constants.LARGEST_MISSING * size or too_many(len(copies), size):
            raise Unusable("repeated", f"{found}; export the record again, each buffer once")
        notes.append(("repeated", "time_s", f"{found}: left out"))
    dropped = _NONE
    if position is not None:
        known = np.concatenate([breaks, copies.ravel()])
        dropped, found_there = _moved(position, velocity, nominal, sample_rate, known)
        notes += found_there
    return Findings(dropped, copies, tuple(notes))


def _moved(
    position: Samples, velocity: Samples | None, nominal: float | None, rate: float, known: IntArray
) -> tuple[IntArray, list[tuple[str, str, str]]]:
    """Compare a set position with itself, and the rate with it; return unknown jumps, and notes."""
    notes: list[tuple[str, str, str]] = []
    own = _displacements(position, velocity, rate)
    if own.step <= 0:
        return _NONE, notes
    fine = own.usual >= constants.FINE_STEPS * own.step
    dropped = _isolated(position, own) if fine else _NONE
    if velocity is not None:
        dropped, fit = _without_beat(own, dropped)
        notes += [] if fit is None else _rate_notes(own, velocity, rate, fit)
        dropped = dropped if fine else _jumps(position, own)
    elif nominal:
        notes += _speed_notes(own, abs(nominal), rate)
    dropped = dropped[~np.isin(dropped, np.concatenate([known - 1, known, known + 1]))]
    if dropped.size:
        found = f"the set position jumps {dropped.size} times: samples were dropped there"
        # At rest they are not seen.
        if too_many(dropped.size, _LENGTH * int(np.count_nonzero(own.way))):
            raise Unusable("dropped", f"{found}; {_NEEDED}")
        notes.append(("dropped", "reference_position", f"{found}, the record is cut"))
    return dropped, notes


def _displacements(position: Samples, velocity: Samples | None, rate: float) -> _Blocks:
    """Sum the increments of a position and integrate a velocity over blocks."""
    ways, sums = [], []
    for at in range(0, position.size - _LENGTH, BLOCK):
        place = position[at : at + BLOCK + 1]
        whole = (place.size - 1) // _LENGTH * _LENGTH
        ways.append(np.diff(place[: whole + 1 : _LENGTH]))
        if velocity is not None:
            begin = max(at - 1, 0)
            speed = velocity[begin : at + whole + 2]
            ends = at - begin + np.arange(0, whole + 1, _LENGTH)
            # Trapezoids, and their error by the slopes at the ends (Euler and Maclaurin).
            slope = speed[np.minimum(ends + 1, speed.size - 1)] - speed[np.maximum(ends - 1, 0)]
            rows = speed[ends[0] : ends[-1]].reshape(-1, _LENGTH)
            total = rows @ np.ones(_LENGTH) + np.diff(speed[ends] / 2 - slope / 24)
            sums.append(total / rate)
    way = np.concatenate([np.empty(0), *ways])
    expected = np.concatenate(sums) if sums else np.full(way.size, np.nan)
    return _Blocks(way, expected, *_steps_of(position, way))


def _steps_of(position: Samples, way: FloatArray) -> tuple[float, float]:
    """Return the step and the usual increment in m of a position in its longest motion."""
    size = np.nan_to_num(np.abs(way))
    if not size.any():
        return 0.0, 0.0
    motions = runs(size > constants.MOVING * np.quantile(size[size > 0], 0.9))
    start, stop = motions[np.argmax(motions[:, 1] - motions[:, 0])] * _LENGTH
    middle = max(start, (start + stop - _STRETCH) // 2)
    stretch = position[middle : min(stop, middle + _STRETCH) + 1]
    apart = np.abs(np.diff(stretch))
    stretch, apart = stretch[np.isfinite(stretch)], apart[np.isfinite(apart)]
    if not apart.size:
        return 0.0, 0.0
    # Second differences are those of rounding, also where the motion accelerates.
    uneven = float(np.quantile(np.abs(np.diff(apart)), 0.9)) if apart.size > 1 else 0.0
    steps = [resolution(stretch, float(np.finfo(np.float32).eps)), uneven]
    # A position that is held, or coarser than its increment, has steps of its own.
    held = apart[apart > 0]
    if held.size < 0.9 * apart.size:
        steps.append(float(held.min()) if held.size else np.inf)
    return max(steps), float(np.mean(apart))


def _isolated(position: Samples, own: _Blocks) -> IntArray:
    """Find samples whose increment is a multiple of those around it, ``(n,)``."""
    found = [_NONE]
    # Only blocks that are longer than their neighbours by a part of an increment are examined.
    size = np.pad(np.abs(own.way), 1, mode="edge")
    longer = size[1:-1] - (size[:-2] + size[2:]) / 2 > size[1:-1] / (4 * _LENGTH)
    starts = np.flatnonzero(longer) * _LENGTH
    for at in range(0, position.size, BLOCK):
        chosen = starts[slice(*np.searchsorted(starts, (at, at + BLOCK)))]
        if not chosen.size:
            continue
        begin = max(0, at - 2)
        ways = np.diff(position[begin : at + BLOCK + 3])
        k = (chosen[:, None] + np.arange(_LENGTH)).ravel() - begin
        k = k[(k >= 2) & (k < ways.size - 2)]
        near = np.stack([ways[k + i] for i in (-2, -1, 1, 2)]) * np.sign(ways[k])
        around = near.mean(axis=0)
        larger = np.abs(ways[k]) > constants.JUMP * around + 0.9 * own.step
        found.append(begin + 1 + k[larger & (near.min(axis=0) > 0.5 * around)])
    return np.concatenate(found)


def _jumps(position: Samples, own: _Blocks) -> IntArray:
    """Find jumps of a coarse position at constant velocity, beyond what its step explains."""
    # It explains nothing where blocks are whole numbers of steps, at the usual velocity.
    ahead = np.abs(own.expected)
    moving = np.sort(ahead[ahead > 0])
    if not moving.size:
        return _NONE
    usual = moving[moving.size // 2]
    even = np.abs(ahead - usual) < 1e-6 * usual
    way = np.sign(own.expected) * own.way
    slope = float(np.nanmedian(way[even])) / usual
    excess, increment = way - slope * ahead, ahead / _LENGTH
    padded = np.pad(ahead, 1, mode="edge")
    steady = (np.abs(padded[2:] - padded[:-2]) <= 0.01 * ahead) & (ahead > 0) & np.isfinite(way)
    uneven = np.mean(np.abs(excess[even]) > 0.3 * increment[even])
    exact = even & (abs(slope - 1) * np.nansum(ahead) < own.step / 2) & (uneven < 0.05)
    usual_error = 3 * np.quantile(np.abs(excess[steady]), 0.9) if steady.any() else 0.0
    explained = np.maximum(1.02 * own.step + 0.1 * increment, usual_error)
    odd = excess > np.maximum(np.where(exact, 0.0, explained), 0.6 * increment)
    starts = np.flatnonzero(odd & steady) * _LENGTH
    ways = [np.abs(np.diff(position[k : k + _LENGTH + 1])) for k in starts.tolist()]
    return starts + 1 + np.array([int(np.argmax(one)) for one in ways], dtype=np.int64)


def _without_beat(own: _Blocks, dropped: IntArray) -> tuple[IntArray, tuple[float, float] | None]:
    """Fit the displacements without the blocks of jumps; return jumps and `_slope`."""
    # A set position of another clock jumps where the clocks are a sample apart, and so does
    # one in steps slightly below its increment: with the jumps it moves by the velocity,
    # without them not.
    way = own.way.copy()
    way[np.minimum((dropped - 1) // _LENGTH, way.size - 1)] = np.nan
    fit = _slope(own._replace(way=way))
    if dropped.size and fit is not None and (whole := _slope(own)) is not None:
        off = abs(fit[0] - 1)
        if off > constants.AGREEMENT + 5 * fit[1] and abs(whole[0] - 1) < off / 2:
            return _NONE, whole
    return dropped, fit


def _rate_notes(
    own: _Blocks, velocity: Samples, rate: float, fit: tuple[float, float]
) -> Iterator[tuple[str, str, str]]:
    """Compare the sample rate with that at which the position moves by the velocity."""
    slope, std = fit
    off, allowed = abs(slope - 1), 5 * std + _rounding(velocity, own.expected)
    found = f"the sample rate is {rate:.8g} Hz, but the set position moves by the set velocity at"
    found += f" {rate / slope:.6g} Hz"
    if off > constants.RATE_REFUSED + allowed:
        needed = "correct the rate or a unit, or map only one of the two columns"
        raise Unusable("rate", f"{found}; {needed}")
    if off > constants.RATE_FLAGGED + allowed:
        yield "rate", "reference_velocity", f"{found}; check which is right"


def _speed_notes(own: _Blocks, nominal: float, rate: float) -> Iterator[tuple[str, str, str]]:
    """Compare the speed of the metadata with that of the set position, where it has one speed."""
    for n in _JOINED:
        size = np.abs(own.way[: own.way.size // n * n].reshape(-1, n).sum(axis=1))
        size = size[np.isfinite(size)]
        if size.size < _FEWEST or not size.any():
            continue
        size = size[size > constants.MOVING * np.quantile(size, 0.99)]
        low, middle, high = np.quantile(size, [0.2, 0.5, 0.9])
        speed, spread = middle * rate / (n * _LENGTH), (high - low + own.step) / middle
        off = abs(speed / nominal - 1)
        if spread < 0.1 and off > constants.RATE_REFUSED + spread:
            found = f"the set position moves at {1e3 * speed:.6g} mm/s at {rate:.8g} Hz"
            stated = f"velocity_mm_s is {1e3 * nominal:.6g}"
            yield "rate", "reference_position", f"{found}, {stated}; check which is right"
        if spread < 0.1:
            return


def _slope(own: _Blocks) -> tuple[float, float] | None:
    """Fit displacements by position to those by velocity; return slope and standard error."""
    # Blocks are joined, the more the better where that leaves enough of them. None where too
    # few are in motion.
    best = None
    for n in _JOINED:
        whole = own.way.size // n * n
        way, expected = (one[:whole].reshape(-1, n).sum(axis=1) for one in own[:2])
        fit = _fit(np.abs(way), np.abs(expected), own.step)
        if fit is not None and (best is None or fit[1] < best[1]):
            best = fit
        if best is not None and best[1] < _EXACT:
            break
    return best


def _fit(way: FloatArray, expected: FloatArray, step: float) -> tuple[float, float] | None:
    """Regress sizes of displacements on expected ones and on their change, outliers left out."""
    # A velocity that a filter delays is off by a multiple of its change.
    there = np.isfinite(way + expected) & (expected > 0)
    usual = np.quantile(expected[there], 0.9) if there.any() else 0.0
    there &= expected > constants.MOVING * usual
    if there.sum() < _FEWEST:
        return None
    change = np.nan_to_num(np.gradient(expected)[there])
    x, y = np.stack([expected[there], change], axis=1), way[there]
    error = y - x[:, 0] * np.median(y / x[:, 0])
    for _ in range(3):
        keep = np.abs(error) <= max(2 * np.quantile(np.abs(error), 0.9), 1.1 * step)
        inverse = np.linalg.pinv(x[keep].T @ x[keep], rcond=1e-6, hermitian=True)
        slope = inverse @ (x[keep].T @ y[keep])
        error = y - x @ slope
    n = int(keep.sum())
    if np.mean(np.abs(error)) > constants.UNLIKE * np.mean(y) + step:
        return None  # the one does not follow the other, as a path velocity
    variance = max(float(np.sum(error[keep] ** 2)) / max(n - 2, 1), step**2 / 6 / n)
    return float(slope[0]), float(np.sqrt(variance * inverse[0, 0]))


def _rounding(velocity: Samples, expected: FloatArray) -> float:
    """Return the largest relative error by the decimals of a velocity, which its ramps show."""
    ramps = np.flatnonzero(np.diff(expected))[:_MOST_RAMPS] * _LENGTH
    if ramps.size < _FEWEST:
        return 0.0
    levels = np.abs(np.concatenate([velocity[k : k + 2 * _LENGTH] for k in ramps]))
    levels = levels[np.isfinite(levels)]
    return float(resolution(levels) / 2 / np.quantile(levels, 0.9)) if levels.any() else 0.0


def _held(measured: Sequence[Samples], breaks: IntArray) -> IntArray:
    """Find stretches in which all of several channels hold one value, ``(n, 2)``, ascending."""
    # A driver that loses its data may write zeros, or the last sample: signals jump at the
    # ends of a stretch. They do not where a machine stands still, and its channels are
    # coarse; at an end of a piece only one end of a rest is seen. A record that is held for
    # most of its time, and never for long, has another clock.
    size, least = measured[0].size, constants.SHORTEST_REPEAT - 1
    if len(measured) < 2:
        return NO_RANGES
    same = np.zeros(size, dtype=bool)
    for at, block in blocks(measured[0], overlap=1):
        if (equal := block[1:] == block[:-1]).any():
            stop = at + block.size
            same[at + 1 : stop] = equal & _equal(measured[1:], at + 1, stop, 1)
    held = runs(same)
    held = held[np.diff(held, axis=1)[:, 0] >= least]
    n_held = count(held)
    chance = max(int(same.sum()) - n_held, 1) / max(size - n_held, 1)
    # A slower clock holds samples for most of the time, and never for long.
    slow = n_held > size / 2 and np.diff(held, axis=1).max(initial=0) < constants.SLOW_CLOCK
    by_chance = -np.log(chance) * least < constants.CHANCE
    if not len(held) or by_chance or slow:
        return NO_RANGES
    jumps = _jumps_at_ends(measured, held, same, breaks).max(axis=1)
    seen = np.isfinite(jumps)
    lost = seen.any() and np.median(jumps[seen]) > constants.HELD_JUMP
    return np.asarray(held[seen] if lost else NO_RANGES)


def _jumps_at_ends(
    measured: Sequence[Samples], held: IntArray, same: BoolArray, breaks: IntArray
) -> FloatArray:
    """Return the largest jump of a channel at both ends of stretches, ``(n, 2)``.

    In standard deviations of its other samples; NaN where no samples are, or time is interrupted.
    """
    # The first sample of a stretch is no repeat.
    ends = held - [1, 0]
    outside = (ends < 1) | (ends >= measured[0].size) | np.isin(ends, breaks)
    found = np.where(outside, np.nan, 0.0)
    inside = np.flatnonzero(~outside)
    for one in measured:
        parts = [block[~same[at : at + block.size]] for at, block in blocks(one)]
        spread = max(float(np.nanstd(np.concatenate(parts))), np.finfo(float).tiny)
        for k in inside:
            before, after = one[ends.flat[k] - 1 : ends.flat[k] + 1]
            found.flat[k] = np.maximum(found.flat[k], abs(after - before) / spread)
    return found


def _repeats(measured: Sequence[Samples]) -> IntArray:
    """Find stretches that are equal to earlier ones in all channels, ``(n, 2)``, ascending."""
    # Samples are selected by their own hash, so that a copy of a stretch has those of the
    # original.
    middle = measured[0].size // 2
    levels = [np.unique(one[middle : middle + 512]).size for one in measured]
    if max(levels) < constants.FEWEST_LEVELS:
        return NO_RANGES
    values = measured[int(np.argmax(levels))]
    size = values.size
    found: list[tuple[int, int]] = []
    end = n_periodic = 0
    # Ends of the last stretches of each lag: all samples of a stretch have the same ends.
    judged = dict[int, int]()
    for at, lag in _alike(values):
        if at < max(end, judged.get(lag, 0)):
            continue
        start, stop = _extent(measured, at, lag)
        judged[lag] = stop
        if stop - start >= constants.SHORTEST_REPEAT and not _by_chance(measured, start, stop, lag):
            found.append((max(start, end), stop))
            end = stop
            n_periodic += stop - start if stop - start >= 3 * lag else 0
        if too_many(len(found), size):
            break
    # A signal that was computed may be periodic.
    return np.array([] if n_periodic > size / 2 else found, dtype=np.int64).reshape(-1, 2)


def _alike(values: Samples) -> Iterator[tuple[int, int]]:
    """Yield samples whose next ones probably equal those a lag before, ascending, with the lag."""
    keys, places = [], []
    for at, block in blocks(values, overlap=_KEY):
        bits = np.ascontiguousarray(block).view(np.uint64) * _FACTORS[0]
        k = np.flatnonzero(bits[: bits.size - _KEY] < (1 << 64) // _SELECTED)
        # Of a constant value, which may go on for hours, the first.
        k = k[(k == 0) | (bits[k] != bits[k - 1])]
        key = np.zeros(k.size, dtype=np.uint64)
        for i, factor in enumerate(_FACTORS):
            key += (bits[k + i] >> np.uint64(7)) * factor
        keys.append(key)
        places.append(at + k)
    key, place = np.concatenate(keys), np.concatenate(places)
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(np.diff(key[order]) == 0)
    first, second = place[order[same]], place[order[same + 1]]
    yield from sorted(zip(second.tolist(), (second - first).tolist(), strict=True))


def _extent(measured: Sequence[Samples], at: int, lag: int) -> tuple[int, int]:
    """Return the range around a sample in which all channels equal those a lag before."""
    size, reach = measured[0].size, 64
    while True:
        low, high = max(lag, at - reach), min(size, at + reach)
        differ = low + np.flatnonzero(~_equal(measured, low, high, lag))
        start = int(differ[differ <= at].max(initial=low - 1)) + 1
        stop = int(differ[differ >= at].min(initial=high))
        if (start > low or low == lag) and (stop < high or high == size):
            return start, stop
        reach *= 4


def _equal(measured: Sequence[Samples], start: int, stop: int, lag: int) -> np.ndarray:
    """Return which samples of a range equal those a lag before in all channels, ``(n,)``."""
    each = [one[start:stop] == one[start - lag : stop - lag] for one in measured]
    return np.asarray(np.all(each, axis=0))


def _by_chance(measured: Sequence[Samples], start: int, stop: int, lag: int) -> bool:
    """Return whether a range may repeat another one, a lag before it, by chance."""
    # It may where few levels occur in it, or, as in a tone of few digits, where samples
    # beside it equal those a lag before, too.
    n, size = stop - start, measured[0].size
    tried = [(start + k, stop, k) for k in _LAGS if k < n]
    tried += [(max(lag, start - n), start, lag), (stop, min(size, stop + n), lag)]
    share = max(_equal(measured, *one).mean() for one in tried if one[0] < one[1])
    return bool(share > 0 and n * -np.log(share) < constants.CHANCE)
