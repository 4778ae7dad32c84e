"""Findings: what an examination of a stage description comes to, in sentences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lmshealth.examination import (
    SURROGATE_TARGET,
    USUAL_DURATION,
    Coverage,
    Examination,
    ModeCheck,
    Telling,
)
from lmshealth.results import INFORMED

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
