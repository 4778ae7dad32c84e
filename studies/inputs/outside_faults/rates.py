"""Facts that a log, or the logs of a machine, state more than once: rates, dropped and repeated.

The logs are sums of three modes and noise along a set point, in columns of the log contract.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.signal import lfilter

from studies.inputs.outside_faults.case import Case, Program, Seen, last_line

KIND = "rates"
RATE, SECONDS = 20_000.0, 12.0
MODES = {"roll": 126.0, "pitch": 137.0, "yaw": 155.0}  # Hz, those of the description lms-y
DAMPING = 0.012
LOGS = 6

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Recording:
    """A log: samples per second that it has and that it states, motion, rounding, damage."""

    stated: float = RATE
    velocity: bool = True
    position: bool = True
    strokes: bool = False
    step_um: float = 0.0  # of the position
    nominal: float | None = None  # velocity_mm_s of the metadata
    stamps: bool = False  # made from the index
    damage: Callable[[Columns], Columns] | None = None
    scale: float = 1.0  # of the frequencies
    seed: int = 1
    decimated: int = 1

    def columns(self) -> Columns:
        """Return the columns as they are stored."""
        n = round(SECONDS * RATE)
        rng = np.random.default_rng(self.seed)
        signals = np.zeros((2, n))
        for i, frequency in enumerate(MODES.values()):
            pole = np.exp((-DAMPING + 1j) * 2 * np.pi * frequency * self.scale / RATE)
            moved = lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], rng.normal(size=n))
            shape = (1.0, 0.4 * (i - 1.3))
            signals += np.outer(shape, moved / moved.std())
        signals += 0.05 * rng.normal(size=signals.shape)
        time = np.arange(n) / RATE
        velocity = np.full(n, 10.0)
        if self.strokes:
            velocity = 50 * np.clip(5 * np.sin(2 * np.pi * time / 3), -1, 1)
        position = -60 + np.concatenate([[0], np.cumsum((velocity[1:] + velocity[:-1]) / 2)]) / RATE
        if self.step_um:
            position = np.round(position * 1e3 / self.step_um) * self.step_um / 1e3
        found = {"acc_feed_m_s2": signals[0], "acc_pitch_m_s2": signals[1]}
        if self.position:
            found["reference_position_mm"] = position
        if self.velocity:
            found["reference_velocity_mm_s"] = velocity
        found = {name: values[:: self.decimated] for name, values in found.items()}
        if self.damage is not None:
            found = self.damage(found)
        if self.stamps:
            found["time_s"] = np.arange(found["acc_feed_m_s2"].size) / self.stated
        return found

    def write(self, path: Path, **metadata: Any) -> Path:
        """Write the log as HDF5."""
        with h5py.File(path, "w") as file:
            for name, values in self.columns().items():
                file[name] = values
            file.attrs["sample_rate_hz"] = self.stated
            if self.nominal is not None:
                file.attrs["velocity_mm_s"] = self.nominal
            file.attrs.update(metadata)
        return path


def _asked(recording: Recording, words: tuple[str, ...]) -> Callable[[Program, Path], Seen]:
    """Identify the modes of a log; right where a refusal or a warning has all words."""

    def ask(program: Program, folder: Path) -> Seen:
        path = recording.write(folder / "log.h5")
        done = program("modes", path, "--stage", "lms-y", "--format", "json")
        found = json.loads(done.stdout) if done.stdout.strip() else {}
        rows = [one for one in found.get("refused", ()) if not one["mode"]]
        texts = [f"{one['reason']}: {one['detail']}" for one in rows]
        seen = any(all(word in text for word in words) for text in texts)
        answer = "; ".join(texts) or _frequencies(found) or last_line(done.stderr)
        return Seen(seen if words else not texts and bool(found.get("modes")), answer[:160])

    return ask


def _frequencies(found: Mapping[str, Any]) -> str:
    """Return the frequencies of an answer in Hz."""
    return ", ".join(f"{row['frequency_hz']:.2f} Hz" for row in found.get("modes", ()))


def _case(name: str, right: str, fault: Recording, *words: str) -> Case:
    """Make a case of one log; its control is the same recording without the fault."""
    control = replace(fault, stated=RATE, damage=None, scale=1.0)
    if fault.nominal is not None:
        control = replace(control, nominal=10.0)
    return Case(KIND, name, right, _asked(fault, words), _asked(control, ()))


def _dropped(n: int) -> Callable[[Columns], Columns]:
    """Drop every n-th sample."""
    return lambda found: {k: np.delete(v, np.s_[n // 2 :: n]) for k, v in found.items()}


def _dropped_at(*places: int) -> Callable[[Columns], Columns]:
    """Drop seven samples at some places."""
    gone = np.add.outer(places, np.arange(7)).ravel()
    return lambda found: {k: np.delete(v, gone) for k, v in found.items()}


def _repeated(length: int, *, is_inserted: bool) -> Callable[[Columns], Columns]:
    """Record a buffer twice, in addition to the next one or instead of it."""

    def damage(found: Columns) -> Columns:
        at = 100_000
        rest = at + (1 if is_inserted else 2) * length
        return {
            k: np.concatenate([v[: at + length], v[at : at + length], v[rest:]])
            for k, v in found.items()
        }

    return damage


def _run(program: Program, folder: Path, logs: list[Recording]) -> tuple[dict[str, str], str]:
    """Run a machine of several logs; return its refused logs with details, and its last line."""
    archive = folder / "logs"
    archive.mkdir()
    first = datetime(2026, 1, 5, 8, tzinfo=UTC)
    for k, one in enumerate(logs):
        moment = (first + timedelta(days=7 * k)).isoformat()
        own = replace(one, seed=k + 1)
        own.write(archive / f"{k:02d}.h5", stage="M-Y", recorded_at=moment, travel_km=10.0 * k)
    done = program("run", archive, "--stage", "lms-y", "--out", folder / "out", "--epochs", "1")
    table = folder / "out" / "refused.csv"
    rows = csv.DictReader(table.read_text("utf-8").splitlines()) if table.exists() else ()
    return {
        row["log"]: f"{row['reason']}: {row['detail']}"
        for row in rows
        if not row["mode"] and row["reason"] != "no-stage"
    }, last_line(done.stdout)


def _machine(logs: list[Recording], odd: set[int]) -> Callable[[Program, Path], Seen]:
    """Run a machine; right where the odd logs, and no others, are refused with both rates."""

    def ask(program: Program, folder: Path) -> Seen:
        found, line = _run(program, folder, logs)
        names = {f"{k:02d}.h5" for k in odd}
        both = all(f"{logs[0].stated:g} Hz" in text for text in found.values())
        answer = "; ".join(f"{log} {text}" for log, text in found.items()) or line
        return Seen(set(found) == names and both, answer[:160])

    return ask


_BARE = Recording(position=False, velocity=False)
_OFF = replace(_BARE, stated=0.98 * RATE)
# What the machine does, with another setting of the recorder: every second sample.
_OTHER = replace(_BARE, stated=RATE / 2, decimated=2)

CASES: tuple[Case, ...] = (
    _case(
        "header of 19,000 for 20,000 Hz",
        "refused, with 19000 and 20000 Hz",
        Recording(stated=19_000),
        "rate:", "19000 Hz", "20000 Hz",
    ),
    _case(
        "header of 20,200 for 20,000 Hz, position in µm, strokes",
        "refused, with 20200 and about 20000 Hz",
        Recording(stated=20_200, strokes=True, step_um=1.0),
        "rate:", "20200 Hz",
    ),
    _case(
        "header of 20,040 for 20,000 Hz",
        "flagged, with both",
        Recording(stated=20_040),
        "rate:", "20040 Hz", "20000 Hz",
    ),
    _case(
        "stamps made from the index at 10,000 for 20,000 Hz",
        "refused, with both",
        Recording(stated=10_000, stamps=True, step_um=1.0),
        "rate:", "10000 Hz",
    ),
    _case(
        "header of 19,000 Hz, speed in the metadata",
        "flagged, with 9.5 and 10 mm/s",
        Recording(stated=19_000, velocity=False, nominal=10.0),
        "rate:", "9.5 mm/s", "velocity_mm_s is 10",
    ),
    _case(
        "1 of 100 samples dropped, set position and velocity",
        "refused",
        Recording(damage=_dropped(100)),
        "dropped:",
    ),
    _case(
        "1 of 100 samples dropped, set position in 0.1 µm",
        "refused",
        Recording(velocity=False, step_um=0.1, damage=_dropped(100)),
        "dropped:",
    ),
    _case(
        "1 of 100 samples dropped, set position in µm, velocity",
        "refused",
        Recording(step_um=1.0, damage=_dropped(100)),
        "rate:",
    ),
    _case(
        "seven samples dropped at three places",
        "cut there, with their count",
        Recording(damage=_dropped_at(40_000, 90_000, 150_001)),
        "dropped:", "3 times",
    ),
    _case(
        "a buffer of 1,024 samples recorded twice",
        "left out, with its length",
        Recording(position=False, velocity=False, damage=_repeated(1024, is_inserted=True)),
        "repeated:", "1024 samples",
    ),
    _case(
        "a buffer of 256 samples instead of the next, with stamps",
        "left out, with its length",
        Recording(stamps=True, damage=_repeated(256, is_inserted=False)),
        "repeated:", "256 samples",
    ),
    Case(
        KIND,
        "one log of six states 19,600 Hz",
        "it alone is refused, with 19600 and 20000 Hz",
        _machine([_OFF if k == 3 else _BARE for k in range(LOGS)], {3}),
        _machine([_OTHER if k == 3 else _BARE for k in range(LOGS)], set()),
    ),
    Case(
        KIND,
        "headers alternate between 20,000 and 19,600 Hz",
        "the logs that differ from the first are refused, with both",
        _machine([_OFF if k % 2 else _BARE for k in range(LOGS)], set(range(1, LOGS, 2))),
        _machine([_OTHER if k % 2 else _BARE for k in range(LOGS)], set()),
    ),
)  # fmt: skip
