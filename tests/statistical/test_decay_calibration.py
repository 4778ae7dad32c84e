"""Coverage of intervals of f and ζ from free decays.

Three stops of one second from a mode at 60 Hz with ζ = 1 %, whose ambient response is a twentieth
of what each stop excites. A coverage passes when its 99.9 % Clopper-Pearson interval holds 95 %:
with a true coverage of 95 % each judgement fails in at most 0.1 % of reseeded runs.
"""

from __future__ import annotations

import numpy as np

from lmshealth.decay import identify_decays
from tests.oracles import binomial_band
from tests.signals import deviations, make_stage
from tests.stops import Ring, stop_log, whole

_RING = Ring(60.37, 0.01, ambient=0.05)
_LOGS, _Z = 300, 1.959963984540054


def test_intervals_from_stops_cover_as_stated(rng: np.random.Generator) -> None:
    """95 % intervals of 300 logs cover; a third narrower, the negative control, do not."""
    stage = make_stage([("roll", _RING.frequency, _RING.damping)])
    off = []
    for _ in range(_LOGS):
        log = stop_log(rng, [_RING], 1.0, 400.0, 0.02, n_stops=3)
        modes = identify_decays(log, stage, segments=whole(log))
        assert modes.names == ("roll",), modes.refused
        off.append(np.abs(deviations(modes, "roll", _RING.frequency, _RING.damping)))
    for name, own in zip(("frequency", "damping"), np.transpose(off), strict=True):
        hits, narrow = (int(np.sum(own < width * _Z)) for width in (1.0, 2 / 3))
        low, high = binomial_band(hits, _LOGS)
        print(f"{name}: {hits} of {_LOGS}, {low:.3f} to {high:.3f}; narrow: {narrow}")
        assert low <= 0.95 <= high, f"{name}: {hits} of {_LOGS} intervals hold the truth"
        assert binomial_band(narrow, _LOGS)[1] < 0.95, f"{name}: {narrow} of {_LOGS}"
