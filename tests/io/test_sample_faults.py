"""Overflows, bad samples, lost signs and missing levels are found; good channels are left alone."""

import numpy as np
import pytest
from scipy.signal import lfilter

from lmshealth.io.channel_checks import (
    check_sign,
    coarse_levels,
    level_step,
    magnitudes,
    roughness,
    spikes,
    unwrapped,
)
from lmshealth.io.refusal import Unusable

NONE = np.empty((0, 2), dtype=np.int64)
N = 30_000


def vibration(seed=0, noise=0.1):
    """Make a resonance in noise, of standard deviation one."""
    rng = np.random.default_rng(seed)
    pole = np.exp(2j * np.pi * 0.05 - 2 * np.pi * 0.05 * 0.02)
    x = lfilter([1], np.poly([pole, pole.conj()]), rng.standard_normal(N))
    return x / x.std() + noise * rng.standard_normal(N)


def overflow(counts, bits):
    """Let a counter overflow."""
    half = 2 ** (bits - 1)
    return (counts + half) % (2 * half) - half


@pytest.mark.parametrize("bits", [8, 12, 16, 24])
@pytest.mark.parametrize("share", [0.6, 0.9])
@pytest.mark.parametrize("step", [1.0, 0.0981])
def test_overflows_are_undone(bits, share, step):
    """The samples are those of a counter of more bits, whatever their unit."""
    x = vibration()
    counts = np.round(x / np.abs(x).max() * 2 ** (bits - 1) / share).astype(np.int64)
    values = overflow(counts, bits) * step
    undone, note = unwrapped(values, NONE, roughness(values))
    np.testing.assert_allclose(undone[:], counts * step, rtol=0, atol=1e-6 * step * 2**bits)
    assert f"{bits} bits" in note


def test_overflows_of_no_whole_number_are_refused():
    """Rounded values do not state the step of their counter."""
    x = vibration(noise=0.01)
    turn = 1.5 * np.abs(x).max()
    values = (x + turn / 2) % turn - turn / 2
    with pytest.raises(Unusable) as caught:
        unwrapped(values, NONE, roughness(values))
    assert caught.value.reason == "wrapped"


@pytest.mark.parametrize("name", ["square", "steps", "white", "quantised"])
def test_other_jumps_are_no_overflows(name):
    """Square waves, moves and noise jump by more than half of their range, too."""
    rng = np.random.default_rng(1)
    t = np.arange(N)
    values = {
        "square": np.round(127 * np.where(t // 997 % 2, 1, -1) + 2 * rng.standard_normal(N)),
        "steps": np.exp(-(t % 2000) / 120) + 1e-3 * rng.standard_normal(N),
        "white": rng.standard_normal(N),
        "quantised": np.round(40 * rng.standard_normal(N)),
    }[name]
    undone, note = unwrapped(values, NONE, roughness(values))
    assert undone is values and not note


@pytest.mark.parametrize("width", [1, 2])
def test_bad_samples_are_found(width):
    """Single samples and pairs beyond what the signal allows are found where they are."""
    x = vibration()
    at = np.arange(500, N - 500, 1500)
    for k in range(width):
        x[at + k] += 12.0
    found = spikes(x, NONE, roughness(x))
    assert found.tolist() == [[i, i + width] for i in at.tolist()]


def test_a_bad_sample_near_a_missing_one_is_found():
    """Missing samples beside it are predicted together with it."""
    x = vibration()
    x[500] += 12.0
    x[505] = np.nan
    found = spikes(x, np.array([[505, 506]]), roughness(x))
    assert found.tolist() == [[500, 501]]


def test_a_jump_where_time_is_interrupted_is_no_bad_sample():
    """Samples after a gap of the clock go on from others; one further away is found."""
    x = np.concatenate([vibration()[:5000], -vibration(1)[5000:]])
    x[4997:5003] = [0.0, 0.0, 8.0, -8.0, 0.0, 0.0]
    x[7000] += 12.0
    found = spikes(x, NONE, roughness(x), np.array([5000]))
    assert found.tolist() == [[7000, 7001]]


@pytest.mark.parametrize("name", ["normal", "tails", "blows", "shocks", "encoder", "steps"])
@pytest.mark.parametrize("seed", range(3))
def test_signals_have_no_bad_samples(name, seed):
    """Heavy tails, blows that ring, steps and single levels of an encoder belong to the signal."""
    rng = np.random.default_rng(seed)
    pole = np.exp(2j * np.pi * 0.06 - 2 * np.pi * 0.06 * 0.02)
    poly = np.poly([pole, pole.conj()])
    blows = (rng.random(N) < 3e-4) * rng.exponential(20, N)
    x = {
        "normal": vibration(seed),
        "tails": rng.standard_t(3, N),
        "blows": lfilter([1], poly, blows) + 0.1 * rng.standard_normal(N),
        "shocks": lfilter([1, -2, 1], poly, blows) + 0.1 * rng.standard_normal(N),
        "encoder": np.round(0.4 * vibration(seed, 0.0)) * 4.88e-9,
        "steps": np.where(np.arange(N) // 5000 % 2, 30.0, 0.0) + vibration(seed),
    }[name]
    assert not spikes(x, NONE, roughness(x)).size


@pytest.mark.parametrize("name", ["abs", "line", "negative", "coupled", "square", "two", "three"])
def test_magnitudes_are_refused(name):
    """Without its sign a vibration is none, also after its mean was removed."""
    x, y, z = (vibration(seed) for seed in range(3))
    line = 5 * np.sin(0.15 * np.arange(N)) + x
    values = {
        "abs": np.abs(x), "line": np.abs(line), "negative": -np.abs(x),
        "coupled": np.abs(x) - 0.8, "square": x**2,
        "two": np.hypot(x, y), "three": np.sqrt(x**2 + y**2 + z**2),
    }[name]  # fmt: skip
    with pytest.raises(Unusable) as caught:
        check_sign(values, roughness(values))
    assert caught.value.reason == "rectified"


@pytest.mark.parametrize(
    "name", ["vibration", "gravity", "sine", "decay", "ramp", "friction", "moves"]
)
def test_signed_channels_are_accepted(name):
    """Offsets, sines, ramps and one-sided errors of moves are no magnitudes."""
    x, t = vibration(), np.arange(N)
    cycles = np.linspace(0, 20, 4000)
    values = {
        "vibration": x,
        "gravity": 9.81 + 0.1 * x,
        "sine": np.sin(0.1 * t),
        # One sample of a knock at an end of the range.
        "decay": np.append(0.99**cycles * np.sin(2 * np.pi * cycles), -1.2),
        "ramp": t + x,
        "friction": np.where(t // 5000 % 2, 3.0, 0.0) + 0.1 * x,
        "moves": 5 * np.exp(-(t % 2000) / 120) + 0.01 * x,
    }[name]
    check_sign(values, roughness(values))


def test_the_magnitude_of_other_channels_is_found():
    """With or without gravity it is found by the axes that it is made of."""
    x, y, z, other = (vibration(seed) for seed in range(4))
    z = z + 9.81
    for r in (np.sqrt(x**2 + y**2 + z**2), np.sqrt(x**2 + y**2 + z**2) - 9.80665):
        found = magnitudes([x, other, y, np.round(r, 3), z], [(0, N)])
        assert found == {3: [0, 2, 4]}
    assert magnitudes([x, other, y, z], [(0, N)]) == {}


def test_magnitudes_are_found_among_many_channels():
    """Two of them, which have an axis in common, exact or rounded, with an offset or without."""
    rng = np.random.default_rng(12)
    axes = rng.standard_normal((40, N)) * np.geomspace(0.5, 2, 40)[:, None]
    first, second = (np.sqrt(np.sum(axes[own] ** 2, axis=0)) for own in ([3, 8, 21], [8, 30]))
    found = magnitudes([*axes, first - 9.81, np.round(second, 3)], [(0, N)])
    assert found == {40: [3, 8, 21], 41: [8, 30]}
    assert magnitudes([*axes, first + 0.3 * axes[1], second * axes[0]], [(0, N)]) == {}


def test_levels():
    """A third of a step and a stuck bit are noted; a stuck last bit only doubles the step."""
    x = vibration()
    counts = np.round(60 * x).astype(np.int64)
    assert "steps" in coarse_levels(np.round(0.3 * x))
    assert "no sample lies between" in coarse_levels((counts & ~32).astype(float))
    for good in (np.round(0.7 * x), counts & ~1, counts, x):
        assert coarse_levels(np.asarray(good, dtype=float)) == ""


@pytest.mark.parametrize("seconds", [0.2, 0.4, 1.0])
def test_drifts_and_tones_are_no_faults(seconds):
    """A slow decay has no edge and no missing levels, nor has a tone of whole periods."""
    t = np.arange(N) / N
    for part in (0.001, 0.03):
        x = np.exp(-t / seconds) + part * vibration()
        check_sign(x, roughness(x))
        assert coarse_levels(x) == ""
    for period in (5, 6, 8):
        tone = np.sin(2 * np.pi * np.arange(N) / period + 0.3) + 1e-3 * vibration()
        check_sign(tone, roughness(tone))
        assert coarse_levels(tone) == ""


@pytest.mark.parametrize("bits", [16, 24])
def test_overflows_of_blows_end_with_an_answer(bits):
    """Jumps of blows in a counter that overflows are undone or refused."""
    t = np.arange(25000) % 5000 / 5000
    wave = np.exp(-0.02 * 2 * np.pi * 90 * t) * np.cos(2 * np.pi * 90 * t)
    noise = 3 * np.random.default_rng(1).standard_normal(t.size)
    values = overflow(np.round(1.2 * 2 ** (bits - 1) * wave + noise), bits)
    try:
        read, _ = unwrapped(values, np.empty((0, 2), dtype=np.int64), roughness(values))
    except Unusable as error:
        assert error.reason == "wrapped"
    else:
        assert np.isfinite(read[:]).all()


def test_the_step_of_levels():
    """The step is found from rounded values, and there is none without levels."""
    counts = np.round(60 * vibration())
    assert level_step(np.round(0.0981 * counts, 5)) == pytest.approx(0.0981, rel=1e-5)
    assert level_step(vibration()) is None


@pytest.mark.parametrize("n_missing", [1, 5, 10])
@pytest.mark.parametrize("seed", range(3))
def test_overflows_beside_missing_samples_are_undone(n_missing, seed):
    """A gap near the largest sample neither hides a turn nor makes one."""
    counts = np.rint(160 * vibration(seed, noise=0.01) / np.abs(vibration(seed, noise=0.01)).max())
    at = int(np.abs(counts).argmax()) + 1
    values = overflow(counts, 8)
    values[at : at + n_missing] = np.nan
    gone = np.array([[at, at + n_missing]])
    read, note = unwrapped(values, gone, roughness(values))
    assert "overflow" in note
    np.testing.assert_array_equal(np.diff(np.delete(read - counts, slice(at, at + n_missing))), 0)
