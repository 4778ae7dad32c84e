"""Two ways to the posterior of one epoch: ours, and a plain loop of emcee over the same density."""

from __future__ import annotations

import time
from typing import NamedTuple

import emcee
import numpy as np
from emcee.autocorr import integrated_time
from numpy.random import MT19937, RandomState

from lmshealth._private.seeds import stream
from lmshealth.life.ensemble_sampling import start_from_prior
from lmshealth.health.epoch_posterior import EpochPosterior
from lmshealth.life.inference import draw
from lmshealth.stage.description import Stage
from studies.harness.cost import cpu_s

TRUTH = np.log([[0.8, 0.9]])
# What two dozen logs of 20 s reach; the baseline is common to the modes of a log.
STD, COMMON = 1e-3, 5e-4
N_WALKERS = 32


def epoch_posterior(stage: Stage) -> EpochPosterior:
    """Make the posterior of an epoch of LMS-Y with a fifth of the preload gone."""
    modes = stage.informative
    n = len(modes)
    cov = STD**2 * np.eye(n) + COMMON**2 * np.ones((n, n))
    return EpochPosterior.of(stage, modes, stage.drift(TRUTH, modes)[0], cov)


class Found(NamedTuple):
    """Effective sample size, and processor time in s."""

    ess: float
    cpu_s: float


def ours(posterior: EpochPosterior, seed: int) -> Found:
    """Draw as `lmshealth infer` does: Laplace's start, four ensembles, arviz's judgement."""
    begin = time.process_time()
    found = draw(posterior, stream(seed))
    ess = float(min(found.ess_bulk.min(), found.ess_tail.min()))
    return Found(ess, time.process_time() - begin)


def walker_loop(posterior: EpochPosterior, seed: int, steps: int) -> float:
    """Return effective draws a second of emcee's default, one walker of the density at a time."""
    rng = np.random.default_rng(seed)
    begin = start_from_prior(posterior.log_probability, posterior.prior.draw)(rng)[:N_WALKERS]
    state = emcee.State(begin, random_state=RandomState(MT19937(seed)).get_state(legacy=False))
    sampler = emcee.EnsembleSampler(
        N_WALKERS, 2, lambda x: float(posterior.log_probability(x[None])[0])
    )
    cpu = cpu_s(lambda: sampler.run_mcmc(state, steps))
    # Without the first fifth of the chain.
    tau = float(np.max(integrated_time(sampler.get_chain()[steps // 5 :], tol=0, quiet=True)))
    return N_WALKERS * steps / tau / cpu
