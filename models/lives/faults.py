"""Faults of recordings, as real archives contain them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from models.errors import UnknownFault
from models.recordings.recording import SAMPLE_RATE_HZ, Recording

Column = NDArray[np.float32]

_STRUCK = "acc_pitch_m_s2"
_STANDARD_GRAVITY = 9.80665
_GAPS = 3
_LONGEST_GAP = 400  # samples: 20 ms
_HUM_RMS = 3.0  # of the signal's own


def _changed(recording: Recording, columns: Mapping[str, NDArray[np.floating]]) -> Recording:
    """Return the recording with some columns replaced."""
    stored = {name: np.asarray(values, dtype=np.float32) for name, values in columns.items()}
    return Recording({**recording.columns, **stored}, recording.metadata)


def drop_samples(recording: Recording, rng: np.random.Generator) -> Recording:
    """Lose three short runs of samples; a time column shows where."""
    count = recording.columns[_STRUCK].size
    keep = np.ones(count, dtype=bool)
    for start in rng.integers(1, count, _GAPS):
        keep[start : start + int(rng.integers(1, _LONGEST_GAP))] = False
    kept = {name: values[keep] for name, values in recording.columns.items()}
    # Single precision would not separate two samples after a few minutes.
    time = (np.arange(count) / SAMPLE_RATE_HZ)[keep]
    return Recording({"time_s": time, **kept}, recording.metadata)


def clip_channel(recording: Recording, rng: np.random.Generator) -> Recording:
    """End one accelerometer's range below its signal."""
    values = recording.columns[_STRUCK]
    reach = float(np.std(values)) * rng.uniform(0.5, 1.5)
    return _changed(recording, {_STRUCK: np.clip(values, -reach, reach)})


def kill_channel(recording: Recording, rng: np.random.Generator) -> Recording:
    """Let one accelerometer read a constant: its cable has come off."""
    values = recording.columns[_STRUCK]
    return _changed(recording, {_STRUCK: np.full(values.size, 1e-3 * rng.standard_normal())})


def mistake_gain(recording: Recording, rng: np.random.Generator) -> Recording:
    """Write one accelerometer in g under a column name in m/s²."""
    return _changed(recording, {_STRUCK: recording.columns[_STRUCK] / _STANDARD_GRAVITY})


def add_hum(recording: Recording, rng: np.random.Generator) -> Recording:
    """Add mains hum to Δe and both accelerometers: an earth loop."""
    turns = 50.0 * np.arange(recording.columns[_STRUCK].size) / SAMPLE_RATE_HZ
    hum = sum(np.sin(2 * np.pi * (k * turns + rng.random())) / k for k in (1, 2, 3)) / np.sqrt(
        0.5 * sum(1 / k**2 for k in (1, 2, 3))
    )
    struck = ("delta_e_um", "acc_feed_m_s2", _STRUCK)
    values = {name: recording.columns[name] for name in struck}
    return _changed(recording, {n: v + _HUM_RMS * np.std(v) * hum for n, v in values.items()})


FAULTS: dict[str, Callable[[Recording, np.random.Generator], Recording]] = {
    "dropped-samples": drop_samples,
    "clipped-channel": clip_channel,
    "dead-channel": kill_channel,
    "wrong-gain": mistake_gain,
    "mains-hum": add_hum,
}


def fault_named(name: str) -> Callable[[Recording, np.random.Generator], Recording]:
    """Return a fault by its name.

    Raises
    ------
    UnknownFault
        If the name is not registered in `FAULTS`.
    """
    if name not in FAULTS:
        raise UnknownFault(name, FAULTS)
    return FAULTS[name]
