"""Check of a stage description: range of its map, and the parameters that its modes identify."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from lmshealth._arrays import FloatArray, freeze
from lmshealth.stage.constants import INFORMED
from lmshealth.stage.description import ModeSpec, ParameterSpec, Stage
from lmshealth.stage.identifiability import Identifiability, identifiability_of

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
class MapRange:
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
class ParameterCheck:
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
class StageCheck:
    """What a stage description can do.

    Attributes
    ----------
    name : str
        Of the description.
    modes : tuple of ModeCheck
        All that are described.
    ranges : tuple of MapRange
        One per parameter; empty without a map.
    parameters : tuple of ParameterCheck
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
    ranges: tuple[MapRange, ...]
    parameters: tuple[ParameterCheck, ...]
    informative: tuple[str, ...]
    slopes: FloatArray
    limit_slopes: FloatArray
    correlation: FloatArray
    n_logs: int
    model_std: float
    unused: tuple[str, ...]

    def __post_init__(self) -> None:
        freeze(self)


def check_stage(stage: Stage) -> StageCheck:
    """Examine what the map of a stage description covers, and what its modes can tell.

    Parameters
    ----------
    stage : Stage
        Description and map; both may be without health.

    Returns
    -------
    StageCheck
    """
    if stage.modal_map is None:
        none = np.empty((0, 0))
        return StageCheck(
            name=stage.name,
            modes=tuple(ModeCheck(mode, informs=False) for mode in stage.modes),
            ranges=(),
            parameters=(),
            informative=(),
            slopes=none,
            limit_slopes=none,
            correlation=none,
            n_logs=stage.description.baseline.logs,
            model_std=np.nan,
            unused=(),
        )
    information = identifiability_of(stage)
    rows = [stage.modal_map.modes.index(mode.name) for mode in information.modes]
    limits = _limits(stage)
    usual = information.drift_variance(USUAL_DURATION, information.n_baseline)
    cov = np.linalg.inv(information.precision(usual))
    std = np.sqrt(np.diag(cov))
    described = {mode.name for mode in stage.modes}
    return StageCheck(
        name=stage.name,
        modes=tuple(_check(stage, mode, information, limits) for mode in stage.modes),
        ranges=tuple(_cover(stage, k) for k in range(len(stage.parameters))),
        parameters=tuple(_tell(information, j, usual) for j in range(len(stage.parameters))),
        informative=tuple(mode.name for mode in information.modes),
        slopes=information.slopes,
        limit_slopes=np.full(information.slopes.shape, np.nan)
        if limits is None
        else stage.modal_map.gradient(limits[None])[0, rows],
        correlation=cov / np.outer(std, std),
        n_logs=information.n_baseline,
        model_std=information.model_std,
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


def _check(
    stage: Stage, mode: ModeSpec, information: Identifiability, limits: FloatArray | None
) -> ModeCheck:
    known = stage.modal_map
    if known is None or mode.name not in known.modes:
        return ModeCheck(mode, informs=False)
    column = known.modes.index(mode.name)

    def frequency(point: FloatArray) -> float:
        return float(np.exp(known.ln_frequency(point[None])[0, column]))

    reached = replace(information, modes=(mode,), _known={}).drift_variance(
        USUAL_DURATION, information.n_baseline
    )
    return ModeCheck(
        mode,
        informs=mode.tracked,
        map_frequency=frequency(stage.baseline_point),
        limit_frequency=np.nan if limits is None else frequency(limits),
        surrogate_error=float(known.leave_out_error[column]),
        reached=float(np.sqrt(reached[0])),
    )


def _cover(stage: Stage, column: int) -> MapRange:
    assert stage.modal_map is not None
    parameter = stage.parameters[column]
    ends = np.exp([stage.modal_map.low[column], stage.modal_map.high[column]])
    below, upto = parameter.prior.probability(ends)
    lowest, low, high, highest = parameter.prior.quantile(np.array([0.005, 0.05, 0.95, 0.995]))
    return MapRange(
        parameter=parameter,
        low=float(ends[0]),
        high=float(ends[1]),
        prior=(float(lowest), float(low), float(high), float(highest)),
        below=float(below),
        above=float(1 - upto),
    )


def _tell(information: Identifiability, j: int, usual: FloatArray) -> ParameterCheck:
    def left(view: Identifiability, noise: FloatArray) -> float:
        return float(np.sqrt(np.linalg.inv(view.precision(noise))[j, j]))

    precision = information.precision(information.limiting_variance())
    found = ParameterCheck(
        parameter=information.parameters[j],
        verdict="not-told",
        prior_std=float(np.sqrt(information.prior[j])),
        usual_std=left(information, usual),
        endless_std=left(information, information.limiting_variance()),
        exact_map_std=left(replace(information, model_std=0.0), usual),
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
class Diagnostic:
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


def diagnose(examined: StageCheck) -> tuple[Diagnostic, ...]:
    """Say what an examination comes to.

    Parameters
    ----------
    examined : StageCheck
        What was measured.

    Returns
    -------
    tuple of Diagnostic
        Of the parameters first, then of the map and the modes.
    """
    if not examined.parameters:
        text = (
            "No [[parameter]], so modes are followed and no health is inferred. For health "
            "describe [[parameter]] and a [map] that says what it does to the modes."
        )
        return (Diagnostic("parameters", True, text),)
    return (
        *(_told(examined, check) for check in examined.parameters),
        *_correlated(examined),
        _surrogate(examined),
        *(found for ranges in examined.ranges for found in _covered(ranges)),
        *(found for check in examined.modes for found in _placed(check)),
        *_strangers(examined),
    )


def _told(examined: StageCheck, check: ParameterCheck) -> Diagnostic:
    name, before = check.parameter, _share(check.prior_std)
    logs = f"{examined.n_logs} logs of {USUAL_DURATION:g} s"
    after = _share(check.usual_std)
    if check.verdict == "told":
        text = f"{name} can be told: {logs} know it to {after}, the prior alone to {before}."
    elif check.verdict == "longer-logs":
        text = (
            f"{name} can be told by more or longer logs only: {logs} know it to {after}, endless "
            f"ones to {_share(check.endless_std)}, the prior alone to {before}."
        )
    elif check.verdict == "together":
        text = (
            f"{name} can be told only together with others: {_combination(examined, check)} is "
            f"known to {_share(check.known_std)}, {name} by itself to "
            f"{_share(check.endless_std)} even from endless logs, and to {before} by the prior "
            "alone. Track a mode that feels the parameters in another proportion."
        )
    else:
        text = (
            f"{name} is not identifiable: {logs} leave it known to {after}, endless ones to "
            f"{_share(check.endless_std)}, where the prior alone knows {before}. "
            f"{_hindrance(check)}"
        )
    return Diagnostic("parameters", check.verdict == "told", text)


def _hindrance(check: ParameterCheck) -> str:
    if check.informed(check.exact_map_std) >= INFORMED:
        return (
            "What it does to the modes is less than the map's error (model_std) in what the others "
            f"do; with an exact map it would be {_share(check.exact_map_std)}. Track a mode that "
            "depends on it more, or make a better map."
        )
    return "The modes hardly feel it: track a mode that depends on it more."


def _combination(examined: StageCheck, check: ParameterCheck) -> str:
    """Write the product of powers that is known best."""
    widths = [other.prior_std / check.prior_std for other in examined.parameters]
    shown = [
        (other.parameter, exponent)
        for other, exponent, width in zip(examined.parameters, check.exponents, widths, strict=True)
        if abs(exponent) * width >= _SLIGHT
    ]
    return " · ".join(
        name if exponent == 1 else f"{name}^{exponent:.2g}" for name, exponent in shown
    )


def _correlated(examined: StageCheck) -> Iterator[Diagnostic]:
    told = [k for k, check in enumerate(examined.parameters) if check.verdict == "told"]
    for i, j in combinations(told, 2):
        first, second = (examined.parameters[k].parameter for k in (i, j))
        value = examined.correlation[i, j]
        text = f"{first} and {second} can be told apart, their errors correlate by {value:+.2f}"
        if abs(value) >= _CORRELATED:
            how = "down" if value < 0 else "up too"
            text += f": where one is estimated too high, the other tends {how}"
        yield Diagnostic("parameters", True, f"{text}.")


def _surrogate(examined: StageCheck) -> Diagnostic:
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
    return Diagnostic("map", meets or share < _SLIGHT, text)


def _covered(ranges: MapRange) -> Iterator[Diagnostic]:
    spec, ends = ranges.parameter, f"{ranges.low:.3g} to {ranges.high:.3g}"
    outside = ranges.below + ranges.above
    if outside > _CUT:
        yield Diagnostic(
            "map",
            False,
            f"The map of {spec.name} reaches from {ends}, and {_share(outside)} of its prior lies "
            "beyond: it is cut there. Make a wider map, or a narrower prior.",
        )
    if not ranges.holds_limit and spec.limit is not None:
        yield Diagnostic(
            "map",
            False,
            f"The limit {spec.limit.below:g} of {spec.name} does not lie inside the map ({ends}), "
            "so logs cannot show that it is passed. Make a wider map.",
        )


def _placed(check: ModeCheck) -> Iterator[Diagnostic]:
    mode, (low, high) = check.mode, check.searched
    if mode.tracked and not check.informs:
        text = f"{mode.name} is followed but not on the map: it tells nothing of health."
        yield Diagnostic("modes", True, text)
    if not check.informs:
        return
    for when, frequency in (
        ("at the baseline", check.map_frequency),
        ("with every parameter at its limit", check.limit_frequency),
    ):
        if np.isfinite(frequency) and not check.is_searched(frequency):
            yield Diagnostic(
                "modes",
                False,
                f"{mode.name} is looked for from {low:.4g} to {high:.4g} Hz, and the map has it at "
                f"{frequency:.4g} Hz {when}. Widen its search, or mend map or frequency.",
            )


def _strangers(examined: StageCheck) -> Iterator[Diagnostic]:
    if examined.unused:
        text = f"The map also has {', '.join(examined.unused)}, which no [[mode]] describes."
        yield Diagnostic("modes", True, text)


def _share(value: float) -> str:
    return f"{100 * value:.2g} %" if value >= 1e-3 else "less than 0.1 %"
