"""Tests of the exact recursion against eigenvalues, matrix exponentials and spectra."""

import numpy as np
import pytest
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
from models.dynamics.plant import INPUTS, closed_loop, closed_loop_modes
from models.dynamics.stages import STAGES

RATE = 20000.0


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
