"""Health of linear-motor stages from the logs they already write.

Guide preload, mount stiffness and remaining life, with every uncertainty carried from the raw
samples to the date. Inside the package all quantities are in SI units.
"""

from importlib.metadata import version

from lmshealth.assessing import assess
from lmshealth.decay import identify_decays
from lmshealth.decision import decide
from lmshealth.errors import LmshealthError
from lmshealth.frf import read_frf
from lmshealth.history import Reading, build_history
from lmshealth.inference import infer, infer_together
from lmshealth.lifefit import fit_life
from lmshealth.modal import identify
from lmshealth.pipeline import Settings, run
from lmshealth.planning import plan
from lmshealth.prognosis import prognose
from lmshealth.readers import read_log
from lmshealth.stage import load_stage
from lmshealth.tracking import track
from lmshealth.verdict import judge

__version__ = version("lmshealth")

__all__ = [
    "LmshealthError",
    "Reading",
    "Settings",
    "assess",
    "build_history",
    "decide",
    "fit_life",
    "identify",
    "identify_decays",
    "infer",
    "infer_together",
    "judge",
    "load_stage",
    "plan",
    "prognose",
    "read_frf",
    "read_log",
    "run",
    "track",
]
