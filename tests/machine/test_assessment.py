"""Assessment of a machine: what samples a life, what is kept for the next log, and what is past."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmshealth import examples
from lmshealth._private.serialize import pack, unpack
from lmshealth.calibration.lives import make_history
from lmshealth.errors import NotEnoughData
from lmshealth.life import constants
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.life.prognosis import prognosis_of
from lmshealth.machine import assessment as assessing
from lmshealth.machine.assessment import Assessment, LifeState
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.history import Series, build_history
from lmshealth.tracking.maintenance import NO_MAINTENANCE, Action, Maintenance
from lmshealth.tracking.track import track
from tests.lives import FADING, FREQUENCY, LAWS_ALONE, make_reading, make_stage, true_drift


@pytest.fixture
def stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stage:
    """Make a preload that fades, and few points of the grid."""
    monkeypatch.setattr(constants, "WALK_STDS", (1e-4,))
    monkeypatch.setattr(constants, "WALK_PRIOR", (1.0,))
    monkeypatch.setattr(constants, "DEVIATION_STDS", (0.0,))
    monkeypatch.setattr(constants, "DEVIATION_PRIOR", (1.0,))
    return make_stage(tmp_path, (FADING,), n_modes=3, tail=LAWS_ALONE)


def readings(n: int, *, loss: float = 0.0) -> list[LogEstimates]:
    """Make the estimates of so many weekly logs, with a loss by log 40."""
    rng, made = np.random.default_rng(1), []
    for k in range(n):
        x = np.log([1 - loss * k / 40])
        ln_f = np.log(FREQUENCY) + true_drift(("guide_preload",), x) + 1e-4 * rng.normal(size=3)
        modes = dict(zip(("roll", "pitch", "yaw"), ln_f.tolist(), strict=True))
        one = make_reading(f"{k:02d}.csv", 7.0 * k, 1e5 * k, modes)
        cov = np.diag([2.5e-7] * 3 + [0.05**2] * 3)
        ln_damping = np.log([0.018, 0.015, 0.017])
        made.append(replace(one, modes=replace(one.modes, cov=cov, ln_damping=ln_damping)))
    return made


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[tuple[bool, bool]]:
    """List of each fit whether chains ran, and whether it began with draws; none really run."""
    seen: list[tuple[bool, bool]] = []

    def counting(*given: Any, chains: bool = True, **options: Any) -> LifePosterior:
        seen.append((chains, options.get("before") is not None))
        life = fit_life(*given, chains=False, **options)
        return replace(life, sampler="emcee" if chains else "importance")

    monkeypatch.setattr(assessing, "fit_life", counting)
    return seen


def assess_from(
    logs: list[LogEstimates], stage: Stage, before: LifeState | None
) -> tuple[Assessment, LifeState | None]:
    """Assess a machine without maintenance from the state before."""
    how: dict[str, int] = {"epochs": 5, "seed": 0}
    return assessing.assess_from(logs, stage, NO_MAINTENANCE, **how, before=before)


def test_emcee_samples_the_first_and_each_sixteenth_log(
    stage: Stage, fits: list[tuple[bool, bool]]
) -> None:
    """In between importance sampling updates, from draws that a store has kept, and says so."""
    before: LifeState | None = None
    found = {}
    for n in (13, 14, 15, 16, 17, 31, 33):
        made, after = assess_from(readings(n), stage, before)
        assert made.health is not None and after is not None
        (found[n],) = set(made.health.sampler)
        assert made.judgement.verdict == after.verdict == "healthy"
        assert after.n_logs == n
        before = unpack(pack(after), LifeState)
    emcee = [n for n, sampler in found.items() if sampler == "emcee"]
    assert emcee == [13, 16, 33]
    assert fits == [(n in emcee, n > 13) for n in found]


def test_a_new_life_is_not_updated_from_the_old_one(
    stage: Stage, fits: list[tuple[bool, bool]]
) -> None:
    """After a baseline chains run without the draws of the life before."""
    logs = readings(20)
    _, before = assess_from(logs[:17], stage, None)
    logs[10] = replace(logs[10], metadata=replace(logs[10].metadata, baseline=True))
    fits.clear()
    assess_from(logs[:18], stage, before)
    assert fits == [(True, False)]


@pytest.mark.parametrize("log", [3, 12])
def test_what_a_table_corrects_of_ended_lives_begins_anew(
    stage: Stage, fits: list[tuple[bool, bool]], log: int
) -> None:
    """The odometer of a log before the baseline is another; that of a later log is an update."""
    logs = readings(17)
    logs[10] = replace(logs[10], metadata=replace(logs[10].metadata, baseline=True))
    _, before = assess_from(logs, stage, None)
    fits.clear()
    moved = replace(logs[log].metadata, travel=1e5 * log + 5e4)
    logs[log] = replace(logs[log], metadata=moved)
    assess_from(logs, stage, before)
    assert fits == [(log < 10, log > 10)]


def test_logs_and_work_of_other_machines_are_not_assessed(stage: Stage) -> None:
    """Work on another machine is left out; its logs are an error."""
    logs = readings(4)
    machine, moment = logs[0].metadata.stage, logs[2].metadata.recorded_at
    assert machine is not None and moment is not None
    elsewhere = Maintenance((Action("another", moment, "guide-replaced"),))
    found = assessing.assess(logs, stage, work=elsewhere, epochs=1)
    assert found.history.logs == tuple(one.log for one in logs) and not found.history.baseline
    other = replace(logs[3], metadata=replace(logs[3].metadata, stage="another"))
    with pytest.raises(NotEnoughData, match=f"2 machines: .*{machine}.*; needed is one"):
        assessing.assess([*logs[:3], other], stage)


def test_a_drift_is_that_of_a_source_with_an_estimate(stage: Stage) -> None:
    """Roll falls by 5 % in the last of four logs, in which its first source has no estimate."""
    made, _ = assess_from(readings(4), stage, None)
    modes, n = ("roll", "pitch", "yaw"), 4
    series = (*(Series(mode, "acc") for mode in modes), Series("roll", "delta_e"))
    rng = np.random.default_rng(0)
    ln_f = np.asarray(np.log(FREQUENCY)[[0, 1, 2, 0]] + 3e-4 * rng.standard_normal((n, 4)))
    ln_f[-1, [0, 3]] -= 0.05
    cov = np.tile(np.diag([1e-7] * 4 + [0.05**2] * 4), (n, 1, 1))
    missing = np.zeros((n, 4), dtype=bool)
    missing[-1, 0] = True
    estimates = ln_f, np.full((n, 4), float(np.log(0.02))), cov
    history = make_history(modes, 1e5 * np.arange(4.0), estimates, series=series, missing=missing)
    found = replace(made, history=history, track=track(history, stage))
    assert found.drifted["roll"][0] == pytest.approx(-0.05, abs=1e-3)


def test_emcee_samples_where_the_verdict_changes(
    stage: Stage, fits: list[tuple[bool, bool]]
) -> None:
    """An update that turns healthy to degraded is repeated by chains, and these are published."""
    _, before = assess_from(readings(17, loss=0.2), stage, None)
    assert before is not None and before.verdict == "healthy"
    fits.clear()
    made, after = assess_from(readings(31, loss=0.2), stage, before)
    assert made.health is not None and after is not None
    assert made.judgement.verdict == after.verdict == "preload"
    assert set(made.health.sampler) == {"emcee"}
    assert fits == [(False, True), (True, True)]


def test_an_assessment_alone_is_by_emcee(stage: Stage, fits: list[tuple[bool, bool]]) -> None:
    """`assess` knows of no assessment before."""
    made = assessing.assess(readings(8), stage, epochs=3)
    assert made.health is not None
    assert set(made.health.sampler) == {"emcee"}
    assert len(made.health.recorded_at) == 3
    assert fits == [(True, False)]


def test_a_mode_that_moves_alone_is_the_verdict(tmp_path: Path) -> None:
    """Yaw by −2 % alone: outside-map, without a service by it, in words."""
    stage = make_stage(tmp_path, (FADING,), n_modes=3, tail="")
    made = []
    for k, one in enumerate(readings(24)):
        ln_f = one.modes.ln_frequency + np.array([0.0, 0.0, -0.02 * k / 23])
        made.append(replace(one, modes=replace(one.modes, ln_frequency=ln_f)))
    with pytest.MonkeyPatch.context() as patch:
        quick = lambda *given, chains=True, **more: fit_life(*given, chains=False, **more)  # noqa: E731
        patch.setattr(assessing, "fit_life", quick)
        found = assessing.assess(made, stage, epochs=3)
    assert found.judgement.verdict == "outside-map"
    assert found.judgement.probability > 0.9
    assert "Yaw has moved by −2.0" in found.judgement.why
    assert found.service().kind != "now"


def test_work_on_one_part_keeps_the_loss_of_the_other(fits: list[tuple[bool, bool]]) -> None:
    """Fractions of what was not restored are of commissioning: of the preload 72 % is left.

    Control: after work on the guide they are of the state after it, and the mount keeps its loss.
    """
    logs, stage = examples.readings(), load_stage("lms-y")
    machine, at = str(logs[0].metadata.stage), logs[12].metadata.recorded_at
    assert at is not None
    names = [one.name for one in stage.parameters]
    preload, mount = names.index("guide_preload"), names.index("mount_stiffness")
    found = {}
    for action in ("mount-tightened", "preload-adjust"):
        work = Maintenance((Action(machine, at, action),))
        made, after = assessing.assess_from(logs, stage, work, epochs=5, seed=0)
        assert made.history.baseline == 12
        assert made.carried is not None
        assert made.health is not None
        assert after is not None
        found[action] = made.carried, made.health
        # The next assessment takes over what is carried.
        n_fits = len(fits)
        again, _ = assessing.assess_from(logs, stage, work, epochs=5, seed=0, before=after)
        assert len(fits) - n_fits == 1
        assert again.carried is made.carried
    (left, tightened), (kept, adjusted) = found["mount-tightened"], found["preload-adjust"]
    assert (left[:, mount] == 0).all()
    assert (kept[:, preload] == 0).all()
    assert np.median(kept[:, mount]) < -0.03
    low, high = (tightened.latest(level)[preload] for level in (0.05, 0.95))
    assert low < 0.72 < high
    assert adjusted.latest(0.05)[preload] > 0.72


def test_a_loss_that_is_carried_may_be_past_the_limit(stage: Stage) -> None:
    """Half of the preload was lost before the baseline: below the limit, whatever came since."""
    history, logs = build_history(readings(20), stage)[0], np.log(np.full((10, 1), 0.5))
    life = fit_life(history, stage, 0, chains=False)
    before, after = (prognosis_of(one, history, stage) for one in (life, life.carrying(logs)))
    assert before.already_past()[-1] == 0
    assert after.already_past()[-1] == 1
    np.testing.assert_allclose(after.health, before.health / 2)
    np.testing.assert_allclose(after.curve_quantiles, before.curve_quantiles / 2, rtol=0.05)
