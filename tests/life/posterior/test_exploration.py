"""Evidences of scenarios with steps, from few draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from lmshealth.calibration.lives import make_history
from lmshealth.life.posterior.likelihood import NO_MODE, LifeDensity, LifeLikelihood, ln_health
from lmshealth.life.posterior.sampling import importance_sample
from lmshealth.life.posterior.scenarios import Scenario
from lmshealth.stage.description import load_stage
from lmshealth.tracking.history import Step

_N = 60
# Logs after steps, and the ln factors of preload and stiffness there.
JUMPS = {15: (-0.3, 0.3), 30: (0.5, -0.5), 45: (-0.2, -0.3)}


@pytest.fixture(scope="module")
def stepped() -> LifeLikelihood:
    """Return the likelihood of a life with three steps of both parameters."""
    stage, rng = load_stage("lms-y"), np.random.default_rng(2)
    assert stage.description.map is not None
    # Without what keeps the factors wide however many logs there are.
    exact = structs.replace(stage.description.map, common_std=0.0)
    stage = replace(stage, description=structs.replace(stage.description, map=exact))
    modes, x = stage.informative, np.tile(stage.baseline_point, (_N, 1))
    for first, jump in JUMPS.items():
        x[first:] += jump
    noise = 3e-4 * rng.standard_normal((_N, 2 * len(modes)))
    ln_f = np.log(100.0) + stage.drifts(x, modes)[0] + noise[:, : len(modes)]
    cov = np.tile(9e-8 * np.eye(2 * len(modes)), (_N, 1, 1))
    steps = tuple(Step.found("step", first, _N) for first in JUMPS)
    estimates = ln_f, noise[:, len(modes) :], cov
    history = make_history(modes, np.linspace(0.0, 1e6, _N), estimates, steps=steps)
    return LifeLikelihood.of(history, stage)


def scenario(likelihood: LifeLikelihood, *laws: str) -> Scenario:
    """Return the scenario of these laws from the baseline on, with steps."""
    return next(
        one
        for one in likelihood.data.scenarios
        if one.steps and [path.law.kind for path in one.paths] == list(laws) and not one.restarts
    )


def density_of(likelihood: LifeLikelihood, one: Scenario) -> LifeDensity:
    """Return the density at the reported errors, exact laws and small walks."""
    grid = likelihood.grid
    few = (grid.noise_scale == 1) & (grid.deviation == 0) & (grid.lone == NO_MODE)
    return LifeDensity(likelihood, one, grid[few & (grid.walk < 2e-3)])


@pytest.mark.parametrize("laws", [("none", "none"), ("hertz-wear", "loosening")])
def test_few_draws_have_the_evidence_of_many(
    stepped: LifeLikelihood, laws: tuple[str, str]
) -> None:
    """Within 1 of its logarithm. Negative control: steps that begin with draws of their prior."""
    one, rng = scenario(stepped, *laws), np.random.default_rng(1)
    density = density_of(stepped, one)

    def evidence(n: int, *, given_laws: bool) -> float:
        start = one.draw(rng, n)
        if given_laws:
            start = stepped.steps_given_laws(density.grid, one, start, rng)
        return importance_sample(density.log_probability, start, rng, n).log_evidence

    many = evidence(6000, given_laws=True)
    few = [evidence(300, given_laws=True) for _ in range(4)]
    assert np.abs(np.array(few) - many).max() < 1.0
    control = [evidence(300, given_laws=False) for _ in range(4)]
    assert np.median(control) < many - 5.0


def test_steps_are_near_their_values_given_the_laws(stepped: LifeLikelihood) -> None:
    """Where no parameter changes otherwise the factors are found; other coordinates stay."""
    none = scenario(stepped, "none", "none")
    rng, n = np.random.default_rng(3), 400
    grid = density_of(stepped, none).grid
    found = stepped.steps_given_laws(grid, none, none.draw(rng, n), rng)
    assert (none.step_columns == np.arange(6)).all()
    true = np.array(list(JUMPS.values())).T.ravel()
    assert (np.abs(np.median(found, axis=0) - true) < 2 * found.std(axis=0)).all()
    assert (found.std(axis=0) < 0.1).all()
    wear = scenario(stepped, "hertz-wear", "loosening")
    y = wear.draw(rng, n)
    changed = np.any(stepped.steps_given_laws(grid, wear, y, rng) != y, axis=0)
    assert np.flatnonzero(changed).tolist() == wear.step_columns.tolist()


def test_laws_that_have_ended_are_no_error(stepped: LifeLikelihood) -> None:
    """Their lives are outside the map; the factors are numbers all the same."""
    wear, rng = scenario(stepped, "hertz-wear", "loosening"), np.random.default_rng(4)
    y = wear.draw(rng, 40)
    y[:, 0] = 5.0  # ended long before now
    assert not ln_health(stepped.data.stage, wear, y, stepped.basis.moments)[1].any()
    found = stepped.steps_given_laws(density_of(stepped, wear).grid, wear, y, rng)
    assert np.isfinite(found).all()
