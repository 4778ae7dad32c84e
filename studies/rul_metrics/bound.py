"""How well anybody could know the remaining life: the Cramér-Rao bound of a history."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from lmshealth.health.epoch_posterior import one_at_a_time
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from models.lives.degradation import (
    GUIDE_PRELOAD_LIMIT,
    MOUNT_STIFFNESS_LIMIT,
    HertzWear,
    Loosening,
    Steady,
)
from studies.common.lives import Array
from studies.rul_metrics.lives import Case

_INTERCEPT_STD = 0.1
_KM = 1000.0
_STEP = 1e-4
_LIMITS = {HertzWear: GUIDE_PRELOAD_LIMIT, Loosening: MOUNT_STIFFNESS_LIMIT}
# Standard deviations of what the description states of ln s_w, n, the floor, and ln s_m.
_PRIOR_STD = {
    HertzWear: np.array([1.0, 0.9 / np.sqrt(12)]),
    Loosening: np.array([0.7 / np.sqrt(12), 1.0]),
}


def share_within(std: float, margin: float) -> float:
    """Probability of a normal error of some standard deviation to lie within a margin."""
    return float(erf(margin / (np.sqrt(2) * std)))


@dataclass(frozen=True, slots=True, eq=False)
class _Laws:
    """The laws that something is lost by, as functions of one vector."""

    case: Case
    kinds: tuple[type, ...]
    point: Array

    @classmethod
    def of(cls, case: Case) -> _Laws:
        own = [law for law in (case.truth.preload, case.truth.mount) if not isinstance(law, Steady)]
        point = [_vector(law) for law in own]
        return cls(case, tuple(type(law) for law in own), np.concatenate(point))

    def at(self, point: Array) -> dict[type, HertzWear | Loosening]:
        made = {}
        for k, kind in enumerate(self.kinds):
            first, second = point[2 * k : 2 * k + 2]
            made[kind] = (
                HertzWear(float(np.exp(first)), float(second))
                if kind is HertzWear
                else Loosening(float(np.exp(second)), float(first))
            )
        return made

    def ln_health(self, point: Array, travel: Array) -> Array:
        laws = self.at(point)
        columns = [laws.get(kind, Steady()) for kind in (HertzWear, Loosening)]
        return np.log([[law.at(s / _KM) for law in columns] for s in travel])

    def end(self, point: Array) -> Array:
        """Travel in m at the limit that is the first one in truth."""
        limits = self.case.truth.limits_km()
        ends = {HertzWear: limits["guide_preload"], Loosening: limits["mount_stiffness"]}
        first = min(self.kinds, key=lambda kind: ends[kind] or np.inf)
        found = self.at(point)[first].reaches_km(_LIMITS[first])
        return np.array([_KM * (np.inf if found is None else found)])


def _vector(law: object) -> Array:
    if isinstance(law, HertzWear):
        return np.array([np.log(law.life_km), law.exponent])
    assert isinstance(law, Loosening)
    return np.array([law.floor, np.log(law.scale_km)])


def bound(case: Case, history: History, stage: Stage, model_std: float) -> float:
    """Return the least standard deviation in m of the remaining life that a history allows.

    Fisher's information of the laws' parameters from the ln frequencies of all logs, with their
    covariance, unknown intercepts and temperature coefficients of each mode, and relative errors of
    the map's sensitivities, all marginalised; with the information of the priors of the description
    (van Trees). It is told which parameters lose anything at all, and of no wandering: who has to
    find that out knows less. The bound of the remaining life follows by its gradient.

    Parameters
    ----------
    case : Case
        The truth.
    history : History
        What is known of it.
    stage : Stage
        Modal map.
    model_std : float
        Of the map's sensitivities; 0 for a map that is known to be right.
    """
    laws, modes = _Laws.of(case), history.modes

    def mean(point: Array) -> Array:
        return stage.drift(laws.ln_health(point, history.travel), modes).ravel()

    sensitivity = _jacobian(mean, laws.point)
    x = laws.ln_health(laws.point, history.travel)
    total = _covariance(history) + model_std**2 * _map_error(stage, x, modes)
    information = sensitivity.T @ np.linalg.solve(total, sensitivity)
    prior = np.concatenate([_PRIOR_STD[kind] for kind in laws.kinds])
    gradient = _jacobian(laws.end, laws.point)[0]
    cov = np.linalg.inv(information + np.diag(prior**-2.0))
    return float(np.sqrt(gradient @ cov @ gradient))


def _jacobian(function: Callable[[Array], Array], point: Array) -> Array:
    columns = [
        (function(point + step) - function(point - step)) / (2 * _STEP)
        for step in _STEP * np.eye(point.size)
    ]
    return np.column_stack(columns)


def _covariance(history: History) -> Array:
    """Of all ln frequencies, log by log: estimates, intercepts and temperature."""
    n, m = len(history.logs), len(history.modes)
    total = np.zeros((n, m, n, m))
    at = np.arange(n)
    total[at, :, at, :] = history.cov[:, :m, :m]
    warm = history.covariates["temperature_c"] - 21.0
    common = _INTERCEPT_STD**2 + 0.001**2 * np.outer(warm, warm)
    return total.reshape(n * m, n * m) + np.kron(common, np.eye(m))


def _map_error(stage: Stage, x: Array, modes: tuple[str, ...]) -> Array:
    """Of errors that are one of each parameter and mode, in units of their own."""
    alone = stage.drift(one_at_a_time(stage, x), modes).reshape(-1, x.shape[0], len(modes))[1:]
    total = np.einsum("jkm,jlm,mi->kmli", alone, alone, np.eye(len(modes)))
    return np.asarray(total.reshape(alone[0].size, -1))
