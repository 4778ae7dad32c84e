"""The time axis: rates agree, gaps split, disorder is refused; varying rates; set velocities."""

import numpy as np
import pytest

from lmshealth.io.buffers import BLOCK, Stored
from lmshealth.io.refusal import Unusable
from lmshealth.io.time_axis import pieces, resampled, set_velocity, time_axis
from lmshealth.signal.segments import find_phases
from tests.signals import make_log


def test_rate_from_time():
    """The rate is found from exact, rounded, float32, offset and integer time stamps."""
    n = np.arange(100_000)
    assert time_axis(n / 20e3, None).sample_rate == 20e3
    for stamps in (
        np.round(n / 16384, 6),
        (n / 16384).astype("f4").astype(float),
        1.7e9 + n / 16384,
    ):
        axis = time_axis(stamps, None)
        assert axis.sample_rate == pytest.approx(16384, rel=1e-5) and axis.breaks.size == 0
    assert time_axis(n.astype(float), 1.0).sample_rate == 1.0


def test_agreement():
    """Time and metadata must agree within 1e-4; the metadata's rate is kept."""
    time = np.arange(1000) / 1000
    assert time_axis(time, 1000.05).sample_rate == 1000.05
    with pytest.raises(Unusable, match=r"1000\.2"):
        time_axis(time, 1000.2)
    with pytest.raises(Unusable, match="neither"):
        time_axis(None, None)


def test_gaps_are_counted_and_split():
    """Dropped samples split the record in indices of stored samples."""
    time = np.delete(np.arange(1000) / 1000, [100, 101, 500])
    axis = time_axis(time, 1000.0)
    assert "2 gaps with 3 dropped samples" in axis.note
    assert pieces(997, [], axis.breaks) == ((0, 100), (100, 498), (498, 997))


def test_one_hiccup_splits():
    """A single irregular interval interrupts the record there and nowhere else."""
    time = np.arange(1000) / 1000
    time[400:] += 0.0004
    axis = time_axis(time, None)
    assert axis.breaks.tolist() == [400] and "1 of 999 intervals" in axis.note
    assert axis.sample_rate == pytest.approx(1000, rel=1e-9)


def test_jitter_is_refused():
    """Time that is not uniform is refused with the count of odd intervals."""
    rng = np.random.default_rng(0)
    with pytest.raises(Unusable, match="of 999 intervals differ"):
        time_axis(np.cumsum(rng.uniform(0.5, 1.5, 1000)), None)


def test_disorder_is_refused():
    """Time is never sorted: what runs backwards or repeats is counted and refused."""
    time = np.arange(100.0)
    time[50], time[80] = 10.0, 79.0
    with pytest.raises(Unusable, match="backwards 1 times and repeats 1 times"):
        time_axis(time, None)
    time[3] = np.nan
    with pytest.raises(Unusable, match="1 of 100 time stamps"):
        time_axis(time, None)


INDEX = np.arange(12_000)
CLOCKS = {
    "a step": np.cumsum(np.repeat([1e-3, 1.2e-3], 6000)),
    "drift": np.cumsum(1e-3 * (1 + 0.2 * INDEX / INDEX.size)),
    "oscillation": 1e-3 * (INDEX + 3 * np.sin(INDEX / 500)),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_a_varying_rate_is_resampled(name):
    """A sine keeps frequency, phase and amplitude within 1 % when resampled to the lowest rate."""
    time = CLOCKS[name]
    axis = time_axis(time, None)
    assert axis.clocks and "resampled" in axis.note
    assert axis.sample_rate == pytest.approx(1 / np.diff(time).max(), rel=2e-3)
    ranges = pieces(time.size, [axis.lost], axis.breaks)
    columns, cut = resampled([(np.sin(2 * np.pi * 100 * time), True), (time, False)], ranges, axis)
    for start, stop in cut:
        at, steps = columns[1][start:stop], np.arange(stop - start) / axis.sample_rate
        even = np.median(at - steps) + steps
        error = np.abs(columns[0][start:stop] - np.sin(2 * np.pi * 100 * even))
        # Near a step samples may be off by a quarter of an interval: 0.16 of the amplitude.
        assert np.quantile(error, 0.95) < 0.01 and error.max() < 0.2
    # The negative control: in samples of one rate it is another sine.
    uniform = time[0] + INDEX * np.mean(np.diff(time))
    assert np.abs(np.sin(2 * np.pi * 100 * time) - np.sin(2 * np.pi * 100 * uniform)).max() > 0.5


@pytest.mark.parametrize("digits", [3, 4, 5, 6])
@pytest.mark.parametrize("rate", [1010.0, 2999.7, 3000.0, 16384.0])
def test_rounded_stamps_are_no_jitter(rate, digits):
    """Stamps rounded to coarser than the interval give the rate, without a break."""
    axis = time_axis(np.round(np.arange(30_000) / rate, digits), None)
    assert axis.sample_rate == pytest.approx(rate, rel=1e-4)
    assert not axis.breaks.size and not axis.clocks and not axis.note


def test_a_short_record_of_rounded_stamps_gives_the_rate():
    """In 2 s with stamps in ms the rate is within 1e-5, and the one that is stated agrees."""
    for offset in np.linspace(0, 1, 23):
        stamps = np.round(offset + np.arange(10_400) / 5200.0, 3)
        assert time_axis(stamps, None).sample_rate == pytest.approx(5200, rel=1e-5)
        assert time_axis(stamps, 5200.0).sample_rate == 5200.0
    with pytest.raises(Unusable, match="sample_rate_hz is 5210"):
        time_axis(stamps, 5210.0)


def test_stamps_cut_to_the_interval_are_one_rate():
    """Stamps cut to ms at 1 kHz, some a step low by binary fractions, keep the rate."""
    for time in (np.arange(30_000) / 1000, np.cumsum(np.full(30_000, 1e-3))):
        stamps = np.floor(time * 1e3) / 1e3
        assert (np.diff(stamps) < 5e-4).any()
        axis = time_axis(stamps, None)
        assert axis.sample_rate == 1000.0 and not axis.clocks and not axis.note
        assert not axis.breaks.size


def test_samples_that_are_doubled_cut_the_record():
    """The record is cut at a few stamps that repeat; one is within a step of rounding."""
    time = np.arange(30_000) / 1000
    axis = time_axis(np.insert(time, [777, 9000, 20_000], time[[777, 9000, 20_000]]), None)
    assert axis.breaks.tolist() == [778, 9002, 20_003] and not axis.clocks
    assert axis.sample_rate == 1000.0
    axis = time_axis(np.insert(time, 777, time[777]), None)
    assert not axis.clocks and axis.sample_rate == 1000.0


def test_jitter_of_one_frequency_is_refused():
    """Periodic jitter makes sidebands and is refused; the same power as noise is accepted."""
    time = INDEX / 1000
    with pytest.raises(Unusable, match="periodically"):
        time_axis(time + 5e-5 * np.sin(2 * np.pi * INDEX / 7), None)
    noise = np.random.default_rng(0).uniform(-6e-5, 6e-5, INDEX.size)
    assert not time_axis(time + noise, None).clocks


@pytest.mark.parametrize("digits", [0, -1, -5])
def test_stamps_that_stand_still_are_refused(digits):
    """Stamps that are too coarse for their clock, or all equal, are refused."""
    with pytest.raises(Unusable, match="repeats"):
        time_axis(np.round(INDEX / 1000 + 1.7e9, digits), None)


def test_a_rate_that_more_than_doubles_is_refused():
    """Resampling to the lowest rate would lose more than half of the band."""
    for slow in (2.01e-3, 3e-3):
        with pytest.raises(Unusable, match="cut the record where the rate changes"):
            time_axis(np.cumsum(np.repeat([1e-3, slow], 6000)), None)


@pytest.mark.parametrize("rates", [(1000, 500), (2999.7, 1499.85), (250, 500)])
@pytest.mark.parametrize("digits", [6, 9])
def test_a_rate_may_halve_or_double(rates, digits):
    """A factor of two is resampled, as documented, however the stamps are rounded."""
    time = np.cumsum(np.repeat(1 / np.array(rates), 6000))
    axis = time_axis(np.round(time, digits), None)
    assert axis.sample_rate == pytest.approx(min(rates), rel=2e-4)
    sine = np.sin(2 * np.pi * 0.1 * min(rates) * time)
    ranges = pieces(time.size, [axis.lost], axis.breaks)
    (found, at), cut = resampled([(sine, True), (time, False)], ranges, axis)
    for start, stop in cut:
        steps = np.arange(stop - start) / axis.sample_rate
        even = np.median(at[start:stop] - steps) + steps
        error = np.abs(found[start:stop] - np.sin(2 * np.pi * 0.1 * min(rates) * even))
        assert np.quantile(error, 0.9) < 0.01


def test_pieces_around_missing_samples():
    """Pieces leave missing samples of any channel and single samples out."""
    one, other = np.array([[0, 1], [5, 6]]), np.array([[3, 4], [9, 10]])
    assert pieces(10, [one, other], np.array([8])) == ((1, 3), (6, 8))
    assert pieces(10, [np.array([[2, 9]]), np.array([[3, 5]])], np.array([4])) == ((0, 2),)
    assert pieces(3, [np.array([[0, 3]])], np.empty(0, int)) == ()
    assert pieces(8, [], np.array([4])) == ((0, 4), (4, 8))


def test_long_time_axes_are_read_in_blocks():
    """Gaps, odd intervals and disorder are found in every block, also at their edges."""
    n = 2 * BLOCK + 1000
    time = np.arange(n) / 20e3
    time[BLOCK:] += 3 / 20e3
    time[2 * BLOCK + 10 :] += 0.4 / 20e3
    axis = time_axis(time, None)
    assert axis.breaks.tolist() == [BLOCK, 2 * BLOCK + 10]
    assert "1 gaps with 3 dropped" in axis.note and "1 of" in axis.note
    assert axis.sample_rate == pytest.approx(20e3, rel=1e-9)
    time[2 * BLOCK + 20] = 0.0
    with pytest.raises(Unusable, match=f"backwards 1 times.*at sample {2 * BLOCK + 20};"):
        time_axis(time, None)


RATE = 20_000.0


def stroke(speed, rate=RATE):
    """Velocity of a stroke there and back with rests, and its position."""
    ramp = np.arange(0, speed, 10.0 / rate)
    rest, top = np.zeros(round(0.3 * rate)), np.full(round(0.5 * rate), speed)
    there = np.concatenate([ramp, top, ramp[::-1]])
    velocity = np.concatenate([rest, there, rest, -there, rest])
    return velocity, np.cumsum(velocity) / rate


STEPS = {
    "exact": lambda x: x,
    "float32 in mm": lambda x: (1e3 * x).astype(np.float32) / 1e3,
    "float32 at 300 mm": lambda x: (1e3 * (x + 0.3)).astype(np.float32) / 1e3,
    "1 um": lambda x: np.round(x, 6),
    "0.1 um": lambda x: np.round(x, 7),
    "1 nm": lambda x: np.round(x, 9),
}


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("speed", [0.005, 0.1, 0.4])
def test_steps_do_not_break_a_stroke(steps, speed):
    """Both constant segments are found whole but for 40 ms, at their speed."""
    _, position = stroke(speed)
    rounded = np.asarray(STEPS[steps](position), dtype=np.float64)
    velocity = set_velocity(rounded, ((0, rounded.size),), RATE)
    log = make_log({"acc_a": np.zeros(rounded.size)}, RATE, velocity=velocity[:])
    constant = [p for p in find_phases(log) if p.kind == "constant" and p.stop - p.start > 400]
    assert [p.velocity for p in constant] == pytest.approx([speed, -speed], rel=1e-3)
    assert all(0.45 < (p.stop - p.start) / RATE < 0.51 for p in constant)


def test_neighbouring_differences_would_break_it():
    """The negative control: in steps of 1 um the plain difference leaves no segment whole."""
    _, position = stroke(0.1)
    plain = np.gradient(np.round(position, 6), 1 / RATE)
    log = make_log({"acc_a": np.zeros(position.size)}, RATE, velocity=plain)
    longest = max(p.stop - p.start for p in find_phases(log) if p.kind == "constant")
    assert longest < 0.45 * RATE


def test_an_exact_position_gives_the_central_difference():
    """Without steps nothing is smoothed."""
    _, position = stroke(0.1)
    velocity = set_velocity(position, ((0, position.size),), RATE)
    np.testing.assert_allclose(velocity[:], np.gradient(position, 1 / RATE), atol=1e-12)


def test_gaps_stay_open():
    """Outside the pieces there is no velocity, and no difference is taken across a gap."""
    position = np.arange(100.0)
    position[50:] += 1000.0
    velocity = set_velocity(position, ((0, 40), (50, 90)), 10.0)
    assert np.isnan(velocity[40:50]).all() and np.isnan(velocity[90:]).all()
    np.testing.assert_allclose(velocity[0:40], 10.0)
    np.testing.assert_allclose(velocity[50:90], 10.0)


def test_blocks_do_not_show():
    """A long position gives the velocity of the same position at once, at every edge."""
    position = np.cumsum(np.sin(np.arange(6 * BLOCK) / 1e5)) / RATE
    velocity = set_velocity(position, ((0, position.size),), RATE)
    assert isinstance(velocity, Stored)
    expected = np.gradient(position, 1 / RATE)
    np.testing.assert_allclose(velocity[0 : velocity.size], expected, atol=1e-9)
