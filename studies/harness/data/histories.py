"""Histories of estimates that a study makes or changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History, Series, Step

START = datetime(2026, 3, 1, tzinfo=UTC)


def map_std(rng: np.random.Generator, machine: Stage) -> float:
    """Draw by how much the map of a machine is wrong: as declared, or by more."""
    stds, weights = zip(*machine.map_errors, strict=True)
    return float(rng.choice(stds, p=weights))


def make_history(
    modes: Sequence[str],
    travel: FloatArray,
    estimates: tuple[FloatArray, FloatArray, FloatArray],
    *,
    series: Sequence[Series] | None = None,
    covariates: Mapping[str, FloatArray] | None = None,
    steps: tuple[Step, ...] = (),
    missing: BoolArray | None = None,
) -> History:
    """Make a history of daily logs whose first is the baseline.

    ``estimates`` are ln frequency and ln damping ``(n_logs, n_series)`` and the covariance of both;
    ``missing`` ones become NaN. By default an accelerometer sees each mode.
    """
    ln_frequency, ln_damping, cov = estimates
    if missing is not None:
        gone = np.hstack([missing, missing])
        ln_frequency = np.where(missing, np.nan, ln_frequency)
        ln_damping = np.where(missing, np.nan, ln_damping)
        cov = np.where(gone[:, :, None] | gone[:, None, :], np.nan, cov)
    n = travel.size
    return History(
        stage="AX-1",
        logs=tuple(f"{k:05d}" for k in range(n)),
        recorded_at=tuple(START + timedelta(days=k) for k in range(n)),
        travel=travel,
        covariates=dict(covariates or {}),
        modes=tuple(modes),
        series=tuple(series or (Series(name, "acc") for name in modes)),
        ln_frequency=ln_frequency,
        ln_damping=ln_damping,
        cov=cov,
        loop_error=np.full(n, np.nan),
        baselines=(0,),
        steps=steps,
    )


def keep_series(history: History, columns: Sequence[int]) -> History:
    """Keep some series of a history, and the modes that they see."""
    both = np.r_[columns, np.add(columns, len(history.series))]
    series = tuple(history.series[i] for i in columns)
    return replace(
        history,
        modes=tuple(name for name in history.modes if any(one.mode == name for one in series)),
        series=series,
        ln_frequency=history.ln_frequency[:, columns],
        ln_damping=history.ln_damping[:, columns],
        cov=history.cov[:, both[:, None], both],
    )
