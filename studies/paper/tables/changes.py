"""The simulated stages with some numbers changed: tests of why a row of a table differs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from fnmatch import fnmatch
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from models.dynamics.modal_coordinates import Diagonal, diagonalise
from models.dynamics.plant import INPUTS
from models.dynamics.stages import SERVOS, Stage
from models.recordings import disturbances, strokes
from models.recordings.disturbances import Drawn, Noise, drawn_orders
from models.recordings.recording import shaken
from studies.paper.tables import tables


@contextmanager
def changed(stage: Stage, change: Mapping[str, Any]) -> Iterator[None]:
    """Change what a stage is recorded with; the head of `reasons.toml` explains the keys."""
    own, tunings = disturbances.LEVELS[stage.name], SERVOS["commissioning"]
    known, factors = disturbances._noise_of, change.get("inputs", {})

    def times(name: str) -> float:
        return math.prod(by for inputs, by in factors.items() if fnmatch(name, inputs))

    def noise_of(owner: Stage, name: str) -> Noise:
        noise, by = known(owner, name), times(name)
        return replace(noise, density=by * noise.density, fast_density=by * noise.fast_density)

    def orders(*args: Any) -> Drawn:
        cycles, inputs, amplitudes = drawn_orders(*args)
        return cycles, inputs, amplitudes * [times(INPUTS[i]) for i in inputs]

    def moved(make: Callable[..., Diagonal], *args: Any) -> Diagonal:
        diagonal = make(*args)
        hertz, poles = np.abs(diagonal.poles) / (2 * np.pi), diagonal.poles.copy()
        for at, to in change.get("poles", ()):
            poles[np.abs(hertz - at) < 0.2] *= to / at
        return replace(diagonal, poles=poles)

    levels = {k: replace(getattr(own, k), **v) for k, v in change.get("levels", {}).items()}
    levels["mains"] = own.mains + tuple(map(tuple, change.get("lines", ())))
    numbers = {k: replace(getattr(stage, k), value=v) for k, v in change.get("stage", {}).items()}
    drive = replace(tunings[stage.name], **change.get("drive", {}))
    with (
        patch.dict(disturbances.LEVELS, {stage.name: replace(own, **levels)}),
        patch.dict(tunings, {stage.name: drive}),
        patch.object(disturbances, "_noise_of", noise_of),
        patch.object(strokes, "drawn_orders", orders),
        patch.object(strokes, "shaken", partial(moved, shaken)),
        patch.object(strokes, "diagonalise", partial(moved, diagonalise)),
        patch.object(tables, "stage_of", lambda *_: replace(stage, **numbers)),
    ):
        yield
