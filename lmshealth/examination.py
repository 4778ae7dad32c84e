"""Examination of a stage description: what its map covers, and what its modes can tell.

After N logs now and at the baseline the ln parameters x have the covariance P, for small changes,
as `sight` has it. The data inform about parameter j by 1 - P_jj / Λ_j, one minus the share of its
prior's variance that is left. Were the other parameters known, 1 / Q_jj would be left, Q being the
inverse of P. That is also the variance of the combination Σ_k (Q_jk / Q_jj) x_k, of all with x_j in
them the one known best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lmshealth.arrays import FloatArray, freeze
from lmshealth.results import INFORMED
from lmshealth.sight import Sight, sight_of
from lmshealth.stage import ModeSpec, ParameterSpec, Stage

# Surrogates are to be this good: an error of ln f that no measurement comes near.
SURROGATE_TARGET = 1e-5
# Logs as they are usual; so many now as the baseline has.
USUAL_DURATION = 60.0

Verdict = Literal["told", "longer-logs", "together", "not-told"]


@dataclass(frozen=True, slots=True)
class ModeCheck:
    """A mode of the description, and what the map has for it.

    Attributes
    ----------
    mode : ModeSpec
        As described.
    informs : bool
        Whether health is read from it: it is tracked and on the map.
    map_frequency, limit_frequency : float
        On the map, in Hz: at the baseline, and with every parameter at its limit. NaN without a
        map; the second also without limits, or where they lie beyond the map.
    surrogate_error : float
        Largest error of ln f at grid points left out of the fit.
    reached : float
        Standard deviation that usual logs reach of the drift of ln f.
    """

    mode: ModeSpec
    informs: bool
    map_frequency: float = np.nan
    limit_frequency: float = np.nan
    surrogate_error: float = np.nan
    reached: float = np.nan

    @property
    def searched(self) -> tuple[float, float]:
        """Band in Hz in which the mode is looked for."""
        f, share = self.mode.frequency_hz, self.mode.search
        return f * (1 - share), f * (1 + share)

    def is_searched(self, frequency: float) -> bool:
        """Tell whether a frequency in Hz is looked for."""
        low, high = self.searched
        return low <= frequency <= high


@dataclass(frozen=True, slots=True)
class Coverage:
    """How far the map reaches for one parameter.

    Attributes
    ----------
    parameter : ParameterSpec
        As described.
    low, high : float
        Where the map ends.
    prior : tuple of float
        Quantiles of the prior at 0.5, 5, 95 and 99.5 %.
    below, above : float
        Probability of the prior beyond either end.
    """

    parameter: ParameterSpec
    low: float
    high: float
    prior: tuple[float, float, float, float]
    below: float
    above: float

    @property
    def holds_limit(self) -> bool:
        """Whether the limit, if there is one, lies inside the map."""
        limit = self.parameter.limit
        return limit is None or limit.below > self.low


@dataclass(frozen=True, slots=True, eq=False)
class Telling:
    """What the modes can tell of one parameter; standard deviations are of its logarithm.

    Attributes
    ----------
    parameter : str
        Its name.
    verdict : str
        ``told`` by usual logs; by ``longer-logs`` only; ``together`` with other parameters, as one
        combination; ``not-told``.
    prior_std, usual_std, endless_std : float
        In the prior, after usual logs, and after endless ones.
    exact_map_std : float
        After usual logs, were the map exact.
    known_std : float
        After endless logs, were the other parameters known; also that of the combination.
    exponents : ndarray
        Of the parameters in the combination, its own being 1, shape ``(n_parameters,)``.
    """

    parameter: str
    verdict: Verdict
    prior_std: float
    usual_std: float
    endless_std: float
    exact_map_std: float
    known_std: float
    exponents: FloatArray

    def __post_init__(self) -> None:
        freeze(self)

    def informed(self, std: float) -> float:
        """Share of the prior's variance that data take away which leave this deviation."""
        return 1 - (std / self.prior_std) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class Examination:
    """What a stage description can do.

    Attributes
    ----------
    name : str
        Of the description.
    modes : tuple of ModeCheck
        All that are described.
    coverage : tuple of Coverage
        One per parameter; empty without a map.
    tellings : tuple of Telling
        One per parameter.
    informative : tuple of str
        Modes in whose order the sensitivities stand.
    slopes, limit_slopes : ndarray
        d ln f / d ln parameter at the baseline and with every parameter at its limit, NaN where
        there is none, shape ``(n_modes, n_parameters)``.
    correlation : ndarray
        Of the ln parameters after usual logs, shape ``(n_parameters, n_parameters)``.
    n_logs : int
        Usual number of logs.
    model_std : float
        Relative standard deviation of the map's sensitivities; NaN without a map.
    unused : tuple of str
        Modes that only the map has.
    """

    name: str
    modes: tuple[ModeCheck, ...]
    coverage: tuple[Coverage, ...]
    tellings: tuple[Telling, ...]
    informative: tuple[str, ...]
    slopes: FloatArray
    limit_slopes: FloatArray
    correlation: FloatArray
    n_logs: int
    model_std: float
    unused: tuple[str, ...]

    def __post_init__(self) -> None:
        freeze(self)


def examine(stage: Stage) -> Examination:
    """Examine what the map of a stage description covers, and what its modes can tell.

    Parameters
    ----------
    stage : Stage
        Description and map; both may be without health.

    Returns
    -------
    Examination
    """
    if stage.modal_map is None:
        none = np.empty((0, 0))
        return Examination(
            name=stage.name,
            modes=tuple(ModeCheck(mode, informs=False) for mode in stage.modes),
            coverage=(),
            tellings=(),
            informative=(),
            slopes=none,
            limit_slopes=none,
            correlation=none,
            n_logs=stage.description.baseline.logs,
            model_std=np.nan,
            unused=(),
        )
    sight = sight_of(stage)
    rows = [stage.modal_map.modes.index(mode.name) for mode in sight.modes]
    limits = _limits(stage)
    usual = sight.drift_variance(USUAL_DURATION, sight.n_baseline)
    cov = np.linalg.inv(sight.precision(usual))
    std = np.sqrt(np.diag(cov))
    described = {mode.name for mode in stage.modes}
    return Examination(
        name=stage.name,
        modes=tuple(_check(stage, mode, sight, limits) for mode in stage.modes),
        coverage=tuple(_cover(stage, k) for k in range(len(stage.parameters))),
        tellings=tuple(_tell(sight, j, usual) for j in range(len(stage.parameters))),
        informative=tuple(mode.name for mode in sight.modes),
        slopes=sight.slopes,
        limit_slopes=np.full(sight.slopes.shape, np.nan)
        if limits is None
        else stage.modal_map.gradient(limits[None])[0, rows],
        correlation=cov / np.outer(std, std),
        n_logs=sight.n_baseline,
        model_std=sight.model_std,
        unused=tuple(name for name in stage.modal_map.modes if name not in described),
    )


def _limits(stage: Stage) -> FloatArray | None:
    """Ln parameters with each at its limit, or at the baseline; None off the map or without any."""
    assert stage.modal_map is not None
    if not any(parameter.limit for parameter in stage.parameters):
        return None
    ends = [p.limit.below if p.limit else p.baseline for p in stage.parameters]
    point = np.log(ends)
    return point if stage.modal_map.inside(point[None]).all() else None


def _check(stage: Stage, mode: ModeSpec, sight: Sight, limits: FloatArray | None) -> ModeCheck:
    known = stage.modal_map
    if known is None or mode.name not in known.modes:
        return ModeCheck(mode, informs=False)
    column = known.modes.index(mode.name)

    def frequency(point: FloatArray) -> float:
        return float(np.exp(known.ln_frequency(point[None])[0, column]))

    reached = replace(sight, modes=(mode,), _known={}).drift_variance(
        USUAL_DURATION, sight.n_baseline
    )
    return ModeCheck(
        mode,
        informs=mode.tracked,
        map_frequency=frequency(stage.baseline_point),
        limit_frequency=np.nan if limits is None else frequency(limits),
        surrogate_error=float(known.leave_out_error[column]),
        reached=float(np.sqrt(reached[0])),
    )


def _cover(stage: Stage, column: int) -> Coverage:
    assert stage.modal_map is not None
    parameter = stage.parameters[column]
    ends = np.exp([stage.modal_map.low[column], stage.modal_map.high[column]])
    below, upto = parameter.prior.probability(ends)
    lowest, low, high, highest = parameter.prior.quantile(np.array([0.005, 0.05, 0.95, 0.995]))
    return Coverage(
        parameter=parameter,
        low=float(ends[0]),
        high=float(ends[1]),
        prior=(float(lowest), float(low), float(high), float(highest)),
        below=float(below),
        above=float(1 - upto),
    )


def _tell(sight: Sight, j: int, usual: FloatArray) -> Telling:
    def left(view: Sight, noise: FloatArray) -> float:
        return float(np.sqrt(np.linalg.inv(view.precision(noise))[j, j]))

    precision = sight.precision(sight.endless_variance())
    found = Telling(
        parameter=sight.parameters[j],
        verdict="not-told",
        prior_std=float(np.sqrt(sight.prior[j])),
        usual_std=left(sight, usual),
        endless_std=left(sight, sight.endless_variance()),
        exact_map_std=left(replace(sight, model_std=0.0), usual),
        known_std=float(1 / np.sqrt(precision[j, j])),
        exponents=precision[j] / precision[j, j],
    )
    cases: tuple[tuple[Verdict, float], ...] = (
        ("told", found.usual_std),
        ("longer-logs", found.endless_std),
        ("together", found.known_std),
    )
    told = (verdict for verdict, std in cases if found.informed(std) >= INFORMED)
    return replace(found, verdict=next(told, "not-told"))
