"""Peaks: resonances stand out at their own width; noise and lines do not."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal.ambient.candidates import find_excess, find_peaks
from lmshealth.modal.targets import Target
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectra import Spectrum, periodogram
from tests.signals import Mode, accelerations, make_log, sine, white

RATE = 1000.0


def transform(values: np.ndarray) -> tuple[Spectrum, ...]:
    """Transform a channel."""
    (channel,) = make_log({"acc_a": values}, RATE).channels
    return (periodogram(channel, Segment(0, values.size, float("nan")), RATE),)


def near(targets: tuple[Target, ...], frequency: float, share: float = 0.04) -> bool:
    """Return whether a target is within a share of a frequency."""
    return any(abs(target.frequency / frequency - 1) < share for target in targets)


@pytest.mark.parametrize("damping", [0.004, 0.01, 0.03])
def test_a_resonance_is_a_start_that_a_fit_can_use(damping: float) -> None:
    """The frequency is well inside the search about the start, the damping of its order."""
    values = accelerations(np.random.default_rng(1), [Mode(120.0, damping)], 60_000, RATE, 0.1)
    targets = find_peaks(transform(values[0]), 40.0, 300.0)
    best = min(targets, key=lambda target: abs(target.frequency - 120.0))
    assert abs(best.frequency / 120.0 - 1) < best.search / 2
    assert 0.1 < best.damping_ratio / damping < 10


def test_modes_of_all_channels_are_listed_once_in_ascending_order() -> None:
    """Two modes, each in its own channel and one in both, make two candidates."""
    modes = [Mode(90.0, 0.01, 1.0, (1.0, 1.0)), Mode(160.0, 0.01, 1.0, (0.0, 1.0))]
    values = accelerations(np.random.default_rng(2), modes, 60_000, RATE, 0.05)
    targets = find_peaks([s for row in values for s in transform(row)], 40.0, 300.0)
    assert near(targets, 90.0)
    assert near(targets, 160.0)
    frequencies = [target.frequency for target in targets]
    assert frequencies == sorted(frequencies)
    assert [target.name for target in targets] == [f"mode_{k + 1}" for k in range(len(targets))]
    assert sum(abs(f / 90 - 1) < 0.04 for f in frequencies) == 1


def test_white_noise_has_hardly_any_peaks() -> None:
    """Twenty records of noise give at most one candidate together."""
    rng = np.random.default_rng(3)
    found = [find_peaks(transform(white(rng, 1.0, 20_000, RATE)), 20, 450) for _ in range(20)]
    assert sum(len(targets) for targets in found) <= 1


def test_a_line_is_no_peak() -> None:
    """A line ten thousand times above the noise poses as no resonance."""
    values = white(np.random.default_rng(4), 1.0, 60_000, RATE) + sine(60_000, RATE, 50.0, 20.0)
    assert not near(find_peaks(transform(values), 20.0, 300.0), 50.0)


def test_a_wandering_line_that_is_known_is_no_peak() -> None:
    """Mains wandering by a few ordinates look like a resonance until they are named as a line."""
    n, rng = 60_000, np.random.default_rng(7)
    frequency = 150.0 + 0.1 * np.sin(2 * np.pi * np.arange(n) / n * 2.4)
    phase = 2 * np.pi * np.cumsum(frequency) / RATE
    spectra = transform(white(rng, 1.0, n, RATE) + 3.0 * np.sin(phase))
    assert near(find_peaks(spectra, 20.0, 300.0), 150.0)
    assert not near(find_peaks(spectra, 20.0, 300.0, [150.0]), 150.0)


def test_a_resonance_beside_a_known_line_is_kept() -> None:
    """Only the ordinates that a line reaches are laid flat."""
    values = accelerations(np.random.default_rng(8), [Mode(120.0, 0.01)], 60_000, RATE, 0.1)[0]
    spectra = transform(values + sine(60_000, RATE, 119.0, 30.0))
    assert near(find_peaks(spectra, 40.0, 300.0, [119.0]), 120.0, 0.02)


def means(rng: np.random.Generator, hump: np.ndarray, count: int) -> Spectrum:
    """Draw the mean of some periodograms of 20 s about a density."""
    frequency = np.arange(400, 400 + hump.size) / 20.0
    drawn = hump * rng.gamma(count, 1 / count, size=hump.size)
    return Spectrum(frequency, drawn, 20.0, 0.0, count)


def test_means_show_peaks_that_single_records_hide() -> None:
    """A hump of 40 % above the noise stands out of the mean of 30 records, and not of one."""
    frequency = np.arange(400, 6000) / 20.0
    hump = 1 + 0.4 / (1 + ((frequency - 126.4) / 1.5) ** 2)
    rng = np.random.default_rng(9)
    for count, seen in ((1, 0), (30, 8)):
        found = [find_peaks((means(rng, hump, count),), 30.0, 280.0) for _ in range(8)]
        assert sum(near(targets, 126.4, 0.02) for targets in found) == seen


@pytest.mark.parametrize("wide", [1, 2])
def test_no_peak_is_narrower_than_four_ordinates(wide: int) -> None:
    """What rises in one ordinate or two of a mean is a candidate at least four ordinates wide."""
    density = np.ones(5600)
    density[200 : 200 + wide] = 12.0
    spectrum = means(np.random.default_rng(14), density, 30)
    peaks = find_peaks((spectrum,), 20.5, 280.0)
    assert near(peaks, float(spectrum.frequency[200]), 0.005)
    # A scale, half the width of a peak, is 1.5 damping ratios.
    widths = [2 * 1.5 * t.damping_ratio * t.frequency * spectrum.duration for t in peaks]
    assert min(widths) >= 4


def test_means_leave_over_what_single_records_hide() -> None:
    """A fit that lacks 20 % over 3 Hz is found out by the mean of 30 records, and not by one."""
    frequency = np.arange(400, 6000) / 20.0
    hump = 1 + 0.2 / (1 + ((frequency - 126.4) / 1.5) ** 2)
    rng = np.random.default_rng(13)
    for count, seen in ((1, 0), (30, 8)):
        found = [find_excess(means(rng, hump, count)) for _ in range(8)]
        assert sum(one is not None for one in found) == seen
        assert all(abs(one.frequency - 126.4) < 3 for one in found if one is not None)


def test_the_noise_of_means_has_hardly_any_peaks() -> None:
    """Twenty means of ten records give at most one candidate together, and no excess."""
    rng = np.random.default_rng(10)
    spectra = [means(rng, np.ones(5600), 10) for _ in range(20)]
    assert sum(len(find_peaks((s,), 30.0, 280.0)) for s in spectra) <= 1
    assert [find_excess(s) for s in spectra] == [None] * 20


def test_lines_tower_in_means_as_in_single_records() -> None:
    """An ordinate as far above the others as a sine of one record is no peak of a mean either."""
    rng = np.random.default_rng(11)
    for count in (1, 10):
        density = np.ones(5600)
        density[2000] = 400.0
        line = means(rng, density, count)
        assert find_peaks((line,), 30.0, 280.0) == ()


def test_an_excess_narrower_than_asked_for_does_not_count() -> None:
    """With a least damping only a broad excess is found, near a narrow one, or none."""
    frequency = np.arange(2000, 3500) / 20.0
    narrow = 30 / (1 + ((frequency - 126.4) / 0.1) ** 2)
    broad = 1 / (1 + ((frequency - 150.0) / 3.0) ** 2)
    noise = np.random.default_rng(12).exponential(size=frequency.size)
    for more, there in ((0.0, False), (broad, True)):
        residual = Spectrum(frequency, noise * (1 + narrow + more), 20.0, 0.0)
        found = find_excess(residual)
        assert found is not None
        assert abs(found.frequency - 126.4) < 0.3
        wide = find_excess(residual, 0.01)
        assert (wide is not None) == there
        assert wide is None or abs(wide.frequency - 150.0) < 4.0


def test_peaks_do_not_depend_on_the_unit() -> None:
    """Signals in another unit have the same candidates."""
    values = accelerations(np.random.default_rng(5), [Mode(120.0, 0.01)], 30_000, RATE, 0.1)[0]
    one, other = (find_peaks(transform(v), 40.0, 300.0) for v in (values, 1e-7 * values))
    assert [t.name for t in one] == [t.name for t in other]
    np.testing.assert_allclose([t.frequency for t in one], [t.frequency for t in other])


def test_only_the_band_is_searched() -> None:
    """A resonance outside the band is no candidate."""
    values = accelerations(np.random.default_rng(6), [Mode(120.0, 0.01)], 60_000, RATE, 0.1)
    assert not near(find_peaks(transform(values[0]), 150.0, 300.0), 120.0)


def test_what_a_fit_leaves_over_is_found_and_noise_is_not() -> None:
    """A hump on an exponential residual is a candidate where it stands; pure noise is none."""
    frequency = np.arange(2000, 3500) / 20.0
    hump = 1 + 3 / (1 + ((frequency - 126.4) / 2.0) ** 2)
    for seed in range(10):
        noise = np.random.default_rng(seed).exponential(size=frequency.size)
        assert find_excess(Spectrum(frequency, noise, 20.0, 0.0)) is None
        found = find_excess(Spectrum(frequency, noise * hump, 20.0, 0.0))
        assert found is not None
        assert abs(found.frequency - 126.4) < 2.0
