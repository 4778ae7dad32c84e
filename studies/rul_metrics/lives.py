"""Lives that are followed to their end, and what was known of them before."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from lmshealth.tracking.history import History
from models.lives.degradation import Life as Truth
from models.lives.simulation import Plan, schedule
from studies.common.lives import (
    SECONDS,
    Estimates,
    Life,
    drawn,
    history_of,
    life_with,
    measured,
    rng_of,
)

STAGE = "lms-y"
KINDS = ("preload-wear", "mount-loosening", "both")
HEALTHY = "healthy"
N_LOGS = 60
MODES = ("roll", "pitch")
CUTS = (0.3, 0.5, 0.7, 0.9)
FIRST_SEED = 60_000
_SIZED = 12  # logs that are simulated and identified, to tell how exact estimates are
_KM = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One life, followed past its end."""

    life: Life  # What is so at every log
    truth: Truth  # Its laws
    history: History  # Estimates of roll and pitch at all logs
    end: float  # Odometer in m at which the first limit is reached; infinite if none ever is


def case_of(kind: str, number: int, sizes: tuple[Estimates, Life] | None = None) -> Case:
    """Draw a life of a kind, and estimates of its modes; healthy ones go on until now.

    Their sizes are those of some simulated logs, where no other ones are given.
    """
    at, until = (*KINDS, HEALTHY).index(kind), "now" if kind == HEALTHY else "failure"
    plan = Plan(STAGE, kind, N_LOGS, SECONDS, FIRST_SEED + 4 * number + at, until=until)
    life, truth = life_with(plan, schedule(plan)), plan.draw_life()
    estimates = drawn(life, *(sizes or _sizes()), rng_of(31, at, number))
    end = truth.failure_km()
    return Case(
        life, truth, seen(history_of(life, estimates)), np.inf if end is None else _KM * end
    )


@cache
def _sizes() -> tuple[Estimates, Life]:
    return measured(STAGE, _SIZED)


def seen(history: History) -> History:
    """Leave what is known of roll and pitch."""
    columns = [i for i, one in enumerate(history.series) if one.mode in MODES]
    both = [*columns, *(i + len(history.series) for i in columns)]
    return replace(
        history,
        modes=MODES,
        series=tuple(history.series[i] for i in columns),
        ln_frequency=history.ln_frequency[:, columns],
        ln_damping=history.ln_damping[:, columns],
        cov=history.cov[:, both][:, :, both],
    )


def cut(case: Case, share: float) -> History:
    """Leave the logs up to a share of the life."""
    n = int(np.searchsorted(case.history.travel, share * case.end, side="right"))
    whole = case.history
    return replace(
        whole,
        logs=whole.logs[:n],
        recorded_at=whole.recorded_at[:n],
        travel=whole.travel[:n],
        covariates={name: values[:n] for name, values in whole.covariates.items()},
        ln_frequency=whole.ln_frequency[:n],
        ln_damping=whole.ln_damping[:n],
        cov=whole.cov[:n],
        loop_error=whole.loop_error[:n],
    )
