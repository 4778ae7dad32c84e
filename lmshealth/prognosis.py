"""Remaining useful life: when the laws of a life reach their limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.errors import BadStage, NotEnoughData
from lmshealth.life import LifeLikelihood, limited
from lmshealth.results import Prognosis
from lmshealth.sampling import sample, start_from_prior, stream, thin
from lmshealth.stage import Stage
from lmshealth.tracks import History

_STEP = 1 << 20  # far from the epochs that health counts its streams by
_N_DRAWS = 10_000
_N_CURVE = 121
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
    likelihood = LifeLikelihood(history, stage)
    streams = stream(seed, _STEP).spawn(3)
    y, ess, r_hat = _posterior(likelihood, streams[0], streams[1])
    rng = np.random.default_rng(streams[2])
    walk, noise_scale, chi_square, dof = likelihood.settings(y[:500])
    remaining = np.empty((_N_DRAWS, len(ends) + 1))
    parts = likelihood.split(y)
    since = history.travel[-1] - history.travel[history.baseline]
    for column, (j, parameter) in enumerate(ends):
        assert parameter.limit is not None  # limited() has chosen
        theta = likelihood.laws[j].natural(parts[j], likelihood.now)
        limit = parameter.limit.below / parameter.baseline
        remaining[:, column] = likelihood.laws[j].passage(theta, limit) - since
    remaining[:, -1] = remaining[:, :-1].min(axis=1)
    horizon = stage.description.usage.horizon_km * _KM
    travel = _curve_grid(remaining[:, -1], since, horizon)
    positions = [j for j, _ in ends]
    unit = np.array([parameter.baseline for _, parameter in ends])
    curves = likelihood.health(y[:2000], travel)[..., positions] * unit
    start = history.travel[history.baseline]
    return Prognosis(
        stage=history.stage,
        recorded_at=history.recorded_at[-1],
        travel=float(history.travel[-1]),
        parameters=(*(p.name for _, p in ends), "any"),
        limits=np.array([p.limit.below for _, p in ends if p.limit] + [np.nan]),
        remaining=remaining,
        usage=_usage(history, stage, rng),
        horizon=horizon,
        health=likelihood.health(y, np.array([since]))[:, 0, positions] * unit,
        curve_travel=travel + start,
        curve_quantiles=np.quantile(curves, _LEVELS, axis=0),
        chi_square=chi_square,
        degrees_of_freedom=dof,
        walk=walk,
        noise_scale=noise_scale,
        ess=ess,
        r_hat=r_hat,
    )


def _posterior(
    likelihood: LifeLikelihood, start: np.random.SeedSequence, seed: np.random.SeedSequence
) -> tuple[FloatArray, float, float]:
    """Draw sampling coordinates from the posterior: draws, worst ESS, worst R-hat."""
    if likelihood.n_dim == 0:
        return np.empty((_N_DRAWS, 0)), float("inf"), 1.0
    begin = start_from_prior(likelihood.log_probability, likelihood.draw_prior, 300)
    likelihood.narrow(begin(np.random.default_rng(start)))
    begin = start_from_prior(likelihood.log_probability, likelihood.draw_prior, 300)
    found = sample(likelihood.log_probability, begin, seed)
    draws = thin(found.draws, _N_DRAWS // found.draws.shape[0])
    ess = min(found.ess_bulk.min(), found.ess_tail.min())
    return draws.reshape(-1, draws.shape[-1]), float(ess), float(found.r_hat.max())


def _curve_grid(remaining: FloatArray, since: float, horizon: float) -> FloatArray:
    """Travel since the baseline, far enough ahead to show when most lives end."""
    ahead = float(np.quantile(np.minimum(remaining, horizon), 0.75))
    return np.linspace(0.0, since + min(max(1.3 * ahead, 0.5 * since), horizon), _N_CURVE)


def _usage(history: History, stage: Stage, rng: np.random.Generator) -> FloatArray:
    """Draw the travel per day in m.

    Learned from the odometer: increments between logs are taken as independent, so that the total
    over the total time has the relative error of a ratio estimate.
    """
    stated = stage.description.usage.km_per_day
    if stated is not None:
        return np.full(_N_DRAWS, stated * _KM)
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
    return np.asarray(rate * np.exp(relative * rng.standard_normal(_N_DRAWS)))
