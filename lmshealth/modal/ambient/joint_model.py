"""Joint fit of all modes of a band with independent noise floors, to select candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lmshealth._arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.modal.ambient.whittle import receptance, response

# Gain in log likelihood below which a mode is left as it is, and most shorter steps.
_LEAST_GAIN, _HALVINGS = 0.3, 5
# Median of the square of a normal variable.
_MEDIAN_SQUARE = 0.455
# Of silent channels, in units of the median density of a channel.
LEAST_FLOOR = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class BandData:
    """Mean cross spectra of a band, in units of the median of each channel."""

    frequency: FloatArray  # in Hz, (n,)
    count: FloatArray  # ordinates of single segments in each mean, (n,)
    matrix: ComplexArray  # (n, n_channels, n_channels)
    foreign: ComplexArray | None  # expectation of what no mode causes, as the matrix
    scale: FloatArray  # unit of each channel in (m/s²)/Hz^½, (n_channels,)
    basis: FloatArray  # of the floors, positive, (n_basis, n)


class JointModel:
    """Modes with real shapes and correlated forces, and independent floors.

    E = Σ R_ij b_i b_j* + floors, b_i = φ_i h_i + ρ_i: R has a unit diagonal, φ_i holds the root of
    the PSD of the modal force in each channel, ρ_i the static response. Modes are refined one after
    the other by Fisher's scoring with the others fixed, so that the cost of a sweep is linear in
    their number. It selects modes; published estimates come from the likelihood of `whittle`.
    """

    def __init__(
        self,
        data: BandData,
        floor: FloatArray,
        f: FloatArray,
        zeta: FloatArray,
        phi: FloatArray,
        r: FloatArray,
        rho: FloatArray | None = None,
    ) -> None:
        self.data, self.floor = data, floor
        self.f, self.zeta, self.phi, self.r = f, zeta, phi, r
        self.rho = np.zeros_like(phi) if rho is None else rho
        self.misfit, self._inverse = self._evaluate()

    def without(self, i: int) -> JointModel:
        """Return the model without one mode."""
        return self.subset(np.arange(self.f.size) != i)

    def subset(self, kept: BoolArray) -> JointModel:
        """Return the model of some of its modes."""
        poles = self.f[kept], self.zeta[kept]
        r = self.r[np.ix_(kept, kept)]
        return JointModel(
            self.data, self.floor.copy(), *poles, self.phi[:, kept], r, self.rho[:, kept]
        )

    def of_channels(self, kept: list[int]) -> JointModel:
        """Return the model of some of the channels."""
        d, block = self.data, np.ix_(range(len(self.data.count)), kept, kept)
        foreign = None if d.foreign is None else d.foreign[block]
        data = replace(d, matrix=d.matrix[block], foreign=foreign, scale=d.scale[kept])
        poles, rows = (self.f.copy(), self.zeta.copy()), (self.phi[kept], self.r, self.rho[kept])
        return JointModel(data, self.floor[kept], *poles, *rows)

    def dispersions(self) -> FloatArray:
        """Return, for each channel given the others, the dispersion of its residual; 1 for noise.

        The median square of the residual is resistant to lines.
        """
        g = self._inverse
        ratio = np.einsum("kaa->ka", g @ self.data.matrix @ g).real / np.einsum("kaa->ka", g).real
        squares = self.data.count[:, None] * (ratio - 1) ** 2
        return np.asarray(np.median(squares, axis=0) / _MEDIAN_SQUARE)

    def with_mode(self, f: float, zeta: float, phi: FloatArray) -> JointModel:
        """Return the model with one mode more, the last one."""
        m = self.f.size
        r = np.eye(m + 1)
        r[:m, :m] = self.r
        return JointModel(
            self.data,
            self.floor.copy(),
            np.append(self.f, f),
            np.append(self.zeta, zeta),
            np.column_stack([self.phi, phi]),
            r,
            np.column_stack([self.rho, np.zeros_like(phi)]),
        )

    @property
    def size(self) -> int:
        """Number of unknowns of the modes."""
        m, n = self.f.size, len(self.phi)
        return m * (2 + n) + m * (m - 1) // 2

    def _columns(self) -> ComplexArray:
        """Return b, shape ``(n, n_channels, n_modes)``."""
        h = response(self.f[:, None], self.zeta[:, None], self.data.frequency)
        return np.asarray(self.phi[None] * h.T[:, None, :] + self.rho)

    def expected(self) -> ComplexArray:
        """Compute E, shape ``(n, n_channels, n_channels)``."""
        b = self._columns()
        e = (b @ self.r) @ np.swapaxes(b.conj(), 1, 2)
        k = np.arange(e.shape[1])
        e[:, k, k] += (self.floor @ self.data.basis).T
        return e if self.data.foreign is None else e + self.data.foreign

    def modal(self, kept: BoolArray, frequency: FloatArray) -> ComplexArray:
        """Return the part of some modes in the expectation, in physical units."""
        h = response(self.f[kept, None], self.zeta[kept, None], frequency)
        b = (self.phi[:, kept] * h.T[:, None, :] + self.rho[:, kept]) * self.data.scale[:, None]
        return np.asarray((b @ self.r[np.ix_(kept, kept)]) @ np.swapaxes(b.conj(), 1, 2))

    def _evaluate(self) -> tuple[float, ComplexArray]:
        """Return the negative log posterior, infinite where E is singular, and the inverse of E."""
        e = self.expected()
        try:
            root = np.linalg.cholesky(e)
        except np.linalg.LinAlgError:
            return np.inf, e
        log_det = 2 * np.log(np.diagonal(root, axis1=1, axis2=2).real).sum(axis=1)
        inverse = np.asarray(np.linalg.inv(e), dtype=np.complex128)
        # tr E⁻¹ W of Hermitian matrices
        trace = np.sum(inverse.conj() * self.data.matrix, axis=(1, 2)).real
        prior = np.sum(self.rho**2 / self._rho_variance()[:, None]) + np.sum(
            np.tril(self.r, -1) ** 2
        )
        return float(self.data.count @ (log_det + trace) + 0.5 * prior), inverse

    def _rho_variance(self) -> FloatArray:
        return np.asarray(np.mean(self.floor, axis=1))

    def nearest(self, f: float, most: int = 3) -> list[int]:
        """Return the modes that are nearest to a frequency in units of their bandwidths."""
        order = np.argsort(np.abs(np.log(self.f / f)) / self.zeta)
        return [int(i) for i in order[:most]]

    def refine(self, sweeps: int, modes: Sequence[int] | None = None) -> None:
        """Improve the modes one after the other, as long as they gain."""
        active = list(range(self.f.size)) if modes is None else modes
        for _ in range(sweeps):
            self._refine_floor()
            gains = []
            for i in active:
                before = self.misfit
                self._refine_mode(i)
                gains.append(before - self.misfit)
            active = [i for i, gain in zip(active, gains, strict=True) if gain > _LEAST_GAIN]
            if not active:
                break

    def _refine_floor(self) -> None:
        for _ in range(2):
            g = self._inverse
            gwg = g @ self.data.matrix @ g
            up = (self.data.count * np.einsum("kaa->ak", gwg).real) @ self.data.basis.T
            down = (self.data.count * np.einsum("kaa->ak", g).real) @ self.data.basis.T
            old = self.floor
            ratio = np.sqrt((up / down).clip(1e-2, 1e2)) ** 1.8
            self.floor = np.maximum(self.floor * ratio, LEAST_FLOOR)
            if not self._improved():
                self.floor = old
                break

    def _refine_mode(self, i: int) -> None:
        """Improve pole, shape and static response of a mode, then its share of the forces."""
        n, m = self.phi.shape
        h = receptance(self.f[i : i + 1, None], self.zeta[i : i + 1, None], self.data.frequency)[
            :3, 0
        ]
        eye = np.eye(n)
        u = np.concatenate(
            [
                h[1:].T[:, None, :] * self.phi[None, :, i, None],
                h[0, :, None, None] * eye,
                np.ones((h.shape[1], 1, 1)) * eye,
            ],
            axis=2,
        )
        gradient, fisher = self._score(self._inverse, self._columns() @ self.r[:, i], u)
        weak = 1 / self._rho_variance()
        gradient[2 + n :] += weak * self.rho[:, i]
        step = _solve(gradient, fisher, np.concatenate([np.zeros(2 + n), weak]))
        # At most a bandwidth, and a factor of two of the damping, in one step.
        step *= min(
            1.0, 1.5 * self.zeta[i] / max(abs(step[0]), 1e-12), 0.7 / max(abs(step[1]), 1e-12)
        )
        state = self.f[i], self.zeta[i], self.phi[:, i].copy(), self.rho[:, i].copy()
        for _ in range(_HALVINGS):
            self.f[i], self.zeta[i] = state[0] * np.exp(step[0]), state[1] * np.exp(step[1])
            self.phi[:, i] = state[2] + step[2 : 2 + n]
            self.rho[:, i] = state[3] + step[2 + n :]
            if self._improved():
                break
            step = step * 0.3
        else:
            self.f[i], self.zeta[i], self.phi[:, i], self.rho[:, i] = state
        if m > 1:
            self._refine_forces(i)

    def _refine_forces(self, i: int) -> None:
        """Improve the correlations of the force of a mode."""
        m = self.f.size
        b = self._columns()
        others = np.arange(m) != i
        gradient, fisher = self._score(self._inverse, b[:, :, i], b[:, :, others])
        step = _solve(gradient + self.r[i, others], fisher, np.ones(m - 1))
        state = self.r
        for _ in range(_HALVINGS):
            self.r = state.copy()
            self.r[i, others] = self.r[others, i] = np.clip(state[i, others] + step, -0.999, 0.999)
            if np.linalg.eigvalsh(self.r)[0] > 1e-4 and self._improved():
                return
            step = step * 0.3
        self.r = state

    def _improved(self) -> bool:
        """Return whether the misfit decreased, and keep it if so."""
        value, inverse = self._evaluate()
        better = value < self.misfit
        if better:
            self.misfit, self._inverse = value, inverse
        return better

    def _score(
        self, g: ComplexArray, v: ComplexArray, u: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Gradient and Fisher information of unknowns by which E changes as u v* + v u*."""
        gv = (g @ v[:, :, None])[:, :, 0]
        size = (gv * v.conj()).sum(axis=1).real
        gu = g @ u
        along = np.einsum("kc,kca->ka", gv.conj(), u)
        excess = gv - (g @ (self.data.matrix @ gv[:, :, None]))[:, :, 0]
        gradient = 2 * self.data.count @ np.einsum("kc,kca->ka", excess.conj(), u).real
        across = (u * (self.data.count * size)[:, None, None]).reshape(-1, u.shape[2])
        fisher = across.conj().T @ gu.reshape(-1, u.shape[2])
        fisher = fisher + (along * self.data.count[:, None]).T @ along
        return gradient, np.asarray(2 * fisher.real)


def _solve(gradient: FloatArray, fisher: FloatArray, prior: FloatArray) -> FloatArray:
    information = fisher + np.diag(prior + 1e-6 * np.diag(fisher) + 1e-12)
    return np.asarray(-np.linalg.solve(information, gradient), dtype=np.float64)
