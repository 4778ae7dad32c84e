"""How often the line test raises false alarms.

2,000 spectra of noise with four resonances, from two ordinates wide to twenty, and no line. The
rate passes when its 99.9 % Clopper-Pearson interval holds the declared one, so that a right test
fails in 0.1 % of reseeded runs.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import beta

from lmshealth.lines import find_lines
from lmshealth.logs import Channel
from lmshealth.segments import Segment
from tests.signals import Mode, accelerations

_RATE, _N, _SPECTRA = 1000.0, 3000, 2000
_BAND = (10.0, 450.0)
_DECLARED = 0.05
# Half-power bandwidths of 2, 4, 11 and 21 ordinates.
_MODES = [Mode(15.0, 0.022), Mode(60.0, 0.011), Mode(126.4, 0.0148), Mode(272.0, 0.013)]


def _interval(hits: int, n: int) -> tuple[float, float]:
    """Bounds of a rate by Clopper and Pearson, 99.9 %."""
    low = beta.ppf(0.0005, hits, n - hits + 1) if hits else 0.0
    high = beta.ppf(0.9995, hits + 1, n - hits) if hits < n else 1.0
    return float(low), float(high)


def _tenth_of_the_threshold() -> float:
    """False-alarm rate to declare for an F threshold ten times lower (share of each frequency)."""
    n_tests = 4 * (_BAND[1] - _BAND[0]) * _N / _RATE
    threshold = 6 * ((_DECLARED / n_tests) ** (-1 / 6) - 1)
    return float(n_tests * (1 + threshold / 60) ** -6)


def test_false_alarms_are_as_often_as_declared(rng: np.random.Generator) -> None:
    """Noise and resonances show a line in 5 % of spectra; a tenth of the threshold in most."""
    hits, control = 0, 0
    for number in range(_SPECTRA):
        values = accelerations(rng, _MODES, _N, _RATE, 0.01)[0]
        channel = Channel("acc_a", "acceleration", values)
        segment = Segment(0, _N, float("nan"))
        hits += len(find_lines(channel, segment, _RATE, _BAND, _DECLARED)) > 0
        if number < 200:
            low = _tenth_of_the_threshold()
            control += len(find_lines(channel, segment, _RATE, _BAND, low)) > 0
    low, high = _interval(hits, _SPECTRA)
    assert low <= _DECLARED <= high, f"{hits} of {_SPECTRA}: {low:.4f} to {high:.4f}"
    low, high = _interval(control, 200)
    assert not low <= _DECLARED <= high
