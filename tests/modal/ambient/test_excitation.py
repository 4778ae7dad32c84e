"""Unsteady forces: their intensity, its share in the covariance, and the level of excitation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.io.log import Log
from lmshealth.modal.ambient.excitation import Unsteadiness, unsteadiness
from lmshealth.modal.identification import identify
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectra import cross_spectra
from tests.signals import Mode, make_log, make_stage, white

RATE, SECONDS = 400.0, 60.0
MODE = Mode(100.0, 0.02, 1.0, (1.0, -0.6))
STAGE = make_stage([("roll", 100.0, 0.02)])


def forced(seed: int, intensity: np.ndarray, noise: float = 1.0) -> Log:
    """Drive a mode by noise whose intensity over time is given, shape ``(n,)``, on a circle."""
    rng, n = np.random.default_rng(seed), intensity.size
    force = np.fft.rfft(white(rng, 1.0, n, RATE) * np.sqrt(intensity))
    moved = np.fft.irfft(force * MODE.response(np.fft.rfftfreq(n, 1 / RATE)), n)
    rows = [part * moved + white(rng, noise, n, RATE) for part in MODE.shape]
    return make_log({f"acc_{k}": row for k, row in enumerate(rows)}, RATE)


def bursts(duty: float) -> np.ndarray:
    """Intensity of bursts of equal length, six in a record."""
    t = np.arange(round(RATE * SECONDS)) / RATE
    return np.asarray((t % 10.0 < 10.0 * duty).astype(float))


def measured(log: Log, n_parts: int = 1) -> Unsteadiness:
    """Measure the unsteadiness with the true mode and noise, in parts of one length."""
    n = log.channels[0].values.size // n_parts
    parts = [Segment(k * n, (k + 1) * n, float("nan")) for k in range(n_parts)]
    spectra = cross_spectra(log.channels, parts, RATE, 150.0)
    shape = np.array(MODE.shape)
    expected = [
        np.eye(2) + np.abs(MODE.response(s.frequency))[:, None, None] ** 2 * np.outer(shape, shape)
        for s in spectra
    ]
    masks = [s.free for s in spectra]
    return unsteadiness(spectra, masks, expected, MODE.frequency, MODE.damping, shape)


@pytest.mark.parametrize("n_parts", [1, 6])
def test_the_ratio_is_that_of_the_intensity(n_parts: int) -> None:
    """Mean square over squared mean: 1 for steady noise, the inverse duty for bursts."""
    steady = measured(forced(1, np.ones(24_000)), n_parts)
    assert abs(steady.ratio - 1) < 4 / np.sqrt(steady.n)
    assert not steady.is_clear
    shaken = measured(forced(2, bursts(0.3)), n_parts)
    assert abs(shaken.ratio * 0.3 - 1) < 0.2
    assert shaken.is_clear


def test_without_transforms_a_force_counts_as_steady() -> None:
    """Means of spectra whose transforms were not kept."""
    log = forced(2, bursts(0.3))
    spectra = [
        replace(s, transforms=None)
        for s in cross_spectra(log.channels, [Segment(0, 24_000, 0.0)], RATE, 150.0)
    ]
    expected = [np.tile(np.eye(2), (s.frequency.size, 1, 1)) + 0j for s in spectra]
    found = unsteadiness(spectra, [s.free for s in spectra], expected, 100.0, 0.02, np.ones(2))
    assert found == (1.0, 0)


def test_bursts_widen_the_intervals_and_are_flagged() -> None:
    """The control, a steady force, is neither."""
    unsteady, steady = (identify(forced(3, i), STAGE) for i in (bursts(0.3), np.ones(24_000)))
    assert unsteady.flags == ("unsteady",)
    assert steady.flags == ("",)
    wider = np.sqrt(np.diag(unsteady.cov) / np.diag(steady.cov))
    assert (wider > 1.4).all()
    assert (wider < 2.4).all()


def test_excitation_is_the_level_of_the_mode() -> None:
    """Root mean square of the noise-free acceleration; four times the force, four times as much."""
    weak, strong = (identify(forced(4, np.full(24_000, i), 1e-3), STAGE) for i in (1.0, 16.0))
    quiet = forced(4, np.ones(24_000), 0.0)
    rms = np.sqrt(sum(np.mean(c.values**2) for c in quiet.channels))
    # Beyond the resonance a white force moves the channels, too.
    assert 0.9 * rms < weak.excitation[0] < 1.02 * rms
    assert abs(strong.excitation[0] / weak.excitation[0] - 4) < 0.1
