"""Complex mode shapes, modal assurance criterion and phase collinearity."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal.identification import read_ambient
from lmshealth.modal.mode_shapes import ModeShapes, mode_shapes
from tests.signals import Mode, make_log, make_stage, white

RATE, N = 500.0, 30_000
MODES = (Mode(60.0, 0.015, 1.0, (1.0, 0.7, 0.3)), Mode(66.0, 0.015, 1.0, (0.5, -1.0, 0.8)))
PHASES = np.radians([(0.0, 20.0, -10.0), (0.0, 0.0, 15.0)])


@pytest.mark.slow
def test_shapes_of_neighbours_have_their_amplitudes_and_phases() -> None:
    """Two modes two bandwidths apart, of which one moves one channel 20° late."""
    rng = np.random.default_rng(3)
    frequency = np.fft.rfftfreq(2 * N, 1 / RATE)
    frequency[0] = frequency[1]
    channels = white(rng, 5.0, 3 * N, RATE).reshape(3, N)
    for mode, phases in zip(MODES, PHASES, strict=True):
        force = np.fft.rfft(white(rng, 1.0, 2 * N, RATE))
        for c, phase in enumerate(phases):
            moved = force * mode.response(frequency) * mode.shape[c] * np.exp(1j * phase)
            channels[c] += np.fft.irfft(moved)[:N]
    log = make_log({f"acc_{c}": x for c, x in enumerate(channels)}, RATE)
    stage = make_stage([("roll", 60.0, 0.015), ("pitch", 66.0, 0.015)])
    reading = read_ambient(log, stage)
    found = mode_shapes(reading.modes, reading.fitted)
    true = np.array([m.shape for m in MODES]) * np.exp(1j * PHASES)
    true = true / true[[0, 1], [0, 1]][:, None]
    assert found.names == ("roll", "pitch")
    assert np.abs(found.shapes) == pytest.approx(np.abs(true), abs=0.05)
    apart = np.angle(found.shapes / true, deg=True)
    assert apart == pytest.approx(np.zeros((2, 3)), abs=5)
    assert (found.complexity < 0.96).all()


def test_criteria_are_those_of_the_literature() -> None:
    """MPC of a real shape is 1, whatever its phase, of a turning one 0; MAC of common channels."""
    real = np.array([1.0, -0.5, 0.25])
    turning = np.array([1.0, 1.0j, np.nan])
    found = ModeShapes(
        ("a", "b", "c"),
        ("x", "y", "z"),
        np.array([real * np.exp(0.7j), turning, [1, np.nan, np.nan]]),
    )
    assert found.complexity[:2] == pytest.approx([1.0, 0.0], abs=1e-12)
    assert np.isnan(found.complexity[2])
    overlap = abs(1.0 - 0.5j) ** 2 / (1.25 * 2)
    assert found.mac[0, 1] == pytest.approx(overlap)
    assert found.mac[1, 0] == pytest.approx(overlap)
    assert np.diag(found.mac)[:2] == pytest.approx([1.0, 1.0])
    assert np.isnan(found.mac[2]).all()


def test_mac_with_another_log_compares_modes_of_one_name() -> None:
    """Over the channels that both have, in any order; NaN where there is nothing to compare."""
    now = ModeShapes(
        ("roll", "pitch", "yaw"), ("a", "b", "c"),
        np.array([[1.0, 0.5, np.nan], [1.0, -1.0, 0.3], [np.nan, np.nan, 1.0]], dtype=complex),
    )  # fmt: skip
    before = ModeShapes(
        ("pitch", "roll", "yaw"), ("b", "a", "d"),
        np.array([[-1j, 1j, 0.1], [1.0, -0.5, 0.2], [1.0, 1.0, 1.0]]),
    )  # fmt: skip
    assert now.mac_with(before) == pytest.approx([0.0, 1.0, np.nan], nan_ok=True)
    assert now.mac_with(now)[:2] == pytest.approx([1.0, 1.0])
    assert np.isnan(now.mac_with(ModeShapes((), (), np.empty((0, 0), dtype=complex)))).all()
