"""Tests of the controllers."""

import sys
from dataclasses import fields, replace

import numpy as np
import pytest

from models.dynamics.equations import CONTROLLER, ratio
from models.dynamics.servo import (
    TUNINGS,
    controller,
    current_loop,
    delay_sections,
    python_control,
    servo_matrices,
)
from models.errors import BadParameter, MissingLibrary


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


@pytest.mark.slow
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


@pytest.mark.parametrize("name", sorted(TUNINGS))
def test_factors_equal_the_corrected_polynomials(name):
    """The factored controllers meet equations (8) and (9), errata applied, within 0.6 %."""
    s = 2j * np.pi * np.geomspace(0.05, 2000.0, 60)
    printed = TUNINGS[name].drive_gain * ratio(CONTROLLER[name], "corrected")(s)
    assert np.abs(controller(TUNINGS[name])(s) / printed - 1).max() < 6e-3


def test_current_loop_has_unit_gain():
    """A steady command is the steady current."""
    assert current_loop(TUNINGS["lms-x"]).dcgain() == pytest.approx(1.0)


NUMBERS = [f.name for f in fields(TUNINGS["lms-x"]) if f.name not in ("name", "sections")]


@pytest.mark.parametrize("value", [-1.0, 0.0, 0, float("nan"), float("inf")])
def test_numbers_that_are_not_positive_are_refused(value):
    """Every number of a tuning and of its sections is named, before a loop is closed."""
    for part in (TUNINGS["lms-x"], TUNINGS["lms-x"].sections[0]):
        for name in NUMBERS if part is TUNINGS["lms-x"] else part.__slots__:
            with pytest.raises(BadParameter, match=f"{name} is {value}; needed: a positive"):
                replace(part, **{name: value})


def test_a_missing_library_is_named_with_its_extra(monkeypatch):
    """Without python-control the error names the extra that installs it."""
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(MissingLibrary, match=r"control: pip install 'lmshealth\[models\]'"):
        python_control()


def test_delay_delays():
    """The delay lets every frequency pass, and lags by its time up to 0.6 cycles within 1°."""
    first, second = delay_sections(3e-3)
    hertz = np.array([5.0, 50.0, 200.0])
    response = first(2j * np.pi * hertz) * second(2j * np.pi * hertz)
    np.testing.assert_allclose(np.abs(response), 1.0, rtol=1e-9)
    lag = np.angle(response * np.exp(2j * np.pi * hertz * 3e-3), deg=True)
    assert np.abs(lag).max() < 1.0
