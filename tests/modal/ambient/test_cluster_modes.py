"""Estimates of a cluster: dispersion, flags, rejections, and modes too close to be separated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.modal.ambient.cluster_fit import _dispersion, _flags, _incredible
from lmshealth.modal.ambient.cluster_modes import (
    ClusterFit,
    ClusterModes,
    drop_duplicates,
    separate,
)
from lmshealth.modal.identification import identify
from lmshealth.modal.modes import Modes
from tests.bands import PITCH, RATE, ROLL, both, fit, found
from tests.signals import Mode, acceleration_log, make_stage


def brought_to(apart: float, fit: ClusterModes, shapes: list[list[float]]) -> ClusterModes:
    """Move the second mode so many half-power bandwidths above the first, with these shapes."""
    estimate = fit.modes.estimate.copy()
    estimate[2:] = np.log(0.02)
    estimate[1] = estimate[0] + np.log1p(2 * 0.02 * apart)
    moved = replace(
        fit.modes,
        ln_frequency=estimate[:2],
        ln_damping=estimate[2:],
        shapes=np.array(shapes) * fit.fitted.unit,
    )
    return replace(fit, modes=moved)


ALIKE, UNLIKE = [[1.0, 0.5], [1.0, 0.45]], [[1.0, 0.5], [0.5, -1.0]]


@pytest.mark.parametrize(
    ("apart", "shapes", "close"),
    [(1.2, ALIKE, False), (0.9, ALIKE, True), (0.3, UNLIKE, False), (0.1, UNLIKE, True)],
)
def test_modes_are_close_within_a_bandwidth_unless_their_shapes_differ(
    apart: float, shapes: list[list[float]], close: bool
) -> None:
    """What is too close is refused by name, with both frequencies and where they stand together."""
    fit = brought_to(apart, found(both()), shapes)
    result = separate(ClusterFit(fit, {}), ("roll", "pitch"))
    kept, rejected = result.credible, result.rejected
    assert kept is not None
    assert (set(rejected) == {"roll", "pitch"}) is close
    assert (len(kept.names) == 0) is close
    if close:
        reason, detail, *_ = rejected["roll"]
        assert reason == "too-close"
        assert f"{np.exp(fit.modes.estimate[0]):.5g}" in detail


def test_what_was_not_sought_by_name_is_left_as_one() -> None:
    """One mode for both, half of their distance in its standard deviation, and flagged."""
    fit = brought_to(0.5, found(both()), ALIKE)
    kept = separate(ClusterFit(fit, {}), ()).credible
    assert kept is not None
    assert list(kept.names) == ["roll"]
    # It has the name of the one that is described.
    described = separate(ClusterFit(fit, {}), ("pitch",)).credible
    assert described is not None
    assert list(described.names) == ["pitch"]
    assert described.modes.estimate[0] == pytest.approx(kept.modes.estimate[0])
    assert kept.modes.flags == ("cluster",)
    assert kept.modes.estimate[0] == pytest.approx(fit.modes.estimate[:2].mean())
    half = (fit.modes.estimate[1] - fit.modes.estimate[0]) / 2
    own = (fit.modes.cov[0, 0] + fit.modes.cov[1, 1] + 2 * fit.modes.cov[0, 1]) / 4
    assert kept.modes.cov[0, 0] == pytest.approx(own + half**2)
    cause, factor = kept.modes.credibility[0].factors[-1]
    assert (cause, factor) == ("cluster", pytest.approx(np.sqrt(1 + half**2 / own)))
    assert kept.modes.cov.shape == (2, 2)


def renamed(fit: ClusterModes, *names: str) -> ClusterModes:
    """Give modes other names."""
    return replace(fit, modes=replace(fit.modes, names=names))


def test_of_a_mode_that_two_parts_of_a_band_find_the_clearer_is_kept() -> None:
    """The same fit twice, once less clear: its modes are dropped; modes elsewhere are kept.

    Two modes of one fit are kept however close they are.
    """
    clear = renamed(found(both()), "mode_1", "mode_2")
    again = renamed(replace(clear, clarity=clear.clarity / 2), "mode_3", "mode_4")
    far = renamed(again, "mode_5", "mode_6")
    far = replace(far, modes=replace(far.modes, ln_frequency=far.modes.ln_frequency + 1))
    close = renamed(brought_to(0.3, far, UNLIKE), "mode_7", "mode_8")
    close = replace(close, modes=replace(close.modes, ln_frequency=close.modes.ln_frequency - 3))
    fits = drop_duplicates([ClusterFit(one, {}) for one in (again, clear, far, close)])
    kept = [one.names for fit in fits if (one := fit.modes) is not None]
    assert kept == [(), ("mode_1", "mode_2"), ("mode_5", "mode_6"), ("mode_7", "mode_8")]


@pytest.mark.slow
def test_modes_at_one_place_in_one_channel_are_refused_and_not_guessed() -> None:
    """Of 8 records of two modes half a bandwidth apart none gives both by name."""
    modes = [Mode(120.0, 0.02), Mode(122.4, 0.02)]
    stage = make_stage([("roll", 120.0, 0.02), ("pitch", 122.4, 0.02)])
    for seed in range(8):
        log = acceleration_log(np.random.default_rng(seed), modes, 60.0, RATE, 6.25)
        result = identify(log, stage)
        assert len(result.names) < 2
        assert {r.reason for r in result.refused} <= {"too-close", "ambiguous", "not-identified"}


@pytest.mark.slow
def test_modes_that_channels_see_differently_are_told_apart_at_one_place() -> None:
    """A third of a bandwidth apart both are found, in order, within 4σ."""
    modes = [Mode(120.0, 0.02, 1.0, (1.0, 0.6, -0.4)), Mode(121.5, 0.02, 1.0, (0.5, -1.0, 0.7))]
    stage = make_stage([("roll", 120.0, 0.02), ("pitch", 121.5, 0.02)])
    for seed in range(6):
        log = acceleration_log(np.random.default_rng(seed), modes, 60.0, RATE, 6.25)
        result = identify(log, stage)
        assert result.names == ("roll", "pitch")
        off = (result.ln_frequency - np.log([120.0, 121.5])) / np.sqrt(np.diag(result.cov)[:2])
        assert np.abs(off).max() < 4


TRUTH = np.log([105.0, 125.0, 0.015, 0.02])


def test_a_mode_narrower_than_a_record_resolves_is_a_line() -> None:
    """A half-power bandwidth of 0.95 Fourier frequencies is refused, one of 1.05 accepted."""
    result = found(both())
    width = 2 * np.exp(result.modes.estimate[0] + result.modes.estimate[2])
    why = _incredible(result.modes, 0, ROLL, 0.95 / width)
    assert why is not None
    assert why[0] == "line-not-mode"
    assert "is narrower" in why[1]
    assert _incredible(result.modes, 0, ROLL, 1.05 / width) is None


# How well the model fits, and what to bear in mind


def residual(values: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray, int]:
    """Return what a fit leaves over, of 50 s from 95 to 115 Hz."""
    return np.arange(95 * 50, 115 * 50) / 50, values, count


def scatter(seed: int, count: int = 1) -> np.ndarray:
    """Draw means of so many exponential variables, one for each ordinate."""
    return np.random.default_rng(seed).exponential(size=(1000, count)).mean(axis=1)


F, ZETA = np.array([105.0]), np.array([0.02])


@pytest.mark.parametrize("count", [1, 12])
def test_dispersion_of_noise_is_about_one(count: int) -> None:
    """Whatever the number of records and channels, over 100 residuals within 4.5 errors."""
    values = [_dispersion(*residual(scatter(k, count), count), F, ZETA)[0] for k in range(100)]
    # Within ±4.2 Hz stand 419 ordinates; the fourth moment of an exponential is 9.
    error = np.sqrt((2 + 6 / count) / (100 * 419))
    assert abs(np.mean(values) - 1) < 4.5 * error
    # Negative control: with the count forgotten it is not.
    wrong = _dispersion(*residual(scatter(0, 12)), F, ZETA)[0]
    assert wrong < 0.2


def test_dispersion_is_that_of_what_stands_near_the_mode() -> None:
    """What is further away does not count; twice the scatter does."""
    values = scatter(1)
    noise = residual(values)
    near = np.abs(noise[0] - 105.0) < 2 * 0.02 * 105.0
    (plain,) = _dispersion(*noise, F, ZETA)
    assert plain == pytest.approx(np.mean((values[near] - 1) ** 2), rel=1e-12)
    far = np.where(near, values, 50.0)
    assert _dispersion(*residual(far), F, ZETA)[0] == plain
    (loose,) = _dispersion(*residual(1 + 2 * (values - 1)), F, ZETA)
    assert loose == pytest.approx(4 * plain, rel=1e-12)


def test_too_few_ordinates_tell_no_dispersion() -> None:
    """Thirty ordinates near a mode suffice, 28 do not; modes are independent."""
    left = residual(scatter(2))
    wide, narrow = _dispersion(*left, np.array([100.0, 110.0]), np.array([0.02, 5e-4]))
    assert np.isfinite(wide)
    assert np.isnan(narrow)
    between = np.array([105.01])  # half way between two ordinates, 0.02 Hz apart
    for reach, enough in ((0.291, True), (0.289, False)):
        assert np.isfinite(_dispersion(*left, between, reach / (2 * between))[0]) == enough


def flags(modes: Modes, duration: float = 60.0) -> list[list[str]]:
    """List the flags of both modes."""
    values = zip(modes.frequency, modes.damping_ratio, modes.dispersion, strict=True)
    return [_flags(*value, duration, unsteady=False).split() for value in values]


def test_a_good_fit_has_no_flags() -> None:
    """A record of a minute that shows both modes as described leaves nothing to bear in mind."""
    result = found(both())
    assert result.modes.flags == ("", "")
    assert (result.modes.dispersion > 0.7).all()
    assert (result.modes.dispersion < 1.4).all()


def test_each_flag_has_its_own_reason() -> None:
    """Resolution and dispersion raise flags, also together."""
    modes = found(both()).modes
    # Half-power bandwidths of 3.15 and 5 Hz: a second holds 3.15 and 5 ordinates.
    assert flags(modes, 1.0) == [["resolution-limited"], []]
    assert flags(replace(modes, dispersion=np.array([np.nan, 1.6]))) == [[], ["loose-fit"]]
    worst = replace(modes, dispersion=np.array([2.0, 1.0]))
    assert flags(worst, 1.0) == [["resolution-limited", "loose-fit"], []]


@pytest.mark.slow
def test_a_line_that_is_unsteady_about_a_mode_leaves_its_truth_or_a_flag() -> None:
    """A line that wanders by 0.3 Hz about roll is masked where it is clear, and flagged if not."""
    t = np.arange(60_000) / RATE
    phase = 2 * np.pi * np.cumsum(105 + 0.3 * np.sin(2 * np.pi * t / 17)) / RATE
    for amplitude, loose in ((30.0, False), (10.0, False), (5.0, True)):
        result, rejected = fit(both() + amplitude * np.sin(phase), [ROLL, PITCH])
        assert result is not None
        assert rejected == {}
        off = (result.modes.estimate - TRUTH) / np.sqrt(np.diag(result.modes.cov))
        assert np.abs(off).max() < 4
        assert ["loose-fit" in flags.split() for flags in result.modes.flags] == [loose, False]
