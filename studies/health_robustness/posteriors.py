"""Draws of health at an epoch and of a whole life, by importance sampling.

The densities are those that `lmshealth.infer` and `lmshealth.prognose` sample; the study checks
that both ways give the same quantiles.
"""

from __future__ import annotations

from contextlib import nullcontext
from unittest.mock import patch

import numpy as np

from lmshealth.health.epoch_posterior import EpochPosterior
from lmshealth.health.importance_sampling import importance_sample_to_ess
from lmshealth.prognosis import constants
from lmshealth.prognosis import life_likelihood as life_module
from lmshealth.prognosis.life_posterior import fit_life
from lmshealth.prognosis.remaining_life import parameters_with_limit, remaining_travel
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track
from studies.common.lives import Array

_N_PRIOR, _N_POINTS, _N_DRAWS = 1000, 2000, 4000


def epoch_draws(
    track: Track, stage: Stage, epoch: int, rng: np.random.Generator, shrink: float = 1.0
) -> Array:
    """Draw health at one epoch of a track, without a law; ``shrink`` falsifies the covariance."""
    modes = tuple(name for name in stage.informative if name in track.modes)
    columns = [track.modes.index(name) for name in modes]
    cov = shrink * track.drift_cov[epoch][np.ix_(columns, columns)]
    posterior = EpochPosterior.of(stage, modes, track.drift[epoch][columns], cov)
    start = posterior.draw_prior(rng, _N_PRIOR)
    found = importance_sample_to_ess(posterior.log_probability, start, rng, _N_POINTS)
    return np.asarray(np.exp(found.resampled(rng, _N_DRAWS)))


def life_draws(
    history: History,
    stage: Stage,
    rng: np.random.Generator,
    *,
    noise_known: bool = False,
    chains: bool = False,
) -> tuple[Array, Array]:
    """Draw health now, and the travel left to each limit and to the first, by the laws.

    Parameters
    ----------
    noise_known : bool
        Whether the stated covariance is all; otherwise a factor on it, a random walk of the
        frequencies and a deviation of health from its laws are averaged over, and take what it
        does not explain.
    chains : bool
        As in `fit_life`.

    Returns
    -------
    now : ndarray
        Fractions of baseline, shape ``(n_draws, n_parameters)``.
    left : ndarray
        In m, infinite past the horizon and 0 where a limit is passed already,
        shape ``(n_draws, n_limits + 1)``.
    """
    with _noise_as_stated() if noise_known else nullcontext():
        found = fit_life(history, stage, int(rng.integers(2**32)), chains=chains, n_draws=_N_DRAWS)
    now, horizon = history.clock()[-1], 1000 * stage.description.usage.horizon_km
    left = remaining_travel(found, parameters_with_limit(stage), rng, now=now, horizon=horizon)
    return found.health.reshape(-1, found.health.shape[-1]), claimed(left, stage)


def claimed(left: Array, stage: Stage) -> Array:
    """Give of the travel left what is claimed: no end past the horizon, no time of one passed."""
    horizon = 1000 * stage.description.usage.horizon_km
    return np.where(left > horizon, np.inf, np.maximum(left, 0.0))


def _noise_as_stated() -> patch.multiple:
    """Leave of the grid of `lmshealth.life` the point at which estimates are all that errs."""
    return patch.multiple(
        life_module,
        _WALKS=constants.WALKS[:1],
        _NOISE_SCALES=(1.0,),
        _NOISE_SCALE_PRIOR=(1.0,),
        _DEVIATIONS=(0.0,),
        _DEVIATION_PRIOR=(1.0,),
    )
