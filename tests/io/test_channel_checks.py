"""Flat, clipped and dependent channels are refused, coarse ones are not."""

import numpy as np
import pytest
from scipy.signal import lfilter

from lmshealth.io.buffers import BLOCK, NO_RANGES
from lmshealth.io.channel_checks import (
    check_signal,
    independent,
    missing_ranges,
    roughness,
    unwrapped,
)
from lmshealth.io.refusal import Unusable

N = 40_000
STEP = 4.88e-9


def noise(std, seed=0):
    """Make slow noise, so that neighbours are alike."""
    white = np.random.default_rng(seed).normal(size=N + 20)
    slow = np.convolve(white, np.ones(20), "valid")[:N]
    return std * slow / slow.std()


@pytest.mark.parametrize("limit", [0.5, 1.0, 2.0, 2.5])
@pytest.mark.parametrize("step", [0.0, 1e-4, 0.01])
def test_clipping_is_seen(limit, step):
    """Noise cut at one or both ends is refused, whatever the resolution."""
    values = np.round(noise(1.0) / step) * step if step else noise(1.0)
    for cut in (np.clip(values, -limit, limit), np.minimum(values, limit)):
        with pytest.raises(Unusable, match="maximum") as caught:
            check_signal(cut)
        assert caught.value.reason == "clipped"


def test_clipped_sine_is_seen():
    """A sine that is cut at nine tenths of its amplitude is refused."""
    with pytest.raises(Unusable, match="minimum"):
        check_signal(np.clip(np.sin(np.arange(N) / 50), -0.9, 0.9))


@pytest.mark.parametrize("amplitude", [0.6, 1.2, 2.3, 5.5, 9.0, 20.49, 20.51, 300.0, 3000.0])
@pytest.mark.parametrize("period", [7.3, 200.0, 6000.0])
def test_coarse_sines_are_not_clipped(amplitude, period):
    """A sine in encoder steps stays long in its outermost step and is not called clipped."""
    sine = amplitude * np.sin(2 * np.pi * np.arange(N) / period)
    check_signal(np.round(sine) * STEP)


@pytest.mark.parametrize("std", [0.3, 1.0, 3.0, 10.0, 100.0])
@pytest.mark.parametrize("seed", range(5))
def test_coarse_noise_is_not_clipped(std, seed):
    """Noise of a few encoder steps is not called clipped."""
    check_signal(np.round(noise(std, seed)) * STEP)


def test_flat():
    """A constant channel is refused."""
    with pytest.raises(Unusable, match="all 100 samples are 3"):
        check_signal(np.full(100, 3.0))


def test_vanishing_samples_are_flat():
    """Samples whose squares are no numbers are refused."""
    with pytest.raises(Unusable, match="within"):
        check_signal(1e-300 * noise(1.0))


def test_independent_channels():
    """Copies, opposites, multiples and combinations are found; noisy copies are not."""
    x, y = noise(1.0), noise(1.0, seed=1)
    whole = [(0, N)]
    assert independent([x, -x, 1e-6 * x + 9.81], whole, 3) == [0]
    assert sorted(independent([x, y, x + 2 * y], whole, 3)) in ([0, 1], [0, 2])
    assert independent([x, x + noise(1e-3, seed=2)], whole, 2) == [0, 1]
    assert independent([x, x + noise(0.1, seed=2), y], whole, 2) == [0, 2]


def test_a_channel_at_rest_is_no_copy():
    """What is constant for a while, or wherever it is compared, is none; copies of it are."""
    x, y, whole = noise(1.0), np.round(noise(20.0, seed=1)), [(0, N)]
    y[:5000] = 0.0
    assert sorted(independent([x, y], whole, 2)) == [0, 1]
    assert len(independent([y, 3 * y + 1, x], whole, 3)) == 2
    short = np.full((2, N), 0.7)
    short[0, 10_000:10_010], short[1, 20_100:20_110] = x[:10], y[-10:]
    assert sorted(independent([*short, x], whole, 3)) == [0, 1, 2]
    assert independent([*short], whole, 1) == [0]


def test_missing_ranges():
    """NaN, infinite and absurd samples are counted; too many of them end the channel."""
    values = np.ones(1000)
    values[[3, 4, 50, 70]] = np.nan, np.inf, 1e300, -np.inf
    ranges, note = missing_ranges(values)
    assert ranges.tolist() == [[3, 5], [50, 51], [70, 71]]
    assert "4 of 1000" in note and "3 ranges" in note
    assert missing_ranges(np.ones(5))[1] == ""
    values[:101] = np.nan
    for bad in (values, np.where(np.arange(1000) % 20 == 0, np.nan, 1.0)):
        with pytest.raises(Unusable, match="missing"):
            missing_ranges(bad)


def test_a_stretch_across_blocks_is_one():
    """Samples missing at the end of a block and at the beginning of the next are one range."""
    values = np.ones(3 * BLOCK)
    values[BLOCK - 2 : BLOCK + 3] = values[-1] = values[0] = np.nan
    ranges, note = missing_ranges(values)
    assert ranges.tolist() == [[0, 1], [BLOCK - 2, BLOCK + 3], [3 * BLOCK - 1, 3 * BLOCK]]
    assert "7 of" in note and "3 ranges" in note


def test_long_signals_are_judged_as_a_whole():
    """A limit reached in the last block only is seen, and a rare extreme is no limit."""
    values = np.tile(noise(1.0), 20)
    check_signal(values)
    cut = values.copy()
    cut[-N:] = np.clip(cut[-N:], None, 0.5)
    check_signal(cut)
    with pytest.raises(Unusable, match="maximum"):
        check_signal(np.minimum(values, 1.0))


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_a_counter_that_overflows_most_of_the_time_is_refused(bits):
    """Vibration larger than its range fills all levels alike; a smaller one does not."""
    motion = lfilter([1.0], [1.0, -0.9], np.random.default_rng(1).standard_normal(100_000))
    counts = np.round(0.3 * 2**bits / motion.std() * motion)
    wrapped = (counts + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1)
    with pytest.raises(Unusable, match="overflows"):
        unwrapped(wrapped, NO_RANGES, roughness(wrapped))
    small = np.round(counts / 4)
    assert unwrapped(small, NO_RANGES, roughness(small))[1] == ""
