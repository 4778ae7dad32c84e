"""Lives drawn from a stage description: histories of modal estimates, and what is true of them.

They are drawn from the model of the estimator, with all that is unknown to it (README.md).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Literal

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.calibration import constants
from lmshealth.errors import BadQuestion, BadStage
from lmshealth.life import constants as of_life
from lmshealth.life.posterior.data import KM
from lmshealth.life.posterior.likelihood import (
    NO_MODE,
    common_kernel,
    lone_kernel,
    scatter_prior,
)
from lmshealth.life.posterior.scenarios import DegradationPath, Scenario, laws_of, list_scenarios
from lmshealth.life.prognosis import (
    early_life,
    lives_by_law,
    parameters_with_limit,
    rate_std,
    reach_of,
)
from lmshealth.stage import constants as of_stage
from lmshealth.stage.degradation_laws import Unchanging
from lmshealth.stage.description import Stage
from lmshealth.stage.identifiability import identifiability_of
from lmshealth.tracking.constants import BIAS_STD, HEALTHY_WALKS, JUMP_STD, LOGS_PER_LIFE
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.history import History, Series, Step

Kind = Literal["wearing", "healthy", "foreign change"]
KINDS: tuple[Kind, ...] = ("wearing", "healthy", "foreign change")
"""Some parameter changes; none does; a mode moves by a cause that the map does not have."""
START = datetime(2026, 3, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Schedule:
    """When logs are recorded, how far the machine travels, and how well a log shows the modes."""

    logs: int = 40
    every: float = 7.0  # days from log to log
    # None: that of the description, or such that the last log is at the share
    # `constants.LIFE_SEEN` of the median life of the parameter that is worn out first.
    km_per_day: float | None = None
    seconds: float = 60.0  # duration of a log
    # Relative standard deviation of the natural frequencies in one log; None: the Cramér-Rao bound
    # of such a log with the modal SNR of the description.
    frequency_std: float | None = None

    def __post_init__(self) -> None:
        if not constants.LEAST_LOGS <= self.logs <= of_life.MAX_LOGS:
            needed = f"needed are {constants.LEAST_LOGS} to {of_life.MAX_LOGS}"
            raise BadQuestion(f"{self.logs} logs a life: {needed}")
        for name in ("every", "km_per_day", "seconds", "frequency_std"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise BadQuestion(f"{name} is {value}: needed is a positive number")

    def resolved(self, stage: Stage) -> "Schedule":
        """Return the schedule with its travel per day."""
        stated = stage.description.usage.km_per_day
        if self.km_per_day is not None and stated is not None and self.km_per_day != stated:
            raise BadQuestion(
                f"{stage.name}: [usage] km_per_day is {stated:g}, and {self.km_per_day:g} is asked "
                "for: change the description, whose value decides all dates"
            )
        rate = self.km_per_day or stated
        if rate is None:
            span = self.every * (self.logs - 1)
            rate = constants.LIFE_SEEN * _median_life(stage) / KM / span
        return replace(self, km_per_day=rate)


def _median_life(stage: Stage) -> float:
    """Return the least median travel in m to a limit by the laws of a parameter, each by itself."""
    rng, n = np.random.default_rng(0), constants.N_LIVES
    medians = [stage.description.usage.horizon_km * KM]
    for _, parameter in parameters_with_limit(stage):
        assert parameter.limit is not None
        limit = parameter.limit.below / parameter.baseline
        laws = [(law, weight) for law, weight in laws_of(parameter, 0.0) if law.names]
        ends = []
        for law, weight in laws:
            share = weight / sum(own for _, own in laws)
            ends.append(lives_by_law(law, limit, rng, int(np.ceil(share * n))))
        if ends:
            medians.append(float(np.median(np.concatenate(ends))))
    return min(medians)


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """True degradation of a health parameter."""

    path: DegradationPath  # law, and begin of law and steps
    theta: FloatArray  # natural parameters of the path, lengths in m
    off: FloatArray  # ln health minus that by the path at each log, ``(n_logs,)``
    rate: float  # its variance per m

    @property
    def changes(self) -> bool:
        """Whether a law with parameters holds."""
        return bool(self.path.law.names)

    def by_law(self, travel: FloatArray) -> FloatArray:
        """Return health by the law and the steps alone, at travels in m since the baseline."""
        return np.asarray(self.path.health(self.theta[None], travel)[0])

    def left(self, rng: np.random.Generator, now: float, limit: float, horizon: float) -> float:
        """Draw the travel in m from now until the limit; inf past the horizon."""
        law = self.path.law
        left = self._left_by_law(rng, now, limit, horizon)
        if left > 0 and self.changes:
            if np.isfinite(left):
                left *= rng.lognormal(0.0, rate_std(law) * np.sqrt(np.log2(1 + left / now)))
            proven = now + early_life(law, limit, rng)
            hazard = rng.gamma(of_life.UNSEEN_ONSETS) / proven
            onset = rng.exponential() / hazard if hazard > 0 else np.inf
            growth = of_life.UNSEEN_GROWTH
            end = onset + (proven + onset) * rng.lognormal(np.log(growth.median), growth.sigma)
            left = min(left, float(end))
        return left if left <= horizon else np.inf

    def _left_by_law(
        self, rng: np.random.Generator, now: float, limit: float, horizon: float
    ) -> float:
        """Follow the parameter by its law and its deviation alone, inf far past the horizon."""
        start = limit * np.exp(-self.off[-1])
        closed = float(self.path.passage(self.theta[None], start)[0]) - now
        # A parameter that gains may have been below the limit before.
        if closed <= 0 and self.by_law(np.array([now]))[0] > start:
            return np.inf
        if self.rate == 0 or closed <= 0:
            return closed
        n, reach = constants.STEPS_AHEAD, reach_of(self.path.law, now, horizon)
        ends = np.append(np.linspace(0.0, horizon, n + 1), np.linspace(horizon, reach, n + 1)[1:])
        ahead = ends[1:]
        walk = np.cumsum(np.sqrt(self.rate * np.diff(ends)) * rng.standard_normal(ahead.size))
        with np.errstate(divide="ignore"):
            health = np.log(self.by_law(now + ahead)) + self.off[-1] + walk
        below = np.flatnonzero(health <= np.log(limit))
        return float(ahead[below[0]]) if below.size else np.inf


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """A history, and what is true of it."""

    history: History
    parts: tuple[Part, ...]  # one for each health parameter
    lone: int  # index of the mode that moves alone, or `NO_MODE`
    common: float  # standard deviation of ln f by a wander that all modes have in common
    walk: float  # standard deviation of ln f at the last log by its random walk
    rate: float  # mean travel in m per day
    scatter: float  # standard deviation of the travel from log to log, as a share of its mean

    @property
    def now(self) -> float:
        """Travel since the baseline in m."""
        return float(np.ptp(self.history.travel))

    @property
    def kind(self) -> Kind:
        """What happens in this life."""
        if self.lone != NO_MODE:
            return "foreign change"
        return "wearing" if any(part.changes for part in self.parts) else "healthy"

    @property
    def still(self) -> bool:
        """Whether health is constant, and ln f wanders as the tracker has it for healthy machines.

        The tracker declares its false alarms for these machines alone.
        """
        n_lives = (len(self.history.logs) - 1) / LOGS_PER_LIFE
        most = max(walk for walk, _ in HEALTHY_WALKS) * np.sqrt(n_lives)
        constant = self.kind == "healthy" and all(part.rate == 0 for part in self.parts)
        return bool(constant and self.walk <= most and self.common == 0)

    @property
    def health(self) -> FloatArray:
        """Health now as fractions of the baseline, ``(n_parameters,)``."""
        now = np.array([self.now])
        return np.array([part.by_law(now)[0] * np.exp(part.off[-1]) for part in self.parts])

    def days(self, rng: np.random.Generator, travel: float) -> float:
        """Draw the days in which a travel in m from now passes, with the scatter of the usage."""
        every = (self.history.recorded_at[1] - self.history.recorded_at[0]) / timedelta(days=1)
        if not 0 < travel < np.inf or self.scatter == 0:
            return travel / self.rate
        n = int(np.ceil(1.5 * travel / (self.rate * every))) + 20
        odometer = np.cumsum(self.rate * every * _paces(rng, n, self.scatter))
        return float(np.interp(travel, np.r_[0.0, odometer], every * np.arange(n + 1)))


def _paces(rng: np.random.Generator, n: int, scatter: float) -> FloatArray:
    """Draw the travel of intervals over its mean, always positive."""
    return np.maximum(1 + scatter * rng.standard_normal(n), constants.LEAST_PACE)


def draw(
    rng: np.random.Generator,
    stage: Stage,
    schedule: Schedule,
    kind: Kind | None = None,
    *,
    steps: float = 0.0,
    second_source: float = 0.0,
) -> Life:
    """Draw a life of a stage, by default of any kind, with the probabilities of its description.

    Of a share ``steps`` of lives the tracker reports a step, which is true as often as the prior of
    the estimator has it; a share ``second_source`` has a second source of its second mode.
    Logs are retuned now and then, and some estimates and temperatures are missing.
    """
    names, n = stage.informative, schedule.logs
    schedule = schedule.resolved(stage)
    assert schedule.km_per_day is not None
    rate = schedule.km_per_day * KM
    scatter = 0.0 if stage.description.usage.km_per_day else of_life.USAGE_SCATTER
    clock = np.r_[0.0, np.cumsum(rate * schedule.every * _paces(rng, n - 1, scatter))]
    first = int(rng.integers(5, n - 5)) if rng.random() < steps else None
    at = () if first is None else (float(clock[first - 1] + clock[first]) / 2,)
    parts = _parts(rng, stage, clock, at, kind)
    series = tuple(Series(name, "acc") for name in names)
    if len(names) > 1 and rng.random() < second_source:
        series = (*series, Series(names[1], "delta_e"))
    covariates, declared = _covariates(rng, stage, n), _declared(rng, series, n)
    if first is not None:
        declared = (*declared, Step.found("step", first, n))
    # Health moves the modes by a map that is wrong; other causes move them too.
    level, *alone = stage.drifts(np.log(_path(stage, clock, parts)), names)
    for own, error in zip(alone, map_errors(rng, stage, len(names)), strict=True):
        level = level + error * own
    moved, lone, common, walk = without_health(rng, stage, clock, len(names), kind, at)
    known = np.log([mode.frequency_hz for mode in stage.modes if mode.name in names])
    level = level + moved + known + _covariate_effects(rng, stage, covariates, n, len(names))
    mode = np.array([names.index(one.mode) for one in series])
    cov = _covariance(rng, stage, schedule, mode)
    scale = rng.choice(of_life.NOISE_SCALES, p=shares(stage, "noise_scale"))
    noise = (np.linalg.cholesky(cov) @ rng.standard_normal((n, 2 * mode.size, 1)))[..., 0]
    frequency = level[:, mode] + _offsets(rng, series, mode, declared, n)
    frequency += scale * noise[:, : mode.size]
    zeta = np.log([one.damping_ratio for one in stage.modes if one.name in names])
    history = make_history(
        names,
        constants.ODOMETER + clock,
        (frequency, zeta[mode] + noise[:, mode.size :], cov),
        series=series,
        covariates=covariates,
        steps=tuple(sorted(declared, key=lambda step: step.first)),
        missing=rng.random((n, mode.size)) < constants.MISSING,
        every=schedule.every,
    )
    return Life(history, parts, lone, common, walk, rate, scatter)


def make_history(
    modes: Sequence[str],
    travel: FloatArray,
    estimates: tuple[FloatArray, FloatArray, FloatArray],
    *,
    series: Sequence[Series] | None = None,
    covariates: Mapping[str, FloatArray] | None = None,
    steps: tuple[Step, ...] = (),
    missing: BoolArray | None = None,
    every: float = 1.0,
) -> History:
    """Make a history of regular logs whose first is the baseline.

    Odometer in m; ``estimates`` are ln frequency and ln damping ``(n_logs, n_series)`` and the
    covariance of both; ``missing`` ones become NaN. A log follows ``every`` so many days. By
    default an accelerometer sees each mode.
    """
    ln_frequency, ln_damping, cov = estimates
    if missing is not None:
        gone = np.hstack([missing, missing])
        ln_frequency = np.where(missing, np.nan, ln_frequency)
        ln_damping = np.where(missing, np.nan, ln_damping)
        cov = np.where(gone[:, :, None] | gone[:, None, :], np.nan, cov)
    n = travel.size
    return History(
        stage="AX-1",
        logs=tuple(f"{k:05d}" for k in range(n)),
        recorded_at=tuple(START + timedelta(days=every * k) for k in range(n)),
        travel=travel,
        covariates=dict(covariates or {}),
        modes=tuple(modes),
        series=tuple(series or (Series(name, "acc") for name in modes)),
        ln_frequency=ln_frequency,
        ln_damping=ln_damping,
        cov=cov,
        loop_error=np.full(n, np.nan),
        baselines=(0,),
        steps=steps,
    )


def _parts(
    rng: np.random.Generator,
    stage: Stage,
    clock: FloatArray,
    steps: tuple[float, ...],
    kind: Kind | None,
) -> tuple[Part, ...]:
    """Draw scenarios and deviations from their priors, until a life stays inside the map."""
    assert stage.modal_map is not None
    now, free = float(clock[-1]), stage.description.life.free
    scenarios = list_scenarios(stage.parameters, steps, now, free)
    if kind == "healthy":
        still = DegradationPath(Unchanging(), 0.0, ())
        scenarios = (Scenario((still,) * len(stage.parameters), now, 1.0),)
    if kind == "wearing":
        scenarios = tuple(one for one in scenarios if any(p.law.names for p in one.paths))
        if not scenarios:
            raise BadStage(f"{stage.name}: no law lets a parameter change: no life wears")
    weights = np.array([one.weight for one in scenarios])
    for _ in range(constants.MOST_TRIES):
        scenario = scenarios[rng.choice(weights.size, p=weights / weights.sum())]
        theta = scenario.split(scenario.natural(scenario.draw(rng, 1))[0])
        pairs = zip(scenario.paths, theta, strict=True)
        deviation = rng.choice(of_life.DEVIATION_STDS, p=shares(stage, "deviation"))
        parts = tuple(part_of(rng, path, own, float(deviation), clock) for path, own in pairs)
        with np.errstate(divide="ignore"):
            if stage.modal_map.inside(np.log(_path(stage, clock, parts))).all():
                return parts
    raise BadStage(
        f"{stage.name}: of {constants.MOST_TRIES} lives drawn from its laws over {now / KM:.4g} km "
        "none stays inside the modal map; extend the map, or correct laws and travel"
    )


def part_of(
    rng: np.random.Generator,
    path: DegradationPath,
    theta: FloatArray,
    deviation: float,
    clock: FloatArray,
) -> Part:
    """Draw how health wanders about a path, with a standard deviation by the last log."""
    rate = deviation**2 / float(clock[-1])
    steps = np.sqrt(rate * np.diff(clock, prepend=0.0)) * rng.standard_normal(clock.size)
    return Part(path, theta, np.cumsum(steps), rate)


def shares(stage: Stage, field: str) -> FloatArray:
    """Return the prior of the walk, the noise scale or the deviation, of sum 1."""
    weight = np.array(getattr(scatter_prior(stage), field))
    return np.asarray(weight / weight.sum())


def _path(stage: Stage, clock: FloatArray, parts: Sequence[Part]) -> FloatArray:
    """Return the health parameters along a life, ``(n_logs, n_parameters)``."""
    pairs = zip(stage.parameters, parts, strict=True)
    columns = [p.baseline * part.by_law(clock) * np.exp(part.off) for p, part in pairs]
    return np.column_stack(columns)


def map_errors(rng: np.random.Generator, stage: Stage, n_modes: int) -> FloatArray:
    """Draw the relative errors of a map, as declared or larger, ``(n_parameters, n_modes)``."""
    scales, weights = zip(*of_stage.MAP_ERRORS, strict=True)
    unit = rng.standard_normal((len(stage.parameters), n_modes))
    error = unit @ np.linalg.cholesky(stage.map_cov(n_modes)).T
    return np.asarray(rng.choice(scales, p=weights) * error)


def without_health(
    rng: np.random.Generator,
    stage: Stage,
    clock: FloatArray,
    n_modes: int,
    kind: Kind | None = None,
    steps: tuple[float, ...] = (),
) -> tuple[FloatArray, int, float, float]:
    """Draw intercepts, random walks, a common wander, and the drift of a mode that moves alone.

    Of ln f at each log, ``(n_logs, n_modes)``; the index of that mode, which may jump at a step, or
    `NO_MODE`; and the standard deviations of the wander, and of the walks at the last log.
    """
    prior, common = stage.description.life, 0.0
    which, alone, together = rng.random(), prior.lone_mode, prior.common_wander * (n_modes > 1)
    if kind is not None:
        alone = 1 / n_modes if kind == "foreign change" else 0.0
    lone = int(which / alone) if which < n_modes * alone else NO_MODE
    if lone == NO_MODE and which < n_modes * alone + together:
        common = float(rng.choice(of_life.COMMON_STDS))
    if lone == NO_MODE and not common:
        walk = rng.choice(of_life.WALK_STDS, p=shares(stage, "walk"))
    else:
        stds, weights = zip(*of_life.LONE_WALKS, strict=True)
        walk = rng.choice(stds, p=weights)
    stds_of_logs = walk * np.sqrt(np.diff(clock, prepend=0.0) / clock[-1])
    drift = np.cumsum(stds_of_logs[:, None] * rng.standard_normal((clock.size, n_modes)), axis=0)
    if common:
        cov = common**2 * common_kernel(np.arange(clock.size))
        drift += rng.multivariate_normal(np.zeros(clock.size), cov, method="cholesky")[:, None]
    if lone != NO_MODE:
        cov = of_life.LONE_STD**2 * lone_kernel(clock, clock, float(clock[-1]), steps)
        # It is 0 at the baseline: no Cholesky factor.
        drift[:, lone] += rng.multivariate_normal(np.zeros(clock.size), cov, method="eigh")
    level = constants.INTERCEPT_STD * rng.standard_normal(n_modes)
    return drift + level, lone, common, float(walk)


def _covariates(rng: np.random.Generator, stage: Stage, n: int) -> dict[str, FloatArray]:
    """Draw covariates about their references, by which ln f moves by `COVARIATE_EFFECT`."""
    effect, found = constants.COVARIATE_EFFECT, {}
    for one in stage.description.covariate:
        values = one.reference + effect / one.prior_std * rng.standard_normal(n)
        # A log without the value of a covariate of large effect has no use: it is never missing.
        if one.prior_std <= effect:
            values[rng.random(n) < constants.MISSING] = np.nan
        found[one.name] = values
    return found


def _covariate_effects(
    rng: np.random.Generator,
    stage: Stage,
    covariates: dict[str, FloatArray],
    n_logs: int,
    n_modes: int,
) -> FloatArray:
    """Draw the effects of covariates on ln f of each mode, known or not."""
    total = np.zeros((n_logs, n_modes))
    for one in regressors(covariates, stage):
        total += np.outer(one.values, one.prior_std * rng.standard_normal(n_modes))
        total += np.sqrt(one.unknown)[:, None] * rng.standard_normal((n_logs, n_modes))
    return total


def _declared(rng: np.random.Generator, series: Sequence[Series], n: int) -> tuple[Step, ...]:
    """Draw declared retunings, and changes of the sensor of a second source."""
    steps = []
    if rng.random() < constants.RETUNED:
        first = int(rng.integers(1, n))
        steps.append(Step("servo", first, np.arange(n) >= first, name="v2"))
    if len({one.source for one in series}) > 1 and rng.random() < 0.5:
        first = int(rng.integers(1, n))
        steps.append(Step("sensor", first, np.arange(n) >= first, source="delta_e"))
    return tuple(steps)


def _offsets(
    rng: np.random.Generator,
    series: Sequence[Series],
    mode: np.ndarray,
    steps: Sequence[Step],
    n: int,
) -> FloatArray:
    """Draw the bias of a second source, and the sizes of declared steps."""
    second = [one.mode in {other.mode for other in series[:i]} for i, one in enumerate(series)]
    total = np.tile(second * rng.normal(0, BIAS_STD[0], len(series)), (n, 1))
    for step in steps:
        if step.kind == "step":  # health itself jumps
            continue
        jump = rng.normal(0, JUMP_STD[step.kind][0], len(series))[mode]
        seen = [step.source in ("", one.source) for one in series]
        total += np.outer(step.there, jump * seen)
    return total


def _covariance(
    rng: np.random.Generator, stage: Stage, schedule: Schedule, mode: np.ndarray
) -> FloatArray:
    """Draw covariances of ln f and ln ζ that differ from log to log, ``(n_logs, 2 r, 2 r)``.

    Errors of one mode by two sources are mostly common.
    """
    bound = identifiability_of(stage).log_std(schedule.seconds)[:, mode]
    if schedule.frequency_std is not None:
        bound = bound * schedule.frequency_std / bound[:1]
    if not np.isfinite(bound).all():
        raise BadQuestion(
            f"{stage.name}: logs of {schedule.seconds:g} s are too short to identify its modes; "
            "needed are longer ones, or the standard deviation of their frequencies"
        )
    factor = np.exp(constants.LOG_SCATTER * rng.standard_normal((schedule.logs, mode.size)))
    correlation = np.where(np.equal.outer(mode, mode), *constants.CORRELATIONS)
    np.fill_diagonal(correlation, 1.0)
    r = mode.size
    cov = np.zeros((schedule.logs, 2 * r, 2 * r))
    for part, own in ((slice(r), bound[0]), (slice(r, 2 * r), bound[1])):
        std = own * factor
        cov[:, part, part] = std[:, :, None] * std[:, None, :] * correlation
    return cov
