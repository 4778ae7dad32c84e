"""Survey of accelerometers: bands where a log shows its modes, and spectral lines."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.log import Log
from lmshealth.modal.acceleration_survey import survey
from tests.signals import Mode, accelerations, make_log, make_stage, sine

RATE, N = 500.0, 10_000
STAGE = make_stage([("roll", 60.0, 0.02)])


@pytest.fixture(scope="module")
def log() -> Log:
    """Two accelerometers: a mode at 62.5 Hz, in the first a line at 90 Hz; and a current."""
    mode = Mode(62.5, 0.02, shape=(1.0, 0.5))
    first, second = accelerations(np.random.default_rng(3), [mode], N, RATE, 0.01)
    first = first + sine(N, RATE, 90.0, 50.0)
    return make_log({"acc_a": first, "acc_b": second, "current": np.ones(N)}, RATE)


def test_a_survey_reads_modes_where_the_log_shows_them(log: Log) -> None:
    """One magnitude per accelerometer, about the identified frequency; the line in its channel."""
    found = survey(log, STAGE, None)
    assert (found.log, found.refused) == (log.name, ())
    assert [m.channel for m in found.magnitudes] == ["acc_a", "acc_b"]
    for magnitude in found.magnitudes:
        middle = (magnitude.band.low + magnitude.band.high) / 2
        assert middle == pytest.approx(62.5, rel=0.01)
        assert magnitude.band.placed_by == "identified"
    (line,) = [line for line in found.lines if abs(line.frequency - 90.0) < 0.1]
    assert (line.channel, line.amplitude) == ("acc_a", pytest.approx(50.0, rel=0.05))


def test_modes_that_a_log_does_not_show_are_read_where_the_description_has_them(log: Log) -> None:
    """A log that identification refuses is surveyed nevertheless."""
    slow = make_stage([("roll", 62.5, 0.0005)])
    found = survey(log, slow, None)
    assert {m.band.placed_by for m in found.magnitudes} == {"stage"}


def test_the_band_limits_grid_and_lines(log: Log) -> None:
    """Without a description there is a grid; what is outside of the band is not looked at."""
    found = survey(log, None, (20.0, 80.0))
    assert {m.band.kind for m in found.magnitudes} == {"grid"}
    assert max(m.band.high for m in found.magnitudes) <= 85.0
    assert not [line for line in found.lines if line.frequency > 80]


def test_a_log_without_accelerometers_is_refused() -> None:
    """As reading magnitudes refuses it."""
    with pytest.raises(BadLog) as caught:
        survey(make_log({"current": np.ones(N)}, RATE), STAGE, None)
    assert caught.value.reason == "no-accelerometer"


def test_lines_are_of_the_part_that_is_asked_for() -> None:
    """A line that is there while the stage moves is none of its rest."""
    moving = np.arange(N) % 5000 < 3000
    samples = np.random.default_rng(0).normal(size=N) + moving * sine(N, RATE, 90.0, 5.0)
    log = make_log({"acc_a": samples}, RATE, velocity=0.1 * moving)
    assert [round(x.frequency) for x in survey(log, None, None, part="constant").lines] == [90]
    assert survey(log, None, None, part="idle").lines == ()
