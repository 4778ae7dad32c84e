"""Spectra and their fit in bins; waterfall of many logs."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.io.log import Log
from lmshealth.modal.identification import read_ambient
from lmshealth.modal.modes import merge
from lmshealth.modal.spectra_summary import (
    WATERFALL_BINS,
    SpectraSummary,
    Waterfall,
    bin_density,
    shown_band,
    summarise,
)
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra
from lmshealth.signal.spectral_lines import Line
from tests.signals import Mode, accelerations, density, make_log, make_stage, sine, white

RATE, N, NOISE = 500.0, 64000, 0.5
MODE = Mode(62.0, 0.02, 1.0, (1.0, 0.5))


def test_levels_fit_and_singular_values_are_those_of_the_process() -> None:
    """Two channels show a mode, one of them a line, which keeps its power."""
    rng = np.random.default_rng(5)
    one, two = accelerations(rng, [MODE], N, RATE, NOISE)
    log = make_log({"acc_a": one + sine(N, RATE, 75.0, 3.0), "acc_b": two}, RATE)
    reading = read_ambient(log, make_stage([("roll", 62.0, 0.02)]))
    summary = summarise(
        reading.spectra, reading.fitted, reading.modes, (50.0, 80.0), 100, n_singular=2
    )
    middle = (summary.edges[1:] + summary.edges[:-1]) / 2
    true = 10 * np.log10(density([MODE], middle, NOISE))
    line = np.abs(middle - 75.0) < 0.5
    scatter = 20 / float(np.sqrt(summary.count[0]))
    assert summary.level[0][~line] == pytest.approx(true[~line], abs=scatter)
    shown = np.isfinite(summary.fitted[0]) & ~line
    assert shown.sum() > 20
    assert summary.fitted[0][shown] == pytest.approx(true[shown], abs=1.5)
    excess = 10 ** (summary.level[0].astype(float) / 10) - density([MODE], middle, NOISE)
    power = excess[line] @ np.diff(summary.edges)[line]
    assert power == pytest.approx(3.0**2 / 2, rel=0.15)
    # The mode has one shape: the second singular value is the noise.
    peak = int(np.argmax(summary.singular[0] * ~line))
    assert middle[peak] == pytest.approx(62.0, abs=1.0)
    noise = 10 * np.log10(NOISE)
    assert np.median(summary.singular[1].astype(float)) == pytest.approx(noise, abs=1.0)


def test_a_channel_without_power_has_no_level() -> None:
    """Its logarithm is missing, not infinite; a single channel has no singular values."""
    rng = np.random.default_rng(5)
    log = make_log({"acc_a": white(rng, 1.0, 8000, RATE)}, RATE)
    reading = read_ambient(log, band=(50.0, 80.0))
    spectra = reading.spectra
    summary = summarise(spectra, (), reading.modes, (50.0, 80.0), 100, n_singular=2)
    assert summary.singular.shape == (0, summary.count.size)
    assert np.isfinite(summary.level).all()
    assert np.isnan(summary.fitted).all()


@pytest.mark.parametrize("least", [0.0, 0.6])
def test_segments_without_low_frequencies_do_not_lower_the_level_there(least: float) -> None:
    """White noise and a line in a long and a cut short segment keep level and power."""

    def flat(duration: float, least: float, count: int) -> CrossSpectrum:
        frequency = np.arange(1, 5 * duration) / duration
        ones = np.ones((count, frequency.size, 1), dtype=complex)
        free, lines = np.ones(frequency.size, dtype=bool), ((0, 2.0, 0.3),) * count
        return CrossSpectrum(frequency, ones, duration, np.nan, free, lines).band(least, np.inf)

    spectra = LogSpectra(("acc_a",), ("acc",), (flat(120.0, 0.0, 1), flat(20.0, least, 20)))
    summary = summarise(spectra, (), merge([], (), ()), (0.1, 4.0), 20)
    density = 10 ** (summary.level[0].astype(float) / 10)
    power, width = density @ np.diff(summary.edges), np.diff(summary.edges)
    line = int(np.searchsorted(summary.edges, 2.0)) - 1
    assert np.delete(density, line) == pytest.approx(1.0, abs=1e-3)
    assert power - width.sum() == pytest.approx(0.3**2 / 2, abs=1e-3)
    observed = np.where(summary.edges[1:] < least - 0.025, 120.0, 520.0)
    whole = (summary.edges[1:] < least - 0.025) | (summary.edges[:-1] > least)
    assert summary.count[whole] == pytest.approx((observed * width)[whole], rel=1e-3)


# Waterfall

WIDE, RATE_W, QUIET = 40_000, 1000.0, 1e-4
STAGE = make_stage([("roll", 100.0, 0.02), ("yaw", 160.0, 0.02)])
MODES = (Mode(104.0, 0.02, shape=(1.0, 0.3)), Mode(155.0, 0.02, shape=(0.3, 1.0)))


def summarised(log: Log) -> SpectraSummary:
    """Return the spectra of a log as a batch keeps them."""
    reading = read_ambient(log, STAGE)
    band = shown_band(STAGE)
    return summarise(reading.spectra, reading.fitted, reading.modes, band, WATERFALL_BINS)


def stacked(*logs: Log) -> Waterfall:
    """Return the waterfall of logs without lines."""
    found = Waterfall.stack([(summarised(log), ()) for log in logs])
    assert found is not None
    return found


def resonant(factor: float = 1.0) -> Log:
    """Make a log of two accelerometers that see two modes, the first ``factor`` times as loud."""
    values = accelerations(np.random.default_rng(1), MODES, WIDE, RATE_W, QUIET)
    return make_log({"acc_a": factor * values[0], "acc_b": values[1]}, RATE_W)


def test_band_is_where_tracked_modes_are_looked_for() -> None:
    """It reaches from the lowest search to the highest."""
    assert shown_band(STAGE) == pytest.approx((100.0 / 1.15, 184.0))


def test_binning_keeps_the_power() -> None:
    """Bins narrower and wider than the resolution hold the same power together."""
    rng = np.random.default_rng(2)
    frequency = np.arange(1, 400) / 2.0
    density, free = rng.exponential(size=frequency.size), np.ones(frequency.size, dtype=bool)
    transforms = np.sqrt(density)[None, :, None].astype(complex)
    spectrum = CrossSpectrum(frequency, transforms, 2.0, float("nan"), free)
    wide, narrow = np.array([50.25, 150.25]), np.geomspace(50.25, 150.25, 1001)
    inside = (frequency > 50.25) & (frequency < 150.25)
    power = density[inside].sum() / spectrum.duration
    np.testing.assert_allclose(bin_density(spectrum, density, wide) * 100, power, rtol=1e-12)
    np.testing.assert_allclose(
        bin_density(spectrum, density, narrow) @ np.diff(narrow), power, rtol=1e-12
    )


def test_resonances_and_lines_stand_out_where_they_are() -> None:
    """The highest bins are those of the modes; a line makes its own bin the highest of all."""
    (noise,) = accelerations(np.random.default_rng(2), MODES[:1], WIDE, RATE_W, QUIET)[:1]
    line = make_log({"acc_a": noise + sine(WIDE, RATE_W, 120.0, 100.0)}, RATE_W)
    waterfall = stacked(resonant(), line)
    edges = waterfall.edges
    centre = np.sqrt(edges[1:] * edges[:-1])
    for low, high, truth in ((85, 130, 104.0), (130, 184, 155.0)):
        own = (centre > low) & (centre < high)
        peak = centre[own][np.argmax(waterfall.level[0][own])]
        assert peak == pytest.approx(truth, rel=0.02)
    assert abs(int(np.argmax(waterfall.level[1])) - np.searchsorted(edges, 120.0) + 1) <= 1


def test_level_is_that_of_white_noise_about_its_median() -> None:
    """White noise is at 0 dB, as far as the number of ordinates in a bin allows."""
    noise = white(np.random.default_rng(3), QUIET, 8 * WIDE, RATE_W)
    level = stacked(make_log({"acc_a": noise}, RATE_W)).level
    # A bin of 0.5 Hz holds 160 ordinates: 4.5 of its standard deviations are 1.5 dB.
    assert np.abs(level).max() < 1.6


def test_loudness_and_unit_of_a_channel_do_not_matter() -> None:
    """A channel a thousand times as loud gives the same picture; absolute levels are lost."""
    one, other = stacked(resonant()), stacked(resonant(1e3))
    np.testing.assert_allclose(one.level, other.level, atol=0.1)


def test_a_band_above_half_of_the_sample_rate_is_missing() -> None:
    """A log of a lower rate has no level where another one has."""
    values = accelerations(np.random.default_rng(1), MODES[:1], WIDE, 250.0, QUIET)
    reading = read_ambient(make_log({"acc_a": values[0]}, 250.0), band=(85.0, 112.0))
    slow = summarise(reading.spectra, (), reading.modes, shown_band(STAGE), WATERFALL_BINS)
    waterfall = Waterfall.stack([(slow, ()), (summarised(resonant()), ())])
    assert waterfall is not None
    gone = np.isnan(waterfall.level[0])
    assert gone.any() and not gone.all()
    assert (waterfall.edges[1:][gone] > slow.high).all()
    assert np.isfinite(waterfall.level[1]).all()


def test_logs_stand_side_by_side_with_their_lines() -> None:
    """A log without levels is a row of NaN; only lines within the band are kept."""
    lines = [Line(f, 1e-3, "m/s²", "mains", "acc_a") for f in (50.0, 100.0, 150.0, 200.0)]
    waterfall = Waterfall.stack([(summarised(resonant()), lines), (None, ())])
    assert waterfall is not None
    assert np.isfinite(waterfall.level[0]).all()
    assert np.isnan(waterfall.level[1]).all()
    assert [[line.frequency for line in own] for own in waterfall.lines] == [[100.0, 150.0], []]
    assert Waterfall.stack([(None, lines)]) is None
