"""Identification: truth within its uncertainty, refusals with their reasons, invariances."""

from __future__ import annotations

import os
import tempfile
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from threadpoolctl import threadpool_info, threadpool_limits

from lmshealth.errors import BadLog
from lmshealth.io.buffers import MINUTE, Stored
from lmshealth.io.column_map import load_columns
from lmshealth.io.log import Channel, Log, Refusal
from lmshealth.io.reading import read_log
from lmshealth.modal import constants
from lmshealth.modal import identification as modal
from lmshealth.modal.ambient import cluster_fit
from lmshealth.modal.ambient.cluster_fit import fit_modes
from lmshealth.modal.ambient.cluster_modes import ClusterFit
from lmshealth.modal.ambient.search import Found, search, split_groups
from lmshealth.modal.identification import identify, read_ambient, read_modes
from lmshealth.modal.modes import Modes, Rejection
from lmshealth.modal.targets import Target
from lmshealth.signal import segments, spectra
from lmshealth.signal.spectra import LogSpectra
from studies.modes.frf import hammer
from studies.modes.without_description.worlds import Machine, log_of, record, shapes_of
from tests.bands import as_if_white
from tests.signals import (
    Mode,
    acceleration_log,
    accelerations,
    deviations,
    displacements,
    make_log,
    make_stage,
    sine,
    white,
)
from tests.stops import Ring, stop

RATE = 1000.0
LMS_Y = (("roll", 126.4, 0.0176), ("pitch", 136.6, 0.0151), ("yaw", 155.0, 0.0176))
ROLL = (("roll", 105.0, 0.015),)


def rng(seed: int = 1) -> np.random.Generator:
    """Return a generator."""
    return np.random.default_rng(seed)


def one_mode_log(seconds: float = 60.0, seed: int = 1, noise: float = 0.5) -> Log:
    """Make a log that shows one mode."""
    return acceleration_log(rng(seed), [Mode(105.0, 0.015)], seconds, RATE, noise)


def why(modes: Modes, name: str) -> str:
    """Return the reason for which a mode was refused."""
    (reason,) = {refusal.reason for refusal in modes.refused if refusal.mode == name}
    return reason


# Known truth


def test_one_mode_is_found_within_its_uncertainty() -> None:
    """Over 12 records f and ζ are within 4σ, and their mean square deviation is about one."""
    stage = make_stage(ROLL)
    off = np.array(
        [
            deviations(identify(one_mode_log(seed=seed), stage), "roll", 105.0, 0.015)
            for seed in range(12)
        ]
    )
    assert np.abs(off).max() < 4
    # 24 squares of about unit variance: 0.35 to 2.1 holds all but a thousandth.
    assert 0.35 < np.mean(off**2) < 2.1
    # Negative control: standard deviations three times too small would not do.
    assert np.mean((3 * off) ** 2) > 2.1


def test_two_modes_three_bandwidths_apart_keep_their_truth() -> None:
    """Two modes 3 half-power bandwidths apart are each within 4σ in f and ζ."""
    first, gap = 120.0, 3 * 2 * 0.018 * 120.0
    modes = [Mode(first, 0.018), Mode(first + gap, 0.018, 2.0)]
    stage = make_stage([("roll", first, 0.018), ("pitch", first + gap, 0.018)])
    for seed in range(4):
        found = identify(acceleration_log(rng(seed), modes, 60, RATE, 0.5), stage)
        assert found.names == ("roll", "pitch")
        assert np.abs(deviations(found, "roll", first, 0.018)).max() < 4
        assert np.abs(deviations(found, "pitch", first + gap, 0.018)).max() < 4


def test_two_modes_of_a_common_force_keep_their_truth() -> None:
    """Driven by the same force, modes interfere; f and ζ are within 4σ all the same."""
    modes = [Mode(120.0, 0.018), Mode(133.0, 0.018)]
    n = 60_000
    size = 4 * n
    frequency = np.arange(1, size // 2) * RATE / size
    force = rng(3).standard_normal((2, frequency.size)) * np.sqrt(RATE * size / 4)
    spectrum = np.zeros(size // 2 + 1, dtype=complex)
    total = modes[0].response(frequency) - 0.7 * modes[1].response(frequency)
    spectrum[1:-1] = total * (force[0] + 1j * force[1])
    values = np.fft.irfft(spectrum, size)[:n] + white(rng(4), 0.2, n, RATE)
    found = identify(
        make_log({"acc_a": values}, RATE),
        make_stage([("roll", 120.0, 0.018), ("pitch", 133.0, 0.018)]),
    )
    assert np.abs(deviations(found, "roll", 120.0, 0.018)).max() < 4
    assert np.abs(deviations(found, "pitch", 133.0, 0.018)).max() < 4


def lms_y_modes(shift: float = 1.0) -> list[Mode]:
    """Return three modes as the Y stage has them, in three channels of different shape."""
    shapes = ((1.0, 0.2, 0.5), (0.3, 1.0, 0.4), (0.1, 0.3, 1.0))
    return [
        Mode(f * shift, zeta, 1.0, shape) for (_, f, zeta), shape in zip(LMS_Y, shapes, strict=True)
    ]


def test_three_modes_of_a_stage_are_told_apart() -> None:
    """Roll, pitch and yaw are each within 4σ of their truth, and their order is by frequency."""
    found = identify(acceleration_log(rng(5), lms_y_modes(), 60, RATE, 0.5), make_stage(LMS_Y))
    assert found.names == ("roll", "pitch", "yaw")
    for name, f, zeta in LMS_Y:
        assert np.abs(deviations(found, name, f, zeta)).max() < 4
    assert np.linalg.eigvalsh(found.cov).min() > 0


@pytest.mark.parametrize("shift", [126.4 / 136.6, 136.6 / 126.4])
def test_worn_modes_keep_their_identity(shift: float) -> None:
    """Pitch standing where roll was new is still pitch, and the reverse."""
    log = acceleration_log(rng(6), lms_y_modes(shift), 60, RATE, 0.5)
    found = identify(log, make_stage(LMS_Y))
    assert found.names == ("roll", "pitch", "yaw")
    for name, f, zeta in LMS_Y:
        assert np.abs(deviations(found, name, f * shift, zeta)).max() < 4


@pytest.mark.slow
def test_an_undescribed_mode_takes_no_name() -> None:
    """Yaw is not described and stronger: roll and pitch stay, yaw is reported without a name."""
    modes = lms_y_modes()
    modes[2] = replace(modes[2], psd=30.0)
    log = acceleration_log(rng(7), modes, 60, RATE, 0.5)
    for shift in (1.0, 1.02):
        stage = make_stage([(name, f * shift, zeta) for name, f, zeta in LMS_Y[:2]])
        found = identify(log, stage)
        assert found.names == ("roll", "pitch")
        for name, f, zeta in LMS_Y[:2]:
            assert np.abs(deviations(found, name, f, zeta)).max() < 4
        (undescribed,) = [r for r in found.refused if r.reason == "undescribed"]
        assert undescribed.frequency == pytest.approx(155.0, rel=0.005)


def test_following_error_shows_a_mode_as_an_accelerometer_does() -> None:
    """From Δe alone, with its floor of white displacement noise, f and ζ are within 4σ."""
    quiet = 1.0 / (2 * np.pi * 105.0) ** 4
    values = displacements(rng(7), [Mode(105.0, 0.015)], 60_000, RATE, quiet)
    log = make_log({"delta_e": values[0]}, RATE)
    found = identify(log, make_stage(ROLL))
    assert found.sources == ("delta_e",)
    assert found.channels == ("delta_e",)
    assert np.abs(deviations(found, "roll", 105.0, 0.015)).max() < 4


def joint_log(seed: int, n: int = 20_000) -> Log:
    """Make a log of Δe and two accelerometers of one mode under one force."""
    mode = Mode(105.0, 0.015, 1.0, (1.0, 0.6))
    quiet = 0.5 / (2 * np.pi * 105.0) ** 4
    # The same seed makes the same force.
    x = displacements(rng(seed), [replace(mode, shape=(0.8,))], n, RATE, 0.0)[0]
    a = accelerations(rng(seed), [mode], n, RATE, 0.0)
    noise = rng(1000 + seed)
    signals = {f"acc_{k}": row + white(noise, 0.5, n, RATE) for k, row in enumerate(a)}
    return make_log({"delta_e": x + white(noise, quiet, n, RATE), **signals}, RATE)


@pytest.mark.slow
def test_following_error_and_accelerometers_are_one_source() -> None:
    """Where both show a mode, it is reported once, from all together, with its truth."""
    off = []
    for seed in range(8):
        found = identify(joint_log(seed), make_stage(ROLL))
        assert (found.names, found.sources) == (("roll",), ("joint",))
        off.append(deviations(found, "roll", 105.0, 0.015))
    assert np.abs(off).max() < 4
    # 16 squares of about unit variance: 2.5 is passed once in a thousand times.
    assert np.mean(np.square(off)) < 2.5


@pytest.mark.parametrize("noise", [(0.5, 0.5, 0.5), (0.5, 50.0, 0.05), (20.0, 0.05, 0.5)])
def test_shapes_are_accelerations_whatever_the_noise_of_each_channel(
    noise: tuple[float, float, float],
) -> None:
    """Shapes of three neighbours are within 0.05 of the truth, of unit norm, largest positive."""
    truth = np.array([[0.9, 0.6, -0.4], [0.5, -1.0, 0.7], [-0.6, 0.5, 1.0]])
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    modes = [Mode(f, z, 1.0, tuple(s)) for (_, f, z), s in zip(LMS_Y, truth, strict=True)]
    n = 60_000
    signals = accelerations(rng(4), modes, n, RATE, 0.0)
    named = zip("abc", signals, noise, strict=True)
    log = make_log({f"acc_{c}": x + white(rng(9), own, n, RATE) for c, x, own in named}, RATE)
    found = identify(log, make_stage(LMS_Y))
    assert found.names == ("roll", "pitch", "yaw")
    assert found.shape_channels == ("acc_a", "acc_b", "acc_c")
    expected = truth * np.sign(np.take_along_axis(truth, np.abs(truth).argmax(1)[:, None], 1))
    np.testing.assert_allclose(found.shapes, expected, rtol=0, atol=0.05)
    np.testing.assert_allclose(np.linalg.norm(found.shapes, axis=1), 1.0, rtol=1e-12)


def test_the_following_error_counts_as_an_acceleration_in_a_shape() -> None:
    """Δe of 0.8 with accelerometers of 1.0 and 0.6 has that share of the shape."""
    found = identify(joint_log(3, 60_000), make_stage(ROLL))
    assert found.shape_channels == ("acc_0", "acc_1", "delta_e")
    np.testing.assert_allclose(found.shapes, np.array([[1.0, 0.6, 0.8]]) / np.sqrt(2), atol=0.03)


def test_a_channel_that_shows_nothing_has_no_part_in_a_shape() -> None:
    """It is missing there, and what is left has unit norm."""
    seen = accelerations(rng(5), [Mode(105.0, 0.015, 1.0, (0.6, -0.8))], 30_000, RATE, 0.5)
    log = make_log({"acc_a": seen[0], "acc_b": np.full(30_000, 3.0), "acc_c": seen[1]}, RATE)
    found = identify(log, make_stage(ROLL))
    assert found.shape_channels == ("acc_a", "acc_b", "acc_c")
    np.testing.assert_allclose(found.shapes, [[-0.6, np.nan, 0.8]], atol=0.03)


@pytest.mark.slow
def test_more_channels_make_no_interval_wider_and_none_counts_for_itself() -> None:
    """Three channels are at least as sure as each, and the mode is not counted three times."""
    ratios = []
    for seed in range(8):
        log, stage = joint_log(seed), make_stage(ROLL)
        names = [channel.name for channel in log.channels]
        together = np.diag(identify(log, stage).cov)
        alone = [np.diag(identify(log, stage, channels=[name]).cov) for name in names]
        ratios.append(np.sqrt(together / np.min(alone, axis=0)))
    ratio = np.median(ratios, axis=0)
    assert (ratio < 1.05).all()
    # Channels counted as if they were independent would have deviations smaller by √3; those of
    # one alone determine its floor and static response less.
    assert (ratio > 0.7).all()


def test_the_floor_of_the_following_error_is_its_noise_also_in_short_moves() -> None:
    """At 20 kHz and moves of 0.67 s Δe has the SNR of its own noise, not of what leaks into it.

    White noise of an encoder, as acceleration, rises with the fourth power of frequency; it must
    not leak from the far end of the spectrum into the band of the modes.
    """
    rate, n = 20_000.0, 13_400
    level = 1 / (2 * np.pi * 130.0) ** 4
    mode = Mode(130.0, 0.02, 0.032)
    snr = []
    for seed in range(4):
        generator = rng(seed)
        moves = [displacements(generator, [mode], n, rate, level)[0] for _ in range(12)]
        pieces = [(k * n, (k + 1) * n) for k in range(12)]
        log = make_log({"delta_e": np.concatenate(moves)}, rate, pieces=pieces)
        found = identify(log, make_stage([("roll", 130.0, 0.02)]))
        assert found.names == ("roll",)
        snr.append(found.snr[0])
    # Under the skirts of the resonance one log determines the noise only to a factor of three.
    assert mode.snr(1.0) == pytest.approx(20)
    assert mode.snr(1.0) / 3 < np.median(snr) < mode.snr(1.0) * 3


def test_noise_of_the_encoder_beyond_the_band_hides_no_mode() -> None:
    """In 4 s of Δe at 20 kHz a mode is found in a band to 250 Hz, though noise rises to 10 kHz."""
    rate, mode = 20_000.0, Mode(130.0, 0.02, 0.1)
    level = 1 / (2 * np.pi * 130.0) ** 4
    for seed in range(3):
        values = displacements(rng(seed), [mode], 80_000, rate, level)[0]
        found = identify(make_log({"delta_e": values}, rate), band=(60.0, 250.0))
        assert found.names == ("mode_1",)
        assert np.abs(deviations(found, "mode_1", mode.frequency, mode.damping)).max() < 4


def short_moves(seed: int, n_moves: int = 7, seconds: float = 3.0) -> Log:
    """Make a log of separate short moves of one mode."""
    generator, n = rng(seed), round(seconds * RATE)
    parts = [
        accelerations(generator, [Mode(105.0, 0.015)], n, RATE, 0.5)[0] for _ in range(n_moves)
    ]
    pieces = [(k * n, (k + 1) * n) for k in range(n_moves)]
    return make_log({"acc_a": np.concatenate(parts)}, RATE, pieces=pieces)


@pytest.mark.slow
def test_short_moves_do_not_bias_the_damping() -> None:
    """Over 40 logs of 7 moves of 3 s the mean ln ζ is the truth within 4 standard errors."""
    stage = make_stage(ROLL)
    off, std = [], []
    for seed in range(40):
        found = identify(short_moves(seed), stage)
        off.append(found.ln_damping[0] - np.log(0.015))
        std.append(np.sqrt(found.cov[1, 1]))
    error = np.mean(std) / np.sqrt(len(off))
    # ln ζ itself is skewed: its mean lies below its mode by up to half its variance.
    assert abs(np.mean(off)) < 4 * error + np.mean(std) ** 2 / 2
    # Negative control: the 9 % by which a plain likelihood is off would be seen.
    assert 4 * error + np.mean(std) ** 2 / 2 < 0.16


def test_a_channel_that_does_not_see_a_mode_does_no_harm() -> None:
    """Of three channels two see nothing of roll; it comes from the third, with its truth."""
    modes = [Mode(105.0, 0.015, 1.0, (0.0, 1.0, 0.0))]
    found = identify(acceleration_log(rng(11), modes, 60, RATE, 0.5), make_stage(ROLL))
    assert found.channels == ("acc_1",)
    assert np.abs(deviations(found, "roll", 105.0, 0.015)).max() < 4


# Long records


def cut_after(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Cut records of RATE into parts of at most so many seconds."""
    monkeypatch.setattr(segments, "MINUTE", round(seconds * RATE))
    monkeypatch.setattr(spectra, "_LEAST_PART", round(seconds * RATE) // 2)


@pytest.mark.parametrize("kind", ["acc", "delta_e"])
def test_a_record_in_parts_says_what_it_says_as_a_whole(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Cut into ten, a record gives its modes within half a σ, and as sure within a tenth."""
    # How coloured the force may be is judged from fewer ordinates of the parts.
    monkeypatch.setattr(cluster_fit, "average_colours", as_if_white)
    quiet = 1.0 / (2 * np.pi * 105.0) ** 4
    make, noise = (accelerations, 0.5) if kind == "acc" else (displacements, quiet)
    modes = [Mode(105.0, 0.015), Mode(120.0, 0.02)]
    log = make_log({kind: make(rng(30), modes, 200_000, RATE, noise)[0]}, RATE)
    stage = make_stage([("roll", 105.0, 0.015), ("pitch", 120.0, 0.02)])
    whole = identify(log, stage)
    cut_after(monkeypatch, 20.0)
    found = identify(log, stage)
    assert found.names == ("roll", "pitch")
    std = np.sqrt(np.diag(whole.cov))
    np.testing.assert_allclose(np.sqrt(np.diag(found.cov)), std, rtol=0.1)
    off = np.concatenate(
        [found.ln_frequency - whole.ln_frequency, found.ln_damping - whole.ln_damping]
    )
    assert np.abs(off / std).max() < 0.5
    assert np.abs(deviations(found, "roll", 105.0, 0.015)).max() < 4


def test_modes_of_a_record_in_parts_are_found_without_a_description(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Three modes and no other are found in the mean over ten parts."""
    cut_after(monkeypatch, 20.0)
    modes = [Mode(60.0, 0.01), Mode(120.0, 0.02), Mode(210.0, 0.008)]
    found = identify(acceleration_log(rng(31), modes, 200, RATE, 0.2), band=(30.0, 400.0))
    assert found.names == ("mode_1", "mode_2", "mode_3")
    for name, mode in zip(found.names, modes, strict=True):
        assert np.abs(deviations(found, name, mode.frequency, mode.damping)).max() < 4


@pytest.mark.slow
def test_a_long_record_does_not_fill_the_memory() -> None:
    """Ten minutes at 20 kHz on disk are identified in less than four times one minute of them."""
    rate, n, f, zeta = 20_000.0, 10 * MINUTE, 120.0, 0.02
    # A resonator in two poles: near them it moves as the mode does.
    pole = np.exp(2j * np.pi * f / rate * (np.sqrt(1 - zeta**2) + 1j * zeta))
    generator, channels = rng(32), []
    for name in ("acc_a", "acc_b"):
        force = np.random.default_rng(33)  # one force moves both
        file = tempfile.TemporaryFile()  # noqa: SIM115
        state = np.zeros(2)
        for _ in range(n // MINUTE):
            moved, state = lfilter(
                [1e-3], [1, -2 * pole.real, abs(pole) ** 2], force.normal(size=MINUTE), zi=state
            )
            (moved + generator.normal(size=MINUTE)).tofile(file)
        file.flush()
        channels.append(Channel(name, "acceleration", Stored(file, n)))
    log = replace(make_log({"acc": np.zeros(n)}, rate), channels=tuple(channels))
    tracemalloc.start()
    try:
        found = identify(log, make_stage([("roll", f, zeta)]))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert found.names == ("roll",)
    assert found.frequency[0] == pytest.approx(f, rel=0.01)
    assert peak < 4 * len(channels) * MINUTE * 8


# Refusals


def test_white_noise_has_no_mode() -> None:
    """Of six records of noise none gives a mode, with a description or without."""
    stage = make_stage(LMS_Y)
    for seed in range(6):
        log = make_log({"acc_a": white(rng(seed), 1.0, 20_000, RATE)}, RATE)
        found = identify(log, stage)
        assert found.names == ()
        assert found.cov.shape == (0, 0)
        assert {why(found, name) for name, *_ in LMS_Y} == {"not-excited"}
        sought = identify(log, band=(20.0, 400.0))
        assert sought.names == ()
        assert [refusal.reason for refusal in sought.refused] == ["not-excited"]


def test_what_is_too_weak_for_a_mode_is_said_to_stand_out() -> None:
    """Without a description a peak that no fit bears out is named with what it lacks."""
    log = acceleration_log(rng(4), [Mode(120.0, 0.01)], 30.0, 1000.0, 1600.0)
    found = identify(log, band=(60.0, 200.0))
    assert found.names == ()
    (refusal,) = found.refused
    assert refusal.reason == "too-uncertain"
    assert refusal.detail.startswith("1 peak above the noise, of which none is a mode: 120.57")


def test_a_mode_that_is_not_there_is_refused_and_the_other_kept() -> None:
    """Without excitation of pitch only roll is found; the refusal quotes where it is described."""
    log = acceleration_log(rng(2), [Mode(105.0, 0.015, 1.0, (1.0, 0.5))], 60, RATE, 0.5)
    found = identify(log, make_stage([("roll", 105.0, 0.015), ("pitch", 125.0, 0.02)]))
    assert found.names == ("roll",)
    (refusal,) = found.refused
    assert (refusal.mode, refusal.reason) == ("pitch", "not-excited")
    assert "125 Hz in any channel" in refusal.detail


def test_a_mode_far_from_where_it_is_described_gets_no_name() -> None:
    """A resonance 19 % above a search of ±5 % is none of the description."""
    log = acceleration_log(rng(4), [Mode(125.0, 0.02, 1.0, (1.0, 1.0))], 60, RATE, 0.5)
    found = identify(log, make_stage([("roll", 105.0, 0.015)], search=0.05))
    assert found.names == ()
    assert why(found, "roll") == "not-excited"


def test_mains_are_a_line_and_no_mode() -> None:
    """A sine of 50 Hz in noise is no mode at 50 Hz, sought or not."""
    values = white(rng(12), 1.0, 60_000, RATE) + sine(60_000, RATE, 50.0, 3.0)
    log = make_log({"acc_a": values}, RATE)
    assert identify(log, make_stage([("hum", 50.5, 0.015)])).names == ()
    assert identify(log, band=(20.0, 400.0)).names == ()


@pytest.mark.parametrize("frequency", [105.0, 105.01])
def test_a_pure_sine_is_a_line_and_no_mode(frequency: float) -> None:
    """Without any noise a sine is refused as a mode, sought or not, and listed as a line."""
    log = make_log({"acc_a": sine(20_000, RATE, frequency, 30.0)}, RATE)
    sought = identify(log, make_stage(ROLL))
    assert sought.names == ()
    assert why(sought, "roll") in ("not-excited", "line-not-mode")
    anything = identify(log, band=(20.0, 400.0))
    assert anything.names == ()
    assert "lines, which are no modes" in anything.refused[0].detail
    (line,) = sought.lines
    assert line.frequency == pytest.approx(frequency, abs=0.02)
    assert line.amplitude == pytest.approx(30.0, rel=0.01)


@pytest.mark.parametrize("seed", range(8))
def test_a_strong_line_takes_no_name_from_a_mode(seed: int) -> None:
    """Mains at 150 Hz, near yaw, leave roll, pitch and yaw of 20 s their names and places."""
    log = acceleration_log(rng(100 + seed), lms_y_modes(), 20, RATE, 0.5)
    mains = sine(20_000, RATE, 150.0, 60.0)
    dirty = make_log({c.name: c.values + mains for c in log.channels}, RATE)
    found = identify(dirty, make_stage(LMS_Y))
    assert found.names == ("roll", "pitch", "yaw")
    for name, f, zeta in LMS_Y:
        assert np.abs(deviations(found, name, f, zeta)).max() < 4.5
    kinds = [line.kind for line in found.lines]
    assert "mains" in kinds
    # Thomson's test of three channels may find one by chance.
    assert kinds.count("mains") >= len(kinds) - 1


def test_a_record_too_short_names_the_seconds_needed() -> None:
    """The error quotes the seconds that the narrowest mode needs and those available."""
    with pytest.raises(BadLog, match=r"0\.635 s.*0\.3 s") as caught:
        identify(one_mode_log(0.3), make_stage(ROLL))
    assert caught.value.reason == "too-short"
    with pytest.raises(BadLog, match="needed are at least 50") as caught:
        identify(one_mode_log(0.3), band=(100.0, 110.0))
    assert caught.value.reason == "too-short"


def test_a_record_too_short_for_one_mode_shows_the_others() -> None:
    """A described mode that the record cannot resolve is refused by name, and no other is."""
    log = one_mode_log(20.0)
    stage = make_stage([("wide", 105.0, 0.015), ("narrow", 60.0, 0.0001)])
    found = identify(log, stage)
    assert found.names == ("wide",)
    assert why(found, "narrow") == "too-short"


def test_a_sample_rate_too_low_names_the_one_needed() -> None:
    """A mode above half the sample rate is no question for this log."""
    with pytest.raises(BadLog, match=r"needed is at least 1\d{3} Hz") as caught:
        identify(one_mode_log(), make_stage([("roll", 490.0, 0.03)]))
    assert caught.value.reason == "sample-rate"


def test_unknown_channels_are_named_with_those_there_are() -> None:
    """A channel that is not there is an error that lists what is."""
    with pytest.raises(BadLog, match=r"acc_9.*acc_0") as caught:
        identify(one_mode_log(), make_stage(ROLL), channels=["acc_9"])
    assert caught.value.reason == "channel"


def test_chosen_channels_are_the_only_ones_used() -> None:
    """With channels given, no estimate comes from another."""
    modes = [Mode(105.0, 0.015, 1.0, (1.0, 0.5))]
    log = acceleration_log(rng(16), modes, 60, RATE, 0.5)
    assert identify(log, make_stage(ROLL)).channels == ("acc_0",)
    assert identify(log, make_stage(ROLL), channels=["acc_1"]).channels == ("acc_1",)


def test_refused_channels_of_the_log_are_passed_on() -> None:
    """What the door refused is in the modes' refusals too."""
    from lmshealth.io.log import Refusal

    refusal = Refusal("synthetic.h5", "flat", "all samples are 0", channel="acc_dead")
    log = replace(one_mode_log(), refused=(refusal,))
    assert refusal in identify(log, make_stage(ROLL)).refused


# Without a description


def test_modes_are_found_in_a_band_and_named_in_order() -> None:
    """Three modes are found without a description, numbered upwards, within 4σ of the truth."""
    modes = [Mode(60.0, 0.01), Mode(120.0, 0.02), Mode(210.0, 0.008)]
    found = identify(acceleration_log(rng(17), modes, 60, RATE, 0.2), band=(30.0, 400.0))
    assert found.names == ("mode_1", "mode_2", "mode_3")
    for name, mode in zip(found.names, modes, strict=True):
        assert np.abs(deviations(found, name, mode.frequency, mode.damping)).max() < 4


def test_a_mode_on_the_flank_of_another_is_found_in_what_that_one_leaves_over() -> None:
    """One peak stands out of the noise, and both modes under it are read within 4σ."""
    modes = [Mode(30.0, 0.03), Mode(31.5, 0.01, 0.1)]
    found = identify(acceleration_log(rng(27), modes, 600, 250.0, 0.2), band=(20.0, 50.0))
    assert found.names == ("mode_1", "mode_2")
    for name, mode in zip(found.names, modes, strict=True):
        assert np.abs(deviations(found, name, mode.frequency, mode.damping)).max() < 4


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[LogSpectra, tuple[Target, ...]]]:
    """List the views and targets that are fitted."""
    seen: list[tuple[LogSpectra, tuple[Target, ...]]] = []

    def spy_found(
        view: LogSpectra,
        targets: tuple[Target, ...],
        band: tuple[float, float],
        noise: np.ndarray,
        static: float,
        *,
        out_of_phase: bool,
    ) -> ClusterFit:
        seen.append((view, targets))
        return fit_modes(view, targets, band, noise, static, out_of_phase=out_of_phase)

    monkeypatch.setattr(modal, "fit_modes", spy_found)
    return seen


def test_neighbours_of_a_group_are_fitted_with_it_but_published_once(
    fitted: list[tuple[LogSpectra, tuple[Target, ...]]],
) -> None:
    """Modes whose flanks reach into the band of others take part in two fits."""
    modes = [Mode(60.0, 0.04), Mode(120.0, 0.03), Mode(210.0, 0.03)]
    found = identify(acceleration_log(rng(25), modes, 60, RATE, 0.1), band=(30.0, 400.0))
    assert max(len(targets) for _, targets in fitted) > 1
    assert len(found.names) == 3
    for name, mode in zip(found.names, modes, strict=True):
        assert np.abs(deviations(found, name, mode.frequency, mode.damping)).max() < 4


@pytest.mark.parametrize("real", [False, True])
def test_shapes_out_of_phase_leave_modes_at_their_truth(
    real: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Channels that differ by up to 6° in phase: all within 4σ. Control: real shapes, far off."""
    turned = np.exp(1j * rng(1).uniform(-0.1, 0.1, (3, 4)))
    shapes = np.array([(1, -0.3, 0.2, 0.6), (0.25, 1, -0.4, 0.5), (0.3, 0.5, 1, -0.3)]) * turned
    modes = [
        Mode(f, zeta, 1.0, tuple(shape))
        for (f, zeta), shape in zip([(126, 0.015), (137, 0.015), (155, 0.018)], shapes, strict=True)
    ]
    if real:
        monkeypatch.setattr(constants, "QUADRATURE_SIGMAS", (np.inf, np.inf))
    off = []
    for seed in range(4):
        found = identify(acceleration_log(rng(seed), modes, 60.0, RATE, 0.5), make_stage(LMS_Y))
        for (name, _, _), mode in zip(LMS_Y, modes, strict=True):
            if name in found.names:
                off.append(np.abs(deviations(found, name, mode.frequency, mode.damping)).max())
    if real:
        assert max(off) > 10
    else:
        assert len(off) == 12 and max(off) < 4


@pytest.mark.parametrize("late", [1, 0])
def test_a_channel_that_is_late_is_left_out_by_name(late: int) -> None:
    """Its phase is that of no mode: others give the modes as without it; the control keeps it."""
    modes = [Mode(80.0, 0.006, 1.0, (1.0, 0.6, -0.7)), Mode(92.0, 0.008, 1.0, (0.6, -1.0, 0.5))]
    log = acceleration_log(rng(3), modes, 60.0, 400.0, 1e-2)
    rows = dict(zip("abc", (channel.values[:] for channel in log.channels), strict=True))
    rows["c"] = np.roll(rows["c"], late)
    found = identify(make_log(rows, 400.0), band=(60.0, 120.0))
    assert [r.channel for r in found.refused] == (["c"] if late else [])
    np.testing.assert_allclose(found.frequency, [80.0, 92.0], rtol=3e-3)


def test_spectra_reach_as_far_as_modes_are_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """For a mode of 105 Hz, a search of 15 % and eight damping ratios, it ends at 135 Hz."""
    ends: list[tuple[float, float]] = []

    def spy(view: LogSpectra, low: float, high: float, *others: Any) -> Found:
        ends.append((low, high))
        return search(view, low, high, *others)

    monkeypatch.setattr(modal, "search", spy)
    identify(one_mode_log(), make_stage(ROLL))
    low, high = 0.85 * 105.0 * (1 - 8 * 0.015), 1.15 * 105.0 * (1 + 8 * 0.015)
    assert ends == [(pytest.approx(low), pytest.approx(high))]


def test_lines_that_are_found_are_neither_sought_nor_fitted(
    fitted: list[tuple[LogSpectra, tuple[Target, ...]]],
) -> None:
    """Mains of 100 Hz that wander by 0.1 Hz are no candidate, and masked in every fit."""
    n = 60_000
    phase = 2 * np.pi * np.cumsum(100 + 0.1 * np.sin(2 * np.pi * np.arange(n) / 25_000)) / RATE
    values = accelerations(rng(26), [Mode(105.0, 0.015)], n, RATE, 0.5)[0] + 40.0 * np.sin(phase)
    found = identify(make_log({"acc_a": values}, RATE), band=(60.0, 200.0))
    assert found.names == ("mode_1",)
    assert fitted
    for view, targets in fitted:
        (spectrum,) = view.spectra
        near = np.abs(spectrum.frequency - 100.0) < 0.05
        assert near.any()
        assert not spectrum.free[near].any()
        assert all(abs(target.frequency - 100.0) > 1 for target in targets)


def test_a_very_light_damping_is_found_without_a_description() -> None:
    """A resonance of ζ = 0.2 % far above the noise is found in 60 s."""
    log = acceleration_log(rng(18), [Mode(120.0, 0.002)], 60, RATE, 1.0)
    found = identify(log, band=(40.0, 300.0))
    assert found.names == ("mode_1",)
    assert np.abs(deviations(found, "mode_1", 120.0, 0.002)).max() < 4


@pytest.mark.parametrize("damping", [0.0007, 0.001])
def test_a_light_mode_is_found_in_a_long_record(damping: float) -> None:
    """Thomson's test takes it for a line, but its amplitude and phase are random."""
    log = acceleration_log(rng(18), [Mode(100.0, damping)], 600.0, RATE, 1.0)
    found = identify(log, band=(40.0, 300.0))
    assert found.names == ("mode_1",)
    assert np.abs(deviations(found, "mode_1", 100.0, damping)).max() < 4


@pytest.mark.parametrize("phase_counts", [True, False])
def test_a_line_whose_amplitude_varies_is_no_mode(
    phase_counts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its phase is steady, its amplitude as random as a mode's. Control: the amplitude alone."""
    n, mode = 300_000, Mode(105.0, 0.015)
    pole = np.exp(-1 / (2.0 * RATE))
    varies = lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], rng(27).standard_normal(n))
    line = (1 + 0.7 * varies) * np.cos(2 * np.pi * 90.0 * np.arange(n) / RATE)
    values = accelerations(rng(23), [mode], n, RATE, 0.5)[0] + 10.0 * line
    if not phase_counts:
        monkeypatch.setattr(constants, "STEADY_PHASE", 2.0)
    found = identify(make_log({"acc_a": values}, RATE), band=(60.0, 200.0))
    assert len(found.names) == (1 if phase_counts else 2)


def test_mains_that_wander_are_no_mode_and_leave_the_others_alone() -> None:
    """Mains of 100 Hz that wander by 0.05 Hz are a line on the flank of a mode, and no mode."""
    n, mode = 60_000, Mode(105.0, 0.015)
    values = accelerations(rng(23), [mode], n, RATE, 0.5)[0]
    phase = 2 * np.pi * np.cumsum(100 + 0.05 * np.sin(2 * np.pi * np.arange(n) / 25_000)) / RATE
    clean, dirty = (
        identify(make_log({"acc_a": signal}, RATE), band=(60.0, 200.0))
        for signal in (values, values + 20.0 * np.sin(phase))
    )
    assert dirty.names == ("mode_1",)
    assert np.abs(deviations(dirty, "mode_1", mode.frequency, mode.damping)).max() < 4
    assert abs(dirty.ln_frequency[0] - clean.ln_frequency[0]) < np.sqrt(clean.cov[0, 0])
    assert "mains" in {line.kind for line in dirty.lines}


def test_segments_of_an_instant_are_passed_over() -> None:
    """A piece between two gaps, too short for the band to be seen in it, does no harm."""
    rate, mode = 20_000.0, Mode(60.0, 0.02)
    pieces = [(0, 200_000), (204_000, 204_050), (208_000, 408_000)]
    velocity = np.full(pieces[-1][1], 0.1)
    quiet = 1.0 / (2 * np.pi * 60.0) ** 4
    values = displacements(rng(24), [mode], velocity.size, rate, quiet)[0]
    log = make_log({"delta_e": values}, rate, velocity=velocity, pieces=pieces)
    assert min(s.stop - s.start for s in segments.find_segments(log, 0.0)) < 60
    found = identify(log, band=(30.0, 80.0))
    assert found.names == ("mode_1",)
    assert np.abs(deviations(found, "mode_1", mode.frequency, mode.damping)).max() < 4


def test_modes_outside_the_band_are_left_alone() -> None:
    """Only modes of the band are identified, with a description and without."""
    log = acceleration_log(rng(19), lms_y_modes(), 60, RATE, 0.5)
    assert identify(log, make_stage(LMS_Y), band=(130.0, 140.0)).names == ("pitch",)
    found = identify(log, band=(145.0, 165.0))
    assert all(145 < f < 165 for f in found.frequency)


# Invariances


@pytest.mark.slow
def test_the_order_of_channels_does_not_matter() -> None:
    """Permuted channels give the same modes to the last bit."""
    log = acceleration_log(rng(20), lms_y_modes(), 20, RATE, 0.5)
    turned = replace(log, channels=log.channels[::-1])
    for stage in (make_stage(LMS_Y), None):
        one, other = (identify(item, stage, band=(90.0, 200.0)) for item in (log, turned))
        assert one.names == other.names
        assert one.channels == other.channels
        np.testing.assert_array_equal(one.ln_frequency, other.ln_frequency)
        np.testing.assert_array_equal(one.cov, other.cov)
        np.testing.assert_array_equal(one.shapes, other.shapes)


@pytest.mark.parametrize("factor", [1e-6, 1e4])
def test_the_unit_of_the_signal_does_not_matter(factor: float) -> None:
    """Scaled signals give the same f, ζ and SNR, and covariances within 10⁻³."""
    log = acceleration_log(rng(21), lms_y_modes(), 20, RATE, 0.5)
    signals = {channel.name: factor * channel.values[:] for channel in log.channels}
    one, other = (identify(item, make_stage(LMS_Y)) for item in (log, make_log(signals, RATE)))
    assert one.names == other.names
    np.testing.assert_allclose(one.ln_frequency, other.ln_frequency, rtol=0, atol=1e-7)
    np.testing.assert_allclose(one.ln_damping, other.ln_damping, rtol=0, atol=1e-5)
    np.testing.assert_allclose(np.diag(one.cov), np.diag(other.cov), rtol=1e-3)
    np.testing.assert_allclose(one.snr, other.snr, rtol=1e-3)
    np.testing.assert_allclose(one.shapes, other.shapes, rtol=0, atol=1e-5)


def test_longer_records_are_surer() -> None:
    """Four times the record halves the standard deviations, within a third."""
    stage = make_stage(ROLL)
    short, long = (identify(one_mode_log(seconds, 22), stage) for seconds in (40.0, 160.0))
    ratio = np.sqrt(np.diag(short.cov) / np.diag(long.cov))
    np.testing.assert_allclose(ratio, 2.0, rtol=0.33)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_close_modes_of_unlike_shapes_are_one_or_two_and_not_none(seed: int) -> None:
    """A sixth of a half-power bandwidth apart: both, or one with the flag; right in either case."""
    modes = [
        Mode(126.0, 0.015, 1.0, (1.0, 0.4, 0.2, 0.6)),
        Mode(126.63, 0.015, 1.0, (0.4, -1.0, 0.5, -0.3)),
    ]
    found = identify(acceleration_log(rng(seed), modes, 30, RATE, 0.1), band=(80.0, 180.0))
    assert len(found.names) == 2 or found.flags == ("cluster",)
    off = np.abs(found.frequency[:, None] - [126.0, 126.63]).min(axis=1)
    assert (off < 4 * found.frequency_std).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_described_mode_as_narrow_as_a_line_is_none(seed: int) -> None:
    """Thomson's test takes a damping of 0.05 % for lines; a description states that it is none."""
    log = acceleration_log(rng(seed), [Mode(100.0, 5e-4)], 200, RATE, 1.0)
    modes = identify(log, make_stage([("m", 100.0, 5e-4)]))
    assert modes.names == ("m",)
    assert np.abs(deviations(modes, "m", 100.0, 5e-4)).max() < 4


@pytest.mark.parametrize("seed", [0, 1])
def test_a_narrow_mode_on_a_broad_one_is_another_mode(seed: int) -> None:
    """Within its half-power bandwidth, as of a light part on a damped machine: both are named."""
    modes = [Mode(100.0, 0.05, 1.0, (1.0, 0.3)), Mode(101.0, 0.003, 0.05, (0.3, 1.0))]
    log = acceleration_log(rng(seed), modes, 60, RATE, 0.01)
    found = identify(log, make_stage([("broad", 100.0, 0.05), ("narrow", 101.0, 0.003)]))
    assert sorted(found.names) == ["broad", "narrow"]
    for name, f, zeta in (("broad", 100.0, 0.05), ("narrow", 101.0, 0.003)):
        assert np.abs(deviations(found, name, f, zeta)).max() < 4


@pytest.mark.slow
def test_no_channel_of_a_long_record_is_unlike_the_others() -> None:
    """Of a quarter of an hour the errors of bins, not of channels, are significant."""
    for seed in range(3):
        own = rng(seed)
        modes = [Mode(f, 0.015, 1.0, tuple(own.standard_normal(3))) for f in (126.0, 136.0, 155.0)]
        found = identify(acceleration_log(own, modes, 900, RATE, 0.05), band=(80.0, 200.0))
        assert len(found.names) == 3
        assert "unlike-others" not in [row.reason for row in found.refused]


# Real measurements


@pytest.mark.slow
def test_a_building_in_the_wind_shows_its_three_modes(needs: Callable[[str], None]) -> None:
    """Without a description the first half hour gives the three published frequencies."""
    needs("data")
    path = Path(os.environ["LMSHEALTH_DATA"]) / "palisaden_building" / "Palisaden_dataset.npy"
    data = np.load(path, mmap_mode="r")[:180_000].astype(float)
    log = make_log({f"acc_{k}": data[:, k] for k in range(data.shape[1])}, 100.0)
    found = identify(log, band=(1.2, 3.5))
    assert len(found.names) == 3
    np.testing.assert_allclose(found.frequency, [1.88, 2.42, 2.69], rtol=5e-3)
    assert ((found.damping_ratio > 0.008) & (found.damping_ratio < 0.025)).all()


@pytest.mark.slow
def test_a_vibrating_machine_shows_its_modes_and_not_its_mains(
    needs: Callable[[str], None],
) -> None:
    """Without a description broad resonances stand out; mains and the motor's lines do not."""
    needs("data")
    (path,) = (Path(os.environ["LMSHEALTH_DATA"]) / "uff58_samples").glob("MPSTD*.uff")
    found = identify(read_log(path), band=(20.0, 200.0))
    assert found.frequency[0] == pytest.approx(40.5, rel=0.005)
    assert abs(found.damping_ratio[0] - 0.015) < 3 * found.damping_ratio_std[0]
    # 140 and 143 Hz overlap: one mode stands for both, and may lie between them. Which of the weak
    # modes beside it are found depends on how the processor rounds.
    (place,) = np.flatnonzero((found.frequency > 137) & (found.frequency < 146))
    f, std = found.frequency[place], found.frequency_std[place]
    assert 140 - 3 * std < f < 143 + 3 * std
    assert found.damping_ratio[place] < 0.05
    assert (found.damping_ratio > 0.01).all()
    assert np.abs(found.frequency - np.array([[50.0], [100.0], [150.0]])).min() > 1
    assert {50, 100} <= {round(line.frequency) for line in found.lines if line.kind == "mains"}


def test_a_model_frame_shows_its_first_mode(needs: Callable[[str], None], tmp_path: Path) -> None:
    """An export of another program, read through a column map, shows 3.69 Hz within 0.15 Hz."""
    needs("data")
    folder = Path(os.environ["LMSHEALTH_DATA"]) / "shake_3storey" / "open"
    (tmp_path / "map.toml").write_text(
        'sample_rate_hz = 120\n[columns]\nacc_x_m_s2 = "Acc_X"\nacc_y_m_s2 = "Acc_Y"\n'
        "[csv]\nskip_rows = 7\n"
    )
    log = read_log(
        folder / "Flexible_BonusEvent_1st.csv", columns=load_columns(tmp_path / "map.toml")
    )
    found = identify(log, make_stage([("first", 3.7, 0.03)], search=0.1))
    assert found.names == ("first",)
    assert found.frequency[0] == pytest.approx(3.69, abs=0.15)


@pytest.mark.parametrize("lonely", ["roll", "pitch"])
def test_a_lonely_resonance_is_not_named_by_guessing(lonely: str) -> None:
    """Where one of three close modes is excited, its name is not clear: refused, not guessed."""
    nominal = {"roll": 126.4, "pitch": 136.6, "yaw": 155.0}
    stage = make_stage([(name, f, 0.017) for name, f in nominal.items()])
    for seed in range(6):
        mode = Mode(nominal[lonely], 0.017)
        signal = accelerations(rng(seed), [mode], round(20 * RATE), RATE, 0.01)[0]
        found = identify(make_log({"acc_a": signal}, RATE), stage)
        assert found.names == ()
        assert {r.mode for r in found.refused} == set(nominal)
        assert "ambiguous" in {r.reason for r in found.refused}


@pytest.mark.parametrize("pair", [("roll", "yaw"), ("roll", "pitch"), ("pitch", "yaw")])
def test_two_of_three_modes_keep_their_names(pair: tuple[str, str]) -> None:
    """The distance between two resonances identifies them among three modes."""
    nominal = {"roll": 126.4, "pitch": 136.6, "yaw": 155.0}
    stage = make_stage([(name, f, 0.017) for name, f in nominal.items()])
    for seed in range(4):
        modes = [Mode(nominal[name], 0.017) for name in pair]
        signal = accelerations(rng(seed), modes, round(20 * RATE), RATE, 0.01)[0]
        found = identify(make_log({"acc_a": signal}, RATE), stage)
        assert found.names == pair


def test_a_silent_channel_has_no_mode_and_does_no_harm() -> None:
    """A channel of one value is passed over, alone with a reason, sought or not."""
    log = make_log({"acc_a": np.full(60_000, 3.0)}, RATE)
    assert identify(log, band=(20.0, 400.0)).refused[0].reason == "not-excited"
    assert why(identify(log, make_stage(ROLL)), "roll") == "not-excited"
    values = accelerations(rng(60), [Mode(105.0, 0.015)], 60_000, RATE, 0.5)[0]
    log = make_log({"acc_a": np.full(60_000, 3.0), "acc_b": values}, RATE)
    assert identify(log, make_stage(ROLL)).names == ("roll",)
    assert identify(log, band=(20.0, 400.0)).names == ("mode_1",)


def test_a_narrow_peak_is_not_fitted_with_a_broad_one() -> None:
    """Their bands overlap, but their widths differ by more than eight: each has its own cluster."""
    broad = Target("broad", 200.0, 0.0107, 0.05)
    narrow, alike = Target("narrow", 184.0, 0.0007, 0.02), Target("alike", 184.0, 0.008, 0.02)
    assert [len(group) for group in split_groups((narrow, broad))] == [1, 1]
    assert [len(group) for group in split_groups((alike, broad))] == [2]


@pytest.mark.slow
def test_a_record_in_parts_is_as_sure_as_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over 20 records σ is that of the whole record to 2 %, and estimates differ by less than σ/4.

    What is lost is resolution: in parts a half-power bandwidth holds 80 ordinates.
    """
    mode = Mode(100.0, 0.02, 1.0, (1.0, 0.6, -0.4))
    stage = make_stage([("roll", mode.frequency, mode.damping)])
    draws = rng(61)
    logs = [acceleration_log(draws, [mode], 160.0, 400.0, 1.0) for _ in range(20)]
    whole = [identify(log, stage) for log in logs]
    monkeypatch.setattr(segments, "MINUTE", 8000)
    monkeypatch.setattr(spectra, "_LEAST_PART", 8000)
    parts = [identify(log, stage) for log in logs]
    std, cut = (
        np.array([np.sqrt(np.diag(modes.cov)) for modes in found]) for found in (whole, parts)
    )
    estimates = [
        np.array([(*modes.ln_frequency, *modes.ln_damping) for modes in found])
        for found in (whole, parts)
    ]
    apart = (estimates[1] - estimates[0]) / std
    assert np.abs((cut / std).mean(axis=0) - 1).max() < 0.02
    assert apart.std(axis=0).max() < 0.25
    assert np.abs(apart.mean(axis=0)).max() < 0.1


def test_a_wide_band_is_searched_in_parts() -> None:
    """Modes over three decades are found without a band, each once and none lost between parts."""
    rate, seconds = 2000.0, 60.0
    # Parts end at 64.6 and 241.2 Hz.
    truth = [
        (6.0, 0.03),
        (64.6, 0.02),
        (120.0, 0.015),
        (126.0, 0.012),
        (242.0, 0.01),
        (640.0, 0.01),
    ]
    rng = np.random.default_rng(3)
    signal = 0.05 * rng.standard_normal(round(rate * seconds))
    for f, zeta in truth:
        pole = np.exp(2 * np.pi * f / rate * (-zeta + 1j * np.sqrt(1 - zeta**2)))
        force = rng.standard_normal(signal.size)
        moved = lfilter([1, -2, 1], np.poly([pole, pole.conj()]), force)
        signal += moved / moved.std()
    modes = identify(make_log({"acc_0": signal}, rate))
    assert modes.frequency == pytest.approx([f for f, _ in truth], rel=0.01)


@pytest.mark.parametrize(
    ("reason", "channel", "flagged"),
    [
        ("levels", "acc_a", True),
        ("rate", "time_s", True),
        ("levels", "acc_other", False),
        ("spikes", "acc_a", False),
        ("rate", "", False),
    ],
)
def test_warnings_flag_the_modes_that_they_concern(
    reason: str, channel: str, flagged: bool
) -> None:
    """A warning flags modes of its channel, and of all where it is about time, unless repaired."""
    log = one_mode_log(20.0)
    name = log.channels[0].name
    channel = name if channel == "acc_a" else channel
    log = replace(log, refused=(Refusal(log.name, reason, "as it is", channel=channel),))
    modes = identify(log, band=(90.0, 160.0))
    assert len(modes.names) == 1
    assert (reason in modes.flags[0].split()) == flagged


@pytest.mark.slow
def test_modes_outside_the_band_need_no_data(needs: Callable[[str], None]) -> None:
    """A mode of the search that left the spectra is not fitted: this band ended in a traceback."""
    needs("data")
    path = Path(os.environ["LMSHEALTH_DATA"]) / "outside_faults/crash_zero_weights.csv"
    modes = identify(read_log(path), band=(22.0, 45.0))
    assert all(22.0 <= f <= 45.0 for f in modes.frequency)


@pytest.mark.slow
def test_many_short_pieces_keep_the_damping(needs: Callable[[str], None]) -> None:
    """A log that lost samples 511 times shows the damping of the whole one."""
    needs("data")
    path = Path(os.environ["LMSHEALTH_DATA"]) / "outside_faults/klipper_lost_random.csv"
    modes = identify(read_log(path))
    upper = int(np.abs(modes.frequency - 78).argmin())
    error = modes.damping_ratio[upper] - 0.0238
    assert abs(error) < 3 * modes.damping_ratio_std[upper] and modes.snr.max() < 1e5


def _overflow(x: np.ndarray, bits: int, turns: float) -> np.ndarray:
    """Let a counter overflow whose range is so many times too small."""
    step = 2 * np.abs(x).max() / 2**bits / turns
    half = 2 ** (bits - 1)
    return ((np.round(x / step) + half) % (2 * half) - half) * step


def _with_gaps(x: np.ndarray, share: float, length: int, seed: int) -> np.ndarray:
    """Lose a share of the samples in gaps of a length."""
    starts = rng(seed).integers(0, x.size - length, round(share * x.size / length))
    lost = np.unique(starts[:, None] + np.arange(length))
    return np.where(np.isin(np.arange(x.size), lost), np.nan, x)


def _with_spikes(x: np.ndarray, seed: int) -> np.ndarray:
    """Add thirty single bad samples."""
    bad = rng(seed).choice(x.size, 30, replace=False)
    return x + np.where(np.isin(np.arange(x.size), bad), 20.0, 0.0)


@pytest.mark.parametrize(
    ("reason", "damage"),
    [
        ("", lambda x, k: np.round(x / 1e-3) * 1e-3),
        ("unwrapped", lambda x, k: x if k else _overflow(x, 16, 1.05)),
        ("unwrapped", lambda x, k: x if k else _overflow(x, 12, 1.4)),
        ("spikes", lambda x, k: _with_spikes(x, seed=k)),
        ("gaps", lambda x, k: _with_gaps(x, 0.005, 1, seed=k)),
        ("gaps", lambda x, k: _with_gaps(x, 0.03, 5, seed=0)),
    ],
    ids=["none", "few overflows", "many overflows", "bad samples", "single lost", "gaps of five"],
)
def test_faults_of_samples_are_named_and_leave_the_damping(
    tmp_path: Path, reason: str, damage: Callable[[np.ndarray, int], np.ndarray]
) -> None:
    """A mode of 96 Hz and 2 % is within 3σ whatever happened to its samples, and that is named."""
    mode = Mode(96.0, 0.02, 1.0, (1.0, -0.6))
    clean = accelerations(rng(), [mode], 60_000, 2000.0, 0.1)
    channels = {f"acc_{k}_m_s2": damage(x / x.std(), k) for k, x in enumerate(clean)}
    path = tmp_path / "log.csv"
    text = [",".join("nan" if np.isnan(x) else f"{x:.9g}" for x in row)
            for row in zip(*channels.values(), strict=True)]  # fmt: skip
    path.write_text("\n".join(["# sample_rate_hz: 2000", ",".join(channels), *text]))
    log = read_log(path)
    modes = identify(log, band=(60.0, 150.0))
    (found,) = modes.damping_ratio
    assert abs(found - 0.02) < 3 * modes.damping_ratio_std[0]
    assert {refusal.reason for refusal in log.refused} == ({reason} if reason else set())


# What a log carries decides how it is read.

STRUCK = ((62.0, 0.02, 1.0), (105.0, 0.015, -0.7))
STRUCK_STAGE = make_stage([(n, f, z) for n, (f, z, _) in zip("ab", STRUCK, strict=True)])


def struck_log(*, blows: int = 4, double: tuple[int, ...] = (), name: str = "current_force") -> Log:
    """Make a log of blows with two accelerometers, of which the second hardly shows mode a."""
    test = hammer.Hammer(STRUCK, blows, 1.0, white=0.03, double=double, share=(0.5, 0.7))
    force, first = hammer.strike(rng(), test)
    second = hammer.respond(((62.0, 0.02, 0.05), (105.0, 0.015, 1.0)), force)
    second = second + 0.003 * np.abs(second).max() * rng(2).standard_normal(second.size)
    return make_log({name: force, "acc_0": first, "acc_1": second}, hammer.RATE)


def stops_log(move: float, *, noise: float = 0.02) -> Log:
    """Make a log of four moves of so many seconds with a stop of one second after each."""
    still, values, velocity = 500, list[np.ndarray](), list[np.ndarray]()
    for k in range(4):
        moving = round(500 * move)
        ring = stop(rng(k), [Ring(62.0, 0.02, ambient=0.02)], still, 500.0, noise)[0]
        values += [rng(k + 9).standard_normal(moving), ring]
        velocity += [np.full(moving, 0.1), np.zeros(still)]
    signals = {"acc_0": np.concatenate(values)}
    return make_log(signals, 500.0, velocity=np.concatenate(velocity))


def test_blows_are_read_from_the_response_of_the_channel_that_shows_a_mode_best() -> None:
    """Both modes of a description are found within four standard deviations, once each."""
    reading = read_modes(struck_log(), STRUCK_STAGE)
    modes = reading.modes
    assert (modes.names, modes.sources) == (("a", "b"), ("frf", "frf"))
    assert modes.channels == ("acc_0", "acc_1")
    for name, (f, zeta, _) in zip(modes.names, STRUCK, strict=True):
        assert np.abs(deviations(modes, name, f, zeta)).max() < 4
    assert reading.spectra.channels == ("acc_0", "acc_1")
    assert identify(struck_log(), band=(30.0, 150.0)).names == ("mode_1", "mode_2")


def answer_of(force: np.ndarray, f: float, zeta: float = 0.01) -> np.ndarray:
    """Return the acceleration of a mode under a force, with a little noise."""
    pole = np.exp(2 * np.pi * f / RATE * (-zeta + 1j * np.sqrt(1 - zeta**2)))
    answer = lfilter([1, -2, 1], np.poly([pole, pole.conj()]).real, force)
    return np.asarray(answer + 0.3 * rng(round(f)).standard_normal(force.size))


@pytest.mark.parametrize("second", [130.0, 100.8])
def test_modes_that_one_channel_each_shows_are_all_identified(second: float) -> None:
    """Also where they are nearer than a half-power bandwidth; a silent channel is refused."""
    force = rng().standard_normal(30_000)
    signals = {"current_force": force, "acc_0": answer_of(force, 100.0)}
    signals |= {"acc_1": answer_of(force, second), "acc_2": rng(3).standard_normal(force.size)}
    modes = identify(make_log(signals, RATE), band=(70.0, 150.0))
    assert (modes.names, modes.channels) == (("mode_1", "mode_2"), ("acc_0", "acc_1"))
    for name, f in zip(modes.names, (100.0, second), strict=True):
        assert np.abs(deviations(modes, name, f, 0.01)).max() < 4.5
    assert [(row.channel, row.reason) for row in modes.refused] == [("acc_2", "coherence")]


def test_of_two_excitations_the_second_is_refused() -> None:
    """Only the response to the first is identified, and the log says so."""
    first, second = rng().standard_normal((2, 30_000))
    signals = {"current_excitation_x": first, "current_excitation_y": second}
    signals["acc_0"] = answer_of(first, 100.0) + answer_of(second, 130.0)
    modes = identify(make_log(signals, RATE), band=(70.0, 150.0))
    assert modes.frequency == pytest.approx([100.0], rel=1e-3)
    assert [(row.channel, row.reason) for row in modes.refused] == [
        ("current_excitation_y", "surplus")
    ]


def test_a_mode_of_a_response_that_may_be_several_has_no_name() -> None:
    """A hammer excites one of two modes whose searches overlap: tracking has to assign it."""
    force, answer = hammer.strike(rng(), hammer.Hammer(((62.0, 0.02, 1.0),), seconds=1.0))
    log = make_log({"current_force": force, "acc_0": answer}, hammer.RATE)
    modes = identify(log, make_stage([("low", 59.0, 0.02), ("high", 65.0, 0.02)]))
    assert (modes.names, modes.sources) == (("",), ("frf",))
    assert [(row.mode, row.reason) for row in modes.refused] == [
        ("low", "ambiguous"),
        ("high", "ambiguous"),
    ]


def test_a_servo_s_current_is_no_excitation() -> None:
    """Pulses of a motor's current are not blows: its log is identified as ambient."""
    modes = identify(struck_log(name="current_motor"), band=(30.0, 150.0))
    assert "frf" not in modes.sources


def test_blows_that_cannot_be_used_are_refused_and_ambient_vibration_is_read() -> None:
    """Every blow hits twice: the force is refused for that, and the log is none without modes."""
    log = struck_log(blows=3, double=(0, 1, 2))
    modes = identify(log, STRUCK_STAGE)
    (row,) = (row for row in modes.refused if row.channel == "current_force")
    assert row.reason == "double-hit"
    assert "frf" not in modes.sources


@pytest.mark.parametrize("more", [(), ("current",), ("current_force",)])
def test_ambient_logs_are_read_as_before(more: tuple[str, ...]) -> None:
    """Neither a servo's current nor a hammer at rest changes a bit of the modes."""
    log = one_mode_log(30.0)
    noise = Channel("", "current", rng(5).standard_normal(log.channels[0].values.size))
    own = tuple(replace(noise, name=name) for name in more)
    plain = read_ambient(log, make_stage(ROLL)).modes
    found = identify(replace(log, channels=(*log.channels, *own)), make_stage(ROLL))
    assert found.names == plain.names == ("roll",)
    np.testing.assert_array_equal(found.estimate, plain.estimate)
    np.testing.assert_array_equal(found.cov, plain.cov)
    assert found.refused == plain.refused


def test_a_log_that_only_moves_and_stops_is_read_from_its_decays() -> None:
    """Moves of 0.3 s are too short for the mode, its decays are not; those of 4 s are used."""
    stage = make_stage([("a", 62.0, 0.02)])
    log = stops_log(0.3)
    with pytest.raises(BadLog, match="too-short"):
        read_ambient(log, stage)
    modes = identify(log, stage)
    assert modes.names == ("a",)
    assert np.abs(deviations(modes, "a", 62.0, 0.02)).max() < 4
    moving = stops_log(4.0)
    assert identify(moving, stage).refused == read_ambient(moving, stage).modes.refused


def test_stops_that_excite_nothing_leave_the_log_too_short() -> None:
    """Where decays show no mode either, the refusal is that of the segments, with that of them."""
    log = stops_log(0.3, noise=50.0)
    refused = r"too-short.*no segment of constant velocity.*decays after stops: no resonance"
    with pytest.raises(BadLog, match=refused):
        identify(log, make_stage([("a", 62.0, 0.02)]))


def test_a_mode_that_became_a_line_beside_others_is_refused_as_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The mode of a group whose pole collapsed keeps its rejection though the others survive."""

    def collapsing(*given: Any, **options: Any) -> ClusterFit:
        fit = fit_modes(*given, **options)
        assert fit.modes is not None
        (line,) = [t.name for t in given[1] if abs(t.frequency - 136.6) < 2]
        rejection = Rejection("line-not-mode", "136.6 Hz", 136.6)
        kept = [name for name in fit.modes.names if name != line]
        return replace(fit, modes=fit.modes.keep(kept), rejected={line: rejection})

    monkeypatch.setattr(modal, "fit_modes", collapsing)
    log = acceleration_log(rng(5), lms_y_modes(), 60, RATE, 0.5)
    reading = read_ambient(log, make_stage(LMS_Y))
    assert reading.modes.names == ("roll", "yaw")
    assert why(reading.modes, "pitch") == "line-not-mode"
    assert [row.reason for row in reading.rejected] == ["line-not-mode"]


def test_a_line_at_a_mode_that_is_no_harmonic_costs_no_second_fit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The search for it finds nothing further, and its groups are those that were fitted."""
    plain, fitted = modal._fit_group, [0]

    def fit_group(*given: Any) -> list[ClusterFit]:
        fitted[0] += 1
        return plain(*given)

    log, stage = one_mode_log(), make_stage(ROLL)
    monkeypatch.setattr(modal, "_fit_group", fit_group)
    found, once = identify(log, stage), fitted[0]
    monkeypatch.setattr(modal, "_lines_at_modes", lambda _: [found.frequency[0]])
    again = identify(log, stage)
    assert fitted[0] == 2 * once
    np.testing.assert_array_equal(again.estimate, found.estimate)
    # Control: with a further harmonic the groups are fitted again.
    counts = iter((1, 0))
    monkeypatch.setattr(modal, "_n_harmonics", lambda _: next(counts))
    identify(log, stage)
    assert fitted[0] == 4 * once


def test_one_thread_of_linear_algebra_is_used() -> None:
    """Also from Python, where nobody has set a variable; the caller's number is back in the end."""

    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    seen = list[set[int]]()
    with threadpool_limits(2, user_api="blas"):
        read_modes(
            one_mode_log(8.0), band=(90.0, 120.0), progress=lambda *step: seen.append(threads())
        )
        assert {1} in seen and all(own == {1} for own in seen)
        assert threads() == {2}


@pytest.mark.parametrize("seed", [0, 2])
def test_no_fit_converges_to_a_strong_mode_below_the_described_band(seed: int) -> None:
    """A broad pole at the edge of the band describes its flank, and no fit reaches down to it."""
    r, f = np.random.default_rng(seed), np.array([62.0, 117.0, 131.0, 148.0])
    machine = Machine(
        f, np.array([0.01, 0.012, 0.015, 0.01]), np.array([1e5, 1e4, 1e4, 1e4]),
        shapes_of(r, 3, 4), shared=1.0, band=(90.0, 185.0),
    )  # fmt: skip
    log = log_of(record(r, "mode below", machine, 2000.0, 20.0))
    found = identify(log, make_stage([(f"m{k}", 1.004 * f[k], 0.012) for k in (1, 2, 3)]))
    assert found.names == ("m1", "m2", "m3")
    assert (np.abs(found.frequency - f[1:]) / found.frequency_std).max() < 4
