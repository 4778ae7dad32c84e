"""Position controllers of X and Y as corrected from the paper, as chains of low-order factors.

A tenth-order transfer function in polynomial form loses its poles to rounding; every factor here
is of first or second order and stays in state space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.errors import BadParameter, MissingLibrary

Array = NDArray[np.float64]


def python_control() -> Any:
    """Import python-control, on first use: it takes as long as all the rest.

    Raises
    ------
    MissingLibrary
        If it is not installed: nothing in the wheel of lmshealth needs it.
    """
    try:
        import control
    except ImportError as error:
        raise MissingLibrary("control", "models") from error
    return control


@dataclass(frozen=True, slots=True)
class Biquad:
    """Second-order section (s² + 2 ζ_n ω s + ω²) / (s² + 2 ζ_d ω s + ω²)."""

    frequency_hz: float
    damping_above: float
    damping_below: float

    def __post_init__(self) -> None:
        """Reject numbers that are not positive."""
        _refuse_not_positive(self)


@dataclass(frozen=True, slots=True)
class Tuning:
    """A controller and its drive, in the factored and corrected form of equations (6)-(9).

    The command current is ``drive_gain / divisor`` × (s + position_gain)(velocity_p s +
    velocity_i)/s × low pass × sections × position error (m).
    """

    name: str
    position_gain: float
    velocity_p: float
    velocity_i: float
    low_pass_hz: float
    low_pass_damping: float
    sections: tuple[Biquad, ...]
    divisor: float
    # Fitted in the paper's plant (equations 6, 7): does not follow from its constants.
    drive_gain: float
    # The paper's motor and current loop.
    force_constant: float = 12.9
    inductance: float = 1.24e-3
    current_p: float = 25.0
    current_i: float = 21000.0
    # Equations (6) and (7) add K_v = 15.0 to K_p where R = 6.4 Ω is expected.  The loop of the
    # paper is kept; 6.4 would move the gain crossover by 0.2 Hz (X) and 0.01 Hz (Y).
    resistance: float = 15.0
    # Of a real drive, s: from the encoder's sample to the middle of the held current.
    delay: float | None = None
    # Of its strokes, m/s³, if not that of `models.recordings.motion_profile`.
    jerk: float | None = None

    def __post_init__(self) -> None:
        """Reject numbers that are not positive."""
        _refuse_not_positive(self)


def _refuse_not_positive(part: Biquad | Tuning) -> None:
    """Raise if one of the numbers of a part is not positive or not finite."""
    for field in fields(part):
        value = getattr(part, field.name)
        if isinstance(value, int | float) and not (math.isfinite(value) and value > 0):
            raise BadParameter(field.name, value, "a positive number, finite")


TUNINGS = {
    "lms-x": Tuning(
        name="commissioning",
        position_gain=50.0,
        velocity_p=400.0,
        velocity_i=225.0,
        low_pass_hz=300.0,
        low_pass_damping=0.707,
        sections=(Biquad(280.0, 0.094, 0.30),),
        divisor=22000.0,
        drive_gain=11630.0,
    ),
    "lms-y": Tuning(
        name="commissioning",
        position_gain=40.0,
        velocity_p=250.0,
        velocity_i=200.0,
        low_pass_hz=300.0,
        low_pass_damping=0.707,
        sections=(Biquad(160.0, 0.15, 0.50), Biquad(180.0, 0.40, 1.0)),
        divisor=19550.0,
        drive_gain=4455.0,
    ),
}
# The loops as measured: gain, notch of Y and lag that lead to Table 1.  One lag makes the gain and
# phase margins of both stages.  It is not that of a drive at 20 kHz (sample and hold, computing and
# current loop: 0.2 ms) but as long as three cycles of a motion controller at 1 kHz.  The jerk is
# set by eye on Table 3: softer loops leave more of what the reaction of the granite shakes.
_LAG = 3.4e-3
MEASURED = {
    "lms-x-full": replace(TUNINGS["lms-x"], drive_gain=6690.0, delay=_LAG, jerk=70.0),
    "lms-y-full": replace(
        TUNINGS["lms-y"],
        drive_gain=8220.0,
        delay=_LAG,
        jerk=105.0,
        sections=(Biquad(165.0, 0.15, 0.50), Biquad(180.0, 0.40, 1.0)),
    ),
}


@dataclass(frozen=True, slots=True)
class ServoMatrices:
    """State space from position error (m) and feedforward (A) to motor current (A).

    Parameters
    ----------
    a : (n, n)
    b : (n,)
        From the position error.
    feedforward : (n,)
        From a command current added in front of the current loop.
    c : (n,)
    """

    a: Array
    b: Array
    feedforward: Array
    c: Array


def second_order(numerator: tuple[float, float, float], omega: float, zeta: float) -> Any:
    """Return (n2 s² + n1 s + n0) / (s² + 2 ζ ω s + ω²) as a well-scaled state space.

    Both states have the size of the output: the canonical form with states y and dy/dt would
    differ by ω and spoil eigenvectors.
    """
    control = python_control()
    high, middle, low = numerator
    a = np.array([[0.0, omega], [-omega, -2 * zeta * omega]])
    b = np.array([[0.0], [omega]])
    c = np.array([[low / omega**2 - high, (middle / omega - 2 * zeta * high)]])
    return control.ss(a, b, c, [[high]])


def controller(tuning: Tuning) -> Any:
    """Return the controller, position error (m) to command current (A), as a series connection."""
    control = python_control()
    # (velocity_p s + velocity_i) / s
    velocity = control.ss([[0.0]], [[1.0]], [[tuning.velocity_i]], [[tuning.velocity_p]])
    omega = 2 * np.pi * tuning.low_pass_hz
    # The position loop's (s + gain) is improper alone; the low pass makes it proper.
    position = second_order(
        (0.0, omega**2, tuning.position_gain * omega**2), omega, tuning.low_pass_damping
    )
    scale = control.ss([], [], [], [[tuning.drive_gain / tuning.divisor]])
    factors = [scale, position, velocity]
    for section in tuning.sections:
        w = 2 * np.pi * section.frequency_hz
        factors.append(
            second_order((1.0, 2 * section.damping_above * w, w**2), w, section.damping_below)
        )
    if tuning.delay is not None:
        factors += delay_sections(tuning.delay)
    return reduce(control.series, factors)


def delay_sections(seconds: float) -> list[Any]:
    """Return a delay as all-pass sections, Padé of fourth order.

    Its phase is met within 1° up to 0.6 cycles of the delay, its gain everywhere.
    """
    poles = np.roots(python_control().pade(1.0, 4)[1]) / seconds
    sizes = [(abs(p), -p.real / abs(p)) for p in poles if p.imag > 0]
    return [second_order((1.0, -2 * z * w, w**2), w, z) for w, z in sizes]


def current_loop(tuning: Tuning) -> Any:
    """Return the closed current loop, command (A) to motor current (A), equations (4)-(5)."""
    total = tuning.current_p + tuning.resistance
    omega = np.sqrt(tuning.current_i / tuning.inductance)
    zeta = total / (2 * tuning.inductance * omega)
    numerator = (0.0, tuning.current_p / tuning.inductance, tuning.current_i / tuning.inductance)
    return second_order(numerator, omega, zeta)


@lru_cache(maxsize=32)
def servo_matrices(tuning: Tuning) -> ServoMatrices:
    """Return controller and current loop in series, a feedforward between, as plain arrays."""
    control = python_control()
    summed = control.ss([], [], [], [[1.0, 1.0]])
    command = control.append(controller(tuning), control.ss([], [], [], [[1.0]]))
    system = control.series(command, summed, current_loop(tuning))
    b = np.asarray(system.B)
    return ServoMatrices(np.asarray(system.A), b[:, 0], b[:, 1], np.asarray(system.C)[0])
