"""Search for modes on all channels at once, and harmonics that wander."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lmshealth import Modes, identify
from lmshealth._private.arrays import FloatArray
from lmshealth.io.log import Log
from lmshealth.modal.ambient import cluster_fit, search
from lmshealth.modal.ambient.cluster_fit import ClusterData
from lmshealth.modal.ambient.joint_model import BandData, JointModel
from lmshealth.modal.ambient.wandering import Harmonic, find_harmonic
from lmshealth.modal.ambient.whittle import response
from lmshealth.modal.identification import read_ambient
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra
from studies.modes.without_description.worlds import FAMILIES, World, log_of
from tests.signals import Mode, accelerations, make_log

RATE, SECONDS = 128.0, 300.0
FREQUENCY = np.arange(1, 12_000) / SECONDS


def identified(world: World) -> tuple[int, int, int]:
    """Return how many modes there are, were found within half a bandwidth, and are false."""
    found = identify(log_of(world), band=world.band).frequency
    width = 2 * world.damping_ratio * world.frequency
    near = np.abs(found[:, None] - world.frequency) < width
    return world.frequency.size, int(near.any(axis=0).sum()), int((~near.any(axis=1)).sum())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("family", ["four modes", "varied"])
def test_every_mode_is_found_and_none_that_is_not_there(family: str, seed: int) -> None:
    """Few modes in one to eight channels of 20 to 120 s, two of them close."""
    there, found, false = identified(FAMILIES[family](np.random.default_rng([231, 7, seed])))
    assert (found, false) == (there, 0)


@pytest.mark.slow
def test_a_harmonic_that_wanders_is_a_line_and_hides_no_mode() -> None:
    """Eight modes, two steady harmonics and one that wanders by 1 %."""
    world = FAMILIES["eight modes"](np.random.default_rng([231, 2, 4]))
    found = identify(log_of(world), band=world.band)
    assert len(found.names) == 8
    (line,) = [line for line in found.lines if line.kind == "wandering"]
    assert line.frequency == pytest.approx(world.wandering[0], rel=0.01)


def band_of(transforms: np.ndarray) -> BandData:
    """Return the mean cross spectra of transforms in bins of 20 ordinates."""
    n = len(transforms) // 20
    cut = transforms[: 20 * n].reshape(n, 20, -1)
    matrix = np.einsum("kja,kjb->kab", cut, cut.conj()) / 20
    frequency = FREQUENCY[: 20 * n].reshape(n, 20).mean(axis=1)
    return BandData(
        frequency, np.full(n, 20.0), matrix, None, np.ones(transforms.shape[1]), np.ones((1, n))
    )


@pytest.mark.parametrize("harmonic", [True, False])
def test_a_constant_amplitude_distinguishes_a_harmonic_from_a_mode(harmonic: bool) -> None:
    """One spectrum, once of a sine whose frequency wanders, once of noise (the control)."""
    rng = np.random.default_rng(5)
    n = round(RATE * SECONDS)
    slow = np.convolve(rng.standard_normal(n + 639), np.ones(640), "valid") / np.sqrt(640)
    phase = 2 * np.pi * np.cumsum(20 * (1 + 0.01 * slow)) / RATE
    sine = np.fft.rfft(np.cos(phase))[1:12_000]
    if not harmonic:
        level = np.sqrt(np.convolve(np.abs(sine) ** 2, np.ones(21) / 21, "same"))
        sine = level * (rng.standard_normal((sine.size, 2)) @ [1, 1j]) / np.sqrt(2)
    noise = rng.standard_normal((sine.size, 3, 2)) @ [1, 1j] / np.sqrt(2)
    transforms = noise + sine[:, None] * np.array([1.0, -0.5, 0.3])
    data = band_of(transforms)
    phi = np.array([[3.0], [-1.5], [0.9]], dtype=complex)
    floor, r = np.ones((3, 1)), np.eye(1, dtype=complex)
    poles = np.array([20.0]), np.array([0.01])
    model = JointModel(data, floor, *poles, phi, np.zeros_like(phi), r).refined(6)
    free = np.ones(FREQUENCY.size, dtype=bool)
    recording = CrossSpectrum(FREQUENCY, transforms[None].copy(), SECONDS, np.nan, free)
    found = find_harmonic(model, recording)
    assert (found is not None) == harmonic
    if found is not None:
        assert found.frequency == pytest.approx(20.0, rel=0.01)


def test_no_harmonic_is_read_from_masked_ordinates() -> None:
    """Two ordinates at a mode are masked, and only their mean with neighbours is high."""
    k = int(np.abs(FREQUENCY - 20.0).argmin())
    transforms = np.zeros((FREQUENCY.size, 2), dtype=complex)
    transforms[[k - 1, k + 2], 0] = np.sqrt(7.5)  # of two in five the mean is 3, of one 1.5
    data = band_of(transforms)
    phi = np.array([[0.1], [0.0]], dtype=complex)
    poles, r = (np.array([20.0]), np.array([1e-3])), np.eye(1, dtype=complex)
    model = JointModel(data, np.ones((2, 1)), *poles, phi, np.zeros_like(phi), r)
    free = ~np.isin(np.arange(FREQUENCY.size), [k, k + 1])
    recording = CrossSpectrum(FREQUENCY, transforms[None], SECONDS, np.nan, free)
    assert find_harmonic(model, recording) is None


def test_the_score_of_the_joint_model_is_the_derivative_of_its_misfit() -> None:
    """The gradient by the force in one channel equals a difference of the misfit; sweeps gain."""
    rng = np.random.default_rng(8)
    data = band_of(rng.standard_normal((11_999, 2, 2)) @ [1, 1j])
    poles = np.array([20.0, 25.0]), np.array([0.03, 0.02])
    r = np.array([[1.0, 0.3], [0.3, 1.0]], dtype=complex)

    def model(first: float) -> JointModel:
        phi = np.array([[0.3 + first, 0.1], [0.2, -0.4]], dtype=complex)
        return JointModel(data, np.full((2, 1), 2.0), *poles, phi, np.zeros_like(phi), r)

    before = model(0.0)
    h = response(poles[0][0], poles[1][0], data.frequency)
    u = np.stack([h, np.zeros_like(h)], axis=1)[:, :, None]
    gradient, _ = before._score(before._b @ r[:, 0], u)
    slope = (model(1e-5).misfit - model(-1e-5).misfit) / 2e-5
    assert gradient[0] == pytest.approx(slope, rel=1e-5)
    assert before.refined(3).misfit < before.misfit


def many_channels(n: int, seconds: float, rate: float = 200.0) -> tuple[list[Mode], np.ndarray]:
    """Return modes of which each moves few of n channels, and accelerations under white forces."""
    rng = np.random.default_rng([n, 5])
    places = [(12.0, 0.012), (17.0, 0.01), (24.0, 0.013), (31.0, 0.01)]
    shapes = rng.standard_normal((4, n)) * (rng.random((4, n)) < 0.4)
    shapes[range(4), [0, 1, 2, 3]] = 1.0  # the first channels show them all
    shapes[3, 4:] *= 5.0
    modes = [Mode(f, zeta, 1.0, tuple(x)) for (f, zeta), x in zip(places, shapes, strict=True)]
    return modes, accelerations(rng, modes, round(seconds * rate), rate, 0.1)


def identified_from(values: np.ndarray, rate: float = 200.0) -> Modes:
    """Return the modes from 8 to 40 Hz that channels show."""
    return identify(make_log({f"acc_{k:02d}": row for k, row in enumerate(values)}, rate),
                    band=(8.0, 40.0))  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("n", [12, 20])
def test_more_channels_lose_no_mode(n: int) -> None:
    """What four channels show is found in all of them, at its truth, and no channel is left out."""
    modes, values = many_channels(n, 120.0)
    few, all_ = identified_from(values[:4]), identified_from(values)
    truth = np.log([mode.frequency for mode in modes])
    for found in (few, all_):
        assert len(found.names) == len(modes)
        std = np.sqrt(np.diag(found.cov))[: len(modes)]
        assert np.abs((found.ln_frequency - truth) / std).max() < 4
    assert all_.shape_channels == tuple(f"acc_{k:02d}" for k in range(n))
    assert not any(row.channel for row in all_.refused)


def test_more_channels_make_no_interval_wider(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of twelve as of four of them: flanks of modes elsewhere are no noise (the control)."""
    rng = np.random.default_rng([45, 0])
    shapes = rng.standard_normal((4, 12))
    places = [(12.0, 0.012), (17.0, 0.01), (24.0, 0.013), (31.0, 0.01)]
    modes = [Mode(f, zeta, 1.0, tuple(x)) for (f, zeta), x in zip(places, shapes, strict=True)]
    values = accelerations(rng, modes, 24_000, 200.0, 0.1)
    few, all_ = identified_from(values[:4]), identified_from(values)
    plain, units = cluster_fit.prepare, list[FloatArray]()

    def prepare(spectra: LogSpectra, targets: Any, band: Any, noise: FloatArray) -> ClusterData:
        level = np.median(spectra.longest.band(*band).powers(), axis=0) / np.log(2)
        units.append(plain(spectra, targets, band, level).unit ** 2)
        return plain(spectra, targets, band, level)

    monkeypatch.setattr(cluster_fit, "prepare", prepare)
    control = identified_from(values)
    wider, less = (np.log(one.frequency_std / few.frequency_std) for one in (control, all_))
    assert less.mean() < np.log(1.05)
    assert less.max() < np.log(1.1)
    assert wider.mean() > np.log(1.05)
    assert np.median(np.concatenate(units)) > 10 * 0.1


@pytest.mark.slow
def test_a_mode_that_only_later_channels_show_is_found() -> None:
    """One of three in twenty-four that is strong in three others, which are weak in the first."""
    rng = np.random.default_rng(9)
    shapes = np.zeros((2, 24))
    shapes[0, :21] = rng.choice([-1.0, 1.0], 21) * rng.uniform(5, 10, 21)
    shapes[1, 21:] = [1.0, -0.8, 0.6]
    modes = [Mode(12.0, 0.012, 1.0, tuple(shapes[0])), Mode(24.0, 0.01, 1.0, tuple(shapes[1]))]
    found = identified_from(accelerations(rng, modes, 24_000, 200.0, 0.1))
    assert found.frequency == pytest.approx([12.0, 24.0], rel=0.01)
    # Negative control: the first channels alone do not show it.
    alone = identified_from(accelerations(rng, modes, 24_000, 200.0, 0.1)[:21])
    assert alone.frequency == pytest.approx([12.0], rel=0.01)


def exact_model() -> JointModel:
    """Return a model of two modes in four channels whose data are its own expectation."""
    f, n = np.linspace(8.0, 40.0, 400), 4
    phi = np.array([[1.0, 0.2], [-0.5, 0.6], [0.3, -0.9], [0.8, 0.4]])
    r = np.array([[1.0, 0.4], [0.4, 1.0]])
    data = BandData(f, np.full(400, 50.0), np.zeros((400, n, n), complex), None, np.ones(n),
                    np.ones((1, 400)))  # fmt: skip
    poles = np.array([14.0, 25.0]), np.array([0.02, 0.015])
    model = JointModel(data, np.full((n, 1), 0.5), *poles, phi, np.zeros_like(phi), r)
    return replace(model, data=replace(data, matrix=model.expected))


def test_channels_are_added_by_what_they_have_in_common() -> None:
    """On exact data the shapes of the added channels are true, and follow a sign."""
    whole = exact_model()
    few = whole.of_channels([0, 1])
    added = few.with_channels(whole.data)
    np.testing.assert_allclose(added.phi, whole.phi, rtol=1e-6)
    half = few.with_channels(whole.data, lambda f: f > 20.0)
    np.testing.assert_allclose(half.phi, whole.phi, rtol=1e-6)
    turned = replace(whole.data, matrix=whole.data.matrix * np.array([[1], [1], [-1], [1]]))
    np.testing.assert_allclose(few.with_channels(turned).phi[2], -whole.phi[2], rtol=1e-6)


def test_joined_models_have_the_channels_of_all() -> None:
    """Channels added in steps are those added at once, with a mode that only later ones have."""
    whole = exact_model()
    later = whole.of_channels([0, 1, 3]).with_mode(33.0, 0.01, np.array([0.0, 0.0, 1.0]))
    joined = later.of_channels([0, 1]).joined(
        [whole.of_channels([2]), later.of_channels([2])], [3, 0, 1, 2]
    )
    np.testing.assert_array_equal(joined.phi[:, :2], whole.phi[[3, 0, 1, 2]])
    np.testing.assert_array_equal(joined.phi[:, 2], [1.0, 0.0, 0.0, 0.0])
    assert joined.f.tolist() == [14.0, 25.0, 33.0]
    np.testing.assert_array_equal(joined.floor_at(20.0), whole.floor_at(20.0))
    columns = joined.modal(np.array([True, True, False]), whole.data.frequency)
    expected = whole.modal(np.array([True, True]), whole.data.frequency)
    np.testing.assert_allclose(columns, expected[:, [3, 0, 1, 2]], rtol=1e-12)


def test_a_harmonic_is_seen_by_all_channels() -> None:
    """From the cross spectra in its band the column of the added channels follows."""
    whole = exact_model()
    column = np.array([3.0, -2.0 + 1j, 0.5, 4.0])
    line = Harmonic(18.0, 17.0, 19.0, 1.0, 0, 10 * column[:2])
    within = line.along(10 * column).expected(whole.data.frequency)
    shown = replace(whole.data, matrix=whole.data.matrix + within @ within.conj().swapaxes(1, 2))
    seen = line.seen_by(replace(whole, data=shown))
    np.testing.assert_allclose(seen, 10 * column, rtol=0.02, atol=0.2)
    assert line.along(seen).channel == 3


def shaft_signals(wander: float) -> tuple[Harmonic, Harmonic, Harmonic]:
    """Return the second and the fifth harmonic of a shaft, and noise in the band of the fifth."""
    rng, n = np.random.default_rng(11), round(RATE * SECONDS)
    slow = np.convolve(rng.standard_normal(n + 1279), np.ones(1280), "valid") / np.sqrt(1280)
    phase = 2 * np.pi * np.cumsum(4.0 * (1 + wander * slow)) / RATE

    def line(frequency: float, transform: np.ndarray) -> Harmonic:
        first, last = (round(frequency * (1 + side * 0.05) * SECONDS) for side in (-1, 1))
        ends = first / SECONDS, last / SECONDS
        column = np.ones(1, complex)
        return Harmonic(frequency, *ends, 1.0, 0, column, first, transform[first:last])

    second, fifth = (
        line(4.0 * k, np.fft.rfft(np.cos(k * phase) + 0.3 * rng.standard_normal(n))) for k in (2, 5)
    )
    return second, fifth, line(20.0, np.fft.rfft(rng.standard_normal(n)))


@pytest.mark.parametrize("wander", [0.003, 0.01])
def test_harmonics_of_one_shaft_are_recognised_by_their_phases(wander: float) -> None:
    """The fifth follows the second, and noise in its band does not (the control)."""
    second, fifth, noise = shaft_signals(wander)
    assert fifth.follows(second)
    assert second.follows(fifth)
    assert not noise.follows(second)
    assert not fifth.follows(replace(second, frequency=8.8))  # no ratio of small numbers


def shaken(rng: np.random.Generator, base_moves: bool, noise: float, shapes: np.ndarray) -> Log:
    """Record two modes, 60 and 95 Hz, under white forces or over a base that moves."""
    rate, n = 500.0, 60_000
    f = np.fft.rfftfreq(n, 1 / rate)
    x = noise * rng.standard_normal((4, n))
    for frequency, zeta, shape in zip((60.0, 95.0), (0.012, 0.01), shapes, strict=True):
        moved = response(np.array(frequency), np.array(zeta), f.clip(f[1])) - base_moves
        moved *= np.fft.rfft(rng.standard_normal(n))
        x += shape[:, None] * np.fft.irfft(moved, n)
    return make_log({f"acc_{c}": row for c, row in enumerate(x)}, rate)


@pytest.mark.parametrize("base_moves", [True, False])
def test_the_static_response_is_that_of_what_moves(
    base_moves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of absolute acceleration over a moving base it is -1, of a force 0; else poles take it."""
    shapes = np.array([[1.0, 0.7, -0.4, 0.9], [0.6, -1.0, 0.8, 0.5]])
    log = shaken(np.random.default_rng(3), base_moves, 0.02, shapes)
    (found,) = read_ambient(log, band=(40.0, 130.0)).sought
    assert found.model.static == -float(base_moves)
    assert found.model.f.size == 2
    # The share of φ in the static response of the other kind is what ρ has to find.
    other = float(base_moves) - 1.0
    monkeypatch.setattr(search, "_STATICS", (other,))
    (control,) = read_ambient(log, band=(40.0, 130.0)).sought
    assert control.model.static == other
    assert control.model.misfit > found.model.misfit + 20 or control.model.f.size > 2


@pytest.mark.parametrize("base_moves", [True, False])
@pytest.mark.parametrize("seed", [4, 8])
def test_noise_does_not_change_which_static_response_is_found(
    seed: int, base_moves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Starts of a moving base are likelier with 0, and a refinement may end anywhere (controls)."""
    starts: list[JointModel] = []
    plain = search._start

    def start(*given: Any) -> JointModel:
        starts.append(plain(*given))
        return starts[-1]

    monkeypatch.setattr(search, "_start", start)
    rng = np.random.default_rng(seed)
    shapes = rng.choice([-1, 1], (2, 4)) * 10 ** rng.uniform(-1, 0, (2, 4))
    log = shaken(rng, base_moves, 0.3, shapes)
    (found,) = read_ambient(log, band=(40.0, 130.0)).sought
    assert found.model.static == -float(base_moves)
    force, base = (replace(starts[0], static=c) for c in (0.0, -1.0))
    assert force.misfit < base.misfit
    # Of a force the base is likelier after the same sweeps, though both can express the same.
    assert base.refined(6).misfit < force.refined(6).misfit
    same = found.model.with_static(-1.0 - found.model.static)
    np.testing.assert_allclose(same.expected, found.model.expected)
