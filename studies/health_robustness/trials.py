"""What is asked of one life, and how the answers of many are summed up."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from unittest.mock import patch

import msgspec
import numpy as np

from lmshealth.health.epoch_posterior import EpochPosterior
from lmshealth.health.importance_sampling import importance_sample_to_ess
from lmshealth.prognosis import constants
from lmshealth.prognosis.life_posterior import fit_life
from lmshealth.prognosis.remaining_life import parameters_with_limit, passages
from lmshealth.prognosis.scenarios import list_scenarios
from lmshealth.stage.description import Stage, load_stage
from lmshealth.stage.identifiability import identifiability_of, identifiable_parameters
from lmshealth.stage.modal_map import ModalMap, read_map
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track, accepted_estimates, track
from models.dynamics.modal_map import modal_map
from models.dynamics.plant import GUIDE_MODES
from models.dynamics.stages import stage_named
from models.lives.simulation import Visit, schedule
from studies.common import lives
from studies.common.lives import Array, Estimates, Life
from studies.common.metrics import place
from studies.harness.study import Row, judge_coverage
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

    life: Life
    estimates: Estimates
    health: Array  # Fractions of their value at the first log, (n_logs, 2)
    passage: Array  # Travel in m since then to each limit, infinite if never, (2,)
    losing: bool = False  # Whether it is known that every parameter loses


_N_PRIOR, _N_POINTS, _N_DRAWS = 1000, 2000, 4000

NOMINALS = (0.9, 0.5)
_LEVELS = (0.05, 0.5, 0.95)
ENDS = (*PARAMETERS, "any")


@dataclass(frozen=True, slots=True)
class Answer:
    """One posterior against its truth: one parameter of one life."""

    place: float  # Posterior probability below the truth
    error: float  # Posterior median minus truth, of ln health, or of the travel left in km
    z: float  # The same over the posterior standard deviation
    width: float  # Of the 90 % interval, in the same unit
    third: bool  # Whether the truth lies inside that interval shrunk to a third about the median


@dataclass(frozen=True, slots=True)
class Arm:
    """What the estimator believes."""

    name: str
    model_std: float  # Relative error of the map's sensitivities
    shrink: float = 1.0  # Factor on the covariance of estimates, unknown to the estimator
    independent: float = 0.0  # Relative error of the map, as if it were new at every log


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """A life as the estimator has it."""

    case: Case
    track: Track
    history: History  # as the track takes it: with the steps that it found, and without outliers


def followed(cases: Iterable[Case], stage: Stage) -> list[Followed]:
    """Track lives."""
    found = []
    for case in cases:
        history = lives.history_of(case.life, case.estimates)
        own = track(history, stage)
        found.append(Followed(case, own, accepted_estimates(history, own)))
    return found


def at_epoch(
    one: Followed, stage: Stage, epoch: int, rng: np.random.Generator, shrink: float = 1.0
) -> list[Answer]:
    """Ask for health at one epoch, without a law."""
    draws = epoch_draws(one.track, stage, epoch, rng, shrink)
    return _answers(np.log(draws), np.log(one.case.health[epoch]), rng)


def by_laws(
    one: Followed, stage: Stage, arm: Arm, rng: np.random.Generator
) -> tuple[list[Answer], list[Answer]]:
    """Ask for health now and for the travel left, by the laws, of the whole life."""
    case, cov = one.case, arm.shrink * one.history.cov
    if arm.independent:
        # As noise of each log, of the size that the error has where the truth is.
        parts = alone(stage, case.health)
        at = np.arange(parts.shape[2])
        cov[:, at, at] += arm.independent**2 * np.sum(parts**2, axis=0)
    given = replace(one.history, cov=cov)
    now, left = life_draws(given, stage, rng, noise_known=arm.shrink != 1)
    ends = case.passage - (case.life.travel[-1] - case.life.travel[0])
    truth = claimed(np.append(ends, ends.min()), stage)
    return (
        _answers(np.log(now), np.log(case.health[-1]), rng),
        _answers(left / 1000, truth / 1000, rng),
    )


def _answers(draws: Array, truth: Array, rng: np.random.Generator) -> list[Answer]:
    places = place(draws, truth, rng)
    cuts = np.quantile(draws, _LEVELS, axis=0, method="inverted_cdf")
    answers = []
    for own, value, column, (low, middle, high) in zip(places, truth, draws.T, cuts.T, strict=True):
        # Lives that never end, and health that is surely as it was.
        with np.errstate(invalid="ignore", divide="ignore"):
            error, width = middle - value, high - low
            third = (low - middle) / 3 <= value - middle <= (high - middle) / 3
            z = error / column.std()
        answers.append(Answer(float(own), float(error), float(z), float(width), bool(third)))
    return answers


def summed(answers: list[Answer]) -> Row:
    """Sum up the answers of many lives: coverage and bias, each with its Monte-Carlo error."""
    places = np.array([one.place for one in answers])
    row: Row = {"n": len(answers)}
    for nominal in NOMINALS:
        hits = int(np.sum(np.abs(places - 0.5) <= nominal / 2))
        row[f"{100 * nominal:g}"] = judge_coverage(hits, places.size, nominal)
    row["third"] = float(np.mean([one.third for one in answers]))
    for name in ("z", "error"):
        values = np.array([getattr(one, name) for one in answers])
        values = values[np.isfinite(values)]
        n = values.size
        row[name] = {
            "n": n,
            "mean": float(values.mean()) if n else None,
            "se": float(values.std(ddof=1) / np.sqrt(n)) if n > 1 else None,
            "rms": float(np.sqrt(np.mean(values**2))) if n else None,
        }
    widths = np.array([one.width for one in answers])
    # Ends that are not in sight are as far apart as can be.
    width = np.median(np.where(np.isnan(widths), np.inf, widths))
    row["width"] = float(width) if np.isfinite(width) else None
    return row


@cache
def stage_with(name: str, model_std: float, plant: str = "", *, losing: bool = False) -> Stage:
    """Load a description with another error of its map, or with the map of a wrong plant.

    With ``losing`` it has no law by which a parameter keeps its value.
    """
    stage = always_losing(load_stage(name)) if losing else load_stage(name)
    assert stage.description.map is not None
    spec = msgspec.structs.replace(stage.description.map, model_std=model_std)
    surrogate = _wrong_map(name, plant) if plant else stage.modal_map
    description = msgspec.structs.replace(stage.description, map=spec)
    return replace(stage, description=description, modal_map=surrogate)


@cache
def told(name: str) -> dict[str, bool]:
    """Return which parameters the modes of a stage tell at all; ``any`` stands for all of them."""
    seen = identifiability_of(load_stage(name))
    shown = identifiable_parameters([seen], [range(len(seen.parameters))], seen.prior)
    return dict(zip(seen.parameters, shown.tolist(), strict=True)) | {"any": bool(shown.all())}


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
    plan = lives.plan_of(stage, kind, seed)
    life = lives.life_of(plan)
    limits = plan.draw_life().limits_km()
    ends = [np.inf if limits[name] is None else _KM * limits[name] for name in PARAMETERS]
    passage = np.array(ends) - life.travel[0]
    return Case(life, identify(life), life.health / life.health[0], passage)


def on_path(stage: str, seed: int, rng: np.random.Generator) -> Life:
    """Take a life that ends at health drawn from the prior and goes there evenly."""
    last = np.exp(load_stage(stage).prior.draw(rng, 1)[0])
    # Effects without wear: hall, payload, retuning, grease or none.
    plan = lives.plan_of(stage, str(rng.choice(lives.HEALTHY)), seed)
    visits = schedule(plan)
    s = np.array([visit.travel_km - visits[0].travel_km for visit in visits])
    health = last ** (s / s[-1])[:, None]
    return lives.life_with(plan, _with_health(visits, health))


def by_law(stage: str, seed: int, rng: np.random.Generator) -> tuple[Life, Array]:
    """Take a life whose scenario is drawn from its prior: the life, and where its limits are, in m.

    Each parameter follows one of the laws by which it loses, and does not deviate from it. Only
    lives that stay inside the map until now are possible for who believes in the map.
    """
    description = always_losing(load_stage(stage))
    assert description.modal_map is not None
    plan = lives.plan_of(stage, str(rng.choice(lives.HEALTHY)), seed)
    visits = schedule(plan)
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
    parts = zip(scenario.paths, scenario.split(theta), description.parameters, strict=True)
    ends = [path.passage(own, p.limit.below)[0] if p.limit else np.inf for path, own, p in parts]
    return lives.life_with(plan, _with_health(visits, health)), np.array(ends)


def _with_health(visits: list[Visit], health: Array) -> list[Visit]:
    return [
        replace(visit, condition=replace(
            visit.condition, guide_preload=float(preload), mount_stiffness=float(mount)))
        for visit, (preload, mount) in zip(visits, health, strict=True)
    ]  # fmt: skip


def alone(stage: Stage, health: Array) -> Array:
    """Drifts of the modes by each parameter alone, shape ``(n_parameters, n_points, n_modes)``."""
    only = np.eye(health.shape[1])[:, None] * np.log(health)
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


def epoch_draws(
    track: Track, stage: Stage, epoch: int, rng: np.random.Generator, shrink: float = 1.0
) -> Array:
    """Draw health at one epoch of a track, without a law; ``shrink`` falsifies the covariance."""
    modes = tuple(name for name in stage.informative if name in track.modes)
    columns = [track.modes.index(name) for name in modes]
    cov = shrink * track.drift_cov[epoch][np.ix_(columns, columns)]
    posterior = EpochPosterior.of(stage, modes, track.drift[epoch][columns], cov)
    start = posterior.prior.draw(rng, _N_PRIOR)
    found = importance_sample_to_ess(posterior.log_probability, start, rng, _N_POINTS)
    return np.asarray(np.exp(found.resampled(rng, _N_DRAWS)))


def life_draws(
    history: History, stage: Stage, rng: np.random.Generator, *,
    noise_known: bool = False, chains: bool = False,
) -> tuple[Array, Array]:  # fmt: skip
    """Draw health now, and the travel left to each limit and to the first, by the laws.

    With ``noise_known`` the stated covariance is all; otherwise a factor on it, a random walk of
    the frequencies and a deviation of health from its laws take what it does not explain. Returns
    fractions of baseline, ``(n_draws, n_parameters)``, and travel in m, infinite past the horizon
    and 0 where a limit is passed already, ``(n_draws, n_limits + 1)``.
    """
    with _noise_as_stated() if noise_known else nullcontext():
        found = fit_life(history, stage, int(rng.integers(2**32)), chains=chains, n_draws=_N_DRAWS)
    now, horizon = history.clock()[-1], 1000 * stage.description.usage.horizon_km
    left, _ = passages(found, parameters_with_limit(stage), rng, now=now, horizon=horizon)
    return found.health.reshape(-1, found.health.shape[-1]), claimed(left, stage)


def claimed(left: Array, stage: Stage) -> Array:
    """Return the travel left as it is claimed: infinite past the horizon, 0 if passed."""
    horizon = 1000 * stage.description.usage.horizon_km
    return np.where(left > horizon, np.inf, np.maximum(left, 0.0))


def _noise_as_stated() -> patch.multiple:
    """Leave of the grid of scatter the point at which estimates are all that errs."""
    return patch.multiple(
        constants, WALK_STDS=constants.WALK_STDS[:1], NOISE_SCALES=(1.0,), NOISE_SCALE_PRIOR=(1.0,),
        DEVIATION_STDS=(0.0,), DEVIATION_PRIOR=(1.0,),
    )  # fmt: skip
