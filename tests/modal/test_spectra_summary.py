"""Spectra and their fit in bins."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal.identification import read_ambient
from lmshealth.modal.spectra_summary import summarise
from tests.signals import Mode, accelerations, density, make_log, make_stage, sine, white

RATE, N, NOISE = 500.0, 64000, 0.5
MODE = Mode(62.0, 0.02, 1.0, (1.0, 0.5))


def test_levels_fit_and_singular_values_are_those_of_the_process() -> None:
    """Two channels show a mode, one of them a line, which keeps its power."""
    rng = np.random.default_rng(5)
    one, two = accelerations(rng, [MODE], N, RATE, NOISE)
    log = make_log({"acc_a": one + sine(N, RATE, 75.0, 3.0), "acc_b": two}, RATE)
    reading = read_ambient(log, make_stage([("roll", 62.0, 0.02)]))
    summary = summarise(
        reading.spectra, reading.fitted, reading.modes, (50.0, 80.0), 100, n_singular=2
    )
    middle = (summary.edges[1:] + summary.edges[:-1]) / 2
    true = 10 * np.log10(density([MODE], middle, NOISE))
    line = np.abs(middle - 75.0) < 0.5
    scatter = 20 / float(np.sqrt(summary.count[0]))
    assert summary.level[0][~line] == pytest.approx(true[~line], abs=scatter)
    shown = np.isfinite(summary.fitted[0])
    assert shown.sum() > 20
    assert summary.fitted[0][shown] == pytest.approx(true[shown], abs=1.5)
    excess = 10 ** (summary.level[0].astype(float) / 10) - density([MODE], middle, NOISE)
    power = excess[line] @ np.diff(summary.edges)[line]
    assert power == pytest.approx(3.0**2 / 2, rel=0.15)
    # The mode has one shape: the second singular value is the noise.
    peak = int(np.argmax(summary.singular[0] * ~line))
    assert middle[peak] == pytest.approx(62.0, abs=1.0)
    noise = 10 * np.log10(NOISE)
    assert np.median(summary.singular[1].astype(float)) == pytest.approx(noise, abs=1.0)


def test_a_channel_without_power_has_no_level() -> None:
    """Its logarithm is missing, not infinite; a single channel has no singular values."""
    rng = np.random.default_rng(5)
    log = make_log({"acc_a": white(rng, 1.0, 8000, RATE)}, RATE)
    reading = read_ambient(log, band=(50.0, 80.0))
    spectra = reading.spectra
    summary = summarise(spectra, (), reading.modes, (50.0, 80.0), 100, n_singular=2)
    assert summary.singular.shape == (0, summary.count.size)
    assert np.isfinite(summary.level).all()
    assert np.isnan(summary.fitted).all()
