"""What comes out: frozen results that floors hand upwards.

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

from lmshealth.arrays import BoolArray, FloatArray, expect_shape, freeze
from lmshealth.logs import Refusal

if TYPE_CHECKING:
    from xarray import DataTree

# Share of the prior variance that data must have removed before a value is shown.
INFORMED = 0.5
# What tables say of a posterior.
QUANTILES = {"median": 0.5, "q05": 0.05, "q25": 0.25, "q75": 0.75, "q95": 0.95}
# Drifts this improbable are of something that is not on the map.
_UNEXPLAINED = 1e-4
# What else is known about a posterior of health, one number per epoch and parameter.
_CHECKS = ("ess_bulk", "ess_tail", "laplace_shift", "laplace_ratio", "prior_shift", "prior_ratio")


@dataclass(frozen=True, slots=True)
class Line:
    """A narrow spectral line that is no mode.

    Attributes
    ----------
    frequency : float
        In Hz.
    amplitude : float
        Of the sine, in the channel's unit.
    unit : str
        SI unit of the amplitude.
    kind : str
        What it was recognised as: a name of the stage's orders, ``mains`` or ``unknown``.
    channel : str
        The channel it was seen in.
    """

    frequency: float
    amplitude: float
    unit: str
    kind: str
    channel: str


@dataclass(frozen=True, slots=True, eq=False)
class Modes:
    """Modal estimates of one log with their joint covariance.

    Attributes
    ----------
    names : tuple of str
        Mode names, unique per source; empty where another program gave none.
    sources : tuple of str
        ``acc``, ``delta_e``, ``frf`` or ``joint`` per mode.
    channels : tuple of str
        The channel each estimate comes from.
    ln_frequency : ndarray
        Natural logarithm of the natural frequency in Hz, shape ``(n_modes,)``.
    ln_damping : ndarray
        Natural logarithm of the damping ratio, shape ``(n_modes,)``.
    cov : ndarray
        Covariance of ``[ln_frequency, ln_damping]``, shape ``(2 n_modes, 2 n_modes)``.
    snr : ndarray
        Modal signal-to-noise ratio S / (4 ζ² S_e), shape ``(n_modes,)``.
    dispersion : ndarray
        Variance of what the fit leaves about each mode over what noise has: about one where the
        model is right, more where lines, other modes or changing conditions are in the data; NaN
        where it was not measured. Shape ``(n_modes,)``.
    flags : tuple of str
        What to bear in mind of each mode, separated by blanks: ``resolution-limited`` where the
        half-power bandwidth spans few Fourier frequencies, ``at-bound`` where frequency or
        damping is at the end of what was searched, ``loose-fit`` where the dispersion is clearly
        more than one, ``cluster`` where one stands for two that cannot be told apart.
    shape_channels : tuple of str
        The channels that shapes tell of; none where shapes were not identified.
    shapes : ndarray
        Acceleration of each channel in each mode, the following error's as its second derivative,
        shape ``(n_modes, n_shape_channels)``. Of each mode they have unit Euclidean norm, and the
        largest is positive; NaN in channels that did not see it.
    lines : tuple of Line
        Spectral lines that were kept out of the likelihood.
    refused : tuple of Refusal
        Modes that were looked for and not found, with the reason.
    """

    names: tuple[str, ...]
    sources: tuple[str, ...]
    channels: tuple[str, ...]
    ln_frequency: FloatArray
    ln_damping: FloatArray
    cov: FloatArray
    snr: FloatArray
    dispersion: FloatArray
    flags: tuple[str, ...]
    shape_channels: tuple[str, ...]
    shapes: FloatArray
    lines: tuple[Line, ...]
    refused: tuple[Refusal, ...]

    def __post_init__(self) -> None:
        n = len(self.names)
        named = [pair for pair in zip(self.names, self.sources, strict=True) if pair[0]]
        if len(set(named)) != len(named):
            raise ValueError(f"mode names are not unique per source: {self.names}")
        for name in ("ln_frequency", "ln_damping", "snr", "dispersion"):
            expect_shape(name, getattr(self, name), (n,))
        expect_shape("cov", self.cov, (2 * n, 2 * n))
        expect_shape("shapes", self.shapes, (n, len(self.shape_channels)))
        freeze(self)

    @property
    def frequency(self) -> FloatArray:
        """Natural frequency in Hz, shape ``(n_modes,)``."""
        return np.exp(self.ln_frequency)

    @property
    def frequency_std(self) -> FloatArray:
        """Standard deviation of the natural frequency in Hz, shape ``(n_modes,)``."""
        n = len(self.names)
        return self.frequency * np.sqrt(np.diag(self.cov)[:n])

    @property
    def damping_ratio(self) -> FloatArray:
        """Damping ratio, shape ``(n_modes,)``."""
        return np.exp(self.ln_damping)

    @property
    def damping_ratio_std(self) -> FloatArray:
        """Standard deviation of the damping ratio, shape ``(n_modes,)``."""
        n = len(self.names)
        return self.damping_ratio * np.sqrt(np.diag(self.cov)[n:])

    @property
    def correlation(self) -> FloatArray:
        """Correlation between frequency and damping ratio of each mode, shape ``(n_modes,)``."""
        n = len(self.names)
        std = np.sqrt(np.diag(self.cov))
        index = np.arange(n)
        return np.asarray(self.cov[index, index + n] / (std[:n] * std[n:]))


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

    def told(self) -> BoolArray:
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


@dataclass(frozen=True, slots=True)
class LawWeight:
    """How probable it is that a parameter follows a law.

    Attributes
    ----------
    parameter : str
        Name of the health parameter.
    kind : str
        The law, as in the stage description.
    begin : float
        Travel in m since the baseline at which it begins: 0, or that of a step.
    probability : float
        In the posterior.
    """

    parameter: str
    kind: str
    begin: float
    probability: float


@dataclass(frozen=True, slots=True, eq=False)
class Prognosis:
    """Remaining useful life with everything that is not known about it.

    Attributes
    ----------
    stage : str
        Identity of the machine.
    recorded_at : datetime
        The moment the prognosis is made at: the last log.
    travel : float
        Odometer at that moment, in m.
    parameters : tuple of str
        Names of the health parameters with a limit, then ``any`` (the first limit reached).
    untold : tuple of str
        Parameters with a limit of which the modes cannot tell how far off it is: nothing is said of
        them, and they are no part of ``any``.
    limits : ndarray
        Limit of each parameter, NaN for ``any``, shape ``(n_parameters + 1,)``.
    remaining : ndarray
        Draws of the remaining travel in m, negative when the limit is already passed and infinite
        when it is never reached, shape ``(n_draws, n_parameters + 1)``.
    usage : ndarray
        Draws of the mean travel per day in m until the end, shape ``(n_draws,)``.
    horizon : float
        Travel in m past which nothing is claimed.
    health : ndarray
        Draws of the same parameters now, by their laws and how far health is off these,
        shape ``(n_draws, n_parameters)``.
    curve_travel : ndarray
        Odometer grid in m of the life curves, shape ``(n_grid,)``.
    curve_quantiles : ndarray
        5, 25, 50, 75, 95 % quantiles of the same on that grid,
        shape ``(5, n_grid, n_parameters)``.
    laws : tuple of LawWeight
        Of each parameter, the most probable law first.
    chi_square : float
        Of the residuals at the posterior mean.
    degrees_of_freedom : int
        Data minus law parameters.
    walk : float
        Standard deviation over the history of the random walk of ln frequency that the data ask
        for beside the laws, averaged over its evidence.
    noise_scale : float
        Factor on the reported standard deviations that the data ask for, averaged likewise.
    deviation : float
        Standard deviation at the horizon of ln health about its laws, averaged likewise.
    ess, r_hat : float
        Worst over the law parameters.
    """

    stage: str
    recorded_at: datetime
    travel: float
    parameters: tuple[str, ...]
    untold: tuple[str, ...]
    limits: FloatArray
    remaining: FloatArray
    usage: FloatArray
    horizon: float
    health: FloatArray
    curve_travel: FloatArray
    curve_quantiles: FloatArray
    laws: tuple[LawWeight, ...]
    chi_square: float
    degrees_of_freedom: int
    walk: float
    noise_scale: float
    deviation: float
    ess: float
    r_hat: float

    def __post_init__(self) -> None:
        n = len(self.parameters)
        expect_shape("limits", self.limits, (n,))
        expect_shape("remaining", self.remaining, (self.remaining.shape[0], n))
        expect_shape("usage", self.usage, (self.remaining.shape[0],))
        expect_shape("health", self.health, (self.health.shape[0], n - 1))
        expect_shape("curve_quantiles", self.curve_quantiles, (5, self.curve_travel.size, n - 1))
        freeze(self)

    def claimed(self) -> FloatArray:
        """Draws of the remaining travel, infinite past the horizon, as `remaining` is shaped."""
        return np.where(self.remaining > self.horizon, np.inf, self.remaining)

    def beyond_horizon(self) -> FloatArray:
        """Probability that each limit stays unreached to the horizon, ``(n_parameters + 1,)``."""
        return np.asarray(np.mean(self.remaining > self.horizon, axis=0))

    def already_past(self) -> FloatArray:
        """Probability that each limit has been passed already, shape ``(n_parameters + 1,)``."""
        return np.asarray(np.mean(self.remaining <= 0, axis=0))
