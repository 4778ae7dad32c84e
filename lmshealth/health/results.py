"""Result of the inference: posterior of the health parameters per epoch.

Arrays are read-only, time (or log) axis first, mode axis last, NaN where a value is missing.
SI units throughout: s, m, m/s, Hz, m/s²; temperatures are in °C because only their differences
are used.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from lmshealth._arrays import BoolArray, FloatArray, expect_shape, freeze
from lmshealth.stage.constants import INFORMED

if TYPE_CHECKING:
    from xarray import DataTree

# What tables say of a posterior.
QUANTILES = {"median": 0.5, "q05": 0.05, "q25": 0.25, "q75": 0.75, "q95": 0.95}
# Drifts this improbable are of something that is not on the map.
_UNEXPLAINED = 1e-4
# What else is known about a posterior of health, one number per epoch and parameter.
_CHECKS = ("ess_bulk", "ess_tail", "laplace_shift", "laplace_ratio", "prior_shift", "prior_ratio")


@dataclass(frozen=True, slots=True, eq=False)
class Health:
    """Posterior of the health parameters per epoch, as fractions of their baseline value.

    Attributes
    ----------
    stage : str
        Identity of the machine.
    recorded_at : tuple of datetime
        Epochs that were inferred, ascending.
    travel : ndarray
        Odometer in m, shape ``(n_epochs,)``.
    parameters : tuple of str
        Parameter names.
    chains : ndarray
        Posterior draws of independent ensembles,
        shape ``(n_epochs, n_ensembles, n_draws, n_parameters)``.
    ess_bulk, ess_tail : ndarray
        Effective sample size over all ensembles, for the middle and for the 5 and 95 % quantiles,
        shape ``(n_epochs, n_parameters)``; NaN where the sampler did not converge, as are all that
        follow but `informed` and `correlation`.
    r_hat : ndarray
        Rank-normalised split R-hat over the ensembles, shape ``(n_epochs, n_parameters)``.
    converged : ndarray of bool
        Shape ``(n_epochs,)``.
    informed : ndarray
        One minus the ratio of posterior to prior variance of the logarithm, floored at 0:
        how much the data, and not the prior, say; shape ``(n_epochs, n_parameters)``.
    prior_width : ndarray
        Width of the prior's 90 % interval, shape ``(n_parameters,)``.
    identifiable : ndarray of bool
        Whether endless logs with the modes of an epoch would tell a parameter, on average over the
        priors. One that they would not may still be informed by chance: while nothing has drifted,
        the map's error does not count. Shape ``(n_epochs, n_parameters)``.
    correlation : ndarray
        Of the logarithms in the posterior, shape ``(n_epochs, n_parameters, n_parameters)``.
    laplace_shift, laplace_ratio : ndarray
        By another method, Laplace's approximation, the posterior of the logarithm is lower by so
        many of its standard deviations, and the posterior's standard deviation is so many times
        its; NaN also where no normal distribution approximates. Shape ``(n_epochs, n_parameters)``.
    prior_shift, prior_ratio : ndarray
        With priors twice as wide the median of the logarithm moves by so many posterior standard
        deviations, and its 90 % interval is so many times as wide; the map cuts these priors too,
        NaN where it hardly lets them be wider. Shape ``(n_epochs, n_parameters)``.
    fit : ndarray
        Probability, at most, that drifts lie as far from the map as these do at best, shape
        ``(n_epochs,)``.
    at_edge : ndarray of bool
        Whether the posterior is piled up at an end of the map, which is then a bound of it and not
        of the parameter, shape ``(n_epochs, n_parameters)``.
    seed : tuple of int
        Of all random streams; the same one gives the same chains.
    """

    stage: str
    recorded_at: tuple[datetime, ...]
    travel: FloatArray
    parameters: tuple[str, ...]
    chains: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    r_hat: FloatArray
    converged: BoolArray
    informed: FloatArray
    prior_width: FloatArray
    identifiable: BoolArray
    correlation: FloatArray
    laplace_shift: FloatArray
    laplace_ratio: FloatArray
    prior_shift: FloatArray
    prior_ratio: FloatArray
    fit: FloatArray
    at_edge: BoolArray
    seed: tuple[int, ...]

    def __post_init__(self) -> None:
        n, p = len(self.recorded_at), len(self.parameters)
        expect_shape("chains", self.chains, (n, *self.chains.shape[1:3], p))
        for name in ("r_hat", "informed", *_CHECKS):
            expect_shape(name, getattr(self, name), (n, p))
        expect_shape("correlation", self.correlation, (n, p, p))
        expect_shape("prior_width", self.prior_width, (p,))
        for name in ("travel", "converged", "fit"):
            expect_shape(name, getattr(self, name), (n,))
        for name in ("at_edge", "identifiable"):
            expect_shape(name, getattr(self, name), (n, p))
        freeze(self)

    @property
    def samples(self) -> FloatArray:
        """Draws of all ensembles, shape ``(n_epochs, n_draws, n_parameters)``."""
        return self.chains.reshape(self.chains.shape[0], -1, self.chains.shape[-1])

    @property
    def ess(self) -> FloatArray:
        """The smaller effective sample size, ``(n_epochs, n_parameters)``."""
        return np.minimum(self.ess_bulk, self.ess_tail)

    def informed_parameters(self) -> BoolArray:
        """Tell which parameters the last epoch's data tell, not the prior, ``(n_parameters,)``."""
        claimed = bool(self.converged[-1]) and self.explained
        return np.asarray(claimed & self.identifiable[-1] & (self.informed[-1] >= INFORMED))

    @property
    def explained(self) -> bool:
        """Whether some state of the parameters explains the drifts of the last epoch."""
        return not self.fit[-1] < _UNEXPLAINED

    def quantile(self, level: float | FloatArray) -> FloatArray:
        """Quantiles of every parameter at every epoch, shape ``(..., n_epochs, n_parameters)``."""
        return np.asarray(np.quantile(self.samples, level, axis=1))

    def latest(self, level: float | FloatArray) -> FloatArray:
        """Quantiles of every parameter at the last epoch, shape ``(..., n_parameters)``."""
        return np.asarray(np.quantile(self.samples[-1], level, axis=0))

    def to_frame(self) -> pd.DataFrame:
        """Make the table of ``health.csv``: one row per epoch and parameter, odometer in km."""
        quantiles = self.quantile(np.array(list(QUANTILES.values())))
        columns: dict[str, FloatArray | BoolArray] = dict(zip(QUANTILES, quantiles, strict=True))
        columns |= {name: getattr(self, name) for name in ("ess", "r_hat")}
        n, p = len(self.recorded_at), len(self.parameters)
        columns["converged"] = np.repeat(self.converged[:, None], p, axis=1)
        columns["identifiable"] = self.identifiable
        columns["at_edge"] = self.at_edge
        columns["fit"] = np.repeat(self.fit[:, None], p, axis=1)
        columns["prior_width"] = np.tile(self.prior_width, (n, 1))
        columns |= {name: getattr(self, name) for name in ("informed", *_CHECKS)}
        columns |= {
            f"correlation_{name}": self.correlation[:, :, j]
            for j, name in enumerate(self.parameters)
        }
        return pd.DataFrame(
            {
                "stage": self.stage,
                "recorded_at": np.repeat([moment.isoformat() for moment in self.recorded_at], p),
                "travel_km": np.repeat(self.travel / 1000, p),
                "parameter": np.tile(self.parameters, n),
                **{name: values.ravel() for name, values in columns.items()},
            }
        )

    def to_arviz(self) -> DataTree:
        """Give the draws to ArviZ: groups posterior, with the ensembles as chains, and checks.

        ``to_arviz().to_netcdf(file, engine="h5netcdf")`` writes what ``xarray.open_datatree``
        reads.
        """
        import arviz_base  # late: it takes a second to import

        # xarray keeps no time zones: moments are those of UTC.
        moments = [moment.astimezone(UTC).replace(tzinfo=None) for moment in self.recorded_at]
        coords = {"epoch": np.array(moments, dtype="datetime64[us]")}
        draws = np.moveaxis(self.chains, 0, 2)  # chain, draw, epoch
        checks = {
            f"{what}_{name}": getattr(self, what)[:, j]
            for what in ("informed", "identifiable", "at_edge", "r_hat", *_CHECKS)
            for j, name in enumerate(self.parameters)
        }
        checks |= {
            f"correlation_{a}_{b}": self.correlation[:, i, j]
            for (i, a), (j, b) in combinations(enumerate(self.parameters), 2)
        }
        checks |= {"travel_m": self.travel, "converged": self.converged, "fit": self.fit}
        posterior = {name: draws[..., j] for j, name in enumerate(self.parameters)}
        return arviz_base.from_dict(
            {"posterior": posterior, "checks_data": checks},
            coords=coords,
            dims={name: ["epoch"] for name in (*posterior, *checks)},
            attrs={"/": {"stage": self.stage, "seed": " ".join(map(str, self.seed))}},
        )
