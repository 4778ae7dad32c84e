"""Do intervals of f and ζ cover as often as they say? Judged against the Monte-Carlo error.

Records are short and many: one mode at 100 Hz with ζ = 2 % and SNR 625 at 400 Hz, as one record of
20 s or as 7 moves of 3 s. A coverage passes when its 99.9 % Clopper-Pearson interval holds 95 %:
with a true coverage of 95 % each judgement fails in at most 0.1 % of runs, so that each of the two
tests fails in at most 0.2 % of reseeded runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import beta

from lmshealth.logs import Log
from lmshealth.modal import identify
from tests.signals import (
    Mode,
    acceleration_log,
    accelerations,
    deviations,
    make_log,
    make_stage,
)

_MODE = Mode(100.0, 0.02)
_RATE = 400.0
_NOMINAL = 0.95
_Z = 1.959963984540054


@dataclass(frozen=True)
class Coverage:
    """A measured coverage with its 99.9 % Clopper-Pearson interval."""

    hits: int
    n: int

    @property
    def interval(self) -> tuple[float, float]:
        """Bounds of the true coverage."""
        low = beta.ppf(0.0005, self.hits, self.n - self.hits + 1) if self.hits else 0.0
        high = beta.ppf(0.9995, self.hits + 1, self.n - self.hits) if self.hits < self.n else 1.0
        return float(low), float(high)

    def holds(self, nominal: float) -> bool:
        """Tell whether the nominal coverage is among the possible ones."""
        low, high = self.interval
        return low <= nominal <= high

    def __str__(self) -> str:
        low, high = self.interval
        return f"{100 * self.hits / self.n:.1f} % ({100 * low:.1f} to {100 * high:.1f} %)"


def _coverage(off: np.ndarray, shrink: float = 1.0) -> Coverage:
    return Coverage(int(np.count_nonzero(np.abs(off) < _Z * shrink)), off.size)


def _deviations(logs: Iterable[Log]) -> np.ndarray:
    """Identify logs: deviations of ln f and ln ζ in standard deviations, shape ``(n_logs, 2)``."""
    stage = make_stage([("roll", _MODE.frequency, _MODE.damping)])
    return np.array(
        [deviations(identify(log, stage), "roll", _MODE.frequency, _MODE.damping) for log in logs]
    )


def _judge(off: np.ndarray) -> None:
    """Intervals cover as they say; halved ones, the negative control, are found out."""
    for column, name in enumerate(("frequency", "damping")):
        found, halved = _coverage(off[:, column]), _coverage(off[:, column], 0.5)
        bias, std = off[:, column].mean(), off[:, column].std()
        print(f"{name}: {found}, bias {bias:+.3f} σ, std {std:.3f} σ")
        assert found.holds(_NOMINAL), f"{name} covers {found}"
        assert not halved.holds(_NOMINAL), f"{name} with halved intervals covers {halved}"


def test_intervals_from_one_record_cover_as_stated(rng: np.random.Generator) -> None:
    """95 % intervals of 1000 records cover f and ζ within the Monte-Carlo error."""
    _judge(_deviations(acceleration_log(rng, [_MODE], 20.0, _RATE, 1.0) for _ in range(1000)))


def _short_moves(rng: np.random.Generator) -> Log:
    n = round(3 * _RATE)
    parts = [accelerations(rng, [_MODE], n, _RATE, 1.0)[0] for _ in range(7)]
    pieces = [(k * n, (k + 1) * n) for k in range(7)]
    return make_log({"acc_0": np.concatenate(parts)}, _RATE, pieces=pieces)


def test_intervals_from_short_moves_cover_as_stated(rng: np.random.Generator) -> None:
    """95 % intervals of 300 logs of short moves cover f and ζ within the Monte-Carlo error."""
    _judge(_deviations(_short_moves(rng) for _ in range(300)))
