"""Calibration of whole lives on truths drawn from the stated priors.

Of lives that fade posteriors are integrated on grids, so that the check is of the model and not of
the sampler; of the lives of the shipped description they are drawn, up to the remaining life.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lmshealth._private.arrays import FloatArray
from lmshealth.calibration.check import quantities, ranks_of, true_quantities
from lmshealth.calibration.lives import map_errors
from lmshealth.calibration.ranks import place
from lmshealth.life import constants
from lmshealth.life.fleet_prior import machine_evidence, needs_fleet_prior
from lmshealth.life.posterior.fit import fit_life
from lmshealth.life.posterior.likelihood import LifeDensity, LifeLikelihood
from lmshealth.life.prognosis import _usage, passages, prognosis_of
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from studies.life.calibration.run import drawn_life, machine
from studies.life.fleet.lives import YOUNG, draw_fleet
from studies.life.fleet.lives import draw as draw_machine
from studies.life.fleet.run import (
    MOST_DRAWN,
    SMALL,
    described,
    evidence_of,
    horizon,
    learned_prior,
    posterior,
)
from tests.claims import Claims
from tests.lives import (
    AXES,
    FADING,
    FREQUENCY,
    SENSITIVITY,
    TEMPERATURE,
    make_history,
    make_stage,
    true_drift,
)
from tests.oracles import cdf_at
from tests.statistical.evidence import uniform

N_LOGS = 12
# Lives follow the law and the map: without a change of another course, of a mode alone, or a wander
# of all modes together.
BY_LAW = f"{TEMPERATURE}\n[life]\nfree = 0\nlone_mode = 0\ncommon_wander = 0\n"


def draw_history(rng: np.random.Generator, stage: Stage) -> tuple[History, float, float]:
    """Draw a life of a fading preload, its loss by the law and its health now, from all priors."""
    travel = np.cumsum(np.r_[1e5, rng.uniform(5e4, 4e5, N_LOGS - 1)])
    clock = travel - travel[0]
    now = clock[-1]
    low, high = AXES["guide_preload"][[0, -1]]
    while not low < 1 - (loss := rng.normal(0, 2e-7) * now) < high:
        pass
    drift = true_drift(("guide_preload",), np.log(1 - loss * clock / now)[:, None])[:, :2]
    drift = drift * (1 + map_errors(rng, stage, 2)[0])
    temperature = 21 + 4 * rng.standard_normal(N_LOGS)
    drift += np.outer(temperature - 21, rng.normal(0, 1e-3, 2))
    steps = np.sqrt(np.diff(clock) / now)[:, None] * rng.standard_normal((N_LOGS - 1, 2))
    walk = rng.choice(constants.WALK_STDS, p=constants.WALK_PRIOR)
    drift[1:] += walk * np.cumsum(steps, axis=0)
    deviation = rng.choice(constants.DEVIATION_STDS, p=constants.DEVIATION_PRIOR)
    steps = np.sqrt(np.diff(clock) / now) * rng.standard_normal(N_LOGS - 1)
    off = deviation * np.r_[0, np.cumsum(steps)]
    drift += np.outer(off, SENSITIVITY["guide_preload"][:2])
    scale = rng.choice(constants.NOISE_SCALES, p=constants.NOISE_SCALE_PRIOR)
    noise = scale * 1e-3 * rng.standard_normal((N_LOGS, 2))
    history = make_history(
        np.log(FREQUENCY[:2]) + drift + noise, travel=travel, temperature=temperature
    )
    return history, float(loss), float((1 - loss) * np.exp(off[-1]))


def integrated(density: LifeDensity) -> tuple[FloatArray, FloatArray]:
    """Posterior density of the loss by the law, on a coarse then a fine grid."""
    low, high = 1 - AXES["guide_preload"][[-1, 0]]
    for _ in range(2):
        y = np.linspace(low, high, 241)
        value = density.log_probability(y[:, None])
        weight = np.exp(value - value.max())
        likely = y[weight > 1e-7]
        step = y[1] - y[0]
        low, high = likely[0] - step, likely[-1] + step
    return y, weight


def density_of(history: History, stage: Stage) -> LifeDensity:
    """Give the density of the only scenario."""
    likelihood = LifeLikelihood.of(history, stage)
    return LifeDensity(likelihood, likelihood.data.scenarios[0], likelihood.grid)


def level_of_health(
    density: LifeDensity, rng: np.random.Generator, truth: float, n: int = 400
) -> float:
    """Posterior probability of less health now than the truth: the law times how far it is off."""
    y, weight = integrated(density)
    drawn = rng.choice(y, n, p=weight / weight.sum())[:, None]
    nuisances, now = density.draw_nuisances(drawn, rng), np.array([density.likelihood.data.now])
    off = density.deviations(drawn, nuisances, now, rng)
    return float(np.mean((1 - drawn) * np.exp(off[:, 0]) < truth))


def test_losses_by_laws_are_calibrated(
    rng: np.random.Generator, claims: Claims, tmp_path: Path
) -> None:
    """All that is not known drawn from its prior: losses by the law are covered, and so is health.

    Control: on the same lives a map that is taken as exact.
    """
    honest = make_stage(tmp_path / "honest", (FADING,), model_std=0.2, tail=BY_LAW)
    proud = make_stage(tmp_path / "proud", (FADING,), model_std=0.0, tail=BY_LAW)
    found, health, wrong = [], [], []
    for _ in range(claims.trials):
        history, loss, left = draw_history(rng, honest)
        density = density_of(history, honest)
        found.append(cdf_at(*integrated(density), loss))
        health.append(level_of_health(density, rng, left))
        rash = density_of(history, proud)
        wrong.append((cdf_at(*integrated(rash), loss), level_of_health(rash, rng, left)))
    claims.claim("loss by the law", uniform(found))
    claims.claim("health now", uniform(health))
    for name, own in zip(claims.part.claims, np.transpose(wrong), strict=True):
        claims.control(name, uniform(own))


def test_health_off_its_law_is_calibrated(
    rng: np.random.Generator, claims: Claims, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where most lives stray far from their law, by modes that wander little, health is covered.

    Control: taken never to leave its law, it is not.
    """
    monkeypatch.setattr(constants, "WALK_STDS", (1e-5, 5e-4, 1.5e-3))
    monkeypatch.setattr(constants, "WALK_PRIOR", (0.3, 0.3, 0.4))
    monkeypatch.setattr(constants, "DEVIATION_STDS", (0.0, 0.13))
    monkeypatch.setattr(constants, "DEVIATION_PRIOR", (0.1, 0.9))
    stage = make_stage(tmp_path, (FADING,), model_std=0.2, tail=BY_LAW)
    found, wrong = [], []
    for _ in range(claims.trials):
        history, _, left = draw_history(rng, stage)
        density = density_of(history, stage)
        found.append(level_of_health(density, rng, left))
        lawful = replace(density, grid=density.grid[density.grid.deviation == 0])
        wrong.append(level_of_health(lawful, rng, left))
    claims.claim("health now, off its law", uniform(found))
    claims.control("health now, off its law", uniform(wrong))


def worsened(name: str, draws: FloatArray) -> FloatArray:
    """Return wrong draws of a quantity; an end that never comes is one at the horizon."""
    if "changes" in name:
        return 1 - draws
    if "off its law" in name:
        return draws - 0.2
    if "now" in name:
        return 0.8 * draws
    return np.nan_to_num(draws, posinf=1000 * machine().description.usage.horizon_km) / 4


def test_ranks_of_whole_lives_are_uniform(rng: np.random.Generator, claims: Claims) -> None:
    """Of the shipped Y stage health now, whether a part wears and what remains is one more draw.

    Controls are of what narrower draws would hide where many of them tie: the contrary of whether a
    part wears, a fifth less of health, and a quarter of what remains.
    """
    places, wrong = [], []
    for _ in range(claims.trials):
        drawn = drawn_life(rng)
        truth = true_quantities(drawn, machine(), rng)
        found = fit_life(drawn.history, machine(), int(rng.integers(1 << 32)), chains=False)
        draws = quantities(found, machine(), prognosis_of(found, drawn.history, machine()))
        draws = {name: own for name, own in draws.items() if name in claims.part.claims}
        worse = {name: worsened(name, own) for name, own in draws.items()}
        places.append(ranks_of(truth, draws, rng))
        wrong.append(ranks_of(truth, worse, rng))
    for name in claims.part.claims:
        claims.claim(name, uniform([own[name] for own in places]))
        claims.control(name, uniform([own[name] for own in wrong]))


def test_young_machines_are_told_right_by_their_fleet(
    rng: np.random.Generator, claims: Claims
) -> None:
    """The true remaining life of a young machine is one more draw with the prior of its fleet.

    One machine of each fleet counts, the first that is young. Control: a quarter of what remains.
    """
    limit = described().parameters[0].limit
    assert limit is not None
    places, wrong = list[float](), list[float]()
    while len(places) < claims.trials:
        fleet = draw_fleet(rng, described())
        number = int(rng.integers(1 << 32))
        mature = evidence_of(rng, fleet, SMALL, number)
        for _ in range(MOST_DRAWN):
            young = draw_machine(rng, fleet, YOUNG)
            evidence = machine_evidence(described(), posterior(young, described(), number))
            if (
                needs_fleet_prior(evidence)
                and (prior := learned_prior(evidence, mature)) is not None
            ):
                break
        else:
            continue
        told = posterior(young, prior.apply_to(described()), number)
        left, _ = passages(
            told, [(0, described().parameters[0])], rng, now=young.now, horizon=horizon()
        )
        draws = np.minimum(left, horizon())
        truth = np.array([young.part.left(rng, young.now, limit.below, horizon())])
        for factor, kept in ((1.0, places), (0.25, wrong)):
            kept.append(place(factor * draws, truth, rng, horizon=horizon())[0])
    claims.claim("remaining life", uniform(places))
    claims.control("remaining life", uniform(wrong))


def test_usage_covers_what_comes(rng: np.random.Generator, claims: Claims, tmp_path: Path) -> None:
    """The travel of weeks to come is one more draw, also after few logs.

    Control: the mean of years to come, which says too little of few weeks.
    """
    stage = make_stage(tmp_path, (FADING,))
    for name, n, weeks in (("twenty weeks", 20, 20), ("three weeks", 5, 3)):
        levels, wrong = list[float](), list[float]()
        for _ in range(claims.trials):
            steps = 1.4e5 * (1 + 0.1 * rng.standard_normal(n))
            still = np.tile(np.log(FREQUENCY[:2]), (n + 1, 1))
            history = make_history(still, travel=np.r_[0, np.cumsum(steps)])
            truth = 1.4e5 / 7 * (1 + 0.1 * rng.standard_normal(weeks).mean())
            for found, left in ((levels, weeks * 1.4e5), (wrong, 4e7)):
                usage, _ = _usage(history, stage, rng, np.full(500, left), 4e7)
                found.append(np.mean(usage < truth))
        claims.claim(name, uniform(levels))
        claims.control(name, uniform(wrong))
