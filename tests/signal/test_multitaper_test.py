"""Multitaper test: its statistic, its tails in noise and resonances, and removal of lines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft

from lmshealth.signal import constants
from lmshealth.signal import spectral_lines as linetest
from lmshealth.signal.spectral_lines import detect_sinusoids
from tests.signals import Mode, accelerations, sine, white

RATE = 1000.0
BAND = (20.0, 450.0)


def found_in(*segments: np.ndarray, alarm: float = 0.01) -> np.ndarray:
    """Test segments together."""
    lengths = [segment.size for segment in segments]
    return detect_sinusoids(lengths, lambda number: segments[number], RATE, BAND, alarm)


def shares(
    rng: np.random.Generator, width: float, limits: np.ndarray, n: int = 20_000
) -> np.ndarray:
    """How often noise so many ordinates wide is explained by a sine to more than a limit."""
    size = 200
    # A complex process of first order: its density is that of a resonance about its peak.
    decay = np.exp(-np.pi * width / size)
    draws = rng.standard_normal((2, n, size))
    steps = draws[0] + 1j * draws[1]
    state, turned = steps[:, 0], [steps[:, 0]]
    for step in steps[:, 1:].T:
        state = decay * state + np.sqrt(1 - decay**2) * step
        turned.append(state)
    k, j = np.arange(1, 8), np.arange(1, size + 1)
    tapers = np.sin(np.pi * np.outer(k, j) / (size + 1))
    seen, weight = np.array(turned).T @ tapers.T, tapers.sum(axis=1)
    explained = np.abs(seen @ weight) ** 2 / (weight @ weight)
    ratio = explained / (np.sum(np.abs(seen) ** 2, axis=1) - explained)
    return np.mean(ratio[:, None] > limits, axis=0)


def test_all_tapers_are_in_one_transform() -> None:
    """Explained over unexplained power is that of seven written-out tapers, between ordinates."""
    n, index = 301, 174
    x = np.random.default_rng(1).standard_normal(n)
    ratio, squared = linetest._line_test(fft.rfft(x, 4 * (n + 1)), n, index, index + 1)
    j, k = np.arange(n), np.arange(1, 8)
    tapers = np.sqrt(2 / (n + 1)) * np.sin(np.pi * np.outer(k, j + 1) / (n + 1))
    seen = tapers @ (x * np.exp(-2j * np.pi * index / (4 * (n + 1)) * j))
    weight = tapers.sum(axis=1)
    amplitude = seen @ weight / (weight @ weight)
    explained = np.abs(amplitude) ** 2 * (weight @ weight)
    rest = np.sum(np.abs(seen - amplitude * weight) ** 2)
    assert ratio[0] == pytest.approx(explained / rest, rel=1e-9)
    assert squared[0] == pytest.approx(4 * np.abs(amplitude) ** 2, rel=1e-9)


@pytest.mark.parametrize("width", [0.5, 2.0, 8.0])
@pytest.mark.slow
def test_the_tail_in_a_resonance_is_that_of_a_simulated_one(width: float) -> None:
    """At three limits the share of 20,000 draws is as computed within 4σ, and not as in noise."""
    limits = np.array([0.5, 1.5, 4.0])
    p = np.exp(-linetest._resonance_evidence(limits, width))
    share = shares(np.random.default_rng(2), width, limits)
    std = np.sqrt(p * (1 - p) / 20_000)
    assert np.all(np.abs(share - p) < 4 * std + 0.02 * p)
    assert share[0] - np.exp(-linetest._noise_evidence(limits))[0] > 4 * std[0]


def test_a_resonance_wider_than_all_is_white() -> None:
    """The computed tail goes over into that of Fisher's F, and falls as the width grows."""
    limits = np.array([0.5, 3.0, 20.0])
    np.testing.assert_allclose(
        linetest._resonance_evidence(limits, 1e5), linetest._noise_evidence(limits), rtol=1e-9
    )
    evidence = np.array(
        [linetest._resonance_evidence(limits, w) for w in (0.1, 0.5, 2.0, 8.0, 30.0)]
    )
    assert np.all(np.diff(evidence, axis=0) > 0)


@pytest.mark.slow
def test_narrow_resonances_in_a_long_record_are_no_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 20 records of 30 s with four resonances of 0.2 % none alarms; taken for noise, most do."""
    # At the bottom of octaves they are narrowest: two ordinates of a block.
    modes = [Mode(f, 0.002) for f in (47.1, 93.3, 185.2, 365.4)]
    rng = np.random.default_rng(3)
    records = [accelerations(rng, modes, 30_000, RATE, 0.1)[0] for _ in range(20)]
    assert not any(found_in(record, alarm=1e-3).size for record in records)
    monkeypatch.setattr(constants, "LEAST_DAMPING", 1e3)
    assert np.mean([found_in(record, alarm=1e-3).size > 0 for record in records]) > 0.5


def unsteady(kind: str, frequency: float, n: int = 4000) -> np.ndarray:
    """Make a line of amplitude one that does not quite keep frequency or amplitude."""
    t = np.linspace(0, 1, n)
    size = {"fades": 1 - 0.1 * t, "halves": 0.5**t}.get(kind, 1.0)
    phase = {"drifts": 0.8 * t**2, "wanders": 0.3 * np.sin(5 * t)}.get(kind, 0.0)
    return size * np.sin(2 * np.pi * frequency * np.arange(n) / RATE + phase)


@pytest.mark.parametrize("kind", ["steady", "fades", "halves", "drifts", "wanders"])
def test_an_unsteady_line_has_no_satellites(kind: str) -> None:
    """Of 40 dB to 120 dB, alone in noise, it is shown once or not at all."""
    rng = np.random.default_rng(4)
    for size in (0.2, 2.0, 20.0, 2000.0):
        for frequency in rng.uniform(100, 170, 5).tolist():
            values = size * unsteady(kind, frequency) + white(rng, 1e-2, 4000, RATE)
            assert len(found_in(values, alarm=1e-4)) <= 1


@pytest.mark.parametrize("gap", [5.0, 7.5, 10.0, 13.0])
def test_a_weak_line_stands_beside_a_strong_one(gap: float) -> None:
    """A tenth as strong, from five ordinates on, it is read in most records; nothing else is."""
    rng, n_read = np.random.default_rng(5), 0
    for strong in rng.uniform(100.0, 100.25, 20).tolist():
        weak = strong + gap * RATE / 4000
        values = sine(4000, RATE, strong, 1.0) + white(rng, 1e-5, 4000, RATE)
        values += sine(4000, RATE, weak, 0.1, phase=rng.uniform(0, 6))
        found = found_in(values, alarm=1e-4)
        read = [(strong, 1.0), (weak, 0.1)][: len(found)]
        np.testing.assert_allclose(found[:, 0], [f for f, _ in read], atol=0.02)
        np.testing.assert_allclose(found[:, 1], [size for _, size in read], rtol=0.15)
        n_read += len(found) == 2
    assert n_read >= 18


def test_segments_show_together_what_none_shows_alone() -> None:
    """Sixteen of half a second show a line, each at a phase of its own; four without it do not."""
    rng = np.random.default_rng(6)
    parts = [
        sine(500, RATE, 141.0, 0.5, phase=rng.uniform(0, 6)) + white(rng, 1e-2, 500, RATE)
        for _ in range(16)
    ]
    ((frequency, amplitude),) = found_in(*parts)
    assert frequency == pytest.approx(141.0, abs=0.1)
    assert amplitude == pytest.approx(0.5, rel=0.15)
    assert not any(found_in(part, alarm=0.01 / 16).size for part in parts)


def test_segments_much_shorter_than_the_longest_are_left_out() -> None:
    """Half as long is read and a little less is not; the blocks have the length of the half."""
    noise = white(np.random.default_rng(7), 1e-2, 4000, RATE)
    read: list[int] = []

    def samples(number: int) -> np.ndarray:
        read.append(number)
        return noise[: (4000, 1999, 2000)[number]]

    detect_sinusoids([4000, 1999, 2000], samples, RATE, BAND, 0.01)
    assert set(read) == {0, 2}


def test_what_is_found_does_not_depend_on_the_band() -> None:
    """Cut at other frequencies, the band shows the same line to the last digit."""
    values = sine(4000, RATE, 100.3, 1.0) + white(np.random.default_rng(8), 1e-3, 4000, RATE)
    one, other = [detect_sinusoids([4000], lambda _: values, RATE, band, 1e-4) for band in
            ((20.0, 450.0), (93.0, 130.0))]  # fmt: skip
    np.testing.assert_array_equal(one, other)
    assert len(detect_sinusoids([4000], lambda _: values, RATE, (101.5, 130.0), 1e-4)) == 0


@pytest.mark.parametrize("n", [3000, 4000, 5003])
def test_no_line_falls_between_octaves(n: int) -> None:
    """About the cuts at 45, 90, 180 and 360 Hz, whose octaves have grids of their own."""
    rng = np.random.default_rng(8)
    for cut in (45.0, 90.0, 180.0, 360.0):
        for frequency in cut + np.array([-0.2, -0.05, 0.0, 0.02, 0.2]) * RATE / n:
            values = sine(n, RATE, frequency, 1.0, phase=1.0) + white(rng, 1e-4, n, RATE)
            found = found_in(values, alarm=1e-4)
            np.testing.assert_allclose(found[:, 0], [frequency], atol=0.02)
