"""Equations (1)-(11) of the paper [Piscalov2021] as printed, as corrected, as derived.

``printed`` has the digits and exponents of the paper.

``corrected`` applies `ERRATA` to the printed coefficients; the open loops (10), (11) are then
products of (6)-(9).  K_v = 15.0, which is in the s³ term of (6) and (7) where R = 6.4 is
expected, is kept.

``derived`` has no coefficient of the equations in it: the plant follows from (1)-(5) and the
constants, the controller from Table 1.  Fitted to the print there, for want of a source: the gain
of the plant, the controller's divisor, the damping ratios of low pass and notch, and all of Y's
bi-quad.  Y's notch is at Table 1's 165 Hz, where the coefficients of (9) put it at 160 Hz.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Literal

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike, NDArray

from models.dynamics.servo import TUNINGS, Biquad, Tuning, python_control
from models.dynamics.stages import stage_named
from models.errors import BadParameter, UnknownReading

READINGS = ("printed", "corrected", "derived")
PLANT = {"lms-x": 6, "lms-y": 7}
CONTROLLER = {"lms-x": 8, "lms-y": 9}
OPEN_LOOP = {"lms-x": 10, "lms-y": 11}

# Constants of equation (3); those of the current loop (5) are in `servo.Tuning`.
RESISTANCE = 6.4
BACK_EMF = 15.0
# Table 1 and the text; see the module's first lines.
_TABLE_1_NOTCH_HZ = {"lms-x": 280.0, "lms-y": 165.0}


@dataclass(frozen=True, slots=True)
class Ratio:
    """A ratio of two polynomials in s (rad/s), coefficients in ascending powers."""

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]

    def __call__(self, s: ArrayLike) -> NDArray[np.complex128]:
        """Return the value at each s (rad/s), same shape."""
        at = np.asarray(s, dtype=complex)
        top = polynomial.polyval(at, self.numerator)
        return np.asarray(top / polynomial.polyval(at, self.denominator))

    def __mul__(self, other: Ratio) -> Ratio:
        """Return the ratio of two factors in series."""
        return Ratio(
            tuple(np.convolve(self.numerator, other.numerator).tolist()),
            tuple(np.convolve(self.denominator, other.denominator).tolist()),
        )

    def transfer_function(self) -> Any:
        """Return it as a ``control.TransferFunction``.

        Valid for values at single s.  Roots of high orders are lost to rounding: take poles and
        stability from `state_space` of the factors.
        """
        return python_control().tf(self.numerator[::-1], self.denominator[::-1])

    def state_space(self) -> Any:
        """Return it as a ``control.StateSpace``, time scaled to the geometric mean of its poles.

        Raises
        ------
        BadParameter
            If the numerator has the higher order.
        """
        control = python_control()
        order = len(self.denominator) - 1
        if len(self.numerator) > order + 1:
            raise BadParameter(
                "order of the numerator", len(self.numerator) - 1, f"at most {order}, a proper loop"
            )
        # Companion form in p = s/ω: without the scaling its entries span 30 decades.
        low = next(k for k, value in enumerate(self.denominator) if value)
        ends = abs(self.denominator[low] / self.denominator[-1])
        omega = ends ** (1.0 / (order - low)) if order > low else 1.0
        powers = omega ** (np.arange(order + 1.0) - order)
        below = np.array(self.denominator) * powers / self.denominator[-1]
        above = np.zeros(order + 1)
        above[: len(self.numerator)] = self.numerator
        above *= powers / self.denominator[-1]
        through = above[-1]
        a = np.eye(order, k=1)
        a[-1] = -below[:-1]
        b = np.zeros((order, 1))
        b[-1] = omega
        return control.ss(omega * a, b, [above[:-1] - through * below[:-1]], [[through]])


@dataclass(frozen=True, slots=True)
class Erratum:
    """A printed coefficient that is wrong, its equation, place (power of s) and reason."""

    equation: int
    part: Literal["numerator", "denominator"]
    power: int
    corrected: float
    reason: str


# One power of s, common to both sums of (8)-(11), is cancelled: a_1 and b_1 are the constants.
# Not a number in print, and read so: (6) s⁴ "6.126 · 10 1" as 6.126e1; (7) s⁴ "5 · 580 1" as
# 5.580e1, like its twin in (6).
PRINTED = {
    6: Ratio((6.622e10, 7.884e7), (0.0, 0.0, 1.037e7, 1.976e4, 6.126e1)),
    7: Ratio((2.722e8, 2.586e7), (0.0, 0.0, 9.450e6, 1.800e4, 5.580e1)),
    8: Ratio(
        (3.482e10, 6.260e10, 1.245e9, 1.529e5, 4.000e2),
        (0.0, 6.810e10, 7.431e7, 5.859e4, 2.304e1, 6.192e3),
    ),
    9: Ratio(
        (8.085e9, 1.032e10, 2.631e8, 2.750e5, 5.108e2, 2.441e1, 1.954e4),
        (0.0, 1.1977e10, 6.944e7, 1.163e5, 1.177e5, 7.240e2, 2.553e5, 4.303e9),
    ),
    10: Ratio(
        (2.306e21, 4.149e21, 8.737e19, 1.083e17, 3.854e13, 3.154e10),
        (0.0, 6.810e10, 7.431e7, 5.859e4, 2.304e1, 6.192e3),
    ),
    11: Ratio(
        (8.085e9, 1.032e10, 2.631e8, 2.750e5, 5.108e2, 2.441e1, 1.954e4),
        (0.0, 0.0, 0.0, 7.064e17, 2.116e15, 2.118e12, 1.442e9, 5.554e5, 1.365e2, 3.793e3),
    ),
}

_SIGN = "the exponent has lost its minus sign"
ERRATA = (
    Erratum(6, "denominator", 4, 6.126e-1, "s·L·m with the s that yields the s² term from K_i"),
    Erratum(7, "denominator", 4, 5.580e-1, "s·L·m with the s that yields the s² term from K_i"),
    Erratum(7, "numerator", 0, 2.172e10, "K_i/K_p = 840 times the s term, as in equation (6)"),
    Erratum(8, "denominator", 5, 6.192e-3, _SIGN),
    Erratum(9, "denominator", 1, 1.977e10, "a digit too many: the low pass is then at 300 Hz"),
    Erratum(9, "denominator", 4, 1.177e2, "1e5 puts poles into the right half plane"),
    Erratum(9, "numerator", 5, 2.441e-1, _SIGN),
    Erratum(9, "numerator", 6, 1.954e-4, _SIGN),
    Erratum(9, "denominator", 5, 7.240e-2, _SIGN),
    Erratum(9, "denominator", 6, 2.553e-5, _SIGN),
    Erratum(9, "denominator", 7, 4.303e-9, _SIGN),
)


def _corrected(equation: int) -> Ratio:
    """Return a printed ratio with its errata applied."""
    parts = {
        "numerator": list(PRINTED[equation].numerator),
        "denominator": list(PRINTED[equation].denominator),
    }
    for erratum in ERRATA:
        if erratum.equation == equation:
            parts[erratum.part][erratum.power] = erratum.corrected
    return Ratio(tuple(parts["numerator"]), tuple(parts["denominator"]))


def derived_tuning(stage: str) -> Tuning:
    """Return the servo with R in the current loop and the notch where Table 1 has it."""
    tuning = TUNINGS[stage_named(stage).name]
    notch = replace(tuning.sections[0], frequency_hz=_TABLE_1_NOTCH_HZ[stage])
    return replace(
        tuning, name="derived", resistance=RESISTANCE, sections=(notch, *tuning.sections[1:])
    )


def _derived_plant(stage: str) -> Ratio:
    """Return the plant of equations (1)-(5), command current I_c (A) to position (m), times gain.

    With m s² x = K_f I and (L s + R) I = u − K_v s x, and the PI loop u = (K_p + K_i/s)(I_c − I):
    x/I_c = K_f (K_p s + K_i) / (s² (m L s² + m (K_p + R) s + m K_i + K_v K_f)).  The print leaves
    the last term out (0.04 % of m K_i).
    """
    tuning = derived_tuning(stage)
    mass = stage_named(stage).moving_mass.value
    gain = tuning.drive_gain * tuning.force_constant
    stiff = mass * tuning.current_i + BACK_EMF * tuning.force_constant
    damp = mass * (tuning.current_p + tuning.resistance)
    return Ratio(
        (gain * tuning.current_i, gain * tuning.current_p),
        (0.0, 0.0, stiff, damp, mass * tuning.inductance),
    )


def _section(section: Biquad) -> Ratio:
    """Return a second-order section."""
    w = 2 * np.pi * section.frequency_hz
    return Ratio(
        (w**2, 2 * section.damping_above * w, 1.0), (w**2, 2 * section.damping_below * w, 1.0)
    )


def controller_ratio(tuning: Tuning) -> Ratio:
    """Return the polynomial form of a factored controller, without the plant's drive gain."""
    w = 2 * np.pi * tuning.low_pass_hz
    gain = 1.0 / tuning.divisor
    factors = [
        Ratio((gain * tuning.position_gain, gain), (1.0,)),
        Ratio((tuning.velocity_i, tuning.velocity_p), (0.0, 1.0)),
        Ratio((w**2,), (w**2, 2 * tuning.low_pass_damping * w, 1.0)),
        *map(_section, tuning.sections),
    ]
    return _series(factors)


def _series(factors: Iterable[Ratio]) -> Ratio:
    """Return the product of factors."""
    return reduce(Ratio.__mul__, factors)


def factors(stage: str, reading: str) -> tuple[Ratio, Ratio]:
    """Return controller and plant of a stage; their product is the open loop.

    Parameters
    ----------
    stage
        ``lms-x`` or ``lms-y``.
    reading
        One of `READINGS`.

    Raises
    ------
    UnknownStage, UnknownReading
        If there is none of that name.
    """
    name = stage_named(stage).name
    return ratio(CONTROLLER[name], reading), ratio(PLANT[name], reading)


def ratio(equation: int, reading: str) -> Ratio:
    """Return one of equations (6)-(11) in a reading.

    The open loops (10), (11) as printed are not the product of their printed factors; corrected
    and derived they are.

    Raises
    ------
    BadParameter
        If the equation is none of (6)-(11).
    UnknownReading
        If there is no reading of that name.
    """
    if equation not in PRINTED:
        raise BadParameter("equation", equation, "6 to 11")
    if reading not in READINGS:
        raise UnknownReading(reading, READINGS)
    if reading == "printed":
        return PRINTED[equation]
    stage = "lms-x" if equation % 2 == 0 else "lms-y"
    if equation == OPEN_LOOP[stage]:
        return _series(factors(stage, reading))
    if reading == "corrected":
        return _corrected(equation)
    if equation == PLANT[stage]:
        return _derived_plant(stage)
    return controller_ratio(derived_tuning(stage))


def controller(stage: str, reading: str) -> Any:
    """Return the controller of (8) or (9), position error (m) to what the plant's gain scales."""
    return factors(stage, reading)[0].transfer_function()


def plant(stage: str, reading: str) -> Any:
    """Return the plant of (6) or (7), command to position (m), with its fitted gain."""
    return factors(stage, reading)[1].transfer_function()
