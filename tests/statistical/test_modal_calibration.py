"""Do intervals of f and ζ cover as often as they say? Judged against the Monte-Carlo error.

Records are short and many: one mode at 100 Hz with ζ = 2 % and SNR 625 at 400 Hz, as one record of
20 s, as 7 moves of 3 s, or as the mean over 8 parts of 20 s. A coverage passes when its 99.9 %
Clopper-Pearson interval holds 95 %: with a true coverage of 95 % each judgement fails in at most
0.1 % of runs, so that each of the tests fails in at most 0.2 % of reseeded runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import beta

from lmshealth import segments, spectra
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


_PARTS, _PART_S = 8, 20.0


def _long_records(rng: np.random.Generator, n: int) -> list[Log]:
    return [acceleration_log(rng, [_MODE], _PARTS * _PART_S, _RATE, 1.0) for _ in range(n)]


def _cut(monkeypatch: pytest.MonkeyPatch) -> None:
    size = round(_PART_S * _RATE)
    monkeypatch.setattr(segments, "MINUTE", size)
    monkeypatch.setattr(spectra, "_LEAST_PART", size)


def test_intervals_from_means_over_parts_cover_as_stated(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """95 % intervals of 500 long records, averaged over 8 parts, cover f and ζ as stated."""
    _cut(monkeypatch)
    _judge(_deviations(_long_records(rng, 500)))


def test_a_mean_over_parts_is_no_single_periodogram(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Negative control: with its count forgotten a mean has intervals that cover too often."""
    _cut(monkeypatch)
    mean = spectra._mean
    monkeypatch.setattr(spectra, "_mean", lambda parts: replace(mean(parts), count=1))
    off = _deviations(_long_records(rng, 200))
    for column in (0, 1):
        found = _coverage(off[:, column])
        print(found)
        assert not found.holds(_NOMINAL)
        assert found.hits > _NOMINAL * found.n


def test_a_record_in_parts_is_as_sure_as_the_whole(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over 100 records σ is that of the whole record to 2 %, and estimates differ by less than σ/4.

    What is lost is resolution: in parts a half-power bandwidth holds 80 ordinates.
    """
    stage = make_stage([("roll", _MODE.frequency, _MODE.damping)])
    logs = _long_records(rng, 100)
    whole = [identify(log, stage) for log in logs]
    _cut(monkeypatch)
    parts = [identify(log, stage) for log in logs]
    std = np.array([np.sqrt(np.diag(modes.cov)) for modes in whole])
    ratio = np.array([np.sqrt(np.diag(modes.cov)) for modes in parts]) / std
    estimate = [
        np.array([(*modes.ln_frequency, *modes.ln_damping) for modes in found])
        for found in (whole, parts)
    ]
    apart = (estimate[1] - estimate[0]) / std
    print(f"ratio {ratio.mean(axis=0)}, apart {apart.mean(axis=0)} ± {apart.std(axis=0)} σ")
    assert np.abs(ratio.mean(axis=0) - 1).max() < 0.02
    assert apart.std(axis=0).max() < 0.25
    assert np.abs(apart.mean(axis=0)).max() < 0.1
