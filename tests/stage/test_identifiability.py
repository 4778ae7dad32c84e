"""Identifiability and bounds: closed forms, drawn drifts, and estimators that do not beat them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import optimize

from lmshealth.errors import BadStage
from lmshealth.stage.description import load_stage
from lmshealth.stage.identifiability import (
    Identifiability,
    ambient_bound,
    identifiability_of,
)
from studies.harness.data.cramer_rao import (
    Recording,
    Vibration,
    band_factors,
    decay_bound,
    joint_bound,
    long_record_law,
)
from tests.lives import DAMPING, FREQUENCY, MOUNT, PRELOAD, SENSITIVITY, make_stage
from tests.signals import Mode, density
from tests.stops import Ring, stop

NAMES = ("guide_preload", "mount_stiffness")


@pytest.fixture(scope="module")
def information(tmp_path_factory: pytest.TempPathFactory) -> Identifiability:
    """Two modes, two parameters."""
    return identifiability_of(make_stage(tmp_path_factory.mktemp("identifiability")))


def test_slopes_are_those_of_the_formula_at_the_baseline(information: Identifiability) -> None:
    """The bend of the map counts from the baseline, here ln 1 = 0."""
    known = np.column_stack([SENSITIVITY[name][:2] for name in NAMES])
    np.testing.assert_allclose(information.slopes, known, atol=1e-10)
    assert (information.parameters, information.n_baseline, information.model_std) == (
        NAMES,
        5,
        0.05,
    )


def test_the_prior_is_that_inside_the_map(tmp_path: Path) -> None:
    """A uniform prior of the parameter, cut by the map, has the variance of its logarithm."""
    inside = 'kind = "lognormal", median = 1.0, sigma = 0.3'
    wide = PRELOAD.replace(inside, 'kind = "uniform", low = 0.05, high = 9.0')
    found = identifiability_of(make_stage(tmp_path, (wide, MOUNT))).prior[0]
    low, high = 0.2, 1.5
    drawn = np.log(np.random.default_rng(3).uniform(low, high, 400_000))
    assert found == pytest.approx(drawn.var(), rel=0.01)


def test_drift_variances_are_bounds_of_both_groups(information: Identifiability) -> None:
    """R (1/N + 1/N_baseline), with R the Cramér-Rao bound of one log."""
    known = []
    for f, zeta in zip(FREQUENCY[:2], DAMPING, strict=False):
        band = (f * (1 - 8 * zeta), f * (1 + 8 * zeta))
        known.append(ambient_bound(f, zeta, 100.0, 60.0, band=band)[0, 0])
    np.testing.assert_allclose(
        information.drift_variance(60.0, 3), np.array(known) * (1 / 3 + 1 / 5)
    )
    np.testing.assert_allclose(
        information.drift_variance(60.0, 3, 7), np.array(known) * (1 / 3 + 1 / 7)
    )
    assert (information.limiting_variance() < 1e-4 * information.drift_variance(60.0, 5)).all()


def test_with_an_exact_map_both_deviations_agree(tmp_path: Path) -> None:
    """Generalised least squares with the prior added equals the joint precision."""
    exact = identifiability_of(make_stage(tmp_path, model_std=0.0))
    noise = exact.drift_variance(60.0, 5)
    for j, found in enumerate(exact.change_std(noise)):
        own, others = exact.slopes[:, j], np.delete(exact.slopes, j, axis=1)
        cov = np.diag(noise) + (others * np.delete(exact.prior, j)) @ others.T
        assert found == pytest.approx((own @ np.linalg.solve(cov, own)) ** -0.5, rel=1e-9)
        alone = 1 / (1 / exact.prior[j] + found**-2)
        assert exact.std(noise)[j] ** 2 == pytest.approx(alone, rel=1e-6)


@pytest.mark.parametrize(
    ("model_std", "common_std", "covered"), [(0.3, 0.2, True), (0.0, 0.2, False), (0.3, 0.0, False)]
)
def test_the_precision_is_that_of_drawn_drifts(
    information: Identifiability, model_std: float, common_std: float, covered: bool
) -> None:
    """Estimates scatter as they should where sensitivities are wrong; not where that is left out.

    Sensitivities are drawn 30 % wrong, and 20 % in all modes. The mean square of 40,000 errors in
    units of its expectation has a standard deviation below 0.02: the errors have heavier tails than
    a Gaussian.
    """
    rng, n = np.random.default_rng(8), 40_000
    slopes, prior = information.slopes, information.prior
    noise = np.array([1e-6, 4e-6])
    x = rng.normal(0, np.sqrt(prior), (n, 2))
    wrong = 1 + 0.3 * rng.normal(size=(n, 2, 2)) + 0.2 * rng.normal(size=(n, 1, 2))
    drifts = np.einsum("nij,ij,nj->ni", wrong, slopes, x) + rng.normal(0, np.sqrt(noise), (n, 2))
    model = replace(information, leave_out=np.zeros(2), model_std=model_std, common_std=common_std)
    cov = np.linalg.inv(model.precision(noise))
    own = np.diag(noise + model_std**2 * slopes**2 @ prior)
    total = own + common_std**2 * slopes * prior @ slopes.T
    estimates = drifts @ np.linalg.solve(total, slopes) @ cov
    ratio = ((estimates - x) ** 2).mean(axis=0) / np.diag(cov)
    assert (np.abs(ratio - 1) < 0.1).all() == covered


def test_the_weakest_mode_sets_the_least_duration(information: Identifiability) -> None:
    """The narrowest half-power band has to be resolved."""
    narrow = min(2 * DAMPING[:2] * FREQUENCY[:2])
    assert information.least_duration * narrow == pytest.approx(2.0)


def test_without_a_map_there_is_nothing_to_see(tmp_path: Path) -> None:
    """The error names what to describe."""
    with pytest.raises(BadStage, match=r"no \[map\].*describe \[\[parameter\]\]"):
        identifiability_of(make_stage(tmp_path, ()))


def test_what_is_identifiable_is_said_before_any_log() -> None:
    """In X the mount is not, in Y both are; by an exact map both are in X too."""
    x, y = (identifiability_of(load_stage(name)) for name in ("lms-x", "lms-y"))
    assert x.identifiable().tolist() == [True, False]
    assert y.identifiable().tolist() == [True, True]
    assert replace(x, model_std=0.0).identifiable().tolist() == [True, True]


def test_a_wide_band_holds_all_and_a_narrow_one_nothing() -> None:
    """Both band factors rise from 0 to 1."""
    narrow, wide = band_factors(1e-3), band_factors(1e9)
    assert max(narrow) < 1e-8
    np.testing.assert_allclose(wide, 1.0, rtol=1e-6)
    b_f, b_zeta = band_factors(np.linspace(0.5, 50, 40))
    assert (np.diff(b_f) > 0).all()
    assert (np.diff(b_zeta) > 0).all()


def test_band_factors_are_integrals_of_the_information() -> None:
    """Both agree with the information summed numerically over the band."""
    kappa = 3.0
    x = np.linspace(-kappa, kappa, 200_001)
    by_f, by_zeta = 2 * x / (1 + x**2), -2 / (1 + x**2)
    area = 2 * kappa
    b_f = np.mean(by_f**2) * area / (2 * np.pi)
    b_zeta = (np.mean(by_zeta**2) - np.mean(by_zeta) ** 2) * area / (2 * np.pi)
    np.testing.assert_allclose(band_factors(kappa), (b_f, b_zeta), rtol=1e-3)


def test_long_record_law_is_the_printed_one() -> None:
    """A mode of 1 Hz and 1 % over 600 cycles is known to 0.16 % and 16 %."""
    law = long_record_law(1.0, 0.01, 600.0)
    np.testing.assert_allclose(law, (np.sqrt(0.01 / (1200 * np.pi)), 1 / np.sqrt(12 * np.pi)))
    banded = long_record_law(1.0, 0.01, 600.0, 5.0)
    np.testing.assert_allclose(banded, np.array(law) / np.sqrt(band_factors(5.0)))


@pytest.mark.parametrize("kappa", [4.0, 10.0, 30.0])
def test_without_noise_the_bound_is_the_law(kappa: float) -> None:
    """At a huge SNR the bound approaches the law with its band factors, for a light damping."""
    f, zeta, duration = 100.0, 0.001, 5000.0
    band = (f * (1 - kappa * zeta), f * (1 + kappa * zeta))
    bound = np.sqrt(np.diag(ambient_bound(f, zeta, 1e9, duration, band=band)))
    np.testing.assert_allclose(bound, long_record_law(f, zeta, duration, kappa), rtol=0.02)


def test_noise_and_an_unknown_noise_level_only_cost() -> None:
    """The bound grows as the SNR falls; more channels of the same total SNR determine the noise."""
    stds = [
        np.sqrt(np.diag(ambient_bound(100.0, 0.01, snr, 100.0, band=(80, 120))))
        for snr in (1e6, 100.0, 10.0, 1.0)
    ]
    assert (np.diff(stds, axis=0) > 0).all()
    more = ambient_bound(100.0, 0.01, 1.0, 100.0, band=(80, 120), n_channels=4)
    assert (np.diag(more) < np.diag(ambient_bound(100.0, 0.01, 1.0, 100.0, band=(80, 120)))).all()


def test_bounds_scale_with_the_length_of_the_record_and_not_with_units() -> None:
    """Four times the time halves the deviation; minutes instead of seconds do nothing."""
    one = ambient_bound(100.0, 0.01, 50.0, 100.0, band=(80, 120))
    four = ambient_bound(100.0, 0.01, 50.0, 400.0, band=(80, 120))
    np.testing.assert_allclose(one / four, 4, rtol=0.01)
    slow = ambient_bound(100.0 / 60, 0.01, 50.0, 6000.0, band=(80 / 60, 120 / 60))
    np.testing.assert_allclose(slow, one, rtol=1e-6)


def two_modes(apart: float, shapes: np.ndarray) -> Vibration:
    """Make modes at 100 Hz and so many Hz above."""
    return Vibration(np.array([100.0, 100.0 + apart]), np.array([0.01, 0.01]), shapes)


def stds(cov: np.ndarray) -> np.ndarray:
    """Take standard deviations from a covariance."""
    return np.sqrt(np.diag(cov))


@pytest.mark.parametrize("noise", [0.02, 2.0])
def test_the_joint_bound_inverts_the_curvature_of_the_divergence(noise: float) -> None:
    """The divergence from the truth to what is near, from plain response functions, is the same.

    Two modes, two channels with different noise, all else unknown: differenced twice by all ten
    parameters.
    """
    zeta, shapes = np.array([0.01, 0.02]), np.array([[1.0, 0.7], [0.4, -1.0]])
    f0, psd = np.array([60.0, 62.5]), np.array([1.0, 2.0])
    levels = np.array([noise, 3 * noise])
    frequency = np.arange(500, 751) / 10.0

    def spectra(p: np.ndarray) -> np.ndarray:
        c = np.zeros((frequency.size, 2, 2), dtype=complex)
        for i in range(2):
            mode = Mode(f0[i] * np.exp(p[i]), zeta[i] * np.exp(p[2 + i]))
            shape = shapes[:, i] + p[4 + 2 * i : 6 + 2 * i]
            power = psd[i] * np.abs(mode.response(frequency)) ** 2
            c += power[:, None, None] * np.outer(shape, shape)
        return c + np.diag(levels * np.exp(p[8:10]))

    truth = spectra(np.zeros(10))

    def divergence(p: np.ndarray) -> float:
        ratio = np.linalg.solve(spectra(p), truth)
        trace = np.trace(ratio, axis1=1, axis2=2).real
        return float(np.sum(trace - 2 - np.log(np.linalg.det(ratio).real)))

    step = 1e-4
    axes = step * np.eye(10)
    curvature = np.array(
        [
            [sum(u * v * divergence(u * a + v * b) for u in (1, -1) for v in (1, -1)) for b in axes]
            for a in axes
        ]
    ) / (4 * step**2)
    # Noise far below two modes hardly shows in two channels: what was known of it counts.
    curvature[[8, 9], [8, 9]] += 3.0**-2
    expected = np.linalg.inv(curvature)[:4, :4]
    recording = Recording(levels, 10.0, (50.0, 75.0))
    found = joint_bound(Vibration(f0, zeta, shapes), np.diag(psd), recording)
    np.testing.assert_allclose(found / np.outer(stds(expected), stds(expected)),
                               expected / np.outer(stds(expected), stds(expected)),
                               atol=0.01)  # fmt: skip


def test_one_mode_in_one_channel_is_bounded_alike_by_both() -> None:
    """The joint bound of one mode is that of its SNR."""
    one = Vibration(np.array([100.0]), np.array([0.01]), np.array([[0.7]]))
    joint = joint_bound(one, np.eye(1), Recording(np.array([2.0]), 50.0, (80, 125)))
    snr = 0.49 / (4 * 0.01**2 * 2.0)
    np.testing.assert_allclose(
        joint, ambient_bound(100.0, 0.01, snr, 50.0, band=(80, 125)), rtol=1e-6
    )


def test_far_modes_are_bounded_as_if_alone() -> None:
    """The joint bound of two modes 60 bandwidths apart is that of each by itself."""
    shapes = np.array([[1.0, 0.5], [0.3, 1.0], [0.2, -0.4]])
    noise = 1e-3
    modes = Vibration(np.array([60.0, 120.0]), np.array([0.01, 0.01]), shapes)
    joint = joint_bound(modes, np.eye(2), Recording(np.full(3, noise), 50.0, (40, 160)))
    for i, f in enumerate(modes.frequency):
        snr = np.sum(shapes[:, i] ** 2) / (4 * 0.01**2 * noise)
        alone = ambient_bound(f, 0.01, snr, 50.0, band=(40, 160), n_channels=3)
        own = joint[np.ix_([i, 2 + i], [i, 2 + i])]
        np.testing.assert_allclose(np.diag(own), np.diag(alone), rtol=0.05)


def test_close_modes_and_coherent_forces_cost_information() -> None:
    """The bound grows as two modes approach, and does not depend on the sign of shapes."""
    shapes = np.array([[1.0, 0.6], [0.5, -1.0]])
    recording = Recording(np.full(2, 1e-2), 50.0, (80, 125))

    def std(apart: float, force: np.ndarray, turned: np.ndarray = shapes) -> np.ndarray:
        return stds(joint_bound(two_modes(apart, turned), force, recording))

    far, near = std(10.0, np.eye(2)), std(2.0, np.eye(2))
    assert (near > far).all()
    # Forces that may be coherent, though they are not, on shapes that are nearly alike.
    alike = np.array([[1.0, 0.9], [0.5, 0.47]])
    sure, unsure = (std(2.0, np.array([[1.0, c], [c, 1.0]]), alike) for c in (0.0, 1e-9))
    assert (unsure > sure * (1 - 1e-6)).all()
    assert (unsure > sure * 1.005).any()
    np.testing.assert_allclose(std(2.0, np.eye(2), -shapes), near, rtol=1e-6)


@pytest.mark.slow
def test_a_simple_estimator_of_an_ambient_mode_reaches_its_bound_and_not_a_better_one() -> None:
    """Whittle fits of exponential ordinates scatter by the bound; at half of it they would not.

    The fit is a plain minimisation of its own; 400 fits know a standard deviation to 3.5 %.
    """
    f0, zeta, noise, duration, band = 100.0, 0.02, 1.0, 60.0, (80.0, 125.0)
    mode = Mode(f0, zeta, 0.16)
    bound = np.sqrt(np.diag(ambient_bound(f0, zeta, mode.snr(noise), duration, band=band)))
    frequency = np.arange(np.ceil(band[0] * duration), band[1] * duration) / duration
    truth = density([mode], frequency, noise)
    rng = np.random.default_rng(7)
    found = []
    for _ in range(400):
        ordinates = truth * rng.exponential(size=truth.size)

        def misfit(q: np.ndarray, ordinates: np.ndarray = ordinates) -> float:
            tried = Mode(
                f0 * np.exp(q[0] * bound[0]), zeta * np.exp(q[1] * bound[1]), 0.16 * np.exp(q[2])
            )
            level = density([tried], frequency, noise * np.exp(q[3]))
            return float(np.sum(np.log(level) + ordinates / level))

        found.append(optimize.minimize(misfit, np.zeros(4), method="BFGS").x[:2])
    scatter = np.std(found, axis=0)
    assert (np.abs(scatter - 1) < 0.15).all()
    assert not (np.abs(scatter / 0.5 - 1) < 0.15).any()


@pytest.mark.slow
def test_a_simple_estimator_of_decays_reaches_its_bound() -> None:
    """Least squares on decays in white noise, where they are efficient, scatter by the bound."""
    rng = np.random.default_rng(8)
    f0, zeta, rate, n, noise = 60.0, 0.01, 400.0, 400, 0.05
    one = Vibration(np.array([f0]), np.array([zeta]), np.eye(1))
    recording = Recording(np.array([noise**2 * 2 / rate]), 1.0, (1.0, 199.0))
    bound = stds(decay_bound(one, np.ones((1, 1), complex), np.zeros(1), recording))
    t = np.arange(n) / rate
    found = []
    for _ in range(300):
        x = stop(rng, [Ring(f0, zeta)], n, rate, noise)[0]

        def left(q: np.ndarray, x: np.ndarray = x) -> np.ndarray:
            omega, z = 2 * np.pi * f0 * np.exp(q[0] * bound[0]), zeta * np.exp(q[1] * bound[1])
            wave = np.exp(omega * (-z + 1j * np.sqrt(1 - z**2)) * t)
            columns = np.stack([wave.real, wave.imag], axis=1)
            return np.asarray(x - columns @ np.linalg.lstsq(columns, x)[0])

        found.append(optimize.least_squares(left, np.zeros(2)).x)
    scatter = np.std(found, axis=0)
    assert (np.abs(scatter - 1) < 0.16).all()


def test_an_ambient_response_raises_the_bound_of_a_decay() -> None:
    """The bound grows with the ambient response, and falls with decays and channels."""

    def std(ambient: float, n_decays: int, n_channels: int) -> np.ndarray:
        one = Vibration(np.array([60.0]), np.array([0.01]), np.ones((n_channels, 1)))
        recording = Recording(np.full(n_channels, 1e-5), 1.0, (30, 90))
        return stds(
            decay_bound(one, np.ones((n_decays, 1), complex), np.array([ambient]), recording)
        )

    quiet, shaken = std(1e-9, 1, 1), std(1e-5, 1, 1)
    assert (shaken > 1.5 * quiet).all()
    np.testing.assert_allclose(std(1e-5, 4, 1), shaken / 2, rtol=0.02)
    np.testing.assert_allclose(std(0.0, 1, 4), std(0.0, 1, 1) / 2, rtol=0.02)
    # Four channels see one and the same ambient response.
    assert (std(1e-3, 1, 4) > 0.9 * std(1e-3, 1, 1)).all()


def test_decays_of_close_modes_cost_information() -> None:
    """Far modes are bounded as if alone, near ones worse, with coefficients that correlate."""
    recording = Recording(np.full(2, 1e-5), 1.0, (60, 140))
    shapes = np.array([[1.0, 0.6], [0.5, -1.0]])

    def cov(modes: Vibration) -> np.ndarray:
        m = modes.frequency.size
        return decay_bound(modes, np.ones((2, m), complex), np.full(m, 1e-8), recording)

    far, near = cov(two_modes(20.0, shapes)), cov(two_modes(1.0, shapes))
    alone = cov(Vibration(np.array([100.0]), np.array([0.01]), shapes[:, :1]))
    np.testing.assert_allclose(stds(far)[[0, 2]], stds(alone), rtol=0.05)
    assert (stds(near)[[0, 2]] > 1.05 * stds(alone)).all()


def test_a_shape_that_does_not_fit_is_named() -> None:
    """Shapes of another number of modes are refused with what was needed."""
    with pytest.raises(ValueError, match="damping_ratio"):
        Vibration(np.array([60.0, 70.0]), np.array([0.01]), np.ones((1, 2)))
