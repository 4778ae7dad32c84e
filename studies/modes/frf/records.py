"""Records of a simulated machine that is driven, with known modes; column maps of real benches.

Everything is exact: responses are made in the frequency domain, over one period that is repeated,
or on a circle of which the record is a stretch. Nothing here knows how the modes are estimated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from studies.harness.data import samples

Array = np.ndarray[Any, Any]

RATE = 400.0
# Within the band, and two beside it that the residual terms must stand for.
MODES = ((62.0, 0.015, 1.0), (90.0, 0.02, -0.6), (30.0, 0.03, 0.5), (150.0, 0.02, 0.8))
BAND = (42.0, 118.0)
EXCITED = (40.0, 120.0)  # by a multisine


@dataclass(frozen=True)
class Machine:
    """Linear machine between a current and a sensor."""

    # Natural frequency in Hz, damping ratio, participation
    modes: tuple[tuple[float, float, float], ...] = MODES
    displacement: bool = False  # What the sensor reads; else acceleration
    # Noise of the sensor as a share of its answer's standard deviation, and a disturbance that the
    # machine answers like the current, as a share of the current's
    white: float = 0.1
    process: float = 0.1
    input_noise: float = 0.0  # Of the measured current, as a share of its standard deviation
    # Of the motor: what the cube adds to the force at one standard deviation. Poles stay.
    cubic: float = 0.0

    def response(self, hertz: Array) -> Array:
        """Return the response at frequencies above 0, (line,)."""
        w = 2 * np.pi * hertz
        w_n = [2 * np.pi * f for f, _, _ in self.modes]
        total = sum(
            p / (n**2 - w**2 + 2j * zeta * n * w)
            for n, (_, zeta, p) in zip(w_n, self.modes, strict=True)
        )
        return np.asarray(total if self.displacement else -(w**2) * total)

    def noise(self, rng: np.random.Generator, given: Array, answer: Array) -> tuple[Array, Array]:
        """Return both signals with noise of sensors and machine, (time,) each."""
        process = self.process * given.std() * rng.standard_normal(3 * answer.size)
        answer = answer + self.answer(process)[: answer.size]
        answer = answer + self.white * answer.std() * rng.standard_normal(answer.size)
        return given + self.input_noise * given.std() * rng.standard_normal(given.size), answer

    def answer(self, given: Array) -> Array:
        """Return the answer to a signal that repeats itself, (time,)."""
        hertz = np.fft.rfftfreq(given.size, 1 / RATE)
        spectrum = np.fft.rfft(given)
        spectrum[1:] *= self.response(hertz[1:])
        spectrum[0] = 0.0
        return np.fft.irfft(spectrum, given.size)


def multisine(rng: np.random.Generator, size: int, band: tuple[float, float] = EXCITED) -> Array:
    """Return a period of equal amplitudes and random phases, of variance one (time,)."""
    hertz = np.fft.rfftfreq(size, 1 / RATE)
    excited = (hertz >= band[0]) & (hertz <= band[1])
    spectrum = np.where(excited, np.exp(2j * np.pi * rng.uniform(size=hertz.size)), 0)
    return np.asarray(np.fft.irfft(spectrum) * size / np.sqrt(2 * excited.sum()))


def periodic(
    rng: np.random.Generator, machine: Machine, size: int, periods: int
) -> tuple[Array, Array]:
    """Return current and sensor under a multisine that has been going on for ever."""
    given = multisine(rng, size)
    answer = machine.answer(given + machine.cubic * given**3)
    return machine.noise(rng, np.tile(given, periods), np.tile(answer, periods))


def at_random(rng: np.random.Generator, machine: Machine, size: int) -> tuple[Array, Array]:
    """Return current and sensor under white noise: a stretch of a longer record."""
    given = rng.standard_normal(3 * size)
    answer = machine.answer(given)
    return machine.noise(rng, given[:size], answer[:size])


GUIDE = ("lsb250_linear_guide/open/exp1.mat", "lsb250_linear_guide/open/exp2.mat")
BENCH = "fditools_two_inertia_bench/open/MultisineTypeA.mat"
# What a user would write to read two real benches: a voltage stands where the contract has a
# current, angles stand where it has lengths; modes do not depend on units.
MAPS = {
    GUIDE[0]: """
[columns]
time_s = "X.Data"
delta_e_motor_mm = "Y(1).Data"
delta_e_load_mm = "Y(2).Data"
current_input = "Y(3).Data"
[units]
current_input = 1.0
[mat]
variable = "exp1"
""",
    BENCH: samples.MAPS[BENCH],
}
MAPS[GUIDE[1]] = MAPS[GUIDE[0]].replace("exp1", "exp2")
