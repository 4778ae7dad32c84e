"""Modes too close to each other to be told apart: what is known of them is where both stand."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from lmshealth.modal.ambient.cluster_fit import BandFit, Missing

# Half-power bandwidths between modes that channels see alike, and between any: closer ones trade
# strength and damping with each other, and no likelihood is normal in them any more.
_APART_ALIKE, _APART = 1.0, 0.2
# Correlation of shapes (MAC) above which channels see two modes alike.
_ALIKE = 0.8


def keep_separate(fit: BandFit, *, known: bool) -> tuple[BandFit, Missing]:
    """Take out modes that cannot be told apart.

    Parameters
    ----------
    fit : BandFit
        Modes of a cluster.
    known : bool
        Whether they were sought by name: then two that are too close are both refused, and the
        reason says where they stand together. Otherwise one is left for both, with a standard
        deviation that reaches to either and the flag ``cluster``.

    Returns
    -------
    fit : BandFit
        What is left.
    missing : dict
        Reason and detail of each mode that was taken out.
    """
    missing: Missing = {}
    while (pair := _closest(fit)) is not None:
        i, j = pair
        names = [fit.targets[k].name for k in (i, j)]
        both = _merged(fit, i, j)
        if not known:
            fit = both.only([t.name for t in fit.targets if t.name != names[1]])
            continue
        m = len(fit.targets)
        f = np.sort(np.exp(fit.estimate[[i, j]]))
        centre = float(np.exp(both.estimate[i]))
        std = centre * float(np.sqrt(both.cov[i, i]))
        ratio = float(np.exp(both.estimate[m + i]))
        detail = (
            f"resonances at {f[0]:.5g} and {f[1]:.5g} Hz cannot be told apart; together they stand "
            f"at {centre:.5g} ± {std:.2g} Hz, damping {100 * ratio:.2g} %: record longer, or in a "
            "channel that they move differently"
        )
        missing |= dict.fromkeys(names, ("too-close", detail))
        fit = fit.only([t.name for t in fit.targets if t.name not in names])
    return fit, missing


def _closest(fit: BandFit) -> tuple[int, int] | None:
    """Find two modes that are too close; None where there are none."""
    m = len(fit.targets)
    f, zeta = np.exp(fit.estimate[:m]), np.exp(fit.estimate[m:])
    shapes = fit.shapes / np.linalg.norm(fit.shapes, axis=0)
    for i, j in combinations(range(m), 2):
        apart = abs(f[i] - f[j]) / (zeta[i] * f[i] + zeta[j] * f[j])
        alike = float(shapes[:, i] @ shapes[:, j]) ** 2 > _ALIKE
        if apart < (_APART_ALIKE if alike else _APART):
            return i, j
    return None


def _merged(fit: BandFit, i: int, j: int) -> BandFit:
    """Put what two modes have in common in the place of the first."""
    m = len(fit.targets)
    mean = np.eye(2 * m)
    for a, b in ((i, j), (m + i, m + j)):
        mean[a, [a, b]] = 0.5
    half = (fit.estimate[[i, m + i]] - fit.estimate[[j, m + j]]) / 2
    cov = mean @ fit.cov @ mean.T
    cov[[i, m + i], [i, m + i]] += half**2
    flags = tuple(f"{flag} cluster".strip() if k == i else flag for k, flag in enumerate(fit.flags))
    return replace(fit, estimate=mean @ fit.estimate, cov=cov, flags=flags)
