"""Intervals of f and ζ cover as often as they say.

Records are short and many: 20 s in one, 7 moves of 3 s, or the mean over 8 parts of 20 s. Controls
are intervals of half the width, unless a test says more.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from lmshealth.io.log import Log
from lmshealth.modal.identification import identify
from lmshealth.modal.modes import Modes
from lmshealth.signal import segments, spectra
from lmshealth.signal.spectra import CrossSpectrum
from tests.bands import with_mean
from tests.claims import Claims
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
from tests.statistical.evidence import covered

# Three channels: a single one cannot tell a floor that moves with the mode from one that does not,
# and its intervals of f cover up to 98 %.
_MODE = Mode(100.0, 0.02, 1.0, (1.0, 0.6, -0.4))
_RATE = 400.0


def _deviations(logs: Iterable[Log], modes: Sequence[Mode] = (_MODE,)) -> np.ndarray:
    """Identify logs: deviations of ln f and ln ζ in standard deviations, ``(n_logs n_modes, 2)``.

    More than a few modes that are refused are an error: leaving them out would flatter the rest.
    """
    names = [f"mode_{k}" for k in range(len(modes))]
    stage = make_stage([(n, m.frequency, m.damping) for n, m in zip(names, modes, strict=True)])
    found = [identify(log, stage) for log in logs]
    pairs = [(one, name, mode) for one in found for name, mode in zip(names, modes, strict=True)]
    there = [(one, name, mode) for one, name, mode in pairs if name in one.names]
    assert len(there) > 0.97 * len(pairs)
    return np.array(
        [deviations(one, name, mode.frequency, mode.damping) for one, name, mode in there]
    )


def _judge(claims: Claims, off: np.ndarray) -> None:
    """Intervals cover as they say; halved ones, the negative control, are found out."""
    for name, own in zip(claims.part.claims, off.T, strict=True):
        claims.claim(name, covered(own))
        claims.control(name, covered(own, 0.5))


def test_intervals_from_one_record_cover(rng: np.random.Generator, claims: Claims) -> None:
    """95 % intervals of single records."""
    logs = (acceleration_log(rng, [_MODE], 20.0, _RATE, 1.0) for _ in range(claims.trials))
    _judge(claims, _deviations(logs))


def _short_moves(rng: np.random.Generator) -> Log:
    n = round(3 * _RATE)
    parts = [accelerations(rng, [_MODE], n, _RATE, 1.0) for _ in range(7)]
    pieces = [(k * n, (k + 1) * n) for k in range(7)]
    channels = {f"acc_{c}": row for c, row in enumerate(np.concatenate(parts, axis=1))}
    return make_log(channels, _RATE, pieces=pieces)


def test_intervals_from_short_moves_cover(rng: np.random.Generator, claims: Claims) -> None:
    """95 % intervals of logs of short moves."""
    _judge(claims, _deviations(_short_moves(rng) for _ in range(claims.trials)))


_PARTS, _PART_S = 8, 20.0


def _long_records(rng: np.random.Generator, n: int) -> Iterable[Log]:
    return (acceleration_log(rng, [_MODE], _PARTS * _PART_S, _RATE, 1.0) for _ in range(n))


def test_intervals_from_means_over_parts_cover(
    rng: np.random.Generator, claims: Claims, monkeypatch: pytest.MonkeyPatch
) -> None:
    """95 % intervals of long records, averaged over 8 parts.

    Control beside half the width: with its count forgotten a mean has intervals that are too wide.
    """
    size = round(_PART_S * _RATE)
    monkeypatch.setattr(segments, "MINUTE", size)
    monkeypatch.setattr(spectra, "_LEAST_PART", size)
    _judge(claims, _deviations(_long_records(rng, claims.trials)))
    mean = spectra._mean

    def once(parts: Iterator[CrossSpectrum]) -> CrossSpectrum:
        whole = mean(parts)
        return replace(whole, transforms=with_mean(whole.matrix))

    monkeypatch.setattr(spectra, "_mean", once)
    wide = _deviations(_long_records(rng, claims.part.control))
    for name, own in zip(claims.part.claims, wide.T, strict=True):
        claims.control(name, covered(own, share=0.8))


def test_intervals_of_three_modes_in_three_channels_cover(
    rng: np.random.Generator, claims: Claims
) -> None:
    """105, 120 and 135 Hz, ζ 1.5, 2 and 2.5 %, fitted jointly: three intervals a record."""
    modes = [
        Mode(105.0, 0.015, 1.0, (1.0, 0.4, -0.3)),
        Mode(120.0, 0.02, 1.0, (0.3, 1.0, 0.5)),
        Mode(135.0, 0.025, 1.0, (-0.4, 0.2, 1.0)),
    ]
    logs = (acceleration_log(rng, modes, 20.0, 500.0, 1.0) for _ in range(claims.trials))
    _judge(claims, _deviations(logs, modes))


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


def test_intervals_cover_where_floors_share_the_force(
    rng: np.random.Generator, claims: Claims
) -> None:
    """A floor common to two channels interferes with the mode."""
    _judge(claims, _deviations(_coherent_floor(rng) for _ in range(claims.trials)))


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


def test_intervals_of_joint_sources_cover(rng: np.random.Generator, claims: Claims) -> None:
    """Δe and accelerometers of one force in one likelihood.

    Control beside half the width: ζ of single channels, averaged as if they were independent; of f
    so many records do not tell.
    """
    logs = [_three_sensors(rng) for _ in range(claims.trials)]
    _judge(claims, _deviations(logs))
    averaged = np.array([_averaged(log) for log in logs[: claims.part.control]])
    claims.control(claims.part.claims[1], covered(averaged[:, 1]))
