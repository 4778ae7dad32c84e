"""Examination of a stage description: what its map covers, and what its modes can tell.

After N logs now and at the baseline the ln parameters x have the covariance P, for small changes,
as `sight` has it. The data inform about parameter j by 1 - P_jj / Λ_j, one minus the share of its
prior's variance that is left. Were the other parameters known, 1 / Q_jj would be left, Q being the
inverse of P. That is also the variance of the combination Σ_k (Q_jk / Q_jj) x_k, of all with x_j in
them the one known best.

Findings: what an examination of a stage description comes to, in sentences.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from lmshealth._arrays import FloatArray, freeze
from lmshealth.stage.constants import INFORMED
from lmshealth.stage.description import ModeSpec, ParameterSpec, Stage
from lmshealth.stage.identifiability import Sight, sight_of

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


# A prior cut by more than this is not the one that was described; a correlation of more than this
# is worth knowing; an exponent below this, times the priors' widths, is left out, and so small a
# share of what logs reach is no limit.
_CUT, _CORRELATED, _SLIGHT = 0.01, 0.5, 0.05


@dataclass(frozen=True, slots=True)
class Finding:
    """One sentence or two about a stage description.

    Attributes
    ----------
    topic : str
        ``modes``, ``map`` or ``parameters``.
    good : bool
        False for what may have to be mended.
    text : str
        What was found, and what to do.
    """

    topic: str
    good: bool
    text: str


def findings(examined: Examination) -> tuple[Finding, ...]:
    """Say what an examination comes to.

    Parameters
    ----------
    examined : Examination
        What was measured.

    Returns
    -------
    tuple of Finding
        Of the parameters first, then of the map and the modes.
    """
    if not examined.tellings:
        text = (
            "No [[parameter]], so modes are followed and no health is inferred. For health "
            "describe [[parameter]] and a [map] that says what it does to the modes."
        )
        return (Finding("parameters", True, text),)
    return (
        *(_told(examined, telling) for telling in examined.tellings),
        *_correlated(examined),
        _surrogate(examined),
        *(found for coverage in examined.coverage for found in _covered(coverage)),
        *(found for check in examined.modes for found in _placed(check)),
        *_strangers(examined),
    )


def _told(examined: Examination, telling: Telling) -> Finding:
    name, before = telling.parameter, _share(telling.prior_std)
    logs = f"{examined.n_logs} logs of {USUAL_DURATION:g} s"
    after = _share(telling.usual_std)
    if telling.verdict == "told":
        text = f"{name} can be told: {logs} know it to {after}, the prior alone to {before}."
    elif telling.verdict == "longer-logs":
        text = (
            f"{name} can be told by more or longer logs only: {logs} know it to {after}, endless "
            f"ones to {_share(telling.endless_std)}, the prior alone to {before}."
        )
    elif telling.verdict == "together":
        text = (
            f"{name} can be told only together with others: {_combination(examined, telling)} is "
            f"known to {_share(telling.known_std)}, {name} by itself to "
            f"{_share(telling.endless_std)} even from endless logs, and to {before} by the prior "
            "alone. Track a mode that feels the parameters in another proportion."
        )
    else:
        text = (
            f"{name} is not identifiable: {logs} leave it known to {after}, endless ones to "
            f"{_share(telling.endless_std)}, where the prior alone knows {before}. "
            f"{_hindrance(telling)}"
        )
    return Finding("parameters", telling.verdict == "told", text)


def _hindrance(telling: Telling) -> str:
    if telling.informed(telling.exact_map_std) >= INFORMED:
        return (
            "What it does to the modes is less than the map's error (model_std) in what the others "
            f"do; with an exact map it would be {_share(telling.exact_map_std)}. Track a mode that "
            "depends on it more, or make a better map."
        )
    return "The modes hardly feel it: track a mode that depends on it more."


def _combination(examined: Examination, telling: Telling) -> str:
    """Write the product of powers that is known best."""
    widths = [other.prior_std / telling.prior_std for other in examined.tellings]
    shown = [
        (other.parameter, exponent)
        for other, exponent, width in zip(examined.tellings, telling.exponents, widths, strict=True)
        if abs(exponent) * width >= _SLIGHT
    ]
    return " · ".join(
        name if exponent == 1 else f"{name}^{exponent:.2g}" for name, exponent in shown
    )


def _correlated(examined: Examination) -> Iterator[Finding]:
    told = [k for k, telling in enumerate(examined.tellings) if telling.verdict == "told"]
    for i, j in combinations(told, 2):
        first, second = (examined.tellings[k].parameter for k in (i, j))
        value = examined.correlation[i, j]
        text = f"{first} and {second} can be told apart, their errors correlate by {value:+.2f}"
        if abs(value) >= _CORRELATED:
            how = "down" if value < 0 else "up too"
            text += f": where one is estimated too high, the other tends {how}"
        yield Finding("parameters", True, f"{text}.")


def _surrogate(examined: Examination) -> Finding:
    """Judge the surrogate against its target and against what logs reach."""
    checks = [check for check in examined.modes if check.informs]
    worst = max(checks, key=lambda check: check.surrogate_error)
    share = max(check.surrogate_error / check.reached for check in checks)
    meets = worst.surrogate_error <= SURROGATE_TARGET
    text = (
        f"The surrogate meets points left out of the map within {worst.surrogate_error:.1e} of "
        f"ln f ({worst.mode.name}), {'at most' if meets else 'more than'} the "
        f"{SURROGATE_TARGET:g} wanted; {_share(share)} of what usual logs reach."
    )
    if share > 1:
        text += (
            " It limits what can be told: make the map's grid denser, above all where modes cross."
        )
    elif not meets and share < _SLIGHT:
        text += " It does not limit what can be told."
    return Finding("map", meets or share < _SLIGHT, text)


def _covered(coverage: Coverage) -> Iterator[Finding]:
    spec, ends = coverage.parameter, f"{coverage.low:.3g} to {coverage.high:.3g}"
    outside = coverage.below + coverage.above
    if outside > _CUT:
        yield Finding(
            "map",
            False,
            f"The map of {spec.name} reaches from {ends}, and {_share(outside)} of its prior lies "
            "beyond: it is cut there. Make a wider map, or a narrower prior.",
        )
    if not coverage.holds_limit and spec.limit is not None:
        yield Finding(
            "map",
            False,
            f"The limit {spec.limit.below:g} of {spec.name} does not lie inside the map ({ends}), "
            "so logs cannot show that it is passed. Make a wider map.",
        )


def _placed(check: ModeCheck) -> Iterator[Finding]:
    mode, (low, high) = check.mode, check.searched
    if mode.tracked and not check.informs:
        text = f"{mode.name} is followed but not on the map: it tells nothing of health."
        yield Finding("modes", True, text)
    if not check.informs:
        return
    for when, frequency in (
        ("at the baseline", check.map_frequency),
        ("with every parameter at its limit", check.limit_frequency),
    ):
        if np.isfinite(frequency) and not check.is_searched(frequency):
            yield Finding(
                "modes",
                False,
                f"{mode.name} is looked for from {low:.4g} to {high:.4g} Hz, and the map has it at "
                f"{frequency:.4g} Hz {when}. Widen its search, or mend map or frequency.",
            )


def _strangers(examined: Examination) -> Iterator[Finding]:
    if examined.unused:
        text = f"The map also has {', '.join(examined.unused)}, which no [[mode]] describes."
        yield Finding("modes", True, text)


def _share(value: float) -> str:
    return f"{100 * value:.2g} %" if value >= 1e-3 else "less than 0.1 %"
