"""Machines for the study: lives with what is true of their health, and maps that are wrong."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np

from lmshealth.prognosis.scenarios import list_scenarios
from lmshealth.stage.description import Stage, load_stage
from lmshealth.stage.identifiability import identifiability_of, identifiable_parameters
from lmshealth.stage.modal_map import ModalMap, read_map
from models.dynamics.modal_map import modal_map
from models.dynamics.plant import GUIDE_MODES
from models.dynamics.stages import stage_named
from models.lives.simulation import Visit, schedule
from studies.common.lives import HEALTHY, Array, Estimates, Life, life_of, life_with, plan_of
from studies.sbc_life.run import always_losing

PARAMETERS = ("guide_preload", "mount_stiffness")
# Plants whose map is believed in place of the true one: what is wrong, by which factor.
WRONG_PLANTS: dict[str, dict[str, float]] = {
    "masses 10 % more, load 10 % higher": {
        "moving_mass": 1.1, "housing_mass": 1.1, "load_height": 1.1},
    "preload exponent 5 % more": {"preload_exponent": 1.05},
    "guide 10 % stiffer": {"block_stiffness": 1.1},
    "blocks 10 % farther apart": {"block_half_spacing": 1.1},
}  # fmt: skip
_KM = 1000.0
_REDRAWS = 200


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One life, its estimates, and the truth that is asked for."""

    life: Life  # What is so at every log
    estimates: Estimates  # What identification gives
    health: Array  # Fractions of their value at the first log, shape ``(n_logs, 2)``
    # Travel in m since the first log at which each limit is reached, infinite if never, shape
    # ``(2,)``
    passage: Array
    losing: bool = False  # Whether it is known that every parameter loses


@cache
def stage_with(name: str, model_std: float, plant: str = "", *, losing: bool = False) -> Stage:
    """Load a description with another error of its map, or with the map of a wrong plant.

    With ``losing`` it has no law by which a parameter keeps its value.
    """
    stage = always_losing(load_stage(name)) if losing else load_stage(name)
    assert stage.description.map is not None
    spec = msgspec.structs.replace(stage.description.map, model_std=model_std)
    surrogate = _wrong_map(name, plant) if plant else stage.modal_map
    return replace(
        stage,
        description=msgspec.structs.replace(stage.description, map=spec),
        modal_map=surrogate,
    )


@cache
def told(name: str) -> dict[str, bool]:
    """Say which parameters the modes of a stage tell at all; ``any`` stands for all of them."""
    seen = identifiability_of(load_stage(name))
    shown = identifiable_parameters([seen], [range(len(seen.parameters))], seen.prior)
    return {
        **dict(zip(seen.parameters, shown.tolist(), strict=True)),
        "any": bool(shown.all()),
    }


@cache
def _wrong_map(name: str, plant: str) -> ModalMap:
    """Make the map of a stage with some numbers wrong."""
    stage = stage_named(name)
    wrong = {}
    for field, factor in WRONG_PLANTS[plant].items():
        number = getattr(stage, field)
        value = number.value
        scaled = tuple(factor * x for x in value) if isinstance(value, tuple) else factor * value
        wrong[field] = replace(number, value=scaled)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.csv"
        modal_map(replace(stage, **wrong)).to_csv(path, index=False)
        return read_map(str(path), PARAMETERS)


def modelled(stage: str, kind: str, seed: int, identify: Callable[[Life], Estimates]) -> Case:
    """Take a life of `models` and estimates of it."""
    plan = plan_of(stage, kind, seed)
    life = life_of(plan)
    limits = plan.draw_life().limits_km()
    ends = [np.inf if limits[name] is None else _KM * limits[name] for name in PARAMETERS]
    return Case(
        life,
        identify(life),
        life.health / life.health[0],
        np.array(ends) - life.travel[0],
    )


def on_path(stage: str, seed: int, rng: np.random.Generator) -> Life:
    """Take a life that ends at health drawn from the prior and goes there evenly."""
    last = np.exp(load_stage(stage).prior.draw(rng, 1)[0])
    kind, visits = _healthy(stage, seed, rng)
    s = np.array([visit.travel_km - visits[0].travel_km for visit in visits])
    health = last ** (s / s[-1])[:, None]
    return life_with(plan_of(stage, kind, seed), _with_health(visits, health))


def by_law(stage: str, seed: int, rng: np.random.Generator) -> tuple[Life, Array]:
    """Take a life whose scenario is drawn from its prior: the life, and where its limits are, in m.

    Each parameter follows one of the laws by which it loses, and does not deviate from it. Only
    lives that stay inside the map until now are possible for who believes in the map.
    """
    description = always_losing(load_stage(stage))
    assert description.modal_map is not None
    kind, visits = _healthy(stage, seed, rng)
    s = _KM * np.array([visit.travel_km - visits[0].travel_km for visit in visits])
    scenarios = list_scenarios(description.parameters, (), s[-1])
    for _ in range(_REDRAWS):
        scenario = scenarios[rng.choice(len(scenarios), p=[one.weight for one in scenarios])]
        theta = scenario.natural(scenario.draw(rng, 1))
        health = scenario.health(theta, s)[0]
        if health.min() > 0 and description.modal_map.inside(np.log(health)).all():
            break
    else:
        raise RuntimeError(f"{stage}: no life of {_REDRAWS} stays inside the map")
    ends = [
        path.passage(own, p.limit.below)[0] if p.limit else np.inf
        for path, own, p in zip(
            scenario.paths, scenario.split(theta), description.parameters, strict=True
        )
    ]
    life = life_with(plan_of(stage, kind, seed), _with_health(visits, health))
    return life, np.array(ends)


def _healthy(stage: str, seed: int, rng: np.random.Generator) -> tuple[str, list[Visit]]:
    """Draw which effects without wear a life has: hall, payload, retuning, grease or none."""
    kind = str(rng.choice(HEALTHY))
    return kind, schedule(plan_of(stage, kind, seed))


def _with_health(visits: list[Visit], health: Array) -> list[Visit]:
    return [
        replace(visit, condition=replace(
            visit.condition, guide_preload=float(preload), mount_stiffness=float(mount)))
        for visit, (preload, mount) in zip(visits, health, strict=True)
    ]  # fmt: skip


def alone(stage: Stage, health: Array) -> Array:
    """Drifts of the modes by each parameter alone, shape ``(n_parameters, n_points, n_modes)``."""
    x = np.log(health)
    only = np.zeros((x.shape[1], *x.shape))
    for j in range(x.shape[1]):
        only[j, :, j] = x[:, j]
    return np.stack([stage.drift(own, GUIDE_MODES) for own in only])


def elsewhere(life: Life, model_std: float, rng: np.random.Generator) -> Life:
    """Move a life to a machine whose sensitivities are not those of its map.

    What each parameter alone does to each mode is more or less by a relative error of standard
    deviation `model_std`, the same over the whole life: the map is then wrong by as much.
    """
    parts = alone(load_stage(life.stage), life.health)
    error = model_std * rng.standard_normal((parts.shape[0], 1, parts.shape[2]))
    moved = np.sum(error * parts, axis=0)
    return replace(life, ln_frequency=life.ln_frequency + moved, drift=life.drift + moved)
