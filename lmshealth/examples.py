"""Example data: half a year of a simulated Y stage, whose guide wears and whose mount loosens.

24 logs of 20 s over 1,632 km, as estimates of `lmshealth modes`. At the last one 72 % of the
preload is left and 87 % of the mount stiffness; the preload reaches its limit of 60 % at 2,457 km.
"""

from importlib import resources
from pathlib import Path

from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.stage.description import load_stage
from lmshealth.tracking.history import History, build_history
from lmshealth.tracking.read_tables import read_estimates

TABLE = Path(str(resources.files("lmshealth") / "stage" / "descriptions" / "example-y.csv"))
"""The estimates, in the columns of ``modes.csv``."""


def readings() -> list[LogEstimates]:
    """Return the estimates of every log of the example."""
    return read_estimates(TABLE, stage=load_stage("lms-y"))[0]


def history() -> History:
    """Return the history of the example."""
    return build_history(readings(), load_stage("lms-y"))[0]
