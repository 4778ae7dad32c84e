"""Result of the inference: posterior of the health parameters per epoch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, freeze
from lmshealth._private.result import Result
from lmshealth._private.tables import TABLES
from lmshealth.health import constants
from lmshealth.stage.constants import INFORMED

if TYPE_CHECKING:
    from xarray import DataTree

# Quantiles in the tables of a posterior.
QUANTILES = {"median": 0.5, "q05": 0.05, "q25": 0.25, "q75": 0.75, "q95": 0.95}
# Diagnostics with one number per epoch and parameter.
CHECKS = (
    *("r_hat", "ess_bulk", "ess_tail"),
    *("laplace_shift", "laplace_ratio", "prior_shift", "prior_ratio"),
    *("judge_shift", "judge_ratio"),
)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Health(Result):
    """Posterior of the health parameters per epoch, in their units.

    Arrays have the shape ``(n_epochs, n_parameters)`` where none is stated.
    """

    stage: str  # identity of the machine
    recorded_at: tuple[datetime, ...]  # ascending
    travel: FloatArray  # odometer in m, ``(n_epochs,)``
    parameters: tuple[str, ...]
    chains: FloatArray  # draws, ``(n_epochs, n_ensembles, n_draws, n_parameters)``
    # Effective sample size over all ensembles, for the middle and for the 5 and 95 % quantiles (of
    # importance samplers by their weights, for both), and rank-normalised split R-hat; NaN where
    # the sampler did not converge, as are shifts and ratios.
    ess_bulk: FloatArray
    ess_tail: FloatArray
    r_hat: FloatArray
    converged: BoolArray  # ``(n_epochs,)``
    informed: FloatArray  # share of the prior variance of ln parameter that the data removed
    prior_width: FloatArray  # width of the prior's 90 % interval, ``(n_parameters,)``
    # Whether unlimited logs with the modes of the epoch inform the parameter on average over the
    # priors. An unidentifiable one may be `informed` by chance: at drifts near 0 the map's error is
    # negligible.
    identifiable: BoolArray
    correlation: FloatArray  # of ln parameters, ``(n_epochs, n_parameters, n_parameters)``
    # Difference of the posterior mean of ln parameter from the mode of Laplace's approximation in
    # its standard deviations, and ratio of the standard deviations; NaN also without it.
    laplace_shift: FloatArray
    laplace_ratio: FloatArray
    # Change of the median of ln parameter under priors twice as wide, in posterior standard
    # deviations, and ratio of the 90 % intervals; NaN also where the map hardly lets them widen.
    prior_shift: FloatArray
    prior_ratio: FloatArray
    # The same from importance sampling to the ensembles of emcee that judge it at some epochs; NaN
    # at others.
    judge_shift: FloatArray
    judge_ratio: FloatArray
    fit: FloatArray  # upper bound of the p value of the drifts under the best draw, ``(n_epochs,)``
    at_edge: BoolArray  # whether the posterior ends at an end of the map, which bounds the value
    seed: tuple[int, ...]

    def __post_init__(self) -> None:
        n, p = len(self.recorded_at), len(self.parameters)
        freeze(
            self,
            ("chains", n, *self.chains.shape[1:3], p),
            (" ".join(["informed at_edge identifiable", *CHECKS]), n, p),
            ("correlation", n, p, p),
            ("prior_width", p),
            ("travel converged fit", n),
        )

    def relative_to(self, baselines: FloatArray) -> Health:
        """Return the posterior of the parameters divided by their baseline values."""
        width = self.prior_width / baselines
        return replace(self, chains=self.chains / baselines, prior_width=width)

    @property
    def samples(self) -> FloatArray:
        """Draws of all ensembles, shape ``(n_epochs, n_draws, n_parameters)``."""
        return self.chains.reshape(self.chains.shape[0], -1, self.chains.shape[-1])

    @property
    def ess(self) -> FloatArray:
        """Smaller effective sample size, shape ``(n_epochs, n_parameters)``."""
        return np.minimum(self.ess_bulk, self.ess_tail)

    def publishable_parameters(self) -> BoolArray:
        """Return which values of the last epoch may be published, shape ``(n_parameters,)``.

        The sampler converged, the drifts are explained, and the parameter is identifiable and
        informed.
        """
        valid = bool(self.converged[-1]) and self.explained
        return np.asarray(valid & self.identifiable[-1] & (self.informed[-1] >= INFORMED))

    @property
    def explained(self) -> bool:
        """Whether some state of the parameters explains the drifts of the last epoch."""
        return not self.fit[-1] < constants.MIN_FIT

    def quantile(self, level: float | FloatArray) -> FloatArray:
        """Return quantiles at every epoch, shape ``(..., n_epochs, n_parameters)``."""
        return np.asarray(np.quantile(self.samples, level, axis=1))

    def latest(self, level: float | FloatArray) -> FloatArray:
        """Return quantiles at the last epoch, shape ``(..., n_parameters)``."""
        return np.asarray(np.quantile(self.samples[-1], level, axis=0))

    def title(self) -> str:
        """Return machine, number of epochs, and the last one."""
        n = len(self.recorded_at)
        last = f"; posterior at {self.recorded_at[-1].date()}" if n else ""
        return f"Health of {self.stage}: {n} epochs{last}"

    def digest_columns(self) -> dict[str, Any]:
        """Return quantiles and diagnostics of the last epoch."""
        names = ("parameter", "median", "q05", "q95", "informed", "converged", "identifiable")
        return {name: self.to_columns()[name][-len(self.parameters) :] for name in names}

    def to_columns(self) -> dict[str, Any]:
        """Return the columns of ``health.csv``, one row per epoch and parameter."""
        n, p = len(self.recorded_at), len(self.parameters)
        quantiles = self.quantile(np.array(list(QUANTILES.values())))
        columns = TABLES["health"].read(
            self,
            recorded_at=np.array([moment.isoformat() for moment in self.recorded_at])[:, None],
            travel_km=self.travel[:, None] / 1000,
            parameter=self.parameters,
            converged=self.converged[:, None],
            fit=self.fit[:, None],
            **dict(zip(QUANTILES, quantiles, strict=True)),
        )
        names = enumerate(self.parameters)
        columns |= {f"correlation_{name}": self.correlation[:, :, j] for j, name in names}
        return {name: np.broadcast_to(own, (n, p)).ravel() for name, own in columns.items()}

    def to_arviz(self) -> DataTree:
        """Return the draws, with the ensembles as chains, and the diagnostics for ArviZ.

        ``to_arviz().to_netcdf(file, engine="h5netcdf")`` writes a file for
        ``xarray.open_datatree``.
        """
        import arviz_base  # late: its import takes a second

        # xarray has no time zones: moments in UTC.
        moments = [moment.astimezone(UTC).replace(tzinfo=None) for moment in self.recorded_at]
        coords = {"epoch": np.array(moments, dtype="datetime64[us]")}
        draws = np.moveaxis(self.chains, 0, 2)  # chain, draw, epoch
        checks = {
            f"{what}_{name}": getattr(self, what)[:, j]
            for what in ("informed", "identifiable", "at_edge", *CHECKS)
            for j, name in enumerate(self.parameters)
        }
        pairs = combinations(enumerate(self.parameters), 2)
        checks |= {f"correlation_{a}_{b}": self.correlation[:, i, j] for (i, a), (j, b) in pairs}
        checks |= {"travel_m": self.travel, "converged": self.converged, "fit": self.fit}
        posterior = {name: draws[..., j] for j, name in enumerate(self.parameters)}
        return arviz_base.from_dict(
            {"posterior": posterior, "checks_data": checks},
            coords=coords,
            dims={name: ["epoch"] for name in (*posterior, *checks)},
            attrs={"/": {"stage": self.stage, "seed": " ".join(map(str, self.seed))}},
        )
