"""Logs of simulated signals, in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lmshealth._private.arrays import FloatArray
from lmshealth.io.log import Channel, ChannelKind, Log, Metadata

_KINDS: dict[str, ChannelKind] = {
    "acc": "acceleration",
    "delta": "displacement",
    "current": "current",
}


def make_log(
    signals: Mapping[str, FloatArray],
    rate: float,
    pieces: Sequence[tuple[int, int]] | None = None,
    *,
    velocity: float | None = None,
) -> Log:
    """Make a log of signals in SI units, whose kinds are those of their names; one piece if none.

    ``velocity`` is that of the set point, in m/s.
    """
    n = next(iter(signals.values())).size
    return Log(
        name="simulated",
        digest="0" * 64,
        metadata=Metadata(),
        sample_rate=rate,
        channels=tuple(
            Channel(name, _KINDS[name.split("_")[0]], values) for name, values in signals.items()
        ),
        reference_velocity=None if velocity is None else np.full(n, velocity),
        pieces=tuple(pieces or [(0, n)]),
        refused=(),
    )
