"""Lives that are followed to their end, their logs before a cut, and their Cramér-Rao bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import erf

from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from models.lives.degradation import (
    GUIDE_PRELOAD_LIMIT,
    MOUNT_STIFFNESS_LIMIT,
    HertzWear,
    Loosening,
    Steady,
)
from models.lives.degradation import Life as Truth
from models.lives.simulation import Plan, schedule
from studies.common import lives
from studies.common.histories import keep_series
from studies.common.lives import Array, Estimates, Life

STAGE = "lms-y"
KINDS, HEALTHY = ("preload-wear", "mount-loosening", "both"), "healthy"
N_LOGS, FIRST_SEED = 60, 60_000
CUTS = (0.3, 0.5, 0.7, 0.9)
_MODES = ("roll", "pitch")
_SIZED = 12  # logs that are simulated and identified for the covariances of the estimates
_KM = 1000.0
_INTERCEPT_STD, _TEMPERATURE_STD, _STEP = 0.1, 0.001, 1e-4
_measured = cache(lives.measured)
_LIMITS = {HertzWear: GUIDE_PRELOAD_LIMIT, Loosening: MOUNT_STIFFNESS_LIMIT}
# Prior standard deviations of the description: of ln s_w and n, and of the floor and ln s_m.
_PRIOR_STD = {HertzWear: [1.0, 0.9 / np.sqrt(12)], Loosening: [0.7 / np.sqrt(12), 1.0]}


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One life, followed past its end."""

    truth: Truth  # Its laws
    history: History  # Estimates of roll and pitch at all logs
    end: float  # Odometer in m at which the first limit is reached; infinite if none ever is


def case_of(kind: str, number: int, sizes: tuple[Estimates, Life] | None = None) -> Case:
    """Draw a life of a kind, and estimates of its modes; a healthy one ends with the present.

    The covariances are those of some simulated logs, unless others are given.
    """
    at, until = (*KINDS, HEALTHY).index(kind), "now" if kind == HEALTHY else "failure"
    plan = Plan(STAGE, kind, N_LOGS, lives.SECONDS, FIRST_SEED + 4 * number + at, until=until)
    life, truth = lives.life_with(plan, schedule(plan)), plan.draw_life()
    estimates = lives.drawn(
        life, *(sizes or _measured(STAGE, _SIZED)), lives.rng_of(31, at, number)
    )
    history, end = lives.history_of(life, estimates), truth.failure_km()
    columns = [i for i, one in enumerate(history.series) if one.mode in _MODES]
    return Case(truth, keep_series(history, columns), np.inf if end is None else _KM * end)


def cut(case: Case, share: float) -> History:
    """Keep the logs up to a share of the life."""
    whole = case.history
    n = int(np.searchsorted(whole.travel, share * case.end, side="right"))
    by_log = ("logs", "recorded_at", "travel", "ln_frequency", "ln_damping", "cov", "loop_error")
    covariates = {name: values[:n] for name, values in whole.covariates.items()}
    return replace(
        whole, covariates=covariates, **{name: getattr(whole, name)[:n] for name in by_log}
    )


def share_within(std: float, margin: float) -> float:
    """Return the probability that a normal error lies within a margin."""
    return float(erf(margin / (np.sqrt(2) * std)))


def bound(case: Case, history: History, stage: Stage, model_std: float) -> float:
    """Return the least standard deviation in m of the remaining life that a history allows.

    Fisher's information of the laws' parameters from the ln frequencies of all logs, with unknown
    intercepts and temperature coefficients of each mode and relative errors ``model_std`` of the
    map's sensitivities, plus that of the priors of the description (van Trees). The bound knows
    which parameters degrade, and that modes do not drift otherwise. The bound of the remaining life
    follows by its gradient.
    """
    laws = [law for law in (case.truth.preload, case.truth.mount) if not isinstance(law, Steady)]
    first = min(laws, key=lambda law: law.reaches_km(_LIMITS[type(law)]) or np.inf)

    def made(point: Array) -> dict[type, HertzWear | Loosening]:
        pairs = zip(laws, point.reshape(-1, 2).tolist(), strict=True)
        return {
            type(law): HertzWear(np.exp(a), b)
            if isinstance(law, HertzWear)
            else Loosening(np.exp(b), a)
            for law, (a, b) in pairs
        }

    def ln_health(point: Array) -> Array:
        both = [made(point).get(kind, Steady()) for kind in (HertzWear, Loosening)]
        return np.log([[law.at(s / _KM) for law in both] for s in history.travel])

    def end(point: Array) -> Array:
        found = made(point)[type(first)].reaches_km(_LIMITS[type(first)])
        return np.array([_KM * (np.inf if found is None else found)])

    point = np.concatenate(
        [
            [np.log(law.life_km), law.exponent]
            if isinstance(law, HertzWear)
            else [law.floor, np.log(law.scale_km)]
            for law in laws
        ]
    )
    slopes = _jacobian(lambda x: stage.drift(ln_health(x), history.modes).ravel(), point)
    cov = _covariance(history) + model_std**2 * _map_error(stage, ln_health(point), history.modes)
    prior = np.concatenate([_PRIOR_STD[type(law)] for law in laws])
    information = slopes.T @ np.linalg.solve(cov, slopes) + np.diag(prior**-2.0)
    gradient = _jacobian(end, point)[0]
    return float(np.sqrt(gradient @ np.linalg.inv(information) @ gradient))


def _jacobian(function: Callable[[Array], Array], point: Array) -> Array:
    steps = _STEP * np.eye(point.size)
    columns = [(function(point + step) - function(point - step)) / (2 * _STEP) for step in steps]
    return np.column_stack(columns)


def _covariance(history: History) -> Array:
    """Covariance of all ln frequencies, log by log: estimates, intercepts and temperature."""
    n, m = len(history.logs), len(history.modes)
    total = np.zeros((n, m, n, m))
    at = np.arange(n)
    total[at, :, at, :] = history.cov[:, :m, :m]
    warm = history.covariates["temperature_c"] - 21.0
    common = _INTERCEPT_STD**2 + _TEMPERATURE_STD**2 * np.outer(warm, warm)
    return total.reshape(n * m, n * m) + np.kron(common, np.eye(m))


def _map_error(stage: Stage, x: Array, modes: tuple[str, ...]) -> Array:
    """Covariance of relative errors of 1 of every sensitivity, one per parameter and mode."""
    alone = stage.drifts(x, modes)[1:]
    total = np.einsum("jkm,jlm,mi->kmli", alone, alone, np.eye(len(modes)))
    return np.asarray(total.reshape(alone[0].size, -1))
