"""Health of linear-motor stages from the logs they already write.

Guide preload, mount stiffness and remaining life, with every uncertainty carried from the raw
samples to the date. Inside the package all quantities are in SI units.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lmshealth.assessing import assess as assess
    from lmshealth.decay import identify_decays as identify_decays
    from lmshealth.decision import decide as decide
    from lmshealth.errors import LmshealthError as LmshealthError
    from lmshealth.frf import read_frf as read_frf
    from lmshealth.history import Reading as Reading
    from lmshealth.history import build_history as build_history
    from lmshealth.inference import infer as infer
    from lmshealth.inference import infer_together as infer_together
    from lmshealth.lifefit import fit_life as fit_life
    from lmshealth.modal import identify as identify
    from lmshealth.pipeline import Settings as Settings
    from lmshealth.pipeline import run as run
    from lmshealth.planning import plan as plan
    from lmshealth.prognosis import prognose as prognose
    from lmshealth.readers import read_log as read_log
    from lmshealth.stage import load_stage as load_stage
    from lmshealth.tracking import track as track
    from lmshealth.verdict import judge as judge

__version__ = version("lmshealth")

# Where each public name is at home. It is fetched when it is first asked for: who reads one log
# pays for no database, and the command line sets its threads before numpy is there.
_HOMES = {
    "LmshealthError": "errors",
    "Reading": "history",
    "Settings": "pipeline",
    "assess": "assessing",
    "build_history": "history",
    "decide": "decision",
    "fit_life": "lifefit",
    "identify": "modal",
    "identify_decays": "decay",
    "infer": "inference",
    "infer_together": "inference",
    "judge": "verdict",
    "load_stage": "stage",
    "plan": "planning",
    "prognose": "prognosis",
    "read_frf": "frf",
    "read_log": "readers",
    "run": "pipeline",
    "track": "tracking",
}

__all__ = [*_HOMES]

if not TYPE_CHECKING:  # else a type checker would take any name for one of these

    def __getattr__(name: str) -> object:
        """Fetch a public name from its home."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        found = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        """List the public names, fetched or not."""
        return sorted({*globals(), *__all__})
