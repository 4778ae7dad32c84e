"""Ways to the posterior of one epoch: ours, a plain loop with the eigenproblem, nested samplers."""

from __future__ import annotations

import time
from importlib.util import find_spec
from typing import NamedTuple

import emcee
import numpy as np
from emcee.autocorr import integrated_time
from numpy.random import MT19937, RandomState
from numpy.typing import NDArray

from lmshealth.health.ensemble_sampling import start_from_prior, stream
from lmshealth.health.epoch_posterior import EpochPosterior
from lmshealth.health.inference import draw
from lmshealth.stage.description import Stage, load_stage
from models.dynamics.modal_map import guide_frequencies
from models.dynamics.stages import stage_named
from studies.common.cost import cpu_s
from studies.harness.study import Row

Array = NDArray[np.float64]
TRUTH = np.log([[0.8, 0.9]])
# What two dozen logs of 20 s reach; the baseline is common to the modes of a log.
STD, COMMON = 1e-3, 5e-4
LEVELS = np.array([0.05, 0.5, 0.95])
N_WALKERS = 32
MISSING = "not installed; pip install '.[peers]'"


def epoch_posterior(stage: Stage) -> EpochPosterior:
    """Make the posterior of an epoch of LMS-Y with a fifth of the preload gone."""
    modes = stage.informative
    n = len(modes)
    cov = STD**2 * np.eye(n) + COMMON**2 * np.ones((n, n))
    return EpochPosterior.of(stage, modes, stage.drift(TRUTH, modes)[0], cov)


class Found(NamedTuple):
    """Quantiles of ln parameters, ``(3, n)``, effective sample size, and processor time in s."""

    quantiles: Array
    ess: float
    cpu_s: float


def exact(posterior: EpochPosterior, points: int) -> Array:
    """Quantiles by a grid over the posterior, found from coarse to fine."""
    low, high = posterior.prior.support
    for n in (121, 121, points):
        axes = [np.linspace(a, b, n) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
        value = posterior.log_probability(grid).reshape(n, n)
        density = np.exp(value - value.max())
        likely = np.argwhere(density > 1e-9)
        first, last = likely.min(axis=0) - 1, likely.max(axis=0) + 1
        low = np.array([axis[max(k, 0)] for axis, k in zip(axes, first, strict=True)])
        high = np.array([axis[min(k, n - 1)] for axis, k in zip(axes, last, strict=True)])
    columns = []
    for j in range(2):
        marginal = density.sum(axis=1 - j)
        share = (np.cumsum(marginal) - 0.5 * marginal) / marginal.sum()
        columns.append(np.interp(LEVELS, share, axes[j]))
    return np.column_stack(columns)


def ours(posterior: EpochPosterior, seed: int) -> Found:
    """Draw as `lmshealth infer` does: Laplace's start, four ensembles, arviz's judgement."""
    begin = time.process_time()
    found = draw(posterior, stream(seed))
    ess = float(min(found.ess_bulk.min(), found.ess_tail.min()))
    quantiles = np.quantile(found.flat, LEVELS, axis=0)
    return Found(quantiles, ess, time.process_time() - begin)


def start_of(posterior: EpochPosterior, seed: int) -> emcee.State:
    """Return the walkers that plain loops begin with."""
    rng = np.random.default_rng(seed)
    begin = start_from_prior(posterior.log_probability, posterior.prior.draw)(rng)[:N_WALKERS]
    return emcee.State(begin, random_state=RandomState(MT19937(seed)).get_state(legacy=False))


def autocorrelation_time(sampler: emcee.EnsembleSampler, steps: int) -> float:
    """Return the autocorrelation time of a chain without its first fifth."""
    return float(np.max(integrated_time(sampler.get_chain()[steps // 5 :], tol=0, quiet=True)))


def plain_loop(posterior: EpochPosterior, seed: int, steps: int, long: int) -> Row:
    """Time emcee's default with one walker at a time and the plant solved for each.

    The autocorrelation time, for which so few steps are not enough, is that of the same moves on
    the same density, evaluated by the surrogate over many more steps.
    """
    machine, view = stage_named("lms-y"), posterior.machines[0]
    base = guide_frequencies(machine, 1.0, 1.0)

    def drift(preload: float, mount: float) -> Array:
        found = guide_frequencies(machine, preload, mount)
        return np.array([np.log(found[name] / base[name]) for name in view.modes])

    def log_probability(x: Array) -> float:
        prior = float(posterior.prior.log_density(x[None])[0])
        if not np.isfinite(prior):
            return -np.inf
        preload, mount = np.exp(x)
        own = drift(preload, 1.0) ** 2 + drift(1.0, mount) ** 2
        off = view.drift - drift(preload, mount)
        terms = []
        for model_std, weight in view.stage.map_errors:
            cov = view.cov + model_std**2 * np.diag(own)
            misfit = off @ np.linalg.solve(cov, off) + np.linalg.slogdet(cov)[1]
            terms.append(np.log(weight) - 0.5 * float(misfit))
        return prior + float(np.logaddexp.reduce(terms))

    state = start_of(posterior, seed)
    few = state.coords[:5]
    same = np.array([log_probability(x) for x in few])
    sampler = emcee.EnsembleSampler(N_WALKERS, 2, log_probability)
    cpu = cpu_s(lambda: sampler.run_mcmc(state, steps)) / steps
    fast = emcee.EnsembleSampler(N_WALKERS, 2, posterior.log_probability, vectorize=True)
    fast.run_mcmc(state, long)
    tau = autocorrelation_time(fast, long)
    return {
        "program": "emcee, plain loop with the eigenproblem inside",
        "autocorrelation_time": tau,
        "ms_per_likelihood": 1e3 * cpu / N_WALKERS,
        "ess_per_s": N_WALKERS / tau / cpu,
        "largest_difference_of_log_probability": float(
            np.ptp(same - posterior.log_probability(few))
        ),
    }


def walker_loop(posterior: EpochPosterior, seed: int, steps: int) -> Row:
    """Time emcee's default with the surrogate, but one walker at a time."""
    sampler = emcee.EnsembleSampler(
        N_WALKERS, 2, lambda x: float(posterior.log_probability(x[None])[0])
    )
    state = start_of(posterior, seed)
    cpu = cpu_s(lambda: sampler.run_mcmc(state, steps))
    tau = autocorrelation_time(sampler, steps)
    return {
        "program": "emcee, plain loop over our surrogate",
        "autocorrelation_time": tau,
        "ess_per_s": N_WALKERS * steps / tau / cpu,
    }


def by_dynesty(posterior: EpochPosterior, seed: int) -> Found:
    """Run dynesty's nested sampler as its guide does, with our surrogate one point at a time."""
    import dynesty

    begin, log_likelihood = time.process_time(), posterior.machines[0].log_likelihood
    sampler = dynesty.NestedSampler(
        lambda x: float(log_likelihood(x[None])[0]),
        lambda u: posterior.prior.quantile(u[None])[0],
        2,
        rstate=np.random.default_rng(seed),
    )
    sampler.run_nested(print_progress=False)
    return _weighted(sampler.results.samples, sampler.results.importance_weights(), begin)


def by_nautilus(posterior: EpochPosterior, seed: int) -> Found:
    """Run nautilus with our surrogate for all points at once."""
    import nautilus

    begin, log_likelihood = time.process_time(), posterior.machines[0].log_likelihood
    how = {"n_dim": 2, "vectorized": True, "pass_dict": False, "seed": seed}
    sampler = nautilus.Sampler(posterior.prior.quantile, log_likelihood, **how)
    sampler.run(verbose=False, n_eff=10_000)
    points, log_weight, _ = sampler.posterior()
    return _weighted(points, np.exp(log_weight - log_weight.max()), begin)


def _weighted(points: Array, weight: Array, begin: float) -> Found:
    columns = [
        np.quantile(column, LEVELS, weights=weight, method="inverted_cdf") for column in points.T
    ]
    ess = float(weight.sum() ** 2 / np.sum(weight**2))
    return Found(np.column_stack(columns), ess, time.process_time() - begin)


def compare(seed: int, turns: int, *, quick: bool) -> Row:
    """Let all ways take turns, and compare their quantiles with those of a grid."""
    posterior = epoch_posterior(load_stage("lms-y"))
    known = exact(posterior, 201 if quick else 401)
    width = (known[2] - known[0]) / (2 * 1.645)
    ways = {"lmshealth": ours, "dynesty": by_dynesty, "nautilus": by_nautilus}
    missing = [name for name in ways if name != "lmshealth" and not find_spec(name)]
    found: dict[str, list[Found]] = {name: [] for name in ways if name not in missing}
    for turn in range(turns):
        for name, runs in found.items():
            runs.append(ways[name](posterior, seed + turn))
    rows: list[Row] = []
    for name, runs in found.items():
        off = np.array([(run.quantiles - known) / width for run in runs])
        rows.append(
            {
                "program": name,
                "cpu_s": float(np.median([run.cpu_s for run in runs])),
                "ess_per_s": float(np.median([run.ess / run.cpu_s for run in runs])),
                "rms_error_of_quantiles": float(np.sqrt(np.mean(off**2))),
            }
        )
    rows.append(walker_loop(posterior, seed, 100 if quick else 3000))
    rows.append(plain_loop(posterior, seed, 1 if quick else 60, 200 if quick else 20_000))
    for row in rows:
        row["ours_is_times_faster"] = rows[0]["ess_per_s"] / row["ess_per_s"]
    told = [f"{name}: {MISSING}" for name in missing]
    return {"turns": turns, "programs": rows, "missing": told}
