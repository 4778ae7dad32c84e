"""Skeleton of a stage description, from modes that were identified without one."""

import glob
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from lmshealth._files import write_text
from lmshealth._toml import quoted
from lmshealth.errors import BadStage
from lmshealth.stage.description import ModeSpec

# Widest search, in relative distances of neighbouring modes, and its least value.
_NEIGHBOURS, _LEAST_SEARCH = 2.0, 0.02


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

    ``stage`` is the machine of the log, ``source`` a note on the origin of the modes. A file that
    exists is replaced. `BadStage` if there is no mode, `BadTable` if it cannot be written.
    """
    if not modes:
        raise BadStage(f"{path} is not written: a description needs at least one mode; none found")
    from jinja2 import Template  # late: only this needs it

    layout = (Path(__file__).parent / "descriptions" / "skeleton.toml.j2").read_text("utf-8")
    template = Template(layout, trim_blocks=True, keep_trailing_newline=True)
    machines = glob.escape(stage) if stage else "*"
    given = {"name": path.stem, "source": source, "stage": machines, "modes": modes}
    write_text(path, template.render(given, quoted=quoted))
