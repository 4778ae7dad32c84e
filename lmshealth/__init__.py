"""Health of linear-motor stages from the logs they already write.

Estimates guide preload, mount stiffness and remaining life, with uncertainty propagated from the
raw samples to the service date. All quantities are in SI units.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from lmshealth._private.result import Result as _Result

if TYPE_CHECKING:
    from lmshealth.batch.analysis import analyse as analyse
    from lmshealth.batch.ingest import Settings as Settings
    from lmshealth.batch.run import run as run
    from lmshealth.errors import LmshealthError as LmshealthError
    from lmshealth.io.reading import read_log as read_log
    from lmshealth.life.health import infer as infer
    from lmshealth.life.health import infer_drifts as infer_drifts
    from lmshealth.life.posterior.fit import fit_life as fit_life
    from lmshealth.life.prognosis import prognose as prognose
    from lmshealth.life.verdict import judge as judge
    from lmshealth.machine.assessment import assess as assess
    from lmshealth.machine.service import decide as decide
    from lmshealth.modal.free_decay.identification import identify_decays as identify_decays
    from lmshealth.modal.frf.identification import read_frf as read_frf
    from lmshealth.modal.identification import identify as identify
    from lmshealth.modal.log_estimates import LogEstimates as LogEstimates
    from lmshealth.stage.description import load_stage as load_stage
    from lmshealth.stage.planning import plan as plan
    from lmshealth.tracking.history import build_history as build_history
    from lmshealth.tracking.track import track as track

__version__ = version("lmshealth")

# Module of each public name, imported on first use: reading a log needs no database, and the
# command line sets the number of threads before numpy is imported.
_HOMES = {
    "LmshealthError": "errors",
    "LogEstimates": "modal.log_estimates",
    "Settings": "batch.ingest",
    "analyse": "batch.analysis",
    "assess": "machine.assessment",
    "build_history": "tracking.history",
    "decide": "machine.service",
    "fit_life": "life.posterior.fit",
    "identify": "modal.identification",
    "identify_decays": "modal.free_decay.identification",
    "infer": "life.health",
    "infer_drifts": "life.health",
    "judge": "life.verdict",
    "load_stage": "stage.description",
    "plan": "stage.planning",
    "prognose": "life.prognosis",
    "read_frf": "modal.frf.identification",
    "read_log": "io.reading",
    "run": "batch.run",
    "track": "tracking.track",
}

__all__ = [*_HOMES]


def _draw(result: _Result, what: str, ax: Any) -> Any:
    return import_module(f"{__name__}.report.figures").draw(result, what, ax)


# Drawing is above all results, and imported when one is drawn first.
_Result.draw = staticmethod(_draw)

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
