"""A cluster in one channel: which modes it shows, which it does not, and the lines it hides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from lmshealth.bandfit import BandFit, _mask_towers, fit_band
from lmshealth.segments import Segment
from lmshealth.spectra import Spectrum, View, periodogram
from lmshealth.starts import Coarse, Target, coarsen
from tests.signals import Mode, accelerations, make_log, sine, white

RATE = 1000.0
ROLL, PITCH = Target("roll", 105.0, 0.015, 0.15), Target("pitch", 125.0, 0.02, 0.15)


def view_of(values: np.ndarray) -> tuple[View, Coarse]:
    """Transform a channel, and bin it around the modes of these tests."""
    (channel,) = make_log({"acc_a": values}, RATE).channels
    spectra = (periodogram(channel, Segment(0, values.size, float("nan")), RATE),)
    return View("acc_a", "acc", spectra), coarsen(spectra, 75.0, 165.0, 0.8)


def fit(
    values: np.ndarray, targets: Sequence[Target]
) -> tuple[BandFit | None, dict[str, tuple[str, str]]]:
    """Fit targets to the samples of a channel."""
    view, coarse = view_of(values)
    return fit_band(view, coarse, tuple(targets))


def both(seed: int = 1, n: int = 60_000) -> np.ndarray:
    """Give a channel that shows both modes."""
    modes = [Mode(105.0, 0.015), Mode(125.0, 0.02)]
    return accelerations(np.random.default_rng(seed), modes, n, RATE, 0.5)[0]


def test_both_modes_are_fitted_with_their_truth_inside_four_sigma() -> None:
    """Frequency and damping of both are within 4 standard deviations of the truth."""
    found, missing = fit(both(), [ROLL, PITCH])
    assert found is not None
    assert missing == {}
    truth = np.log([105.0, 125.0, 0.015, 0.02])
    off = (found.estimate - truth) / np.sqrt(np.diag(found.cov))
    assert np.abs(off).max() < 4
    assert np.sqrt(np.diag(found.cov))[:2].max() < 2e-3


def test_snr_is_the_modal_signal_to_noise_ratio() -> None:
    """S / (4 ζ² S_e) is found within 40 % where the noise shows between the modes."""
    modes = [Mode(105.0, 0.015), Mode(125.0, 0.02)]
    found, _ = fit(
        accelerations(np.random.default_rng(6), modes, 60_000, RATE, 20.0)[0], [ROLL, PITCH]
    )
    assert found is not None
    np.testing.assert_allclose(found.snr, [mode.snr(20.0) for mode in modes], rtol=0.4)


def test_a_mode_that_is_not_there_is_refused_and_the_other_kept() -> None:
    """Without excitation of pitch the fit holds roll alone, and the reason names both facts."""
    values = accelerations(np.random.default_rng(2), [Mode(105.0, 0.015)], 60_000, RATE, 0.5)[0]
    found, missing = fit(values, [ROLL, PITCH])
    assert found is not None
    assert [target.name for target in found.targets] == ["roll"]
    reason, detail = missing["pitch"]
    assert reason == "not-excited"
    assert "acc_a" in detail
    assert "125 Hz" in detail


def test_noise_alone_has_no_fit() -> None:
    """White noise shows none of the modes, and says so for each."""
    found, missing = fit(white(np.random.default_rng(3), 1.0, 60_000, RATE), [ROLL, PITCH])
    assert found is None
    assert {name: reason for name, (reason, _) in missing.items()} == {
        "roll": "not-excited",
        "pitch": "not-excited",
    }


def test_a_line_is_kept_out_and_listed_with_its_amplitude() -> None:
    """A line on the flank of a mode is masked; its amplitude is read within 10 %."""
    values = both() + sine(60_000, RATE, 110.0, 30.0)
    found, _ = fit(values, [ROLL, PITCH])
    clean, _ = fit(both(), [ROLL, PITCH])
    assert found is not None
    assert clean is not None
    assert clean.lines.shape == (0, 2)
    ((frequency, amplitude),) = found.lines
    assert frequency == pytest.approx(110.0, abs=0.02)
    assert amplitude == pytest.approx(30.0, rel=0.1)
    off = (found.estimate - clean.estimate) / np.sqrt(np.diag(clean.cov))
    assert np.abs(off).max() < 1


def test_a_line_known_beforehand_is_masked() -> None:
    """Where a line is said to stand nothing is read, and it is not found once more."""
    view, coarse = view_of(both())
    found, _ = fit_band(replace(view, lines=(110.0,)), coarse, (ROLL, PITCH))
    clean, _ = fit_band(view, coarse, (ROLL, PITCH))
    assert found is not None
    assert clean is not None
    reach = found.residual.near(110.0)
    assert reach.stop - reach.start > 10
    assert (found.residual.periodogram[reach] == 1).all()
    assert (clean.residual.periodogram[reach] != 1).all()
    assert found.lines.shape == (0, 2)
    assert np.abs((found.estimate - clean.estimate) / np.sqrt(np.diag(clean.cov))).max() < 0.5


def test_a_band_that_known_lines_cover_is_too_short() -> None:
    """Where lines leave nothing to fit, the mode is refused with what is left."""
    view, coarse = view_of(both())
    everywhere = tuple(np.arange(80.0, 160.0, 0.1).tolist())
    found, missing = fit_band(replace(view, lines=everywhere), coarse, (ROLL,))
    assert found is None
    assert missing["roll"][0] == "too-short"


def mean_of(values: np.ndarray, count: int) -> Spectrum:
    """Average the periodograms of equal parts."""
    (channel,) = make_log({"acc_a": values}, RATE).channels
    n = values.size // count
    parts = [
        periodogram(channel, Segment(k * n, (k + 1) * n, float("nan")), RATE) for k in range(count)
    ]
    mean = np.mean([part.periodogram for part in parts], axis=0)
    return replace(parts[0], periodogram=mean, count=count)


def fit_mean(spectrum: Spectrum) -> BandFit:
    """Fit both modes to one spectrum."""
    found, missing = fit_band(
        View("acc_a", "acc", (spectrum,)), coarsen((spectrum,), 75.0, 165.0, 0.8), (ROLL, PITCH)
    )
    assert found is not None
    assert missing == {}
    return found


def test_the_mean_of_parts_is_as_sure_as_the_whole_record() -> None:
    """Ten parts of 20 s averaged have their truth within 4σ, and the σ of 200 s within a tenth."""
    values = both(seed=7, n=200_000)
    whole, mean = fit_mean(mean_of(values, 1)), fit_mean(mean_of(values, 10))
    std = np.sqrt(np.diag(mean.cov))
    truth = np.log([105.0, 125.0, 0.015, 0.02])
    assert np.abs((mean.estimate - truth) / std).max() < 4
    np.testing.assert_allclose(std, np.sqrt(np.diag(whole.cov)), rtol=0.1)
    # Negative control: taken for a single periodogram it would be three times less sure.
    once = fit_mean(replace(mean_of(values, 10), count=1))
    assert (np.sqrt(np.diag(once.cov)) > 2 * std).all()


def test_the_mean_of_parts_shows_lines_that_none_of_them_shows() -> None:
    """A line six times above the noise of a part is masked in the mean of ten, noise never is."""
    clean = both(seed=8, n=200_000)
    level, _ = mean_of(clean, 10).density(113.0, 115.0)
    dirty = clean + sine(200_000, RATE, 114.0, float(np.sqrt(2 * 6 * level / 20.0)))
    assert fit_mean(mean_of(clean, 10)).lines.shape == (0, 2)
    (row,) = fit_mean(mean_of(dirty, 10)).lines
    assert row[0] == pytest.approx(114.0, abs=0.1)
    # Negative control: by the threshold of a single periodogram it would not be seen.
    assert fit_mean(replace(mean_of(dirty, 10), count=1)).lines.shape == (0, 2)


def test_what_a_fit_of_a_sure_mean_lacks_is_no_line() -> None:
    """A mode that nobody looks for is left over for the search, and not masked as lines."""
    modes = [Mode(105.0, 0.015), Mode(112.0, 0.01, 0.05)]
    values = accelerations(np.random.default_rng(10), modes, 1_200_000, RATE, 0.5)[0]
    mean = mean_of(values, 60)
    found, _ = fit_band(View("acc_a", "acc", (mean,)), coarsen((mean,), 90.0, 120.0, 0.8), (ROLL,))
    assert found is not None
    assert found.residual.band(111.0, 113.0).periodogram.max() > 2
    assert found.lines.shape == (0, 2)


def test_a_stretch_too_short_for_the_band_does_no_harm() -> None:
    """A segment of six samples beside a record leaves the fit as it is."""
    view, coarse = view_of(both())
    (channel,) = make_log({"acc_a": both(n=6)}, RATE).channels
    tiny = periodogram(channel, Segment(0, 6, float("nan")), RATE)
    alone, _ = fit_band(view, coarse, (ROLL, PITCH))
    beside, _ = fit_band(replace(view, spectra=(*view.spectra, tiny)), coarse, (ROLL, PITCH))
    assert alone is not None
    assert beside is not None
    np.testing.assert_allclose(beside.estimate, alone.estimate, atol=1e-9)


@pytest.mark.parametrize(("nominal", "reason"), [(None, "line-not-mode"), (105.0, None)])
def test_a_peak_as_narrow_as_mains_is_no_mode_unless_sought(
    nominal: float | None, reason: str | None
) -> None:
    """Of ζ = 0.03 % a resonance cannot be told from a line that wanders, though it is resolved."""
    mode, n = Mode(105.0, 0.0003), 400_000
    values = accelerations(np.random.default_rng(9), [mode], n, RATE, 0.5)[0]
    (channel,) = make_log({"acc_a": values}, RATE).channels
    spectra = (periodogram(channel, Segment(0, n, float("nan")), RATE),)
    target = Target("roll", 105.0, 0.0005, 0.02, nominal=nominal)
    found, missing = fit_band(
        View("acc_a", "acc", spectra), coarsen(spectra, 103.0, 107.0, 0.02), (target,)
    )
    assert found is not None
    assert [t.name for t in found.targets] == ([] if reason else ["roll"])
    assert reason is None or missing["roll"][0] == reason


@pytest.mark.parametrize(("apart", "masked"), [(6, 0.0), (12, 5 / 12)])
def test_towers_are_masked_unless_they_are_most_of_the_band(apart: int, masked: float) -> None:
    """Five of every twelve ordinates are masked as lines; where it would be five of six, none."""
    n, low, high = 60_000, 75, 165
    values = both()
    for k in range(low * 60, high * 60, apart):
        values = values + sine(n, RATE, k / 60, 300.0)
    view, coarse = view_of(values)
    spectra = (view.spectra[0].band(low, high),)
    masks = [np.ones(spectra[0].frequency.size, dtype=bool)]
    _mask_towers(spectra, masks, coarse)
    assert 1 - masks[0].mean() == pytest.approx(masked, abs=2e-3)


def test_a_mode_far_from_where_it_is_sought_is_not_taken() -> None:
    """A resonance 19 % above a search of ±5 % is not reported under the sought name."""
    target = Target("roll", 105.0, 0.015, 0.05)
    values = accelerations(np.random.default_rng(4), [Mode(125.0, 0.02)], 60_000, RATE, 0.5)[0]
    found, missing = fit(values, [target])
    assert found is None
    assert set(missing) == {"roll"}


def test_too_few_ordinates_are_named_with_their_number() -> None:
    """A quarter of a second is too short even for a mode beyond doubt; its frequencies count."""
    (_, coarse), (view, _) = view_of(both()), view_of(both(n=250))
    found, missing = fit_band(view, coarse, (ROLL,))
    assert found is None
    reason, detail = missing["roll"]
    assert reason == "too-short"
    assert "needed 16" in detail


def test_keeping_some_modes_marginalises_the_others() -> None:
    """The covariance of what is kept is the block of the whole; the names follow."""
    found, _ = fit(both(), [ROLL, PITCH])
    assert found is not None
    kept = found.only(["pitch"])
    assert [target.name for target in kept.targets] == ["pitch"]
    np.testing.assert_array_equal(kept.estimate, found.estimate[[1, 3]])
    np.testing.assert_array_equal(kept.cov, found.cov[np.ix_([1, 3], [1, 3])])
    np.testing.assert_array_equal(kept.snr, found.snr[[1]])


def test_the_clearer_channel_has_the_higher_clarity() -> None:
    """The log likelihood a mode gains is larger where its noise is lower."""
    modes = [Mode(105.0, 0.015)]
    clear, blurred = (
        fit(accelerations(np.random.default_rng(5), modes, 60_000, RATE, noise)[0], [ROLL])[0]
        for noise in (0.1, 10.0)
    )
    assert clear is not None
    assert blurred is not None
    assert clear.clarity[0] > blurred.clarity[0] > 0
