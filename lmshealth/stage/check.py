"""Check of a stage description: range of its map, and the parameters that its modes identify.

`check_stage` computes the numbers, `diagnose` states what they mean (README.md, "Check").
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import combinations
from typing import Literal

import numpy as np

from lmshealth._private.arrays import FloatArray, ReadOnly
from lmshealth.io.log import covariates
from lmshealth.io.manifest import LIKE
from lmshealth.stage import constants
from lmshealth.stage.description import ModeSpec, ParameterSpec, Stage
from lmshealth.stage.identifiability import Identifiability, identifiability_of
from lmshealth.stage.modal_map import ModalMap

# Values of the column `verdict` of `lmshealth stage`.
Verdict = Literal["identifiable", "longer-logs", "together", "not-identifiable"]


@dataclass(frozen=True, slots=True)
class ModeCheck:
    """A mode of the description and its place on the map."""

    mode: ModeSpec
    informs: bool  # whether health is inferred from it: it is tracked and on the map
    # On the map, in Hz: at the baseline, and with every parameter at its limit. NaN without a map;
    # the second also without limits, or where they lie outside the map.
    map_frequency: float = np.nan
    limit_frequency: float = np.nan
    surrogate_error: float = np.nan  # largest error of ln f at grid points left out of the fit
    reached: float = np.nan  # standard deviation that typical logs reach of its drift

    @property
    def searched(self) -> tuple[float, float]:
        """Band in Hz in which the mode is searched."""
        return self.mode.searched


@dataclass(frozen=True, slots=True, eq=False)
class ParameterCheck(ReadOnly):
    """Range of the map and identifiability of one parameter; ``std`` is of its logarithm."""

    spec: ParameterSpec
    # Range of the map, 0.5, 5, 95 and 99.5 % of the prior, and its probability outside either end.
    low: float
    high: float
    quantiles: tuple[float, ...]
    below: float
    above: float
    # Identified by typical logs (``identifiable``), by ``longer-logs`` only, ``together`` with
    # other parameters as one combination, or ``not-identifiable``.
    verdict: Verdict
    prior_std: float
    usual_std: float  # after typical logs
    endless_std: float  # after unlimited ones
    exact_map_std: float  # after typical logs, were the map exact
    known_std: float  # after unlimited logs, were the others known: also of the combination
    change_std: float  # of a small change since the baseline, as `lmshealth plan` has it
    # Of the parameters in the combination, its own being 1, shape ``(n_parameters,)``.
    exponents: FloatArray

    @property
    def name(self) -> str:
        """Name of the parameter."""
        return self.spec.name

    @property
    def has_limit_on_map(self) -> bool:
        """Whether the limit, if there is one, lies inside the map."""
        return self.spec.limit is None or self.spec.limit.below > self.low

    def variance_removed(self, std: float) -> float:
        """Return the share of the prior variance removed by data that leave this deviation."""
        return 1 - (std / self.prior_std) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class StageCheck(ReadOnly):
    """Capabilities of a stage description; without a map it has no parameters."""

    name: str
    modes: tuple[ModeCheck, ...]
    parameters: tuple[ParameterCheck, ...]
    informative: tuple[str, ...]  # modes in the order of the sensitivities
    # d ln f / d ln parameter at the baseline and with every parameter at its limit, NaN where there
    # is none, shape ``(n_modes, n_parameters)``.
    slopes: FloatArray
    limit_slopes: FloatArray
    # Of the ln parameters after typical logs, shape ``(n_parameters, n_parameters)``.
    correlation: FloatArray
    n_logs: int  # typical ones
    model_std: float  # relative, of the map's sensitivities; NaN without
    unused: tuple[str, ...]  # modes of the map that are not described
    misspelt: tuple[tuple[str, str], ...]  # covariates that are no key of logs, and the nearest key


def check_stage(stage: Stage) -> StageCheck:
    """Check a stage description, with or without health parameters."""
    modal_map, slips = stage.modal_map, tuple(_misspelt(stage))
    if modal_map is None:
        modes = tuple(ModeCheck(mode, informs=False) for mode in stage.modes)
        n_logs, none = stage.description.baseline.logs, np.empty((0, 0))
        return StageCheck(stage.name, modes, (), (), none, none, none, n_logs, np.nan, (), slips)
    information = identifiability_of(stage)
    # The ln parameters at their limits, or baselines; None off the map or without any limit.
    point = np.log([p.limit.below if p.limit else p.baseline for p in stage.parameters])
    any_limit = any(parameter.limit for parameter in stage.parameters)
    limits = point if any_limit and modal_map.inside(point[None]).all() else None
    limit_slopes = np.full(information.slopes.shape, np.nan)
    if limits is not None:
        rows = [modal_map.modes.index(mode.name) for mode in information.modes]
        limit_slopes = modal_map.gradient(limits[None])[0, rows]
    noise = information.drift_variance(constants.TYPICAL_DURATION, information.n_baseline)
    cov = np.linalg.inv(information.precision(noise))
    std = np.sqrt(np.diag(cov))
    described = {mode.name for mode in stage.modes}
    return StageCheck(
        name=stage.name,
        modes=tuple(_check_mode(stage, mode, information, limits) for mode in stage.modes),
        parameters=tuple(_check_parameters(stage.parameters, modal_map, information, noise)),
        informative=tuple(mode.name for mode in information.modes),
        slopes=information.slopes,
        limit_slopes=limit_slopes,
        correlation=cov / np.outer(std, std),
        n_logs=information.n_baseline,
        model_std=information.model_std,
        unused=tuple(name for name in modal_map.modes if name not in described),
        misspelt=slips,
    )


def _check_mode(
    stage: Stage, mode: ModeSpec, information: Identifiability, limits: FloatArray | None
) -> ModeCheck:
    modal_map = stage.modal_map
    if modal_map is None or mode.name not in modal_map.modes:
        return ModeCheck(mode, informs=False)
    column = modal_map.modes.index(mode.name)

    def frequency(point: FloatArray) -> float:
        return float(np.exp(modal_map.ln_frequency(point[None])[0, column]))

    own = replace(information, modes=(mode,))
    reached = own.drift_variance(constants.TYPICAL_DURATION, information.n_baseline)[0]
    frequencies = frequency(stage.baseline_point), np.nan if limits is None else frequency(limits)
    error = float(modal_map.leave_out_error[column])
    return ModeCheck(mode, mode.tracked, *frequencies, error, float(np.sqrt(reached)))


def _check_parameters(
    specs: Sequence[ParameterSpec],
    modal_map: ModalMap,
    information: Identifiability,
    noise: FloatArray,
) -> Iterator[ParameterCheck]:
    """Yield the checks of all parameters; ``noise`` is that of typical logs, ``(n_modes,)``."""
    unlimited = information.precision(information.limiting_variance())
    usual, exact = information.std(noise), information.std(noise, exact_map=True)
    endless = information.std(information.limiting_variance())
    change = information.change_std(noise)
    for j, spec in enumerate(specs):
        low, high = np.exp([modal_map.low[j], modal_map.high[j]]).tolist()
        below, upto = spec.prior.probability(np.array([low, high])).tolist()
        found = ParameterCheck(
            spec,
            low=low,
            high=high,
            quantiles=tuple(spec.prior.quantile(np.array([0.005, 0.05, 0.95, 0.995])).tolist()),
            below=below,
            above=1 - upto,
            verdict="not-identifiable",
            prior_std=float(np.sqrt(information.prior[j])),
            usual_std=float(usual[j]),
            endless_std=float(endless[j]),
            exact_map_std=float(exact[j]),
            change_std=float(change[j]),
            known_std=float(1 / np.sqrt(unlimited[j, j])),
            exponents=unlimited[j] / unlimited[j, j],
        )
        stds: dict[Verdict, float] = {
            "identifiable": found.usual_std,
            "longer-logs": found.endless_std,
            "together": found.known_std,
        }
        passed = (v for v, std in stds.items() if found.variance_removed(std) >= constants.INFORMED)
        yield replace(found, verdict=next(passed, "not-identifiable"))


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One or two sentences about a stage description: what was found, and what to do.

    The topic is ``modes``, ``map`` or ``parameters``; a possible fault is not good.
    """

    topic: str
    good: bool
    text: str


def diagnose(checked: StageCheck) -> tuple[Diagnostic, ...]:
    """State the results of a check in sentences: of parameters, of the map, then of modes."""
    slips = [
        Diagnostic("modes", False, f"No key of logs is {name}, a covariate. Is {key} meant?")
        for name, key in checked.misspelt
    ]
    if not checked.parameters:
        text = "No [[parameter]]: modes are tracked and no health is inferred. For health, describe"
        text += " [[parameter]] and a [map] of its effect on the modes."
        return Diagnostic("parameters", True, text), *slips
    found = [_identified(checked, parameter) for parameter in checked.parameters]
    found += [*_correlated(checked), _surrogate(checked)]
    found += [one for parameter in checked.parameters for one in _map_range(parameter)]
    found += [one for mode in checked.modes for one in _searched(mode)]
    if checked.unused:
        text = f"The map also has {', '.join(checked.unused)}, which no [[mode]] describes."
        found.append(Diagnostic("modes", True, text))
    return *found, *slips


def _identified(checked: StageCheck, parameter: ParameterCheck) -> Diagnostic:
    name, logs = parameter.name, f"{checked.n_logs} logs of {constants.TYPICAL_DURATION:g} s"
    what, step = "is identifiable", ""
    if parameter.verdict == "longer-logs":
        what = "is identifiable by more or longer logs only"
    elif parameter.verdict == "together":
        what = (
            f"is identifiable only together with others: {_combination(checked, parameter)} has a "
            f"standard deviation of {_share(parameter.known_std)}, {name} by itself"
        )
        step = " Track a mode that depends on the parameters in another proportion."
    elif parameter.verdict == "not-identifiable":
        what = "is not identifiable"
        step = " The modes hardly depend on it: track a mode that depends on it more."
        if parameter.variance_removed(parameter.exact_map_std) >= constants.INFORMED:
            step = (
                " Its effect on the modes is less than the map's error (model_std) in the effects "
                f"of the others; with an exact map it would be {_share(parameter.exact_map_std)}. "
                "Track a mode that depends on it more, or make a better map."
            )
    std = "" if parameter.verdict == "together" else ": its standard deviation is"
    text = (
        f"{name} {what}{std} {_share(parameter.usual_std)} after {logs}, "
        f"{_share(parameter.endless_std)} after unlimited logs and {_share(parameter.prior_std)} "
        f"in the prior.{step}"
    )
    return Diagnostic("parameters", parameter.verdict == "identifiable", text)


def _combination(checked: StageCheck, parameter: ParameterCheck) -> str:
    """Write the product of powers with the least standard deviation."""
    return " · ".join(
        other.name if exponent == 1 else f"{other.name}^{exponent:.2g}"
        for other, exponent in zip(checked.parameters, parameter.exponents, strict=True)
        if abs(exponent) * other.prior_std / parameter.prior_std >= constants.NEGLIGIBLE_SHARE
    )


def _correlated(checked: StageCheck) -> Iterator[Diagnostic]:
    identified = [
        (k, p.name) for k, p in enumerate(checked.parameters) if p.verdict == "identifiable"
    ]
    for (i, first), (j, second) in combinations(identified, 2):
        value = checked.correlation[i, j]
        text = f"{first} and {second} are identifiable separately; their errors have a correlation"
        text += f" of {value:+.2f}"
        if abs(value) >= constants.NOTABLE_CORRELATION:
            text += ": if the estimate of one is too high, that of the other tends to be too "
            text += "low" if value < 0 else "high"
        yield Diagnostic("parameters", True, f"{text}.")


def _surrogate(checked: StageCheck) -> Diagnostic:
    """Compare the error of the surrogate with its target and with the scatter of typical logs."""
    checks = [mode for mode in checked.modes if mode.informs]
    worst = max(checks, key=lambda mode: mode.surrogate_error)
    share = max(mode.surrogate_error / mode.reached for mode in checks)
    meets = worst.surrogate_error <= constants.SURROGATE_TARGET
    text = (
        f"The surrogate reproduces grid points left out of its fit within "
        f"{worst.surrogate_error:.1e} of ln f ({worst.mode.name}), "
        f"{'at most' if meets else 'more than'} the target of {constants.SURROGATE_TARGET:g}; "
        f"{_share(share)} of the standard deviation of typical logs."
    )
    if share > 1:
        text += " It limits the result: make the map's grid denser, above all where modes cross."
    elif not meets and share < constants.NEGLIGIBLE_SHARE:
        text += " It does not limit the result."
    return Diagnostic("map", meets or share < constants.NEGLIGIBLE_SHARE, text)


def _map_range(parameter: ParameterCheck) -> Iterator[Diagnostic]:
    name, ends = parameter.name, f"{parameter.low:.3g} to {parameter.high:.3g}"
    outside = parameter.below + parameter.above
    if outside > constants.PRIOR_OUTSIDE:
        text = f"The map of {name} covers {ends}; {_share(outside)} of its prior lies outside and "
        text += "is cut off. Make a wider map, or a narrower prior."
        yield Diagnostic("map", False, text)
    if not parameter.has_limit_on_map and parameter.spec.limit is not None:
        text = f"The limit {parameter.spec.limit.below:g} of {name} does not lie inside the map"
        text += f" ({ends}), so logs cannot show that it is passed. Make a wider map."
        yield Diagnostic("map", False, text)


def _searched(check: ModeCheck) -> Iterator[Diagnostic]:
    mode, (low, high) = check.mode, check.searched
    if mode.tracked and not check.informs:
        text = f"{mode.name} is tracked but not on the map: it contributes nothing to health."
        yield Diagnostic("modes", True, text)
    if not check.informs:
        return
    places = {"at the baseline": check.map_frequency}
    places["with every parameter at its limit"] = check.limit_frequency
    for when, frequency in places.items():
        if np.isfinite(frequency) and not low <= frequency <= high:
            text = f"{mode.name} is searched from {low:.4g} to {high:.4g} Hz, but the map has it at"
            text += f" {frequency:.4g} Hz {when}. Widen its search, or correct map or frequency."
            yield Diagnostic("modes", False, text)


def _misspelt(stage: Stage) -> Iterator[tuple[str, str]]:
    """Yield covariates that are no key of logs, with the key that they nearly are."""
    for name in (one.name for one in stage.description.covariate if one.name not in covariates()):
        # A name that contains a key is one of its own, such as that of another temperature.
        if not any(key in name for key in covariates()):
            yield from ((name, near) for near in get_close_matches(name, covariates(), 1, LIKE))


def _share(value: float) -> str:
    return f"{100 * value:.2g} %" if value >= 1e-3 else "less than 0.1 %"
