"""Tests of FRF logs: the sweep, what it does to the stage, and what can be read from it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.ndimage import uniform_filter1d
from scipy.signal import hilbert

from models.__main__ import cli
from models.dynamics.modal_coordinates import diagonalise, frequency_response
from models.dynamics.plant import GUIDE_MODES, INPUTS, OUTPUTS, closed_loop, structure_state
from models.dynamics.quantities import Number
from models.dynamics.servo import TUNINGS
from models.dynamics.stages import STAGES, build_structure
from models.errors import BadParameter
from models.recordings.formats import WRITERS
from models.recordings.recording import COLUMNS, SAMPLE_RATE_HZ, record
from models.recordings.sweep import EXCITATION, Sweep, record_sweep, response, without_loop

BOTH = sorted(STAGES)
SHORT = Sweep(60.0, 400.0, amplitude=0.1, period=1.0)


def swept(name, sweep=SHORT, seconds=2.0, seed=0):
    """Return a sweep's recording."""
    rng = np.random.default_rng(seed)
    return record_sweep(STAGES[name], sweep, seconds=seconds, rng=rng)


@pytest.fixture(scope="module")
def log_y():
    """Return 20 s of stage Y with the default sweep."""
    return swept("lms-y", Sweep(), 20.0)


@pytest.mark.parametrize("law", ["log", "linear"])
def test_sine_has_constant_amplitude_and_rises_from_low_to_high(law):
    """The analytic signal has one amplitude, and a frequency that follows the law."""
    sweep = Sweep(50.0, 500.0, amplitude=0.3, period=2.0, law=law)
    analytic = hilbert(np.tile(sweep.one_period(), 3))[sweep.samples : 2 * sweep.samples]
    inner = slice(sweep.samples // 20, -sweep.samples // 20)
    np.testing.assert_allclose(np.abs(analytic)[inner], 0.3, rtol=0.01)
    hertz = np.gradient(np.unwrap(np.angle(analytic))) * SAMPLE_RATE_HZ / (2 * np.pi)
    share = np.arange(sweep.samples) / sweep.samples
    expected = 50.0 * 10.0**share if law == "log" else 50.0 + 450.0 * share
    np.testing.assert_allclose(hertz[inner], expected[inner], rtol=0.02)


def test_periods_join_without_a_jump():
    """From the last sample to the first is no further than from any sample to its next."""
    wave = Sweep(33.3, 777.0, period=1.7).one_period()
    assert abs(wave[0] - wave[-1]) <= np.abs(np.diff(wave)).max()


@pytest.mark.slow
def test_columns_are_those_of_a_log_and_the_excitation(log_y):
    """The columns of every log, and the injected current next to the total."""
    assert tuple(log_y.columns) == (*COLUMNS, EXCITATION)
    assert {v.dtype for v in log_y.columns.values()} == {np.dtype("float32")}
    assert {v.size for v in log_y.columns.values()} == {400000}
    assert np.all(log_y.columns["reference_velocity_mm_s"] == 10.0)
    assert log_y.metadata["excitation_period_s"] == 5.0


def test_following_error_is_counted_once(log_y):
    """Δe holds whole encoder counts, rounded after the sweep's part was added."""
    count = 1e6 * STAGES["lms-y"].encoder_count.value
    counts = log_y.columns["delta_e_um"].astype(float) / count
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-3)


def test_sweep_comes_on_top_of_the_disturbances():
    """Less what the sweep does, the record is that of an undisturbed move of the same seed."""
    quiet = record(STAGES["lms-y"], seconds=2.0, rng=np.random.default_rng(0))
    recording = swept("lms-y")
    parts = response(STAGES["lms-y"], SHORT, samples=40000)
    for name, part in zip(COLUMNS[1:4], parts[1:], strict=True):
        left = recording.columns[name] - part
        np.testing.assert_allclose(left, quiet.columns[name], atol=1e-6 * np.abs(part).max())


@pytest.mark.parametrize("name", BOTH)
def test_every_period_is_alike(name):
    """The sweep's part has no transient: its answer at each line is the sampled response."""
    parts = response(STAGES[name], SHORT, samples=2 * SHORT.samples)
    np.testing.assert_array_equal(parts[:, : SHORT.samples], parts[:, SHORT.samples :])
    index = np.arange(70, 391)
    wave = np.fft.rfft(SHORT.one_period())[index]
    found = np.fft.rfft(parts[:, : SHORT.samples])[:, index] / wave
    column = INPUTS.index("motor_force")
    diagonal = diagonalise(closed_loop(STAGES[name]))
    force = TUNINGS[name].force_constant
    delta_e, current = OUTPUTS.index("delta_e"), OUTPUTS.index("current")
    expected = force * frequency_response(diagonal, index.astype(float))[:, :, column]
    held = np.exp(-1j * np.pi * index / SAMPLE_RATE_HZ) * np.sinc(index / SAMPLE_RATE_HZ)
    for k, direct in ((delta_e, 0.0), (current, 1.0)):
        exact = held * expected[:, k] + direct
        np.testing.assert_allclose(found[k], exact, atol=1e-4 * np.abs(exact).max())


def coherence(recording, periods=4):
    """Return f (Hz) and coherence of Δe at the sweep's lines, noise taken from between them.

    A Hann window keeps a periodic signal within one bin of every fourth.
    """
    values = recording.columns["delta_e_um"].astype(float)
    window = np.hanning(values.size + 1)[:-1]
    power = np.abs(np.fft.rfft(window * (values - values.mean()))) ** 2
    at = np.arange(periods, power.size - periods, periods)
    noise = uniform_filter1d((power[at - 2] + power[at + 2]) / 2, 9)
    return at * SAMPLE_RATE_HZ / values.size, 1 - noise / power[at]


@pytest.mark.slow
def test_coherence_is_near_one_and_the_following_error_small(log_y):
    """From 100 to 140 Hz coherence is above 0.9, mostly 0.99, while Δe stays within 10 µm."""
    hertz, found = coherence(log_y)
    band = (hertz >= 100) & (hertz <= 140)
    assert found[band].min() > 0.9
    assert np.median(found[band]) > 0.99
    assert np.abs(log_y.columns["delta_e_um"]).max() < 10.0
    _, weak = coherence(swept("lms-y", replace(Sweep(), amplitude=0.001), 20.0))
    assert np.median(weak[band]) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("mode", GUIDE_MODES)
@pytest.mark.parametrize("name", BOTH)
def test_excitation_shows_the_closed_loop_and_the_whole_current_the_structure(name, mode):
    """Around a mode each response is, ten times nearer than the other, that of its matrices."""
    stage = STAGES[name]
    wave = Sweep(60.0, 400.0, period=10.0)
    spectrum = np.fft.rfft(response(stage, wave, samples=wave.samples))
    hertz = np.fft.rfftfreq(wave.samples, 1 / SAMPLE_RATE_HZ)
    near = np.abs(hertz / without_loop(stage)[mode][0].frequency_hz - 1) < 0.03
    delta_e, current = (spectrum[OUTPUTS.index(output), near] for output in ("delta_e", "current"))

    loop = closed_loop(stage).driven_by(["motor_force"])
    a, b = structure_state(stage, build_structure(stage))
    encoder = loop.c[0, : len(a)]
    closed, alone = (
        TUNINGS[name].force_constant
        * np.array(
            [c @ np.linalg.solve(s * np.eye(len(c)) - a, b) for s in 2j * np.pi * hertz[near]]
        )
        for a, b, c in ((loop.a, loop.b[:, 0], loop.c[0]), (a, b[:, -1], encoder))
    )

    def off(source, expected):
        return np.abs(np.abs(delta_e / source / expected) - 1).max()

    sine = np.fft.rfft(wave.one_period())[near]
    assert off(sine, closed) < 0.1 * off(sine, alone)
    assert off(current, alone) < 0.1 * off(current, closed)


@pytest.mark.parametrize("name", BOTH)
def test_poles_without_the_loop_are_those_of_the_matrices(name):
    """Each open eigenvalue is a root of the quadratic pencil, and near the closed one."""
    structure = build_structure(STAGES[name])
    for mode, value in without_loop(STAGES[name]).values():
        dynamic = structure.mass * value**2 + structure.damping * value + structure.stiffness
        sizes = np.linalg.svd(dynamic, compute_uv=False)
        assert sizes[-1] < 1e-9 * sizes[0]
        assert abs(value / mode.eigenvalue - 1) < 0.02
    assert set(without_loop(STAGES[name])) == set(GUIDE_MODES)


def test_same_seed_same_log_other_seed_other_log():
    """A record is a function of its seed."""
    first, again, other = (swept("lms-x", seed=seed).columns for seed in (1, 1, 2))
    for name in first:
        np.testing.assert_array_equal(first[name], again[name])
    assert np.any(first["delta_e_um"] != other["delta_e_um"])
    np.testing.assert_array_equal(first[EXCITATION], other[EXCITATION])


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("band", {"low_hz": 500.0, "high_hz": 100.0}),
        ("band", {"high_hz": 10000.0}),
        ("amplitude", {"amplitude": 0.0}),
        ("amplitude", {"amplitude": float("nan")}),
        ("period", {"period": 0.01}),
        ("period", {"period": float("inf")}),
        ("law", {"law": "square"}),
    ],
)
def test_impossible_sweeps_are_refused(name, changed):
    """Each number outside its range is named."""
    with pytest.raises(BadParameter) as caught:
        replace(Sweep(), **changed)
    assert caught.value.name == name


def test_a_log_shorter_than_a_period_is_refused():
    """A sweep that does not end within the log is no sweep."""
    with pytest.raises(BadParameter, match="one period"):
        swept("lms-y", Sweep(), 2.0)


@pytest.mark.parametrize("seconds", [float("inf"), float("nan"), 1e9])
def test_a_log_without_end_is_refused(seconds):
    """What no log can be as long as is named, whatever the period."""
    with pytest.raises(BadParameter, match=r"seconds is .* 0\.01 to 600 s"):
        swept("lms-y", SHORT, seconds)


def test_a_sine_that_turns_the_platform_back_is_refused():
    """The largest amplitude is named, and a hundredth below it is accepted."""
    with pytest.raises(BadParameter, match="turns back") as caught:
        swept("lms-y", replace(SHORT, amplitude=5.0))
    largest = float(str(caught.value).split("below ")[1].split(" A")[0])
    with pytest.raises(BadParameter, match="turns back"):
        swept("lms-y", replace(SHORT, amplitude=1.01 * largest))
    assert swept("lms-y", replace(SHORT, amplitude=0.99 * largest)).metadata


@pytest.mark.parametrize("file_format", sorted(WRITERS))
def test_command_writes_a_log_that_the_reader_takes(tmp_path, file_format):
    """`sweep` writes each format; its identity and seed are those asked for."""
    out = tmp_path / f"sweep{WRITERS[file_format][0]}"
    arguments = ["sweep", "lms-y", "--low", "60", "--high", "400", "--period", "1", "--seed", "7"]
    arguments += ["--seconds", "2", "--out", str(out), "--format", file_format]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    assert out.stat().st_size > 1000
    if file_format == "csv":
        head = out.read_text(encoding="utf-8")[:2000]
        assert "# stage: LMS-7-Y" in head
        assert EXCITATION in head


SHORT_SWEEP = ["sweep", "lms-x", "--low", "100", "--period", "0.1", "--seconds", "0.2", "--out"]


@pytest.mark.parametrize("file_format", sorted(WRITERS))
def test_suffix_says_the_format(tmp_path, file_format):
    """Without --format the file has the name that was asked for, and the format of its suffix."""
    out = tmp_path / f"sweep{WRITERS[file_format][0]}"
    result = CliRunner().invoke(cli, [*SHORT_SWEEP, str(out)])
    assert result.exit_code == 0, result.output
    assert [path.name for path in tmp_path.iterdir()] == [out.name]
    first = {"csv": b"# stage: LMS-0-X", "parquet": b"PAR1", "hdf5": b"\x89HDF"}[file_format]
    assert out.read_bytes().startswith(first)


@pytest.mark.parametrize(
    ("name", "chosen", "needed"),
    [
        ("sweep.csv", ["--format", "hdf5"], r"ending in \.h5, the suffix of hdf5"),
        ("sweep.txt", [], r"ending in \.csv or \.parquet or \.h5"),
        ("sweep", [], r"ending in \.csv or \.parquet or \.h5"),
    ],
)
def test_suffix_that_contradicts_is_refused(tmp_path, name, chosen, needed):
    """A suffix of another format, of none, or none at all, writes nothing under another name."""
    arguments = [*SHORT_SWEEP, str(tmp_path / name), *chosen]
    with pytest.raises(BadParameter, match=rf"out is {name}; needed: a name {needed}"):
        CliRunner().invoke(cli, arguments, catch_exceptions=False)
    assert not list(tmp_path.iterdir())


def test_modes_agree_with_the_command_line():
    """The closed-loop side of the comparison is what `modes` prints."""
    printed = json.loads(CliRunner().invoke(cli, ["modes", "lms-x", "--format", "json"]).output)
    hertz = {mode["mode"]: mode["frequency_hz"] for mode in printed["modes"]}
    for name, (mode, _) in without_loop(STAGES["lms-x"]).items():
        assert mode.frequency_hz == hertz[name]


def test_encoder_without_steps_is_not_left_behind():
    """The recording's count is the stage's, whatever it is."""
    coarse = replace(STAGES["lms-y"], encoder_count=Number(1e-6, "m", "our choice"))
    columns = record_sweep(coarse, SHORT, seconds=1.0, rng=np.random.default_rng(0)).columns
    np.testing.assert_array_equal(columns["delta_e_um"], np.round(columns["delta_e_um"]))
