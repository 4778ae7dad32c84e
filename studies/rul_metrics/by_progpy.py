"""The same laws and draws as a model of progpy, and its Monte-Carlo predictor."""

from __future__ import annotations

import math
import time
import warnings
from typing import Any, ClassVar

import numpy as np
from progpy import PrognosticsModel
from progpy.predictors import MonteCarlo
from progpy.uncertain_data import UnweightedSamples

from studies.common.lives import Array
from studies.harness.study import Row

N_SAMPLES = 1000
_STEP_KM = 10.0


class Wearing(PrognosticsModel):
    """A stage whose guide wears and whose mount loosens; its time is travel in km.

    The parameters of the laws are states that stay as they are. Ln of health over its law wanders.
    """

    inputs: ClassVar[list[str]] = []
    states: ClassVar[list[str]] = [
        "travel",
        "life",
        "exponent",
        "floor",
        "length",
        "off_preload",
        "off_mount",
        "rate",
    ]
    _limits = 0.6, 0.7
    outputs: ClassVar[list[str]] = ["preload", "mount"]
    events: ClassVar[list[str]] = ["end"]
    default_parameters: ClassVar[Row] = {
        "process_noise": 0,
        "measurement_noise": 0,
        "rng": np.random.default_rng(0),
    }

    def next_state(self, x: Any, u: Any, dt: float) -> Any:
        """Go on by some km."""
        x["travel"] += dt
        if x["rate"] > 0:
            step = math.sqrt(x["rate"] * dt)
            first, second = self.parameters["rng"].standard_normal(2)
            x["off_preload"] += step * first
            x["off_mount"] += step * second
        return x

    def _health(self, x: Any) -> tuple[float, float]:
        left = max(1 - (x["travel"] / x["life"]) ** x["exponent"], 0.0)
        lost = (1 - x["floor"]) * -math.expm1(-x["travel"] / x["length"])
        return left**1.5 * math.exp(x["off_preload"]), (1 - lost) * math.exp(x["off_mount"])

    def output(self, x: Any) -> Any:
        """Return health."""
        return self.OutputContainer(dict(zip(self.outputs, self._health(x), strict=True)))

    def event_state(self, x: Any) -> dict[str, float]:
        """Return the smaller share of what may be lost that is left."""
        pairs = zip(self._health(x), self._limits, strict=True)
        return {"end": min((own - limit) / (1 - limit) for own, limit in pairs)}

    def threshold_met(self, x: Any) -> dict[str, bool]:
        """Return whether a limit is reached."""
        pairs = zip(self._health(x), self._limits, strict=True)
        return {"end": any(own <= limit for own, limit in pairs)}


def predicted(
    states: dict[str, Array], horizon: float, rng: np.random.Generator
) -> tuple[Array, float]:
    """Let progpy run `N_SAMPLES` of the states forward; return their ends in m, and processor time.

    Ends are NaN where the horizon (m) comes first, which progpy leaves out of its statistics.
    """
    n = states["travel"].size
    chosen = rng.choice(n, N_SAMPLES, replace=False)
    rows = [{name: float(values[i]) for name, values in states.items()} for i in chosen]
    predictor = MonteCarlo(Wearing(rng=rng))
    begin = time.process_time()
    with warnings.catch_warnings():
        # It calls what it has deprecated itself.
        warnings.simplefilter("ignore", DeprecationWarning)
        found = predictor.predict(
            UnweightedSamples(rows),
            events=["end"],
            horizon=horizon / 1000,
            dt=_STEP_KM,
            save_freq=1e9,  # nothing but the end is asked for
        )
    seconds = time.process_time() - begin
    ends = [np.nan if row["end"] is None else row["end"] for row in found.time_of_event]
    return 1000.0 * np.array(ends), seconds
