"""Margins of the position loops: every crossover, judged, rigid and with the flexible structure.

The verbs take any ``python-control`` system of one input and one output.  Loops are series
connections of low-order blocks in state space; the polynomials multiplied out would lose their
roots to rounding.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from models.dynamics.equations import CONTROLLER, OPEN_LOOP, PLANT, READINGS, Ratio, factors, ratio
from models.dynamics.plant import sensor_rows, structure_state
from models.dynamics.servo import MEASURED, controller, current_loop, python_control
from models.dynamics.stages import (
    NOMINAL,
    Condition,
    build_structure,
    stage_named,
    tuning_named,
)
from models.dynamics.structure import named_modes

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# What the paper demands (section 3), and what its Table 1 reports: bandwidth (Hz), gain margin
# (dB), phase margin (degrees) of the measured loops.
GAIN_MARGIN_DB = 6.0
PHASE_MARGIN_DEG = 30.0
TABLE_1 = {"lms-x": (12.5, 14.5, 40.5), "lms-y": (10.5, 13.5, 30.3)}
TABLE_1 |= {f"{name}-full": row for name, row in TABLE_1.items()}

GAIN_CROSSOVER = "gain crossover"
UPPER_CROSSOVER = "upper phase crossover"
LOWER_CROSSOVER = "lower phase crossover"

_BAND_HZ = (1e-4, 1e4)
_PER_DECADE = 600
# A resonance of damping ratio ζ is sampled at |p| (1 + ζ k) for these k: a mode that the encoder
# hardly sees turns the phase within a small part of its width.
_BESIDE_RESONANCE = np.geomspace(1e-3, 4.0, 50)
_AROUND_RESONANCE = np.concatenate([-_BESIDE_RESONANCE, [0.0], _BESIDE_RESONANCE])
_NEAR_RESONANCE = 0.05


@dataclass(frozen=True, slots=True)
class Crossover:
    """A frequency at which the loop gain is one, or its phase −180°.

    Parameters
    ----------
    kind
        ``gain crossover``; ``upper phase crossover`` where a rise of the gain reaches −1;
        ``lower phase crossover`` where a fall does.
    number
        Counts the crossovers of this kind upwards from 1.
    frequency_hz
        Where.
    margin
        Phase margin (degrees) of a gain crossover: the lag that brings the loop to −1, or lead
        where negative.  Gain margin (dB) of a phase crossover: the change of gain that does.
    """

    kind: str
    number: int
    frequency_hz: float
    margin: float

    @property
    def name(self) -> str:
        """Kind and number."""
        return f"{self.kind} {self.number}"

    @property
    def needed(self) -> float:
        """Least size of the margin, degrees or dB."""
        return PHASE_MARGIN_DEG if self.kind == GAIN_CROSSOVER else GAIN_MARGIN_DB

    @property
    def enough(self) -> bool:
        """Whether the margin is as large as needed; means nothing in an unstable loop."""
        return abs(self.margin) >= self.needed


@dataclass(frozen=True, slots=True)
class Margins:
    """Stability, crossovers and peak sensitivity of a loop.

    Parameters
    ----------
    growth_per_s
        Largest real part of the closed loop's poles; the loop is stable where it is negative.
    rolls_off
        Whether the loop gain is below one at 10 kHz, as in any real loop.
    crossovers
        All between 0.1 mHz and 10 kHz, ascending.
    peak_sensitivity, peak_hz
        Largest |1/(1+L)| and where.
    """

    growth_per_s: float
    rolls_off: bool
    crossovers: tuple[Crossover, ...]
    peak_sensitivity: float
    peak_hz: float

    @property
    def stable(self) -> bool:
        """Whether all poles of the closed loop decay."""
        return self.growth_per_s < 0

    @property
    def verdict(self) -> str:
        """``meets`` or ``fails`` the demanded margins, ``unstable``, or ``no roll-off``."""
        if not self.stable:
            return "unstable"
        if not self.rolls_off:
            return "no roll-off"
        return "meets" if all(c.enough for c in self.crossovers) else "fails"

    def deciding(self, kind: str) -> Crossover | None:
        """Return the crossover of a kind with the smallest margin, None if there is none."""
        found = [c for c in self.crossovers if c.kind == kind]
        return min(found, key=lambda c: abs(c.margin), default=None)


@dataclass(frozen=True, slots=True)
class Case:
    """A loop of a stage: reading, structure (``rigid``, ``flexible``), equations, margins.

    ``resonances`` are the structure's undamped natural frequencies (Hz) by mode name.
    """

    reading: str
    structure: str
    equations: str
    margins: Margins
    resonances: dict[str, float]

    def near(self, crossover: Crossover) -> str | None:
        """Return the mode whose resonance makes a crossover: the nearest, within 5 %."""
        apart = {
            name: abs(np.log(hertz / crossover.frequency_hz))
            for name, hertz in self.resonances.items()
        }
        name = min(apart, key=apart.__getitem__, default=None)
        return name if name is not None and apart[name] < _NEAR_RESONANCE else None


def rigid_loop(stage: str, reading: str) -> Any:
    """Return the open loop of a reading around the rigid platform, as a ``StateSpace``."""
    return python_control().series(*(part.state_space() for part in factors(stage, reading)))


def structure_path(stage: str, condition: Condition = NOMINAL) -> Any:
    """Return the flexible structure from motor force (N) to encoder (m), as a ``StateSpace``."""
    control = python_control()
    machine = stage_named(stage)
    structure = build_structure(machine, condition)
    a, b = structure_state(machine, structure)
    encoder = sensor_rows(machine, structure)["delta_e"]
    seen = np.concatenate([encoder, np.zeros(encoder.size)])
    return control.ss(a, b[:, [-1]], [seen], [[0.0]])


def flexible_loop(stage: str, reading: str, condition: Condition = NOMINAL) -> Any:
    """Return the open loop of a reading with the flexible structure in place of the rigid mass."""
    control = python_control()
    shaping, plant = factors(stage, reading)
    mass = stage_named(stage).moving_mass.value
    # The plant is force over command current, times 1/(m s²).
    force = Ratio(tuple(mass * value for value in plant.numerator), plant.denominator[2:])
    return control.series(
        shaping.state_space(), force.state_space(), structure_path(stage, condition)
    )


def drive_loop(stage: str, structure: str, condition: Condition = NOMINAL) -> Any:
    """Return the open loop of a full stage with the tuning of its drive, rigid or flexible."""
    control = python_control()
    tuning = tuning_named(stage, condition.servo_id)
    mass = stage_named(stage).moving_mass.value
    rigid = control.ss([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1 / mass]], [[1.0, 0.0]], [[0.0]])
    path = structure_path(stage, condition) if structure == "flexible" else rigid
    force = control.ss([], [], [], [[tuning.force_constant]])
    return control.series(controller(tuning), current_loop(tuning), force, path)


def sensitivity(loop: Any) -> Any:
    """Return 1/(1+L), reference to error."""
    return python_control().feedback(1, loop)


def complementary_sensitivity(loop: Any) -> Any:
    """Return L/(1+L), reference to position."""
    return python_control().feedback(loop, 1)


def _grid(loop: Any) -> Array:
    """Return frequencies (Hz) dense enough to separate crossovers, also around resonances."""
    decades = np.log10(_BAND_HZ[1] / _BAND_HZ[0])
    even = np.geomspace(*_BAND_HZ, round(decades * _PER_DECADE) + 1)
    poles = np.asarray(loop.poles())
    poles = poles[(poles.imag > 0) & (np.abs(poles.real) < 0.1 * np.abs(poles))]
    spread = np.abs(poles)[:, None] + np.abs(poles.real)[:, None] * _AROUND_RESONANCE
    grid = np.union1d(even, spread.ravel() / (2 * np.pi))
    return np.asarray(grid[(grid >= _BAND_HZ[0]) & (grid <= _BAND_HZ[1])])


def _response(loop: Any, hertz: float | Array) -> ComplexArray:
    """Return the loop's frequency response at frequencies in Hz."""
    return np.asarray(loop(2j * np.pi * np.asarray(hertz)), dtype=complex)


def _roots(curve: Callable[[float], float], grid: Array, values: Array) -> list[float]:
    """Return where a curve, sampled on a grid, changes sign."""
    at = np.flatnonzero(np.signbit(values[1:]) != np.signbit(values[:-1]))
    return [float(brentq(curve, grid[k], grid[k + 1], rtol=1e-12)) for k in at]


def _crossovers(loop: Any, grid: Array, values: ComplexArray) -> tuple[Crossover, ...]:
    """Return all crossovers from the loop's response on a grid (Hz), ascending."""

    def log_gain(hertz: float) -> float:
        return float(np.log(np.abs(_response(loop, hertz))))

    def sine(hertz: float) -> float:
        value = complex(_response(loop, hertz))
        return value.imag / abs(value)

    found = [(hertz, GAIN_CROSSOVER) for hertz in _roots(log_gain, grid, np.log(np.abs(values)))]
    for hertz in _roots(sine, grid, values.imag):
        value = complex(_response(loop, hertz))
        if value.real < 0:
            found.append((hertz, UPPER_CROSSOVER if abs(value) < 1 else LOWER_CROSSOVER))
    counts: Counter[str] = Counter()
    result = []
    for hertz, kind in sorted(found):
        counts[kind] += 1
        value = complex(_response(loop, hertz))
        gain = kind == GAIN_CROSSOVER
        margin = np.angle(-value, deg=True) if gain else -20 * np.log10(abs(value))
        result.append(Crossover(kind, counts[kind], hertz, float(margin)))
    return tuple(result)


def _peak(loop: Any, grid: Array, values: ComplexArray) -> tuple[float, float]:
    """Return the largest |1/(1+L)| and its frequency (Hz)."""
    k = int(np.clip(np.argmin(np.abs(1 + values)), 1, grid.size - 2))
    best = minimize_scalar(
        lambda hertz: float(np.abs(1 + _response(loop, hertz))),
        bounds=(grid[k - 1], grid[k + 1]),
        method="bounded",
    )
    return 1.0 / float(best.fun), float(best.x)


def margins(loop: Any) -> Margins:
    """Return stability, all crossovers and the peak sensitivity of an open loop.

    Parameters
    ----------
    loop
        ``python-control`` system, position error to position, for negative feedback.
    """
    grid = _grid(loop)
    values = _response(loop, grid)
    poles = np.asarray(complementary_sensitivity(loop).poles())
    peak, at = _peak(loop, grid, values)
    return Margins(
        growth_per_s=float(poles.real.max()),
        rolls_off=bool(abs(values[-1]) < 1),
        crossovers=_crossovers(loop, grid, values),
        peak_sensitivity=peak,
        peak_hz=at,
    )


def margin_record(case: Case) -> dict[str, Any]:
    """Return a case as JSON-ready record; margins of a loop that cannot work are not judged."""
    found = case.margins
    kinds = (GAIN_CROSSOVER, UPPER_CROSSOVER, LOWER_CROSSOVER)
    judged = found.verdict in ("meets", "fails")
    deciding = [found.deciding(kind) for kind in kinds] if judged else []
    return {
        "reading": case.reading,
        "structure": case.structure,
        "equations": case.equations,
        "verdict": found.verdict,
        "growth_per_s": found.growth_per_s,
        "peak_sensitivity": found.peak_sensitivity,
        "peak_sensitivity_hz": found.peak_hz,
        "crossovers": [
            {
                "crossover": c.name,
                "frequency_hz": c.frequency_hz,
                "phase_margin_deg": c.margin if c.kind == GAIN_CROSSOVER else None,
                "gain_margin_db": None if c.kind == GAIN_CROSSOVER else c.margin,
                "needed": c.needed,
                "enough": c.enough if judged else None,
                "decides": c in deciding,
                "near": case.near(c),
            }
            for c in found.crossovers
        ],
    }


def cases(stage: str, condition: Condition = NOMINAL) -> list[Case]:
    """Return the loops of a stage: three readings and the printed product, rigid and flexible.

    A full stage has the loop of its drive alone: the equations have no lag.

    Raises
    ------
    UnknownStage
        If there is no stage of that name.
    """
    name = stage_named(stage).name
    if name in MEASURED:
        modes = named_modes(build_structure(stage_named(name), condition))
        resonances = dict(zip(modes.names, (modes.omega / (2 * np.pi)).tolist(), strict=True))
        return [
            Case("measured", kind, "drive", margins(drive_loop(name, kind, condition)), near)
            for kind, near in (("rigid", {}), ("flexible", resonances))
        ]
    product = f"({PLANT[name]}) × ({CONTROLLER[name]})"
    written = ratio(OPEN_LOOP[name], "printed").state_space()
    modes = named_modes(build_structure(stage_named(name), condition))
    resonances = dict(zip(modes.names, (modes.omega / (2 * np.pi)).tolist(), strict=True))
    rigid = [Case(r, "rigid", product, margins(rigid_loop(name, r)), {}) for r in READINGS]
    flexible = [
        Case(r, "flexible", product, margins(flexible_loop(name, r, condition)), resonances)
        for r in READINGS
    ]
    alone = Case("printed", "rigid", f"({OPEN_LOOP[name]})", margins(written), {})
    return [rigid[0], alone, *rigid[1:], *flexible]
