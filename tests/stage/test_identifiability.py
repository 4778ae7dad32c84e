"""Identifiability: sensitivities and precisions against closed forms and drawn drifts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lmshealth.errors import BadStage
from lmshealth.stage.cramer_rao import ambient_bound
from lmshealth.stage.description import load_stage
from lmshealth.stage.identifiability import (
    Identifiability,
    identifiability_of,
)
from tests.lives import DAMPING, FREQUENCY, MOUNT, PRELOAD, SENSITIVITY, make_stage

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


@pytest.mark.parametrize(("model_std", "covered"), [(0.3, True), (0.0, False)])
def test_the_precision_is_that_of_drawn_drifts(
    information: Identifiability, model_std: float, covered: bool
) -> None:
    """Estimates scatter as they should where sensitivities are wrong; not where that is left out.

    Sensitivities are drawn 30 % wrong. The mean square of 40,000 errors in units of its expectation
    has a standard deviation below 0.02: the errors have heavier tails than a Gaussian.
    """
    rng, n = np.random.default_rng(8), 40_000
    slopes, prior = information.slopes, information.prior
    noise = np.array([1e-6, 4e-6])
    x = rng.normal(0, np.sqrt(prior), (n, 2))
    wrong = 1 + 0.3 * rng.normal(size=(n, 2, 2))
    drifts = np.einsum("nij,ij,nj->ni", wrong, slopes, x) + rng.normal(0, np.sqrt(noise), (n, 2))
    model = Identifiability(NAMES, information.modes, slopes, prior, model_std, np.zeros(2), 5)
    cov = np.linalg.inv(model.precision(noise))
    weights = 1 / (noise + model_std**2 * slopes**2 @ prior)
    estimates = (drifts * weights) @ slopes @ cov
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
