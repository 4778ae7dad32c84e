"""The posterior of ln f and ln ζ: Laplace's approximation, averaged over widths of priors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.modal.ambient.marginalisation import marginalise
from lmshealth.modal.ambient.whittle import Likelihood
from tests.bands import (
    MODES,
    block_of,
    covariance,
    drawn,
    frequencies,
    noisy,
    scatter_free,
    spectrum_of,
)


def fitted(target: Likelihood) -> np.ndarray:
    """Find the posterior mode."""
    return target.minimise(target.start)


@pytest.mark.parametrize(("m", "n"), [(1, 1), (1, 3), (2, 2)])
def test_it_lies_between_nothing_shared_and_anything_shared(m: int, n: int) -> None:
    """Deviations are at least those with the shared parts known, at most those with wide priors."""
    target = noisy(m, n, 7.0)
    p = fitted(target)
    mean, cov, decrement = marginalise(target, p)
    assert decrement < 1e-2
    hessian = target.derivatives(p)[1]
    layout = target.layout
    loose = [*layout.shared, *layout.common, *layout.bends]
    known = np.setdiff1d(np.arange(layout.size), loose)
    size = 2 * m
    narrow = np.diag(np.linalg.inv(hessian[np.ix_(known, known)]))[:size]
    wide = np.diag(np.linalg.inv(hessian))[:size]
    spread = np.diag(cov)
    assert (spread > 0.99 * narrow).all()
    # What the means of different widths differ by adds to the variance.
    assert (spread < wide + (mean - p[:size]) ** 2 + 0.5 * wide).all()
    assert np.linalg.eigvalsh(cov).min() > 0


def test_without_anything_shared_the_narrow_priors_win() -> None:
    """Without shared forces the truth is the mean, and half the information at most is lost."""
    target = scatter_free(MODES[:1], 2, 30.0)
    mean, cov, _ = marginalise(target, fitted(target))
    std = np.sqrt(np.diag(cov))
    assert np.abs((mean - target.start[:2]) / std).max() < 0.1
    known = np.linalg.inv(target.derivatives(target.start)[1][:2, :2])
    assert (std < 2 * np.sqrt(np.diag(known))).all()


def test_floors_that_share_much_pull_the_wide_priors_in() -> None:
    """Where a floor is driven by the mode's force the mean stays near the free optimum."""
    truth = noisy(1, 2, 30.0)
    p = truth.start.copy()
    p[truth.layout.shared] = 1.0, -1.0
    x = drawn(covariance(truth, p, frequencies(30.0)), np.random.default_rng(4))
    block = block_of([spectrum_of(x[:, :, None] * x[:, None].conj(), 30.0)])
    target = replace(truth, blocks=(block,))
    optimum = fitted(target)
    mean, cov, _ = marginalise(target, optimum)
    std = np.sqrt(np.diag(cov))
    assert np.abs((mean - optimum[:2]) / std).max() < 0.3
    assert np.abs((mean - truth.start[:2]) / std).max() < 4


def test_where_there_is_no_maximum_it_says_so() -> None:
    """Off the maximum the decrement is large, and infinite where the Hessian has no root."""
    target = noisy(1, 2, 7.0)
    p = fitted(target)
    off = p.copy()
    off[0] += 1e-2
    assert marginalise(target, off)[2] > 1
    saddle = p.copy()
    saddle[0] += 0.15
    _, cov, decrement = marginalise(target, saddle)
    assert decrement == np.inf
    assert np.isnan(cov).all()
