"""How often the line test raises false alarms.

Spectra of noise with four resonances, from two ordinates wide to twenty, and no line.
"""

from __future__ import annotations

import numpy as np

from lmshealth.io.log import Channel
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectral_lines import find_lines
from tests.claims import Claims
from tests.signals import Mode, accelerations
from tests.statistical.evidence import at_most

_RATE, _N = 1000.0, 3000
_BAND = (10.0, 450.0)
_DECLARED = 0.05
# Half-power bandwidths of 2, 4, 11 and 21 ordinates.
_MODES = [Mode(15.0, 0.022), Mode(60.0, 0.011), Mode(126.4, 0.0148), Mode(272.0, 0.013)]


def _calls(rng: np.random.Generator, declared: float, n: int) -> int:
    """Count spectra of noise in which a line is found."""
    found = 0
    for _ in range(n):
        values = accelerations(rng, _MODES, _N, _RATE, 0.01)[0]
        channel = Channel("acc_a", "acceleration", values)
        segment = Segment(0, _N, float("nan"))
        found += len(find_lines(channel, (segment,), _RATE, _BAND, declared)) > 0
    return found


def _tenth_of_the_threshold() -> float:
    """False-alarm rate to declare for an F threshold ten times lower (share of each frequency)."""
    n_tests = 4 * (_BAND[1] - _BAND[0]) * _N / _RATE
    threshold = 6 * ((_DECLARED / n_tests) ** (-1 / 6) - 1)
    return float(n_tests * (1 + threshold / 60) ** -6)


def test_lines_are_called_no_oftener_than_declared(
    rng: np.random.Generator, claims: Claims
) -> None:
    """At most 5 % of spectra of noise and resonances show a line.

    Control: by a tenth of the threshold most do.
    """
    n, few = claims.trials, claims.part.control
    claims.claim("false alarms", at_most(_calls(rng, _DECLARED, n), n, _DECLARED))
    rash = _calls(rng, _tenth_of_the_threshold(), few)
    claims.control("false alarms", at_most(rash, few, _DECLARED))
