"""Tests of the controllers."""

from dataclasses import replace

import numpy as np
import pytest

from models.errors import BadParameter
from models.servo import TUNINGS, controller, current_loop, loop_margins, servo_matrices

# Coefficients a1.. and b2.. in ascending powers, signs of exponents and misprints corrected.
PRINTED = {
    "lms-x": (
        [3.482e10, 6.260e10, 1.245e9, 1.529e5, 4.000e2],
        [6.810e10, 7.431e7, 5.859e4, 2.304e1, 6.192e-3],
    ),
    "lms-y": (
        [8.085e9, 1.032e10, 2.631e8, 2.750e5, 5.108e2, 2.441e-1, 1.954e-4],
        [1.977e10, 6.944e7, 1.163e5, 1.177e2, 7.240e-2, 2.553e-5, 4.303e-9],
    ),
}


def factored(tuning, s):
    """Return the controller and current loop by plain complex arithmetic."""

    def section(high, low, w):
        return (s**2 + 2 * high * w * s + w**2) / (s**2 + 2 * low * w * s + w**2)

    w = 2 * np.pi * tuning.low_pass_hz
    value = (s + tuning.position_gain) * (tuning.velocity_p * s + tuning.velocity_i) / s
    value *= w**2 / (s**2 + 2 * tuning.low_pass_damping * w * s + w**2)
    for part in tuning.sections:
        value *= section(part.damping_above, part.damping_below, 2 * np.pi * part.frequency_hz)
    value *= tuning.drive_gain / tuning.divisor
    numerator = tuning.current_p * s + tuning.current_i
    total = tuning.current_p + tuning.resistance
    return value * numerator / (tuning.inductance * s**2 + total * s + tuning.current_i)


@pytest.mark.parametrize("name", sorted(TUNINGS))
def test_state_space_equals_the_factors(name):
    """The series connection has the frequency response of the factors' product."""
    tuning = TUNINGS[name]
    matrices = servo_matrices(tuning)
    for hertz in (0.01, 1.0, 20.0, 160.0, 280.0, 5000.0):
        s = 2j * np.pi * hertz
        size = matrices.b.size
        found = matrices.c @ np.linalg.solve(s * np.eye(size) - matrices.a, matrices.b)
        assert abs(found / factored(tuning, s) - 1) < 1e-9


@pytest.mark.parametrize("name", sorted(PRINTED))
def test_factors_equal_the_printed_polynomials(name):
    """The factored controllers meet equations (8) and (9), errata applied, within 1 %."""
    numerator, denominator = PRINTED[name]
    drive = TUNINGS[name].drive_gain
    chain = controller(TUNINGS[name])
    for hertz in np.geomspace(0.05, 2000.0, 60):
        s = 2j * np.pi * hertz
        printed = np.polyval(numerator[::-1], s) / np.polyval([*denominator[::-1], 0.0], s)
        assert abs(chain(s) / (drive * printed) - 1) < 1e-2


@pytest.mark.parametrize(
    ("name", "mass", "crossover", "phase", "gain"),
    [("lms-x", 23.5, 19.6, 55.8, 24.5), ("lms-y", 25.0, 6.5, 37.0, 31.4)],
)
def test_rigid_margins(name, mass, crossover, phase, gain):
    """The rigid loop of the corrected equations has the margins found by checking the paper."""
    margins = loop_margins(TUNINGS[name], mass)
    assert margins["crossover_hz"] == pytest.approx(crossover, abs=0.05)
    assert margins["phase_margin_deg"] == pytest.approx(phase, abs=0.1)
    assert margins["gain_margin_db"] == pytest.approx(gain, abs=0.1)


def test_current_loop_has_unit_gain():
    """A steady command is the steady current."""
    assert current_loop(TUNINGS["lms-x"]).dcgain() == pytest.approx(1.0)


def test_negative_gain_is_refused():
    """A loop of wrong sign raises before it is closed."""
    with pytest.raises(BadParameter, match="drive_gain"):
        replace(TUNINGS["lms-x"], drive_gain=-1.0)
