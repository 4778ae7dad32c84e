"""Intervals of f and ζ from driven logs cover as often as they say.

A machine with two modes in the band and two beside it answers a multisine of random phases, or
white noise, while sensors are noisy and a disturbance shakes it.
"""

from __future__ import annotations

import numpy as np

from lmshealth.modal.deterministic.frequency_response import read_frf
from studies.modes.frf.records import BAND, MODES, RATE, Machine, at_random, periodic
from tests.claims import Claims
from tests.signals import make_log
from tests.statistical.evidence import covered

_MACHINE = Machine(white=0.1, process=0.1, input_noise=0.05)


def _off(signals: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Tell by how many standard deviations ln f and ln ζ of both modes are off, (2, 2)."""
    log = make_log({"current": signals[0], "acc_x": signals[1]}, RATE)
    modes = read_frf(log, "current", "acc_x", band=BAND).modes
    assert len(modes.names) == 2
    truth = np.log([[f for f, _, _ in MODES[:2]], [zeta for _, zeta, _ in MODES[:2]]])
    std = np.sqrt(np.diag(modes.cov)).reshape(2, 2)
    return np.asarray((np.array([modes.ln_frequency, modes.ln_damping]) - truth) / std)


def _judge(claims: Claims, off: np.ndarray, wrong: tuple[float, ...]) -> None:
    """Both modes count: their errors in one log are all but independent."""
    for name, own in zip(claims.part.claims, np.moveaxis(off, 1, 0), strict=True):
        claims.claim(name, covered(own))
        for factor in wrong:
            claims.control(name, covered(own, factor))


def test_intervals_from_whole_periods_cover(rng: np.random.Generator, claims: Claims) -> None:
    """95 % intervals of logs of six periods; neither a third narrower nor twice as wide."""
    off = [_off(periodic(rng, _MACHINE, 1600, 6)) for _ in range(claims.trials)]
    _judge(claims, np.array(off), (2 / 3, 2.0))


def test_intervals_from_driven_records_cover(rng: np.random.Generator, claims: Claims) -> None:
    """95 % intervals of logs of 16 s; those of half the width do not."""
    off = [_off(at_random(rng, _MACHINE, 6400)) for _ in range(claims.trials)]
    _judge(claims, np.array(off), (0.5,))
