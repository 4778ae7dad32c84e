"""Modal estimates of many logs as a table, and which of its rows need no second look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lmshealth._arrays import BoolArray, FloatArray, expect_shape, freeze
from lmshealth.errors import BadTable
from lmshealth.tracking.association.mode_filters import Readings

# What ln f may differ by from the log before, beyond its error and covariates, and by how much more
# modes must be apart from each other, to be plain.
_STILL, _APART = 0.005, 0.03
_SIGMAS = 4.0
_SAME_SHAPE = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """What one log says.

    Attributes
    ----------
    names : tuple of str
        Names that the identification gave, empty where it gave none.
    sources : tuple of str
        What each was seen by. Two estimates of one source are never of one mode.
    ln_frequency, ln_damping : ndarray
        Of each estimate, shape ``(n,)``, of f in Hz and of the ratio ζ; ln ζ is NaN where unknown.
    cov : ndarray
        Covariance of ``[ln f, ln ζ]``, ``(2 n, 2 n)``; NaN where ln ζ is unknown.
    shapes : ndarray
        Real shapes, ``(n, n_channels)``, of any length; NaN where a channel is absent.

    Raises
    ------
    ValueError
        If shapes of arrays do not belong together.
    """

    names: tuple[str, ...]
    sources: tuple[str, ...]
    ln_frequency: FloatArray
    ln_damping: FloatArray
    cov: FloatArray
    shapes: FloatArray

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(self.sources) != n:
            raise ValueError(f"sources has {len(self.sources)} entries, needed {n}")
        expect_shape("ln_frequency", self.ln_frequency, (n,))
        expect_shape("ln_damping", self.ln_damping, (n,))
        expect_shape("cov", self.cov, (2 * n, 2 * n))
        if self.shapes.ndim != 2:
            raise ValueError(f"shapes has {self.shapes.ndim} dimensions, needed 2")
        expect_shape("shapes", self.shapes, (n, self.shapes.shape[1]))
        freeze(self)


class Table:
    """Estimates of all logs, checked.

    Parameters
    ----------
    epochs : sequence of Estimates
        One for each log, with equally many channels.
    offsets : ndarray
        Covariates about their references, ``(n_epochs, n_covariates)``.
    prior_std : ndarray
        Of their coefficients, ``(n_covariates,)``.

    Attributes
    ----------
    plain : ndarray
        Logs that show the same names as the log before, all of them where they were and far from
        each other, shape ``(n_epochs,)``: it takes no filter to tell who is who there.

    Raises
    ------
    BadTable
        If an estimate is not finite or has no positive variance.
    """

    def __init__(
        self, epochs: Sequence[Estimates], offsets: FloatArray, prior_std: FloatArray
    ) -> None:
        self._start = np.cumsum([0, *(len(e.names) for e in epochs)]).tolist()
        every = [(e.cov.diagonal(), len(e.names)) for e in epochs]
        self._ln_f = np.concatenate([e.ln_frequency for e in epochs])
        self._ln_zeta = np.concatenate([e.ln_damping for e in epochs])
        self._var_f = np.concatenate([var[:n] for var, n in every])
        self._var_zeta = np.concatenate([var[n:] for var, n in every])
        self._shapes = np.concatenate([e.shapes for e in epochs])
        self._check(epochs)
        unknown = ~np.isfinite(self._ln_zeta)
        self._ln_zeta[unknown], self._var_zeta[unknown] = 0.0, np.inf
        if self._shapes.shape[1]:
            norm = np.sqrt(np.nansum(self._shapes**2, axis=1, keepdims=True))
            self._shapes /= np.where(norm > 0, norm, np.nan)
        self.plain = self._screen(epochs, np.abs(np.diff(offsets, axis=0)) @ prior_std)

    def readings(self, k: int) -> Readings:
        """Return the estimates of a log."""
        own = slice(self._start[k], self._start[k + 1])
        return Readings(
            self._ln_f[own],
            self._var_f[own],
            self._ln_zeta[own],
            self._var_zeta[own],
            self._shapes[own],
        )

    def _check(self, epochs: Sequence[Estimates]) -> None:
        good = np.isfinite(self._ln_f) & np.isfinite(self._var_f) & (self._var_f > 0)
        fine = np.isfinite(self._var_zeta) & (self._var_zeta > 0)
        good &= fine | ~np.isfinite(self._ln_zeta)
        if good.all():
            return
        at = int(np.flatnonzero(~good)[0])
        k = int(np.searchsorted(self._start, at, side="right")) - 1
        i = at - self._start[k]
        raise BadTable(
            f"epoch {k}, estimate {i} ({epochs[k].names[i] or 'without a name'}): ln f "
            f"{self._ln_f[at]:g} with variance {self._var_f[at]:g}, ln ζ {self._ln_zeta[at]:g} "
            f"with variance {self._var_zeta[at]:g}: needed finite values with positive "
            "variances; leave out what has none, and give ln ζ as NaN where it is not known"
        )

    def _screen(self, epochs: Sequence[Estimates], moved: FloatArray) -> BoolArray:
        plain = np.zeros(len(epochs), dtype=bool)
        first = 0
        for k in range(1, len(epochs) + 1):
            if (
                k < len(epochs)
                and epochs[k].names == epochs[first].names
                and (epochs[k].sources == epochs[first].sources)
            ):
                continue
            head = epochs[first]
            own = set(zip(head.names, head.sources, strict=True))
            if k - first > 1 and head.names and all(head.names) and len(own) == len(head.names):
                plain[first + 1 : k] = self._screen_run(head.names, first, k, moved[first : k - 1])
            first = k
        return plain

    def _screen_run(
        self, names: tuple[str, ...], first: int, stop: int, moved: FloatArray
    ) -> BoolArray:
        """Screen logs from the second on that show the same names."""
        n = len(names)
        own = slice(self._start[first], self._start[stop])
        ln_f, var_f = self._ln_f[own].reshape(-1, n), self._var_f[own].reshape(-1, n)
        ln_zeta, var_zeta = self._ln_zeta[own].reshape(-1, n), self._var_zeta[own].reshape(-1, n)
        reach = _STILL + moved[:, None] + _SIGMAS * np.sqrt(var_f[1:] + var_f[:-1])
        # Where a damping is unknown its variance is infinite.
        far = _SIGMAS * np.sqrt(var_zeta[1:] + var_zeta[:-1])
        fine = (np.diff(ln_f, axis=0) / reach) ** 2 + (np.diff(ln_zeta, axis=0) / far) ** 2 <= 1
        if self._shapes.shape[1] > 1:
            shapes = self._shapes[own].reshape(-1, n, self._shapes.shape[1])
            fine &= np.nansum(shapes[1:] * shapes[:-1], axis=2) ** 2 >= _SAME_SHAPE
        plain = fine.all(1)
        gap = _APART + reach.max(1)
        for i, j in combinations(range(n), 2):
            if names[i] != names[j]:
                plain &= np.abs(ln_f[1:, i] - ln_f[1:, j]) >= gap
        return np.asarray(plain)
