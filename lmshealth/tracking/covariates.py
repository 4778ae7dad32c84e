"""Covariates of ln f (temperature, payload, position) as regressors of the state space."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from lmshealth._private.arrays import FloatArray
from lmshealth._private.tables import fact
from lmshealth.io.log import Notice
from lmshealth.stage.description import Covariate, Stage
from lmshealth.tracking import constants

_SET = ("payload_kg", "position_mm")  # known, not measured: a new value is no fault


@dataclass(frozen=True, slots=True, eq=False)
class Regressor:
    """One column of the regression of ln f on covariates."""

    name: str  # of the covariate, with ``^2`` for its square
    values: FloatArray  # offset from the reference, ``(n_logs,)``; where unknown, its mean so far
    prior_std: float  # prior standard deviation of d ln f per unit
    unknown: FloatArray  # variance of ln f where the value is unknown, ``(n_logs,)``


def regressors(
    covariates: Mapping[str, FloatArray], stage: Stage | None, recorded_at: Sequence[datetime] = ()
) -> tuple[Regressor, ...]:
    """Return the regressors of the described covariates that at least one log has.

    Without a stage every covariate present is one, about its median in all logs: with further logs
    the reference moves, and with it what ln f at the reference is. Keys are column names, values
    have shape ``(n_logs,)``.
    """
    if stage is not None:
        wanted = stage.description.covariate
    else:
        wanted = tuple(
            Covariate(name, float(np.nanmedian(values)), constants.COVARIATE_STD)
            for name, values in covariates.items()
            if np.isfinite(values).any()
        )
    found: list[Regressor] = []
    for covariate in wanted:
        values = covariates.get(covariate.name)
        if values is None:
            continue
        known = np.isfinite(values)
        offset = np.where(known, values - covariate.reference, 0.0)
        if not offset.any():  # it never leaves its reference
            continue
        # A missing value counts as the mean of those before: no log uses later ones.
        n = np.cumsum(known)
        mean, square = (np.cumsum(offset**p) / np.maximum(n, 1) for p in (1, 2))
        unknown = covariate.prior_std**2 * np.maximum(square - mean**2, 1.0)
        unknown = np.where(known, 0.0, np.where(n > 0, unknown, constants.EXTRAPOLATED**2))
        value = np.where(known, offset, mean)
        found.append(Regressor(covariate.name, value, covariate.prior_std, unknown))
        if covariate.curvature_std:
            value = np.where(known, offset**2, square)
            none = np.zeros_like(unknown)
            found.append(Regressor(f"{covariate.name}^2", value, covariate.curvature_std, none))
        if covariate.name == "temperature_c" and recorded_at:
            found += _daily(covariate, recorded_at)
    return tuple(found)


def _daily(covariate: Covariate, recorded_at: Sequence[datetime]) -> list[Regressor]:
    """Return the cycle of a day, by which a structure lags behind the temperature of its sensor.

    A first-order lag of a daily cycle is another cycle of the day: its sine and cosine have linear
    coefficients, whatever the time constant is. Their size is in units of the covariate.
    """
    angle = np.array([moment.timestamp() for moment in recorded_at]) * (2 * np.pi / 86400)
    waves = constants.LAGGED_CYCLE * np.array([np.cos(angle), np.sin(angle)])
    waves -= waves[:, :1]
    if not np.abs(waves).max() > constants.LEAST_CYCLE:  # all logs at one time of the day
        return []
    none = np.zeros(angle.size)
    names = (f"{covariate.name}:day-cos", f"{covariate.name}:day-sin")
    return [Regressor(n, w, covariate.prior_std, none) for n, w in zip(names, waves, strict=True)]


def covariate_notices(covariates: Mapping[str, FloatArray], stage: Stage) -> list[Notice]:
    """Return notices about measured covariates that no log states, or whose last value is far off.

    The effect on ln f of a value far from all before is extrapolated, and may exceed
    `constants.EXTRAPOLATED`: a stuck sensor.
    """
    notices = []
    for covariate in stage.description.covariate:
        if covariate.name in _SET:
            continue
        if (values := covariates.get(covariate.name)) is None:
            what = fact(
                "No log states {name}, which may move the modes by {effect:.2g} % per unit: what "
                "it does over the months is taken for a change of the machine.",
                name=covariate.name,
                effect=100 * covariate.prior_std,
            )
            to_do = fact("Enter it in manifest.csv, one value in all rows where it is controlled.")
            notices.append(Notice("covariate-missing", "caution", covariate.name, what, to_do))
            continue
        known = values[np.isfinite(values)]
        # Of the logs before; the middle of the first ones, as one of these may be wrong.
        first = stage.description.baseline.logs
        if not np.isfinite(values[-1]) or known.size <= first:
            continue
        low, high = np.quantile(known[:first], (0.25, 0.75)).tolist()
        for value in known[first:].tolist():
            beyond = max(low - value, value - high, 0.0)
            is_far = beyond * covariate.prior_std > constants.EXTRAPOLATED
            if not is_far:
                low, high = min(low, value), max(high, value)
        if is_far:
            what = fact(
                "{name} is {value:.4g} in the last log, far outside of its range before, {low:.4g} "
                "to {high:.4g}: its effect is extrapolated.",
                name=covariate.name,
                value=values[-1],
                low=low,
                high=high,
            )
            to_do = fact("Check its sensor, or its values in manifest.csv.")
            notices.append(Notice("covariate-far", "caution", covariate.name, what, to_do))
    return notices
