"""Health of linear-motor stages from the logs they already write.

Estimates guide preload, mount stiffness and remaining life, with uncertainty propagated from the
raw samples to the service date. All quantities are in SI units.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

from lmshealth._private.result import Result as _Result

if TYPE_CHECKING:
    from lmshealth.batch.analysis import analyse as analyse
    from lmshealth.batch.ingest import Settings as Settings
    from lmshealth.batch.run import RunResult as RunResult
    from lmshealth.batch.run import run as run
    from lmshealth.calibration.check import CalibrationCheck as CalibrationCheck
    from lmshealth.calibration.check import check_calibration as check_calibration
    from lmshealth.errors import LmshealthError as LmshealthError
    from lmshealth.io.log import Log as Log
    from lmshealth.io.log import Refusal as Refusal
    from lmshealth.io.reading import read_log as read_log
    from lmshealth.life.health import Health as Health
    from lmshealth.life.health import infer as infer
    from lmshealth.life.health import infer_drifts as infer_drifts
    from lmshealth.life.posterior.fit import LifePosterior as LifePosterior
    from lmshealth.life.posterior.fit import fit_life as fit_life
    from lmshealth.life.prognosis import Prognosis as Prognosis
    from lmshealth.life.prognosis import prognose as prognose
    from lmshealth.life.verdict import Verdict as Verdict
    from lmshealth.life.verdict import judge as judge
    from lmshealth.machine.assessment import Assessment as Assessment
    from lmshealth.machine.assessment import assess as assess
    from lmshealth.machine.saving import load as load
    from lmshealth.machine.saving import save as save
    from lmshealth.machine.service import Service as Service
    from lmshealth.machine.service import decide as decide
    from lmshealth.machine.status import Status as Status
    from lmshealth.machine.summary import Summary as Summary
    from lmshealth.modal.deterministic.free_decays import identify_decays as identify_decays
    from lmshealth.modal.deterministic.frequency_response import FrfReading as FrfReading
    from lmshealth.modal.deterministic.frequency_response import read_frf as read_frf
    from lmshealth.modal.identification import identify as identify
    from lmshealth.modal.log_estimates import LogEstimates as LogEstimates
    from lmshealth.modal.modes import Modes as Modes
    from lmshealth.modal.setups import merge_setups as merge_setups
    from lmshealth.stage.description import Stage as Stage
    from lmshealth.stage.description import load_stage as load_stage
    from lmshealth.stage.identifiability import Plan as Plan
    from lmshealth.stage.identifiability import plan as plan
    from lmshealth.tracking.history import History as History
    from lmshealth.tracking.history import build_history as build_history
    from lmshealth.tracking.track import Track as Track
    from lmshealth.tracking.track import accepted_estimates as accepted_estimates
    from lmshealth.tracking.track import track as track

__version__ = version("lmshealth")

# Public names by their module, imported on first use: reading a log needs no database, and the
# command line sets the number of threads before numpy is imported.
_NAMES = {
    "batch.analysis": "analyse",
    "batch.ingest": "Settings",
    "batch.run": "RunResult run",
    "calibration.check": "CalibrationCheck check_calibration",
    "errors": "LmshealthError",
    "io.log": "Log Refusal",
    "io.reading": "read_log",
    "life.health": "Health infer infer_drifts",
    "life.posterior.fit": "LifePosterior fit_life",
    "life.prognosis": "Prognosis prognose",
    "life.verdict": "Verdict judge",
    "machine.assessment": "Assessment assess",
    "machine.saving": "load save",
    "machine.service": "Service decide",
    "machine.status": "Status",
    "machine.summary": "Summary",
    "modal.deterministic.free_decays": "identify_decays",
    "modal.deterministic.frequency_response": "FrfReading read_frf",
    "modal.identification": "identify",
    "modal.log_estimates": "LogEstimates",
    "modal.modes": "Modes",
    "modal.setups": "merge_setups",
    "stage.description": "Stage load_stage",
    "stage.identifiability": "Plan plan",
    "tracking.history": "History build_history",
    "tracking.track": "Track accepted_estimates track",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = [*_HOMES]


# Drawing is above all results, and imported when one is drawn first.
_Result.draw = staticmethod(lambda *given: import_module(f"{__name__}.report.figures").draw(*given))

if not TYPE_CHECKING:  # a type checker would accept any attribute otherwise

    def __getattr__(name: str) -> object:
        """Import a public name on first use."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        found = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        """List the public names, fetched or not."""
        return sorted({*globals(), *__all__})
