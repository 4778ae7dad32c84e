"""FRF logs: modes of simulated and real machines, and refusals."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import chirp

from lmshealth.errors import BadLog
from lmshealth.io.column_map import load_columns
from lmshealth.io.log import Channel, Log, Refusal
from lmshealth.io.reading import read_log
from lmshealth.modal.deterministic.frequency_response import FrfReading, read_frf
from lmshealth.modal.naming import name_response, why_unnamed
from lmshealth.stage.description import load_stage
from models.dynamics.stages import stage_named
from models.recordings.formats import write_log
from models.recordings.sweep import Sweep, record_sweep, without_loop
from studies.modes.frf.records import (
    BAND,
    BENCH,
    GUIDE,
    MAPS,
    MODES,
    RATE,
    Machine,
    at_random,
    multisine,
    periodic,
)
from studies.modes.frf.responses import scatter_over_periods
from tests.signals import make_log

SIZE = 1600


def driven(
    machine: Machine | None = None, *, periods: int = 6, seed: int = 1, random: bool = False
) -> Log:
    """Make a log of a machine under a multisine, or under white noise."""
    rng, machine = np.random.default_rng(seed), machine or Machine()
    signals = (
        at_random(rng, machine, periods * SIZE) if random else periodic(rng, machine, SIZE, periods)
    )
    output = "delta_e" if machine.displacement else "acc_x"
    return make_log({"current": signals[0], output: signals[1]}, RATE)


def off(reading: FrfReading) -> np.ndarray:
    """Return the errors of the two modes of the band in standard deviations, shape (2, 2)."""
    modes = reading.modes
    assert modes.names == ("mode_1", "mode_2"), modes.frequency
    truth = np.log([[f for f, _, _ in MODES[:2]], [zeta for _, zeta, _ in MODES[:2]]])
    std = np.sqrt(np.diag(modes.cov)).reshape(2, 2)
    return np.asarray((np.array([modes.ln_frequency, modes.ln_damping]) - truth) / std)


# Simulated machines


@pytest.mark.slow
@pytest.mark.parametrize("displacement", [False, True])
@pytest.mark.parametrize("random", [False, True])
def test_modes_are_found_with_their_uncertainty(random: bool, displacement: bool) -> None:
    """Accelerations and displacements, periodic or not: within four standard deviations."""
    machine = Machine(displacement=displacement, white=0.01 if displacement else 0.1)
    reading = read_frf(driven(machine, random=random), "current", driven_name(machine), band=BAND)
    assert np.abs(off(reading)).max() < 4
    assert (reading.modes.frequency_std < 0.002 * reading.modes.frequency).all()
    assert set(reading.modes.sources) == {"frf"}
    assert set(reading.modes.channels) == {driven_name(machine)}
    assert np.isnan(reading.frf.period) == random


def test_hum_in_a_random_force_does_not_narrow_the_band() -> None:
    """A line of half the force's standard deviation: where the force excites is still known."""
    log = driven(random=True)
    force = next(c.values[:] for c in log.channels if c.name == "current")
    hum = 0.5 * force.std() * np.sin(2 * np.pi * 50 * np.arange(force.size) / RATE)
    channels = tuple(
        replace(c, values=force + hum) if c.name == "current" else c for c in log.channels
    )
    frf = read_frf(replace(log, channels=channels), "current", "acc_x", band=BAND).frf
    assert frf.frequency[-1] - frf.frequency[0] > 0.8 * (BAND[1] - BAND[0])


def driven_name(machine: Machine) -> str:
    """Name the sensor's channel."""
    return "delta_e" if machine.displacement else "acc_x"


@pytest.mark.slow
def test_a_random_input_needs_no_whole_number_of_anything() -> None:
    """A stretch of a longer record, with a transient at both ends."""
    log = driven(random=True, periods=5)
    cut = make_log({c.name: c.values[123:-77] for c in log.channels}, RATE)
    assert np.abs(off(read_frf(cut, "current", "acc_x", band=BAND))).max() < 4


@pytest.mark.slow
def test_without_noise_the_modes_are_exact() -> None:
    """Only modes outside the band keep a simulation from being fitted to rounding."""
    modes = read_frf(driven(Machine(white=0.0, process=0.0)), "current", "acc_x", band=BAND).modes
    assert modes.frequency == pytest.approx([62, 90], rel=1e-6)
    assert modes.damping_ratio == pytest.approx([0.015, 0.02], rel=1e-4)


@pytest.mark.slow
def test_units_do_not_matter_to_modes() -> None:
    """Volts for amperes, angles for lengths: the same modes with the same uncertainty."""
    log = driven()
    scaled = make_log({c.name: c.values[:] * 1e4 for c in log.channels}, RATE)
    scaled = replace(scaled, channels=(log.channels[0], scaled.channels[1]))
    one, other = (read_frf(item, "current", "acc_x", band=BAND).modes for item in (log, scaled))
    np.testing.assert_allclose(other.ln_frequency, one.ln_frequency, rtol=1e-6)
    np.testing.assert_allclose(other.cov, one.cov, rtol=1e-3)


def test_the_default_band_is_where_the_input_is_excited() -> None:
    """A multisine of 40 to 120 Hz is used from end to end, beyond it there are no lines."""
    frf = read_frf(driven(), "current", "acc_x").frf
    assert frf.frequency[[0, -1]] == pytest.approx([40, 120], abs=0.3)


@pytest.mark.slow
def test_a_part_of_a_period_does_not_move_the_default_band() -> None:
    """A sweep downwards, louder below, ends at the same line from 5 periods and from 4.4."""
    t = np.arange(SIZE) / RATE
    given = np.tile(chirp(t, 5, SIZE / RATE, 180, method="logarithmic")[::-1], 6)
    signals = Machine().noise(np.random.default_rng(7), given, Machine().answer(given))
    ends = [
        read_frf(make_log({"current": signals[0][cut:], "acc_x": signals[1][cut:]}, RATE),
                 "current", "acc_x").frf.frequency[-1]
        for cut in (SIZE, 2560)
    ]  # fmt: skip
    assert ends[0] == pytest.approx(ends[1])


def test_a_period_off_by_half_a_percent_is_put_right() -> None:
    """A stated period is taken for what it is: about right."""
    log = driven()
    stated = read_frf(log, "current", "acc_x", band=BAND, period=1.005 * SIZE / RATE)
    assert stated.frf.period == pytest.approx(SIZE / RATE, rel=1e-6)
    assert np.abs(off(stated)).max() < 4


@pytest.mark.slow
def test_a_period_that_is_no_whole_number_of_samples_is_cut_right() -> None:
    """Sampled by a clock that is 0.02 % slow, the modes are 0.02 % high and as certain."""
    rng = np.random.default_rng(3)
    given = multisine(rng, SIZE)
    answer = Machine().answer(given)
    period, n = SIZE * 1.0002, 6 * SIZE
    place = np.arange(n) / period
    line = np.arange(160, 481)

    def sampled(values: np.ndarray) -> np.ndarray:
        spectrum = np.fft.rfft(values)[line] * 2 / SIZE
        return (np.exp(2j * np.pi * np.outer(place, line)) @ spectrum).real

    noise = 0.1 * answer.std() * rng.standard_normal(n)
    log = make_log({"current": sampled(given), "acc_x": sampled(answer) + noise}, RATE)
    reading = read_frf(log, "current", "acc_x", band=BAND)
    assert reading.frf.period * RATE == pytest.approx(period, abs=0.01)
    slow = np.exp(reading.modes.ln_frequency) * 1.0002
    truth = [f for f, _, _ in MODES[:2]]
    assert (np.abs(slow - truth) / reading.modes.frequency_std).max() < 4
    assert reading.frf.std.mean() == pytest.approx(
        read_frf(driven(Machine(process=0.0)), "current", "acc_x", band=BAND).frf.std.mean(),
        rel=0.3,
    )


@cache
def _sweep(tmp: Path) -> Log:
    stage = stage_named("lms-y")
    sweep = Sweep(100.0, 175.0, amplitude=0.3, period=2.0)
    recording = record_sweep(stage, sweep, seconds=8.0, rng=np.random.default_rng(5))
    write_log(recording, tmp / "sweep.h5", "hdf5")
    return read_log(tmp / "sweep.h5")


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """Sweep a simulated stage while it moves."""
    return _sweep(tmp_path_factory.mktemp("sweep"))


@pytest.mark.parametrize("output", ["delta_e", "acc_feed", "acc_pitch"])
def test_a_sweep_shows_the_modes_of_the_closed_loop(sweep: Log, output: str) -> None:
    """Every sensor gives pitch within four standard deviations, better than 0.02 Hz."""
    mode, _ = without_loop(stage_named("lms-y"))["pitch"]
    modes = read_frf(sweep, "current_excitation", output).modes
    i = int(np.argmin(np.abs(modes.frequency - mode.frequency_hz)))
    std = np.sqrt(np.diag(modes.cov))[[i, i + len(modes.names)]]
    error = np.array([modes.ln_frequency[i], modes.ln_damping[i]])
    error -= np.log([mode.frequency_hz, mode.damping_ratio])
    assert np.abs(error / std).max() < 4
    assert modes.frequency_std[i] < 0.02


@pytest.mark.slow
def test_the_whole_current_shows_the_machine_without_its_servo(sweep: Log) -> None:
    """Fed back, a current that sensors cause is no input: poles are those of the open loop."""
    closed, alone = without_loop(stage_named("lms-y"))["pitch"]
    modes = read_frf(sweep, "current", "acc_feed").modes
    i = int(np.argmin(np.abs(modes.frequency - closed.frequency_hz)))
    assert abs(modes.frequency[i] - abs(alone) / (2 * np.pi)) < 4 * modes.frequency_std[i]
    assert abs(modes.frequency[i] - closed.frequency_hz) > 4 * modes.frequency_std[i]


@pytest.mark.slow
def test_a_resonance_beyond_the_band_leaves_no_lines_at_its_end(tmp_path: Path) -> None:
    """Pitch of X at 271.6 Hz bends what is below 250 Hz; those lines are answers all the same."""
    sweep = Sweep(20.0, 1000.0, amplitude=0.3, period=4.1)
    recording = record_sweep(stage_named("lms-x"), sweep, seconds=14.0,
                             rng=np.random.default_rng([100, 42]))  # fmt: skip
    write_log(recording, tmp_path / "sweep.h5", "hdf5")
    log = read_log(tmp_path / "sweep.h5")
    reading = read_frf(log, "current_excitation", "delta_e", band=(18.0, 250.0))
    assert not (reading.fit.outliers[:, 0] > 230).any()
    assert reading.modes.frequency[0] == pytest.approx(47.6, abs=4 * reading.modes.frequency_std[0])


@pytest.mark.parametrize(
    ("damping", "step", "found"),
    [(0.05, 30, True), (0.05, 40, True), (0.015, 8, True), (0.015, 10, False), (0.015, 16, False)],
)
def test_few_lines_show_a_mode_or_are_the_reason_why_not(
    damping: float, step: int, found: bool
) -> None:
    """Three lines in three half-power bandwidths of 77 Hz are enough, lines 2 to 10 Hz apart."""
    log = sparse(damping, step)
    modes = read_frf(log, "current", "acc_x", band=(8, 180)).modes
    if found:
        assert modes.frequency == pytest.approx([77], abs=4 * modes.frequency_std[0])
        assert modes.damping_ratio == pytest.approx([damping], abs=4 * modes.damping_ratio_std[0])
        return
    assert modes.names == ()
    (refused,) = modes.refused
    assert (refused.reason, refused.mode[:2]) == ("too-few-lines", "77")
    width = 2 * damping * 77
    assert f"excite lines at most {width:.2g} Hz apart (now {step / 4:.3g} Hz)" in refused.detail
    assert f"period of at least {1 / width:.2g} s" in refused.detail


def sparse(
    damping: float, step: int, modes: tuple[tuple[float, float, float], ...] | None = None
) -> Log:
    """Make a log of one mode of 77 Hz, or others, excited at every so many 0.25 Hz."""
    rng = np.random.default_rng(1)
    line = np.zeros(SIZE // 2 + 1, dtype=complex)
    line[32 : 4 * 180 + 1 : step] = 1
    given = np.fft.irfft(line * np.exp(2j * np.pi * rng.uniform(size=line.size)), SIZE)
    machine = Machine(modes=modes or ((77.0, damping, 1.0),), white=0.001, process=0.0)
    signals = machine.noise(rng, np.tile(given, 6), np.tile(machine.answer(given), 6))
    return make_log({"current": signals[0], "acc_x": signals[1]}, RATE)


# What cannot be read


def refusal(log: Log, *names: str, **options: object) -> BadLog:
    """Read a log that is refused."""
    with pytest.raises(BadLog) as caught:
        read_frf(log, *names, **options)  # type: ignore[arg-type]
    return caught.value


def test_a_name_is_given_where_there_is_no_doubt(tmp_path: Path) -> None:
    """A mode alone in one search gets the name; two in one search, or one in two, get none."""
    modes = replace(read_frf(driven(), "current", "acc_x", band=BAND).modes, names=("a", "b"))

    why: list[str] = []

    def named(*looked_for: tuple[str, float, float]) -> tuple[str, ...]:
        text = 'name = "m"\n[match]\nstage = "M"\n' + "".join(
            f'[[mode]]\nname = "{name}"\nfrequency_hz = {f}\ndamping_ratio = 0.01\nsearch = {s}\n'
            for name, f, s in looked_for
        )
        (tmp_path / "stage.toml").write_text(text)
        stage = load_stage(str(tmp_path / "stage.toml"))
        result = name_response(modes, stage)
        why[:] = why_unnamed(result, stage)
        return result.names

    low, high = (f for f, _, _ in MODES[:2])
    assert named(("low", low, 0.1), ("high", high, 0.1)) == ("low", "high")
    assert why == []
    assert named(("high", high, 0.1), ("none", 200.0, 0.1)) == ("", "high")
    assert why == []
    assert named(("both", (low + high) / 2, 0.5)) == ("", "")
    assert len(why) == 2
    assert all("it is not the only one where both is searched for; " in w for w in why)
    assert named(("one", low, 0.05), ("two", low + 1, 0.05), ("high", high, 0.1)) == ("", "high")
    (reason,) = why
    assert reason.startswith(
        f"the mode at {modes.frequency[0]:.5g} Hz has no name: one and two are "
    )
    assert "both searched for there; track assigns it" in reason


def test_channels_that_are_not_there_are_named_with_those_that_are() -> None:
    """Input or output missing, or one twice; of a refused channel the reason is quoted."""
    log = driven()
    for names in (("volts", "acc_x"), ("current", "acc_y")):
        error = refusal(log, *names)
        assert error.reason == "channel"
        assert "['current', 'acc_x']" in error.detail
    assert "both input and output" in refusal(log, "current", "current").detail
    flat = replace(log, refused=(Refusal(log.name, "flat", "always 3.3", channel="acc_y"),))
    assert "always 3.3" in refusal(flat, "current", "acc_y").detail


def test_a_constant_signal_is_named() -> None:
    """An amplifier that was off."""
    log = driven()
    still = Channel("current", "current", np.full(log.channels[0].values.size, 0.7))
    error = refusal(replace(log, channels=(still, log.channels[1])), "current", "acc_x")
    assert error.reason == "constant"
    assert "current is 0.7" in error.detail


def test_a_period_longer_than_half_the_record_is_refused() -> None:
    """The refusal quotes the seconds available and those of two periods."""
    error = refusal(driven(periods=3), "current", "acc_x", period=7.0)
    assert error.reason == "period"
    assert "7 s" in error.detail
    assert "12 s" in error.detail


def test_a_stated_period_that_cannot_be_is_refused() -> None:
    """Milliseconds for seconds; and seconds for an input that does not repeat."""
    error = refusal(driven(), "current", "acc_x", period=0.004)
    assert error.reason == "period"
    assert "1.6 samples" in error.detail
    error = refusal(driven(random=True), "current", "acc_x", band=BAND, period=4.0)
    assert error.reason == "period"
    assert "current does not repeat after 4 s" in error.detail


def test_a_band_beyond_the_sample_rate_or_the_excitation_is_refused() -> None:
    """Above 0.45 of the sample rate nothing is shown; an unexcited band is refused."""
    assert refusal(driven(), "current", "acc_x", band=(190, 300)).reason == "sample-rate"
    assert refusal(driven(), "current", "acc_x", band=(130, 150)).reason == "not-excited"
    assert refusal(driven(), "current", "acc_x", band=(60, 61)).reason == "band-too-narrow"


def test_a_short_record_is_refused_with_its_length() -> None:
    """The refusal quotes samples and seconds available, or the lines that a fit needs."""
    log = driven(random=True)
    short = make_log({c.name: c.values[:100] for c in log.channels}, RATE)
    error = refusal(short, "current", "acc_x")
    assert error.reason == "too-short"
    assert "100 samples, 0.25 s" in error.detail
    brief = make_log({c.name: c.values[:300] for c in log.channels}, RATE)
    assert refusal(brief, "current", "acc_x", band=BAND).reason == "band-too-narrow"


def test_a_log_that_only_accelerates_is_refused() -> None:
    """Without constant velocity there is nothing to read."""
    log = driven(random=True)
    n = log.channels[0].values.size
    ramp = replace(log, reference_velocity=np.linspace(0, 1, n))
    assert refusal(ramp, "current", "acc_x").reason == "too-short"


def test_a_sine_excites_too_few_lines() -> None:
    """A pure tone repeats itself, but has one line."""
    t = np.arange(8000) / RATE
    values = np.random.default_rng(1).standard_normal(8000)
    log = make_log({"current": np.sin(2 * np.pi * 50 * t), "acc_x": values}, RATE)
    assert refusal(log, "current", "acc_x").reason in ("not-excited", "band-too-narrow")


@pytest.mark.parametrize("repeats", [True, False])
def test_an_output_that_does_not_answer_is_refused(repeats: bool) -> None:
    """Noise independent of an excitation is refused with its coherence."""
    rng = np.random.default_rng(2)
    given = np.tile(multisine(rng, SIZE), 6) if repeats else rng.standard_normal(6 * SIZE)
    log = make_log({"current": given, "acc_x": rng.standard_normal(6 * SIZE)}, RATE)
    error = refusal(log, "current", "acc_x", band=BAND)
    assert error.reason == "coherence"
    assert "acc_x does not respond to current" in error.detail


def test_a_response_without_a_mode_says_that_none_is_there() -> None:
    """A machine whose modes lie outside the band: no modes, and a reason."""
    machine = Machine(modes=((20.0, 0.05, 1.0), (160.0, 0.02, 1.0)), process=0.0)
    modes = read_frf(driven(machine), "current", "acc_x", band=(60, 110)).modes
    assert modes.names == ()
    assert "not-excited" in {r.reason for r in modes.refused}


def test_noise_is_the_reason_where_it_hides_the_mode() -> None:
    """Six weak modes under noise of their size: none, its share, and how long to record."""
    modes = tuple((f, 0.1, 1.0) for f in np.linspace(45, 115, 6).tolist())
    log = driven(Machine(modes=modes, white=6.0, process=0.0))
    (refused,) = read_frf(log, "current", "acc_x", band=BAND).modes.refused
    assert refused.reason == "noise"
    assert "hides modes above 33 %" in refused.detail
    assert "times as long" in refused.detail


def test_a_strong_nonlinearity_is_the_reason_where_lines_are_dense() -> None:
    """A motor that adds three times its cube: the periods agree, no rational response does."""
    rng = np.random.default_rng(2)
    given = multisine(rng, SIZE)
    bent = Machine().answer(given + 3 * given**3 - 9 * given)
    log = make_log({"current": np.tile(given, 6), "acc_x": np.tile(bent, 6)}, RATE)
    modes = read_frf(log, "current", "acc_x", band=BAND).modes
    assert modes.names == ()
    assert "nonlinear" in {r.reason for r in modes.refused}
    assert "periods scatter by" in modes.refused[-1].detail


def test_too_few_lines_for_many_modes_are_the_reason() -> None:
    """Seven modes 0.6 to 2 Hz wide and 16 lines 10 Hz apart: no modes, and lines are asked for."""
    modes = tuple((f, 0.005, (-1.0) ** i) for i, f in enumerate(np.linspace(23, 171, 7).tolist()))
    found = read_frf(sparse(0.005, 40, modes), "current", "acc_x", band=(8, 180)).modes
    assert found.names == ()
    assert {r.reason for r in found.refused} == {"too-few-lines"}
    assert "needed 46 for 8 modes" in found.refused[-1].detail


def test_a_heavily_damped_mode_is_refused_by_name() -> None:
    """A damping of 40 % is a background, not a mode."""
    machine = Machine(modes=((80.0, 0.4, 1.0), *MODES[2:]), white=0.01, process=0.0)
    modes = read_frf(driven(machine), "current", "acc_x", band=BAND).modes
    assert modes.names == ()
    assert "overdamped" in {r.reason for r in modes.refused}


def test_a_gap_leaves_the_longest_piece() -> None:
    """Periods are not cut across a gap."""
    log = driven(periods=8)
    gap = replace(log, pieces=((0, 2 * SIZE), (2 * SIZE + 5, 8 * SIZE)))
    reading = read_frf(gap, "current", "acc_x", band=BAND)
    assert reading.frf.n_averages == 5
    assert np.abs(off(reading)).max() < 4


def with_sine(frequency: float, share: float) -> tuple[FrfReading, float]:
    """Read a response with a sine of the excitation's period; return the amplitude of this, too."""
    given, answer = periodic(np.random.default_rng(4), Machine(), SIZE, 6)
    size = share * answer.std()
    answer = answer + size * np.sin(2 * np.pi * frequency * np.arange(answer.size) / RATE)
    log = make_log({"current": given, "acc_x": answer}, RATE)
    return read_frf(log, "current", "acc_x", band=BAND), size


def test_a_strong_sine_is_refused_as_a_line() -> None:
    """75 Hz as strong as the answer: a pole of no damping, for which no period is advised."""
    reading, _ = with_sine(75, 1.0)
    (refused,) = reading.modes.refused
    assert (refused.reason, refused.mode) == ("line-not-mode", "75 Hz")
    assert np.abs(off(reading)).max() < 4


def test_mains_on_a_harmonic_is_a_line_and_no_mode() -> None:
    """50 Hz synchronous with the excitation is listed as mains with its amplitude."""
    reading, size = with_sine(50, 0.2)
    (line,) = reading.modes.lines
    assert (line.kind, line.channel) == ("mains", "acc_x")
    assert line.frequency == pytest.approx(50)
    assert line.amplitude == pytest.approx(size, rel=0.3)
    assert np.abs(off(reading)).max() < 4


# Real benches


@pytest.fixture
def bench(needs: Callable[[str], None], tmp_path: Path) -> Callable[[str], Log]:
    """Read a real log with its column map."""
    needs("data")

    def read(name: str) -> Log:
        (tmp_path / "map.toml").write_text(MAPS[name])
        path = Path(os.environ["LMSHEALTH_DATA"]) / name
        return read_log(path, columns=load_columns(tmp_path / "map.toml"))

    return read


@pytest.mark.slow
def test_two_encoders_and_experiments_of_a_linear_guide_agree(bench: Callable[[str], Log]) -> None:
    """Friction moves the resonance by 0.3 Hz between experiments: it is within what is stated."""
    found = []
    for name in GUIDE:
        log = bench(name)
        for output in ("delta_e_motor", "delta_e_load"):
            # The table that is played is 4999 samples long, whatever its author calls 5 s.
            reading = read_frf(log, "current_input", output, period=5.0)
            assert round(reading.frf.period * log.sample_rate, 3) == 4999
            assert reading.modes.names == ("mode_1",)
            modes = reading.modes
            found.append([modes.frequency[0], modes.frequency_std[0], modes.damping_ratio[0],
                          modes.damping_ratio_std[0]])  # fmt: skip
            # Scatter over periods does not show the friction, what no linear model fits does.
            assert reading.fit.distortion > 0.05
            assert reading.fit.chi_square > 100
    f, f_std, zeta, zeta_std = np.array(found).T
    # What its authors' data give: 13.3 to 14.1 Hz, 5 to 8 %.
    assert ((f - 2 * f_std < 14.1) & (f + 2 * f_std > 13.3)).all()
    assert f == pytest.approx(13.5, abs=0.5)
    assert ((zeta - 2 * zeta_std < 0.08) & (zeta + 2 * zeta_std > 0.05)).all()
    for i, j in ((0, 2), (1, 3), (0, 1), (2, 3)):
        assert abs(f[i] - f[j]) < 2 * np.hypot(f_std[i], f_std[j])
        assert abs(zeta[i] - zeta[j]) < 2 * np.hypot(zeta_std[i], zeta_std[j])
    assert (f_std < 0.5).all()


@pytest.mark.parametrize("band", [None, (40.0, 120.0)])
@pytest.mark.slow
def test_motor_and_load_of_a_bench_agree(
    bench: Callable[[str], Log], band: tuple[float, float] | None
) -> None:
    """76.3 ± 0.4 Hz and 1.2 to 2 % on both sides, apart by no more than they state."""
    log = bench(BENCH)
    sides = [
        read_frf(log, "current", output, band=band).modes
        for output in ("delta_e_motor", "delta_e_load")
    ]
    for modes in sides:
        assert modes.names == ("mode_1",), modes.frequency
        assert modes.frequency[0] == pytest.approx(76.3, abs=0.4)
        assert 0.012 < modes.damping_ratio[0] < 0.02
        assert modes.frequency_std[0] < 0.2
    motor, load = sides
    apart = abs(motor.frequency[0] - load.frequency[0])
    assert apart < 2 * np.hypot(motor.frequency_std[0], load.frequency_std[0])


def test_the_motor_side_has_an_antiresonance(bench: Callable[[str], Log]) -> None:
    """The load holds the motor near 53 Hz, measured and fitted."""
    reading = read_frf(bench(BENCH), "current", "delta_e_motor", band=(40.0, 120.0))
    frequency = reading.fit.ordinates.frequency
    assert frequency[np.argmin(np.abs(reading.fit.response))] == pytest.approx(53, abs=1.5)


@pytest.mark.slow
def test_noise_of_a_bench_is_its_scatter_over_periods(bench: Callable[[str], Log]) -> None:
    """Left out one by one, 19 periods scatter by what is stated; a third of it would fail."""
    found = scatter_over_periods(bench(BENCH), "delta_e_load", None)
    for ratio in found["stated_over_scatter"]:
        assert 0.7 < ratio < 2
        assert not 0.7 < ratio / 3 < 2


def test_one_sine_is_one_line() -> None:
    """A strong sine in a displacement leaks into the ordinates around it, which are no lines."""
    log = driven(Machine(displacement=True), periods=12, random=True)
    current, response = (channel.values[:] for channel in log.channels)
    sine = 200 * response.std() * np.cos(2 * np.pi * 90.02 * np.arange(response.size) / RATE)
    log = make_log({"current": current, "delta_e": response + sine}, RATE)
    (line,) = read_frf(log, "current", "delta_e", band=(40, 120)).modes.lines
    assert line.frequency == pytest.approx(90.02, abs=0.02)
