"""Intervals of f and ζ from driven logs cover as often as they say.

A machine with two modes in the band and two beside it answers a multisine of random phases, or
white noise, while sensors are noisy and a disturbance shakes it. A coverage passes when its 99.9 %
Clopper-Pearson interval holds 95 %: a true coverage of 95 % fails in at most 0.1 % of judgements,
each of the two tests in at most 0.2 % of reseeded runs. Negative controls must fail: intervals 1.5
times as narrow, and, where there are seeds enough to tell, as wide.
"""

from __future__ import annotations

import numpy as np

from lmshealth.frf import read_frf
from lmshealth.metrics import clopper_pearson
from studies.frf_modes.records import BAND, MODES, RATE, Machine, at_random, periodic
from tests.signals import make_log

_Z = 1.959963984540054
_MACHINE = Machine(white=0.1, process=0.1, input_noise=0.05)


def _off(signals: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Tell by how many standard deviations ln f and ln ζ of both modes are off, (2, 2)."""
    log = make_log({"current": signals[0], "acc_x": signals[1]}, RATE)
    modes = read_frf(log, "current", "acc_x", band=BAND).modes
    assert len(modes.names) == 2
    truth = np.log([[f for f, _, _ in MODES[:2]], [zeta for _, zeta, _ in MODES[:2]]])
    std = np.sqrt(np.diag(modes.cov)).reshape(2, 2)
    return np.asarray((np.array([modes.ln_frequency, modes.ln_damping]) - truth) / std)


def _judge(off: np.ndarray, controls: tuple[float, ...]) -> None:
    """Both modes count: their errors in one log are all but independent."""
    for name, z in zip(("frequency", "damping"), np.moveaxis(off, 1, 0), strict=True):
        low, high = _covered(z, 1.0)
        print(f"{name}: {low:.3f} to {high:.3f}, bias {z.mean():+.3f} σ, std {z.std():.3f} σ")
        assert low <= 0.95 <= high, name
        for factor in controls:
            low, high = _covered(z, factor)
            assert not low <= 0.95 <= high, f"{name}, {factor:.2f} times as wide"


def _covered(z: np.ndarray, factor: float) -> tuple[float, float]:
    return clopper_pearson(int(np.count_nonzero(np.abs(z) < factor * _Z)), z.size, 0.999)


def test_intervals_from_whole_periods_cover_as_stated(rng: np.random.Generator) -> None:
    """95 % intervals of 150 logs of six periods."""
    _judge(np.array([_off(periodic(rng, _MACHINE, 1600, 6)) for _ in range(150)]), (1 / 1.5, 1.5))


def test_intervals_from_records_cover_as_stated(rng: np.random.Generator) -> None:
    """95 % intervals of 60 logs of 16 s."""
    _judge(np.array([_off(at_random(rng, _MACHINE, 6400)) for _ in range(60)]), (1 / 1.5,))
