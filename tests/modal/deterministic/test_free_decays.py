"""Identification from free decays: identities, refusals, and a real beam."""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lmshealth.errors import BadLog, BadStage
from lmshealth.io.log import Log
from lmshealth.modal.deterministic.free_decays import identify_decays
from lmshealth.modal.modes import Modes
from lmshealth.signal.segments import Segment
from lmshealth.stage.description import Stage
from studies.modes.decays.beam import judge_beam, one_beam
from studies.modes.decays.cases import one_machine
from tests.signals import deviations, make_log, make_stage, sine
from tests.stops import Ring, ring, stop, stop_log, whole

RATE = 400.0
MODES = [("roll", 60.0, 0.01), ("pitch", 85.0, 0.01)]


def log_of(seed: int, rings: list[Ring] | None = None, n_stops: int = 3) -> Log:
    """Make a log of one-second decays."""
    rings = rings or [Ring(60.0, 0.01, ambient=0.03), Ring(85.0, 0.01, ambient=0.03)]
    return stop_log(np.random.default_rng(seed), rings, 1.0, RATE, 0.02, n_stops)


def of_pieces(log: Log, stage: Stage | None = None) -> Modes:
    """Identify a log each piece of which is a decay."""
    return identify_decays(log, stage, segments=whole(log))


def test_modes_of_a_description_are_found_with_their_names() -> None:
    """Two modes are found within their standard deviations, in order, with a covariance."""
    modes = of_pieces(log_of(1), make_stage(MODES))
    assert modes.names == ("roll", "pitch")
    assert modes.sources == ("acc", "acc")
    assert modes.channels == ("acc_0", "acc_0")
    for name, f, zeta in MODES:
        assert np.abs(deviations(modes, name, f, zeta)).max() < 4
    assert np.linalg.eigvalsh(modes.cov).min() > 0
    assert (modes.snr > 100).all()
    assert not modes.refused


def test_without_a_description_all_that_rings_is_numbered() -> None:
    """Modes are searched for in the whole band and numbered in ascending order."""
    modes = of_pieces(log_of(2))
    assert modes.names == ("mode_1", "mode_2")
    np.testing.assert_allclose(modes.frequency, [60.0, 85.0], rtol=2e-3)


@pytest.mark.slow
def test_the_unit_of_the_signal_does_not_matter() -> None:
    """A signal a million times smaller gives the same estimates and covariance."""
    log = log_of(3)
    small = make_log({"acc_0": 1e-6 * log.channels[0].values[:]}, RATE, pieces=log.pieces)
    one, two = (of_pieces(item, make_stage(MODES)) for item in (log, small))
    np.testing.assert_allclose(two.ln_frequency, one.ln_frequency, rtol=1e-7)
    np.testing.assert_allclose(two.cov, one.cov, rtol=1e-3, atol=1e-12)


def test_decays_without_noise_are_refused() -> None:
    """Calculated decays of two channels have no noise for a likelihood; the control has."""
    n, f = 200, 60.0
    time, rng = np.arange(n) / RATE, np.random.default_rng(0)
    decay = np.exp(-2 * np.pi * f * 0.01 * time)
    channels = {
        f"acc_{k}": np.concatenate(
            [a * decay * np.cos(2 * np.pi * f * time + p) for a, p in rng.random((2, 2))]
        )
        for k in range(2)
    }
    pieces = [(0, n), (n, 2 * n)]
    with pytest.raises(BadLog) as caught:
        of_pieces(make_log(channels, RATE, pieces=pieces))
    assert caught.value.reason == "not-identified"
    noisy = {name: x + 1e-3 * rng.standard_normal(x.size) for name, x in channels.items()}
    modes = of_pieces(make_log(noisy, RATE, pieces=pieces))
    np.testing.assert_allclose(modes.frequency, [f], rtol=1e-3)


def test_decays_are_those_after_the_moves_of_the_set_point() -> None:
    """A log that moves and stops twice is cut by its set point; motion is ignored."""
    rng = np.random.default_rng(4)
    n, still = 400, 400
    x, velocity = [], []
    for _ in range(2):
        x += [5 * rng.standard_normal(n), stop(rng, [Ring(60.0, 0.02)], still, RATE, 0.02)[0]]
        velocity += [np.full(n, 0.1), np.zeros(still)]
    log = make_log({"acc_0": np.concatenate(x)}, RATE, velocity=np.concatenate(velocity))
    modes = identify_decays(log, make_stage([("roll", 60.0, 0.02)]))
    assert np.abs(deviations(modes, "roll", 60.0, 0.02)).max() < 4


def test_given_segments_are_the_decays() -> None:
    """Only the segments that are named are looked at."""
    rng = np.random.default_rng(5)
    parts = [stop(rng, [Ring(f, 0.01)], 400, RATE, 0.02)[0] for f in (50.0, 60.0, 50.0)]
    log = make_log({"acc_0": np.concatenate(parts)}, RATE)
    modes = identify_decays(log, segments=[Segment(400, 800, 0.0)])
    np.testing.assert_allclose(modes.frequency, [60.0], rtol=1e-3)


@pytest.mark.slow
def test_decays_of_different_lengths_share_their_modes() -> None:
    """Long and short decays are used together, each on its own Fourier frequencies."""
    rng = np.random.default_rng(6)
    sizes = (400, 395, 300, 220)
    parts = [stop(rng, [Ring(60.0, 0.01, ambient=0.02)], n, RATE, 0.02)[0] for n in sizes]
    ends = np.cumsum((0, *sizes)).tolist()
    log = make_log({"acc_0": np.concatenate(parts)}, RATE, pieces=list(pairwise(ends)))
    everything, first = (
        identify_decays(log, make_stage(MODES[:1]), segments=segments)
        for segments in (whole(log), whole(log)[:1])
    )
    assert np.abs(deviations(everything, "roll", 60.0, 0.01)).max() < 4
    assert everything.frequency_std[0] < first.frequency_std[0]


@pytest.mark.slow
def test_a_following_error_rings_too() -> None:
    """A displacement shows the mode alone, and is not used for modes of accelerometers."""
    rng = np.random.default_rng(7)
    wave = stop(rng, [Ring(60.0, 0.01)], 400, RATE, 0.02)[0]
    error = 1e-6 * stop(rng, [Ring(60.0, 0.01)], 400, RATE, 0.02)[0]
    stage = make_stage(MODES[:1])
    alone = of_pieces(make_log({"delta_e": error}, RATE), stage)
    both = of_pieces(make_log({"delta_e": error, "acc_0": wave}, RATE), stage)
    assert alone.sources == ("delta_e",)
    assert both.sources == ("acc",)
    assert np.abs(deviations(alone, "roll", 60.0, 0.01)).max() < 4
    numbered = of_pieces(make_log({"delta_e": error, "acc_0": wave}, RATE))
    assert numbered.sources == ("acc",)


@pytest.mark.slow
def test_the_decay_begins_where_the_machine_is_linear() -> None:
    """An impact right after the stop is skipped; the frequency is that of the decay."""
    rng = np.random.default_rng(8)
    x = stop(rng, [Ring(60.0, 0.002)], 800, RATE, 0.01)[0]
    x[:60] += 2 * rng.standard_normal(60)
    modes = of_pieces(make_log({"acc_0": x}, RATE), make_stage([("roll", 60.0, 0.002)]))
    assert np.abs(deviations(modes, "roll", 60.0, 0.002)).max() < 4


@pytest.mark.slow
def test_a_softening_machine_gets_wide_intervals_or_none() -> None:
    """A frequency that rises by 1 % while the decay fades is refused or not taken for exact."""
    rng = np.random.default_rng(9)
    t = np.arange(800) / RATE
    fade = np.exp(-1.2 * t)
    phase = 2 * np.pi * np.cumsum(60 * (1 - 0.01 * fade)) / RATE
    x = fade * np.cos(phase) + 1e-3 * rng.standard_normal(t.size)
    try:
        modes = of_pieces(make_log({"acc_0": x}, RATE))
    except BadLog as error:
        assert error.reason in ("not-linear", "too-close", "line-not-mode", "too-uncertain")
        return
    strongest = int(np.argmax(modes.snr))
    f, std = modes.frequency[strongest], modes.frequency_std[strongest]
    assert 59.3 < f < 60.1
    # Least squares in white noise would claim about 1e-4 Hz.
    assert std > 5e-3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_two_modes_nearer_than_a_fourier_frequency_are_two(seed: int) -> None:
    """Where channels show them unlike; a later start of the decays would merge them."""
    rings = [Ring(85.0, 0.01, (1.0, 0.4)), Ring(86.7, 0.01, (0.4, -1.0))]
    log = stop_log(np.random.default_rng(seed), rings, 0.5, RATE, 0.1, 6)
    modes = of_pieces(log)
    assert modes.names == ("mode_1", "mode_2")
    for name, f in zip(modes.names, (85.0, 86.7), strict=True):
        assert np.abs(deviations(modes, name, f, 0.01)).max() < 4


def test_a_decay_beside_a_drift_is_found() -> None:
    """A stage that creeps after its stops by a hundred times the vibration still shows its mode."""
    log = log_of(3, [Ring(85.0, 0.01)], n_stops=4)
    (channel,) = log.channels
    drift = 200 * np.tile(np.arange(round(RATE)) / RATE, 4)
    modes = of_pieces(make_log({"acc_0": channel.values[:] + drift}, RATE, pieces=log.pieces))
    assert modes.names == ("mode_1",)
    assert np.abs(deviations(modes, "mode_1", 85.0, 0.01)).max() < 4


def test_a_following_error_adds_the_modes_that_accelerometers_do_not_show() -> None:
    """Also one that is little more than a half-power bandwidth from one of these."""
    rng = np.random.default_rng(4)
    first = stop_log(rng, [Ring(85.0, 0.01)], 1.0, RATE, 0.02, 4)
    second = stop_log(rng, [Ring(86.2, 0.01)], 1.0, RATE, 0.02, 4)
    error = 1e-6 * second.channels[0].values[:]
    signals = {"acc_0": first.channels[0].values[:], "delta_e": error}
    modes = of_pieces(make_log(signals, RATE, pieces=first.pieces))
    assert modes.channels == ("acc_0", "delta_e")
    assert modes.frequency == pytest.approx([85.0, 86.2], rel=1e-3)


def test_a_mode_on_the_flank_of_a_louder_one_is_found() -> None:
    """Where short decays leave no peak of its own, the fit of the louder mode's band finds it."""
    rings = [Ring(136.0, 0.015), Ring(155.0, 0.0175, (0.07,))]
    modes = of_pieces(stop_log(np.random.default_rng(16), rings, 0.5, RATE, 1e-3, 4))
    np.testing.assert_allclose(modes.frequency, [136.0, 155.0], rtol=2e-3)


def test_noise_is_refused_and_never_an_empty_success() -> None:
    """White noise: without a description an error, with one every mode refused by name."""
    x = np.random.default_rng(10).standard_normal(2000)
    log = make_log({"acc_0": x}, RATE)
    with pytest.raises(BadLog) as error:
        of_pieces(log)
    assert error.value.reason == "not-excited"
    modes = of_pieces(log, make_stage(MODES))
    assert modes.names == ()
    assert {(r.mode, r.reason) for r in modes.refused} == {
        ("roll", "not-excited"),
        ("pitch", "not-excited"),
    }


@pytest.mark.slow
def test_a_sine_is_a_line_and_not_a_mode() -> None:
    """Mains does not fade: it is refused as a line, and a neighbouring mode is found."""
    rng = np.random.default_rng(11)
    x = stop(rng, [Ring(60.0, 0.01)], 800, RATE, 0.02)[0] + sine(800, RATE, 70.13, 0.5)
    modes = of_pieces(make_log({"acc_0": x}, RATE))
    np.testing.assert_allclose(modes.frequency, [60.0], rtol=1e-3)
    only = make_log({"acc_0": sine(800, RATE, 70.13, 0.5) + 0.02 * rng.standard_normal(800)}, RATE)
    with pytest.raises(BadLog) as error:
        of_pieces(only)
    assert error.value.reason == "line-not-mode"


@pytest.mark.slow
def test_ambient_vibration_is_no_decay() -> None:
    """A stationary response of a lightly damped mode is refused: no stop has excited it."""
    reasons = []
    for seed in range(12):
        rng = np.random.default_rng([12, seed])
        x = stop(rng, [Ring(60.0, 0.005, (1e-9,), 1e9)], 400, RATE, 0.05)[0]
        modes = of_pieces(make_log({"acc_0": x}, RATE), make_stage([("roll", 60.0, 0.005)]))
        reasons += [r.reason for r in modes.refused]
        assert modes.names == ()
    assert set(reasons) <= {"not-excited", "line-not-mode", "too-uncertain", "too-close"}


def test_a_mode_outside_its_search_is_not_taken_for_it() -> None:
    """A resonance 20 % off is not the mode that was sought within 15 %."""
    modes = of_pieces(log_of(13, [Ring(72.0, 0.01)]), make_stage(MODES[:1]))
    assert modes.names == ()
    assert modes.refused[0].reason == "not-excited"


def test_which_of_two_resonances_a_name_means_is_not_guessed() -> None:
    """Two resonances on both sides of one target: refused as ambiguous."""
    rings = [Ring(57.0, 0.01), Ring(63.2, 0.01)]
    modes = of_pieces(log_of(14, rings), make_stage(MODES[:1]))
    assert [r.reason for r in modes.refused] == ["ambiguous"]


def test_beside_a_resonance_that_nobody_described_the_one_at_the_description_is_the_mode() -> None:
    """Of a machine that stands at its description; control: the other one alone may be worn."""
    stage = make_stage(MODES[:1])
    both = of_pieces(log_of(14, [Ring(53.2, 0.01), Ring(60.0, 0.01)]), stage)
    assert both.names == ("roll",)
    np.testing.assert_allclose(both.frequency, [60.0], rtol=1e-3)
    assert of_pieces(log_of(14, [Ring(53.2, 0.01)]), stage).names == ("roll",)


def test_a_refused_resonance_leaves_its_name_to_no_weaker_one() -> None:
    """A mode at its description, whose damping one stop does not show, is refused as that."""
    rings = [Ring(53.2, 0.01), Ring(60.0, 0.0015, (3.0,), ambient=0.2)]
    modes = of_pieces(log_of(15, rings, n_stops=1), make_stage([("roll", 60.0, 0.002)]))
    assert modes.names == ()
    assert [(r.mode, r.reason) for r in modes.refused] == [("roll", "line-not-mode")]


def test_what_cannot_be_analysed_is_said() -> None:
    """Too short decays, too slow a sample rate, no channel, no mode in the band, no stop."""
    log = log_of(15)
    stage = make_stage(MODES)
    with pytest.raises(BadLog, match="too-short"):
        identify_decays(log, stage, segments=[Segment(0, 30, 0.0)])
    # Half a second is used of a decay, which more recording does not lengthen.
    with pytest.raises(BadLog, match=r"no more than 0\.5 s after a stop"):
        identify_decays(log, make_stage([("a", 20.0, 0.01)]), segments=[Segment(0, 200, 0.0)])
    with pytest.raises(BadLog, match="sample-rate"):
        of_pieces(log, make_stage([("high", 180.0, 0.01)]))
    with pytest.raises(BadLog, match="channel"):
        identify_decays(log, stage, channels=["nothing"])
    with pytest.raises(BadLog, match="no-signal"):
        identify_decays(log, stage, channels=[])
    with pytest.raises(BadStage):
        identify_decays(log, stage, segments=whole(log), band=(100.0, 150.0))
    with pytest.raises(BadLog, match="no-set-point"):
        identify_decays(log, stage)
    moving = make_log({"acc_0": np.zeros(800)}, RATE, velocity=np.full(800, 0.1))
    with pytest.raises(BadLog, match="no-such-part"):
        identify_decays(moving, stage)


@pytest.mark.slow
def test_a_real_beam_gives_its_frequencies(needs: Callable[[str], None]) -> None:
    """Dwells of a beam on a roller: right to 0.15 Hz or refused, and so is the unexcited first."""
    needs("data")
    rows = one_beam(Path(os.environ["LMSHEALTH_DATA"]), 0)
    assert len(rows) == 11
    assert all(judge_beam(rows).values()), rows
    assert rows[0]["refused"] == "not-excited"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lms-x", "lms-y"])
def test_simulated_stages_tell_their_modes_after_a_stop(name: str) -> None:
    """A stage with all its modes, its loop and mains: what is not refused is right."""
    rows = one_machine(name, 0)
    seen = [row for row in rows if row["f_hz"] is not None]
    assert len(seen) > len(rows) / 2
    for row in seen:
        assert row["nearest"] == row["mode"], row
        assert max(abs(row["z_f"]), abs(row["z_zeta"])) < 4, row


@pytest.mark.slow
def test_a_mode_that_creeps_ends_in_no_runaway_pole() -> None:
    """A frequency that settles after the stop sends no pole to infinity, and is found."""
    rng = np.random.default_rng(3)
    rate, t = 1000.0, np.arange(500) / 1000.0
    creeping = 26.2 * (1 + 5e-4 * np.exp(-t / 0.1))
    phase = 2 * np.pi * np.cumsum(creeping) / rate + rng.uniform(0, 2 * np.pi)
    fading = np.exp(-2 * np.pi * 26.2 * 0.007 * t) * np.cos(phase)
    second = ring(24.1, 0.01, 0.3, rng.uniform(0, 2 * np.pi), 500, rate)
    noise = 1e-4 * rng.standard_normal((2, 500))
    log = make_log(
        {"acc_0": fading + second + noise[0], "acc_1": 1.4 * fading + 0.8 * second + noise[1]}, rate
    )
    stage = make_stage([("beam", 33.0, 0.002)], search=0.3)
    modes = identify_decays(log, stage, segments=whole(log))
    # Within what it creeps by.
    assert modes.frequency == pytest.approx([26.2], rel=5e-4)
