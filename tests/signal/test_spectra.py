"""Spectra: what a periodogram reads, and which segments of a log are averaged."""

from __future__ import annotations

import tempfile
from typing import Literal

import numpy as np
import pytest

from lmshealth.io.buffers import Stored
from lmshealth.io.log import Channel
from lmshealth.signal import spectra
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectra import (
    CrossSpectrum,
    ResonanceRange,
    cross_spectra,
)
from tests.signals import (
    Mode,
    Spectrum,
    accelerations,
    cut_band,
    displacements,
    mean_ordinate,
    of_channel,
    periodogram,
    sine,
    white,
)

RATE = 2000.0


def whole(values: np.ndarray, kind: str = "acceleration", rate: float = RATE) -> Spectrum:
    """Transform all samples of a channel."""
    channel = Channel("x", kind, np.array(values))  # type: ignore[arg-type]
    return periodogram(channel, rate)


def in_bands(spectrum: Spectrum, n: int = 20) -> tuple[np.ndarray, np.ndarray, int]:
    """Mean frequency and mean ordinate of bands of equal size, and that size."""
    size = spectrum.frequency.size // n
    cut = slice(0, size * n)
    frequency = spectrum.frequency[cut].reshape(n, size).mean(axis=1)
    return frequency, spectrum.periodogram[cut].reshape(n, size).mean(axis=1), size


def test_white_noise_reads_its_density_in_every_band() -> None:
    """Mean ordinates of white noise of density S are S within 4.5 of their standard errors."""
    level = 3.7e-4
    _, mean, size = in_bands(whole(white(np.random.default_rng(3), level, 1 << 16, RATE)))
    off = (mean / level - 1) * np.sqrt(size)
    assert np.abs(off).max() < 4.5
    # Negative control: a two-sided density, half of it, is seen.
    assert np.abs((mean / (level / 2) - 1) * np.sqrt(size)).min() > 4.5


def test_ordinates_are_exponential_and_uncorrelated() -> None:
    """Ordinates over density have mean, variance and lag-one correlation of exponentials."""
    ratio = whole(white(np.random.default_rng(4), 1.0, 1 << 16, RATE)).periodogram
    n = ratio.size
    assert abs(ratio.var() - 1) < 4.5 * np.sqrt(8 / n)
    assert abs(np.corrcoef(ratio[1:], ratio[:-1])[0, 1]) < 4.5 / np.sqrt(n)


def test_ordinates_add_up_to_the_variance() -> None:
    """Parseval: without mean and trend, variance is the sum of ordinates over duration."""
    x = np.random.default_rng(5).normal(2.0, 1.0, 4001) + np.linspace(0, 7, 4001)
    spectrum = whole(x)
    t = np.arange(x.size)
    rest = x - np.polyval(np.polyfit(t, x, 1), t)
    assert spectrum.periodogram.sum() / spectrum.duration == pytest.approx(rest.var(), rel=1e-12)


@pytest.mark.parametrize("n", [4000, 4001])
def test_a_sine_reads_its_amplitude(n: int) -> None:
    """A sine of amplitude A on a Fourier frequency has the ordinate A² T / 2, odd n and even."""
    frequency = 200 * RATE / n
    spectrum = whole(sine(n, RATE, frequency, 0.02))
    k = int(np.argmax(spectrum.periodogram))
    assert spectrum.frequency[k] == pytest.approx(frequency, rel=1e-12)
    assert np.sqrt(2 * spectrum.periodogram[k] / spectrum.duration) == pytest.approx(0.02, rel=1e-3)


def test_frequencies_end_below_nyquist() -> None:
    """The first ordinate is at 1/T, the last strictly below half the sample rate."""
    for n in (100, 101):
        spectrum = whole(np.random.default_rng(0).normal(size=n))
        assert spectrum.frequency[0] == pytest.approx(RATE / n)
        assert RATE / 2 - RATE / n <= spectrum.frequency[-1] < RATE / 2


@pytest.mark.parametrize("kind", ["acceleration", "displacement"])
@pytest.mark.parametrize("phase", [0.0, 0.9, np.pi / 2])
def test_a_sine_reads_its_amplitude_to_a_millionth(kind: str, phase: float) -> None:
    """From the 780th ordinate on the trend takes less than 1e-6 away, whatever the phase."""
    n, k = 16_000, 800
    lost = 2 if kind == "displacement" else 0
    frequency = k * RATE / n
    spectrum = whole(sine(n + lost, RATE, frequency, 0.02, phase), kind)
    at = int(np.argmax(spectrum.periodogram))
    amplitude = np.sqrt(2 * spectrum.periodogram[at] / spectrum.duration)
    factor = (2 * np.pi * frequency) ** 2 if lost else 1.0
    assert amplitude == pytest.approx(0.02 * factor, rel=1e-6)


def test_what_the_trend_takes_from_the_lowest_ordinates_is_as_stated() -> None:
    """White noise loses the share 3/(πk)² at the k-th ordinate, as the projection predicts."""
    n, ks = 4000, np.array([1, 2, 10, 100, 800])
    t = np.arange(n)
    ramp = t - (n - 1) / 2
    part = np.abs(np.exp(-2j * np.pi * np.outer(ks, t) / n) @ ramp) ** 2 / (ramp @ ramp) / n
    np.testing.assert_allclose(part, 3 / (np.pi * ks) ** 2, rtol=0.2)
    assert part[-1] < 1e-6


def test_the_mean_ordinate_of_a_band_has_two_degrees_of_freedom_each() -> None:
    """The density of a band scatters over seeds as χ² of its degrees of freedom."""
    rng = np.random.default_rng(12)
    readings = [mean_ordinate(whole(white(rng, 2.0, 2000, RATE)), 100.0, 150.0) for _ in range(500)]
    level = np.array([level for level, _ in readings])
    (dof,) = {dof for _, dof in readings}
    assert dof == 100
    assert abs(level.mean() / 2 - 1) < 4.5 * np.sqrt(2 / dof / 500)
    assert abs(level.var() / (2**2 * 2 / dof) - 1) < 4.5 * np.sqrt(2.5 / 500)


def test_a_displacement_sine_reads_its_acceleration() -> None:
    """Differencing twice and its correction give ω² times the amplitude up to near Nyquist."""
    n = 4002  # two samples are lost to the second difference
    for k in (20, 400, 1900):
        frequency = k * RATE / (n - 2)
        spectrum = whole(sine(n, RATE, frequency, 1e-6), "displacement")
        at = int(np.argmax(spectrum.periodogram))
        amplitude = np.sqrt(2 * spectrum.periodogram[at] / spectrum.duration)
        assert amplitude == pytest.approx((2 * np.pi * frequency) ** 2 * 1e-6, rel=2e-3)


def test_displacement_noise_reads_as_acceleration_growing_with_the_fourth_power() -> None:
    """White displacement noise of density S_x reads (2πf)⁴ S_x in every band."""
    level = 1e-18
    noise = white(np.random.default_rng(6), level, 1 << 16, RATE)
    spectrum = whole(noise, "displacement")
    ratio = spectrum.periodogram / ((2 * np.pi * spectrum.frequency) ** 4 * level)
    # The density is so steep that its upper end leaks into the lowest frequencies.
    flat = Spectrum(spectrum.frequency[2500:], ratio[2500:], spectrum.duration)
    _, mean, size = in_bands(flat)
    assert np.abs((mean - 1) * np.sqrt(size)).max() < 4.5


def test_differencing_first_keeps_slow_motion_out_of_the_band_of_modes() -> None:
    """A millimetre of slow motion leaks over a thousand times less than with ω² afterwards."""
    n = 8000
    slow = sine(n, RATE, 0.37, 1e-3)
    ours = cut_band(whole(slow, "displacement"), 80, 160)
    late = cut_band(whole(slow), 80, 160)
    naive = late.periodogram * (2 * np.pi * late.frequency) ** 4
    assert np.median(ours.periodogram) < 1e-3 * np.median(naive)


@pytest.mark.parametrize("kind", ["acceleration", "displacement"])
def test_ordinates_from_the_ceiling_on_are_not_kept(kind: str) -> None:
    """Below the ceiling nothing changes, and what is above it holds no memory."""
    values = np.random.default_rng(8).normal(size=4000)
    channel = Channel("x", kind, values)  # type: ignore[arg-type]
    all_of_it, cut = (
        periodogram(channel, RATE, 200.0, ceiling=ceiling) for ceiling in (np.inf, 250.0)
    )
    below = all_of_it.frequency < 250.0
    assert 0 < below.sum() < all_of_it.frequency.size
    np.testing.assert_array_equal(cut.periodogram, all_of_it.periodogram[below])
    assert cut.frequency.base is None


# All channels at once


def transform(
    channels: dict[str, np.ndarray],
    segments: list[Segment],
    top: float = 400.0,
    ceiling: float = np.inf,
) -> tuple[CrossSpectrum, ...]:
    """Transform channels; those named delta_e are displacements."""
    made = [
        Channel(name, "displacement" if name == "delta_e" else "acceleration", values.copy())
        for name, values in channels.items()
    ]
    return cross_spectra(made, segments, RATE, top, ceiling=ceiling)


def test_the_diagonal_holds_the_periodograms_of_the_channels() -> None:
    """Each channel alone is its own periodogram; together they are Hermitian, rank 1."""
    rng, n = np.random.default_rng(14), 8000
    values = {"acc_a": rng.normal(size=n), "acc_b": rng.normal(size=n) + np.linspace(0, 9, n)}
    (found,) = transform(values, [Segment(0, n, 0.3)])
    assert (found.duration, found.velocity, found.count) == (n / RATE, 0.3, 1)
    for index, name in enumerate(values):
        alone, own = whole(values[name]), of_channel(found, index)
        np.testing.assert_array_equal(own.frequency, alone.frequency)
        np.testing.assert_allclose(own.periodogram, alone.periodogram, rtol=1e-10)
    adjoint = found.matrix.conj().swapaxes(1, 2)
    np.testing.assert_allclose(found.matrix, adjoint, rtol=1e-12)
    power = np.diagonal(found.matrix, axis1=1, axis2=2).real
    np.testing.assert_allclose(np.abs(found.matrix[:, 0, 1]) ** 2, power.prod(axis=1), rtol=1e-10)
    assert not found.matrix.flags.writeable


def test_band_cuts_ordinates_and_nothing_else() -> None:
    """A band holds the frequencies from low to below high with their ordinates and duration."""
    values = np.random.default_rng(7).normal(size=4000)
    (found,) = transform({"acc_a": values}, [Segment(0, 4000, 0.1)])
    cut = found.band(100.0, 200.0)
    inside = (found.frequency >= 100) & (found.frequency < 200)
    np.testing.assert_array_equal(cut.matrix, found.matrix[inside])
    assert cut.duration == found.duration


def test_a_line_reaches_as_far_as_it_wanders() -> None:
    """A thousandth of its frequency to either side, and never less than two ordinates."""
    (found,) = transform({"acc_a": np.zeros(20_000)}, [Segment(0, 20_000, 0.1)])  # 10 s

    def lost(*lines: float) -> np.ndarray:
        return found.frequency[~found.without(lines).free]

    assert lost(800.0) == pytest.approx(np.arange(7992, 8008) / 10)
    assert lost(50.04) == pytest.approx([49.9, 50.0, 50.1, 50.2])
    assert lost(5000.0).size == 0
    assert lost(800.0, 50.04).size == 16 + 4


def test_what_a_displacement_and_an_accelerometer_see_is_in_phase() -> None:
    """Δe and the acceleration of one motion have the same transform, sign and phase included."""
    mode, n = [Mode(105.0, 0.02)], 16_000
    x = displacements(np.random.default_rng(15), mode, n, RATE, 0.0)[0]
    a = accelerations(np.random.default_rng(15), mode, n, RATE, 0.0)[0]
    (found,) = transform({"acc_a": a, "delta_e": x}, [Segment(0, n, 0.0)], 200.0)
    cut = found.band(95.0, 115.0)
    ratio = cut.matrix[:, 0, 1] / cut.matrix[:, 0, 0]
    np.testing.assert_allclose(np.abs(ratio - 1), 0.0, atol=0.05)


def test_a_delayed_channel_lags_by_its_phase() -> None:
    """F_a F_b* of a channel b that is k samples late has the phase +2πfk over the sample rate."""
    values = np.random.default_rng(16).normal(size=8010)
    late = {"acc_a": values[5:8005], "acc_b": values[:8000]}
    (found,) = transform(late, [Segment(0, 8000, 0.0)])
    cut = found.band(100.0, 110.0)
    phase = np.angle(cut.matrix[:, 0, 1] * np.exp(-2j * np.pi * cut.frequency * 5 / RATE))
    assert np.median(np.abs(phase)) < 0.05


def test_long_parts_of_one_velocity_are_averaged_and_short_ones_are_not() -> None:
    """Long segments to and fro make one mean; another velocity and short moves stay apart."""
    n = 600_000
    values = {"acc_a": np.random.default_rng(17).normal(size=4 * n)}
    parts = [Segment(k * n, (k + 1) * n, v) for k, v in enumerate((0.2, -0.2, 0.4, 0.2))]
    pooled, fast = transform(values, parts, ceiling=400.0)
    assert (pooled.count, fast.count, fast.velocity) == (3, 1, 0.4)
    assert pooled.observed == 3 * n / RATE
    single = [transform(values, [part], ceiling=400.0)[0] for part in parts]
    mean = (single[0].matrix + single[1].matrix + single[3].matrix) / 3
    np.testing.assert_allclose(pooled.matrix, mean, rtol=1e-10)
    short = [Segment(k * 2000, (k + 1) * 2000, 0.2) for k in range(3)]
    assert [s.count for s in transform(values, short)] == [1, 1, 1]


def test_a_strong_line_is_out_of_the_matrix_and_on_the_list() -> None:
    """Its ordinates are not free, frequency and amplitude are reported, and bands include it."""
    n = 40_000
    values = white(np.random.default_rng(18), 1.0, n, RATE)
    lined = values + sine(n, RATE, 150.01, 100.0)
    clean, dirty = (transform({"acc_a": v}, [Segment(0, n, 0.0)])[0] for v in (values, lined))
    ((index, frequency, amplitude),) = dirty.lines
    assert (index, frequency) == (0, pytest.approx(150.01, abs=0.02))
    assert amplitude == pytest.approx(100.0, rel=0.01)
    assert clean.lines == ()
    assert clean.free.all()
    lost = dirty.frequency[~dirty.free]
    assert 0 < lost.size < 20
    assert np.abs(lost - 150.01).max() < 0.5
    free = dirty.free
    left, truth = (s.matrix[free].real.sum() for s in (dirty, clean))
    assert left == pytest.approx(truth, rel=5e-3)
    assert dirty.band(100.0, 200.0).lines == dirty.lines
    assert dirty.band(200.0, 300.0).lines == ()
    assert dirty.band(149.0, 151.0).free.sum() < dirty.band(149.0, 151.0).frequency.size


def test_a_line_in_one_part_of_a_mean_is_masked_in_the_mean() -> None:
    """An ordinate is free when it is in all parts."""
    n = 600_000
    values = white(np.random.default_rng(19), 1.0, 2 * n, RATE)
    values[n:] += sine(n, RATE, 150.01, 100.0)
    parts = [Segment(k * n, (k + 1) * n, 0.2) for k in range(2)]
    (pooled,) = transform({"acc_a": values}, parts, ceiling=200.0)
    assert pooled.count == 2
    assert len(pooled.lines) == 1
    assert not pooled.band(150.0, 150.02).free.all()


def test_cross_spectrum_refuses_arrays_that_differ_in_length() -> None:
    """Frequencies without transforms are no spectrum."""
    with pytest.raises(ValueError, match="has shape"):
        CrossSpectrum(
            np.arange(3.0), np.zeros((1, 4, 1), dtype=complex), 1.0, 0.0, np.ones(3, dtype=bool)
        )


# Means over segments


def parts(*lengths: int, velocity: float = 0.1) -> list[Segment]:
    """Give segments that follow each other."""
    ends = np.cumsum(lengths).tolist()
    return [Segment(end - n, end, velocity) for n, end in zip(lengths, ends, strict=True)]


def averaged(values: np.ndarray | Stored, segments: list[Segment]) -> tuple[Spectrum, ...]:
    """Transform an acceleration."""
    channel = Channel("x", "acceleration", values)
    return tuple(of_channel(s) for s in cross_spectra([channel], segments, RATE, 500.0))


@pytest.fixture
def short_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take 1000 samples for a part of a long segment."""
    monkeypatch.setattr(spectra, "_LEAST_PART", 1000)


@pytest.mark.usefixtures("short_minute")
def test_parts_of_a_long_stretch_are_averaged() -> None:
    """Three parts of one length have one spectrum, the mean of theirs, in memory or on disk."""
    values = np.random.default_rng(20).normal(size=3000)
    with tempfile.TemporaryFile() as file:
        values.tofile(file)
        file.flush()
        (mean,) = averaged(values, parts(1000, 1000, 1000))
        (on_disk,) = averaged(Stored(file, values.size), parts(1000, 1000, 1000))
    each = [whole(part).periodogram for part in values.reshape(3, 1000)]
    np.testing.assert_allclose(mean.periodogram, np.mean(each, axis=0), rtol=1e-12)
    np.testing.assert_array_equal(on_disk.periodogram, mean.periodogram)
    assert (mean.count, mean.duration) == (3, 0.5)


@pytest.mark.usefixtures("short_minute")
@pytest.mark.parametrize(
    ("segments", "counts"),
    [
        (parts(999, 999), [1, 1]),  # short moves
        (parts(1000, 1200, 1000, 1200), [2, 2]),
        (parts(1000, velocity=0.1) + parts(1000, velocity=-0.1005), [2]),
        (parts(1000, velocity=0.1) + parts(1000, velocity=0.102), [1, 1]),
        (parts(1000, 1000, velocity=float("nan")), [2]),
        (parts(1000, velocity=0.0) + parts(1000, velocity=float("nan")), [1, 1]),
    ],
)
def test_only_what_is_alike_is_averaged(segments: list[Segment], counts: list[int]) -> None:
    """Long segments of one length and one speed are; short moves and others stay apart."""
    values = np.random.default_rng(21).normal(size=4400)
    found = averaged(values, segments)
    assert [spectrum.count for spectrum in found] == counts
    assert sum(s.count * s.duration for s in found) == pytest.approx(
        sum(s.stop - s.start for s in segments) / RATE
    )


@pytest.mark.slow
@pytest.mark.usefixtures("short_minute")
def test_means_have_the_degrees_of_freedom_they_state() -> None:
    """The density of a band of five parts scatters over seeds as χ² of its degrees of freedom."""
    rng = np.random.default_rng(22)
    readings = [
        mean_ordinate(averaged(white(rng, 2.0, 5000, RATE), parts(*[1000] * 5))[0], 100.0, 150.0)
        for _ in range(500)
    ]
    level = np.array([level for level, _ in readings])
    (dof,) = {dof for _, dof in readings}
    assert dof == 2 * 5 * 25
    assert abs(level.mean() / 2 - 1) < 4.5 * np.sqrt(2 / dof / 500)
    # Negative control: the degrees of a single part would be detected.
    for wrong, off in ((1.0, False), (5.0, True)):
        detected = abs(level.var() / (2**2 * 2 * wrong / dof) - 1) > 4.5 * np.sqrt(2.5 / 500)
        assert detected == off


@pytest.mark.usefixtures("short_minute")
def test_a_sine_reads_its_amplitude_in_the_mean_of_parts() -> None:
    """The mean over parts reads the amplitude that each of them reads."""
    frequency = 100 * RATE / 1000
    (mean,) = averaged(sine(4000, RATE, frequency, 0.02), parts(*[1000] * 4))
    at = int(np.argmax(mean.periodogram))
    assert mean.frequency[at] == pytest.approx(frequency)
    power = mean.periodogram[at - 2 : at + 3].sum() / mean.duration
    assert np.sqrt(2 * power) == pytest.approx(0.02, rel=1e-3)


# What a line may reach, and where a resonance may stand


def test_without_gives_up_what_lines_reach_and_nothing_else() -> None:
    """Ordinates that lines reach are no longer free; those that were not stay so."""
    values = np.random.default_rng(24).normal(size=20_000)
    (found,) = transform({"acc_a": values}, [Segment(0, 20_000, 0.1)])
    once = found.without([150.04])
    assert found.free.all()
    assert found.frequency[~once.free] == pytest.approx([149.9, 150.0, 150.1, 150.2])
    twice = once.without([800.0, 50.04])
    np.testing.assert_array_equal(twice.free, found.without([150.04, 800.0, 50.04]).free)
    np.testing.assert_array_equal(twice.matrix, found.matrix)


def test_resonances_look_unresolved_where_a_segment_does_not_resolve_them() -> None:
    """Within their band, and below eight ordinates in the half-power bandwidth 2ζf."""
    frequency = np.array([89.0, 90.0, 99.0, 101.0, 110.0, 111.0])
    expected = ResonanceRange(90.0, 110.0, 0.02)
    # 2 · 0.02 · 100 Hz · 2 s is eight.
    assert expected.unresolved(frequency, 2.0).tolist() == [False, True, True, False, False, False]
    assert not expected.unresolved(frequency, 3.0).any()
    assert expected.unresolved(frequency, 1.0).sum() == 4


def test_a_resonance_of_a_short_move_is_not_taken_for_a_tone() -> None:
    """In 60 moves of 0.67 s a mode one ordinate wide is left where it may stand."""
    n, mode = 1340, Mode(130.0, 0.006, 4 * 0.006**2 * 300)
    kept = {}
    for name, expected in (
        ("there", ResonanceRange(110.0, 150.0, 0.005)),
        ("elsewhere", ResonanceRange(300.0, 350.0, 0.005)),
    ):
        free = []
        for seed in range(60):
            values = accelerations(np.random.default_rng(seed), [mode], n, RATE, 1.0)[0]
            (found,) = cross_spectra(
                [Channel("acc_a", "acceleration", values)],
                [Segment(0, n, 0.1)],
                RATE,
                400.0,
                resonances=(expected,),
            )
            free.append(found.band(120.0, 140.0).free.all())
        kept[name] = sum(free)
    assert kept["there"] == 60
    # Negative control: where none is expected about half of the moves lose it.
    assert kept["elsewhere"] < 45


@pytest.mark.parametrize("kind", ["displacement", "acceleration"])
def test_a_segment_without_an_ordinate_is_omitted(
    kind: Literal["displacement", "acceleration"],
) -> None:
    """A log that ends some samples after a stop has the spectra of its other segments."""
    channels = [Channel("a", kind, np.random.default_rng(0).normal(size=4000))]
    for short in range(1, 12):
        segments = [Segment(0, 3000, 0.0), Segment(3000, 3000 + short, 0.0)]
        first, *others = cross_spectra(channels, segments, RATE, RATE / 40)
        assert first.frequency.size > 100
        assert all(one.frequency.size for one in others)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_channel_without_a_signal_has_no_ratio() -> None:
    """A sinusoid of one channel is removed beside a channel that is constant in the segment."""
    n = 20_000
    noisy = np.random.default_rng(0).normal(size=n) + 50 * np.sin(0.7 * np.arange(n))
    channels = [Channel("a", "acceleration", noisy), Channel("b", "acceleration", np.ones(n))]
    (spectrum,) = cross_spectra(channels, [Segment(0, n, 0.0)], RATE, RATE / 4)
    assert spectrum.lines
