"""Fits of a response: how many modes, which errors, and how the uncertainty follows from them."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal.deterministic.response_fit import ResponseFit, fit_response
from lmshealth.modal.deterministic.responses import Ordinates

LINES = np.arange(40.0, 120.0, 0.25)


def respond(modes: tuple[tuple[float, float], ...], f: np.ndarray = LINES) -> np.ndarray:
    """Respond by modes (Hz, damping ratio) of one sign, and two outside the band."""
    s = 2j * np.pi * f
    total = np.zeros(f.size, dtype=complex)
    for frequency, zeta in (*modes, (20.0, 0.05), (200.0, 0.02)):
        w = 2 * np.pi * frequency
        total += s**2 / (s**2 + 2 * zeta * w * s + w**2)
    return total


def measured(
    response: np.ndarray, noise: float, seed: int = 1, *, distortion: float = 0.0
) -> Ordinates:
    """Measure at an input of equal amplitudes: noise known from 16 degrees of freedom."""
    rng = np.random.default_rng(seed)

    def scatter(n: int) -> np.ndarray:
        return (
            rng.standard_normal((n, LINES.size)) + 1j * rng.standard_normal((n, LINES.size))
        ) / (np.sqrt(2))

    error, twist = scatter(2)
    variance = noise**2 * np.mean(np.abs(scatter(16)) ** 2, axis=0) * 16 / 15
    given = np.exp(2j * np.pi * rng.uniform(size=LINES.size))
    answer = given * response * (1 + distortion * twist) + noise * error
    return Ordinates(LINES, given, answer, variance, 16.0, periodic=True)


def frequencies(fit: ResponseFit) -> np.ndarray:
    """Return natural frequencies in Hz."""
    return np.exp(fit.estimate[: fit.estimate.size // 2])


TWO = ((62.0, 0.015), (90.0, 0.02))


@pytest.fixture(scope="module")
def clean() -> ResponseFit:
    """Fit two modes under noise alone."""
    return fit_response(measured(respond(TWO), 0.3))


def test_modes_of_the_band_are_found_and_no_others(clean: ResponseFit) -> None:
    """Two, within four of their standard deviations; noise explains the rest."""
    std = np.sqrt(np.diag(clean.cov))
    truth = np.log([62.0, 90.0, 0.015, 0.02])
    assert clean.estimate.size == 4
    assert np.abs((clean.estimate - truth) / std).max() < 4
    assert clean.distortion == 0
    assert clean.colour == 0
    assert clean.chi_square == pytest.approx(1, abs=0.3)
    assert not clean.outliers.size


def test_covariance_by_noise_alone_is_all_there_is(clean: ResponseFit) -> None:
    """Without distortion the two covariances are one, positive definite."""
    np.testing.assert_allclose(clean.cov, clean.noise_cov)
    for one in clean.credibility:
        assert [factor.cause for factor in one.factors] == ["noise-estimate", "dependent-lines"]
        assert one.total == pytest.approx(np.sqrt(15 / 14))  # variances of 16 degrees of freedom
    assert np.linalg.eigvalsh(clean.cov).min() > 0


def test_snr_is_power_at_the_resonance_over_noise(clean: ResponseFit) -> None:
    """A mode of unit residue has the power 1/(2ζ)² at its resonance."""
    expected = 1 / (2 * np.array([0.015, 0.02])) ** 2 / 0.3**2
    np.testing.assert_allclose(clean.snr, expected, rtol=0.5)
    assert np.isinf(clean.over_distortion).all()


def test_a_response_without_modes_has_none() -> None:
    """What modes outside the band leave in it is no mode."""
    fit = fit_response(measured(respond(()), 0.1))
    inside = (frequencies(fit) > LINES[0]) & (frequencies(fit) < LINES[-1])
    damping = np.exp(fit.estimate[fit.estimate.size // 2 :])
    assert not (inside & (damping < 0.2)).any()
    assert fit.cov.shape == (fit.estimate.size,) * 2


def test_close_modes_are_told_apart_where_the_noise_allows() -> None:
    """One half-power bandwidth apart: two modes under little noise, one under much."""
    close = ((80.0, 0.01), (81.6, 0.01))
    assert frequencies(fit_response(measured(respond(close), 0.1))) == pytest.approx(
        [80.0, 81.6], abs=0.05
    )
    assert frequencies(fit_response(measured(respond(close), 30.0))).size == 1


def test_distortion_is_found_and_widens_what_is_said() -> None:
    """5 % of random error in each line: its share is found; noise alone is far less."""
    fit = fit_response(measured(respond(TWO), 0.02, distortion=0.05))
    assert fit.distortion == pytest.approx(0.05, rel=0.25)
    assert fit.chi_square > 20
    assert frequencies(fit) == pytest.approx([62, 90], abs=0.3)
    assert (np.diag(fit.cov) > 10 * np.diag(fit.noise_cov)).all()
    assert (fit.over_distortion > 100).all()


def test_a_distorted_resonance_is_one_mode() -> None:
    """A resonance that bends with amplitude is not split into modes that are not there."""
    bent = respond(((62.0, 0.015),))
    w = 2 * np.pi * LINES
    # A spring that softens: the resonance of each line depends on how far that line moves.
    for _ in range(50):
        soft = 62.0 * (1 - 0.01 * np.minimum(np.abs(bent) / 33, 1))
        w_n = 2 * np.pi * soft
        bent = -(w**2) / (w_n**2 - w**2 + 0.03j * w_n * w) + respond(())
    fit = fit_response(measured(bent, 0.02))
    near = np.abs(frequencies(fit) / 61.5 - 1) < 0.02
    assert near.sum() == 1
    assert fit.distortion > 0.01
    i = int(np.flatnonzero(near)[0])
    std = 62.0 * np.sqrt(fit.cov[i, i])
    assert abs(frequencies(fit)[i] - 61.7) < 0.3 + 2 * std


@pytest.mark.slow
def test_a_line_that_is_no_answer_is_left_out() -> None:
    """Mains on one harmonic: no mode, no bias, and reported as it stands."""
    ordinates = measured(respond(TWO), 0.3)
    answer = ordinates.answer.copy()
    answer[240] += 30  # 100 Hz
    spoilt = Ordinates(
        LINES, ordinates.given, answer, ordinates.noise, ordinates.freedom, periodic=True
    )
    fit, clean = fit_response(spoilt), fit_response(ordinates)
    assert fit.outliers[:, 0] == pytest.approx([100.0])
    assert fit.outliers[0, 1] == pytest.approx(30, rel=0.2)
    assert fit.estimate.size == 4
    std = np.sqrt(np.diag(clean.cov))
    assert np.abs((fit.estimate - clean.estimate) / std).max() < 0.2


def test_errors_that_neighbours_share_widen_all() -> None:
    """Noise of five lines' width: correlation is seen and standard deviations grow by it."""
    rng = np.random.default_rng(5)
    ordinates = measured(respond(TWO), 1e-9)
    white = rng.standard_normal((2, LINES.size + 4))
    smooth = np.array([np.convolve(row, np.ones(5), "valid") for row in white]) / np.sqrt(10)
    answer = ordinates.answer + 0.3 * ordinates.given * (smooth[0] + 1j * smooth[1])
    noise = np.full(LINES.size, 0.3**2)
    fit = fit_response(Ordinates(LINES, ordinates.given, answer, noise, 1e6, periodic=True))
    # Correlation 0.8 of neighbours; those of a random input would not show it.
    assert fit.colour > 0
    expected = np.sqrt((1 + fit.colour) / (1 - fit.colour))
    assert [one.total for one in fit.credibility] == pytest.approx([expected] * 2, rel=1e-3)
    assert (np.diag(fit.cov) > 2 * np.diag(fit.noise_cov)).all()


def test_a_record_that_does_not_repeat_tells_its_own_noise() -> None:
    """Noise of unknown and uneven level, with a transient: modes within four sigma."""
    rng = np.random.default_rng(6)
    given = rng.standard_normal(LINES.size) + 1j * rng.standard_normal(LINES.size)
    level = 0.3 * (1 + (LINES - 40) / 40)
    scatter = rng.standard_normal((2, LINES.size)) * level / np.sqrt(2)
    answer = respond(TWO) * (given + 0.5) + scatter[0] + 1j * scatter[1]
    fit = fit_response(Ordinates(LINES, given, answer, np.ones(LINES.size), 10.0, periodic=False))
    truth = np.log([62.0, 90.0, 0.015, 0.02])
    assert fit.estimate.size == 4
    assert np.abs((fit.estimate - truth) / np.sqrt(np.diag(fit.cov))).max() < 4
    assert np.isnan(fit.chi_square)
