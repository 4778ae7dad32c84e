"""From the likelihood of a band to estimates: what is not asked for is integrated out.

How much of a floor is driven by the forces of the modes or of other floors, and how far it bends,
one log hardly tells. Yet all of it moves the estimates, by a standard deviation or two where it is
neglected, while a third of the information is lost where nothing is supposed about it. It is
therefore given a normal prior of unknown width, and the posterior is averaged over its evidence:
floors of sensor noise end up with narrow ones, floors of the structure's own motion with wide ones.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.special import softmax

from lmshealth.arrays import FloatArray
from lmshealth.whittle import Likelihood

# Standard deviations of the parts that a floor shares with modes and with other floors, in units
# of its own, and of its bend; the last ones are those of the likelihood.
_WIDTHS = ((0.03, 0.1, 0.3, 1.0), (0.03, 0.3, 3.0), (0.1, 0.3, 1.0))


def marginalise(likelihood: Likelihood, p: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Give mean and covariance of ln f and ln ζ by Laplace's approximation.

    Parameters
    ----------
    likelihood : Likelihood
        With its priors.
    p : ndarray
        Its posterior mode, shape ``(n_unknowns,)``.

    Returns
    -------
    mean : ndarray
        ``[ln f, ln ζ]``, shape ``(2 n_modes,)``.
    cov : ndarray
        Their covariance, shape ``(2 n_modes, 2 n_modes)``.
    decrement : float
        Newton decrement g H⁻¹ g at the mode; infinite where it is none.
    """
    n = 2 * likelihood.layout.n_modes
    gradient, hessian = likelihood.derivatives(p)
    try:
        factor = np.linalg.cholesky(hessian)
    except np.linalg.LinAlgError:
        return p[:n], np.full((n, n), np.nan), np.inf
    decrement = float(np.sum(np.linalg.solve(factor, gradient) ** 2))
    layout = likelihood.layout
    groups = (layout.shared, layout.common, layout.bends)
    widest = [widths[-1] for widths in _WIDTHS]
    weights, means, covs = [], [], []
    for widths in product(*_WIDTHS):
        # What the narrower prior has more than the one that is in the Hessian.
        extra = np.zeros(p.size)
        for index, width, most in zip(groups, widths, widest, strict=True):
            extra[index] = width**-2 - most**-2
        narrowed = hessian + np.diag(extra)
        shift = -np.linalg.solve(narrowed, extra * p)
        moved = p + shift
        cost = 0.5 * float(shift @ hessian @ shift + extra @ moved**2)
        n_each = [len(index) for index in groups]
        weights.append(
            -cost - 0.5 * np.linalg.slogdet(narrowed)[1] - float(np.log(widths) @ n_each)
        )
        means.append(moved[:n])
        covs.append(np.linalg.inv(narrowed)[:n, :n])
    weight = softmax(weights)
    mean = weight @ np.array(means)
    apart = np.array(means) - mean
    cov = np.tensordot(weight, np.array(covs), axes=1) + (weight[:, None] * apart).T @ apart
    return mean, np.asarray(cov, dtype=np.float64), decrement
