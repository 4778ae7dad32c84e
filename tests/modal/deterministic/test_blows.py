"""Impact tests: blows found in the force, double hits and overloads refused, modes with σ."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth._private.arrays import FloatArray
from lmshealth.errors import BadLog
from lmshealth.modal.deterministic import frequency_response
from lmshealth.modal.deterministic.blows import find_hits, from_blows, without_rings
from lmshealth.modal.deterministic.frequency_response import FrfReading, read_frf
from lmshealth.modal.deterministic.responses import Ordinates, Pair
from studies.harness.data.logs import make_log
from studies.modes.frf.hammer import RATE, Hammer, strike

MODES = ((62.0, 0.015, 1.0), (130.0, 0.01, -0.6))
BAND = (30.0, 200.0)


def read(hammer: Hammer, seed: int = 1) -> FrfReading:
    """Read a simulated impact test."""
    force, answer = strike(np.random.default_rng(seed), hammer)
    log = make_log({"current_force": force, "acc": answer}, RATE)
    return read_frf(log, "current_force", "acc", band=BAND)


def assert_found(reading: FrfReading) -> None:
    """Expect the modes and no other, within four standard deviations."""
    modes = reading.modes
    truth = np.log([*(f for f, _, _ in MODES), *(zeta for _, zeta, _ in MODES)])
    error = np.concatenate([modes.ln_frequency, modes.ln_damping]) - truth
    assert np.abs(error / np.sqrt(np.diag(modes.cov))).max() < 4


@pytest.mark.parametrize("blows", [1, 4])
def test_blows_are_recognised_and_averaged(blows: int) -> None:
    """One blow has no coherence, and the noise of the residual; several have that of scatter."""
    reading = read(Hammer(MODES, blows=blows))
    assert_found(reading)
    assert (reading.frf.method, reading.frf.n_averages) == ("blows", blows)
    assert np.isnan(reading.frf.coherence).all() == (blows == 1)
    assert np.abs(reading.fit.response).max() < 1.2 * np.abs(reading.frf.response).max()
    assert (reading.frf.std > 0).all()


def test_a_decay_that_the_next_blow_cuts_off_has_no_added_damping() -> None:
    """A third of 0.3 % is left after 1 s: cut off, its damping is right without a window."""
    modes = ((62.0, 0.003, 1.0),)
    found = read(Hammer(modes, blows=5, seconds=1.0, gap=3.0, white=0.003)).modes
    assert found.damping_ratio == pytest.approx([0.003], abs=4 * found.damping_ratio_std[0])
    assert found.damping_ratio_std[0] < 3e-4


def test_double_hits_are_refused_by_number_and_time() -> None:
    """Two of five: the others are used, and the modes are those of the machine."""
    reading = read(Hammer(MODES, blows=5, double=(1, 3)))
    assert_found(reading)
    assert reading.frf.n_averages == 3
    refused = [r for r in reading.modes.refused if r.reason == "double-hit"]
    assert [r.detail[:6] for r in refused] == ["blow 2", "blow 4"]
    assert "a second hit of" in refused[0].detail
    assert "strike again" in refused[0].detail
    assert read(Hammer(MODES, blows=5, double=(2,), share=(0.03, 0.04))).frf.n_averages == 5
    with pytest.raises(BadLog, match=r"double-hit: none of 1 blows can be used: blow 1 at"):
        read(Hammer(MODES, blows=1, double=(0,)))


@pytest.mark.parametrize("channel", [0, 1])
def test_overloaded_blows_are_refused(channel: int) -> None:
    """The strongest of four exceed the range of the force or of the sensor."""
    signals = list(strike(np.random.default_rng(2), Hammer(MODES, blows=4, tip=0.006)))
    tops = [np.abs(part).max() for part in np.array_split(signals[channel], 4)]
    limit = 0.8 * max(tops)
    signals[channel] = np.clip(signals[channel], -limit, limit)
    log = make_log({"current_force": signals[0], "acc": signals[1]}, RATE)
    reading = read_frf(log, "current_force", "acc", band=BAND)
    assert_found(reading)
    assert [r.reason for r in reading.modes.refused if "blow" in r.detail] == ["overload"] * sum(
        top > limit for top in tops
    )


@pytest.mark.parametrize("sign", [1, -1])
def test_a_force_that_rests_in_few_levels_is_no_overload(sign: int) -> None:
    """Rounded to 1 N, or zero outside the pulses, and of either sign, no blow is refused."""
    force, answer = strike(np.random.default_rng(1), Hammer(MODES, blows=4))
    force *= sign * 300 / force.max()
    in_newtons = np.round(force).astype(float)
    for few in (in_newtons, np.where(np.abs(force) > 6, force, 0.0)):
        log = make_log({"current_force": few, "acc": answer}, RATE)
        reading = read_frf(log, "current_force", "acc", band=BAND)
        assert reading.frf.n_averages == 4
        assert reading.modes.frequency == pytest.approx([62.0, 130.0], rel=2e-3)


def test_only_what_is_certain_is_taken_for_blows() -> None:
    """Noise, noise with a spike, a sweep and a train of equal pulses are none unless stated."""
    rng = np.random.default_rng(3)
    noise = rng.standard_normal(20_000)
    spike = noise + 60 * (np.arange(noise.size) == 7000)
    t = np.arange(noise.size) / RATE
    train = 1.0 * (np.arange(noise.size) % 2000 == 500)
    for values in (noise, spike, np.sin(2 * np.pi * 50 * t**2), train):
        assert find_hits(values, RATE, certain=True) == []
    assert len(find_hits(train, RATE, certain=False)) == 10
    # The same force, a push, and negative.
    force = strike(rng, Hammer(MODES, blows=3))[0]
    for values in (force, force + 5, -force):
        assert len(find_hits(values, RATE, certain=True)) == 3


def test_a_line_is_not_a_mode_after_one_blow() -> None:
    """Mains in the record of one blow do not fade; over several their phase is random."""
    for blows in (1, 4):
        force, answer = strike(np.random.default_rng(4), Hammer(MODES, blows=blows))
        t = np.arange(answer.size) / RATE
        answer = answer + 0.02 * answer.max() * np.sin(2 * np.pi * 50 * t + 1)
        log = make_log({"current_force": force, "acc": answer}, RATE)
        assert_found(read_frf(log, "current_force", "acc", band=BAND))


RINGING = Hammer(((62.0, 0.003, 1.0),), blows=5, seconds=1.0, gap=1.0, white=0.003)


def errors(hammer: Hammer, seeds: range) -> FloatArray:
    """Return the errors of ln f and ln ζ in stated standard deviations, a row for each record."""
    found = [read(hammer, seed).modes for seed in seeds]
    estimate = np.array([[*m.ln_frequency, *m.ln_damping] for m in found])
    std = np.array([np.sqrt(np.diag(m.cov)) for m in found])
    return np.asarray((estimate - np.log(hammer.modes[0][:2])) / std)


def test_a_mode_that_rings_into_the_next_blow_has_its_uncertainty(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Over 12 records errors are those stated; with rings as noise they are below a fifth."""
    seeds = range(300, 312)
    rms = np.sqrt(np.mean(errors(RINGING, seeds) ** 2, axis=0))
    assert ((rms > 0.7) & (rms < 1.2)).all(), rms
    monkeypatch.setattr(frequency_response, "without_rings", lambda *_: None)
    assert np.sqrt(np.mean(errors(RINGING, seeds[:4]) ** 2)) < 0.2


def ordinates_of(hammer: Hammer) -> tuple[Ordinates, float]:
    """Return the ordinates of blows, and the variance of the sensor's noise in them."""
    signals = strike(np.random.default_rng(5), hammer)
    log = make_log({"current_force": signals[0], "acc": signals[1]}, RATE)
    hits = find_hits(signals[0], RATE, certain=True)
    ordinates = from_blows(Pair(log, ("force", "acc"), signals, 0), hits, BAND)[1]
    sigma = hammer.white * np.abs(signals[1]).max()
    return ordinates, float(sigma**2 / (ordinates.spacing * RATE))


def test_without_rings_the_noise_is_that_of_the_sensor() -> None:
    """At resonances, too, where the scatter with rings is a hundred times as large."""
    ordinates, sensor = ordinates_of(RINGING)
    cleaned = without_rings(ordinates, np.array([62.0]), np.array([0.003]))
    assert cleaned is not None
    assert np.median(cleaned.noise) == pytest.approx(sensor, rel=0.1)
    near = np.abs(ordinates.frequency - 62) < 1.5
    assert cleaned.noise[near].mean() == pytest.approx(sensor, rel=0.4)
    assert ordinates.noise[near].mean() > 100 * sensor
    assert cleaned.freedom == ordinates.freedom


def test_blows_that_begin_at_rest_or_are_one_keep_their_scatter() -> None:
    """A mode that has faded at the next blow is no ring, nor is any where one blow is used."""
    f, zeta = np.array([[62.0, 130.0], [0.015, 0.01]])
    for blows in (1, 4):
        ordinates, _ = ordinates_of(Hammer(MODES, blows=blows))
        assert (ordinates.blows is None) == (blows == 1)
        assert without_rings(ordinates, f, zeta) is None
        assert without_rings(ordinates, f[:0], zeta[:0]) is None
