"""Two ways to draw a scenario of a life: ours, and a plain loop of emcee over its density."""

from __future__ import annotations

import time
from typing import NamedTuple

import emcee
import numpy as np
from emcee.autocorr import integrated_time
from numpy.random import MT19937, RandomState

from lmshealth._private.serialize import stream
from lmshealth.calibration.lives import START
from lmshealth.life.posterior.likelihood import LifeDensity, LifeLikelihood
from lmshealth.life.posterior.sampling import (
    WeightedDraws,
    draw_to_ess,
    importance_sample,
    sample,
)
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.read_tables import Drifts
from studies.harness.cost import cpu_s

TRUTH = np.log([[0.8, 0.9]])
# What two dozen logs of 20 s reach; the baseline is common to the modes of a log.
STD, COMMON = 1e-3, 5e-4
N_WALKERS = 32


def drifts_of_an_epoch(stage: Stage) -> Drifts:
    """Make the drifts of LMS-Y with a fifth of the preload gone."""
    modes = stage.informative
    n = len(modes)
    cov = STD**2 * np.eye(n) + COMMON**2 * np.ones((n, n))
    drift = stage.drift(TRUTH, modes)
    return Drifts("AX-Y", (START,), np.array([1e6]), modes, drift, cov[None])


class Target(NamedTuple):
    """The density of a scenario, with the grid points that matter, and weighted draws of it."""

    density: LifeDensity
    draws: WeightedDraws


def target(history: History, stage: Stage) -> Target:
    """Make the density of the first scenario of a life, by the laws that it follows."""
    likelihood, rng = LifeLikelihood.of(history, stage), np.random.default_rng(0)
    scenario = likelihood.data.scenarios[0]
    density = LifeDensity(likelihood, scenario, likelihood.grid)
    start = scenario.draw(rng, 600)
    rough = importance_sample(density.log_probability, start, rng, 2000)
    draws = draw_to_ess(density.log_probability, rough, rng, 100.0)
    density = density.narrowed(draws.resampled(rng, 100))
    return Target(density, draws)


class Found(NamedTuple):
    """Effective sample size, and processor time in s."""

    ess: float
    cpu_s: float


def ours(own: Target, seed: int) -> Found:
    """Draw as a life is drawn: four ensembles about weighted draws, arviz's judgement."""
    begin = time.process_time()
    found = sample(own.density.log_probability, own.draws, stream(seed))
    ess = float(min(found.ess_bulk.min(), found.ess_tail.min()))
    return Found(ess, time.process_time() - begin)


def walker_loop(own: Target, seed: int, steps: int) -> float:
    """Return effective draws a second of emcee's default, one walker of the density at a time."""
    rng = np.random.default_rng(seed)
    begin = own.draws.resampled(rng, N_WALKERS)
    state = emcee.State(begin, random_state=RandomState(MT19937(seed)).get_state(legacy=False))
    sampler = emcee.EnsembleSampler(
        *begin.shape, lambda x: float(own.density.log_probability(x[None])[0])
    )
    cpu = cpu_s(lambda: sampler.run_mcmc(state, steps))
    # Without the first fifth of the chain.
    tau = float(np.max(integrated_time(sampler.get_chain()[steps // 5 :], tol=0, quiet=True)))
    return N_WALKERS * steps / tau / cpu
