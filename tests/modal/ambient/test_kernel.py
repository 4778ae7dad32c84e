"""The expected periodogram: its kernel, and what a record has on average."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.io.log import Channel
from lmshealth.modal.ambient.expected_periodogram import Kernel, make_kernel
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectra import Spectrum, periodogram
from tests.signals import Mode, accelerations, density

RATE = 2000.0


def kernel_of(
    frequency: np.ndarray, duration: float, *, margin: int = 60, keep: np.ndarray | None = None
) -> Kernel:
    """Prepare the expectation of all ordinates, eight samples of the density each."""
    spectrum = Spectrum(frequency.copy(), np.ones(frequency.size), duration, float("nan"))
    keep = np.ones(frequency.size, dtype=bool) if keep is None else keep
    return make_kernel(spectrum, keep, 8, margin)


def whole(values: np.ndarray) -> Spectrum:
    """Transform a record."""
    segment = Segment(0, values.size, float("nan"))
    return periodogram(Channel("x", "acceleration", values), segment, RATE)


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
    kernel = kernel_of(frequency, duration)
    smeared = kernel.expect(density([mode], kernel.grid, noise)).real
    np.testing.assert_allclose(smeared, oracle, rtol=5e-3)
    # Negative control: the density itself is no such expectation.
    bias = density([mode], frequency, noise) / oracle - 1
    assert np.abs(bias).max() > 0.1


@pytest.mark.slow
def test_short_records_average_to_the_expected_periodogram() -> None:
    """The mean periodogram of 400 short records is the kernel's within 4.5 standard errors."""
    mode, noise, n, n_records = Mode(100.0, 0.01), 0.5, 4000, 400
    rng = np.random.default_rng(8)
    spectra = [
        whole(accelerations(rng, [mode], n, RATE, noise)[0]).band(90, 110) for _ in range(n_records)
    ]
    mean = np.mean([spectrum.periodogram for spectrum in spectra], axis=0)
    frequency, duration = spectra[0].frequency, spectra[0].duration
    kernel = kernel_of(frequency, duration)
    ratio = mean / kernel.expect(density([mode], kernel.grid, noise)).real
    assert np.abs(ratio - 1).max() * np.sqrt(n_records) < 4.5
    naive = mean / density([mode], frequency, noise)
    assert np.abs(naive - 1).max() * np.sqrt(n_records) > 4.5


@pytest.mark.parametrize("margin", [2, 40])
def test_a_constant_density_stays_itself(margin: int) -> None:
    """Weights of every ordinate add up to one, also where the grid ends close by."""
    kernel = kernel_of(np.arange(90.0, 110.0, 0.5), 2.0, margin=margin)
    np.testing.assert_allclose(kernel.expect(np.ones(kernel.grid.size)), 1.0, rtol=1e-12)


def test_spreading_is_the_transpose_of_expecting() -> None:
    """⟨a, K b⟩ = ⟨Kᵀ a, b⟩ for complex arrays of several axes, with ordinates left out."""
    keep = np.arange(40) % 7 != 3
    kernel = kernel_of(np.arange(90.0, 110.0, 0.5), 2.0, keep=keep)
    rng = np.random.default_rng(13)
    a, b = (
        rng.standard_normal((3, 3, n)) + 1j * rng.standard_normal((3, 3, n))
        for n in (int(keep.sum()), kernel.grid.size)
    )
    left = np.sum(a * kernel.expect(b), axis=-1)
    right = np.sum(kernel.spread(a) * b, axis=-1)
    np.testing.assert_allclose(left, right, rtol=1e-11)


def test_the_kernel_is_the_fejer_kernel_on_its_grid() -> None:
    """Row by row it is T sinc²(T (f - f')), normalised."""
    frequency = np.arange(90.0, 110.0, 0.5)
    kernel = kernel_of(frequency, 2.0)
    rows = kernel.expect(np.eye(kernel.grid.size)).real.T
    naive = np.sinc(2.0 * (frequency[:, None] - kernel.grid)) ** 2
    np.testing.assert_allclose(rows, naive / naive.sum(axis=1, keepdims=True), atol=1e-13)


@pytest.mark.parametrize(
    ("low", "high", "duration", "finer"),
    [(3, 60, 0.67, 12), (300, 420, 3.0, 5), (5560, 7645, 69.5, 2)],
)
def test_the_transform_is_as_exact_as_the_sum(
    low: int, high: int, duration: float, finer: int
) -> None:
    """Beside a resonance a million times above the floor both agree to 10⁻⁹, with gaps."""
    frequency = np.arange(low, high) / duration
    keep = np.random.default_rng(1).random(frequency.size) > 0.1
    spectrum = Spectrum(frequency, np.ones(frequency.size), duration, float("nan"))
    kernel = make_kernel(spectrum, keep, finer, 20)
    weights = np.sinc(duration * (frequency[keep][:, None] - kernel.grid)) ** 2
    values = density([Mode(100.0, 0.002)], kernel.grid, 0.05)
    naive = weights @ values / weights.sum(axis=1)
    np.testing.assert_allclose(kernel.expect(values).real, naive, rtol=1e-9)
