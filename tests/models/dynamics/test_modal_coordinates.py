"""Modal coordinates against the matrix exponential, energies, statics and other integrators."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import expm
from scipy.signal import periodogram

from models.dynamics.modal_coordinates import (
    diagonalise,
    frequency_response,
    held_gain,
    propagate,
    sampled_spectrum,
    simulate,
    state_covariance,
)
from models.dynamics.plant import (
    GUIDE_MODES,
    INPUTS,
    OUTPUTS,
    LinearSystem,
    closed_loop,
    closed_loop_modes,
)
from models.dynamics.quantities import Number
from models.dynamics.stages import HOUSING, PLATFORM, STAGES, build_structure, corners
from models.dynamics.structure import displacement_rows

RATE = 20000.0
BOTH = sorted(STAGES)
LOSSES = (
    "guide_loss_time",
    "mount_loss_time",
    "isolator_horizontal_loss_time",
    "isolator_vertical_loss_time",
)


def modes_of(stage):
    """Return the closed-loop modes by name."""
    return {mode.name: mode for mode in closed_loop_modes(stage)}


def more_damped(stage, factor):
    """Return the stage with every joint's damping multiplied."""
    changed = {
        name: Number(factor * getattr(stage, name).value, "s", "our choice") for name in LOSSES
    }
    return replace(stage, **changed)


def reading_states(system):
    """Return the system with its states as outputs."""
    n, m = system.b.shape
    return LinearSystem(system.a, system.b, np.eye(n), np.zeros((n, m)))


def run(system, inputs, rate=RATE, start=None):
    """Return outputs (output, time) from a physical start state (n,), at rest without it."""
    diagonal = diagonalise(system)
    start = np.zeros(system.a.shape[0]) if start is None else start
    modal = np.linalg.solve(diagonal.states, start.astype(complex))
    return propagate(diagonal, modal.astype(complex), inputs, rate)[0]


def block_rows(stage):
    """Return (12, dof) rows that read the platform against the housing at the blocks."""
    bodies = build_structure(stage).bodies
    return np.vstack(
        [
            displacement_rows(bodies, PLATFORM, p) - displacement_rows(bodies, HOUSING, p)
            for p in corners(stage.block_half_spacing)
        ]
    )


def structure_alone(stage, *, damped=True, spring=1e6):
    """Return the structure without servo, a spring holding the platform's free motion.

    Inputs are the forces at the blocks, outputs all displacements, then all velocities.
    """
    structure = build_structure(stage)
    n, rows = structure.size, block_rows(stage)
    feed = rows[0]
    stiffness = structure.stiffness + spring * np.outer(feed, feed)
    damping = structure.damping if damped else np.zeros((n, n))
    a = np.zeros((2 * n, 2 * n))
    a[:n, n:] = np.eye(n)
    a[n:] = np.linalg.solve(structure.mass, -np.hstack([stiffness, damping]))
    b = np.vstack([np.zeros((n, 12)), np.linalg.solve(structure.mass, rows.T)])
    matrices = structure.mass, damping, stiffness
    return LinearSystem(a, b, np.eye(2 * n), np.zeros((2 * n, 12))), matrices


def decay(stage, mode):
    """Return f (Hz) and ζ from crossings and logarithmic decrement of a simulated free decay.

    The start state is the real part of the nearest eigenvector of the stage's own matrix.
    """
    system = closed_loop(stage)
    values, vectors = np.linalg.eig(system.a)
    start = vectors[:, np.argmin(np.abs(values - mode.eigenvalue))].real
    samples = round(12 * RATE / mode.frequency_hz)
    states = run(reading_states(system), np.zeros((len(INPUTS), samples)), start=start)
    signal = states[np.argmax(np.abs(start[: mode.shape.size]))]
    before = np.flatnonzero(signal[:-1] * signal[1:] < 0)
    share = signal[before] / (signal[before] - signal[before + 1])
    crossings = (before + share) / RATE
    damped_hz = (crossings.size - 1) / 2 / (crossings[-1] - crossings[0])
    peaks = []
    for start_at, end_at in pairwise(before):
        top = start_at + 1 + np.argmax(np.abs(signal[start_at + 1 : end_at + 1]))
        low, middle, high = np.abs(signal[top - 1 : top + 2])
        peaks.append(middle + (high - low) ** 2 / (8 * (2 * middle - low - high)))
    decrement = -2 * np.polyfit(np.arange(len(peaks)), np.log(peaks), 1)[0]
    zeta = decrement / np.hypot(2 * np.pi, decrement)
    return damped_hz / np.sqrt(1 - zeta**2), zeta


def agrees(found, mode):
    """Check that f and ζ are those of the eigenvalue, to 0.1 % and 2 %."""
    f, zeta = found
    return abs(f / mode.frequency_hz - 1) < 1e-3 and abs(zeta / mode.damping_ratio - 1) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", BOTH)
def test_every_mode_decays_with_its_eigenvalue(name):
    """Free decays of all modes up to 1 kHz give f to 0.1 % and ζ to 2 %."""
    stage = STAGES[name]
    low = [mode for mode in closed_loop_modes(stage) if mode.frequency_hz < 1000]
    assert len(low) > 9
    for mode in low:
        assert agrees(decay(stage, mode), mode), mode.name


@pytest.mark.parametrize("name", BOTH)
def test_decay_notices_five_percent_of_damping(name):
    """The same check fails on a stage whose joints are 5 % more damped."""
    stage = STAGES[name]
    for mode in (modes_of(stage)[m] for m in GUIDE_MODES):
        assert not agrees(decay(more_damped(stage, 1.05), mode), mode), mode.name


def lines(system, force, band, period=5.0):
    """Return frequencies (Hz) and steady responses (frequency, output) to a comb of held sines.

    The comb holds every multiple of 1/period in the band with a random phase; of its periods the
    last is taken, by when the slowest pole has almost died out.
    """
    samples = round(period * RATE)
    index = np.arange(math.ceil(band[0] * period), math.floor(band[1] * period) + 1)
    spectrum = np.zeros(samples // 2 + 1, dtype=complex)
    turns = np.random.default_rng(0).random(index.size)
    spectrum[index] = samples / 2 * np.exp(2j * np.pi * turns)
    wave = np.fft.irfft(spectrum, samples)
    outputs = run(system, np.outer(force, np.tile(wave, 3)))[:, -samples:]
    return index / period, (np.fft.rfft(outputs, axis=1)[:, index] / spectrum[index]).T


@pytest.mark.slow
@pytest.mark.parametrize("name", BOTH)
@pytest.mark.parametrize("source", ["motor_force", "block2_z", "ground_y"])
def test_steady_response_is_the_frequency_response(name, source):
    """From 5 to 600 Hz a driven record has the response that the matrices have."""
    system = closed_loop(STAGES[name])
    force = np.zeros(len(INPUTS))
    force[INPUTS.index(source)] = 1.0
    hertz, found = lines(system, force, (5.0, 600.0))
    expected = np.empty_like(found)
    for k, f in enumerate(hertz):
        state = np.linalg.solve(2j * np.pi * f * np.eye(len(system.a)) - system.a, system.b @ force)
        # A hold delays by half a sample and takes a sinc; what acts at once does not wait.
        held = np.exp(-1j * np.pi * f / RATE) * np.sinc(f / RATE)
        expected[k] = held * (system.c @ state) + system.d @ force
    # What the hold passes at 20 kHz ± f folds back; it is small against the largest response.
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-4)


def modal_push_and_reading(stage, mode):
    """Return input amplitudes (input,) that push a mode most and the (state,) row that reads it.

    The row weighs displacements with mass times shape: to it all other shapes are orthogonal, but
    for what damping and servo couple.
    """
    structure, system = build_structure(stage), closed_loop(stage)
    n = structure.size
    shape = (mode.shape / mode.shape[np.argmax(np.abs(mode.shape))]).real
    force = shape @ structure.mass @ system.b[n : 2 * n]
    force[[not name.startswith("block") for name in INPUTS]] = 0.0
    row = np.zeros(len(system.a))
    row[:n] = shape @ structure.mass
    return force, row


def resonance(stage, mode):
    """Return (f Hz, ζ) from half-power points and (f, ζ) from phase of a driven record."""
    f = mode.frequency_hz
    reach = 4 * mode.damping_ratio * f
    force, row = modal_push_and_reading(stage, mode)
    hertz, answer = lines(reading_states(closed_loop(stage)), force, (f - reach, f + reach))
    moved = answer @ row
    fine = np.linspace(hertz[0], hertz[-1], 40001)
    # The inverse of one mode's power is a parabola in frequency.
    inverse = CubicSpline(hertz, 1 / np.abs(moved) ** 2)(fine)
    inside = fine[inverse < 2 * inverse.min()]
    middle, half = (inside[0] + inside[-1]) / 2, (inside[-1] - inside[0]) / 2
    slope = -CubicSpline(hertz, np.unwrap(np.angle(moved))).derivative()(fine)
    steepest = fine[np.argmax(slope)]
    return tuple(
        (np.hypot(at, decay), decay / np.hypot(at, decay))
        for at, decay in ((middle, half), (steepest, 1 / slope.max()))
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", BOTH)
@pytest.mark.parametrize("mode_name", GUIDE_MODES)
def test_driven_record_has_the_mode_s_frequency_and_damping(name, mode_name):
    """Half-power points and phase of a driven guide mode give f to 0.1 % and ζ to 2 %."""
    stage = STAGES[name]
    mode = modes_of(stage)[mode_name]
    for found in resonance(stage, mode):
        assert agrees(found, mode), found


@pytest.mark.slow
def test_half_power_notices_five_percent_of_damping():
    """The same check fails on a stage whose joints are 5 % more damped."""
    stage = STAGES["lms-y"]
    for found in resonance(more_damped(stage, 1.05), modes_of(stage)["roll"]):
        assert not agrees(found, modes_of(stage)["roll"])


def energy(states, mass, stiffness):
    """Return kinetic and strain energy together, J (time,)."""
    x, v = np.split(states, 2)
    return (np.sum(v * (mass @ v), axis=0) + np.sum(x * (stiffness @ x), axis=0)) / 2


@pytest.mark.parametrize("name", BOTH)
def test_undamped_structure_keeps_its_energy(name):
    """One second of free motion without damping and servo keeps the energy to 1e-7."""
    system, (mass, _, stiffness) = structure_alone(STAGES[name], damped=False)
    start = np.random.default_rng(1).standard_normal(len(system.a)) * 1e-3
    states = run(system, np.zeros((12, 20000)), start=start)
    held = energy(states, mass, stiffness)
    assert np.abs(held / held[0] - 1).max() < 1e-7
    system, (mass, _, stiffness) = structure_alone(STAGES[name])
    damped = energy(run(system, np.zeros((12, 20000)), start=start), mass, stiffness)
    assert damped[-1] < 0.5 * damped[0]


@pytest.mark.parametrize("name", BOTH)
def test_work_is_dissipation_and_gain_of_energy(name):
    """What forces do on the damped structure is dissipated or stored, to 1e-4 of the work."""
    system, (mass, damping, stiffness) = structure_alone(STAGES[name])
    samples = 40000
    time = np.arange(samples) / RATE
    rng = np.random.default_rng(2)
    force = 50.0 * np.sin(2 * np.pi * (rng.uniform(5, 150, 12)[:, None] * time + 0.1))
    states = run(system, force)
    moved = block_rows(STAGES[name]) @ states[: len(mass)]
    # A force is constant over a sample: its work is force times way, exactly.
    work = np.sum(force[:, :-1] * np.diff(moved), axis=0).cumsum()
    v = states[len(mass) :]
    loss = cumulative_trapezoid(np.sum(v * (damping @ v), axis=0), dx=1 / RATE)
    stored = energy(states, mass, stiffness)[1:]
    np.testing.assert_allclose(work, stored + loss, atol=1e-4 * work[-1])
    assert np.abs(work - stored - 1.05 * loss).max() > 1e-2 * work[-1]


@pytest.mark.parametrize("name", BOTH)
def test_constant_force_ends_at_the_stiffness_solution(name):
    """The damped structure comes to rest at the static solution of the stiffness matrix."""
    stage = STAGES[name]
    system, (_, _, stiffness) = structure_alone(stage)
    force = np.random.default_rng(3).standard_normal(12)
    # The propagation of a held force is exact at any step; nothing but the structure damps.
    states = run(system, np.tile(force[:, None], 30000), 100.0)
    expected = np.linalg.solve(stiffness, block_rows(stage).T @ force)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(states[: expected.size, -1] / scale, expected / scale, atol=1e-6)
    assert np.abs(states[expected.size :, -1]).max() < 1e-6 * np.abs(states[expected.size :]).max()


@pytest.mark.parametrize("name", BOTH)
def test_integrator_removes_the_error_of_a_constant_force(name):
    """Under a constant force Δe dies out at the rate of the loop's slowest pole."""
    system = closed_loop(STAGES[name])
    inputs = np.zeros((len(INPUTS), 60000))
    inputs[INPUTS.index("motor_force")] = 1.0
    error = np.abs(run(system, inputs, 1000.0)[OUTPUTS.index("delta_e")])
    poles = np.linalg.eigvals(system.a)
    slowest = poles[np.argmax(poles.real)]
    assert abs(slowest.imag) < 1e-9
    largest = int(np.argmax(error))
    # Over the span in which nothing but the slowest pole is left.
    begin = largest + round(12e3 / np.sort(-poles.real)[1])
    span = round(2e3 / -slowest.real)
    rate = np.log(error[begin] / error[begin + span]) / (span / 1e3)
    assert rate == pytest.approx(-slowest.real, rel=1e-3)
    assert error[-1] < 1e-4 * error.max()


def echoes(a, stage):
    """Return (i, j, time): relative displacement at block axis i after a push at block axis j."""
    structure = build_structure(stage)
    n, rows = structure.size, block_rows(stage)
    b = np.zeros((len(a), 12))
    b[n : 2 * n] = np.linalg.solve(structure.mass, rows.T)
    c = np.hstack([rows, np.zeros((12, len(a) - n))])
    diagonal = diagonalise(LinearSystem(a, b, c, np.zeros((12, 12))))
    pushes = np.zeros((12, 12, 4000))
    pushes[np.arange(12), np.arange(12), 0] = 1.0
    rest = np.zeros(len(a), dtype=complex)
    return np.stack([propagate(diagonal, rest, push, RATE)[0] for push in pushes], axis=1)


@pytest.mark.parametrize("name", BOTH)
def test_structure_is_reciprocal_and_the_loop_is_not(name):
    """Push here and read there is push there and read here, unless the servo is closed."""
    stage = STAGES[name]
    alone, loop = (echoes(s.a, stage) for s in (structure_alone(stage)[0], closed_loop(stage)))
    for found, reciprocal in ((alone, True), (loop, False)):
        off = np.abs(found - found.transpose(1, 0, 2)).max() / np.abs(found).max()
        assert off < 1e-9 if reciprocal else off > 1e-4


def smooth(time):
    """Return a smooth input (input, time) with frequencies up to 300 Hz."""
    rng = np.random.default_rng(4)
    hertz, turn = rng.uniform(20, 300, len(INPUTS)), rng.random(len(INPUTS))
    waves = np.sin(2 * np.pi * (np.multiply.outer(hertz, time) + turn.reshape(-1, 1)))
    waves[INPUTS.index("encoder_error")] *= 1e-8
    return waves


@pytest.mark.parametrize("name", BOTH)
def test_held_inputs_need_no_finer_step(name):
    """20, 40 and 80 kHz agree to rounding where inputs are held over 50 µs."""
    system = reading_states(closed_loop(STAGES[name]))
    inputs = np.random.default_rng(5).standard_normal((len(INPUTS), 4000))
    inputs[INPUTS.index("encoder_error")] *= 1e-8
    coarse = run(system, inputs)
    scale = np.abs(coarse).max(axis=1, keepdims=True)
    for finer in (2, 4):
        fine = run(system, np.repeat(inputs, finer, axis=1), finer * RATE)[:, ::finer]
        np.testing.assert_allclose(fine / scale, coarse / scale, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("shift", "order"), [(0.0, 1), (0.5, 2)])
@pytest.mark.parametrize("name", BOTH)
def test_smooth_inputs_converge_with_the_step(name, shift, order):
    """Held at a step's begin they err in first order, at its middle in second, against DOP853."""
    system = reading_states(closed_loop(STAGES[name]))
    end = 0.02
    exact = solve_ivp(
        lambda t, x: system.a @ x + (system.b @ smooth(np.array([t])))[:, 0],
        (0.0, end), np.zeros(len(system.a)), method="DOP853", rtol=1e-10, atol=1e-16,
    ).y[:, -1]  # fmt: skip
    n = build_structure(STAGES[name]).size
    errors = []
    for rate in (RATE, 2 * RATE, 4 * RATE):
        samples = round(end * rate)
        inputs = smooth((np.arange(samples + 1) + shift) / rate)
        errors.append(np.linalg.norm((run(system, inputs, rate)[:, -1] - exact)[n : 2 * n]))
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    np.testing.assert_allclose(np.log2(ratios), order, atol=0.05)


@pytest.mark.parametrize("name", BOTH)
def test_a_second_of_record_equals_runge_kutta(name):
    """One second under white held inputs equals classical Runge-Kutta at a 16th of the step."""
    system = closed_loop(STAGES[name])
    inputs = np.random.default_rng(6).standard_normal((len(INPUTS), 20000))
    inputs[INPUTS.index("encoder_error")] *= 1e-8
    step, n = 1 / (16 * RATE), len(system.a)
    # Of a linear system the four stages add up to a polynomial of the matrix.
    power, onward = np.eye(n), np.zeros((n, n))
    for k in range(1, 5):
        onward += power * step / k
        power = power @ system.a * step / k
    growth = np.eye(n) + system.a @ onward
    whole, gain = np.eye(n), np.zeros((n, n))
    for _ in range(16):
        whole, gain = growth @ whole, growth @ gain + onward
    push, state = gain @ system.b, np.zeros(n)
    expected = np.empty((len(OUTPUTS), inputs.shape[1]))
    for k, given in enumerate(inputs.T):
        expected[:, k] = system.c @ state + system.d @ given
        state = whole @ state + push @ given
    scale = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(run(system, inputs) / scale, expected / scale, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(STAGES))
def test_recursion_equals_the_matrix_exponential(name):
    """Modal recursion and the plainly written state recursion agree."""
    system = closed_loop(STAGES[name])
    diagonal = diagonalise(system)
    n, m = system.b.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = system.a, system.b
    whole = expm(block / RATE)
    rng = np.random.default_rng(0)
    inputs = rng.standard_normal((m, 300))
    inputs[INPUTS.index("encoder_error")] *= 1e-9
    state, expected = np.zeros(n), np.empty((system.c.shape[0], 300))
    for k in range(300):
        expected[:, k] = system.c @ state + system.d @ inputs[:, k]
        state = whole[:n, :n] @ state + whole[:n, n:] @ inputs[:, k]
    found, _ = propagate(diagonal, np.zeros(n, dtype=complex), inputs, RATE)
    scale = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-8)


def test_free_decay_has_the_mode_s_frequency_and_damping():
    """A record that starts in the roll mode decays with its eigenvalue."""
    stage = STAGES["lms-y"]
    mode = next(m for m in closed_loop_modes(stage) if m.name == "roll")
    diagonal = diagonalise(closed_loop(stage))
    state = np.zeros(diagonal.poles.size, dtype=complex)
    state[np.argmin(np.abs(diagonal.poles - mode.eigenvalue))] = 1.0
    inputs = np.zeros((len(INPUTS), 4000))
    signal = propagate(diagonal, state, inputs, RATE)[0][3]
    # A single damped oscillation obeys y[k+1] = 2 Re(μ) y[k] − |μ|² y[k−1].
    past = np.column_stack([signal[1:-1], signal[:-2]])
    first, second = np.linalg.lstsq(past, signal[2:])[0]
    root = np.roots([1.0, -first, -second])[0]
    exponent = np.log(root) * RATE
    assert abs(exponent) / (2 * np.pi) == pytest.approx(mode.frequency_hz, rel=1e-6)
    assert -exponent.real / abs(exponent) == pytest.approx(mode.damping_ratio, rel=1e-4)


def test_split_record_equals_the_whole():
    """Running in two pieces and handing the state over changes nothing."""
    diagonal = diagonalise(closed_loop(STAGES["lms-y"]))
    inputs = np.random.default_rng(1).standard_normal((len(INPUTS), 500))
    start = np.zeros(diagonal.poles.size, dtype=complex)
    whole, _ = propagate(diagonal, start, inputs, RATE)
    first, state = propagate(diagonal, start, inputs[:, :200], RATE)
    second, _ = propagate(diagonal, state, inputs[:, 200:], RATE)
    joined = np.hstack([first, second])
    np.testing.assert_allclose(joined, whole, rtol=1e-9, atol=1e-12 * np.abs(whole).max())


def test_sine_answer_is_the_frequency_response():
    """After the start has died out a driven record has the response's amplitude and phase."""
    diagonal = diagonalise(closed_loop(STAGES["lms-x"]))
    hertz, index = 200.0, INPUTS.index("block1_z")
    samples = 60000
    wave = np.exp(2j * np.pi * hertz * np.arange(samples) / RATE)
    inputs = np.zeros((len(INPUTS), samples))
    inputs[index] = wave.real
    outputs, _ = propagate(diagonal, np.zeros(diagonal.poles.size, dtype=complex), inputs, RATE)
    tail = slice(-20000, None)
    found = 2 * outputs[0, tail] @ wave[tail].conj() / 20000
    expected = frequency_response(diagonal, np.array([hertz]))[0, 0, index]
    # The hold delays by half a sample.
    expected *= np.exp(-1j * np.pi * hertz / RATE) * np.sinc(hertz / RATE)
    assert abs(found / expected - 1) < 2e-3


def test_shaping_low_pass_multiplies_the_response():
    """Built-in low passes equal the plain response times 1 / (1 + s/ω)."""
    system = closed_loop(STAGES["lms-y"])
    corners = np.linspace(5.0, 900.0, len(INPUTS))
    hertz = np.array([2.0, 130.0, 700.0])
    plain = frequency_response(diagonalise(system), hertz)
    shaped = frequency_response(diagonalise(system, corners), hertz)
    expected = plain / (1 + 1j * hertz[:, None] / corners)[:, None, :]
    scale = np.abs(expected).max(axis=(0, 2))[None, :, None]
    np.testing.assert_allclose(shaped / scale, expected / scale, atol=1e-9)


def test_state_covariance_is_stationary():
    """One step of the recursion leaves the stationary covariance as it is."""
    system = closed_loop(STAGES["lms-y"])
    diagonal = diagonalise(system)
    std = np.ones(len(INPUTS))
    std[INPUTS.index("encoder_error")] = 1e-9
    covariance = state_covariance(diagonal, std, RATE)
    grown, push = held_gain(diagonal, RATE)
    inverse = np.linalg.inv(diagonal.states)
    step = (diagonal.states * grown @ inverse).real
    gain = (diagonal.states @ push).real * std
    moved = step @ covariance @ step.T + gain @ gain.T
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(moved / scale, covariance / scale, atol=1e-6)


def test_record_has_the_analytic_spectrum_and_variance():
    """Periodograms of a stationary record average to the state space's spectral density."""
    system = closed_loop(STAGES["lms-y"])
    corners = np.full(len(INPUTS), 1000.0)
    diagonal = diagonalise(system, corners)
    std = np.zeros(len(INPUTS))
    std[[i for i, name in enumerate(INPUTS) if name.startswith("block")]] = 1.0
    seconds = 10
    record = simulate(
        diagonal, std, int(seconds * RATE), sample_rate_hz=RATE, rng=np.random.default_rng(5)
    )
    hertz, density = periodogram(record[3], RATE, window="hann", detrend=False)
    band = (hertz > 100) & (hertz < 170)
    expected = sampled_spectrum(diagonal, std, RATE, hertz[band])[:, 3]
    ratio = density[band] / expected
    # Each ordinate is exponential; a Hann window leaves 1/1.94 of them independent: 4.5 σ.
    tolerance = 4.5 * np.sqrt(1.94 / ratio.size)
    assert ratio.mean() == pytest.approx(1.0, abs=tolerance)
    reading = np.hstack([system.c, system.d])
    variance = reading @ state_covariance(diagonal, std, RATE) @ reading.T
    assert np.var(record[3]) == pytest.approx(variance[3, 3], rel=0.03)
