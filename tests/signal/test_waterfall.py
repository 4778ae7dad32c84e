"""Waterfall: power over frequency whatever its unit, and missing values."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.io.log import Log
from lmshealth.signal.spectra import Spectrum
from lmshealth.signal.spectral_lines import Line
from lmshealth.signal.waterfall import (
    RelativeSpectrum,
    Waterfall,
    bin_density,
    relative_spectrum,
    shown_band,
)
from tests.signals import Mode, accelerations, make_log, make_stage, sine, white

RATE, N, NOISE = 1000.0, 40_000, 1e-4
STAGE = make_stage([("roll", 100.0, 0.02), ("yaw", 160.0, 0.02)])
MODES = (Mode(104.0, 0.02, shape=(1.0, 0.3)), Mode(155.0, 0.02, shape=(0.3, 1.0)))


def resonant(factor: float = 1.0, rate: float = RATE) -> Log:
    """Make a log of two accelerometers that see two modes, the first ``factor`` times as loud."""
    values = accelerations(np.random.default_rng(1), MODES, N, rate, NOISE)
    return make_log({"acc_a": factor * values[0], "acc_b": values[1]}, rate)


def level_at(levels: RelativeSpectrum, frequency: float) -> float:
    """Give the level of the bin that holds a frequency."""
    return float(levels.level[np.searchsorted(levels.edges, frequency) - 1])


def test_band_is_where_tracked_modes_are_looked_for() -> None:
    """It reaches from the lowest search to the highest."""
    assert shown_band(STAGE) == pytest.approx((85.0, 184.0))


def test_binning_keeps_the_power() -> None:
    """Bins narrower and wider than the resolution hold the same power together."""
    rng = np.random.default_rng(2)
    frequency = np.arange(1, 400) / 2.0
    spectrum = Spectrum(frequency, rng.exponential(size=frequency.size), 2.0, float("nan"))
    wide, narrow = np.array([50.25, 150.25]), np.geomspace(50.25, 150.25, 1001)
    inside = (frequency > 50.25) & (frequency < 150.25)
    power = spectrum.periodogram[inside].sum() / spectrum.duration
    np.testing.assert_allclose(bin_density(spectrum, wide) * 100, power, rtol=1e-12)
    np.testing.assert_allclose(bin_density(spectrum, narrow) @ np.diff(narrow), power, rtol=1e-12)


def test_resonances_and_lines_stand_out_where_they_are() -> None:
    """The highest bins are those of the modes; a line makes its own bin the highest of all."""
    levels = relative_spectrum(resonant(), STAGE)
    assert levels is not None
    for low, high, truth in ((85, 130, 104.0), (130, 184, 155.0)):
        centre = np.sqrt(levels.edges[1:] * levels.edges[:-1])
        own = (centre > low) & (centre < high)
        peak = centre[own][np.argmax(levels.level[own])]
        assert peak == pytest.approx(truth, rel=0.02)
    loud = relative_spectrum(make_log({"acc_a": sine(N, RATE, 120.0, 5.0)}, RATE), STAGE)
    assert loud is not None
    assert int(np.argmax(loud.level)) == np.searchsorted(loud.edges, 120.0) - 1


def test_level_is_that_of_white_noise_about_its_median() -> None:
    """White noise is at 0 dB, as far as the number of ordinates in a bin allows."""
    noise = white(np.random.default_rng(3), NOISE, 8 * N, RATE)
    levels = relative_spectrum(make_log({"acc_a": noise}, RATE), STAGE, n_bins=40)
    assert levels is not None
    # The narrowest bin holds 530 ordinates: 4.5 of its standard deviations are 0.85 dB.
    assert np.abs(levels.level).max() < 0.85


def test_loudness_and_unit_of_a_channel_do_not_matter() -> None:
    """A channel a thousand times as loud gives the same picture; absolute levels are lost."""
    one, other = relative_spectrum(resonant(), STAGE), relative_spectrum(resonant(1e3), STAGE)
    assert one is not None and other is not None
    np.testing.assert_allclose(one.level, other.level, atol=1e-9)


def test_following_error_counts_as_acceleration() -> None:
    """A displacement gives the levels of its second derivative."""
    acceleration = accelerations(np.random.default_rng(4), MODES[:1], N, RATE, NOISE)[0]
    frequency = np.fft.rfftfreq(N, 1 / RATE)
    turned = np.fft.rfft(acceleration)
    turned[1:] /= -((2 * np.pi * frequency[1:]) ** 2)
    turned[0] = 0.0
    one = relative_spectrum(make_log({"acc_a": acceleration}, RATE), STAGE, n_bins=40)
    other = relative_spectrum(
        make_log({"delta_e": np.fft.irfft(turned, N)}, RATE), STAGE, n_bins=40
    )
    assert one is not None and other is not None
    # Read as it is, a displacement would be tilted by 13 dB over the band.
    assert np.abs(one.level - other.level).max() < 1.0


def test_what_cannot_be_read_is_missing() -> None:
    """No fitting channel, no segment, no signal or too low a rate give None; half a band NaN."""
    noise = white(np.random.default_rng(5), NOISE, N, RATE)
    assert relative_spectrum(make_log({"current": noise}, RATE), STAGE) is None
    assert relative_spectrum(make_log({"acc_a": noise}, RATE, pieces=[(0, 50)]), STAGE) is None
    assert relative_spectrum(make_log({"acc_a": np.zeros(N)}, RATE), STAGE) is None
    assert relative_spectrum(make_log({"acc_a": noise}, 160.0), STAGE) is None
    half = relative_spectrum(make_log({"acc_a": noise}, 250.0), STAGE)
    assert half is not None
    np.testing.assert_array_equal(np.isnan(half.level), half.edges[1:] >= 125.0)


def test_logs_stand_side_by_side_with_their_lines() -> None:
    """A log without levels is a row of NaN; only lines within the band are kept."""
    levels = relative_spectrum(resonant(), STAGE)
    lines = [Line(f, 1e-3, "m/s²", "mains", "acc_a") for f in (50.0, 100.0, 150.0, 200.0)]
    waterfall = Waterfall.stack([(levels, lines), (None, ())])
    assert waterfall is not None and levels is not None
    np.testing.assert_array_equal(waterfall.level[0], levels.level)
    assert np.isnan(waterfall.level[1]).all()
    assert [[line.frequency for line in own] for own in waterfall.lines] == [[100.0, 150.0], []]
    assert Waterfall.stack([(None, lines)]) is None
