"""A cluster in all channels: which modes they show, which they do not, and the lines they hide."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from lmshealth.band import View
from lmshealth.bandfit import BandFit, fit_band
from lmshealth.segments import Segment
from lmshealth.spectra import cross_spectra
from lmshealth.starts import Coarse, Target, coarsen
from tests.signals import Mode, accelerations, displacements, make_log, sine, white

RATE = 1000.0
ROLL, PITCH = Target("roll", 105.0, 0.015, 0.15), Target("pitch", 125.0, 0.02, 0.15)
TRUTH = np.log([105.0, 125.0, 0.015, 0.02])


def view_of(channels: np.ndarray) -> tuple[View, tuple[Coarse, ...]]:
    """Transform accelerometers, and bin them around the modes of these tests."""
    rows = np.atleast_2d(channels)
    made = make_log({f"acc_{k}": row for k, row in enumerate(rows)}, RATE).channels
    view = View(
        tuple(channel.name for channel in made),
        ("acc",) * len(made),
        cross_spectra(made, [Segment(0, rows.shape[1], float("nan"))], RATE, 200.0),
    )
    return view, tuple(coarsen(view.single(c), 75.0, 165.0, 0.8) for c in range(len(made)))


def fit(
    channels: np.ndarray, targets: Sequence[Target]
) -> tuple[BandFit | None, dict[str, tuple[str, str]]]:
    """Fit targets to the samples of accelerometers."""
    view, coarse = view_of(channels)
    return fit_band(view, coarse, tuple(targets))


def found(channels: np.ndarray, targets: Sequence[Target] = (ROLL, PITCH)) -> BandFit:
    """Fit targets of which all must be found."""
    result, missing = fit(channels, targets)
    assert result is not None
    assert missing == {}
    return result


def both(seed: int = 1, n: int = 60_000, noise: float = 0.5, psd: float = 1.0) -> np.ndarray:
    """Give two channels that show both modes, each of them one better."""
    modes = [Mode(105.0, 0.015, psd, (1.0, -0.3)), Mode(125.0, 0.02, psd, (0.4, 1.0))]
    return accelerations(np.random.default_rng(seed), modes, n, RATE, noise)


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
