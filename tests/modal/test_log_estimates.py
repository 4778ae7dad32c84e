"""Which logs are one recording, stored twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lmshealth.modal.log_estimates import LogEstimates, without_copies
from tests.lives import make_reading

MODES = {"roll": float(np.log(126.0)), "pitch": float(np.log(136.0))}


def moved(log: LogEstimates, name: str, sigmas: float) -> LogEstimates:
    """Return the log under another name, with ln f moved by so many standard deviations."""
    std = np.sqrt(np.diag(log.modes.cov))[:2]
    ln_f = log.modes.ln_frequency + sigmas * std
    return replace(log, log=name, digest=name, modes=replace(log.modes, ln_frequency=ln_f))


def test_a_recording_in_another_form_is_a_copy() -> None:
    """It has rounding of its own. Controls: another estimate, moment or odometer, and no mode."""
    first = make_reading("a.csv", 1.0, 5e3, MODES)
    copy = moved(first, "b.h5", 1e-3)
    other = moved(first, "c.csv", 0.1)
    later = replace(copy, log="d.csv", metadata=make_reading("", 2.0, 5e3, MODES).metadata)
    further = replace(copy, log="e.csv", metadata=make_reading("", 1.0, 6e3, MODES).metadata)
    nothing = [make_reading(name, 1.0, 5e3, {}) for name in ("f.csv", "g.csv")]
    undated = replace(first.metadata, recorded_at=None)
    no_moment = [replace(first, log=name, metadata=undated) for name in ("h.csv", "i.csv")]
    kept, refused = without_copies([first, copy, other, later, further, *nothing, *no_moment])
    assert [one.log for one in kept] == [f"{name}.csv" for name in "acdefghi"]
    (row,) = refused
    assert (row.log, row.reason, row.machine) == ("b.h5", "duplicate", "AX-1")
    assert "same recording as a.csv" in row.detail
