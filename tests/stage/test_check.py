"""Check of a description on maps known in closed form, and the sentences about it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from scipy.stats import norm

from lmshealth.stage.check import StageCheck, check_stage, diagnose
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
INSIDE = 'kind = "lognormal", median = 1.0, sigma = 0.3'
NARROW = 'kind = "lognormal", median = 0.9, sigma = 0.1'


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes that two parameters move."""
    return make_stage(tmp_path_factory.mktemp("two"))


@pytest.fixture(scope="module")
def two(stage: Stage) -> StageCheck:
    """Its check."""
    return check_stage(stage)


def verdicts(checked: StageCheck) -> dict[str, str]:
    """Give the verdict of each parameter."""
    return {check.name: check.verdict for check in checked.parameters}


def test_modes_stand_where_the_map_has_them(two: StageCheck) -> None:
    """At the baseline the nominal frequency, at the limits that of the formula."""
    at_limits = FREQUENCY[:2] * np.exp(true_drift(NAMES, LIMITS)[:2])
    for k, check in enumerate(two.modes):
        assert check.informs
        assert check.map_frequency == pytest.approx(FREQUENCY[k], rel=1e-9)
        assert check.limit_frequency == pytest.approx(at_limits[k], rel=1e-9)
        assert check.searched == pytest.approx((FREQUENCY[k] / 1.15, 1.15 * FREQUENCY[k]))
        assert check.surrogate_error < 1e-10


def test_sensitivities_at_baseline_and_limits(two: StageCheck) -> None:
    """Slopes of the formula, whose bend shows at the limit of the preload."""
    known = np.column_stack([SENSITIVITY[name][:2] for name in NAMES])
    np.testing.assert_allclose(two.slopes, known, atol=1e-9)
    bent = known + 2 * BEND * LIMITS[0] * np.array([1, 0])
    np.testing.assert_allclose(two.limit_slopes, bent, atol=1e-9)


def test_tails_are_the_share_of_the_prior_outside_the_map(two: StageCheck) -> None:
    """Quantiles and tails of the lognormal prior, by the normal distribution."""
    cover = two.parameters[0]
    assert (cover.low, cover.high) == pytest.approx((0.2, 1.5))
    assert cover.quantiles == pytest.approx(np.exp(0.3 * norm.ppf([0.005, 0.05, 0.95, 0.995])))
    assert cover.below == pytest.approx(norm.cdf(np.log(0.2) / 0.3))
    assert cover.above == pytest.approx(norm.sf(np.log(1.5) / 0.3))
    assert cover.has_limit_on_map


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
    assert check.variance_removed(check.prior_std / 2) == pytest.approx(0.75)
    assert check_stage(stage).correlation == pytest.approx(np.eye(1))


def test_two_modes_identify_two_parameters(two: StageCheck) -> None:
    """Both are identified, less well than were the other known; errors are correlated."""
    assert verdicts(two) == dict.fromkeys(NAMES, "identifiable")
    assert all(check.known_std < check.endless_std for check in two.parameters)
    assert two.correlation[0, 1] < -0.5
    np.testing.assert_allclose(two.correlation, two.correlation.T)


def test_one_mode_identifies_two_parameters_together(tmp_path: Path) -> None:
    """They are known as the product to whose powers the mode goes."""
    checked = check_stage(make_stage(tmp_path, n_modes=1, model_std=0.0))
    preload = checked.parameters[0]
    ratio = SENSITIVITY["mount_stiffness"][0] / SENSITIVITY["guide_preload"][0]
    assert preload.verdict == "together"
    assert preload.exponents == pytest.approx([1.0, ratio], rel=1e-3)
    assert preload.known_std < 0.01 < preload.endless_std


def test_noise_that_only_more_logs_average(tmp_path: Path) -> None:
    """With a modal SNR of next to nothing typical logs do not identify what unlimited ones do."""
    text = stage_text((PRELOAD,), n_modes=1).replace("0.018", "0.018\nsnr = 0.002")
    make_stage(tmp_path, (PRELOAD,), n_modes=1)
    (tmp_path / "small.toml").write_text(text)
    checked = check_stage(load_stage(str(tmp_path / "small.toml")))
    assert verdicts(checked) == {"guide_preload": "longer-logs"}


def test_a_parameter_without_effect_is_not_identified(tmp_path: Path) -> None:
    """Of three parameters the two that move modes are identified, the third keeps its prior."""
    checked = check_stage(make_stage(tmp_path, (PRELOAD, MOUNT, FOOT), n_modes=3))
    assert verdicts(checked) == dict.fromkeys(NAMES, "identifiable") | {"foot": "not-identifiable"}
    foot = checked.parameters[2]
    assert foot.endless_std == pytest.approx(foot.prior_std)
    assert checked.correlation.shape == (3, 3)


def test_a_better_map_identifies_better(tmp_path: Path) -> None:
    """The error of the map bounds the result of unlimited logs."""
    stds = [
        check_stage(make_stage(tmp_path / str(m), model_std=m)).parameters[0].endless_std
        for m in (0.0, 0.05, 0.3)
    ]
    assert stds[0] < 1e-3 < stds[1] < stds[2]


def test_modes_off_the_map_and_not_tracked_do_not_inform(tmp_path: Path) -> None:
    """They are listed all the same."""
    make_stage(tmp_path)
    text = stage_text(n_modes=3).replace("0.015\n", "0.015\ntracked = false\n")
    (tmp_path / "small.toml").write_text(text)
    checked = check_stage(load_stage(str(tmp_path / "small.toml")))
    assert [check.informs for check in checked.modes] == [True, False, False]
    assert [np.isnan(check.map_frequency) for check in checked.modes] == [False, False, True]
    assert checked.informative == ("roll",)


def test_modes_that_only_the_map_has_are_named(tmp_path: Path) -> None:
    """A description of one mode with a map of two."""
    make_stage(tmp_path)
    (tmp_path / "small.toml").write_text(stage_text(n_modes=1))
    assert check_stage(load_stage(str(tmp_path / "small.toml"))).unused == ("pitch",)


def test_limits_beyond_the_map_are_no_point_of_it(tmp_path: Path) -> None:
    """Frequencies and slopes there are missing."""
    low = PRELOAD.replace("below = 0.6", "below = 0.1")
    checked = check_stage(make_stage(tmp_path, (low,)))
    assert np.isnan(checked.limit_slopes).all()
    assert np.isnan(checked.modes[0].limit_frequency)
    assert not checked.parameters[0].has_limit_on_map


def test_without_limits_there_is_only_the_baseline(tmp_path: Path) -> None:
    """No limit, no point at limits."""
    checked = check_stage(
        make_stage(tmp_path, (FOOT, PRELOAD.replace("limit = { below = 0.6 }", "")))
    )
    assert np.isnan(checked.limit_slopes).all()
    assert all(check.has_limit_on_map for check in checked.parameters)


def test_without_parameters_there_are_only_modes(tmp_path: Path) -> None:
    """A description for tracking alone is no error."""
    checked = check_stage(make_stage(tmp_path, ()))
    assert [check.mode.name for check in checked.modes] == ["roll", "pitch"]
    assert checked.parameters == checked.informative == ()
    assert checked.slopes.size == checked.correlation.size == 0


def test_more_logs_in_the_baseline_reduce_the_deviation(stage: Stage, two: StageCheck) -> None:
    """Typical logs are as many as the baseline has."""
    baseline = structs.replace(stage.description.baseline, logs=50)
    longer = Stage(
        structs.replace(stage.description, baseline=baseline), stage.modal_map, stage.digest
    )
    assert check_stage(longer).n_logs == 50
    assert check_stage(longer).modes[0].reached == pytest.approx(two.modes[0].reached / np.sqrt(10))


def test_the_mount_shows_in_y_and_not_in_x() -> None:
    """The shipped descriptions: what `plan` refuses is not identified here."""
    assert verdicts(check_stage(load_stage("lms-x"))) == {
        "guide_preload": "identifiable", "mount_stiffness": "not-identifiable",
    }  # fmt: skip
    assert verdicts(check_stage(load_stage("lms-y"))) == dict.fromkeys(NAMES, "identifiable")


@pytest.fixture(scope="module")
def fine(tmp_path_factory: pytest.TempPathFactory) -> StageCheck:
    """Two parameters whose priors lie inside the map, two modes."""
    parts = tuple(part.replace(INSIDE, NARROW) for part in (PRELOAD, MOUNT))
    return check_stage(make_stage(tmp_path_factory.mktemp("fine"), parts))


def faults(checked: StageCheck) -> list[str]:
    """List the possible faults."""
    return [finding.text for finding in diagnose(checked) if not finding.good]


def merits(checked: StageCheck) -> str:
    """Join the other sentences."""
    return "\n".join(finding.text for finding in diagnose(checked) if finding.good)


def test_a_description_in_order_has_no_faults(fine: StageCheck) -> None:
    """Standard deviations and the correlation of errors are stated."""
    assert faults(fine) == []
    text = merits(fine)
    assert "guide_preload is identifiable: its standard deviation is 2.5 % after 5 logs of" in text
    assert "guide_preload and mount_stiffness are identifiable separately; their errors" in text
    assert "too high, that of the other tends to be too low" in text
    assert "at most the target of 1e-05" in text


def test_errors_that_hardly_correlate_are_not_explained(fine: StageCheck) -> None:
    """Only the number is given; the sign of a large one is explained."""
    small, large = fine.correlation * [[1, 0.1], [0.1, 1]], abs(fine.correlation)
    assert "tends" not in merits(replace(fine, correlation=small))
    assert "that of the other tends to be too high" in merits(replace(fine, correlation=large))


def test_effects_below_the_map_error_and_parameters_without_effect(tmp_path: Path) -> None:
    """The X stage needs a better map for its mount; a foot that moves nothing needs a mode."""
    (text,) = faults(check_stage(load_stage("lms-x")))
    assert text.startswith("mount_stiffness is not identifiable: its standard deviation is 26 %")
    assert "less than the map's error" in text
    assert "with an exact map it would be 9.2 %" in text
    parts = (PRELOAD.replace(INSIDE, NARROW), FOOT)
    (text,) = faults(check_stage(make_stage(tmp_path, parts)))
    assert text.startswith("foot is not identifiable")
    assert "hardly depend on it" in text


def test_combinations_are_written_as_powers(tmp_path: Path) -> None:
    """One mode that two parameters move identifies their product."""
    parts = tuple(part.replace(INSIDE, NARROW) for part in (PRELOAD, MOUNT))
    found = faults(check_stage(make_stage(tmp_path, parts, n_modes=1)))
    assert any("together with others: guide_preload · mount_stiffness^3." in text for text in found)


def test_noise_that_more_logs_average_is_stated(fine: StageCheck) -> None:
    """The sentence recommends more or longer logs."""
    first = replace(fine.parameters[0], verdict="longer-logs")
    (text,) = faults(replace(fine, parameters=(first, fine.parameters[1])))
    assert text.startswith("guide_preload is identifiable by more or longer logs only")


def test_a_prior_and_a_limit_beyond_the_map(tmp_path: Path) -> None:
    """Both state the range of the map."""
    low = PRELOAD.replace("below = 0.6", "below = 0.1")
    found = faults(check_stage(make_stage(tmp_path, (low,))))
    assert any("covers 0.2 to 1.5; 8.8 % of its prior lies outside" in text for text in found)
    assert any("limit 0.1 of guide_preload does not lie inside" in text for text in found)


def test_a_surrogate_is_judged_by_target_and_logs(fine: StageCheck) -> None:
    """Above the target is a fault where it may limit; above what logs reach the grid is too coarse.

    Far below what logs reach an error above the target is no fault.
    """
    reached = fine.modes[0].reached
    slight = replace(fine.modes[0], surrogate_error=0.04 * reached)
    text = merits(replace(fine, modes=(slight, fine.modes[1])))
    assert "1e-05; 4 % of the standard deviation of typical logs. It does not limit" in text
    for error, needle in ((0.06 * reached, "more than the target of 1e-05"), (2e-3, "grid denser")):
        modes = (replace(fine.modes[0], surrogate_error=error), fine.modes[1])
        (text,) = faults(replace(fine, modes=modes))
        assert needle in text
        assert "(roll)" in text


def test_modes_where_the_map_does_not_have_them(fine: StageCheck) -> None:
    """Outside the band that is searched, at the baseline or at the limits."""
    away = replace(fine.modes[0], map_frequency=150.0)
    worn = replace(fine.modes[1], limit_frequency=110.0)
    first, second = faults(replace(fine, modes=(away, worn)))
    assert first.startswith("roll is searched from 109.9 to 145.4 Hz, but the map has it at 150")
    assert "110 Hz with every parameter at its limit" in second


def test_modes_that_only_one_side_knows(tmp_path: Path) -> None:
    """Tracked but not on the map, and on the map but not described: stated, no fault."""
    make_stage(tmp_path)
    (tmp_path / "small.toml").write_text(stage_text(n_modes=2).replace('"pitch"', '"sway"'))
    text = merits(check_stage(load_stage(str(tmp_path / "small.toml"))))
    assert "sway is tracked but not on the map" in text
    assert "The map also has pitch" in text


def test_a_covariate_that_is_nearly_a_key_of_logs_is_named() -> None:
    """Logs could not state it. A key, and a name of the user's own, are none."""
    stage = load_stage("lms-y")
    given = stage.description.covariate
    assert given
    for name, n in (("temprature_c", 1), ("temperature_c", 0), ("oil_level", 0)):
        own = structs.replace(given[0], name=name)
        described = structs.replace(stage.description, covariate=(own,))
        checked = check_stage(replace(stage, description=described))
        found = [one for one in diagnose(checked) if "Is temperature_c meant?" in one.text]
        assert [one.good for one in found] == [False] * n


def test_a_description_without_health_is_no_fault(tmp_path: Path) -> None:
    """One sentence, and no fault."""
    (finding,) = diagnose(check_stage(make_stage(tmp_path, ())))
    assert finding.good
    assert "no health is inferred" in finding.text
