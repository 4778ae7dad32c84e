"""The posterior of a whole life: degradation laws fitted to the ln frequencies of all its logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from lmshealth.arrays import FloatArray, expect_shape, freeze
from lmshealth.life import LifeLikelihood
from lmshealth.results import QUANTILES
from lmshealth.sampling import Sample, sample, start_from_prior, stream
from lmshealth.stage import Stage
from lmshealth.tracks import History

if TYPE_CHECKING:
    from xarray import DataTree

_STEP = 1 << 20  # far from the epochs that health counts its streams by
_N_ENSEMBLES, _N_KEPT, _N_PRIOR, _N_SETTINGS = 4, 2500, 10_000, 500
_ENDS = (0.05, 0.95)


@dataclass(frozen=True, slots=True, eq=False)
class LifePosterior:
    """Posterior of the laws of a life.

    Attributes
    ----------
    stage : str
        Identity of the machine.
    parameters : tuple of str
        Health parameters.
    laws : tuple of str
        Law parameters, as ``guide_preload.life_m``; lengths are in m.
    columns : tuple of tuple of int
        Which law parameters belong to each health parameter.
    chains : ndarray
        Draws of the law parameters, shape ``(n_ensembles, n_draws, n_laws)``.
    health : ndarray
        What the laws say of the health parameters now, as fractions of the baseline value, shape
        ``(n_ensembles, n_draws, n_parameters)``.
    ess_bulk, ess_tail, r_hat : ndarray
        As in `Health`, of the law parameters in sampling coordinates, shape ``(n_laws,)``.
    informed : ndarray
        One minus the squared ratio of posterior to prior width of the 90 % interval, floored at 0,
        shape ``(n_laws,)``.
    correlation : ndarray
        Of the logarithms of health now, shape ``(n_parameters, n_parameters)``; NaN where a law has
        no free parameter.
    chi_square : float
        Of the residuals at the posterior mean.
    degrees_of_freedom : int
        Data minus law parameters.
    walk, noise_scale : float
        As in `Prognosis`.
    seed : tuple of int
        The same one gives the same chains.
    """

    stage: str
    parameters: tuple[str, ...]
    laws: tuple[str, ...]
    columns: tuple[tuple[int, ...], ...]
    chains: FloatArray
    health: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    r_hat: FloatArray
    informed: FloatArray
    correlation: FloatArray
    chi_square: float
    degrees_of_freedom: int
    walk: float
    noise_scale: float
    seed: tuple[int, ...]

    def __post_init__(self) -> None:
        n, p = len(self.laws), len(self.parameters)
        expect_shape("chains", self.chains, (*self.chains.shape[:2], n))
        expect_shape("health", self.health, (*self.chains.shape[:2], p))
        for name in ("ess_bulk", "ess_tail", "r_hat", "informed"):
            expect_shape(name, getattr(self, name), (n,))
        expect_shape("correlation", self.correlation, (p, p))
        freeze(self)

    def theta(self, parameter: int) -> FloatArray:
        """Draws of the law of one health parameter, ``(n_draws of all ensembles, n)``."""
        own = self.chains[..., list(self.columns[parameter])]
        return own.reshape(own.shape[0] * own.shape[1], own.shape[2])

    @property
    def ess(self) -> float:
        """The smallest effective sample size; infinite where nothing is free."""
        return float(np.min([self.ess_bulk, self.ess_tail], initial=np.inf))

    @property
    def worst_r_hat(self) -> float:
        """The largest R-hat."""
        return float(np.max(self.r_hat, initial=1.0))

    def to_frame(self) -> pd.DataFrame:
        """Make a table with a row per law parameter, then per health parameter now."""
        draws = np.concatenate([self.chains, self.health], axis=2)
        quantiles = np.quantile(draws, list(QUANTILES.values()), axis=(0, 1))
        missing = np.full(len(self.parameters), np.nan)
        checks = {
            name: np.append(getattr(self, name), missing)
            for name in ("ess_bulk", "ess_tail", "r_hat", "informed")
        }
        return pd.DataFrame(
            {
                "stage": self.stage,
                "parameter": (*self.laws, *self.parameters),
                **dict(zip(QUANTILES, quantiles, strict=True)),
                **checks,
            }
        )

    def to_arviz(self) -> DataTree:
        """Give law parameters and health now to ArviZ, the ensembles as chains; see `Health`."""
        import arviz_base  # late: it takes a second to import

        posterior = {name: self.chains[..., i] for i, name in enumerate(self.laws)}
        posterior |= {name: self.health[..., j] for j, name in enumerate(self.parameters)}
        checks = {
            f"{what}_{name}": getattr(self, what)[i]
            for what in ("ess_bulk", "ess_tail", "r_hat", "informed")
            for i, name in enumerate(self.laws)
        }
        checks |= {
            name: np.array(getattr(self, name))
            for name in ("chi_square", "degrees_of_freedom", "walk", "noise_scale")
        }
        return arviz_base.from_dict(
            {"posterior": posterior, "checks_data": checks},
            attrs={"/": {"stage": self.stage, "seed": " ".join(map(str, self.seed))}},
        )


def fit_life(history: History, stage: Stage, seed: int | Sequence[int]) -> LifePosterior:
    """Fit the degradation laws of a stage to all logs since its baseline.

    Parameters
    ----------
    history : History
        Modal estimates of all logs.
    stage : Stage
        Laws, priors, covariates and modal map.
    seed : int or sequence of int
        Of all randomness.

    Raises
    ------
    NotEnoughData
        If fewer than three logs hold an informative mode, or the odometer has not moved.
    NotConverged
        If the sampler did not converge; carries the chains.
    """
    likelihood = LifeLikelihood(history, stage)
    begin_seed, chain_seed = stream(seed, _STEP).spawn(2)
    found = _draw(likelihood, begin_seed, chain_seed)
    y = found.thinned(_N_KEPT)
    flat = y.reshape(y.shape[0] * y.shape[1], likelihood.n_dim)
    walk, noise_scale, chi_square, dof = likelihood.settings(flat[:: flat.shape[0] // _N_SETTINGS])
    theta = _natural(likelihood, flat)
    health = likelihood.health(flat, np.array([likelihood.now]))[:, 0]
    with np.errstate(invalid="ignore"):  # health that never changes has no correlation
        correlation = np.atleast_2d(np.corrcoef(np.log(health), rowvar=False))
    names = [parameter.name for parameter in stage.parameters]
    ends = np.cumsum((0, *likelihood.sizes)).tolist()
    return LifePosterior(
        stage=history.stage,
        parameters=tuple(names),
        laws=tuple(
            f"{name}.{own}"
            for name, law in zip(names, likelihood.laws, strict=True)
            for own in law.names
        ),
        columns=tuple(tuple(range(a, b)) for a, b in pairwise(ends)),
        chains=theta.reshape(y.shape),
        health=health.reshape(*y.shape[:2], len(names)),
        ess_bulk=found.ess_bulk,
        ess_tail=found.ess_tail,
        r_hat=found.r_hat,
        informed=_informed(likelihood, theta),
        correlation=correlation,
        chi_square=chi_square,
        degrees_of_freedom=dof,
        walk=walk,
        noise_scale=noise_scale,
        seed=tuple(np.atleast_1d(seed).tolist()),
    )


def _draw(
    likelihood: LifeLikelihood, begin: np.random.SeedSequence, seed: np.random.SeedSequence
) -> Sample:
    """Draw sampling coordinates from the posterior."""
    if likelihood.n_dim == 0:
        nothing = np.empty(0)
        return Sample(np.empty((_N_ENSEMBLES, _N_KEPT, 0)), nothing, nothing, nothing, nothing)
    start = start_from_prior(likelihood.log_probability, likelihood.draw_prior, 300)
    likelihood.narrow(start(np.random.default_rng(begin)))
    return sample(likelihood.log_probability, start, seed)


def _natural(likelihood: LifeLikelihood, y: FloatArray) -> FloatArray:
    """Turn sampling coordinates into law parameters, ``(n, n_laws)`` both."""
    parts = zip(likelihood.laws, likelihood.split(y), strict=True)
    return np.column_stack([law.natural(part, likelihood.now) for law, part in parts])


def _informed(likelihood: LifeLikelihood, theta: FloatArray) -> FloatArray:
    if not theta.size:
        return np.empty(0)
    prior = _natural(likelihood, likelihood.draw_prior(np.random.default_rng(0), _N_PRIOR))
    before, after = (np.ptp(np.quantile(x, _ENDS, axis=0), axis=0) for x in (prior, theta))
    return np.asarray(np.clip(1 - (after / before) ** 2, 0, 1))
