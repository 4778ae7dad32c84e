"""All ways to the remaining life from one history."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

from lmshealth.errors import NotConverged
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from studies.common.lives import Array
from studies.rul_metrics.forecasts import linear, ours

OURS, LINE, PROGPY = "lmshealth", "line", "progpy"
KEPT, CONTROL = "progpy, all runs kept", "a tenth of the spread"
WAYS = (OURS, LINE, PROGPY, KEPT, CONTROL)
MISSING = "progpy: not installed; pip install '.[peers]'"


def all_ways(
    history: History, stage: Stage, seed: list[int], rng: np.random.Generator
) -> tuple[dict[str, Array], dict[str, float]]:
    """Draw the remaining life in every way that says something.

    Parameters
    ----------
    history : History
        What is known.
    stage : Stage
        The description.
    seed : list of int
        Of the posterior.
    rng : Generator
        Of all else.

    Returns
    -------
    draws : dict of str to ndarray
        Way to draws in m, shape ``(n_draws,)``, infinite where life does not end, at least 0.
    seconds : dict of str to float
        Processor times of the posterior, and of what comes after it in two ways.
    """
    horizon = 1000 * stage.description.usage.horizon_km
    draws, seconds = {LINE: linear(history, stage, rng)}, {}
    try:
        found = ours(history, stage, seed)
    except NotConverged:
        return _from_now(draws), seconds
    draws[OURS], draws[CONTROL] = found.remaining, _narrowed(found.remaining)
    seconds = {"posterior": found.posterior_s, OURS: found.futures_s}
    if find_spec("progpy"):
        from studies.rul_metrics.by_progpy import predicted  # late: it need not be installed

        ends, seconds[PROGPY] = predicted(found.states, horizon, rng)
        draws[KEPT] = np.where(np.isnan(ends), np.inf, ends)
        if np.isfinite(ends).any():
            draws[PROGPY] = ends[np.isfinite(ends)]
    return _from_now(draws), seconds


def _from_now(draws: dict[str, Array]) -> dict[str, Array]:
    """Leave nothing where less than nothing is left: who asks knows that the machine runs."""
    return {name: np.maximum(own, 0.0) for name, own in draws.items()}


def _narrowed(draws: Array) -> Array:
    """Shrink draws to a tenth of their distance from the median, where there is one."""
    middle = np.median(draws)
    if not np.isfinite(middle):
        return draws
    return np.asarray(middle + (draws - middle) / 10)
