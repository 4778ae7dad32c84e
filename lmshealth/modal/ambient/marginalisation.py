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

from lmshealth._arrays import FloatArray
from lmshealth.modal.ambient.whittle import Likelihood

# Standard deviations of the parts that a floor shares with modes and with other floors, in units
# of its own, and of its bend; the last ones are those of the likelihood.
_WIDTHS = ((0.03, 0.1, 1.0), (0.03, 0.3, 3.0), (0.03, 0.1, 1.0))


def marginalise(likelihood: Likelihood, p: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Give mean and covariance of ln f and ln ζ by Laplace's approximation.

    Parameters
    ----------
    likelihood : Likelihood
        With its priors.
    p : ndarray
        Its posterior mode, or near it, shape ``(n_unknowns,)``.

    Returns
    -------
    mean : ndarray
        ``[ln f, ln ζ]``, shape ``(2 n_modes,)``.
    cov : ndarray
        Their covariance, shape ``(2 n_modes, 2 n_modes)``.
    decrement : float
        Newton decrement g H⁻¹ g at the mode; infinite where it is none.
    """
    n, layout = 2 * likelihood.layout.n_modes, likelihood.layout
    gradient, hessian = likelihood.derivatives(p)
    try:
        np.linalg.cholesky(hessian)  # it exists at a maximum alone
    except np.linalg.LinAlgError:
        return p[:n], np.full((n, n), np.nan), np.inf
    cov = np.linalg.inv(hessian)
    # Where the search ended the slope is not quite zero: the normal stands a little further.
    step = cov @ gradient
    p, decrement = p - step, float(gradient @ step)
    groups = (layout.shared, layout.common, layout.bends)
    index = np.array([unknown for group in groups for unknown in group], dtype=int)
    precision = np.linalg.inv(cov[np.ix_(index, index)])
    follow = cov[:n, index] @ precision  # how ln f and ln ζ move with these unknowns
    weight, mean, narrowed = _narrow(p[index], precision, [len(group) for group in groups])
    moved = (mean - p[index]) @ follow.T
    estimate = p[:n] + weight @ moved
    apart = p[:n] + moved - estimate
    less = cov[np.ix_(index, index)] - np.tensordot(weight, narrowed, axes=1)
    cov = cov[:n, :n] - follow @ less @ follow.T + (weight[:, None] * apart).T @ apart
    return estimate, np.asarray(cov, dtype=np.float64), decrement


def _narrow(
    x: FloatArray, precision: FloatArray, sizes: list[int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Try narrower priors on groups of unknowns that are near-normal under the widest ones.

    Returns
    -------
    weight : ndarray
        Evidence of each choice of widths, which add up to one, shape ``(n_choices,)``.
    mean, cov : ndarray
        Of the unknowns, shapes ``(n_choices, n)`` and ``(n_choices, n, n)``.
    """
    widths = np.array(list(product(*_WIDTHS)))
    widest = np.array([w[-1] for w in _WIDTHS])
    # What the narrower prior has more than the one that is in the precision.
    extra = np.repeat(widths**-2 - widest**-2, sizes, axis=1)
    narrower = precision + extra[:, :, None] * np.eye(x.size)
    cov = np.asarray(np.linalg.inv(narrower), dtype=np.float64)
    mean = cov @ (precision @ x)
    shift = mean - x
    cost = np.einsum("ki,ij,kj->k", shift, precision, shift) + np.sum(extra * mean**2, axis=1)
    log_det = np.linalg.slogdet(narrower)[1]
    weight = softmax(-0.5 * (cost + log_det) - np.log(widths) @ sizes)
    return np.asarray(weight), mean, cov
