"""Skeleton of a stage description, from modes that were identified without one."""

from __future__ import annotations

import glob
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from lmshealth.errors import BadStage
from lmshealth.stage.description import ModeSpec

# Widest search, in relative distances of neighbouring modes, and its least value.
_NEIGHBOURS, _LEAST_SEARCH = 2.0, 0.02
_HEAD = """\
# Skeleton of a stage description. Reference of all keys: lmshealth/stage/README.md
# Edit it, check it with `lmshealth stage FILE`, and use it with `--stage FILE`.

name = {name}
source = {source}

[match]
stage = {stage}    # pattern of the machines (metadata `stage` of their logs) it applies to

# Rename the modes after their motion (roll, pitch, yaw, ...); delete those you do not want to
# follow. `search`: the mode is searched within ± this fraction of its frequency. It must cover the
# changes by wear and load over the whole life.
"""
_MODE = """
[[mode]]
name = {name}
frequency_hz = {frequency:.6g}    # {comment}
damping_ratio = {damping:.3g}
snr = {snr:.3g}
search = {search:.2g}
"""
_TAIL = """
# Places of the sensors, for drawings of the mode shapes by `lmshealth modes --plot`.
# [[channel]]
# name = "acc_pitch"
# position_m = [0.10, 0.00, 0.25]
# direction = [0, 0, 1]

# Lines that move with the velocity: frequency = velocity / wavelength.
# [[order]]
# name = "ball pass"
# wavelength_mm = 4.0

# Covariates in the metadata of the logs, which shift frequencies without wear.
# [[covariate]]
# name = "temperature_c"
# reference = 21.0
# prior_std = 0.001    # of the relative change of frequency per unit

# Health parameters, with a modal map: a CSV beside this file with their effect on the modes.
# [[parameter]]
# name = "guide_preload"
# prior = { kind = "lognormal", median = 1.0, sigma = 0.3 }
# limit = { below = 0.6 }
# law = { kind = "none" }
#
# [map]
# file = "my-stage.map.csv"
"""


def searches(frequencies: Sequence[float]) -> list[float]:
    """Return the search of each mode, ascending in Hz: the default, less near a neighbour."""
    gaps = [np.inf, *(float(np.log(high / low)) for low, high in pairwise(frequencies)), np.inf]
    nearest = [min(pair) for pair in pairwise(gaps)][: len(frequencies)]
    most = ModeSpec("", 1.0, 0.01).search
    return [min(most, max(_LEAST_SEARCH, _NEIGHBOURS * gap)) for gap in nearest]


def write_skeleton(
    path: Path, source: str, stage: str | None, modes: Sequence[tuple[ModeSpec, str]]
) -> None:
    """Write a description of modes, each with a comment, that `load_stage` reads as it is.

    ``stage`` is the machine of the log, ``source`` a note on the origin of the modes. `BadStage` if
    there is no mode; `FileExistsError`: a description that somebody may have edited is not
    overwritten.
    """
    if not modes:
        raise BadStage(f"{path} is not written: a description needs at least one mode; none found")
    head = {"name": path.stem, "source": source, "stage": glob.escape(stage) if stage else "*"}
    text = _HEAD.format(**{key: _quoted(value) for key, value in head.items()})
    for mode, comment in modes:
        text += _MODE.format(
            name=_quoted(mode.name),
            frequency=mode.frequency_hz,
            damping=mode.damping_ratio,
            snr=mode.snr,
            search=mode.search,
            comment=comment,
        )
    with path.open("x", encoding="utf-8") as file:
        file.write(text + _TAIL)


def _quoted(text: str) -> str:
    """Return a basic string of TOML."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
