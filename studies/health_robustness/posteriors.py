"""Posteriors of a life as the study asks for them, drawn by importance sampling.

The densities are those that `lmshealth.infer` and `lmshealth.prognose` sample; the study checks
that both ways give the same quantiles.
"""

from __future__ import annotations

from unittest.mock import patch

import numpy as np

from lmshealth import life as life_module
from lmshealth.epoch import EpochPosterior
from lmshealth.life import LifeLikelihood
from lmshealth.prognosis import limited
from lmshealth.stage import Stage
from lmshealth.tracks import History, Track
from studies.importance import Draws, believed, explore


def epoch_draws(
    track: Track, stage: Stage, epoch: int, rng: np.random.Generator, shrink: float = 1.0
) -> Draws:
    """Draw health at one epoch of a track, without a law; ``shrink`` falsifies the covariance."""
    modes = tuple(name for name in stage.informative if name in track.modes)
    columns = [track.modes.index(name) for name in modes]
    cov = shrink * track.drift_cov[epoch][np.ix_(columns, columns)]
    posterior = EpochPosterior.of(stage, modes, track.drift[epoch][columns], cov)
    draws = believed(posterior.log_probability, posterior.draw_prior(rng, 1000), rng, 8000)
    return Draws(np.exp(draws.points), draws.weight)


def life_draws(
    history: History, stage: Stage, rng: np.random.Generator, *, noise_known: bool = False
) -> tuple[Draws, Draws]:
    """Draw health now and the travel left to each limit and to the first, by the laws.

    Parameters
    ----------
    noise_known : bool
        Whether the stated covariance is all; otherwise a factor on it and a random walk of the
        frequencies are averaged over, and take what it does not explain.
    """
    if noise_known:
        with (
            patch.object(life_module, "_NOISE_SCALES", (1.0,)),
            patch.object(life_module, "_NOISE_SCALE_PRIOR", (1.0,)),
            patch.object(life_module, "_WALKS", life_module._WALKS[:1]),
        ):
            likelihood = LifeLikelihood(history, stage)
    else:
        likelihood = LifeLikelihood(history, stage)
    about = explore(likelihood.log_probability, likelihood.draw_prior(rng, 600), rng, 600)
    start = about.resampled(rng, 200)
    likelihood.narrow(start)
    draws = believed(likelihood.log_probability, start, rng, 3000)
    now = likelihood.health(draws.points, np.array([likelihood.now]))[:, 0]
    parts = likelihood.split(draws.points)
    left = []
    for j, parameter in limited(stage):
        assert parameter.limit is not None
        theta = likelihood.laws[j].natural(parts[j], likelihood.now)
        below = parameter.limit.below / parameter.baseline
        left.append(likelihood.laws[j].passage(theta, below) - likelihood.now)
    remaining = np.column_stack([*left, np.min(left, axis=0)])
    return Draws(now, draws.weight), Draws(remaining, draws.weight)
