"""Do intervals of f and ζ cover as often as they say? Judged against the Monte-Carlo error.

Records are short and many: 20 s in one, 7 moves of 3 s, or the mean over 8 parts of 20 s. A
coverage passes when its 99.9 % Clopper-Pearson interval holds 95 %: with a true coverage of 95 %
each judgement fails in at most 0.1 % of runs, so that each of the tests, which judge f and ζ, fails
in at most 0.2 % of reseeded runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from lmshealth import segments, spectra
from lmshealth.logs import Log
from lmshealth.modal import identify
from lmshealth.results import Modes
from tests.oracles import binomial_band
from tests.signals import (
    Mode,
    acceleration_log,
    accelerations,
    deviations,
    displacements,
    make_log,
    make_stage,
    white,
)

# Three channels: a single one cannot tell a floor that moves with the mode from one that does not,
# and its intervals of f cover up to 98 %.
_MODE = Mode(100.0, 0.02, 1.0, (1.0, 0.6, -0.4))
_RATE = 400.0
_NOMINAL = 0.95
_Z = 1.959963984540054


@dataclass(frozen=True)
class Coverage:
    """A measured coverage with its 99.9 % Clopper-Pearson interval."""

    hits: int
    n: int

    def holds(self, nominal: float) -> bool:
        """Tell whether the nominal coverage is among the possible ones."""
        low, high = binomial_band(self.hits, self.n)
        return low <= nominal <= high

    def __str__(self) -> str:
        low, high = binomial_band(self.hits, self.n)
        return f"{100 * self.hits / self.n:.1f} % ({100 * low:.1f} to {100 * high:.1f} %)"


def _coverage(off: np.ndarray, shrink: float = 1.0) -> Coverage:
    return Coverage(int(np.count_nonzero(np.abs(off) < _Z * shrink)), off.size)


def _deviations(logs: Iterable[Log], modes: Sequence[Mode] = (_MODE,)) -> np.ndarray:
    """Identify logs: deviations of ln f and ln ζ in standard deviations, ``(n_logs n_modes, 2)``.

    A mode that is refused is an error: leaving its log out would flatter the rest.
    """
    names = [f"mode_{k}" for k in range(len(modes))]
    stage = make_stage([(n, m.frequency, m.damping) for n, m in zip(names, modes, strict=True)])
    return np.array(
        [
            deviations(found, name, mode.frequency, mode.damping)
            for log in logs
            for found in [identify(log, stage)]
            for name, mode in zip(names, modes, strict=True)
        ]
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
    parts = [accelerations(rng, [_MODE], n, _RATE, 1.0) for _ in range(7)]
    pieces = [(k * n, (k + 1) * n) for k in range(7)]
    channels = {f"acc_{c}": row for c, row in enumerate(np.concatenate(parts, axis=1))}
    return make_log(channels, _RATE, pieces=pieces)


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


def test_intervals_of_three_modes_in_three_channels_cover_as_stated(
    rng: np.random.Generator,
) -> None:
    """105, 120 and 135 Hz, ζ 1.5, 2 and 2.5 %, fitted jointly: 150 intervals of 50 records."""
    modes = [
        Mode(105.0, 0.015, 1.0, (1.0, 0.4, -0.3)),
        Mode(120.0, 0.02, 1.0, (0.3, 1.0, 0.5)),
        Mode(135.0, 0.025, 1.0, (-0.4, 0.2, 1.0)),
    ]
    logs = (acceleration_log(rng, modes, 20.0, 500.0, 1.0) for _ in range(50))
    _judge(_deviations(logs, modes))


def _same_force(rng: np.random.Generator, modes: Sequence[Mode], n: int) -> np.ndarray:
    """Accelerations of modes under one common force, without noise."""
    seed = int(rng.integers(1 << 32))
    return np.sum(
        [accelerations(np.random.default_rng(seed), [mode], n, _RATE, 0.0) for mode in modes],
        axis=0,
    )


def _coherent_floor(rng: np.random.Generator) -> Log:
    """Two channels of a mode and of a rigid body that the same force moves."""
    n = round(20 * _RATE)
    modes = [replace(_MODE, shape=(1.0, 0.6)), Mode(0.5, 0.5, 9.0, (1.0, -1.0))]
    values = _same_force(rng, modes, n)
    return make_log(
        {f"acc_{k}": row + white(rng, 1.0, n, _RATE) for k, row in enumerate(values)}, _RATE
    )


def test_intervals_cover_as_stated_where_the_floors_share_the_force(
    rng: np.random.Generator,
) -> None:
    """A floor common to two channels interferes with the mode: 150 records."""
    _judge(_deviations(_coherent_floor(rng) for _ in range(150)))


def _three_sensors(rng: np.random.Generator) -> Log:
    """Δe and two accelerometers of one mode under one force, each with its own noise."""
    n, seed = round(20 * _RATE), int(rng.integers(1 << 32))
    a = accelerations(
        np.random.default_rng(seed), [replace(_MODE, shape=(1.0, 0.6))], n, _RATE, 0.0
    )
    x = displacements(np.random.default_rng(seed), [replace(_MODE, shape=(0.8,))], n, _RATE, 0.0)
    quiet = 1 / (2 * np.pi * _MODE.frequency) ** 4
    signals = {f"acc_{k}": row + white(rng, 1.0, n, _RATE) for k, row in enumerate(a)}
    return make_log({"delta_e": x[0] + white(rng, quiet, n, _RATE), **signals}, _RATE)


def _averaged(log: Log) -> np.ndarray:
    """Average the estimates of single channels as if they were independent."""
    stage = make_stage([("roll", _MODE.frequency, _MODE.damping)])
    alone = [identify(log, stage, channels=[channel.name]) for channel in log.channels]
    weight = np.array([1 / np.diag(found.cov) for found in alone])
    off = np.array([_off_truth(found) for found in alone])
    return np.asarray(np.sum(weight * off, axis=0) / np.sqrt(np.sum(weight, axis=0)))


def _off_truth(found: Modes) -> np.ndarray:
    estimate = np.concatenate([found.ln_frequency, found.ln_damping])
    return np.asarray(estimate - np.log([_MODE.frequency, _MODE.damping]))


def test_intervals_of_joint_sources_cover_as_stated(rng: np.random.Generator) -> None:
    """Δe and accelerometers of one force in one likelihood: 100 records.

    Negative control: averaged as if they were independent, their intervals are far too narrow.
    """
    logs = [_three_sensors(rng) for _ in range(100)]
    _judge(_deviations(logs))
    averaged = np.array([_averaged(log) for log in logs])
    for column, name in enumerate(("frequency", "damping")):
        found = _coverage(averaged[:, column])
        print(f"{name}, called independent: {found}")
        assert not found.holds(_NOMINAL), f"{name} of averaged channels covers {found}"
