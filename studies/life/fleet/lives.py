"""Fleets drawn from the model by which priors are estimated, and lives of their machines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from lmshealth.calibration.lives import (
    Part,
    make_history,
    map_errors,
    part_of,
    shares,
    without_health,
)
from lmshealth.life import constants
from lmshealth.life.posterior.likelihood import scatter_prior
from lmshealth.life.posterior.scenarios import DegradationPath, laws_of
from lmshealth.stage.degradation_laws import HertzWear, Unchanging
from lmshealth.stage.description import ScatterPrior, Stage, load_stage
from lmshealth.stage.priors import Lognormal
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.history import History

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Age:
    """How long machines have been followed."""

    n_logs: int
    median_km: float  # of the lognormal odometer
    sigma: float  # of its logarithm


MATURE, YOUNG = Age(24, 2000.0, 0.7), Age(8, 200.0, 0.5)


@dataclass(frozen=True)
class Life:
    """A history, and what is true of the preload."""

    history: History
    part: Part

    @property
    def now(self) -> float:
        """Travel since the baseline in m."""
        return float(np.ptp(self.history.travel))


def machine() -> Stage:
    """Load the stage that all machines are: that of Y, with a mount that keeps its stiffness.

    The preload wears by Hertz or keeps its value: the two laws whose share and pace are estimated.
    """
    stage = load_stage("lms-y")
    preload, mount = stage.parameters
    named = (law for law in preload.laws if law.kind in ("hertz-wear", "none"))
    laws = tuple(msgspec.structs.replace(law, weight=1.0) for law in named)
    preload = msgspec.structs.replace(preload, law=laws)
    return _with(stage, (preload, msgspec.structs.replace(mount, law=Unchanging())))


def draw_fleet(rng: np.random.Generator, stage: Stage) -> Stage:
    """Draw what is true of a fleet: the description with the fleet's own laws and scatter."""
    between = rng.uniform()
    mean = np.sqrt(1 - between) * rng.standard_normal()
    preload, mount = stage.parameters
    wear, none = preload.laws
    assert isinstance(wear, HertzWear)
    share = rng.uniform()
    assert isinstance(wear.life_km, Lognormal)
    life_km = wear.life_km.placed(float(mean), float(np.sqrt(between)))
    laws = (
        msgspec.structs.replace(wear, life_km=life_km, weight=share),
        msgspec.structs.replace(none, weight=1 - share),
    )
    parameters = scatter_prior(stage)
    scatter = []
    for name in ScatterPrior.__slots__:
        own = np.array(getattr(parameters, name))
        scatter.append(tuple((rng.dirichlet(own.size * own / own.sum()) + 1e-9).tolist()))
    fleet = _with(stage, (msgspec.structs.replace(preload, law=laws), mount))
    return replace(fleet, scatter=ScatterPrior(*scatter))


def longer_lived(fleet: Stage, times: float) -> Stage:
    """Return a fleet whose lives are so many times as long."""
    preload, mount = fleet.parameters
    wear, none = preload.laws
    assert isinstance(wear, HertzWear)
    prior = wear.life_km
    assert isinstance(prior, Lognormal)
    longer = msgspec.structs.replace(prior, median=times * prior.median)
    laws = (msgspec.structs.replace(wear, life_km=longer), none)
    return _with(fleet, (msgspec.structs.replace(preload, law=laws), mount))


def _with(stage: Stage, parameters: tuple[object, ...]) -> Stage:
    description = msgspec.structs.replace(stage.description, parameter=parameters)
    return replace(stage, description=description)


def draw(rng: np.random.Generator, fleet: Stage, age: Age) -> Life:
    """Draw a machine of a fleet; one that leaves the modal map is taken out at the log before."""
    assert fleet.modal_map is not None
    while True:
        now = 1000 * age.median_km * np.exp(age.sigma * rng.standard_normal())
        clock = now * np.r_[0.0, np.sort(rng.uniform(size=age.n_logs - 2)), 1.0]
        part, path = _part(rng, fleet, clock)
        inside = fleet.modal_map.inside(path)
        n = clock.size if inside.all() else int(np.argmin(inside))
        if n >= 4:
            break
    clock, path = clock[:n], path[:n]
    part = replace(part, off=part.off[:n])
    covariates = {
        "temperature_c": 21 + 3 * rng.standard_normal(n),
        "payload_kg": rng.choice([10.0, 20.0, 35.0], size=n),
    }
    names = fleet.informative[:2]
    std = rng.uniform(3e-4, 2e-3) * np.exp(0.3 * rng.standard_normal((n, 2)))
    scale = rng.choice(constants.NOISE_SCALES, p=shares(fleet, "noise_scale"))
    values = _modes(rng, fleet, names, clock, path)
    for one in regressors(covariates, fleet):
        values += np.outer(one.values, one.prior_std * rng.standard_normal(2))
    values += scale * std * rng.standard_normal((n, 2))
    cov = np.zeros((n, 4, 4))
    cov[:, [0, 1], [0, 1]] = std**2
    cov[:, [2, 3], [2, 3]] = 0.05**2
    estimates = values, np.full((n, 2), np.log(0.015)), cov
    return Life(make_history(names, 1e5 + clock, estimates, covariates=covariates), part)


def _part(rng: np.random.Generator, fleet: Stage, clock: Array) -> tuple[Part, Array]:
    """Draw what becomes of the preload, and the path of ln health parameters that this makes."""
    laws, weight = zip(*laws_of(fleet.parameters[0], fleet.description.life.free), strict=True)
    path, now = DegradationPath(laws[rng.choice(len(laws), p=weight)], 0.0, ()), float(clock[-1])
    theta = path.natural(path.draw(rng, 1, now), now)[0]
    deviation = rng.choice(constants.DEVIATION_STDS, p=shares(fleet, "deviation"))
    part = part_of(rng, path, theta, float(deviation), clock)
    with np.errstate(divide="ignore"):
        ln_preload = np.log(part.by_law(clock)) + part.off
    return part, np.column_stack([ln_preload, np.zeros(clock.size)])


def _modes(
    rng: np.random.Generator, fleet: Stage, names: tuple[str, ...], clock: Array, path: Array
) -> Array:
    """Ln f of the modes: health through a map that is wrong, and what moves without health."""
    # The mount keeps its stiffness: the error of the map is that of the preload alone.
    error = map_errors(rng, fleet, len(names))[0]
    moved, *_ = without_health(rng, fleet, clock, len(names))
    known = np.log([mode.frequency_hz for mode in fleet.modes if mode.name in names])
    return np.asarray((1 + error) * fleet.drift(path, names) + moved + known)
