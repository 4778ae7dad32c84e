"""Planning: closed forms, the textbook's information matrix, scaling, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from scipy.stats import norm

from lmshealth.errors import BadQuestion, BadStage, OutsideMap
from lmshealth.stage.check import check_stage
from lmshealth.stage.constants import TYPICAL_DURATION
from lmshealth.stage.description import Stage, load_stage
from lmshealth.stage.identifiability import Plan, ambient_bound, plan
from studies.harness.data.cramer_rao import long_record_law
from tests.lives import DAMPING, FOOT, FREQUENCY, PRELOAD, SENSITIVITY, make_stage
from tests.oracles import planned_std
from tests.signals import write_archive_stage

POWER, ALARM = 0.95, 0.01
LEVELS = norm.ppf(POWER) - norm.ppf(ALARM)
FIVE_LOGS = 1 + 1 / 5


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """One mode that one parameter moves."""
    return make_stage(tmp_path_factory.mktemp("one"), (PRELOAD,), n_modes=1)


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes that two parameters move."""
    return make_stage(tmp_path_factory.mktemp("two"))


def variance(mode: int, duration: float) -> float:
    """Variance of ln f in one log, eight damping ratios to either side."""
    f, zeta = FREQUENCY[mode], DAMPING[mode]
    band = (f * (1 - 8 * zeta), f * (1 + 8 * zeta))
    return float(ambient_bound(f, zeta, 100.0, duration, band=band)[0, 0])


def std_of_one_log(found: Plan) -> float:
    """Return the standard deviation from the smallest loss."""
    return float(-np.log1p(-found.efforts[0].smallest_loss) / LEVELS)


def test_one_mode_and_one_parameter_are_the_closed_form(one: Stage) -> None:
    """σ = √(R (1/N + 1/5)) / s; power, smallest losses, number of logs and seconds follow."""
    slope, loss = SENSITIVITY["guide_preload"][0], 0.03
    found = plan(one, "guide_preload", loss, durations=(60.0,))
    (effort,) = found.efforts

    def std(n_logs: float, duration: float = 60.0) -> float:
        return float(np.sqrt(variance(0, duration) * (1 / n_logs + 1 / 5)) / slope)

    def power(*logs: float) -> float:
        return float(norm.cdf(-np.log(1 - loss) / std(*logs) + norm.ppf(ALARM)))

    assert effort.power == pytest.approx(power(1))
    assert effort.smallest_loss == pytest.approx(1 - np.exp(-LEVELS * std(1)))
    assert effort.smallest_loss_many == pytest.approx(1 - np.exp(-LEVELS * std(5)))
    assert effort.n_logs is not None
    assert effort.n_logs > 1
    assert power(effort.n_logs) >= POWER > power(effort.n_logs - 1)
    alone = found.duration_of_one
    assert alone is not None
    assert power(1, alone) >= POWER > power(1, alone - 1)


@pytest.mark.parametrize("name", ["guide_preload", "mount_stiffness"])
def test_unknown_others_cost_what_the_information_matrix_says(two: Stage, name: str) -> None:
    """Marginal drifts give what inverting the joint information with the prior does."""
    names = ["guide_preload", "mount_stiffness"]
    slopes = np.column_stack([SENSITIVITY[n][:2] for n in names])
    noise = FIVE_LOGS * np.array([variance(k, 60.0) for k in range(2)])
    known = planned_std(slopes, noise, names.index(name), prior_std=0.28)
    found = std_of_one_log(plan(two, name, 0.05, durations=(60.0,)))
    # The prior ends at the map: 0.28 is near enough where the modes are more informative.
    assert found == pytest.approx(known, rel=1e-3)
    alone = np.sqrt(1 / (slopes[:, names.index(name)] ** 2 / noise).sum())
    assert found > 1.5 * alone


def test_four_times_the_time_halves_the_deviation(one: Stage) -> None:
    """As the law of long records has it; at a high SNR the deviation is the law's."""
    short, long = (std_of_one_log(plan(one, "guide_preload", 0.05, durations=(t,)))
                   for t in (60.0, 240.0))  # fmt: skip
    assert short / long == pytest.approx(2, rel=0.01)
    clear = _with_snr(one, 1e9)
    law = long_record_law(FREQUENCY[0], DAMPING[0], 240.0, 8.0)[0]
    known = float(law) * np.sqrt(FIVE_LOGS) / SENSITIVITY["guide_preload"][0]
    found = std_of_one_log(plan(clear, "guide_preload", 0.05, durations=(240.0,)))
    assert found == pytest.approx(known, rel=0.05)
    assert found < long


def _with_snr(stage: Stage, snr: float) -> Stage:
    modes = tuple(structs.replace(mode, snr=snr) for mode in stage.modes)
    return replace(stage, description=structs.replace(stage.description, mode=modes))


def test_more_is_never_worse(two: Stage) -> None:
    """Longer logs, more of them, a larger loss, a longer baseline: each helps."""
    found = plan(two, "guide_preload", 0.03, durations=(10.0, 20.0, 60.0, 120.0, 300.0))
    counts = [effort.n_logs or 10**6 for effort in found.efforts]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1] == 1
    assert (np.diff([effort.power for effort in found.efforts]) > 0).all()
    assert all(effort.smallest_loss_many < effort.smallest_loss for effort in found.efforts)
    larger = plan(two, "guide_preload", 0.06, durations=(10.0,)).efforts[0]
    assert larger.power > found.efforts[0].power


def test_the_baseline_bounds_what_more_logs_can_do(tmp_path: Path) -> None:
    """No number of logs suffices for a baseline of five, some do for a hundred."""
    few = make_stage(tmp_path / "few")
    many = make_stage(tmp_path / "many", tail="[baseline]\nlogs = 100")
    # Two groups of five detect this; unlimited logs against five would detect 1/√2 of it.
    least = plan(few, "guide_preload", 0.05, durations=(10.0,)).efforts[0].smallest_loss_many
    near, beyond = (plan(few, "guide_preload", share * least, durations=(10.0,)).efforts[0]
                    for share in (0.75, 0.69))  # fmt: skip
    assert near.n_logs is not None
    assert near.n_logs > 5
    assert (beyond.n_logs, beyond.hindrance) == (None, "baseline")
    longer = plan(many, "guide_preload", 0.69 * least, durations=(10.0,)).efforts[0]
    assert longer.n_logs is not None
    assert longer.hindrance == ""


def test_what_other_parameters_hide_no_log_shows(tmp_path: Path) -> None:
    """One mode cannot separate two parameters beyond their priors."""
    stage = make_stage(tmp_path, n_modes=1)
    found = plan(stage, "mount_stiffness", 0.1, durations=(60.0, 600.0))
    assert [effort.hindrance for effort in found.efforts] == ["parameters"] * 2
    assert found.duration_of_one is None
    with pytest.raises(BadQuestion, match="do not identify guide_preload"):
        plan(stage, "guide_preload", 0.1)


def test_logs_too_short_to_be_identified_are_told(one: Stage) -> None:
    """What identification would refuse has no power at any number of logs."""
    effort, longer = plan(one, "guide_preload", 0.05, durations=(0.3, 1.0)).efforts
    assert (effort.n_logs, effort.hindrance) == (None, "too-short")
    assert np.isnan([effort.power, effort.smallest_loss, effort.smallest_loss_many]).all()
    assert longer.hindrance != "too-short"


@pytest.mark.parametrize("model_std", [0.0, 0.05])
def test_a_parameter_that_no_mode_feels_is_refused(tmp_path: Path, model_std: float) -> None:
    """Sensitivities, the prior and the next step are named."""
    stage = make_stage(tmp_path, (PRELOAD, FOOT), model_std=model_std)
    with pytest.raises(BadQuestion, match=r"do not identify foot.*roll .*Track a mode"):
        plan(stage, "foot", 0.2)
    assert plan(stage, "guide_preload", 0.2).efforts[-1].n_logs == 1


def test_the_x_stage_does_not_show_its_mount_and_the_y_stage_does() -> None:
    """The shipped descriptions: preload can be planned on both, the mount on Y alone."""
    x, y = load_stage("lms-x"), load_stage("lms-y")
    with pytest.raises(BadQuestion, match="do not identify mount_stiffness"):
        plan(x, "mount_stiffness", 0.3)
    for stage, name in ((x, "guide_preload"), (y, "guide_preload"), (y, "mount_stiffness")):
        assert plan(stage, name, 0.05).duration_of_one is not None


@pytest.mark.parametrize("loss", [-0.1, 0.0, 1.0, 1.5, np.nan])
def test_a_loss_is_a_fraction(one: Stage, loss: float) -> None:
    """Neither nothing nor everything, nor percents."""
    with pytest.raises(BadQuestion, match="between 0 and 1"):
        plan(one, "guide_preload", loss)


def test_questions_without_an_answer_are_refused(one: Stage, tmp_path: Path) -> None:
    """Unknown names with those that are known, losses beyond the map, power below false alarms."""
    with pytest.raises(BadQuestion, match=r"'preload'; there are \['guide_preload'\]"):
        plan(one, "preload", 0.05)
    with pytest.raises(OutsideMap):
        plan(one, "guide_preload", 0.9)
    with pytest.raises(BadQuestion, match="false alarm < power"):
        plan(one, "guide_preload", 0.05, power=0.01, false_alarm=0.05)
    for duration in (np.nan, np.inf, 0.0, -1.0):
        with pytest.raises(BadQuestion, match="finite duration"):
            plan(one, "guide_preload", 0.05, durations=(10.0, duration))
    bare = load_stage(str(write_archive_stage(tmp_path, health=False)))
    with pytest.raises(BadStage, match=r"no \[map\]"):
        plan(bare, "guide_preload", 0.05)


@pytest.mark.parametrize("shipped", ["lms-x", "lms-y"])
@pytest.mark.parametrize("name", ["guide_preload", "mount_stiffness"])
def test_a_plan_and_a_check_agree_about_the_same_logs(shipped: str, name: str) -> None:
    """Of as many logs as the baseline both have one deviation of the value, and one of a change."""
    stage = load_stage(shipped)
    (checked,) = (one for one in check_stage(stage).parameters if one.name == name)
    if checked.verdict == "not-identifiable":
        with pytest.raises(BadQuestion, match="do not identify mount_stiffness"):
            plan(stage, name, 0.05)
        assert (shipped, name) == ("lms-x", "mount_stiffness")
        return
    (effort,) = plan(stage, name, 0.05, durations=(TYPICAL_DURATION,)).efforts
    assert effort.value_std == checked.usual_std
    change = float(-np.log1p(-effort.smallest_loss_many) / LEVELS)
    assert change == pytest.approx(checked.change_std, rel=1e-9)
    assert checked.change_std < 0.5 * checked.usual_std  # the map's error is 5 % here
