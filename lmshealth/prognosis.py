"""Remaining useful life: when the laws of a life reach their limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.errors import BadStage, NotEnoughData
from lmshealth.lifefit import fit_life
from lmshealth.results import Prognosis
from lmshealth.sampling import stream
from lmshealth.stage import ParameterSpec, Stage
from lmshealth.tracks import History

_STEP = 1 << 21
_N_CURVE, _EVERY = 121, 5
_SECONDS_PER_DAY = 86_400.0
_KM = 1000.0
_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)


def prognose(history: History, stage: Stage, seed: int | Sequence[int]) -> Prognosis:
    """Infer the degradation laws of a stage and the travel left to each limit.

    Parameters
    ----------
    history : History
        Modal estimates of all logs.
    stage : Stage
        Laws, limits, modal map and usage.
    seed : int or sequence of int
        Of all randomness.

    Returns
    -------
    Prognosis
        10,000 draws. Runs that never reach a limit are kept, as infinite.

    Raises
    ------
    BadStage
        If no health parameter has a limit.
    NotEnoughData
        If the history is too short.
    NotConverged
        If the sampler did not converge.
    """
    ends = limited(stage)
    if not ends:
        raise BadStage(f"{stage.name}: no [[parameter]] has a limit, so there is no end of life")
    # Health has its streams by epoch, the life its own; this one is of the usage alone.
    rng = np.random.default_rng(stream(seed, _STEP))
    life = fit_life(history, stage, seed)
    theta = [life.theta(j) for j, _ in ends]
    laws = [parameter.law for _, parameter in ends]
    since = history.travel[-1] - history.travel[history.baseline]
    remaining = np.empty((theta[0].shape[0], len(ends) + 1))
    for column, (_, parameter) in enumerate(ends):
        assert parameter.limit is not None  # limited() has chosen
        limit = parameter.limit.below / parameter.baseline
        remaining[:, column] = laws[column].passage(theta[column], limit) - since
    remaining[:, -1] = remaining[:, :-1].min(axis=1)
    horizon = stage.description.usage.horizon_km * _KM
    travel = _curve_grid(remaining[:, -1], since, horizon)
    unit = np.array([parameter.baseline for _, parameter in ends])

    def health(moments: FloatArray, every: int) -> FloatArray:
        paths = zip(laws, theta, strict=True)
        values = np.stack([law.health(own[::every], moments) for law, own in paths], axis=-1)
        return np.asarray(values * unit)

    start = history.travel[history.baseline]
    return Prognosis(
        stage=history.stage,
        recorded_at=history.recorded_at[-1],
        travel=float(history.travel[-1]),
        parameters=(*(p.name for _, p in ends), "any"),
        limits=np.array([p.limit.below for _, p in ends if p.limit] + [np.nan]),
        remaining=remaining,
        usage=_usage(history, stage, rng, remaining.shape[0]),
        horizon=horizon,
        health=health(np.array([since]), 1)[:, 0],
        curve_travel=travel + start,
        curve_quantiles=np.quantile(health(travel, _EVERY), _LEVELS, axis=0),
        chi_square=life.chi_square,
        degrees_of_freedom=life.degrees_of_freedom,
        walk=life.walk,
        noise_scale=life.noise_scale,
        ess=life.ess,
        r_hat=life.worst_r_hat,
    )


def _curve_grid(remaining: FloatArray, since: float, horizon: float) -> FloatArray:
    """Travel since the baseline, far enough ahead to show when most lives end."""
    ahead = float(np.quantile(np.minimum(remaining, horizon), 0.75))
    return np.linspace(0.0, since + min(max(1.3 * ahead, 0.5 * since), horizon), _N_CURVE)


def _usage(history: History, stage: Stage, rng: np.random.Generator, n_draws: int) -> FloatArray:
    """Draw the travel per day in m.

    Learned from the odometer: increments between logs are taken as independent, so that the total
    over the total time has the relative error of a ratio estimate.
    """
    stated = stage.description.usage.km_per_day
    if stated is not None:
        return np.full(n_draws, stated * _KM)
    seconds = np.array([moment.timestamp() for moment in history.recorded_at])
    days = np.diff(seconds) / _SECONDS_PER_DAY
    steps = np.diff(history.travel)
    used = days > 0
    if used.sum() < 2 or steps[used].sum() <= 0:
        raise NotEnoughData(
            f"{history.stage}: the odometer does not tell the usage; state [usage] km_per_day"
        )
    rate = steps[used].sum() / days[used].sum()
    residual = steps[used] - rate * days[used]
    n = int(used.sum())
    relative = np.sqrt(n / (n - 1) * np.sum(residual**2)) / steps[used].sum()
    return np.asarray(rate * np.exp(relative * rng.standard_normal(n_draws)))


def limited(stage: Stage) -> list[tuple[int, ParameterSpec]]:
    """Parameters that have a limit, with their position."""
    return [(j, p) for j, p in enumerate(stage.parameters) if p.limit is not None]
