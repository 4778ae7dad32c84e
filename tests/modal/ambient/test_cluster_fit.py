"""A cluster in all channels: which modes they show, which they do not, and the lines they hide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from lmshealth.modal.ambient import cluster_fit as bandfit
from lmshealth.modal.ambient.cluster_fit import (
    Band,
    BandFit,
    View,
    _dispersion,
    _flags,
    _incredible,
    fit_band,
    make_blocks,
)
from lmshealth.modal.ambient.expected_periodogram import Block
from lmshealth.modal.ambient.initial_values import (
    coarsen,
)
from lmshealth.modal.targets import Target
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectra import CrossSpectrum, Spectrum, cross_spectra
from tests.bands import PITCH, RATE, ROLL, both, fit, found, view_of
from tests.signals import Mode, accelerations, displacements, make_log, sine, white

TRUTH = np.log([105.0, 125.0, 0.015, 0.02])


def off(result: BandFit, truth: np.ndarray = TRUTH) -> np.ndarray:
    """Deviations from the truth in standard deviations."""
    return np.asarray((result.estimate - truth) / np.sqrt(np.diag(result.cov)))


def test_both_modes_are_fitted_with_their_truth_inside_four_sigma() -> None:
    """Frequency and damping of both are within 4 standard deviations of the truth."""
    result = found(both())
    assert np.abs(off(result)).max() < 4
    assert np.sqrt(np.diag(result.cov))[:2].max() < 2e-3
    assert result.best == ("acc_0", "acc_1")
    assert result.view.channels == ("acc_0", "acc_1")


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
    np.testing.assert_allclose(result.snr, truth, rtol=0.4)


def test_channels_of_different_units_are_fitted_as_one() -> None:
    """A millionth of a channel's values changes estimates by less than a hundredth of σ."""
    one = found(both())
    other = found(both() * [[1.0], [1e-6]])
    np.testing.assert_allclose(off(one), off(other), atol=1e-2)
    np.testing.assert_allclose(np.diag(other.cov), np.diag(one.cov), rtol=1e-2)


def test_a_mode_that_is_not_there_is_refused_and_the_other_kept() -> None:
    """Without excitation of pitch the fit holds roll alone, and the reason says where and why."""
    modes = [Mode(105.0, 0.015, 1.0, (1.0, 0.5))]
    result, missing = fit(
        accelerations(np.random.default_rng(2), modes, 60_000, RATE, 0.5), [ROLL, PITCH]
    )
    assert result is not None
    assert [target.name for target in result.targets] == ["roll"]
    reason, detail = missing["pitch"]
    assert reason == "not-excited"
    assert "125 Hz in any channel" in detail


def test_noise_alone_has_no_fit() -> None:
    """White noise shows none of the modes, and says so for each."""
    rng = np.random.default_rng(3)
    noise = np.array([white(rng, 1.0, 60_000, RATE) for _ in range(3)])
    result, missing = fit(noise, [ROLL, PITCH])
    assert result is None
    assert {name: reason for name, (reason, _) in missing.items()} == {
        "roll": "not-excited",
        "pitch": "not-excited",
    }


@pytest.mark.parametrize("noise", [1e-9, 1.0])
def test_a_pure_sine_is_no_mode(noise: float) -> None:
    """A sine where roll is sought is refused by name, in any noise; there is no empty success."""
    rng = np.random.default_rng(4)
    values = sine(60_000, RATE, 105.01, 30.0) + white(rng, noise, 60_000, RATE)
    result, missing = fit(values, [ROLL])
    assert result is None or result.targets == ()
    assert missing["roll"][0] in ("not-excited", "line-not-mode")


def test_a_channel_that_does_not_see_the_modes_is_left_out() -> None:
    """The view of a fit holds the channels that show any of its modes."""
    values = np.vstack([both(), white(np.random.default_rng(5), 1.0, 60_000, RATE)])
    assert found(values).view.channels == ("acc_0", "acc_1")


@pytest.mark.parametrize("seed", range(4))
def test_channels_that_hardly_see_a_mode_do_not_talk_it_away(seed: int) -> None:
    """A weak mode that one channel shows is found as well beside five that show a trace of it."""
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
    (sighting,) = dirty.lines
    assert sighting.channel == "acc_1"
    assert sighting.frequency == pytest.approx(110.0, abs=0.02)
    assert sighting.amplitude == pytest.approx(3.0, rel=0.3)
    assert np.abs((dirty.estimate - clean.estimate) / np.sqrt(np.diag(clean.cov))).max() < 1


def test_a_mode_far_from_where_it_is_sought_is_not_taken() -> None:
    """A resonance 19 % above a search of ±5 % is not reported under the sought name."""
    target = Target("roll", 105.0, 0.015, 0.05)
    modes = [Mode(125.0, 0.02, 1.0, (1.0, 1.0))]
    values = accelerations(np.random.default_rng(4), modes, 60_000, RATE, 0.5)
    result, missing = fit(values, [target])
    assert result is None or result.targets == ()
    assert set(missing) == {"roll"}


def test_too_few_ordinates_are_named_with_their_number() -> None:
    """A quarter of a second is too short even for a mode beyond doubt; its frequencies count."""
    (_, coarse), (view, _) = view_of(both()), view_of(both(n=250))
    result, missing = fit_band(view, coarse, (ROLL,))
    assert result is None
    reason, detail = missing["roll"]
    assert reason == "too-short"
    assert "needed 16" in detail


@pytest.mark.slow
def test_what_a_fit_leaves_over_is_scattered_about_one() -> None:
    """Residuals over two channels have the mean one and the variance of four real normals."""
    residual = found(both()).residual
    n = residual.frequency.size
    assert residual.count == 2
    assert abs(residual.periodogram.mean() - 1) < 4.5 / np.sqrt(2 * n)
    assert abs(residual.periodogram.var() - 0.5) < 4.5 * np.sqrt(1.25 / n)
    # Negative control: where a mode is missing, they are not.
    alone, _ = fit(both(), [Target("roll", 105.0, 0.015, 0.15)])
    assert alone is not None
    view, coarse = view_of(both())
    wide = fit_band(view, coarse, (Target("wide", 105.0, 0.04, 0.15),))[0]
    assert wide is not None
    assert wide.residual.periodogram.var() > 1.0


def test_keeping_some_modes_marginalises_the_others() -> None:
    """The covariance of what is kept is the block of the whole; the names follow."""
    result = found(both())
    kept = result.only(["pitch"])
    assert [target.name for target in kept.targets] == ["pitch"]
    np.testing.assert_array_equal(kept.estimate, result.estimate[[1, 3]])
    np.testing.assert_array_equal(kept.cov, result.cov[np.ix_([1, 3], [1, 3])])
    np.testing.assert_array_equal(kept.snr, result.snr[[1]])
    assert kept.best == ("acc_1",)


def test_the_clearer_record_has_the_higher_clarity() -> None:
    """The log likelihood a mode gains is larger where its noise is lower."""
    modes = [Mode(105.0, 0.015)]
    clear, blurred = (
        found(accelerations(np.random.default_rng(5), modes, 60_000, RATE, noise), (ROLL,))
        for noise in (0.1, 10.0)
    )
    assert clear.clarity[0] > blurred.clarity[0] > 0


def test_the_following_error_and_an_accelerometer_are_one_source_together() -> None:
    """A view of both kinds is joint; each alone keeps its own source."""
    mode = [Mode(105.0, 0.015)]
    x = displacements(np.random.default_rng(6), mode, 20_000, RATE, 1e-13)[0]
    a = accelerations(np.random.default_rng(6), mode, 20_000, RATE, 0.5)[0]
    made = make_log({"acc_a": a, "delta_e": x}, RATE).channels
    spectra = cross_spectra(made, [Segment(0, 20_000, 0.0)], RATE, 200.0)
    view = View(("acc_a", "delta_e"), ("acc", "delta_e"), spectra)
    assert view.source == "joint"
    assert [view.only([c]).source for c in range(2)] == ["acc", "delta_e"]
    assert view.only([1]).spectra[0].matrix.shape[1:] == (1, 1)
    np.testing.assert_array_equal(
        view.only([1, 0]).spectra[0].matrix[:, 0, 1], spectra[0].matrix[:, 1, 0]
    )


# Lines known beforehand, means of parts


def test_a_line_known_beforehand_is_masked() -> None:
    """Where a line is said to stand nothing is read, and it is not found once more."""
    view, coarse = view_of(both())
    told = replace(view, spectra=tuple(s.without([110.0]) for s in view.spectra))
    result, _ = fit_band(told, coarse, (ROLL, PITCH))
    clean, _ = fit_band(view, coarse, (ROLL, PITCH))
    assert result is not None
    assert clean is not None
    reach = result.residual.near(110.0)
    assert reach.stop - reach.start > 10
    assert (result.residual.periodogram[reach] == 1).all()
    assert (clean.residual.periodogram[reach] != 1).all()
    assert result.lines == ()
    assert np.abs((result.estimate - clean.estimate) / np.sqrt(np.diag(clean.cov))).max() < 0.5


def test_a_band_that_known_lines_cover_is_too_short() -> None:
    """Where lines leave nothing to fit, the mode is refused with what is left."""
    view, coarse = view_of(both())
    everywhere = np.arange(80.0, 160.0, 0.1).tolist()
    told = replace(view, spectra=tuple(s.without(everywhere) for s in view.spectra))
    result, missing = fit_band(told, coarse, (ROLL,))
    assert result is None
    assert missing["roll"][0] == "too-short"
    assert "hold no line, needed 16" in missing["roll"][1]


def mean_of(values: np.ndarray, count: int) -> CrossSpectrum:
    """Average the spectra of equal parts."""
    made = make_log({f"acc_{k}": row for k, row in enumerate(values)}, RATE).channels
    n = values.shape[1] // count
    parts = [
        cross_spectra(made, [Segment(k * n, (k + 1) * n, float("nan"))], RATE, 200.0)[0]
        for k in range(count)
    ]
    mean = np.mean([part.matrix for part in parts], axis=0)
    return replace(parts[0], matrix=mean, count=count)


def fit_mean(
    spectrum: CrossSpectrum,
    targets: Sequence[Target] = (ROLL, PITCH),
    ends: tuple[float, float] = (75.0, 165.0),
) -> BandFit:
    """Fit targets to one spectrum; all must be found."""
    n = spectrum.matrix.shape[1]
    view = View(tuple(f"acc_{k}" for k in range(n)), ("acc",) * n, (spectrum,))
    coarse = tuple(coarsen(view.single(c), *ends, 0.8) for c in range(n))
    result, missing = fit_band(view, coarse, tuple(targets))
    assert result is not None
    assert missing == {}
    return result


@pytest.mark.slow
def test_the_mean_of_parts_is_as_sure_as_the_whole_record() -> None:
    """Ten parts of 20 s averaged have their truth within 4σ, and the σ of 200 s within a tenth."""
    values = both(seed=7, n=200_000)
    whole, mean = fit_mean(mean_of(values, 1)), fit_mean(mean_of(values, 10))
    assert np.abs(off(mean)).max() < 4
    std = np.sqrt(np.diag(mean.cov))
    np.testing.assert_allclose(std, np.sqrt(np.diag(whole.cov)), rtol=0.1)
    # Negative control: taken for a single record it would be three times less sure.
    once = fit_mean(replace(mean_of(values, 10), count=1))
    assert (np.sqrt(np.diag(once.cov)) > 2 * std).all()


@pytest.mark.slow
def test_the_mean_of_parts_shows_lines_that_none_of_them_shows() -> None:
    """A line six times above the noise of a part is masked in the mean of ten, noise never is."""
    clean = both(seed=8, n=200_000)
    level, _ = mean_of(clean, 10).channel(0).density(113.0, 115.0)
    dirty = clean + [[1.0], [0.0]] * sine(200_000, RATE, 114.0, float(np.sqrt(2 * 6 * level / 20)))
    assert fit_mean(mean_of(clean, 10)).lines == ()
    (sighting,) = fit_mean(mean_of(dirty, 10)).lines
    assert sighting.channel == "acc_0"
    assert sighting.frequency == pytest.approx(114.0, abs=0.1)
    # Negative control: by the threshold of a single record it would not be seen.
    assert fit_mean(replace(mean_of(dirty, 10), count=1)).lines == ()


@pytest.mark.slow
def test_what_a_fit_of_a_sure_mean_lacks_is_no_line() -> None:
    """A mode that nobody looks for is left over for the search, and not masked as lines."""
    modes = [Mode(105.0, 0.015), Mode(112.0, 0.01, 0.05)]
    values = accelerations(np.random.default_rng(10), modes, 1_200_000, RATE, 0.5)
    result = fit_mean(mean_of(values, 60), (ROLL,), (90.0, 120.0))
    assert result.residual.band(111.0, 113.0).periodogram.max() > 2
    assert result.lines == ()


def test_a_stretch_too_short_for_the_band_does_no_harm() -> None:
    """A segment of six samples beside a record leaves the fit as it is."""
    view, coarse = view_of(both())
    made = make_log({f"acc_{k}": row for k, row in enumerate(both(n=6))}, RATE).channels
    tiny = cross_spectra(made, [Segment(0, 6, float("nan"))], RATE, 200.0)
    alone, _ = fit_band(view, coarse, (ROLL, PITCH))
    more = replace(view, spectra=(*view.spectra, *tiny))
    beside, _ = fit_band(more, coarse, (ROLL, PITCH))
    assert alone is not None
    assert beside is not None
    np.testing.assert_allclose(beside.estimate, alone.estimate, atol=1e-9)


@pytest.mark.parametrize(("nominal", "reason"), [(None, "line-not-mode"), (105.0, None)])
def test_a_peak_as_narrow_as_mains_is_no_mode_unless_sought(
    nominal: float | None, reason: str | None
) -> None:
    """Of ζ = 0.03 % a resonance cannot be told from a line that wanders, though it is resolved."""
    mode = Mode(105.0, 0.0003)
    view, _ = view_of(accelerations(np.random.default_rng(9), [mode], 400_000, RATE, 0.5))
    coarse = (coarsen(view.single(0), 103.0, 107.0, 0.02),)
    target = Target("roll", 105.0, 0.0005, 0.02, nominal=nominal)
    result, missing = fit_band(view, coarse, (target,))
    assert result is not None
    assert [t.name for t in result.targets] == ([] if reason else ["roll"])
    assert reason is None or missing["roll"][0] == reason


def test_a_mode_narrower_than_a_record_resolves_is_a_line() -> None:
    """A half-power bandwidth of 0.95 Fourier frequencies is not believed, one of 1.05 is."""
    result = found(both())
    width = 2 * np.exp(result.estimate[0] + result.estimate[2])
    why = _incredible(result, 0, 0.95 / width)
    assert why is not None
    assert why[0] == "line-not-mode"
    assert "is narrower" in why[1]
    assert _incredible(result, 0, 1.05 / width) is None


@pytest.mark.parametrize(("damping", "again"), [(0.015, False), (0.004, True)])
def test_bins_are_as_fine_as_the_resonance_that_is_found(
    monkeypatch: pytest.MonkeyPatch, damping: float, again: bool
) -> None:
    """One much narrower than sought is binned anew, by its own width; one as sought is not."""
    widths: list[float] = []

    def spy(band: Band, width: float, near: Sequence[float] | None = None) -> tuple[Block, ...]:
        if near is not None:
            widths.append(width)
        return make_blocks(band, width, near)

    monkeypatch.setattr(bandfit, "make_blocks", spy)
    values = accelerations(np.random.default_rng(1), [Mode(105.0, damping)], 60_000, RATE, 0.5)
    found(values, (ROLL,))
    assert len(widths) == 1 + again
    assert widths[-1] == pytest.approx(2 * damping * 105.0, rel=0.3)


# How well the model fits, and what to bear in mind


def residual(values: np.ndarray, count: int = 1) -> Spectrum:
    """Wrap what a fit leaves over, of 50 s from 95 to 115 Hz."""
    frequency = np.arange(95 * 50, 115 * 50) / 50
    return Spectrum(frequency, values, 50.0, float("nan"), count)


def scatter(seed: int, count: int = 1) -> np.ndarray:
    """Draw means of so many exponential variables, one for each ordinate."""
    return np.random.default_rng(seed).exponential(size=(1000, count)).mean(axis=1)


F, ZETA = np.array([105.0]), np.array([0.02])


@pytest.mark.parametrize("count", [1, 12])
def test_dispersion_of_noise_is_about_one(count: int) -> None:
    """Whatever the number of records and channels, over 100 residuals within 4.5 errors."""
    values = [_dispersion(residual(scatter(k, count), count), F, ZETA)[0] for k in range(100)]
    # Within ±4.2 Hz stand 419 ordinates; the fourth moment of an exponential is 9.
    error = np.sqrt((2 + 6 / count) / (100 * 419))
    assert abs(np.mean(values) - 1) < 4.5 * error
    # Negative control: with the count forgotten it is not.
    wrong = _dispersion(residual(scatter(0, 12)), F, ZETA)[0]
    assert wrong < 0.2


def test_dispersion_is_that_of_what_stands_near_the_mode_and_is_not_masked() -> None:
    """What is further away, or masked as a line, does not count; twice the scatter does."""
    values = scatter(1)
    noise = residual(values)
    near = np.abs(noise.frequency - 105.0) < 2 * 0.02 * 105.0
    (plain,) = _dispersion(noise, F, ZETA)
    assert plain == pytest.approx(np.mean((values[near] - 1) ** 2), rel=1e-12)
    far = np.where(near, values, 50.0)
    assert _dispersion(residual(far), F, ZETA)[0] == plain
    masked = values.copy()
    masked[near.nonzero()[0][::2]] = 1.0
    kept = near & (masked != 1.0)
    (rest,) = _dispersion(residual(masked), F, ZETA)
    assert rest == pytest.approx(np.mean((values[kept] - 1) ** 2), rel=1e-12)
    (loose,) = _dispersion(residual(1 + 2 * (values - 1)), F, ZETA)
    assert loose == pytest.approx(4 * plain, rel=1e-12)


def test_too_few_ordinates_tell_no_dispersion() -> None:
    """Thirty about a mode say something, 28 do not; each mode is judged by itself."""
    left = residual(scatter(2))
    wide, narrow = _dispersion(left, np.array([100.0, 110.0]), np.array([0.02, 5e-4]))
    assert np.isfinite(wide)
    assert np.isnan(narrow)
    between = np.array([105.01])  # half way between two ordinates, 0.02 Hz apart
    for reach, enough in ((0.291, True), (0.289, False)):
        assert np.isfinite(_dispersion(left, between, reach / (2 * between))[0]) == enough


def flags(result: BandFit) -> list[list[str]]:
    """List the flags of both modes."""
    values = zip(*np.exp(result.estimate).reshape(2, -1), result.dispersion, strict=True)
    (duration,) = (spectrum.duration for spectrum in result.view.spectra)
    return [
        _flags(target, *value, duration).split()
        for target, value in zip(result.targets, values, strict=True)
    ]


def test_a_good_fit_has_no_flags() -> None:
    """A record of a minute that shows both modes as described leaves nothing to bear in mind."""
    result = found(both())
    assert result.flags == ("", "")
    assert (result.dispersion > 0.7).all()
    assert (result.dispersion < 1.4).all()


def test_flags_say_what_a_reading_lacks() -> None:
    """Each of them is raised by its own reason, for its own mode, and together."""
    result = found(both())
    (spectrum,) = result.view.spectra
    # Half-power bandwidths of 3.15 and 5 Hz: a second holds 3.15 and 5 ordinates.
    short = replace(result, view=replace(result.view, spectra=(replace(spectrum, duration=1.0),)))
    assert flags(short) == [["resolution-limited"], []]
    assert flags(replace(result, dispersion=np.array([np.nan, 1.6]))) == [[], ["loose-fit"]]
    far, heavy = TRUTH.copy(), TRUTH.copy()
    far[0] += 0.95 * np.log1p(0.15)
    heavy[3] = np.log(0.02 * 5.8)
    assert flags(replace(result, estimate=far)) == [["at-bound"], []]
    assert flags(replace(result, estimate=heavy)) == [[], ["at-bound"]]
    worst = replace(short, estimate=far, dispersion=np.array([2.0, 1.0]))
    assert flags(worst) == [["resolution-limited", "at-bound", "loose-fit"], []]
    # What was sought counts, not where the search of this log began.
    moved = tuple(
        replace(t, frequency=1.14 * t.frequency, nominal=t.frequency) for t in (ROLL, PITCH)
    )
    assert flags(replace(result, targets=tuple(moved))) == [[], []]


@pytest.mark.slow
def test_a_mode_under_a_line_that_is_too_unsteady_to_be_told_is_refused() -> None:
    """A line that wanders by 0.3 Hz about roll is no noise: roll is refused, pitch is not."""
    t = np.arange(60_000) / RATE
    phase = 2 * np.pi * np.cumsum(105 + 0.3 * np.sin(2 * np.pi * t / 17)) / RATE
    result, missing = fit(both() + 10.0 * np.sin(phase), [ROLL, PITCH])
    assert result is not None
    assert [target.name for target in result.targets] == ["pitch"]
    assert np.abs(off(result, TRUTH[[1, 3]])).max() < 4
    reason, detail = missing["roll"]
    assert reason == "poor-fit"
    assert "times as much as noise" in detail
    # As faint as a third of that it is told, and the reading is only said to be loose.
    faint, missing = fit(both() + 5.0 * np.sin(phase), [ROLL, PITCH])
    assert faint is not None
    assert missing == {}
    assert faint.flags == ("loose-fit", "")
