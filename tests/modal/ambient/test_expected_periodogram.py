"""Mean ordinates, and the expected periodogram."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.io.log import Channel
from lmshealth.modal.ambient.expected_periodogram import (
    Kernel,
    MeanOrdinates,
    average_ordinates,
    make_kernel,
)
from lmshealth.modal.ambient.whittle import Likelihood
from tests.bands import (
    MODES,
    block_of,
    covariance,
    drawn,
    frequencies,
    likelihood,
    noisy,
    other_point,
    scatter_free,
    spectrum_of,
)
from tests.signals import Mode, Spectrum, accelerations, cut_band, density, periodogram


@pytest.mark.slow
def test_a_mean_over_segments_says_what_they_say_apart() -> None:
    """One block of means has the value and derivatives of the sum over single segments."""
    for duration in (1.0, 40.0):
        truth = likelihood(MODES[:2], 2, [])
        cov, rng = covariance(truth, truth.start, frequencies(duration)), np.random.default_rng(3)
        parts = [drawn(cov, rng) for _ in range(5)]
        matrices = [x[:, :, None] * x[:, None].conj() for x in parts]
        apart = [block_of([spectrum_of(w, duration)]) for w in matrices]
        pooled = block_of([spectrum_of(w, duration) for w in matrices])
        counted = block_of([spectrum_of(np.mean(matrices, axis=0), duration, 5)])
        assert set(counted.count) == {5.0}
        p = other_point(truth)
        one, *others = (replace(truth, blocks=b) for b in (tuple(apart), (pooled,), (counted,)))
        for other in others:
            assert other.data_value(p) == pytest.approx(one.data_value(p), rel=1e-12)
            for a, b in zip(other.derivatives(p), one.derivatives(p), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9 * np.abs(b).max())


@pytest.mark.slow
def test_averaged_neighbours_say_what_they_say_apart_where_nothing_changes() -> None:
    """Of channels that show white floors alone the mean of neighbours loses nothing."""
    one, merged = (
        replace(noisy(0, 2, 60.0), blocks=(block_of([s], merge=merge),))
        for merge in (False, True)
        for s in [spectrum_of(noisy(0, 2, 60.0).blocks[0].matrix, 60.0)]
    )
    (few,), (many,) = merged.blocks, one.blocks
    assert few.frequency.size < many.frequency.size / 5
    assert few.count.sum() == many.count.sum()
    p = one.start.copy()
    p[0] += 0.3
    p[one.layout.common] = 0.4
    assert merged.data_value(p) == pytest.approx(one.data_value(p), rel=1e-12)
    p[1] = 1.0
    assert merged.data_value(p) != pytest.approx(one.data_value(p), rel=1e-9)


@pytest.mark.parametrize(("duration", "n_segments"), [(40.0, 2), (300.0, 2), (300.0, 3)])
def test_averaging_neighbours_moves_nothing_by_a_thirtieth_of_its_uncertainty(
    duration: float, n_segments: int
) -> None:
    """On data without scatter ln f and ln ζ move by less than σ / 30, as bins require."""
    exact = scatter_free(MODES[:1], 2, duration, count=n_segments)
    (block,) = exact.blocks
    merged = block_of([spectrum_of(block.matrix, duration, n_segments)], merge=True)
    together = int(merged.count[0]) // n_segments
    assert together >= 5
    assert _shift(exact, merged) < 1 / 30
    # Negative control: four times as many neighbours move more than that.
    starts = np.arange(0, block.frequency.size, 4 * together)
    size = np.diff(np.append(starts, block.frequency.size))
    wide = MeanOrdinates(
        np.add.reduceat(block.frequency, starts) / size,
        np.asarray(np.add.reduceat(block.matrix, starts, axis=0) / size[:, None, None], complex),
        n_segments * size.astype(float),
        None,
    )
    assert _shift(exact, wide) > 1 / 30


def _shift(exact: Likelihood, block: MeanOrdinates) -> float:
    """How far off the truth the maximum is, in standard deviations."""
    target = replace(exact, blocks=(block,))
    p = target.minimise(target.start)
    std = np.sqrt(np.diag(np.linalg.inv(target.derivatives(p)[1])))
    return float(np.abs((p - target.start) / std)[:2].max())


@pytest.mark.slow
def test_a_block_forgets_what_is_masked_in_all_segments() -> None:
    """Ordinates count as often as they are kept; a short record still expects them smeared."""
    for duration in (2.0, 40.0):
        one, other = (
            spectrum_of(noisy(1, 2, duration, count).blocks[0].matrix, duration, count)
            for count in (1, 3)
        )
        keep = np.ones((2, one.frequency.size), dtype=bool)
        keep[0, 3:9] = False
        keep[1, 6:12] = False
        block = average_ordinates([one, other], list(keep), 3.15)
        kept = keep.any(axis=0)
        np.testing.assert_array_equal(block.frequency, one.frequency[kept])
        np.testing.assert_array_equal(block.count, (keep[0] + 3 * keep[1])[kept])
        np.testing.assert_allclose(block.matrix[4], other.matrix[4], rtol=1e-14)
        mean = (one.matrix[0] + 3 * other.matrix[0]) / 4
        np.testing.assert_allclose(block.matrix[0], mean, rtol=1e-12)
        assert (block.kernel is None) == (duration > 5)
        if block.kernel is not None:
            full = block_of([one])
            p = other_point(likelihood(MODES[:1], 2, []))
            some, every = (likelihood(MODES[:1], 2, [b]).expected(p)[0] for b in (block, full))
            np.testing.assert_allclose(some, every[kept], rtol=1e-9)


@pytest.mark.parametrize("duration", [2.0, 40.0])
def test_segments_masked_at_different_places_are_all_counted(duration: float) -> None:
    """One block of segments with lines of their own is as likely as a block for each."""
    truth = likelihood(MODES[:1], 2, [])
    cov, rng = covariance(truth, truth.start, frequencies(duration)), np.random.default_rng(6)
    spectra, masks = [], []
    for k in range(3):
        x = drawn(cov, rng)
        spectra.append(spectrum_of(x[:, :, None] * x[:, None].conj(), duration, k + 1))
        masks.append(np.ones(len(x), dtype=bool))
        masks[k][[5, 20 + k]] = False
    apart = [average_ordinates([s], [mask], 3.15) for s, mask in zip(spectra, masks, strict=True)]
    together = average_ordinates(spectra, masks, 3.15)
    assert together.count.size == masks[0].size - 1  # the one that all mask
    assert together.count.sum() == sum((k + 1) * masks[k].sum() for k in range(3))
    p = other_point(truth)
    one, other = (replace(truth, blocks=b) for b in (tuple(apart), (together,)))
    assert other.data_value(p) == pytest.approx(one.data_value(p), rel=1e-10)
    for a, b in zip(other.derivatives(p), one.derivatives(p), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9 * np.abs(b).max())


def test_a_mean_over_many_segments_minds_their_resolution() -> None:
    """Sure enough, a mean shows the bias of 63 half-power ordinates; the kernel takes it away."""
    single = scatter_free(MODES[:1], 1, 20.0)
    assert single.blocks[0].kernel is None
    exact = scatter_free(MODES[:1], 1, 20.0, count=100)
    (block,) = exact.blocks
    assert block.kernel is not None
    assert _shift(exact, block) < 0.02
    # Negative control: by the density itself the damping is a good part of σ too high.
    assert _shift(exact, replace(block, kernel=None)) > 0.2


RATE = 2000.0


def kernel_of(
    frequency: np.ndarray, duration: float, *, margin: int = 60, keep: np.ndarray | None = None
) -> Kernel:
    """Prepare the expectation of all ordinates, eight samples of the density each."""
    keep = np.ones(frequency.size, dtype=bool) if keep is None else keep
    return make_kernel(frequency, duration, keep, 8, margin)


def whole(values: np.ndarray) -> Spectrum:
    """Transform a record."""
    return periodogram(Channel("x", "acceleration", values), RATE)


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
        cut_band(whole(accelerations(rng, [mode], n, RATE, noise)[0]), 90, 110)
        for _ in range(n_records)
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
    """Near a resonance a million times above the floor both agree to 10⁻⁹, with gaps."""
    frequency = np.arange(low, high) / duration
    keep = np.random.default_rng(1).random(frequency.size) > 0.1
    kernel = make_kernel(frequency, duration, keep, finer, 20)
    weights = np.sinc(duration * (frequency[keep][:, None] - kernel.grid)) ** 2
    values = density([Mode(100.0, 0.002)], kernel.grid, 0.05)
    naive = weights @ values / weights.sum(axis=1)
    np.testing.assert_allclose(kernel.expect(values).real, naive, rtol=1e-9)
