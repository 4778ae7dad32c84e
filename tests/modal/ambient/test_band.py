"""The band of a cluster: its channels, their units, and the lines that are masked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from lmshealth.modal.ambient.cluster_fit import (
    Band,
    View,
    alike,
    find_sightings,
    make_blocks,
    mask_lines,
    mask_towers,
    prepare,
    sign,
)
from lmshealth.modal.ambient.initial_values import (
    coarsen,
)
from lmshealth.modal.targets import Target
from lmshealth.signal.spectra import CrossSpectrum
from tests.signals import Mode

ROLL = Target("roll", 105.0, 0.015, 0.15)
SECONDS, LOW, HIGH = 60.0, 80.0, 130.0
SHAPE = np.array([1.0, -0.5, 0.0])


def spectrum(
    seed: int, lines: Sequence[tuple[int, int, float]] = (), *, psd: float = 1.0, count: int = 1
) -> CrossSpectrum:
    """Draw ordinates of a mode in three channels of noise 0.5; lines stand at (k, channel, F)."""
    rng = np.random.default_rng(seed)
    frequency = np.arange(LOW * SECONDS, HIGH * SECONDS) / SECONDS
    matrix = np.zeros((frequency.size, 3, 3), dtype=complex)
    for _ in range(count):
        force, *noise = (
            (rng.standard_normal(frequency.size) + 1j * rng.standard_normal(frequency.size))
            / np.sqrt(2)
            for _ in range(4)
        )
        moved = np.sqrt(psd) * Mode(105.0, 0.015).response(frequency) * force
        x = np.outer(moved, SHAPE) + np.sqrt(0.5) * np.array(noise).T
        for k, channel, size in lines:
            x[k, channel] += size
        matrix += x[:, :, None] * x[:, None].conj() / count
    free = np.ones(frequency.size, dtype=bool)
    return CrossSpectrum(frequency, matrix, SECONDS, 0.2, free, (), count)


def band_of(*spectra: CrossSpectrum) -> Band:
    """Prepare the band of roll."""
    view = View(("acc_a", "acc_b", "acc_c"), ("acc",) * 3, spectra)
    coarse = tuple(coarsen(view.single(c), LOW, HIGH, 0.8) for c in range(3))
    return prepare(view, coarse, (ROLL,))


def test_channels_that_see_the_mode_are_kept_in_units_of_their_noise() -> None:
    """The third channel sees nothing and is left out; the floors of the others are about one."""
    band = band_of(spectrum(1))
    assert band.view.channels == ("acc_a", "acc_b")
    np.testing.assert_allclose(band.unit, np.sqrt(0.5), rtol=0.5)
    far = band.view.band(125.0, 130.0).spectra[0]
    model = np.outer(band.unit, band.unit) * far.matrix.mean(axis=0).real
    tail = np.mean(np.abs(Mode(105.0, 0.015).response(far.frequency)) ** 2)
    expected = tail * SHAPE[:2] ** 2 + 0.5
    np.testing.assert_allclose(np.diag(model), expected, rtol=4.5 / np.sqrt(300))


def test_where_none_sees_it_the_best_channel_is_kept() -> None:
    """Noise alone leaves one channel, so that there is something to refuse."""
    assert len(band_of(spectrum(2, psd=0.0)).view.channels) == 1


def test_noise_and_resonance_are_no_lines() -> None:
    """Of 30 bands of noise with a resonance none loses an ordinate: a thousandth would."""
    for seed in range(30):
        band = band_of(spectrum(seed))
        mask_towers(band)
        assert all(mask.all() for mask in band.masks)


@pytest.mark.parametrize("channel", [0, 1])
def test_a_tower_in_any_channel_is_masked_with_its_foot_and_read(channel: int) -> None:
    """A line in one of the channels takes five ordinates from all, and is told with its size."""
    k, size = 2500, 30.0
    band = band_of(spectrum(3, [(k, channel, size)]))
    mask_towers(band)
    np.testing.assert_array_equal(np.flatnonzero(~band.masks[0]), np.arange(k - 2, k + 3))
    (sighting,) = find_sightings(band)
    assert sighting.channel == ("acc_a", "acc_b")[channel]
    assert sighting.frequency == pytest.approx(LOW + k / SECONDS)
    # Σ I = A² T / 2.
    assert sighting.amplitude == pytest.approx(size * np.sqrt(2 / SECONDS), rel=0.1)
    (block,) = make_blocks(band, 3.15)
    assert block.frequency.size == band.masks[0].size - 5


@pytest.mark.parametrize(("count", "size"), [(1, 30.0), (8, 11.0)])
def test_what_a_fit_does_not_expect_is_masked_and_what_it_does_is_not(
    count: int, size: float
) -> None:
    """Lines are judged by the expected matrix; of a mean of several the scatter is smaller."""
    band = band_of(spectrum(4, [(2500, 0, size)], count=count))
    f = band.view.spectra[0].frequency
    modal = np.abs(Mode(105.0, 0.015).response(f)) ** 2
    expected = np.outer(SHAPE, SHAPE) * modal[:, None, None] + 0.5 * np.eye(3)
    expected = expected[:, :2, :2] / np.outer(band.unit, band.unit) + 0j
    assert mask_lines(band, [expected + 1e3 * np.eye(2)]) is False
    assert mask_lines(band, [expected])
    np.testing.assert_array_equal(np.flatnonzero(~band.masks[0]), np.arange(2498, 2503))
    assert mask_lines(band, [expected]) is False


@pytest.mark.parametrize(("apart", "masked"), [(6, 0.0), (12, 5 / 12)])
def test_towers_are_masked_unless_they_are_most_of_the_band(apart: int, masked: float) -> None:
    """Five of every twelve ordinates are masked as lines; where it would be five of six, none."""
    band = band_of(spectrum(5, [(k, 0, 300.0) for k in range(0, 3000, apart)]))
    mask_towers(band)
    assert 1 - band.masks[0].mean() == pytest.approx(masked, abs=2e-3)


def test_a_line_that_moves_is_masked_in_each_segment_where_it_stands() -> None:
    """Masks are of segments; the block counts what is kept of each."""
    parts = [spectrum(6 + i, [(2200 + 200 * i, 0, 60.0)]) for i in range(3)]
    band = band_of(*parts)
    mask_towers(band)
    for i, mask in enumerate(band.masks):
        assert not mask[2198 + 200 * i : 2203 + 200 * i].any()
        assert mask.sum() == mask.size - 5
    (block,) = make_blocks(band, 3.15)
    assert block.count.sum() == 3 * (3000 - 5)
    assert set(block.count) == {2.0, 3.0}


def test_segments_of_one_length_make_one_block() -> None:
    """Spectra are grouped by their frequencies, in whatever order they come."""
    long = spectrum(9)
    short = replace(long.band(LOW, 100.0), duration=30.0)
    assert alike([long, short, long]) == [[0, 2], [1]]


def test_shapes_start_with_the_sign_that_channels_have() -> None:
    """Where the mode stands the second channel moves against the first."""
    blocks = make_blocks(band_of(spectrum(10)), 3.15)
    assert [sign(blocks, ROLL, c, 0) for c in range(2)] == [1.0, -1.0]
