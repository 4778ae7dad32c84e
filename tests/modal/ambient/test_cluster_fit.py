"""Fit of a cluster: its data, masks of lines, modes that are present, and lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from lmshealth._private.arrays import ComplexArray
from lmshealth.modal import constants
from lmshealth.modal.ambient import cluster_fit
from lmshealth.modal.ambient.cluster_fit import (
    ClusterData,
    group_lengths,
    make_blocks,
    mask_residual_lines,
    masked_ordinates,
    prepare,
    read_line,
)
from lmshealth.modal.ambient.cluster_modes import ClusterModes
from lmshealth.modal.ambient.expected_periodogram import MeanOrdinates
from lmshealth.modal.ambient.whittle import Likelihood
from lmshealth.modal.identification import identify
from lmshealth.modal.targets import Target
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra, cross_spectra
from studies.modes.described.worlds import case
from studies.modes.without_description.worlds import Machine, log_of, record, shapes_of
from tests.bands import (
    PITCH,
    RATE,
    ROLL,
    as_if_white,
    both,
    fit,
    fit_spectra,
    found,
    spectra_of,
    with_mean,
)
from tests.signals import (
    Mode,
    Spectrum,
    accelerations,
    cut_band,
    displacements,
    make_log,
    make_stage,
    mean_ordinate,
    of_channel,
    sine,
    white,
)

TRUTH = np.log([105.0, 125.0, 0.015, 0.02])


def off(result: ClusterModes, truth: np.ndarray = TRUTH) -> np.ndarray:
    """Deviations from the truth in standard deviations."""
    return np.asarray((result.modes.estimate - truth) / np.sqrt(np.diag(result.modes.cov)))


def test_both_modes_are_fitted_with_their_truth_inside_four_sigma() -> None:
    """Frequency and damping of both are within 4 standard deviations of the truth."""
    result = found(both())
    assert np.abs(off(result)).max() < 4
    assert np.sqrt(np.diag(result.modes.cov))[:2].max() < 2e-3
    assert result.modes.channels == ("acc_0", "acc_1")
    assert result.modes.shape_channels == ("acc_0", "acc_1")


@pytest.mark.slow
def test_forces_that_modes_share_leave_the_truth_inside_four_sigma() -> None:
    """One force through both modes in two channels: they interfere, in size and in phase."""
    deviations = []
    for seed in range(6):
        # The same seed makes the same force.
        values = sum(
            accelerations(np.random.default_rng(seed), [mode], 60_000, RATE, 0.0)
            for mode in (Mode(112.0, 0.015, 1.0, (1.0, -0.3)), Mode(118.0, 0.02, 1.0, (0.4, 1.0)))
        )
        rng = np.random.default_rng(100 + seed)
        values = values + np.array([white(rng, 0.5, 60_000, RATE) for _ in range(2)])
        targets = (Target("roll", 112.0, 0.015, 0.1), Target("pitch", 118.0, 0.02, 0.1))
        deviations.append(off(found(values, targets), np.log([112.0, 118.0, 0.015, 0.02])))
    assert np.abs(deviations).max() < 4
    # 24 squares of about unit variance: 2.1 is passed once in a thousand times.
    assert np.mean(np.square(deviations)) < 2.1


@pytest.mark.slow
def test_a_floor_that_shares_the_force_of_the_mode_leaves_the_truth_inside_four_sigma() -> None:
    """A rigid body on the force of the mode interferes with it: f and ζ stay within 4σ."""
    deviations = []
    for seed in range(6):
        values = sum(
            accelerations(np.random.default_rng(seed), [mode], 60_000, RATE, 0.0)
            for mode in (Mode(105.0, 0.015, 1.0, (1.0, 0.5)), Mode(0.5, 0.5, 9.0, (1.0, -1.0)))
        )
        rng = np.random.default_rng(100 + seed)
        values = values + np.array([white(rng, 0.5, 60_000, RATE) for _ in range(2)])
        deviations.append(off(found(values, (ROLL,)), np.log([105.0, 0.015])))
    assert np.abs(deviations).max() < 4
    # 12 squares of about unit variance: 2.75 is passed once in a thousand times.
    assert np.mean(np.square(deviations)) < 2.75


def test_snr_is_the_modal_signal_to_noise_ratio_of_all_channels() -> None:
    """Σ S φ² / (4 ζ² S_e) is found within 40 % where the noise shows between the modes."""
    result = found(both(6, noise=20.0))
    truth = [Mode(105.0, 0.015).snr(20.0) * 1.09, Mode(125.0, 0.02).snr(20.0) * 1.16]
    np.testing.assert_allclose(result.modes.snr, truth, rtol=0.4)


def test_channels_of_different_units_are_fitted_as_one() -> None:
    """A millionth of a channel's values changes estimates by less than a hundredth of σ."""
    one = found(both())
    other = found(both() * [[1.0], [1e-6]])
    np.testing.assert_allclose(off(one), off(other), atol=1e-2)
    np.testing.assert_allclose(np.diag(other.modes.cov), np.diag(one.modes.cov), rtol=1e-2)


def test_a_channel_that_does_not_see_the_modes_is_left_out() -> None:
    """The spectra of a fit holds the channels that show any of its modes."""
    values = np.vstack([both(), white(np.random.default_rng(5), 1.0, 60_000, RATE)])
    assert found(values).modes.shape_channels == ("acc_0", "acc_1")


@pytest.mark.parametrize("seed", range(4))
def test_channels_that_hardly_show_a_mode_do_not_hide_it(seed: int) -> None:
    """A weak mode that one channel shows is found as well with five that show a trace of it."""
    shape = (1.0, *(0.4,) * 5)
    mode = Mode(105.0, 0.015, 0.0016, shape)
    values = accelerations(np.random.default_rng(seed), [mode], 60_000, RATE, 1.0)
    alone, _ = fit(values[:1], [ROLL])
    together, _ = fit(values, [ROLL])
    assert alone is not None
    assert together is not None


def test_a_line_is_kept_out_and_listed_with_its_amplitude() -> None:
    """A line on the flank of a mode is masked; it does not move the modes by a deviation."""
    clean = found(both())
    line = sine(60_000, RATE, 110.0, 3.0)
    dirty = found(both() + [[0.0], [1.0]] * line)
    assert clean.lines == ()
    (listed,) = dirty.lines
    assert listed.channel == "acc_1"
    assert listed.frequency == pytest.approx(110.0, abs=0.02)
    assert listed.amplitude == pytest.approx(3.0, rel=0.3)
    assert (
        np.abs(
            (dirty.modes.estimate - clean.modes.estimate) / np.sqrt(np.diag(clean.modes.cov))
        ).max()
        < 1
    )


def test_too_few_ordinates_are_named_with_their_number() -> None:
    """A quarter of a second is too short even for a mode beyond doubt; its frequencies count."""
    spectra = spectra_of(both(n=250))
    result, rejected = fit_spectra(spectra, (ROLL,))
    assert result is None
    reason, detail, *_ = rejected["roll"]
    assert reason == "too-short"
    assert "needed 16" in detail


def residual_of(found: ClusterModes) -> Spectrum:
    """Return the ordinates over their expectation, tr E⁻¹ W / n of n channels, and 1 at lines."""
    fitted = found.fitted
    ratio = np.nan_to_num(fitted.residual, nan=1.0)
    return Spectrum(fitted.spectrum.frequency, ratio, fitted.spectrum.duration, fitted.count)


@pytest.mark.slow
def test_what_a_fit_leaves_over_is_scattered_about_one() -> None:
    """Residuals over two channels have the mean one and the variance of four real normals."""
    residual = residual_of(found(both()))
    n = residual.frequency.size
    assert residual.count == 2
    assert abs(residual.periodogram.mean() - 1) < 4.5 / np.sqrt(2 * n)
    assert abs(residual.periodogram.var() - 0.5) < 4.5 * np.sqrt(1.25 / n)
    # Negative control: where a mode is rejected, they are not.
    alone, _ = fit(both(), [Target("roll", 105.0, 0.015, 0.15)])
    assert alone is not None
    spectra = spectra_of(both())
    wide = fit_spectra(spectra, (Target("wide", 105.0, 0.04, 0.15),))[0]
    assert wide is not None
    assert residual_of(wide).periodogram.var() - 0.5 > 4.5 * np.sqrt(1.25 / n)


def test_keeping_some_modes_marginalises_the_others() -> None:
    """The covariance of what is kept is the block of the whole; the names follow."""
    result = found(both())
    kept = result.keep(["pitch"])
    assert list(kept.names) == ["pitch"]
    np.testing.assert_array_equal(kept.modes.estimate, result.modes.estimate[[1, 3]])
    np.testing.assert_array_equal(kept.modes.cov, result.modes.cov[np.ix_([1, 3], [1, 3])])
    np.testing.assert_array_equal(kept.modes.snr, result.modes.snr[[1]])
    assert kept.modes.channels == ("acc_1",)


def test_the_clearer_record_has_the_higher_clarity() -> None:
    """The log likelihood a mode gains is larger where its noise is lower."""
    modes = [Mode(105.0, 0.015)]
    clear, blurred = (
        found(accelerations(np.random.default_rng(5), modes, 60_000, RATE, noise), (ROLL,))
        for noise in (0.1, 10.0)
    )
    assert clear.clarity[0] > blurred.clarity[0] > 0


def test_the_following_error_and_an_accelerometer_are_one_source_together() -> None:
    """Spectra of both kinds are joint; each alone keeps its own source."""
    mode = [Mode(105.0, 0.015)]
    x = displacements(np.random.default_rng(6), mode, 20_000, RATE, 1e-13)[0]
    a = accelerations(np.random.default_rng(6), mode, 20_000, RATE, 0.5)[0]
    made = make_log({"acc_a": a, "delta_e": x}, RATE).channels
    (cross,) = cross_spectra(made, [Segment(0, 20_000, 0.0)], RATE, 200.0)
    spectra = LogSpectra(("acc_a", "delta_e"), ("acc", "delta_e"), (cross,))
    assert spectra.source == "joint"
    assert [LogSpectra((), (source,), ()).source for source in spectra.sources] == [
        "acc",
        "delta_e",
    ]


# Lines known beforehand, means of parts


def test_a_line_known_beforehand_is_masked() -> None:
    """Ordinates of a known line are excluded, and it is not listed again."""
    spectra = spectra_of(both())
    excluded = spectra.each(lambda spectrum: spectrum.without([110.0]))
    result, _ = fit_spectra(excluded, (ROLL, PITCH))
    clean, _ = fit_spectra(spectra, (ROLL, PITCH))
    assert result is not None
    assert clean is not None
    masked = residual_of(result)
    reach = (masked.frequency >= 109.89) & (masked.frequency < 110.11)
    assert reach.sum() > 10
    assert (masked.periodogram[reach] == 1).all()
    assert (residual_of(clean).periodogram[reach] != 1).all()
    assert result.lines == ()
    assert (
        np.abs(
            (result.modes.estimate - clean.modes.estimate) / np.sqrt(np.diag(clean.modes.cov))
        ).max()
        < 0.5
    )


def test_a_band_that_known_lines_cover_is_too_short() -> None:
    """Where lines leave nothing to fit, the mode is refused with what is left."""
    spectra = spectra_of(both())
    everywhere = np.arange(80.0, 160.0, 0.1).tolist()
    excluded = spectra.each(lambda spectrum: spectrum.without(everywhere))
    result, rejected = fit_spectra(excluded, (ROLL,))
    assert result is None
    assert rejected["roll"][0] == "too-short"
    assert "hold no line, needed 16" in rejected["roll"][1]


def mean_of(values: np.ndarray, count: int) -> CrossSpectrum:
    """Average the spectra of equal parts."""
    made = make_log({f"acc_{k}": row for k, row in enumerate(values)}, RATE).channels
    n = values.shape[1] // count
    parts = [
        cross_spectra(made, [Segment(k * n, (k + 1) * n, float("nan"))], RATE, 200.0)[0]
        for k in range(count)
    ]
    return replace(parts[0], transforms=np.concatenate([part.transforms for part in parts]))


def of_count(mean: CrossSpectrum, count: int) -> CrossSpectrum:
    """Return the same mean as that of another number of segments."""
    return replace(mean, transforms=with_mean(mean.matrix, count))


def fit_mean(
    spectrum: CrossSpectrum,
    targets: Sequence[Target] = (ROLL, PITCH),
) -> ClusterModes:
    """Fit targets to one spectrum; all must be found."""
    n = spectrum.matrix.shape[1]
    spectra = LogSpectra(tuple(f"acc_{k}" for k in range(n)), ("acc",) * n, (spectrum,))
    result, rejected = fit_spectra(spectra, tuple(targets))
    assert result is not None
    assert rejected == {}
    return result


@pytest.mark.slow
def test_the_mean_of_parts_is_as_sure_as_the_whole_record(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten parts of 20 s averaged have their truth within 4σ, and the σ of 200 s within a tenth.

    Of forces that are taken as white: what one record shows of their colour is chance.
    """
    monkeypatch.setattr(cluster_fit, "average_colours", as_if_white)
    values = both(seed=7, n=200_000)
    whole, mean = fit_mean(mean_of(values, 1)), fit_mean(mean_of(values, 10))
    assert np.abs(off(mean)).max() < 4
    std = np.sqrt(np.diag(mean.modes.cov))
    np.testing.assert_allclose(std, np.sqrt(np.diag(whole.modes.cov)), rtol=0.1)
    # Negative control: taken for two records it would be √5 times less sure.
    few = fit_mean(of_count(mean_of(values, 10), 2))
    assert (np.sqrt(np.diag(few.modes.cov)) > 1.8 * std).all()


@pytest.mark.slow
def test_the_mean_of_parts_shows_lines_that_none_of_them_shows() -> None:
    """A line six times above the noise of a part is masked in the mean of ten, noise never is."""
    clean = both(seed=8, n=200_000)
    level, _ = mean_ordinate(of_channel(mean_of(clean, 10)), 113.0, 115.0)
    dirty = clean + [[1.0], [0.0]] * sine(200_000, RATE, 114.0, float(np.sqrt(2 * 6 * level / 20)))
    assert fit_mean(mean_of(clean, 10)).lines == ()
    (line,) = fit_mean(mean_of(dirty, 10)).lines
    assert line.channel == "acc_0"
    assert line.frequency == pytest.approx(114.0, abs=0.1)
    # Negative control: by the threshold of two records it would not be seen.
    assert fit_mean(of_count(mean_of(dirty, 10), 2)).lines == ()


@pytest.mark.slow
def test_what_a_fit_of_a_sure_mean_lacks_is_no_line() -> None:
    """A mode that is no target remains in the residual, and is not masked as lines."""
    modes = [Mode(105.0, 0.015), Mode(112.0, 0.01, 0.05)]
    values = accelerations(np.random.default_rng(10), modes, 1_200_000, RATE, 0.5)
    result = fit_mean(mean_of(values, 60), (ROLL,))
    assert cut_band(residual_of(result), 111.0, 113.0).periodogram.max() > 1.7
    assert result.lines == ()


def test_a_stretch_too_short_for_the_band_does_no_harm() -> None:
    """A further segment of six samples does not change the fit."""
    spectra = spectra_of(both())
    made = make_log({f"acc_{k}": row for k, row in enumerate(both(n=6))}, RATE).channels
    tiny = cross_spectra(made, [Segment(0, 6, float("nan"))], RATE, 200.0)
    alone, _ = fit_spectra(spectra, (ROLL, PITCH))
    more = replace(spectra, spectra=(*spectra.spectra, *tiny))
    extended, _ = fit_spectra(more, (ROLL, PITCH))
    assert alone is not None
    assert extended is not None
    np.testing.assert_allclose(extended.modes.estimate, alone.modes.estimate, atol=1e-9)


@pytest.mark.parametrize(("narrow", "reason"), [(False, "line-not-mode"), (True, None)])
def test_a_peak_as_narrow_as_mains_is_no_mode_unless_described(
    narrow: bool, reason: str | None
) -> None:
    """A resolved resonance of ζ = 0.03 % cannot be distinguished from a wandering line."""
    mode = Mode(105.0, 0.0003)
    spectra = spectra_of(accelerations(np.random.default_rng(9), [mode], 400_000, RATE, 0.5))
    target = Target("roll", 105.0, 0.0005, 0.02, narrow=narrow)
    result, rejected = fit_spectra(spectra, (target,))
    assert result is not None
    assert list(result.names) == ([] if reason else ["roll"])
    assert reason is None or rejected["roll"][0] == reason


@pytest.mark.parametrize(("damping", "again"), [(0.015, False), (0.004, True)])
def test_bins_are_as_fine_as_the_resonance_that_is_found(
    monkeypatch: pytest.MonkeyPatch, damping: float, again: bool
) -> None:
    """Bins are refined for a mode much narrower than expected, and only then."""
    widths: list[float] = []

    def spy(
        band: ClusterData, width: float, near: Sequence[float] | None = None
    ) -> tuple[MeanOrdinates, ...]:
        if near is not None:
            widths.append(width)
        return make_blocks(band, width, near)

    monkeypatch.setattr(cluster_fit, "make_blocks", spy)
    values = accelerations(np.random.default_rng(1), [Mode(105.0, damping)], 60_000, RATE, 0.5)
    found(values, (ROLL,))
    assert len(widths) == 1 + again
    assert widths[-1] == pytest.approx(2 * damping * 105.0, rel=0.3)


SECONDS, LOW, HIGH = 60.0, 80.0, 130.0
SHAPE = np.array([1.0, -0.5, 0.0])


def spectrum(
    seed: int, lines: Sequence[tuple[int, int, float]] = (), *, psd: float = 1.0, count: int = 1
) -> CrossSpectrum:
    """Draw ordinates of a mode in three channels of noise 0.5; lines stand at (k, channel, F)."""
    rng = np.random.default_rng(seed)
    frequency = np.arange(LOW * SECONDS, HIGH * SECONDS) / SECONDS
    transforms = np.zeros((count, frequency.size, 3), dtype=complex)
    for x in transforms:
        force, *noise = (
            (rng.standard_normal(frequency.size) + 1j * rng.standard_normal(frequency.size))
            / np.sqrt(2)
            for _ in range(4)
        )
        moved = np.sqrt(psd) * Mode(105.0, 0.015).response(frequency) * force
        x += np.outer(moved, SHAPE) + np.sqrt(0.5) * np.array(noise).T
        for k, channel, size in lines:
            x[k, channel] += size
    free = np.ones(frequency.size, dtype=bool)
    return CrossSpectrum(frequency, transforms, SECONDS, 0.2, free)


def band_of(*spectra: CrossSpectrum, strength: float = 1.0) -> ClusterData:
    """Prepare the band of roll."""
    log = LogSpectra(("acc_a", "acc_b", "acc_c"), ("acc",) * 3, spectra)
    roll = replace(ROLL, amplitude=np.asarray(strength * np.array(SHAPE), dtype=np.complex128))
    return prepare(log, (roll,), (LOW, HIGH), np.full(3, 0.5))


def expectations(band: ClusterData) -> list[ComplexArray]:
    """Return the true expectations of the spectra of the band of roll."""
    found = []
    for one in band.spectra.spectra:
        modal = np.abs(Mode(105.0, 0.015).response(one.frequency)) ** 2
        expected = np.outer(SHAPE, SHAPE) * modal[:, None, None] + 0.5 * np.eye(3)
        scaled = expected[:, :2, :2] / np.outer(band.unit, band.unit)
        found.append(np.asarray(scaled, dtype=np.complex128))
    return found


def test_a_pole_that_a_line_narrows_does_not_make_all_bins_fine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Mains on the flank of a mode: bins of its start (control) cost five times the work."""
    one = case("mains in the band of a mode", 15)
    spectra = spectra_of(one.samples.T).each(lambda spectrum: spectrum.without([150.0]))
    starts = zip(one.declared, (0.012, 0.012, 0.002), strict=True)
    targets = [Target(f"m{k}", f, zeta, 0.1) for k, (f, zeta) in enumerate(starts)]
    plain, work = Likelihood.derivatives, [0]

    def derivatives(self: Likelihood, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        work[0] += sum(block.grid.size for block in self.blocks)
        return plain(self, p)

    monkeypatch.setattr(Likelihood, "derivatives", derivatives)
    (found, _), coarse = fit_spectra(spectra, targets), work[0]
    assert found is not None
    np.testing.assert_allclose(found.modes.frequency, one.frequency, rtol=0.005)
    monkeypatch.setattr(cluster_fit, "_FINER", constants.SIMILAR_BANDWIDTH)
    fit_spectra(spectra, targets)
    assert work[0] - coarse > 5 * coarse


def test_channels_that_see_the_mode_are_kept_in_units_of_their_noise() -> None:
    """The third channel sees nothing and is left out; the floors of the others are about one."""
    band = band_of(spectrum(1))
    assert band.spectra.channels == ("acc_a", "acc_b")
    np.testing.assert_allclose(band.unit, np.sqrt(0.5), rtol=0.5)
    far = band.spectra.spectra[0].band(125.0, 130.0)
    model = np.outer(band.unit, band.unit) * far.matrix.mean(axis=0).real
    tail = np.mean(np.abs(Mode(105.0, 0.015).response(far.frequency)) ** 2)
    expected = tail * SHAPE[:2] ** 2 + 0.5
    np.testing.assert_allclose(np.diag(model), expected, rtol=4.5 / np.sqrt(300))


def test_where_none_sees_it_the_best_channel_is_kept() -> None:
    """Noise alone leaves one channel, so that there is something to refuse."""
    assert len(band_of(spectrum(2, psd=0.0), strength=1e-6).spectra.channels) == 1


def test_noise_and_resonance_are_no_lines() -> None:
    """Of 30 bands of noise with a resonance none loses an ordinate: a thousandth would."""
    for seed in range(30):
        band = band_of(spectrum(seed))
        band = mask_residual_lines(band, expectations(band))
        assert all(mask.all() for mask in band.masks)


@pytest.mark.parametrize("channel", [0, 1])
def test_a_line_in_any_channel_is_masked_with_its_neighbours_and_read(channel: int) -> None:
    """A line in one channel masks five ordinates of all, and is listed with its amplitude."""
    k, size = 2500, 30.0
    band = band_of(spectrum(3, [(k, channel, size)]))
    band = mask_residual_lines(band, expectations(band))
    np.testing.assert_array_equal(np.flatnonzero(~band.masks[0]), np.arange(k - 2, k + 3))
    (ordinates,) = masked_ordinates(band)
    line = read_line(band, *ordinates)
    assert line.channel == ("acc_a", "acc_b")[channel]
    assert line.frequency == pytest.approx(LOW + k / SECONDS)
    # Σ I = A² T / 2.
    assert line.amplitude == pytest.approx(size * np.sqrt(2 / SECONDS), rel=0.1)
    (block,) = make_blocks(band, 3.15)
    assert block.frequency.size == band.masks[0].size - 5


@pytest.mark.parametrize(("count", "size"), [(1, 30.0), (8, 11.0)])
def test_what_a_fit_does_not_expect_is_masked_and_what_it_does_is_not(
    count: int, size: float
) -> None:
    """Lines are judged by the expected matrix; of a mean of several the scatter is smaller."""
    band = band_of(spectrum(4, [(2500, 0, size)], count=count))
    (expected,) = expectations(band)
    raised = np.asarray(expected + 1e3 * np.eye(2), dtype=np.complex128)
    assert mask_residual_lines(band, [raised]) is band
    masked = mask_residual_lines(band, [expected])
    np.testing.assert_array_equal(np.flatnonzero(~masked.masks[0]), np.arange(2498, 2503))
    assert mask_residual_lines(masked, [expected]) is masked


@pytest.mark.parametrize(("apart", "masked"), [(6, 0.0), (12, 5 / 12)])
def test_lines_are_masked_unless_they_are_most_of_the_band(apart: int, masked: float) -> None:
    """Five of every twelve ordinates are masked as lines; where it would be five of six, none."""
    band = band_of(spectrum(5, [(k, 0, 300.0) for k in range(0, 3000, apart)]))
    band = mask_residual_lines(band, expectations(band))
    assert 1 - band.masks[0].mean() == pytest.approx(masked, abs=2e-3)


def test_a_line_that_moves_is_masked_in_each_segment_where_it_stands() -> None:
    """Masks are of segments; the block counts what is kept of each."""
    parts = [spectrum(6 + i, [(2200 + 200 * i, 0, 60.0)]) for i in range(3)]
    band = band_of(*parts)
    band = mask_residual_lines(band, expectations(band))
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
    assert group_lengths([long, short, long]) == [[0, 2], [1]]


@pytest.mark.parametrize("seen", [0.9, 0.3])
def test_directions_leave_most_of_a_mode_beside_a_strong_harmonic(
    seen: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A harmonic nearly at a right angle to a mode hides it in half of the band (0.3: control)."""
    monkeypatch.setattr(cluster_fit, "_SEEN", seen)
    phi, v = np.zeros((2, 6))
    phi[0], v[:2] = 1.0, np.array([0.1, np.sqrt(0.99)])
    n = 300
    foreign = np.zeros((n, 6, 1), dtype=complex)
    foreign[: n // 2, :, 0] = 300 * v
    transforms = np.ones((1, n, 6), dtype=complex)
    free = np.ones(n, dtype=bool)
    f = np.linspace(90.0, 110.0, n)
    spectrum = CrossSpectrum(f, transforms, 15.0, 0.1, free, foreign=foreign)
    names = tuple("abcdef")
    basis = cluster_fit._directions(
        phi[:, None].astype(complex), LogSpectra(names, ("acc",) * 6, (spectrum,))
    )
    share = cluster_fit._seen(basis, phi[:, None], foreign).ravel()
    assert basis.shape[1] == (2 if seen == 0.9 else 1)
    assert share[n // 2 :].min() > 0.95
    assert (share[: n // 2].min() > 0.9) == (seen == 0.9)


def test_a_pole_that_becomes_a_line_leaves_no_part_of_it() -> None:
    """Means of ordinates show only where about a line is: it is masked where it is strongest."""
    c = case("mains in the band of a mode", 15)
    log = make_log({f"acc_{k}": row.copy() for k, row in enumerate(c.samples.T)}, c.sample_rate)
    modes = [(f"m{k}", f, 0.012) for k, f in zip(c.described, c.declared, strict=True)]
    found = identify(log, make_stage(modes))
    assert found.names == ("m0", "m1", "m2")
    error = np.abs(found.frequency - c.frequency) / found.frequency_std
    assert error.max() < 3


@pytest.mark.parametrize("seed", [3, 4])
def test_modes_far_above_floors_that_one_direction_shows_are_found(seed: int) -> None:
    """Four sensors with floors 80 dB below the modes: the search takes more than 100 steps."""
    r, f = np.random.default_rng(seed), np.array([117.0, 131.0, 148.0])
    machine = Machine(
        f, np.array([0.012, 0.015, 0.01]), np.full(3, 1e8), shapes_of(r, 4, 3), shared=0.0,
        band=(90.0, 185.0),
    )  # fmt: skip
    log = log_of(record(r, "low floors", machine, 1000.0, 20.0))
    found = identify(log, make_stage([(f"m{k}", 1.004 * x, 0.012) for k, x in enumerate(f)]))
    assert found.names == ("m0", "m1", "m2")
    assert (np.abs(found.frequency - f) / found.frequency_std).max() < 4
