"""Histories of estimates that a study changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lmshealth.tracking.history import History


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
