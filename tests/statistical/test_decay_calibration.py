"""Coverage of intervals of f and ζ from free decays.

Three stops of one second from a mode at 60 Hz with ζ = 1 %, whose ambient response is a twentieth
of what each stop excites.
"""

from __future__ import annotations

import numpy as np

from lmshealth.modal.deterministic.free_decays import identify_decays
from tests.claims import Claims
from tests.signals import deviations, make_stage
from tests.statistical.evidence import covered
from tests.stops import Ring, stop_log, whole

_RING = Ring(60.37, 0.01, ambient=0.05)


def test_intervals_from_stops_cover(rng: np.random.Generator, claims: Claims) -> None:
    """95 % intervals cover; a third narrower, the negative control, they do not."""
    stage = make_stage([("roll", _RING.frequency, _RING.damping)])
    off = []
    for _ in range(claims.trials):
        log = stop_log(rng, [_RING], 1.0, 400.0, 0.02, n_stops=3)
        modes = identify_decays(log, stage, segments=whole(log))
        assert modes.names == ("roll",), modes.refused
        off.append(deviations(modes, "roll", _RING.frequency, _RING.damping))
    for name, own in zip(claims.part.claims, np.transpose(off), strict=True):
        claims.claim(name, covered(own))
        claims.control(name, covered(own, 2 / 3))
