"""Prognosis: remaining useful life by first passage of the limits, usage, and life curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from scipy.special import softmax

from lmshealth._private.arrays import FloatArray, freeze
from lmshealth._private.result import Result
from lmshealth._private.serialize import stream
from lmshealth._private.tables import fact
from lmshealth.errors import BadStage, NotEnoughData
from lmshealth.io.log import utc_day
from lmshealth.life import constants
from lmshealth.life.posterior.data import KM, SECONDS_PER_DAY, with_clock
from lmshealth.life.posterior.fit import LifePosterior, LoneMode, fit_life
from lmshealth.life.posterior.scenarios import DegradationPath
from lmshealth.stage.degradation_laws import Accelerating, AnyLaw, Free, Law
from lmshealth.stage.description import ParameterSpec, Stage
from lmshealth.stage.identifiability import identifiability_of
from lmshealth.tracking.history import History

_STEP = 1 << 21  # of the random stream: beyond the epochs of health and the life
_N_CURVE, _N_COARSE = 101, 40
_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
# Grid points up to 1.5 times the passage of the law alone, and from there to the horizon.
_NEAR, _FAR, _BEYOND = 24, 12, 1.5
_REACH = 3.0  # standard deviations of ln of the travel left
_N_LIVES = 2000  # of the prior of a law
_LEAST_USAGE = 1e-3  # of a phase without travel, in rates of the whole record
_RARE = 1e-9  # bounds of the mean and shape of the inverse Gaussian


@dataclass(frozen=True, slots=True)
class LawWeight:
    """Posterior probability of a law of a health parameter.

    It begins at the baseline, or at a step: `begin` is the travel in m since the baseline.
    """

    parameter: str
    kind: str
    begin: float
    probability: float


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Prognosis(Result):
    """Remaining useful life of one machine, of which `n` health parameters have a limit.

    `lmshealth.machine.service.probability_before` has the probability by a day.
    """

    stage: str  # identity of the machine
    recorded_at: datetime  # of the last log, at which the prognosis is made
    travel: float  # odometer then in m
    parameters: tuple[str, ...]  # those with a limit, then ``any`` (the first limit reached)
    # With a limit that the modes do not identify; not in `parameters` nor ``any``.
    unidentifiable: tuple[str, ...]
    limits: FloatArray  # NaN for ``any``, ``(n + 1,)``
    # Draws of the remaining travel in m, negative if the limit has been passed and infinite if it
    # is never reached, ``(n_draws, n + 1)``; and of the travel in m per day, its mean over the
    # remaining life and that of the present, ``(n_draws,)``.
    remaining: FloatArray
    usage: FloatArray
    usage_now: FloatArray
    # Draws of the travel in m, by the laws, at which half of ln(health now / limit) is lost,
    # ``(n_draws, n)``.
    half: FloatArray
    horizon: float  # travel in m beyond which nothing is published
    # Draws of the parameters now in their units, ``(n_draws, n)``: those of `Health`, in its order.
    health: FloatArray
    # Odometer grid in m of the life curves, ``(n_grid,)``, and 5, 25, 50, 75, 95 % quantiles of the
    # parameters there, ``(5, n_grid, n)``.
    curve_travel: FloatArray
    curve_quantiles: FloatArray
    laws: tuple[LawWeight, ...]  # of each parameter, the most probable first
    chi_square: float  # of the residuals at the posterior mean
    degrees_of_freedom: float  # number of data less all that they determine
    # Posterior means: standard deviation over the history of the random walk of ln f, factor on the
    # reported standard deviations, standard deviation over it of ln health about its laws.
    walk: float
    noise_scale: float
    deviation: float
    ess: float  # ess, r_hat: worst of all law parameters
    r_hat: float
    # Modes that moved alone in some draws, the most probable first.
    modes_off: tuple[LoneMode, ...] = ()

    def __post_init__(self) -> None:
        n, n_draws = len(self.parameters), self.remaining.shape[0]
        freeze(
            self,
            ("limits", n),
            ("remaining", n_draws, n),
            ("usage usage_now", n_draws),
            ("half", n_draws, n - 1),
            ("health", self.health.shape[0], n - 1),
            ("curve_quantiles", 5, self.curve_travel.size, n - 1),
        )

    def title(self) -> str:
        """Return machine, moment, odometer and horizon."""
        at = f"{utc_day(self.recorded_at)} at {self.travel / 1000:.6g} km"
        horizon = f"{self.horizon / 1000:.6g} km"
        return f"Prognosis of {self.stage} on {at}: remaining travel in km, at most {horizon}"

    def to_columns(self) -> dict[str, Any]:
        """Return quantiles of the remaining travel, infinite beyond the horizon, of each limit."""
        left = np.maximum(self.censored(), 0.0) / 1000
        quantiles = np.quantile(left, _LEVELS, axis=0, method="inverted_cdf")
        pairs = zip(_LEVELS, quantiles, strict=True)
        return {
            "parameter": list(self.parameters),
            "limit": self.limits,
            **{f"rul_km_q{100 * level:02.0f}": own for level, own in pairs},
            "probability_already_past": self.already_past(),
            "probability_beyond_horizon": self.beyond_horizon(),
        }

    def censored(self) -> FloatArray:
        """Return `remaining` with infinity beyond the horizon."""
        return np.where(self.remaining > self.horizon, np.inf, self.remaining)

    def beyond_horizon(self) -> FloatArray:
        """Return the probability to reach the horizon, shape ``(n_parameters + 1,)``."""
        return np.asarray(np.mean(self.remaining > self.horizon, axis=0))

    def already_past(self) -> FloatArray:
        """Return the probability that a limit has been passed, shape ``(n_parameters + 1,)``."""
        return np.asarray(np.mean(self.remaining <= 0, axis=0))


def prognose(
    history: History, stage: Stage, seed: int | Sequence[int], *, chains: bool = True
) -> Prognosis:
    """Fit the degradation laws of a stage and draw the travel left to each limit.

    Parameters
    ----------
    history, stage : History, Stage
        Modal estimates of all logs; laws, limits, modal map and usage.
    seed, chains : int or sequence of int, bool
        As in `fit_life`.

    Returns
    -------
    Prognosis
        Draws of the remaining travel, infinite where a limit is never reached. Parameters that the
        modes do not identify are left out and named.

    Raises
    ------
    BadStage
        If no health parameter has a limit.
    NotEnoughData
        If the history is too short, or no parameter with a limit is identifiable.
    NotConverged
        If the sampler did not converge.

    Examples
    --------
    A simulated machine, whose preload reaches its limit 824 km after the last log:

    >>> import numpy as np
    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage = lmshealth.load_stage("lms-y")
    >>> prognosis = lmshealth.prognose(examples.history(), stage, seed=0, chains=False)
    >>> prognosis.parameters
    ('guide_preload', 'mount_stiffness', 'any')
    >>> low, median, high = np.quantile(prognosis.remaining[:, -1], (0.05, 0.5, 0.95)) / 1000
    >>> bool(low < 824 < high)
    True
    """
    return prognosis_of(fit_life(history, stage, seed, chains=chains), history, stage)


def prognosis_of(life: LifePosterior, history: History, stage: Stage) -> Prognosis:
    """Return the prognosis of a life, of its draws in their order; see `prognose`."""
    if not parameters_with_limit(stage):
        raise BadStage(f"{stage.name}: no [[parameter]] has a limit, so there is no end of life")
    limited = identifiable_limits(stage, life.modes)
    if not limited:
        raise NotEnoughData(
            fact(
                "{stage}: the modes {names} identify no parameter that has a limit, however many "
                "logs there are; `lmshealth stage` lists what they identify",
                stage=history.stage,
                names=", ".join(life.modes),
            )
        )
    history = with_clock(history, stage)
    seeds = stream(life.seed, _STEP).spawn(3)
    horizon = stage.description.usage.horizon_km * KM
    since = float(history.travel[-1] - history.travel[history.baseline])
    of_passage, of_usage, of_curve = (np.random.default_rng(own) for own in seeds)
    remaining, half = passages(life, limited, of_passage, now=since, horizon=horizon)
    usage, usage_now = _usage(history, stage, of_usage, remaining[:, -1], horizon)
    travel = _curve_grid(remaining, since, horizon)
    columns = [j for j, _ in limited]
    unit = np.array([parameter.baseline for _, parameter in limited])
    curve = life.health_at(travel, of_curve)[..., columns] * unit
    return Prognosis(
        stage=history.stage,
        recorded_at=history.recorded_at[-1],
        travel=float(history.travel[-1]),
        parameters=(*(p.name for _, p in limited), "any"),
        unidentifiable=tuple(p.name for j, p in parameters_with_limit(stage) if j not in columns),
        limits=np.array([p.limit.below for _, p in limited if p.limit] + [np.nan]),
        remaining=remaining,
        usage=usage,
        usage_now=usage_now,
        half=half,
        horizon=horizon,
        health=life.health.reshape(-1, len(life.parameters))[:, columns] * unit,
        curve_travel=travel + history.travel[history.baseline],
        curve_quantiles=np.quantile(curve, _LEVELS, axis=(1, 2)),
        laws=tuple(
            LawWeight(p.name, *law, probability)
            for _, p in limited
            for law, probability in life.laws(p.name).items()
        ),
        chi_square=life.chi_square,
        degrees_of_freedom=life.degrees_of_freedom,
        walk=life.walk,
        noise_scale=life.noise_scale,
        deviation=life.deviation,
        ess=life.ess,
        r_hat=life.worst_r_hat,
        modes_off=life.lone_modes,
    )


def passages(
    life: LifePosterior,
    limited: Sequence[tuple[int, ParameterSpec]],
    rng: np.random.Generator,
    *,
    now: float,
    horizon: float,
) -> tuple[FloatArray, FloatArray]:
    """Draw `remaining` and `half` of `Prognosis`, in the order of the draws.

    For parameters with a limit, and their indices; `now` is the travel in m since the baseline, and
    the horizon is in m from now.
    """
    parts = []
    for one, off, rate in life.by_scenario():
        theta = one.scenario.split(one.scenario.natural(one.mixture_draws))
        columns, halves = [], []
        for j, parameter in limited:
            assert parameter.limit is not None
            path, limit = one.scenario.paths[j], parameter.limit.below / parameter.baseline
            of_health = (path, theta[j], off[:, j], rate[:, j], rng)
            reach = reach_of(path.law, now, horizon)
            left = first_passage(*of_health, now=now, limit=limit, horizon=reach)
            by_law = path.health(theta[j], np.array([now]))[:, 0]
            half = path.passage(theta[j], np.sqrt(by_law * limit * np.exp(-off[:, j]))) - now
            if path.law.names:
                proven = now + early_life(path.law, limit, rng)
                left, half = _beyond_laws(rng, path.law, left, half, now=now, proven=proven)
            columns.append(left)
            halves.append(half)
        found = np.column_stack([*columns, np.min(columns, axis=0), *halves])
        parts.append(found.reshape(life.rate.shape[0], one.n_mixture_draws, -1))
    joined = np.concatenate(parts, axis=1)
    remaining, half = np.split(joined.reshape(-1, joined.shape[-1]), [len(limited) + 1], axis=1)
    return remaining, half


def rate_std(law: Law) -> float:
    """Return the standard deviation of ln of the travel left as `constants.RATE_STD` has it."""
    late = isinstance(law, Accelerating)
    return constants.ACCELERATION_STD if late else constants.RATE_STD


def reach_of(law: Law, now: float, horizon: float) -> float:
    """Return the travel in m up to which an end by a law may come within the horizon after all."""
    spread = rate_std(law) * np.sqrt(np.log2(1 + horizon / now)) if law.names else 0.0
    return horizon * float(np.exp(_REACH * spread))


def early_life(law: AnyLaw, limit: float, rng: np.random.Generator) -> float:
    """Return the travel in m before which few machines of the description reach a limit.

    It is 0 of a change without a law, whose prior states the change up to now, whenever now is:
    lives of other machines do not follow from it.
    """
    if isinstance(law, Free):
        return 0.0
    lives = lives_by_law(law, limit, rng, _N_LIVES)
    return float(np.quantile(lives, constants.EARLY_LIFE, method="inverted_cdf"))


def lives_by_law(law: AnyLaw, limit: float, rng: np.random.Generator, n: int) -> FloatArray:
    """Draw the travel in m to a limit by the prior of a law, ``(n,)``."""
    path = DegradationPath(law, 0.0, ())
    # A travel now is needed for the coordinates alone.
    return path.passage(path.natural(path.draw(rng, n, KM), KM), limit)


def _beyond_laws(
    rng: np.random.Generator,
    law: Law,
    left: FloatArray,
    half: FloatArray,
    *,
    now: float,
    proven: float,
) -> tuple[FloatArray, FloatArray]:
    """Open the travel left and that to half of the loss, ``(n,)``: README.md, "Beyond the laws".

    `proven` is the travel in m without the onset of an end that no log shows yet.
    """
    ahead = np.where(np.isfinite(left), np.maximum(left, 0.0), 0.0)
    spread = rate_std(law) * np.sqrt(np.log2(1 + ahead / now))
    factor = np.exp(spread * rng.standard_normal(left.size))
    with np.errstate(over="ignore"):
        onset = proven * np.expm1(rng.exponential(size=left.size) / constants.UNSEEN_ONSETS)
    growth = constants.UNSEEN_GROWTH.quantile(rng.uniform(1e-9, 1 - 1e-9, left.size))
    growth = (proven + onset) * growth
    sooner = left * factor > onset + growth
    half = np.where(sooner, onset + np.sqrt(0.5) * growth, half * factor)
    return np.where(sooner, onset + growth, left * factor), half


def first_passage(
    path: DegradationPath,
    theta: FloatArray,
    off: FloatArray,
    rate: FloatArray,
    rng: np.random.Generator,
    *,
    now: float,
    limit: float,
    horizon: float,
) -> FloatArray:
    """Draw the travel from now to the first passage of a limit.

    Without deviation the passage is that of the law, in closed form. With deviation, ln health is
    drawn at grid points with Brownian bridges between them [Borodin2002]; see README.md. The result
    in m, shape ``(n,)``, is negative, by the law, if the limit has been passed, and infinite if it
    is never reached or, with deviation, not before the horizon.

    ``theta`` are natural parameters, ``(n, k)``; ``off`` and ``rate`` the deviation of ln health
    from its law now and its variance per m, ``(n,)``; ``now`` the travel in m since the baseline,
    ``limit`` a fraction of it, ``horizon`` in m from now.
    """
    left = path.passage(theta, limit * np.exp(-off)) - now
    # A law that gains may have been below the limit before, and is above it now.
    above = path.health(theta, np.array([now]))[:, 0] * np.exp(off) > limit
    left[above & (left <= 0)] = np.inf
    moving = (rate > 0) & (left > 0)
    if moving.any():
        near = np.minimum(_BEYOND * left[moving], 0.5 * horizon)[:, None]
        fraction, rest = np.linspace(0, 1, _NEAR + 1), np.linspace(0, 1, _FAR + 1)[1:]
        ahead = np.hstack([near * fraction, near + (horizon - near) * rest])
        with np.errstate(divide="ignore"):  # health is 0 past the end of a law
            distance = np.log(path.health(theta[moving], now + ahead))
        distance += (off[moving] - np.log(limit))[:, None]
        left[moving] = _with_deviation(distance, ahead, rate[moving], rng)
    return left


def _with_deviation(
    distance: FloatArray, ahead: FloatArray, rate: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Draw the first passage of 0 by a Wiener process about a path, both ``(n, n_grid)``."""
    step = np.diff(ahead, axis=1)
    variance = rate[:, None] * step
    distance[:, 1:] += np.cumsum(np.sqrt(variance) * rng.standard_normal(step.shape), axis=1)
    a, b = distance[:, :-1], distance[:, 1:]
    # Below the limit at the end of the interval, or the bridge touches it in between.
    with np.errstate(invalid="ignore", over="ignore"):
        touched = np.exp(-2 * a * b / variance) > rng.uniform(size=step.shape)
    crossed = (b <= 0) | touched
    first = crossed.argmax(axis=1)[:, None]
    a, b, begin, length = (
        np.take_along_axis(part, first, axis=1)[:, 0] for part in (a, b, ahead[:, :-1], step)
    )
    # First passage t of a bridge of length T that touches 0: t / (T - t) is inverse Gaussian.
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.clip(a / np.abs(b), _RARE, 1 / _RARE)
        odds = rng.wald(mean, np.maximum(a * a / (rate * length), _RARE))
    share = np.where(np.isneginf(b), 0.5, odds / (1 + odds))
    return np.where(crossed.any(axis=1), begin + length * share, np.inf)


def _curve_grid(remaining: FloatArray, since: float, horizon: float) -> FloatArray:
    """Return travels in m since the baseline, fine up to the first limit, coarse to the last."""
    late = np.quantile(np.minimum(remaining, horizon), 0.75, axis=0)
    near, far = (min(max(1.3 * ahead, 0.5 * since), horizon) for ahead in (late[-1], late.max()))
    fine = np.linspace(0.0, since + near, _N_CURVE)
    return np.append(fine, np.linspace(since + near, since + far, _N_COARSE + 1)[1:])


def _usage(
    history: History, stage: Stage, rng: np.random.Generator, remaining: FloatArray, horizon: float
) -> tuple[FloatArray, FloatArray]:
    """Draw the travel in m per day: its mean over the remaining life, and now (README.md).

    Shape ``(n_draws,)`` each.
    """
    stated = stage.description.usage.km_per_day
    if stated is not None:
        return (np.full(remaining.size, stated * KM),) * 2
    days, steps = np.diff(history.seconds) / SECONDS_PER_DAY, np.diff(history.travel)
    days, steps = days[days > 0], steps[days > 0]
    if days.size < 2 or steps.sum() <= 0:
        raise NotEnoughData(
            fact(
                "{stage}: the odometer gives no usage; state [usage] km_per_day",
                stage=history.stage,
            )
        )
    whole = steps.sum() / days.sum()
    typical = (constants.USAGE_SCATTER * whole) ** 2 * days.mean()  # scatter per day, squared
    travel = np.clip(remaining, days.mean() * whole, horizon)
    probability, rest = _phases(days, steps, typical)
    phase = rng.choice(days.size, remaining.size, p=probability)
    # Two phases of few increments each show little of their scatter.
    known = constants.USAGE_KNOWN, constants.USAGE_KNOWN * typical
    # Days and travel of the increments from each one on.
    lasted, moved = (np.cumsum(own[::-1])[::-1] for own in (days, steps))

    def rates(first: np.ndarray) -> FloatArray:
        """Draw the rate of each draw by the increments from one on, ``(n_draws,)``."""
        rate = np.maximum(moved[first] / lasted[first], _LEAST_USAGE * whole)
        changed = first > 0
        freedom = days.size - 1 + changed * (known[0] - 1)
        square = (rest[first] + changed * known[1]) / freedom
        # Over less than the time between two logs the usage was never observed.
        variance = 1 / lasted[first] + 1 / np.maximum(travel / rate, days.mean())
        scatter = rng.standard_t(freedom) * np.sqrt(square * variance)
        # Usage is positive: errors are those of its logarithm, with the tails of few logs cut.
        return np.asarray(rate * np.exp(np.clip(scatter / rate, -5.0, 5.0)))

    now = rates(phase)
    later = np.where(phase > 0, rates(np.zeros_like(phase)), now)
    # None has ended in the days that the phase has lasted.
    ended = rng.uniform(1e-9, 1.0, remaining.size) ** (-1 / constants.USAGE_ENDS)
    lasting = np.minimum(travel / now, lasted[phase] * (ended - 1))
    return travel / (lasting + (travel - lasting * now) / later), now


def _phases(days: FloatArray, steps: FloatArray, typical: float) -> tuple[FloatArray, FloatArray]:
    """Return how probably each increment is the first of the present usage, ``(n,)``.

    That of increment 0 is that the usage has not changed. And the sums of squares per day about the
    rates before and since, ``(n,)``. ``typical`` is the square of the scatter per day in m that is
    expected. README.md has the model.
    """
    n, rate = days.size, steps.sum() / days.sum()
    total, moved = np.cumsum(days), np.cumsum(steps)
    before, past = total[:-1], moved[:-1]
    since, present = total[-1] - before, moved[-1] - past
    explained = np.append(moved[-1] ** 2 / total[-1], past**2 / before + present**2 / since)
    rest = np.maximum(np.sum(steps**2 / days) - explained, 0.0)
    known, freedom = constants.USAGE_KNOWN * typical, n - 1 + constants.USAGE_KNOWN
    variance, wide = 1 / before + 1 / since, rate**2 / typical
    apart = (past / before - present / since) ** 2 / (variance + wide)
    chance = constants.USAGE_CHANGED
    changed = np.log(chance / (n - 1)) - 0.5 * np.log1p(wide / variance)
    log_weight = np.append(np.log1p(-chance), changed)
    log_weight -= freedom / 2 * np.log(rest + np.append(0.0, apart) + known)
    return np.asarray(softmax(log_weight)), rest


def parameters_with_limit(stage: Stage) -> list[tuple[int, ParameterSpec]]:
    """Return the parameters that have a limit, with their index."""
    return [(j, p) for j, p in enumerate(stage.parameters) if p.limit is not None]


def identifiable_limits(stage: Stage, modes: Sequence[str]) -> list[tuple[int, ParameterSpec]]:
    """Return the parameters with a limit that unlimited logs with some modes identify."""
    seen = identifiability_of(stage).restricted_to(modes).identifiable()
    return [(j, p) for j, p in parameters_with_limit(stage) if seen[j]]
