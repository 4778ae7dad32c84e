"""Joint fit of all modes of a band with independent noise floors, to select candidates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.whittle import receptance, response

# Gain in log likelihood below which a mode is left as it is, and most shorter steps.
_LEAST_GAIN, _HALVINGS = 0.3, 5
# Median of the square of a normal variable.
_MEDIAN_SQUARE = 0.455
# Mean of the residual over the floor below which a channel has less noise than any floor.
_LITTLE = 0.5
# Ordinates of a mean that count in its scatter, at most.
_MOST_COUNTED = 200.0
# In units of the median density of a channel. Channels of hardly any noise would else be judged by
# the errors of the model, and the selection of modes by the rounding of the processor.
LEAST_FLOOR = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class BandData:
    """Mean cross spectra of a band, in units of the median of each channel."""

    frequency: FloatArray  # in Hz, (n,)
    count: FloatArray  # ordinates of single segments in each mean, (n,)
    matrix: ComplexArray  # (n, n_channels, n_channels)
    foreign: ComplexArray | None  # expectation of what no mode causes, as the matrix
    scale: FloatArray  # unit of each channel in (m/s²)/Hz^½, (n_channels,)
    basis: FloatArray  # of the floors, positive, (n_basis, n)

    def of_channels(self, kept: Sequence[int]) -> BandData:
        """Return the data of some of the channels."""
        block = np.ix_(range(len(self.count)), kept, kept)
        foreign = None if self.foreign is None else self.foreign[block]
        scale = self.scale[list(kept)]
        return replace(self, matrix=self.matrix[block], foreign=foreign, scale=scale)


def expectation(
    data: BandData, b: ComplexArray, s: ComplexArray | FloatArray, floor: FloatArray
) -> ComplexArray:
    """Compute E = b S b* + floors + foreign, shape ``(n, n_channels, n_channels)``."""
    e = b @ s @ np.swapaxes(b.conj(), 1, 2)
    k = np.arange(e.shape[1])
    e[:, k, k] += (floor @ data.basis).T
    return np.asarray(e if data.foreign is None else e + data.foreign)


def floor_ratio(data: BandData, g: ComplexArray) -> FloatArray:
    """Return by how much more power there is than floors explain; G is the inverse of E."""
    up, down = (
        (data.count * np.einsum("kaa->ak", x).real) @ data.basis.T for x in (g @ data.matrix @ g, g)
    )
    return np.asarray(up / down)


@dataclass(frozen=True, eq=False)
class JointModel:
    """Modes with correlated forces, and independent floors.

    E = Σ R_ij b_i b_j* + floors, b_i = φ_i (h_i + c) + ρ_i. Shapes φ and correlations R are real
    unless the model is ``out_of_phase``: channels that do not move in phase make φ complex, a force
    that reaches modes with a delay R. Parts in quadrature have priors, and count as no unknowns.
    Modes are refined one after the other by Fisher's scoring with the others fixed, so that the
    cost of a sweep is linear in their number. It selects modes; published estimates come from the
    likelihood of `whittle`.
    """

    data: BandData
    floor: FloatArray  # coefficients of the basis, (n_channels, n_basis)
    f: FloatArray  # in Hz, (n_modes,)
    zeta: FloatArray
    phi: ComplexArray  # root of the PSD of the modal force in each channel, (n_channels, n_modes)
    rho: ComplexArray  # static response beside that of all modes, as phi
    r: ComplexArray  # correlations of the forces, (n_modes, n_modes)
    out_of_phase: bool = False  # whether shapes and correlations have parts in quadrature
    static: float = 0.0  # c: -1 where the base moves and absolute acceleration is measured

    def subset(self, kept: BoolArray) -> JointModel:
        """Return the model of some of its modes."""
        return replace(
            self,
            f=self.f[kept],
            zeta=self.zeta[kept],
            phi=self.phi[:, kept],
            rho=self.rho[:, kept],
            r=self.r[np.ix_(kept, kept)],
        )

    def in_phase(self) -> JointModel:
        """Return the model without the parts of shapes and correlations in quadrature."""
        phi, rho, r = (part.real.astype(np.complex128) for part in (self.phi, self.rho, self.r))
        return replace(self, phi=phi, rho=rho, r=r)

    def without(self, i: int) -> JointModel:
        """Return the model without one mode."""
        return self.subset(np.arange(self.f.size) != i)

    def with_mode(self, f: float, zeta: float, phi: ComplexArray) -> JointModel:
        """Return the model with one mode more, the last one."""
        return replace(
            self,
            f=np.append(self.f, f),
            zeta=np.append(self.zeta, zeta),
            phi=np.column_stack([self.phi, phi]),
            rho=np.column_stack([self.rho, np.zeros_like(phi)]),
            r=block_diag(self.r, np.eye(1)).astype(np.complex128),
        )

    def with_static(self, static: float) -> JointModel:
        """Return the model of the same expectation with another static response of all modes."""
        return replace(self, static=static, rho=self.rho + self.phi * (self.static - static))

    def of_channels(self, kept: Sequence[int]) -> JointModel:
        """Return the model of some of the channels."""
        order = list(kept)
        floor, phi, rho = self.floor[order], self.phi[order], self.rho[order]
        return replace(self, data=self.data.of_channels(kept), floor=floor, phi=phi, rho=rho)

    def on(self, data: BandData) -> JointModel:
        """Return the model of other bins of the same channels, which have units of their own."""
        ratio = (self.data.scale / data.scale)[:, None]
        floor = np.maximum(self.floor * ratio**2, LEAST_FLOOR)
        return replace(self, data=data, floor=floor, phi=self.phi * ratio, rho=self.rho * ratio)

    def with_channels(
        self, data: BandData, within: Callable[[FloatArray], BoolArray] | None = None
    ) -> JointModel:
        """Add the last channels of the data, by regression on what the model's channels show.

        ``within`` selects the frequencies in Hz that are used.
        """
        count = data.count if within is None else data.count * within(data.frequency)
        n, more = len(self.phi), data.scale.size - len(self.phi)
        h = self._response(self.data.frequency)
        # Expected cross spectra of a channel with the others, per unit of its part in each mode.
        unit = h.T[:, :, None] * (self.r @ np.swapaxes(self._b.conj(), 1, 2))
        weighted = count[:, None, None] * (unit @ self._inverse)
        seen = data.matrix[:, n:, :n]
        if data.foreign is not None:
            seen = seen - data.foreign[:, n:, :n]
        normal = np.einsum("kia,kja->ij", weighted, unit.conj())
        right = np.einsum("kia,kca->ic", weighted, seen.conj())
        if not self.out_of_phase:
            normal, right = (np.asarray(one.real, np.complex128) for one in (normal, right))
        phi = np.linalg.solve(normal + 1e-9 * np.diag(np.diag(normal) + 1e-300), right).conj().T
        floor = np.full((more, self.floor.shape[1]), 0.5)
        return replace(
            self,
            data=data,
            floor=np.concatenate([self.floor, floor]),
            phi=np.concatenate([self.phi, phi]),
            rho=np.concatenate([self.rho, np.zeros_like(phi)]),
        )

    def joined(self, parts: Sequence[JointModel], order: Sequence[int]) -> JointModel:
        """Add the channels of other models, whose modes are the first ones of this; in an order.

        Its data have the bins and units of all channels, and no cross spectra: they are expected,
        not fitted.
        """
        every, most = (self, *parts), self.f.size
        phi, rho = (
            np.concatenate([np.pad(x, ((0, 0), (0, most - x.shape[1]))) for x in shapes])
            for shapes in ([one.phi for one in every], [one.rho for one in every])
        )
        floor = np.concatenate([one.floor for one in every])
        scale = np.concatenate([one.data.scale for one in every])[order]
        data = replace(self.data.of_channels([]), scale=scale)
        return replace(self, data=data, floor=floor[order], phi=phi[order], rho=rho[order])

    @property
    def size(self) -> int:
        """Number of unknowns of the modes."""
        m, n = self.f.size, len(self.phi)
        return m * (2 + n) + m * (m - 1) // 2

    def _columns(self, frequency: FloatArray) -> ComplexArray:
        """Return b, shape ``(n, n_channels, n_modes)``."""
        return np.asarray(self.phi * self._response(frequency).T[:, None, :] + self.rho)

    def _response(self, frequency: FloatArray) -> ComplexArray:
        """Return h + c, shape ``(n_modes, n)``."""
        h = response(self.f[:, None], self.zeta[:, None], frequency)
        return np.asarray(h + self.static)

    @cached_property
    def _b(self) -> ComplexArray:
        return self._columns(self.data.frequency)

    @cached_property
    def expected(self) -> ComplexArray:
        """Compute E, shape ``(n, n_channels, n_channels)``."""
        return expectation(self.data, self._b, self.r, self.floor)

    def modal(self, kept: BoolArray, frequency: FloatArray) -> ComplexArray:
        """Return columns of the part of some modes in the expectation, in physical units."""
        part = self.subset(kept)
        b = part._columns(frequency) * self.data.scale[:, None]
        return np.asarray(b @ np.linalg.cholesky(part.r))

    def floor_at(self, frequency: float) -> FloatArray:
        """Return the floor of each channel at a frequency in Hz."""
        place = int(np.abs(self.data.frequency - frequency).argmin())
        return np.asarray(self.floor @ self.data.basis[:, place])

    def dispersions(self) -> FloatArray:
        """Return the dispersion of the residual of each channel given the others; 1 for noise.

        A channel with less noise than the least floor scatters less than its floor implies.
        """
        g = self._inverse
        precision = np.einsum("kaa->ka", g).real
        ratio = np.einsum("kaa->ka", g @ self.data.matrix @ g).real / precision
        # Of more ordinates the errors of the bins, of 1 %, would count.
        squares = np.minimum(self.data.count, _MOST_COUNTED)[:, None] * (ratio - 1) ** 2
        scatter = np.median(squares, axis=0) / _MEDIAN_SQUARE
        level = self.data.count @ ratio / self.data.count.sum()
        return np.asarray(np.where(level < _LITTLE, np.minimum(scatter, 1.0), scatter))

    @cached_property
    def misfit(self) -> float:
        """Negative log posterior; infinite where E is singular."""
        try:
            root = np.linalg.cholesky(self.expected)
        except np.linalg.LinAlgError:
            return np.inf
        log_det = 2 * np.log(np.diagonal(root, axis1=1, axis2=2).real).sum(axis=1)
        # tr E⁻¹ W of Hermitian matrices
        trace = np.sum(self._inverse.conj() * self.data.matrix, axis=(1, 2)).real
        prior = np.sum(np.abs(self.rho) ** 2 * self._weak[:, None])
        prior += np.sum(np.abs(np.tril(self.r, -1)) ** 2)
        off = np.sum(self.phi.imag**2, axis=0) * self._quadrature
        prior += np.sum(off)
        return float(self.data.count @ (log_det + trace) + 0.5 * prior)

    @cached_property
    def _inverse(self) -> ComplexArray:
        return np.asarray(np.linalg.inv(self.expected), dtype=np.complex128)

    @property
    def _weak(self) -> FloatArray:
        """Precision of the prior of the static responses."""
        return np.asarray(1 / np.mean(self.floor, axis=1))

    def quadrature_sigmas(self) -> float:
        """Return by how much parts in quadrature would gain, in standard deviations of chance.

        Of each mode alone by one step of Fisher's scoring, twice whose gain is χ².
        """
        n, gain, freedom = len(self.phi), 0.0, 0
        for i in range(self.f.size):
            h = response(self.f[i], self.zeta[i], self.data.frequency) + self.static
            pairs = [(self._b @ self.r[:, i], 1j * h[:, None, None] * np.eye(n))]
            if i:  # each correlation once
                pairs.append((self._b[:, :, i], -1j * self._b[:, :, :i]))
            for v, u in pairs:
                gradient, fisher = self._score(v, u)
                gain -= float(gradient @ _solve(gradient, fisher, np.zeros(gradient.size)))
                freedom += gradient.size
        return (gain - freedom) / np.sqrt(2 * freedom) if freedom else 0.0

    @property
    def _quadrature(self) -> FloatArray:
        """Precision of the prior of the part of each shape in quadrature, ``(n_modes,)``."""
        power = np.sum(np.abs(self.phi) ** 2, axis=0)
        return np.asarray(1 / (constants.PRIOR_QUADRATURE[1] ** 2 * power + 1e-300))

    def nearest(self, f: float) -> list[int]:
        """Return the three modes nearest to a frequency in units of their bandwidths."""
        return [int(i) for i in np.argsort(np.abs(np.log(self.f / f)) / self.zeta)[:3]]

    def refined(self, sweeps: int, modes: Sequence[int] | None = None) -> JointModel:
        """Improve the modes one after the other, as long as they gain."""
        model = self
        active = range(self.f.size) if modes is None else modes
        for _ in range(sweeps):
            model, gaining = model._with_better_floor(), []
            for i in active:
                before, model = model, model._with_better_mode(i)
                if before.misfit - model.misfit > _LEAST_GAIN:
                    gaining.append(i)
            active = gaining
            if not active:
                break
        return model

    def _with_better_floor(self) -> JointModel:
        model = self
        for _ in range(2):
            ratio = floor_ratio(self.data, model._inverse).clip(1e-2, 1e2) ** 0.9
            moved = replace(model, floor=np.maximum(model.floor * ratio, LEAST_FLOOR))
            if not moved.misfit < model.misfit:
                break
            model = moved
        return model

    def _with_better_mode(self, i: int) -> JointModel:
        """Improve pole, shape and static response of a mode, then its share of the forces."""
        n, m = self.phi.shape
        h, *slopes = receptance(self.f[i], self.zeta[i], self.data.frequency)[:3]
        eye = np.eye(n)
        u = np.concatenate(
            [
                np.stack(slopes, axis=1)[:, None, :] * self.phi[None, :, i, None],
                (h + self.static)[:, None, None] * eye,
                np.ones((h.size, 1, 1)) * eye,
            ],
            axis=2,
        )
        prior = np.concatenate([np.zeros(2 + n), self._weak])
        pull = np.concatenate([np.zeros(2 + n), self._weak * self.rho[:, i].real])
        if self.out_of_phase:
            u = np.concatenate([u, 1j * u[:, :, 2 : 2 + n]], axis=2)
            prior = np.append(prior, np.full(n, self._quadrature[i]))
            pull = np.append(pull, self._quadrature[i] * self.phi[:, i].imag)
        gradient, fisher = self._score(self._b @ self.r[:, i], u)
        step = _solve(gradient + pull, fisher, prior)
        # At most a bandwidth, and a factor of two of the damping, in one step.
        most = np.array([1.5 * self.zeta[i], 0.7])
        step *= min(1.0, *(most / np.abs(step[:2]).clip(1e-12)))
        own = np.arange(m) == i

        def moved(step: FloatArray) -> JointModel:
            f, zeta = self.f * np.exp(step[0] * own), self.zeta * np.exp(step[1] * own)
            phi, rho, *off = (np.outer(part, own) for part in step[2:].reshape(-1, n))
            phi = self.phi + phi + sum(1j * part for part in off)
            return replace(self, f=f, zeta=zeta, phi=phi, rho=self.rho + rho)

        better = self._first_better(moved, step)
        return better._with_better_forces(i) if m > 1 else better

    def _with_better_forces(self, i: int) -> JointModel:
        """Improve the correlations of the force of a mode."""
        others = np.arange(self.f.size) != i
        now = self.r[i, others]
        unit = np.array([1.0, 1j] if self.out_of_phase else [1.0])
        # E changes with r_ij as b_i b_j* = v u*: the unit of u is conjugated.
        u = np.concatenate([one.conj() * self._b[:, :, others] for one in unit], axis=2)
        gradient, fisher = self._score(self._b[:, :, i], u)
        parts = np.concatenate([now.real, now.imag] if self.out_of_phase else [now.real])

        def moved(step: FloatArray) -> JointModel:
            r = self.r.copy()
            r[i, others] = unit @ (parts + step).reshape(unit.size, -1)
            r[i, others] *= np.minimum(1.0, 0.999 / np.abs(r[i, others]).clip(1e-12))
            r[others, i] = r[i, others].conj()
            return replace(self, r=r) if np.linalg.eigvalsh(r)[0] > 1e-4 else self

        return self._first_better(moved, _solve(gradient + parts, fisher, np.ones(parts.size)))

    def _first_better(
        self, moved: Callable[[FloatArray], JointModel], step: FloatArray
    ) -> JointModel:
        """Shorten a step until the misfit decreases; return the model itself if it does not."""
        for _ in range(_HALVINGS):
            model = moved(step)
            if model.misfit < self.misfit:
                return model
            step = step * 0.3
        return self

    def _score(self, v: ComplexArray, u: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Gradient and Fisher information of unknowns by which E changes as u v* + v u*."""
        g, count = self._inverse, self.data.count
        gv = (g @ v[:, :, None])[:, :, 0]
        size = (gv * v.conj()).sum(axis=1).real
        gu = g @ u
        along = np.einsum("kc,kca->ka", gv.conj(), u)
        excess = gv - (g @ (self.data.matrix @ gv[:, :, None]))[:, :, 0]
        gradient = 2 * count @ np.einsum("kc,kca->ka", excess.conj(), u).real
        across = (u * (count * size)[:, None, None]).reshape(-1, u.shape[2])
        fisher = across.conj().T @ gu.reshape(-1, u.shape[2])
        fisher = fisher + (along * count[:, None]).T @ along
        return gradient, np.asarray(2 * fisher.real)


def _solve(gradient: FloatArray, fisher: FloatArray, prior: FloatArray) -> FloatArray:
    """Return a step of Fisher's scoring."""
    information = fisher + np.diag(prior + 1e-6 * np.diag(fisher) + 1e-12)
    return np.asarray(-np.linalg.solve(information, gradient), dtype=np.float64)
