"""The likelihood of a band: its derivatives, its density, its invariances and its maximum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from lmshealth.spectra import Spectrum
from lmshealth.whittle import Block, Likelihood, make_block
from tests.signals import Mode, density, expected_spectrum

MODES = (Mode(105.0, 0.015, 1.0), Mode(120.0, 0.02, 2.0), Mode(135.0, 0.025, 1.5))
NOISE = 0.01
BAND = (80.0, 170.0)


def everything(spectrum: Spectrum) -> np.ndarray:
    """Keep all ordinates."""
    return np.ones(spectrum.frequency.size, dtype=bool)


def likelihood(
    modes: Sequence[Mode], blocks: Sequence[Block], off: float = 0.0, noise: float = NOISE
) -> Likelihood:
    """Build a likelihood whose start is off the truth by a share ``off`` of every unknown."""
    m = len(modes)
    start = np.concatenate(
        [
            np.log([mode.frequency * (1 + 0.03 * off) for mode in modes]),
            np.log([mode.damping * (1 + 0.5 * off) for mode in modes]),
            np.ones(m),
            np.zeros(m - 1),
            [np.log(noise) + off, 0.0],
        ]
    )
    return Likelihood(
        blocks=tuple(blocks),
        start=start,
        belief=np.repeat([0.2, 2.0], m),
        scale=np.sqrt([mode.psd * (1 + off) for mode in modes]),
        centre=float(np.sqrt(BAND[0] * BAND[1])),
        spread=float(np.log(BAND[1] / BAND[0]) / 2),
    )


def noisy_blocks(modes: Sequence[Mode], duration: float, n: int = 1) -> list[Block]:
    """Make blocks of exponential ordinates; short durations come with their kernel."""
    rng = np.random.default_rng(11)
    spectrum = expected_spectrum(modes, duration, *BAND, NOISE)
    blocks = []
    for _ in range(n):
        drawn = spectrum.periodogram * rng.exponential(size=spectrum.frequency.size)
        noisy = replace(spectrum, periodogram=drawn)
        width = min(2 * mode.frequency * mode.damping for mode in modes)
        blocks.append(make_block([noisy], [everything(noisy)], width))
    return blocks


@pytest.mark.parametrize("count", [1.0, 7.0])
@pytest.mark.parametrize("duration", [2.0, 20.0])
@pytest.mark.parametrize("m", [1, 2, 3])
def test_derivatives_are_those_of_the_value(m: int, duration: float, count: float) -> None:
    """Gradient and Hessian agree with central differences, with the kernel and without."""
    modes = MODES[:m]
    blocks = [replace(b, count=count * b.count) for b in noisy_blocks(modes, duration)]
    target = likelihood(modes, blocks)
    assert (target.blocks[0].kernel is not None) == (duration < 5)
    p = target.start + np.random.default_rng(m).normal(0, 0.1, target.start.size)
    p[:m] = target.start[:m] + 0.01
    gradient, hessian = target.derivatives(p)
    step = 1e-5 * np.eye(p.size)
    by_value = [(target.value(p + h) - target.value(p - h)) / 2e-5 for h in step]
    by_gradient = [
        (target.derivatives(p + h)[0] - target.derivatives(p - h)[0]) / 2e-5 for h in step
    ]
    np.testing.assert_allclose(gradient, by_value, atol=2e-6 * np.abs(gradient).max())
    size = np.sqrt(np.outer(np.diag(hessian), np.diag(hessian)).clip(1.0))
    np.testing.assert_allclose(hessian / size, np.array(by_gradient) / size, atol=1e-6)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-12, atol=1e-12 * np.abs(hessian).max())
    # Negative control: the comparison notices one entry that is off by a thousandth.
    wrong = hessian / size
    wrong[0, 0] *= 1.001
    assert not np.allclose(wrong, np.array(by_gradient) / size, rtol=0, atol=1e-6)


def test_density_of_one_mode_is_the_textbook_resonance() -> None:
    """One mode has S / ((1 - β²)² + (2ζβ)²) + S_e, β = f_n / f."""
    (block,) = noisy_blocks(MODES[:1], 20.0)
    target = likelihood(MODES[:1], [block])
    (found,) = target.expected(target.start)
    beta, zeta = 105.0 / block.frequency, 0.015
    np.testing.assert_allclose(
        found, 1.0 / ((1 - beta**2) ** 2 + (2 * zeta * beta) ** 2) + NOISE, rtol=1e-12
    )


def test_density_of_coherent_forces_adds_amplitudes_before_squaring() -> None:
    """The first force drives two modes as |a h₁ + b h₂|², the second the second mode alone."""
    modes = MODES[:2]
    (block,) = noisy_blocks(modes, 20.0)
    target = likelihood(modes, [block])
    p = target.start.copy()
    a, c, b = 0.8, 0.5, -1.7  # a_11, a_22, a_21 in units of the scale
    p[4:7] = a, c, b
    p[-1] = 0.4
    h = [mode.response(block.frequency) * np.sqrt(mode.psd) for mode in modes]
    u = np.log(block.frequency / target.centre) / target.spread
    noise = NOISE * np.exp(0.4 * u)
    truth = np.abs(a * h[0] + b * h[1]) ** 2 + np.abs(c * h[1]) ** 2 + noise
    np.testing.assert_allclose(target.expected(p)[0], truth, rtol=1e-12)
    # Negative control: powers added without interference are something else.
    apart = np.abs(a * h[0]) ** 2 + np.abs(b * h[1]) ** 2 + np.abs(c * h[1]) ** 2 + noise
    assert np.abs(apart / truth - 1).max() > 0.1


def test_the_expected_periodogram_is_the_kernel_times_the_density() -> None:
    """A short block expects the density smeared by its kernel on its own ordinates."""
    spectrum = expected_spectrum(MODES[:1], 2.0, *BAND, NOISE)
    block = make_block([spectrum], [everything(spectrum)], 2 * 105.0 * 0.015)
    assert block.kernel is not None
    target = likelihood(MODES[:1], [block])
    weights = np.sinc(2.0 * (spectrum.frequency[:, None] - block.frequency)) ** 2
    smeared = weights @ density(MODES[:1], block.frequency, NOISE) / weights.sum(axis=1)
    np.testing.assert_allclose(target.expected(target.start)[0], smeared, rtol=1e-12)


def test_a_block_forgets_what_is_masked() -> None:
    """Masked ordinates are in neither kind of block; the density is still smeared across them."""
    for duration in (2.0, 20.0):
        spectrum = expected_spectrum(MODES[:1], duration, *BAND, NOISE)
        keep = everything(spectrum)
        keep[3:9] = False
        block = make_block([spectrum], [keep], 3.15)
        np.testing.assert_array_equal(block.periodogram, spectrum.periodogram[keep])
        if block.kernel is None:
            np.testing.assert_array_equal(block.frequency, spectrum.frequency[keep])
        else:
            np.testing.assert_allclose(
                block.frequency[block.kernel.place], spectrum.frequency[keep], rtol=1e-12
            )


@pytest.mark.parametrize("duration", [2.0, 200.0])
def test_the_mean_of_parts_is_as_likely_as_all_of_them(duration: float) -> None:
    """Value, gradient and Hessian of a mean are the sums over its parts, to 10⁻¹⁰."""
    modes, rng = MODES[:2], np.random.default_rng(5)
    spectrum = expected_spectrum(modes, duration, *BAND, NOISE)
    drawn = spectrum.periodogram * rng.exponential(size=(6, spectrum.frequency.size))
    singles = [replace(spectrum, periodogram=row) for row in drawn]
    mean = replace(spectrum, periodogram=drawn.mean(axis=0), count=6)
    keep = everything(spectrum)
    apart = likelihood(modes, [make_block([single], [keep], 3.15) for single in singles])
    together = likelihood(modes, [make_block([mean], [keep], 3.15)])
    in_one_block = likelihood(modes, [make_block(singles, [keep] * 6, 3.15)])
    for off in (-0.05, 0.1):
        p = apart.start + off
        for other in (together, in_one_block):
            assert other.value(p) == pytest.approx(apart.value(p), rel=1e-10)
            for one, same in zip(apart.derivatives(p), other.derivatives(p), strict=True):
                np.testing.assert_allclose(same, one, rtol=1e-10, atol=1e-10 * np.abs(one).max())
    # Negative control: counted once, the mean says something else.
    once = likelihood(modes, [make_block([replace(mean, count=1)], [keep], 3.15)])
    assert once.value(p) != pytest.approx(apart.value(p), rel=1e-3)


@pytest.mark.parametrize("duration", [2.0, 20.0])
def test_parts_masked_at_different_places_are_all_counted(duration: float) -> None:
    """One block of parts with lines of their own is as likely as a block for each."""
    modes, rng = MODES[:1], np.random.default_rng(6)
    spectrum = expected_spectrum(modes, duration, *BAND, NOISE)
    singles, masks = [], []
    for k in range(3):
        drawn = spectrum.periodogram * rng.exponential(size=spectrum.frequency.size)
        singles.append(replace(spectrum, periodogram=drawn, count=k + 1))
        masks.append(everything(spectrum))
        masks[k][[5, 20 + k]] = False
    apart = likelihood(
        modes, [make_block([s], [mask], 3.15) for s, mask in zip(singles, masks, strict=True)]
    )
    together = likelihood(modes, [make_block(singles, masks, 3.15)])
    p = apart.start + 0.02
    assert together.value(p) == pytest.approx(apart.value(p), rel=1e-10)
    np.testing.assert_allclose(together.derivatives(p)[1], apart.derivatives(p)[1], rtol=1e-9)
    (block,) = together.blocks
    assert block.count.size == spectrum.frequency.size - 1  # the one that all mask
    assert block.count.sum() == sum((k + 1) * masks[k].sum() for k in range(3))


def test_the_covariance_shrinks_with_the_number_of_parts() -> None:
    """On scatter-free data the information of a mean over n parts is n times that of one."""
    spectrum = expected_spectrum(MODES[:1], 200.0, *BAND, NOISE)
    information = []
    for count in (1, 10):
        block = make_block([replace(spectrum, count=count)], [everything(spectrum)], 3.15)
        target = likelihood(MODES[:1], [block])
        hessian = target.derivatives(target.start)[1]
        information.append(hessian - np.diag(1 / target.prior_std**2))
    np.testing.assert_allclose(information[1], 10 * information[0], rtol=1e-9, atol=1e-9)


def test_a_mean_over_many_parts_minds_their_resolution() -> None:
    """Sure enough, a mean shows the bias of 63 half-power ordinates; the kernel takes it away."""
    single = expected_spectrum(MODES[:1], 20.0, *BAND, NOISE)
    mean = replace(single, count=100)
    keep = everything(single)
    assert make_block([single], [keep], 3.15).kernel is None
    block = make_block([mean], [keep], 3.15)
    assert block.kernel is not None
    smeared = block.kernel.expect(density(MODES[:1], block.frequency, NOISE))
    plain = Block(mean.frequency, smeared, None, block.count)
    off = []
    for one in (replace(block, periodogram=smeared), plain):
        target = likelihood(MODES[:1], [one])
        p = target.minimise(target.start)
        std = np.sqrt(np.linalg.inv(target.derivatives(p)[1])[1, 1])
        off.append((p[1] - np.log(0.015)) / std)
    assert abs(off[0]) < 0.02
    # Negative control: by the density itself the damping is a good part of σ too high.
    assert off[1] > 0.2


def long_block(seed: int) -> Block:
    """Make a block that holds 1200 ordinates in a half-power bandwidth."""
    spectrum = expected_spectrum(MODES[:1], 400.0, *BAND, NOISE)
    scatter = np.random.default_rng(seed).exponential(size=spectrum.frequency.size)
    noisy = replace(spectrum, periodogram=spectrum.periodogram * scatter)
    keep = everything(spectrum)
    keep[9000:9050] = False
    return make_block([noisy], [keep], 2 * 105.0 * 0.015)


def test_neighbours_that_are_alike_are_only_a_start() -> None:
    """A long block is searched on means, and its maximum is that of all its ordinates."""
    for seed in range(3):
        block = long_block(seed)
        thin = block.thinned()
        assert thin.count.size < block.count.size / 15
        assert thin.count.sum() == block.count.sum()
        assert thin.count @ thin.periodogram == pytest.approx(block.periodogram.sum(), rel=1e-12)
        quick = likelihood(MODES[:1], [block], 0.3)
        slow = likelihood(MODES[:1], [replace(block, alike=1)], 0.3)
        p, q = quick.minimise(quick.start), slow.minimise(slow.start)
        std = np.sqrt(np.diag(np.linalg.inv(slow.derivatives(q)[1])))
        assert np.abs((p - q) / std).max() < 1e-4
        # Negative control: the means alone are not as good.
        rough = replace(slow, blocks=(thin,)).minimise(slow.start)
        assert np.abs((rough - q) / std).max() > 1e-4


def test_blocks_of_few_ordinates_are_not_thinned() -> None:
    """Where a resonance is only some hundred ordinates wide, or not resolved, all of them count."""
    for duration in (2.0, 20.0):
        (block,) = noisy_blocks(MODES[:1], duration)
        assert block.thinned() is block


def test_the_order_of_segments_does_not_matter() -> None:
    """Permuted segments give the same value, gradient and maximum."""
    blocks = noisy_blocks(MODES[:2], 3.0, n=4)
    one, other = likelihood(MODES[:2], blocks, 0.3), likelihood(MODES[:2], blocks[::-1], 0.3)
    assert one.value(one.start) == pytest.approx(other.value(other.start), rel=1e-13)
    np.testing.assert_allclose(one.minimise(one.start), other.minimise(other.start), atol=1e-7)


def test_scaled_data_move_nothing_but_amplitudes() -> None:
    """Data times 10⁶ with starts scaled alike give the same f, ζ, curvature and amplitudes."""
    blocks = noisy_blocks(MODES[:2], 8.0)
    one = likelihood(MODES[:2], blocks, 0.2)
    loud = [replace(block, periodogram=1e6 * block.periodogram) for block in blocks]
    start = one.start.copy()
    start[-2] += np.log(1e6)
    other = replace(one, blocks=tuple(loud), start=start, scale=1e3 * one.scale)
    p, q = one.minimise(one.start), other.minimise(start)
    q[-2] -= np.log(1e6)
    np.testing.assert_allclose(p, q, atol=1e-7)
    q[-2] += np.log(1e6)
    np.testing.assert_allclose(one.derivatives(p)[1], other.derivatives(q)[1], rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("duration", [1.5, 30.0])
@pytest.mark.parametrize("m", [1, 2, 3])
def test_the_maximum_on_scatter_free_data_is_the_truth(m: int, duration: float) -> None:
    """On expected data f is found to 10⁻⁴ and ζ to 2 % from a start 3 % and 50 % off."""
    modes = MODES[:m]
    spectrum = expected_spectrum(modes, duration, *BAND, NOISE)
    width = min(2 * mode.frequency * mode.damping for mode in modes)
    block = make_block([spectrum], [everything(spectrum)], width)
    if block.kernel is not None:
        smeared = block.kernel.expect(density(modes, block.frequency, NOISE))
        block = replace(block, periodogram=smeared)
    off = 0.4 if m > 1 else 1.0
    target = likelihood(modes, [block] * 8, off)
    p = target.minimise(target.start)
    np.testing.assert_allclose(p[:m], np.log([mode.frequency for mode in modes]), atol=1e-4)
    np.testing.assert_allclose(p[m : 2 * m], np.log([mode.damping for mode in modes]), atol=0.02)


def test_without_the_kernel_a_short_record_reads_too_much_damping() -> None:
    """Negative control: plain Whittle on smeared data is off by more than 5 % in ζ."""
    spectrum = expected_spectrum(MODES[:1], 1.5, *BAND, NOISE)
    block = make_block([spectrum], [everything(spectrum)], 3.15)
    assert block.kernel is not None
    smeared = block.kernel.expect(density(MODES[:1], block.frequency, NOISE))
    plain = Block(spectrum.frequency, smeared, None, block.count)
    target = likelihood(MODES[:1], [plain] * 8)
    assert np.exp(target.minimise(target.start)[1]) > 1.05 * 0.015


def test_a_belief_pulls_as_a_normal_prior() -> None:
    """The value is the misfit of the data plus half the squared distance in beliefs."""
    weak = likelihood(MODES[:1], noisy_blocks(MODES[:1], 20.0))
    sure = replace(weak, belief=np.array([1e-4, 1e-3]))
    p = weak.start.copy()
    p[:2] += 3e-4, 2e-3
    assert sure.value(p) - sure.data_value(p) == pytest.approx((3**2 + 2**2) / 2, rel=1e-6)
    assert weak.data_value(p) == sure.data_value(p)
    start = sure.start.copy()
    found = sure.minimise(start)
    assert np.abs(found[:2] - start[:2]).max() < 1e-3


def test_nonsense_is_infinitely_unlikely_not_an_error() -> None:
    """Unknowns that overflow have the value inf, so that a search turns back."""
    target = likelihood(MODES[:1], noisy_blocks(MODES[:1], 20.0))
    p = target.start.copy()
    p[-2] = 2000.0
    assert target.value(p) == np.inf
