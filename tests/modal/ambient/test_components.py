"""Responses of modes and floors: what they are, and their derivatives."""

from __future__ import annotations

import numpy as np

from lmshealth.modal.ambient.whittle import (
    SECOND,
    floor_response,
    floors,
    receptance,
    response,
)
from tests.signals import Mode

F = np.linspace(80.0, 160.0, 41)
U = np.linspace(-1.2, 1.2, 41)


def test_a_mode_moves_as_the_equation_of_motion_has_it() -> None:
    """The response is that of -ω² / (ω_n² - ω² + 2iζω_nω), in size and phase."""
    mode = Mode(120.0, 0.02)
    expected = mode.response(F)
    np.testing.assert_allclose(response(120.0, 0.02, F), expected, rtol=1e-12)
    # The mirrored phase is another machine.
    assert np.abs(response(120.0, 0.02, F) - expected.conj()).max() > 1


def test_floors_are_exponentials_of_parabolas() -> None:
    """Half the logarithm of the density: at the middle e/2, at the ends with tilt and bend."""
    found = floor_response(np.array([[0.4, 0.6, -0.2]]), np.array([-1.0, 0.0, 1.0]))
    np.testing.assert_allclose(np.log(found[0]), [-0.2, 0.2, 0.4], atol=1e-15)


def test_derivatives_of_modes_are_those_of_their_response() -> None:
    """First and second derivatives by ln f and ln ζ agree with central differences."""
    at, h = np.log([120.0, 0.02]), 1e-5

    def moved(*step: float) -> np.ndarray:
        return response(*np.exp(at + step), F)

    found = receptance(np.array([[120.0]]), np.array([[0.02]]), F)[:, 0]
    np.testing.assert_allclose(found[0], moved(0, 0), rtol=1e-12)
    for q, step in enumerate(np.eye(2) * h):
        first = (moved(*step) - moved(*-step)) / (2 * h)
        np.testing.assert_allclose(found[1 + q], first, atol=1e-6 * np.abs(first).max())
        for r, other in enumerate(np.eye(2) * h):
            second = moved(*(step + other)) - moved(*(step - other))
            second = (second - moved(*(other - step)) + moved(*(-step - other))) / (4 * h**2)
            np.testing.assert_allclose(
                found[SECOND[q, r]], second, atol=1e-4 * np.abs(second).max()
            )
    assert not found[[3, 6, 8, 9]].any()


def test_derivatives_of_floors_are_those_of_their_response() -> None:
    """First and second derivatives by e, d and b agree with central differences."""
    at, h = np.array([0.4, 0.6, -0.2]), 1e-4

    def moved(step: np.ndarray) -> np.ndarray:
        return floor_response((at + step)[None], U)[0]

    found = floors(at[None], U)[:, 0].real
    np.testing.assert_allclose(found[0], moved(np.zeros(3)), rtol=1e-12)
    for q, step in enumerate(np.eye(3) * h):
        np.testing.assert_allclose(found[1 + q], (moved(step) - moved(-step)) / (2 * h), atol=1e-7)
        for r, other in enumerate(np.eye(3) * h):
            second = moved(step + other) - moved(step - other) - moved(other - step)
            second = (second + moved(-step - other)) / (4 * h**2)
            np.testing.assert_allclose(found[SECOND[q, r]], second, atol=1e-6)
