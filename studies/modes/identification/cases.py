"""What is identified: modes, sensors, lengths of records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from lmshealth.io.log import Log
from studies.harness.data.cramer_rao import Recording, Vibration, joint_bound
from studies.modes.identification import records
from studies.modes.identification.records import Array, Truth

# A fit reaches that many damping ratios beyond its modes: the bound is that of the same band.
REACH = 8.0
# Records of a kind: most of the first, whose error is nearest to what is asked.
FIRST, HEADLINE, OTHERS = 2000, 600, 200
SHAPES = ((1.0, 0.6, -0.4), (0.5, -1.0, 0.7), (-0.3, 0.8, 1.0))


@dataclass(frozen=True)
class Case:
    """A kind of record."""

    name: str
    modes: tuple[Truth, ...]
    noise: float  # PSD of the noise of each accelerometer, (m/s²)²/Hz
    # Makes a log of a generator, modes and noise
    make: Callable[[np.random.Generator, tuple[Truth, ...], float], Log]
    seconds: float  # Length and number of the records
    moves: int = 1
    seeds: int = OTHERS
    # Largest root mean square error over the Cramér-Rao bound that is asked for
    worst: float | None = None
    bounded: bool = True

    @property
    def truth(self) -> Array:
        """[ln f, ln ζ] of the modes."""
        return np.log([[m.frequency for m in self.modes], [m.damping for m in self.modes]]).ravel()

    def bound(self) -> Array:
        """Smallest standard deviations that an unbiased estimator could have, as `truth`."""
        f = np.array([m.frequency for m in self.modes])
        zeta = np.array([m.damping for m in self.modes])
        shapes = np.array([m.shape for m in self.modes]).T
        band = float(np.min(f * (1 - REACH * zeta))), float(np.max(f * (1 + REACH * zeta)))
        cov = joint_bound(
            Vibration(f, zeta, shapes),
            np.diag([m.psd for m in self.modes]),
            Recording(np.full(len(shapes), self.noise), self.seconds, band),
        )
        return np.asarray(np.sqrt(np.diag(cov) / self.moves))


def _noise(damping: float, snr: float) -> float:
    return 1 / (4 * damping**2 * snr)


def _case(
    name: str, modes: tuple[Truth, ...], snr: float, seconds: float = 60.0, moves: int = 1,
    seeds: int = OTHERS, worst: float | None = None,
) -> Case:  # fmt: skip
    make = partial(records.accelerations, seconds=seconds, moves=moves)
    return Case(name, modes, _noise(modes[0].damping, snr), make, seconds, moves, seeds, worst)


def _isolated(damping: float = 0.02) -> tuple[Truth, ...]:
    return (Truth(120.0, damping, 1.0, SHAPES[0]),)


_ALONE = (Truth(120.0, 0.02, 1.0, (1.0,)),)


def _pair(apart: float) -> tuple[Truth, ...]:
    first = Truth(120.0, 0.02, 1.0, SHAPES[0])
    return first, Truth(120.0 + apart * first.bandwidth, 0.02, 1.0, SHAPES[1])


THREE = tuple(
    Truth(f, zeta, 1.0, shape)
    for f, zeta, shape in zip((105.0, 120.0, 135.0), (0.015, 0.02, 0.025), SHAPES, strict=True)
)

CASES = (
    _case("isolated, SNR 100", _isolated(), 100.0, seeds=FIRST, worst=1.1),
    _case("three modes, three channels, 60 s", THREE, 100.0, seeds=HEADLINE),
    _case("the same as 30 moves of 0.67 s", THREE, 100.0, 0.67, 30, HEADLINE),
    _case("the same as 7 moves of 3 s", THREE, 100.0, 3.0, 7, HEADLINE),
    _case("two modes 3 bandwidths apart", _pair(3.0), 100.0, seeds=HEADLINE, worst=1.3),
    _case("two modes 2 bandwidths apart", _pair(2.0), 100.0),
    _case("two modes 1 bandwidth apart", _pair(1.0), 100.0),
    _case("isolated, SNR 3", _isolated(), 3.0),
    _case("isolated, SNR 10", _isolated(), 10.0, worst=1.1),
    _case("isolated, SNR 30", _isolated(), 30.0, worst=1.1),
    _case("isolated, SNR 1000", _isolated(), 1000.0, worst=1.1),
    _case("isolated, one channel", _ALONE, 100.0, worst=1.1),
    _case("isolated, one channel, SNR 10", _ALONE, 10.0, worst=1.1),
    _case("isolated, damping 0.3 %", _isolated(0.003), 100.0, worst=1.1),
    _case("isolated, damping 1 %", _isolated(0.01), 100.0, worst=1.1),
    _case("isolated, damping 5 %", _isolated(0.05), 100.0, worst=1.1),
    _case("isolated, 10 s", _isolated(), 100.0, 10.0, worst=1.1),
    _case("isolated, 300 s", _isolated(), 100.0, 300.0, worst=1.1),
    _case("isolated as 30 moves of 0.67 s", _isolated(), 100.0, 0.67, 30, worst=1.1),
    _case("isolated as 7 moves of 3 s", _isolated(), 100.0, 3.0, 7, worst=1.1),
    Case("following error and two accelerometers", THREE, _noise(0.015, 100.0),
         partial(records.fused, seconds=60.0), 60.0, bounded=False),
    Case("mains and ball pass beside the mode", _isolated(), _noise(0.02, 100.0),
         partial(records.with_lines, seconds=60.0), 60.0, worst=1.1),
    Case("following error in encoder counts", _ALONE, 100.0,
         partial(records.counted, seconds=20.0), 20.0, bounded=False),
)  # fmt: skip
