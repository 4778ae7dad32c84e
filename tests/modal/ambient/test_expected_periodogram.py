"""Blocks: what averaging over segments and neighbours keeps, and what is masked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.modal.ambient.expected_periodogram import Block, make_block
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


@pytest.mark.parametrize(("duration", "n_segments"), [(40.0, 1), (300.0, 1), (300.0, 3)])
def test_averaging_neighbours_moves_nothing_by_a_thirtieth_of_its_uncertainty(
    duration: float, n_segments: int
) -> None:
    """On data without scatter ln f and ln ζ move by less than σ / 30, as the rule of bins says."""
    exact = scatter_free(MODES[:1], 2, duration, count=n_segments)
    (block,) = exact.blocks
    merged = block_of([spectrum_of(block.matrix, duration, n_segments)], merge=True)
    together = int(merged.count[0]) // n_segments
    assert together >= 5
    assert _shift(exact, merged) < 1 / 30
    # Negative control: four times as many neighbours move more than that.
    starts = np.arange(0, block.frequency.size, 4 * together)
    size = np.diff(np.append(starts, block.frequency.size))
    wide = Block(
        np.add.reduceat(block.frequency, starts) / size,
        np.add.reduceat(block.matrix, starts, axis=0) / size[:, None, None],
        n_segments * size.astype(float),
        None,
    )
    assert _shift(exact, wide) > 1 / 30


def _shift(exact: Likelihood, block: Block) -> float:
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
        block = make_block([one, other], list(keep), 3.15)
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
    apart = [make_block([s], [mask], 3.15) for s, mask in zip(spectra, masks, strict=True)]
    together = make_block(spectra, masks, 3.15)
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
