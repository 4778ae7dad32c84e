"""StageCheck: what a description covers and can tell, on maps known in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from scipy.stats import norm

from lmshealth.stage.check import StageCheck, check_stage
from lmshealth.stage.description import Stage, load_stage
from lmshealth.stage.identifiability import identifiability_of
from tests.lives import (
    BEND,
    FOOT,
    FREQUENCY,
    MOUNT,
    PRELOAD,
    SENSITIVITY,
    make_stage,
    stage_text,
    true_drift,
)

NAMES = ("guide_preload", "mount_stiffness")
LIMITS = np.log([0.6, 0.7])


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes that two parameters move."""
    return make_stage(tmp_path_factory.mktemp("two"))


@pytest.fixture(scope="module")
def two(stage: Stage) -> StageCheck:
    """Its examination."""
    return check_stage(stage)


def verdicts(examined: StageCheck) -> dict[str, str]:
    """Give the verdict of each parameter."""
    return {check.parameter: check.verdict for check in examined.parameters}


def test_modes_stand_where_the_map_has_them(two: StageCheck) -> None:
    """At the baseline the nominal frequency, at the limits what the formula says."""
    at_limits = FREQUENCY[:2] * np.exp(true_drift(NAMES, LIMITS)[:2])
    for k, check in enumerate(two.modes):
        assert check.informs
        assert check.map_frequency == pytest.approx(FREQUENCY[k], rel=1e-9)
        assert check.limit_frequency == pytest.approx(at_limits[k], rel=1e-9)
        assert check.searched == pytest.approx((0.85 * FREQUENCY[k], 1.15 * FREQUENCY[k]))
        assert check.is_searched(check.limit_frequency)
        assert not check.is_searched(1.16 * FREQUENCY[k])
        assert check.surrogate_error < 1e-10


def test_sensitivities_are_told_at_baseline_and_limits(two: StageCheck) -> None:
    """Slopes of the formula, whose bend shows at the limit of the preload."""
    known = np.column_stack([SENSITIVITY[name][:2] for name in NAMES])
    np.testing.assert_allclose(two.slopes, known, atol=1e-9)
    bent = known + 2 * BEND * LIMITS[0] * np.array([1, 0])
    np.testing.assert_allclose(two.limit_slopes, bent, atol=1e-9)


def test_coverage_is_the_share_of_the_prior_beyond_the_map(two: StageCheck) -> None:
    """Quantiles and tails of the lognormal prior, by the normal distribution."""
    cover = two.ranges[0]
    assert (cover.low, cover.high) == pytest.approx((0.2, 1.5))
    assert cover.prior == pytest.approx(np.exp(0.3 * norm.ppf([0.005, 0.05, 0.95, 0.995])))
    assert cover.below == pytest.approx(norm.cdf(np.log(0.2) / 0.3))
    assert cover.above == pytest.approx(norm.sf(np.log(1.5) / 0.3))
    assert cover.holds_limit


def test_one_parameter_and_one_mode_are_the_closed_form(tmp_path: Path) -> None:
    """1/σ² = 1/Λ + s² / (R (1/5 + 1/5) + m² s² Λ); alone it correlates with nothing."""
    stage = make_stage(tmp_path, (PRELOAD,), n_modes=1)
    (check,) = check_stage(stage).parameters
    slope, prior = SENSITIVITY["guide_preload"][0], check.prior_std**2
    noise = identifiability_of(stage).log_variance(60.0)[0] * 0.4

    def left(variance: float) -> float:
        return (1 / prior + slope**2 / variance) ** -0.5

    error = 0.05**2 * slope**2 * prior
    assert check.usual_std == pytest.approx(left(noise + error))
    assert check.exact_map_std == pytest.approx(left(noise))
    assert check.endless_std == pytest.approx(left(error), rel=1e-3)
    assert check.known_std == pytest.approx(check.endless_std)
    assert check.informed(check.prior_std / 2) == pytest.approx(0.75)
    assert check_stage(stage).correlation == pytest.approx(np.eye(1))


def test_two_modes_tell_two_parameters_apart(two: StageCheck) -> None:
    """Both are told, and less well than were the other known; errors go against each other."""
    assert verdicts(two) == dict.fromkeys(NAMES, "told")
    assert all(check.known_std < check.endless_std for check in two.parameters)
    assert two.correlation[0, 1] < -0.5
    np.testing.assert_allclose(two.correlation, two.correlation.T)


def test_one_mode_tells_two_parameters_together(tmp_path: Path) -> None:
    """They are known as the product to whose powers the mode goes."""
    examined = check_stage(make_stage(tmp_path, n_modes=1, model_std=0.0))
    preload = examined.parameters[0]
    ratio = SENSITIVITY["mount_stiffness"][0] / SENSITIVITY["guide_preload"][0]
    assert preload.verdict == "together"
    assert preload.exponents == pytest.approx([1.0, ratio], rel=1e-3)
    assert preload.known_std < 0.01 < preload.endless_std


def test_noise_that_only_more_logs_average_is_told(tmp_path: Path) -> None:
    """With a modal SNR of next to nothing usual logs do not tell what endless ones do."""
    text = stage_text((PRELOAD,), n_modes=1).replace("0.018", "0.018\nsnr = 0.002")
    make_stage(tmp_path, (PRELOAD,), n_modes=1)
    (tmp_path / "small.toml").write_text(text)
    examined = check_stage(load_stage(str(tmp_path / "small.toml")))
    assert verdicts(examined) == {"guide_preload": "longer-logs"}


def test_what_no_mode_feels_is_not_told(tmp_path: Path) -> None:
    """Of three parameters the two that move modes are told, the third keeps its prior."""
    examined = check_stage(make_stage(tmp_path, (PRELOAD, MOUNT, FOOT), n_modes=3))
    assert verdicts(examined) == dict.fromkeys(NAMES, "told") | {"foot": "not-told"}
    foot = examined.parameters[2]
    assert foot.endless_std == pytest.approx(foot.prior_std)
    assert examined.correlation.shape == (3, 3)


def test_a_better_map_tells_more(tmp_path: Path) -> None:
    """The error of the map bounds what endless logs know; without one it is next to nothing."""
    stds = [
        check_stage(make_stage(tmp_path / str(m), model_std=m)).parameters[0].endless_std
        for m in (0.0, 0.05, 0.3)
    ]
    assert stds[0] < 1e-3 < stds[1] < stds[2]


def test_modes_off_the_map_and_not_tracked_do_not_inform(tmp_path: Path) -> None:
    """They are listed with what is known of them."""
    make_stage(tmp_path)
    text = stage_text(n_modes=3).replace("0.015\n", "0.015\ntracked = false\n")
    (tmp_path / "small.toml").write_text(text)
    examined = check_stage(load_stage(str(tmp_path / "small.toml")))
    assert [check.informs for check in examined.modes] == [True, False, False]
    assert [np.isnan(check.map_frequency) for check in examined.modes] == [False, False, True]
    assert examined.informative == ("roll",)


def test_modes_that_only_the_map_has_are_named(tmp_path: Path) -> None:
    """A description of one mode beside a map of two."""
    make_stage(tmp_path)
    (tmp_path / "small.toml").write_text(stage_text(n_modes=1))
    assert check_stage(load_stage(str(tmp_path / "small.toml"))).unused == ("pitch",)


def test_limits_beyond_the_map_are_no_point_of_it(tmp_path: Path) -> None:
    """Frequencies and slopes there are missing, and ranges says why."""
    low = PRELOAD.replace("below = 0.6", "below = 0.1")
    examined = check_stage(make_stage(tmp_path, (low,)))
    assert np.isnan(examined.limit_slopes).all()
    assert np.isnan(examined.modes[0].limit_frequency)
    assert not examined.ranges[0].holds_limit


def test_without_limits_only_the_baseline_is_told(tmp_path: Path) -> None:
    """No limit, no point at limits."""
    examined = check_stage(
        make_stage(tmp_path, (FOOT, PRELOAD.replace("limit = { below = 0.6 }", "")))
    )
    assert np.isnan(examined.limit_slopes).all()
    assert all(ranges.holds_limit for ranges in examined.ranges)


def test_without_parameters_there_are_only_modes(tmp_path: Path) -> None:
    """A description for tracking alone is no error."""
    examined = check_stage(make_stage(tmp_path, ()))
    assert [check.mode.name for check in examined.modes] == ["roll", "pitch"]
    assert examined.parameters == examined.ranges == examined.informative == ()
    assert examined.slopes.size == examined.correlation.size == 0


def test_more_logs_in_the_baseline_know_more(stage: Stage, two: StageCheck) -> None:
    """Usual logs are as many as the baseline has."""
    baseline = structs.replace(stage.description.baseline, logs=50)
    longer = Stage(
        structs.replace(stage.description, baseline=baseline), stage.modal_map, stage.digest
    )
    assert check_stage(longer).n_logs == 50
    assert check_stage(longer).modes[0].reached == pytest.approx(two.modes[0].reached / np.sqrt(10))


def test_the_mount_shows_in_y_and_not_in_x() -> None:
    """The shipped descriptions: what `plan` refuses is not told here."""
    assert verdicts(check_stage(load_stage("lms-x"))) == {
        "guide_preload": "told", "mount_stiffness": "not-told",
    }  # fmt: skip
    assert verdicts(check_stage(load_stage("lms-y"))) == dict.fromkeys(NAMES, "told")
