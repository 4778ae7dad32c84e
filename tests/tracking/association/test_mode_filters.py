"""Filters of single modes are textbook filters, and a stray estimate moves the level at once."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from lmshealth._private.arrays import FloatArray
from lmshealth.tracking.association.mode_filters import Measurements, ModeFilters, predict, update

HERE = (np.zeros(2, dtype=int), np.arange(2))


def measured(ln_f: FloatArray, shapes: FloatArray | None = None) -> Measurements:
    """Make estimates of σ(ln f) 0.001 and σ(ln ζ) 0.1."""
    n = len(ln_f)
    own = np.empty((n, 0)) if shapes is None else shapes
    return Measurements(ln_f, np.full(n, 1e-6), np.full(n, -4.0), np.full(n, 0.01), own)


def test_filters_are_textbook_filters() -> None:
    """Two modes with a covariate over irregular logs equal filterpy's filter to 1e-9."""
    rng = np.random.default_rng(1)
    b_std, scale = np.array([1e-3]), 50.0
    y = 4.8 + 5e-4 * rng.standard_normal((30, 2))
    x, steps = rng.uniform(-10, 10, 30), rng.uniform(0.5, 2.0, 30)
    filters = ModeFilters.empty(1, 0).start(
        measured(y[0]), np.array([1.0, 0.0, x[0]]), b_std, scale
    )
    plain = KalmanFilter(dim_x=3, dim_z=1)
    plain.x = np.array([[y[0, 1]], [0.0], [0.0]])
    plain.P = np.diag([1e-6 + (x[0] * 1e-3) ** 2, (0.3 / scale) ** 2, 1e-6])
    plain.P[0, 2] = plain.P[2, 0] = -x[0] * 1e-6
    plain.R = np.array([[1e-6]])
    np.testing.assert_allclose(filters.cov[0, 1], plain.P)
    for k in range(1, 30):
        t = steps[k]
        filters = predict(filters, t, scale)
        row = np.array([1.0, 0.0, x[k]])
        filters = update(filters, HERE, measured(y[k]), row)
        white = 0.1**2 / scale**3
        noise = np.zeros((3, 3))
        noise[:2, :2] = white * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
        noise[0, 0] += 3e-3**2 * t / scale
        plain.predict(F=np.array([[1, t, 0], [0, 1, 0], [0, 0, 1]]), Q=noise)
        plain.update(y[k, 1], H=row[None])
    np.testing.assert_allclose(filters.mean[0, 1], plain.x[:, 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(filters.cov[0, 1], plain.P, rtol=1e-7, atol=1e-14)


def test_a_stray_estimate_reopens_the_level() -> None:
    """An innovation of ten σ moves the level by more than half of it, one within σ hardly."""
    row = np.array([1.0, 0.0])
    filters = ModeFilters.empty(0, 0).start(measured(np.full(2, 4.8)), row, np.zeros(0), 50.0)
    for _ in range(30):
        filters = predict(filters, 1.0, 50.0)
        filters = update(filters, HERE, measured(np.full(2, 4.8)), row)
    filters = update(filters, HERE, measured(np.array([4.81, 4.801])), row)
    far, near = filters.mean[0, :, 0] - 4.8
    assert 0.5 < far / 0.01 < 1
    assert 0 < near / 0.001 < 0.5


def test_rates_are_held_within_their_prior() -> None:
    """The rate estimated from the first two logs shrinks once a life proves longer."""
    row = np.array([1.0, 0.0])
    filters = ModeFilters.empty(0, 0).start(measured(np.array([4.8])), row, np.zeros(0), 0.0)
    for scale in (1.0, 100.0, 1e4):
        filters = predict(filters, scale / 50, scale)
        assert np.sqrt(filters.cov[0, 0, 1, 1]) * scale == pytest.approx(0.3, rel=0.01)


def test_shapes_are_averaged_whatever_their_sign() -> None:
    """A shape of either sign gives the same mean; channels that appear later join it."""
    row = np.array([1.0, 0.0])
    first = np.array([[0.6, 0.8, np.nan]])
    filters = ModeFilters.empty(0, 3).start(
        measured(np.array([4.8]), first), row, np.zeros(0), 50.0
    )
    at = (np.zeros(1, dtype=int), np.zeros(1, dtype=int))
    filters = update(filters, at, measured(np.array([4.8]), np.array([[-0.6, -0.8, np.nan]])), row)
    np.testing.assert_allclose(filters.shapes[0, 0, :2], [0.6, 0.8])
    filters = update(filters, at, measured(np.array([4.8]), np.array([[-0.6, 0.0, 0.8]])), row)
    assert np.isfinite(filters.shapes).all()
    assert filters.shapes[0, 0, 2] < 0
    assert np.sum(filters.shapes**2) == pytest.approx(1.0)
