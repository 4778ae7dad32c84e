"""Spectra: what a periodogram reads, which stretches of a log it takes, and what it expects."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.logs import Channel
from lmshealth.segments import Segment
from lmshealth.spectra import Spectrum, periodogram, periodogram_kernel
from tests.signals import Mode, accelerations, density, sine, white

RATE = 2000.0


def whole(values: np.ndarray, kind: str = "acceleration", rate: float = RATE) -> Spectrum:
    """Transform all samples of a channel."""
    channel = Channel("x", kind, np.array(values))  # type: ignore[arg-type]
    return periodogram(channel, Segment(0, values.size, float("nan")), rate)


def in_bands(spectrum: Spectrum, n: int = 20) -> tuple[np.ndarray, np.ndarray, int]:
    """Mean frequency and mean ordinate of bands of equal size, and that size."""
    size = spectrum.frequency.size // n
    cut = slice(0, size * n)
    frequency = spectrum.frequency[cut].reshape(n, size).mean(axis=1)
    return frequency, spectrum.periodogram[cut].reshape(n, size).mean(axis=1), size


def test_white_noise_reads_its_density_in_every_band() -> None:
    """Mean ordinates of white noise of density S are S within 4.5 of their standard errors."""
    level = 3.7e-4
    _, mean, size = in_bands(whole(white(np.random.default_rng(3), level, 1 << 16, RATE)))
    off = (mean / level - 1) * np.sqrt(size)
    assert np.abs(off).max() < 4.5
    # Negative control: a two-sided density, half of it, is seen.
    assert np.abs((mean / (level / 2) - 1) * np.sqrt(size)).min() > 4.5


def test_ordinates_are_exponential_and_uncorrelated() -> None:
    """Ordinates over density have mean, variance and lag-one correlation of exponentials."""
    ratio = whole(white(np.random.default_rng(4), 1.0, 1 << 16, RATE)).periodogram
    n = ratio.size
    assert abs(ratio.var() - 1) < 4.5 * np.sqrt(8 / n)
    assert abs(np.corrcoef(ratio[1:], ratio[:-1])[0, 1]) < 4.5 / np.sqrt(n)


def test_ordinates_add_up_to_the_variance() -> None:
    """Parseval: without mean and trend, variance is the sum of ordinates over duration."""
    x = np.random.default_rng(5).normal(2.0, 1.0, 4001) + np.linspace(0, 7, 4001)
    spectrum = whole(x)
    t = np.arange(x.size)
    rest = x - np.polyval(np.polyfit(t, x, 1), t)
    assert spectrum.periodogram.sum() / spectrum.duration == pytest.approx(rest.var(), rel=1e-12)


@pytest.mark.parametrize("n", [4000, 4001])
def test_a_sine_reads_its_amplitude(n: int) -> None:
    """A sine of amplitude A on a Fourier frequency has the ordinate A² T / 2, odd n and even."""
    frequency = 200 * RATE / n
    spectrum = whole(sine(n, RATE, frequency, 0.02))
    k = int(np.argmax(spectrum.periodogram))
    assert spectrum.frequency[k] == pytest.approx(frequency, rel=1e-12)
    assert np.sqrt(2 * spectrum.periodogram[k] / spectrum.duration) == pytest.approx(0.02, rel=1e-3)


def test_frequencies_end_below_nyquist() -> None:
    """The first ordinate is at 1/T, the last strictly below half the sample rate."""
    for n in (100, 101):
        spectrum = whole(np.random.default_rng(0).normal(size=n))
        assert spectrum.frequency[0] == pytest.approx(RATE / n)
        assert RATE / 2 - RATE / n <= spectrum.frequency[-1] < RATE / 2


@pytest.mark.parametrize("kind", ["acceleration", "displacement"])
@pytest.mark.parametrize("phase", [0.0, 0.9, np.pi / 2])
def test_a_sine_reads_its_amplitude_to_a_millionth(kind: str, phase: float) -> None:
    """From the 780th ordinate on the trend takes less than 1e-6 away, whatever the phase."""
    n, k = 16_000, 800
    lost = 2 if kind == "displacement" else 0
    frequency = k * RATE / n
    spectrum = whole(sine(n + lost, RATE, frequency, 0.02, phase), kind)
    at = int(np.argmax(spectrum.periodogram))
    amplitude = np.sqrt(2 * spectrum.periodogram[at] / spectrum.duration)
    factor = (2 * np.pi * frequency) ** 2 if lost else 1.0
    assert amplitude == pytest.approx(0.02 * factor, rel=1e-6)


def test_what_the_trend_takes_from_the_lowest_ordinates_is_as_stated() -> None:
    """White noise loses the share 3/(πk)² at the k-th ordinate: the projection says so exactly."""
    n, ks = 4000, np.array([1, 2, 10, 100, 800])
    t = np.arange(n)
    ramp = t - (n - 1) / 2
    part = np.abs(np.exp(-2j * np.pi * np.outer(ks, t) / n) @ ramp) ** 2 / (ramp @ ramp) / n
    np.testing.assert_allclose(part, 3 / (np.pi * ks) ** 2, rtol=0.2)
    assert part[-1] < 1e-6


def test_the_mean_ordinate_of_a_band_has_two_degrees_of_freedom_each() -> None:
    """The density of a band scatters over seeds as χ² of its degrees of freedom says."""
    rng = np.random.default_rng(12)
    readings = [whole(white(rng, 2.0, 2000, RATE)).density(100.0, 150.0) for _ in range(500)]
    level = np.array([level for level, _ in readings])
    (dof,) = {dof for _, dof in readings}
    assert dof == 100
    assert abs(level.mean() / 2 - 1) < 4.5 * np.sqrt(2 / dof / 500)
    assert abs(level.var() / (2**2 * 2 / dof) - 1) < 4.5 * np.sqrt(2.5 / 500)


def test_a_displacement_sine_reads_its_acceleration() -> None:
    """Differencing twice and its correction give ω² times the amplitude up to near Nyquist."""
    n = 4002  # two samples are lost to the second difference
    for k in (20, 400, 1900):
        frequency = k * RATE / (n - 2)
        spectrum = whole(sine(n, RATE, frequency, 1e-6), "displacement")
        at = int(np.argmax(spectrum.periodogram))
        amplitude = np.sqrt(2 * spectrum.periodogram[at] / spectrum.duration)
        assert amplitude == pytest.approx((2 * np.pi * frequency) ** 2 * 1e-6, rel=2e-3)


def test_displacement_noise_reads_as_acceleration_growing_with_the_fourth_power() -> None:
    """White displacement noise of density S_x reads (2πf)⁴ S_x in every band."""
    level = 1e-18
    noise = white(np.random.default_rng(6), level, 1 << 16, RATE)
    spectrum = whole(noise, "displacement")
    ratio = spectrum.periodogram / ((2 * np.pi * spectrum.frequency) ** 4 * level)
    # The density is so steep that its upper end leaks into the lowest frequencies.
    flat = Spectrum(spectrum.frequency[2500:], ratio[2500:], spectrum.duration, float("nan"))
    _, mean, size = in_bands(flat)
    assert np.abs((mean - 1) * np.sqrt(size)).max() < 4.5


def test_differencing_first_keeps_slow_motion_out_of_the_band_of_modes() -> None:
    """A millimetre of slow motion leaks over a thousand times less than with ω² afterwards."""
    n = 8000
    slow = sine(n, RATE, 0.37, 1e-3)
    ours = whole(slow, "displacement").band(80, 160)
    late = whole(slow).band(80, 160)
    naive = late.periodogram * (2 * np.pi * late.frequency) ** 4
    assert np.median(ours.periodogram) < 1e-3 * np.median(naive)


def test_band_cuts_ordinates_and_nothing_else() -> None:
    """A band holds the frequencies from low to below high with their ordinates and duration."""
    spectrum = whole(np.random.default_rng(7).normal(size=4000))
    cut = spectrum.band(100.0, 200.0)
    inside = (spectrum.frequency >= 100) & (spectrum.frequency < 200)
    np.testing.assert_array_equal(cut.periodogram, spectrum.periodogram[inside])
    assert cut.duration == spectrum.duration


def test_spectrum_refuses_arrays_that_differ_in_shape() -> None:
    """Frequencies without ordinates are no spectrum."""
    with pytest.raises(ValueError, match="differ in shape"):
        Spectrum(np.arange(3.0), np.arange(4.0), 1.0, 0.0)


# The expected periodogram


def autocovariance(mode: Mode, noise: float, n: int) -> np.ndarray:
    """Autocovariance at lags 0 … n - 1 by the cosine transform of the density."""
    size = 1 << 18
    frequency = np.arange(1, size // 2 + 1) * RATE / size
    values = np.concatenate([[noise], density([mode], frequency, noise)])
    return np.fft.irfft(values, size)[:n] * RATE / 2


def test_the_kernel_gives_the_expected_periodogram_of_a_short_record() -> None:
    """On 4 half-power bandwidths per bin the kernel agrees with the sum over autocovariances."""
    mode, noise, n = Mode(100.0, 0.01), 0.5, 4000
    duration = n / RATE
    lags = np.arange(n)
    weighted = (1 - lags / n) * autocovariance(mode, noise, n)
    frequency = np.arange(160, 241) / duration
    cosines = np.cos(2 * np.pi * np.outer(frequency, lags) / RATE)
    oracle = 2 / RATE * (2 * cosines @ weighted - weighted[0])
    fine = np.arange(1 / (8 * duration), RATE / 2, 1 / (8 * duration))
    kernel = periodogram_kernel(frequency, duration, fine)
    np.testing.assert_allclose(kernel @ density([mode], fine, noise), oracle, rtol=5e-3)
    # Negative control: the density itself is no such expectation.
    bias = density([mode], frequency, noise) / oracle - 1
    assert np.abs(bias).max() > 0.1


def test_short_records_average_to_the_expected_periodogram() -> None:
    """The mean periodogram of 400 short records is the kernel's within 4.5 standard errors."""
    mode, noise, n, n_records = Mode(100.0, 0.01), 0.5, 4000, 400
    rng = np.random.default_rng(8)
    spectra = [
        whole(accelerations(rng, [mode], n, RATE, noise)[0]).band(90, 110) for _ in range(n_records)
    ]
    mean = np.mean([spectrum.periodogram for spectrum in spectra], axis=0)
    frequency, duration = spectra[0].frequency, spectra[0].duration
    fine = np.arange(1 / (8 * duration), RATE / 2, 1 / (8 * duration))
    kernel = periodogram_kernel(frequency, duration, fine)
    ratio = mean / (kernel @ density([mode], fine, noise))
    assert np.abs(ratio - 1).max() * np.sqrt(n_records) < 4.5
    naive = mean / density([mode], frequency, noise)
    assert np.abs(naive - 1).max() * np.sqrt(n_records) > 4.5


def test_kernel_rows_sum_to_one() -> None:
    """A constant density stays itself, also where the grid ends close by."""
    fine = np.arange(90.0, 110.0, 0.05)
    kernel = periodogram_kernel(np.arange(90.0, 110.0, 0.5), 2.0, fine)
    np.testing.assert_allclose(kernel.sum(axis=1), 1.0, rtol=1e-12)
    assert (kernel >= 0).all()
