"""What a log states more than once: sample rate and set point, jumps, repeated buffers."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterable
from unittest.mock import Mock

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io import buffers, consistency, constants
from lmshealth.io.buffers import as_samples
from lmshealth.io.consistency import Findings, compare
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable
from models.recordings.motion_profile import Profile

RATE = 2000.0
NO_BREAKS = np.empty(0, dtype=np.int64)
COARSE = 1e-6  # m


def noise(n: int, seed: int = 0) -> np.ndarray:
    """Return samples of an accelerometer."""
    return np.random.default_rng(seed).normal(0, 0.3, n)


def strokes(rate: float = RATE, seconds: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    """Return set position and velocity of strokes of limited jerk, with dwells."""
    profile = Profile(0.1, 0.2, dwell=0.3, strokes=8)
    position, velocity, *_ = profile.sampled(np.arange(round(seconds * rate)) / rate - 0.1)
    return position, velocity


def constant(rate: float = RATE, seconds: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    """Return set position and velocity of a move at 10 mm/s."""
    n = round(seconds * rate)
    return -0.1 + 0.01 * np.arange(n) / rate, np.full(n, 0.01)


def found(
    position: np.ndarray | None,
    velocity: np.ndarray | None = None,
    *,
    rate: float = RATE,
    nominal: float | None = None,
    breaks: Iterable[int] = (),
) -> Findings:
    """Compare a set point with a sample rate, beside one channel of noise."""
    size = 2000 if position is None else position.size
    at = np.array([*breaks], dtype=np.int64)
    return compare(position, velocity, nominal, [noise(size)], rate, at)


def rounded(values: np.ndarray, step: float) -> np.ndarray:
    """Round to a step, as a controller or a file stores values."""
    return np.round(values / step) * step


def without(values: np.ndarray, dropped: Iterable[int]) -> np.ndarray:
    """Drop samples."""
    return np.delete(values, [*dropped])


def held(values: np.ndarray, n: int) -> np.ndarray:
    """Hold each n-th sample, as a slower controller does."""
    return values[np.arange(values.size) // n * n]


# Sample rate and set point


@pytest.mark.parametrize("motion", [constant, strokes])
@pytest.mark.parametrize("step", [0.0, COARSE, 5e-6])
@pytest.mark.parametrize("ratio", [0.5, 0.95, 0.99, 1.01, 1000.0])
def test_a_wrong_rate_is_refused(motion, step, ratio):
    """A rate that is off from that of the set point by one percent or more is refused with both."""
    position, velocity = motion()
    if step:
        position = rounded(position, step)
    with pytest.raises(Unusable) as caught:
        found(position, velocity, rate=RATE * ratio)
    assert caught.value.reason == "rate"
    assert f"{RATE * ratio:.8g} Hz" in caught.value.detail
    stated = float(caught.value.detail.split(" at ")[1].split(" Hz")[0])
    assert stated == pytest.approx(RATE, rel=2e-3)


@pytest.mark.parametrize("motion", [constant, strokes])
def test_a_rate_that_is_off_by_little_is_flagged(motion):
    """Between what rounding explains and what is refused there is a note with both rates."""
    [(reason, channel, detail)] = found(*motion(), rate=RATE * 1.002).notes
    assert (reason, channel) == ("rate", "reference_velocity")
    assert "2004 Hz" in detail and "2000 Hz" in detail


GOOD = {
    "exact": lambda p, v: (p, v),
    "float32": lambda p, v: tuple((1e3 * x).astype("f4").astype(float) / 1e3 for x in (p, v)),
    "position in um": lambda p, v: (rounded(p, COARSE), v),
    "velocity in mm/s": lambda p, v: (rounded(p, COARSE), rounded(v, 1e-3)),
    "delayed by 5 ms": lambda p, v: (p, np.concatenate([np.full(10, v[0]), v[:-10]])),
    "backward difference": lambda p, v: (p, np.diff(p, prepend=2 * p[0] - p[1]) * RATE),
    "held for 4 samples": lambda p, v: (held(p, 4), held(v, 4)),
    "held for 20 samples": lambda p, v: (held(p, 20), held(v, 20)),
    "speed without sign": lambda p, v: (p, np.abs(v)),
    "other sign": lambda p, v: (p, -v),
    "position of an axis at rest": lambda p, v: (np.zeros_like(p), v),
    "wrapped at 50 mm": lambda p, v: (p % 0.05, v),
    "missing samples": lambda p, v: (np.where(np.arange(p.size) % 9000 < 40, np.nan, p), v),
    "unrelated": lambda p, v: (noise(p.size, 1), noise(p.size, 2)),
}


@pytest.mark.parametrize("motion", [constant, strokes])
@pytest.mark.parametrize("how", GOOD)
def test_good_set_points_are_not_flagged(motion, how):
    """Rounding, delays, holds, signs, wraps and missing samples raise no flag and cut nothing."""
    position, velocity = GOOD[how](*motion())
    assert found(position, velocity).notes == ()
    assert found(position).notes == ()


def test_a_sine_is_no_wrong_rate():
    """Trapezoids of a fast sine are corrected: 50 samples per period would be off by 1e-3."""
    phase = 2 * np.pi * 40 * np.arange(40_000) / RATE
    position, velocity = 1e-3 * np.sin(phase), 1e-3 * 2 * np.pi * 40 * np.cos(phase)
    assert found(position, velocity).notes == ()
    assert found(position, velocity, rate=1.002 * RATE).notes != ()


def test_the_speed_of_the_metadata():
    """A set position that moves at another speed than the metadata state is flagged with both."""
    position, _ = constant()
    assert found(position, nominal=0.01).notes == ()
    assert found(rounded(position, COARSE), nominal=-0.01).notes == ()
    [(reason, _, detail)] = found(position, nominal=0.01, rate=1900.0).notes
    assert reason == "rate" and "9.5 mm/s" in detail and "velocity_mm_s is 10" in detail
    several = np.cumsum(np.repeat([0.01, 0.02, 0.04, 0.08], 10_000)) / RATE
    assert found(several, nominal=0.05).notes == ()


# Dropped samples


@pytest.mark.parametrize("motion", [constant, strokes])
@pytest.mark.parametrize("has_velocity", [True, False])
def test_dropped_samples_cut_the_record(motion, has_velocity):
    """The record is cut where single samples and runs of them are missing in motion."""
    position, velocity = motion()
    gone = [5000, 12_345, 12_346, 21_000, *range(30_000, 30_040)]
    short = without(position, gone)
    seen = found(short, without(velocity, gone) if has_velocity else None)
    moving = [k for k in (5000, 12_344, 20_997, 29_996) if velocity[k + 3] == velocity[k - 3] != 0]
    assert set(moving) <= set(seen.dropped.tolist()) <= {5000, 12_345, 12_344, 20_997, 29_996}
    assert len(moving) > 2
    [(reason, channel, detail)] = seen.notes
    assert (reason, channel) == ("dropped", "reference_position")
    assert f"{seen.dropped.size} times" in detail


def test_dropped_samples_of_coarse_positions():
    """With a set velocity, jumps above one step of a coarse position are found."""
    position, velocity = constant()  # 5 steps in two samples
    rough, gone = rounded(position, 4e-6), [*range(5000, 5003), *range(30_000, 30_004)]
    assert found(rough, velocity).notes == ()
    seen = found(without(rough, gone), without(velocity, gone)).dropped
    assert np.abs(seen - [5000, 29_997]).max() < 40


@pytest.mark.parametrize("step", [0.0, COARSE, 5e-6])
def test_one_sample_of_hundred_is_refused(step):
    """Regularly dropped samples change the rate; they are refused and not cut into a thousand."""
    position, velocity = constant()
    position = rounded(position, step) if step else position
    gone = range(50, position.size, 100)
    with pytest.raises(Unusable, match=r"dropped|rate"):
        found(without(position, gone), without(velocity, gone))


@pytest.mark.parametrize("increment", [1.05, 1.5, 2.03, 0.503, 3.7])
def test_counts_are_no_dropped_samples(increment):
    """Positions in counts of an encoder jump by one count where the set velocity needs that."""
    count = 7.44e-6
    position = np.floor(increment * np.arange(40_000)) * count
    velocity = np.full(position.size, increment * count * RATE)
    assert found(position, velocity).notes == ()


@pytest.mark.parametrize("ratio", [0.95, 0.99, 1.01, 1.05])
def test_another_clock_is_no_dropped_sample(ratio):
    """A controller whose clock differs from that of the samples skips values, and drops none."""
    time = np.floor(np.arange(40_000) * ratio) / (RATE * ratio)
    assert found(0.01 * time, np.full(time.size, 0.01)).notes == ()


def test_known_gaps_are_counted_once():
    """An interruption that the time stamps state is no further one."""
    position, velocity = constant()
    gone = range(5000, 5100)
    seen = found(without(position, gone), without(velocity, gone), breaks=[5000])
    assert seen.dropped.size == 0 and seen.notes == ()


def test_many_known_gaps_need_little_memory():
    """Jumps are compared with known gaps in memory that grows as their sum, not their product."""
    position = without(constant()[0], range(50, 40_000, 100))
    tracemalloc.start()
    try:
        seen = found(position, breaks=range(1, position.size))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert seen.notes == () and peak < 30e6


# Repeated buffers


@pytest.mark.parametrize("kind", ["float64", "float32", "counts"])
@pytest.mark.parametrize("instead", [True, False])
def test_a_repeated_buffer_is_left_out(kind, instead):
    """A buffer that is recorded twice, inserted or instead of the next, is found exactly."""
    signals = np.stack([noise(20_000, 1), noise(20_000, 2)])
    if kind == "float32":
        signals = signals.astype("f4").astype(float)
    elif kind == "counts":
        signals = rounded(signals, 0.02)
    assert compare(None, None, None, list(signals), RATE, NO_BREAKS).repeated.size == 0
    first, length = 7000, 512
    again = signals[:, first : first + length]
    rest = signals[:, first + (2 if instead else 1) * length :]
    signals = np.concatenate([signals[:, : first + length], again, rest], axis=1)
    seen = compare(None, None, None, list(signals), RATE, NO_BREAKS)
    [(start, stop)] = seen.repeated.tolist()
    # Coarse samples may be equal beyond the ends.
    assert abs(start - first - length) < 4 and abs(stop - first - 2 * length) < 4
    assert [note[0] for note in seen.notes] == ["repeated"]


@pytest.mark.parametrize("value", [0.0, None])
def test_samples_that_all_channels_hold_are_left_out(value):
    """Zeros, or the last sample, in place of lost ones are found exactly, beside a repeat."""
    signals = np.stack([noise(20_000, 1), rounded(noise(20_000, 2), 0.02)])
    for start in (4000, 7000, 12_000):
        signals[:, start : start + 300] = signals[:, start, None] if value is None else value
    signals[:, 15_000:15_512] = signals[:, 14_000:14_512]
    seen = compare(None, None, None, list(signals), RATE, NO_BREAKS)
    assert [note[0] for note in seen.notes] == ["repeated"]
    want = [(4000, 4300), (7000, 7300), (12_000, 12_300), (15_000, 15_512)]
    np.testing.assert_allclose(seen.repeated, want, atol=3)
    # One channel may be constant for a while, or all have a slower clock.
    alone = compare(None, None, None, [signals[0]], RATE, NO_BREAKS)
    assert alone.repeated[:, 0].tolist() == [15_000]
    slow = list(np.repeat(np.stack([noise(1000, 1), noise(1000, 2)]), 20, axis=1))
    assert compare(None, None, None, slow, RATE, NO_BREAKS).notes == ()


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_record_that_is_mostly_held_is_refused(share):
    """However large the share is: what is left would be cut to pieces."""
    signals = np.stack([noise(20_000, 1), noise(20_000, 2)])
    for start in range(0, 20_000, 1000):
        signals[:, start : start + round(1000 * share)] = 0.0
    with pytest.raises(Unusable, match="samples repeat earlier ones"):
        compare(None, None, None, list(signals), RATE, NO_BREAKS)


@pytest.mark.parametrize("rest", [0.2, 0.6])
def test_a_machine_at_rest_with_coarse_channels_is_used(rest):
    """Ten bits show nothing while it stands; its signals fade and grow without a jump."""
    t = np.arange(20_000)
    slope = np.clip((np.abs(t - 10_000) - 10_000 * rest) / 2000, 0, 1)
    signals = [rounded(slope * noise(20_000, seed), 0.05) for seed in (1, 2)]
    assert min((own[1:] == own[:-1]).mean() for own in signals) > 0.9 * rest
    assert compare(None, None, None, signals, RATE, NO_BREAKS).notes == ()


@pytest.mark.parametrize("where", ["start", "end", "break", "gap"])
def test_a_rest_at_an_end_of_a_piece_is_used(where):
    """A seventh of the record in which coarse channels rest may be followed by any motion."""
    signals = [rounded(noise(30_000, seed), 0.05) for seed in (1, 2)]
    at = {"start": 0, "end": 25_800}.get(where, 10_000)
    for own in signals:
        own[at : at + 4200] = 0.0
    if where == "gap":
        signals[1][at - 40 : at] = np.nan
    breaks = np.array([at + 4200] if where == "break" else NO_BREAKS, dtype=np.int64)
    found_there = compare(None, None, None, signals, RATE, breaks)
    assert found_there.notes == () and found_there.repeated.size == 0
    signals[0][20_000:20_300] = signals[1][20_000:20_300] = 0.0
    [(start, stop)] = compare(None, None, None, signals, RATE, breaks).repeated.tolist()
    assert abs(start - 20_000) < 4 and abs(stop - 20_300) < 4


@pytest.mark.parametrize("tail", [[0.0], [0.3], [0.0, 1.0], [0.0, 1.0, 3.0]])
def test_constant_and_periodic_stretches_are_compared_once(tail, monkeypatch):
    """A stretch whose samples are all selected is not compared anew for each of them."""
    extent = Mock(wraps=consistency._extent)
    monkeypatch.setattr(consistency, "_extent", extent)
    # Whatever the hash of a value is.
    monkeypatch.setattr(consistency, "_SELECTED", 1)
    values = noise(20_000)
    values[14_000:] = np.resize(tail, 6000)
    assert compare(None, None, None, [values], RATE, NO_BREAKS).notes == ()
    assert extent.call_count <= len(tail)


def test_one_channel_that_repeats_is_no_repeated_buffer():
    """All channels must repeat."""
    one, other = noise(20_000, 1), noise(20_000, 2)
    one[8000:8512] = one[7488:8000]
    assert compare(None, None, None, [one, other], RATE, NO_BREAKS).repeated.size == 0


@pytest.mark.parametrize(
    "values",
    [
        np.tile(noise(500), 40),  # a multisine without noise
        np.arange(20_000) % 7 * 0.01,
        np.round(np.sin(2 * np.pi * np.arange(20_000) / 100), 6),
        np.repeat(noise(4000), 5),
        np.round(noise(20_000) * 3) * 0.1,  # few levels
        np.round(np.cumsum(noise(20_000))),  # slow and coarse
    ],
)
def test_computed_and_coarse_signals_are_no_repeated_buffers(values):
    """Periodic signals, held samples, few levels and slow signals repeat by themselves."""
    assert compare(None, None, None, [values], RATE, NO_BREAKS).notes == ()


def test_a_record_of_buffers_that_repeat_is_refused():
    """A record half of which is a copy is no record."""
    twice = np.repeat(noise(20_000).reshape(-1, 500), 2, axis=0).ravel()
    with pytest.raises(Unusable, match="20000 samples repeat earlier ones"):
        compare(None, None, None, [twice], RATE, NO_BREAKS)


def test_stored_samples_are_compared_alike(monkeypatch):
    """Samples on disk, read block by block, give the same as those in memory."""
    n = 2 * buffers.BLOCK + 777
    position, velocity = constant(seconds=(n + 1) / RATE)
    gone = [1000, buffers.BLOCK + 1, 2 * buffers.BLOCK + 300]
    signal = noise(n - 2)
    start = buffers.BLOCK - 100
    signal[start : start + 300] = signal[start - 300 : start]
    columns = [without(position, gone), without(velocity, gone), signal]
    whole = compare(columns[0], columns[1], None, [signal], RATE, NO_BREAKS)
    monkeypatch.setattr(buffers, "MINUTE", 1000)
    stored = [as_samples(one) for one in columns]
    parts = compare(stored[0], stored[1], None, stored[2:], RATE, NO_BREAKS)
    for one in (whole, parts):
        assert one.dropped.tolist() == [1000, buffers.BLOCK, 2 * buffers.BLOCK + 298]
        assert one.repeated.tolist() == [[start, start + 300]]
    assert whole.notes == parts.notes


# Logs


def columns(n: int = 8000) -> dict[str, np.ndarray | None]:
    """Return columns of a log that moves at 100 mm/s, without time stamps."""
    position = np.round(1e3 * (-0.2 + 0.1 * np.arange(n) / RATE), 4)
    return {"time_s": None, "reference_position_mm": position}


def test_a_log_is_refused_with_both_rates(make):
    """The header of a log states 1,900 Hz for 2,000 Hz."""
    path = make(columns=columns(), meta={"sample_rate_hz": "1900"}, n=8000)
    with pytest.raises(BadLog, match=r"rate: the sample rate is 1900 Hz, but .* at 2000 Hz"):
        read_log(path)
    assert read_log(make(columns=columns(), n=8000)).refused == ()


def test_stamps_made_from_the_index_are_compared(make):
    """Time stamps of a wrong rate that agree with the metadata are refused as well."""
    stamps = {"time_s": np.arange(8000) / 1900}
    with pytest.raises(BadLog, match="rate"):
        read_log(make(columns=columns() | stamps, meta={"sample_rate_hz": "1900"}, n=8000))


def test_a_log_is_cut_at_dropped_and_repeated_samples(make):
    """The pieces of a log end where samples were dropped, and leave repeated ones out."""
    table = make(columns=columns(), n=8000).read_text().splitlines()
    head = next(k for k, line in enumerate(table) if line.startswith("delta_e")) + 1
    rows = table[head:]
    rows = rows[:2000] + rows[2010:5000] + rows[4744:5000] + rows[5256:]
    path = make(columns=columns(), n=8000)
    path.write_text("\n".join([*table[:head], *rows, ""]))
    log = read_log(path)
    assert log.pieces == ((0, 2000), (2000, 4990), (5246, 7990))
    assert [(one.reason, one.channel) for one in log.refused] == [
        ("repeated", "time_s"),
        ("dropped", "reference_position"),
    ]


def test_limits_are_in_order():
    """What is flagged is more than what two clocks may differ by, and less than what is refused."""
    assert constants.AGREEMENT < constants.RATE_FLAGGED < constants.RATE_REFUSED


def test_samples_dropped_at_the_end_of_a_block_are_found():
    """The increment over them belongs to the block that ends there, also to the last one."""
    n, last = 32 * 400 + 5, 32 * 400
    k = np.concatenate([np.arange(last), np.arange(last + 1, n + 1)])[:n]
    phase = 2 * np.pi * 0.01 / RATE
    position = 0.3 * np.sin(phase * k + 0.2)
    velocity = 0.3 * phase * RATE * np.cos(phase * k + 0.2)
    assert last in found(position, velocity).dropped


def test_a_missing_velocity_leaves_the_comparison():
    """One sample without a set velocity does not end the comparison of a rate that is off."""
    position, velocity = strokes()
    velocity[1000] = np.nan
    with pytest.raises(Unusable, match="sample rate is"):
        found(position, velocity, rate=1.02 * RATE)


@pytest.mark.parametrize("speed", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_float32_positions_in_micrometres_are_not_cut(speed, kind):
    """Positions in mm of 1 um, stored as float32, have ramps of whole steps."""
    rate, size = 10_000, 100_000
    t = np.arange(size) / rate
    part, period = t % 1.2, 2.4
    velocity = np.clip(np.minimum(part, 1.1 - part), 0, speed) * np.where(t % period < 1.2, 1, -1)
    position = np.round(1e3 * np.cumsum(velocity) / rate, 3).astype(kind).astype(float) * 1e-3
    assert found(position, rate=rate).dropped.size == 0
    assert found(position, velocity, rate=rate).notes == ()


def test_a_path_velocity_is_no_wrong_rate():
    """The speed along a circle is not that of one axis."""
    t = np.arange(40_000) / RATE
    assert found(0.05 * np.sin(np.pi * t), np.full(t.size, 0.05 * np.pi)).notes == ()
