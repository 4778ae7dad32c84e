"""Search for modes on all channels at once, and harmonics that wander."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth import identify
from lmshealth.modal.ambient.joint_model import BandData, JointModel
from lmshealth.modal.ambient.wandering import find_harmonic
from lmshealth.modal.ambient.whittle import response
from lmshealth.signal.spectra import CrossSpectrum
from studies.modes.without_description.worlds import FAMILIES, World, log_of

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
    phi = np.array([[3.0], [-1.5], [0.9]])
    floor = np.ones((3, 1))
    poles = np.array([20.0]), np.array([0.01])
    model = JointModel(data, floor, *poles, phi, np.zeros_like(phi), np.eye(1)).refined(6)
    free = np.ones(FREQUENCY.size, dtype=bool)
    recording = CrossSpectrum(FREQUENCY, transforms[None].copy(), SECONDS, np.nan, free)
    found = find_harmonic(model, recording)
    assert (found is not None) == harmonic
    if found is not None:
        assert found.frequency == pytest.approx(20.0, rel=0.01)


def test_the_score_of_the_joint_model_is_the_derivative_of_its_misfit() -> None:
    """The gradient by the force in one channel equals a difference of the misfit; sweeps gain."""
    rng = np.random.default_rng(8)
    data = band_of(rng.standard_normal((11_999, 2, 2)) @ [1, 1j])
    poles, r = (np.array([20.0, 25.0]), np.array([0.03, 0.02])), np.array([[1.0, 0.3], [0.3, 1.0]])

    def model(first: float) -> JointModel:
        phi = np.array([[0.3 + first, 0.1], [0.2, -0.4]])
        return JointModel(data, np.full((2, 1), 2.0), *poles, phi, np.zeros_like(phi), r)

    before = model(0.0)
    h = response(poles[0][0], poles[1][0], data.frequency)
    u = np.stack([h, np.zeros_like(h)], axis=1)[:, :, None]
    gradient, _ = before._score(before._b @ r[:, 0], u)
    slope = (model(1e-5).misfit - model(-1e-5).misfit) / 2e-5
    assert gradient[0] == pytest.approx(slope, rel=1e-5)
    assert before.refined(3).misfit < before.misfit
