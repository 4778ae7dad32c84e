"""Harmonics: sums of known sines, white noise, Parseval, and the record rebuilt."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.signal.readings import Harmonics, decompose
from tests.harmonics import rebuild

RATE = 2000.0
SINES = ((3, 2.5e-6, 0.4), (117, 4e-8, -2.9), (250, 1e-6, 1.5))


def sines(n: int, mean: float = -1.2e-7) -> np.ndarray:
    """Sum cosines of known amplitude and phase with whole periods in the record."""
    t = np.arange(n)
    return np.asarray(mean + sum(a * np.cos(2 * np.pi * k * t / n + p) for k, a, p in SINES))


@pytest.mark.parametrize("n", [4000, 4001])
def test_sums_of_sines_read_their_amplitudes_and_phases(n: int) -> None:
    """Amplitude, phase, frequency and mean are exact to 1e-9; all others are nothing."""
    found = decompose(sines(n), RATE)
    for k, amplitude, phase in SINES:
        assert found.frequency[k - 1] == pytest.approx(k * RATE / n, rel=1e-12)
        assert found.amplitude[k - 1] == pytest.approx(amplitude, rel=1e-9)
        assert found.phase[k - 1] == pytest.approx(phase, abs=1e-9)
    assert found.mean == pytest.approx(-1.2e-7, rel=1e-9)
    rest = np.delete(found.amplitude, [k - 1 for k, *_ in SINES])
    assert rest.max() < 1e-9 * 4e-8


def test_half_the_sample_rate_reads_its_amplitude() -> None:
    """A cosine at every second sample counts fully: amplitude 3, mean square 9."""
    found = decompose(3.0 * (-1.0) ** np.arange(100.0), RATE)
    assert found.amplitude[-1] == pytest.approx(3.0, rel=1e-12)
    assert found.power[-1] == pytest.approx(9.0, rel=1e-12)


@pytest.mark.parametrize("n", [4000, 4001])
def test_powers_add_up_to_the_variance(n: int) -> None:
    """Parseval holds to rounding, odd and even."""
    x = np.random.default_rng(1).normal(5.0, 2.0, n)
    assert decompose(x, RATE).power.sum() == pytest.approx(x.var(), rel=1e-12)


@pytest.mark.parametrize("n", [400, 401])
def test_all_harmonics_together_are_the_record(n: int) -> None:
    """Summing every harmonic and the mean gives each sample back to rounding."""
    x = np.random.default_rng(2).normal(1.0, 1.0, n)
    found = decompose(x, RATE)
    np.testing.assert_allclose(rebuild(found, np.arange(n // 2)), x, rtol=0, atol=1e-12)


@pytest.mark.parametrize("n", [400, 401])
def test_some_harmonics_are_the_sum_of_their_cosines(n: int) -> None:
    """The rebuilt record is A cos(2πft + φ) added up, half the sample rate included."""
    found = decompose(np.random.default_rng(3).normal(1.0, 1.0, n), RATE)
    kept = np.append(found.strongest(5), n // 2 - 1)
    t = np.arange(n) / RATE
    added = found.mean + sum(
        found.amplitude[i] * np.cos(2 * np.pi * found.frequency[i] * t + found.phase[i])
        for i in set(kept.tolist())
    )
    np.testing.assert_allclose(rebuild(found, kept), added, rtol=0, atol=1e-12)


def test_white_noise_has_its_density_in_every_harmonic() -> None:
    """The mean power of a harmonic of white noise is S / T within its Monte-Carlo error."""
    level, n, n_records = 3e-4, 200, 4000
    noise = np.random.default_rng(4).normal(0, np.sqrt(level * RATE / 2), (n_records, n))
    mean = np.mean([decompose(row, RATE).power for row in noise], axis=0)[:-1]
    off = (mean / (level * RATE / n) - 1) * np.sqrt(n_records)
    assert np.abs(off).max() < 4.5
    assert abs(off.mean()) * np.sqrt(off.size) < 4.5
    # Negative control: one part in ten too much would be seen.
    assert abs((1.1 * mean / (level * RATE / n) - 1).mean()) * np.sqrt(n_records * off.size) > 4.5


def test_the_strongest_come_first_and_no_more_than_there_are() -> None:
    """Harmonics are ordered by amplitude; asking for more than there are gives all."""
    found = decompose(sines(4000), RATE)
    assert (found.strongest(3) + 1).tolist() == [3, 250, 117]
    assert found.strongest(10_000).size == 2000


def test_between_leaves_out_its_edges() -> None:
    """A band holds the harmonics strictly inside it."""
    found = decompose(sines(4000), RATE)
    inside = found.frequency[found.between(10.0, 12.0)]
    np.testing.assert_allclose(inside, [10.5, 11.0, 11.5])


def test_arrays_that_differ_in_shape_are_no_harmonics() -> None:
    """Amplitudes without phases are refused."""
    with pytest.raises(ValueError, match="has shape"):
        Harmonics(0.0, np.ones(3), np.ones(3), np.ones(2), 1.0, 6)
