"""An example to try things on: half a year of a machine, as its logs told it.

A simulated Y stage, whose guide wears and whose mount loosens, made 24 logs of 20 s over 1,632 km.
This is what `lmshealth modes` said of them. Of the preload 72 % is left at the last one, of the
mount stiffness 87 %; the preload reaches its limit of 60 % at 2,457 km.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from lmshealth.stage.description import load_stage
from lmshealth.tracking.history import History, LogEstimates, build_history
from lmshealth.tracking.read_tables import read_estimates

TABLE = Path(str(resources.files("lmshealth") / "stage" / "descriptions" / "example-y.csv"))
"""The estimates, in the columns of ``modes.csv``."""


def readings() -> tuple[LogEstimates, ...]:
    """Give what each log of the example said."""
    return read_estimates(TABLE, stage=load_stage("lms-y")).readings


def history() -> History:
    """Give the history of the example."""
    return build_history(readings(), load_stage("lms-y"))[0]
