"""FRF logs: a sine of constant current amplitude sweeps while the stage moves.

The sine is added to the servo's current, so that two responses can be read from such a log.  From
``current_excitation_a`` to a sensor it is that of the closed loop, whose poles are the modes of
`closed_loop_modes` and of the modal map.  From ``current_a``, which holds servo and sine together,
it is that of the structure alone: `without_loop` returns its poles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from models.dynamics.modal_coordinates import Diagonal, diagonalise, propagate
from models.dynamics.plant import (
    GUIDE_MODES,
    INPUTS,
    OUTPUTS,
    Mode,
    assurance,
    closed_loop_modes,
    structure_state,
)
from models.dynamics.stages import NOMINAL, Condition, Stage, build_structure, tuning_named
from models.errors import BadParameter
from models.recordings.effects import LINEAR, Effects
from models.recordings.recording import (
    DEFAULT_VELOCITY,
    LONGEST_S,
    SAMPLE_RATE_HZ,
    Recording,
    loop_of,
    move_velocity,
    record,
    sample_count,
)

Array = NDArray[np.float64]

# Among the contract's names of currents, which fixes its unit.
EXCITATION = "current_excitation_a"
_LAWS = ("log", "linear")


@dataclass(frozen=True, slots=True)
class Sweep:
    """A sine whose frequency rises from low to high, again every period.

    Parameters
    ----------
    low_hz, high_hz
        Changed by less than half a cycle per period, so that the phase has no jump.
    amplitude
        Of the current, A.  It adds up to 5 µm to the following error of stage Y at the defaults,
        and ten times as much from 5 Hz on, where the loop is compliant.
    period
        s; a whole number of samples.
    law
        ``log`` dwells equally long in every octave, ``linear`` on every hertz.
    """

    low_hz: float = 20.0
    high_hz: float = 1000.0
    amplitude: float = 0.1
    period: float = 5.0
    law: str = "log"

    def __post_init__(self) -> None:
        """Reject a sweep that a log cannot hold."""
        if not 0 < self.low_hz < self.high_hz < SAMPLE_RATE_HZ / 2:
            band = f"{self.low_hz}..{self.high_hz} Hz"
            raise BadParameter("band", band, f"0 < low < high < {SAMPLE_RATE_HZ / 2:g} Hz")
        if not (math.isfinite(self.amplitude) and self.amplitude > 0):
            raise BadParameter("amplitude", self.amplitude, "a positive current, A")
        if not 1 / self.low_hz <= self.period <= LONGEST_S:
            needed = f"{1 / self.low_hz:g} s, one cycle, to {LONGEST_S:g} s"
            raise BadParameter("period", self.period, needed)
        if self.law not in _LAWS:
            raise BadParameter("law", self.law, " or ".join(_LAWS))

    @property
    def samples(self) -> int:
        """Count of samples in a period."""
        return round(self.period * SAMPLE_RATE_HZ)

    def one_period(self) -> Array:
        """Return the current of one period, A (time,)."""
        share = np.arange(self.samples + 1) / self.samples
        ratio = self.high_hz / self.low_hz
        if self.law == "log":
            cycles = self.low_hz * np.expm1(share * math.log(ratio)) / math.log(ratio)
        else:
            cycles = self.low_hz * (share + (ratio - 1) * share**2 / 2)
        cycles *= self.samples / SAMPLE_RATE_HZ
        cycles *= round(cycles[-1]) / cycles[-1]
        # It begins at its largest: a force that begins at zero leaves a velocity behind.
        return np.asarray(self.amplitude * np.cos(2 * np.pi * cycles[:-1]))


def _from_current(stage: Stage, condition: Condition, effects: Effects) -> Diagonal:
    """Return the closed loop with a current (A), added to the servo's, as its only input."""
    diagonal = diagonalise(loop_of(stage, condition, effects))
    force = tuning_named(stage.name, condition.servo_id).force_constant
    index = INPUTS.index("motor_force")
    b, d = force * diagonal.b[:, [index]], force * diagonal.d[:, [index]]
    # The column of the log holds the whole current of the motor.
    d[OUTPUTS.index("current")] = 1.0
    return replace(diagonal, b=b, d=d)


def response(
    stage: Stage,
    sweep: Sweep,
    condition: Condition = NOMINAL,
    *,
    samples: int,
    effects: Effects = LINEAR,
) -> Array:
    """Return what the sweep alone does to the outputs (output, time), as if it ran for ever.

    Starting from the periodic state, every period is alike: a log has no transient to throw away.
    """
    diagonal = _from_current(stage, condition, effects)
    wave = sweep.one_period()
    rest = np.zeros(diagonal.poles.size, dtype=complex)
    _, end = propagate(diagonal, rest, wave[None], SAMPLE_RATE_HZ)
    # z(T) = e^(λT) z(0) + end, and z(T) = z(0).
    state = end / -np.expm1(diagonal.poles * sweep.samples / SAMPLE_RATE_HZ)
    period, _ = propagate(diagonal, state, wave[None], SAMPLE_RATE_HZ)
    return np.take(period, np.arange(samples), axis=1, mode="wrap")


def record_sweep(
    stage: Stage,
    sweep: Sweep,
    condition: Condition = NOMINAL,
    *,
    seconds: float,
    velocity: float = DEFAULT_VELOCITY,
    rng: np.random.Generator,
    effects: Effects = LINEAR,
) -> Recording:
    """Record a move at constant velocity, with all its disturbances, while the sine sweeps.

    Parameters
    ----------
    seconds
        Duration, s: at least one period.
    velocity
        Wanted velocity, m/s; lowered where the travel is too short for the duration.
    effects
        What the stage has beyond a linear loop.

    Raises
    ------
    BadParameter
        If the log is shorter than a period, or the sine so strong that the stage turns back, unless
        the effects have the friction that is then nonlinear.
    """
    samples = sample_count(seconds)
    if not seconds >= sweep.period:
        raise BadParameter("seconds", seconds, f"at least one period of {sweep.period} s")
    parts = response(stage, sweep, condition, samples=samples, effects=effects)
    if effects.friction is None:
        error = parts[OUTPUTS.index("delta_e")]
        _refuse_turning_back(sweep, error, move_velocity(stage, seconds, velocity))
    log = record(
        stage, condition,
        seconds=seconds, velocity=velocity, rng=rng, effects=effects, added=parts,
    )  # fmt: skip
    excitation = np.resize(sweep.one_period(), samples).astype(np.float32)
    settings = {
        "excitation_low_hz": sweep.low_hz,
        "excitation_high_hz": sweep.high_hz,
        "excitation_amplitude_a": sweep.amplitude,
        "excitation_period_s": sweep.samples / SAMPLE_RATE_HZ,
        "excitation_law": sweep.law,
    }
    return Recording({**log.columns, EXCITATION: excitation}, {**log.metadata, **settings})


def _refuse_turning_back(sweep: Sweep, error: Array, velocity: float) -> None:
    """Raise if the sweep alone would stop the move at times: friction would not be linear then."""
    fastest = float(np.abs(np.diff(error)).max()) * SAMPLE_RATE_HZ
    if fastest >= velocity:
        largest = sweep.amplitude * velocity / fastest
        needed = f"below {largest:.3g} A, so that a move at {velocity:g} m/s never turns back"
        raise BadParameter("amplitude", f"{sweep.amplitude} A", needed)


def without_loop(stage: Stage, condition: Condition = NOMINAL) -> dict[str, tuple[Mode, complex]]:
    """Return each guide mode of the closed loop, and its eigenvalue (rad/s) with the servo open.

    The first are the poles of a response to ``current_excitation_a``, the second of one to
    ``current_a``: fed back, a current that the sensors cause is not an input.
    """
    structure = build_structure(stage, condition)
    values, vectors = np.linalg.eig(structure_state(stage, structure)[0])
    upper = values.imag > 1.0
    values, shapes = values[upper], vectors[: structure.size, upper]
    modes = [m for m in closed_loop_modes(stage, condition) if m.name in GUIDE_MODES]
    alike = assurance(structure.mass, np.column_stack([m.shape for m in modes]), shapes)
    apart = np.abs(np.log(np.abs([[v / m.eigenvalue for v in values] for m in modes])))
    # Platform and housing move alike in more than one mode: the nearer is meant.
    nearest = np.argmax(alike - (apart / 0.3) ** 2, axis=1)
    return {m.name: (m, complex(values[k])) for m, k in zip(modes, nearest, strict=True)}
