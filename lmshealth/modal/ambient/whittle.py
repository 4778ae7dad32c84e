"""Whittle likelihood of the modes of a cluster in all channels, with exact derivatives.

The ordinates of all channels at one frequency are complex normal with the matrix

    E(f) = Φ D(f) Φᵀ,   D_ij = S_ij h_i h_j*,   S = L Lᵀ,   Φ = [shapes, 1],

over modes and noise floors. Means W of n ordinates suffice where E is constant between them:

    -ln p = Σ n (ln det E + tr E⁻¹ W).

Unknowns, in this order: ln f (m), ln ζ (m), e_c, d_c and b_c of each floor, L row by row up to its
diagonal (which is one for the floors), the shapes but for the reference channel of each mode, and
the heights of bumps of the log spectrum of the modal forces, of which there are none at first.
README.md of this folder derives the model; `marginalise` integrates the nuisance parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import OptimizeResult, minimize
from scipy.special import logsumexp, softmax

from lmshealth._arrays import ComplexArray, FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.expected_periodogram import MeanOrdinates


@dataclass(frozen=True, slots=True)
class Layout:
    """Places of the unknowns; the floors of the channels are the components after the modes."""

    n_modes: int
    n_channels: int
    force: tuple[tuple[int, int], ...]  # row and column of each unknown of L
    shape: tuple[tuple[int, int], ...]  # channel and mode of each unknown of the shapes
    has_static: bool = False  # third unknown of each mode: its static response
    n_bumps: int = 0  # of the log spectrum of the modal forces; their heights are the last unknowns

    @property
    def _of_modes(self) -> tuple[int, ...]:
        """Derivatives of h by the unknowns of a mode."""
        return (1, 2, 3) if self.has_static else (1, 2)

    @property
    def n_components(self) -> int:
        """Number of modes and floors."""
        return self.n_modes + self.n_channels

    @property
    def n_poles(self) -> int:
        """Number of the unknowns of h, which come first: two per mode, three per floor."""
        return len(self._of_modes) * self.n_modes + 3 * self.n_channels

    @property
    def pole(self) -> list[tuple[int, int]]:
        """Component of each unknown of h, and the index of its derivative of h."""
        modes = [(i, q) for q in self._of_modes for i in range(self.n_modes)]
        floors = [(i, q) for i in range(self.n_modes, self.n_components) for q in (1, 2, 3)]
        return modes + floors

    @property
    def forces(self) -> slice:
        """Unknowns of L."""
        return slice(self.n_poles, self.n_poles + len(self.force))

    @property
    def shared(self) -> list[int]:
        """Unknowns of L that make floors coherent with modes."""
        m, first = self.n_modes, self.forces.start
        return [first + a for a, (i, j) in enumerate(self.force) if i >= m > j]

    @property
    def common(self) -> list[int]:
        """Unknowns of L that make floors coherent with each other."""
        m, first = self.n_modes, self.forces.start
        return [first + a for a, (_, j) in enumerate(self.force) if j >= m]

    @property
    def bends(self) -> list[int]:
        """Unknowns b of the floors."""
        return list(range(self.n_poles - 3 * self.n_channels + 2, self.n_poles, 3))

    @property
    def shapes(self) -> slice:
        """Unknowns of the shapes."""
        return slice(self.forces.stop, self.forces.stop + len(self.shape))

    @property
    def bumps(self) -> slice:
        """Heights of the bumps."""
        return slice(self.shapes.stop, self.size)

    @property
    def coloured(self) -> FloatArray:
        """Powers of the gain of forces in the change of E by each unknown but the heights."""
        m = self.n_modes
        rows = [i for i, *_ in (*self.pole, *self.force)]
        return np.array([*((i < m) / 2 for i in rows), *(0.5 for _ in self.shape)])

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.n_poles + len(self.force) + len(self.shape) + self.n_bumps


def lay_out(reference: Sequence[int], n_channels: int, *, has_static: bool = False) -> Layout:
    """Return the places of the unknowns; ``reference`` is the channel in which a shape is one."""
    m = len(reference)
    # A single channel only shows which forces neighbours share.
    modes = [(i, j) for i in range(m) for j in range(i + 1) if n_channels > 1 or i - j < 2]
    floors = [(m + c, j) for c in range(n_channels) for j in range(m + c)]
    shape = [(c, i) for i in range(m) for c in range(n_channels) if c != reference[i]]
    return Layout(m, n_channels, (*modes, *floors), tuple(shape), has_static)


# Index of the second derivatives of h by the indices of the first ones.
SECOND = np.array([[4, 5, 6], [5, 7, 8], [6, 8, 9]])


def response(f: FloatArray, zeta: FloatArray, frequency: FloatArray) -> ComplexArray:
    """Return the acceleration response h of modes to a white force, frequency last."""
    beta = f / frequency
    return np.asarray(1 / (1 - beta**2 - 2j * zeta * beta))


def floors(p: FloatArray, u: FloatArray) -> ComplexArray:
    """Return the response exp((e + d u + b u²) / 2) of floors with its derivatives.

    ``p`` holds e, d and b of each floor, ``(n_floors, 3)``; u runs from -1 to 1 over the band. The
    layout is that of `receptance`.
    """
    basis = np.stack([np.ones_like(u), u, u * u]) / 2
    h = np.exp(p @ basis)
    pairs = [basis[a] * basis[b] for a in range(3) for b in range(a, 3)]
    return np.stack([h, *(h * slope for slope in [*basis, *pairs])]).astype(complex)


def receptance(f: FloatArray, zeta: FloatArray, frequency: FloatArray) -> ComplexArray:
    """Return the acceleration response h of modes and its derivatives by x = ln f and z = ln ζ.

    The array has shape ``(10, …, n)``: h, its first derivatives by three unknowns and its second
    ones (11, 12, 13, 22, 23, 33); modes have no third unknown. With d = 1/h, h_a = -d_a h² and
    h_ab = (2 d_a d_b h - d_ab) h².
    """
    beta = f / frequency
    damping = -2j * zeta * beta
    h = 1 / (1 - beta**2 + damping)
    d_x, d_xx = damping - 2 * beta**2, damping - 4 * beta**2
    square = h * h
    none = np.zeros_like(h)
    by_x = [(2 * d_x * d_x * h - d_xx) * square, (2 * d_x * damping * h - damping) * square]
    by_z = (2 * damping * damping * h - damping) * square
    return np.stack([h, -d_x * square, -damping * square, none, *by_x, none, by_z, none, none])


# Newton decrement, a square in standard deviations, below which the search ends; along a valley as
# flat as that of two modes at one frequency, after so many steps, a larger one.
_ARRIVED, _NEARLY, _MANY_STEPS = 1e-4, 0.1, 25
# Slopes of E that are computed at a time: more channels would not fit into the processor's cache.
_CACHED = 1 << 18


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """Negative log posterior of the unknowns of a cluster."""

    blocks: tuple[MeanOrdinates, ...]  # one per length of segments
    layout: Layout
    start: FloatArray  # and centre of the priors, (n_unknowns,)
    scale: FloatArray  # unit of the rows of L, one for floors, (n_components,)
    centre: float  # geometric, of the band in Hz
    spread: float  # half width of the band in ln f
    bumps: FloatArray = field(default_factory=lambda: np.empty((2, 0)))  # centres, widths in Hz
    bump_std: float = 1.0  # standard deviation of the prior of their heights

    @property
    def prior_std(self) -> FloatArray:
        """Standard deviations of the weak priors, shape ``(n_unknowns,)``."""
        lay = self.layout
        forces = np.full(len(lay.force), constants.PRIOR_FORCE)
        forces[np.array(lay.shared, dtype=int) - lay.forces.start] = constants.WIDTHS_SHARED[-1]
        forces[np.array(lay.common, dtype=int) - lay.forces.start] = constants.WIDTHS_COMMON[-1]
        return np.concatenate(
            [
                np.repeat([constants.PRIOR_LN_F, constants.PRIOR_LN_ZETA], lay.n_modes),
                np.full(lay.has_static * lay.n_modes, constants.PRIOR_STATIC),
                np.tile(constants.PRIOR_FLOOR, lay.n_channels),
                forces,
                np.full(len(lay.shape), constants.PRIOR_SHAPE),
                np.full(lay.n_bumps, self.bump_std),
            ]
        )

    def coloured(self, bumps: FloatArray, std: float) -> Likelihood:
        """Return the likelihood with bumps, ``(2, n_bumps)``, and the prior std of heights."""
        n = bumps.shape[1]
        layout, start = replace(self.layout, n_bumps=n), np.append(self.start, np.zeros(n))
        return replace(self, layout=layout, start=start, bumps=bumps, bump_std=std)

    def value(self, p: FloatArray, points: list[_Point] | None = None) -> float:
        """Negative log posterior up to a constant; ``points`` are the models at p."""
        total = 0.5 * float(np.sum(((p - self.start) / self.prior_std) ** 2))
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                total += sum(point.misfit() for point in points or self._at(p))
            except np.linalg.LinAlgError:
                return np.inf
        return total if np.isfinite(total) else np.inf

    def derivatives(
        self, p: FloatArray, points: list[_Point] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Exact gradient and Hessian of `value`, shapes ``(n_unknowns,)`` and square."""
        gradient = (p - self.start) / self.prior_std**2
        hessian = np.diag(1 / self.prior_std**2)
        for point in points or self._at(p):
            first, second = point.derivatives()
            gradient = gradient + first
            hessian = hessian + second
        return gradient, hessian

    def data_value(self, p: FloatArray) -> float:
        """Negative log likelihood without the priors."""
        return sum(point.misfit() for point in self._at(p))

    def expected(self, p: FloatArray) -> list[ComplexArray]:
        """Compute E of each block, shape ``(n, n_channels, n_channels)``."""
        return [point.expected for point in self._at(p)]

    def _at(self, p: FloatArray) -> list[_Point]:
        with np.errstate(over="ignore", invalid="ignore"):
            return [_Point(self, p, block) for block in self.blocks]

    def shapes(self, p: FloatArray) -> FloatArray:
        """Shapes of the modes, shape ``(n_channels, n_modes)``."""
        phi = np.ones((self.layout.n_channels, self.layout.n_modes))
        if self.layout.shape:
            phi[tuple(_columns(self.layout.shape))] = p[self.layout.shapes]
        return phi

    def strength(self, p: FloatArray) -> FloatArray:
        """PSD of each modal force in each channel, shape ``(n_channels, n_modes)``."""
        return self._at_modes(p).strength

    def signal_to_noise(self, p: FloatArray) -> FloatArray:
        """Modal signal-to-noise ratios S φ² / (4 ζ² N), shape ``(n_channels, n_modes)``."""
        m, point = self.layout.n_modes, self._at_modes(p)
        return point.strength / (4 * np.exp(2 * p[m : 2 * m]) * point.floor)

    def _at_modes(self, p: FloatArray) -> _Point:
        m = self.layout.n_modes
        at = MeanOrdinates(np.exp(p[:m]), np.empty((m, 0, 0), dtype=complex), np.ones(m), None)
        return _Point(self, p, at)

    def minimise(self, start: FloatArray, arrived: float = _ARRIVED) -> FloatArray:
        """Find the posterior mode by Newton's method in a trust region, from ``(n_unknowns,)``.

        The search ends below the decrement ``arrived``.
        """

        @lru_cache(maxsize=2)  # the point of a step, and the one before, to which it may return
        def at(raw: bytes) -> tuple[float, FloatArray, FloatArray]:
            p = np.frombuffer(raw)
            points = self._at(p)
            with suppress(np.linalg.LinAlgError), np.errstate(over="ignore", invalid="ignore"):
                slope, curvature = self.derivatives(p, points)
                if np.isfinite(slope).all() and np.isfinite(curvature).all():
                    return self.value(p, points), slope, curvature
            # Overflow far away: the optimiser takes derivatives before it sees that the value is
            # infinite and refuses the step.
            return np.inf, np.full(p.size, np.nan), np.eye(p.size)

        def value(p: FloatArray) -> tuple[float, FloatArray]:
            return at(p.tobytes())[:2]

        def hessian(p: FloatArray) -> FloatArray:
            return at(p.tobytes())[2]

        steps = iter(range(1, 1000))

        def check(intermediate_result: OptimizeResult) -> None:
            near = arrived if next(steps) < _MANY_STEPS else _NEARLY
            _, slope, curvature = at(intermediate_result.x.tobytes())
            with suppress(np.linalg.LinAlgError):  # no minimum near
                if float(slope @ cho_solve(cho_factor(curvature), slope)) < near:
                    raise StopIteration

        found = minimize(
            value,
            start,
            jac=True,
            hess=hessian,
            method="trust-exact",
            callback=check,
            options={"gtol": 1e-9, "maxiter": 100, "initial_trust_radius": 0.3},
        )
        return np.asarray(found.x)


class _Point:
    """Model of a block at one point; frequency is the last axis unless stated otherwise."""

    def __init__(self, likelihood: Likelihood, p: FloatArray, block: MeanOrdinates) -> None:
        self._block, self._scale = block, likelihood.scale
        self._layout = lay = likelihood.layout
        m, n = lay.n_modes, lay.n_components
        self._root = np.zeros((n, n))
        self._root[range(m, n), range(m, n)] = 1.0
        for value, (i, j) in zip(p[lay.forces], lay.force, strict=True):
            self._root[i, j] = self._scale[i] * value
        self._phi = np.concatenate([likelihood.shapes(p), np.eye(lay.n_channels)], axis=1)
        self._s = np.asarray(self._root @ self._root.T)
        f, zeta = np.exp(p[: 2 * m].reshape(2, m, 1))
        modes = receptance(f, zeta, block.grid)
        if lay.has_static:
            modes[0] += p[2 * m : 3 * m, None]
            modes[3] = 1.0
        tilts = p[lay.n_poles - 3 * lay.n_channels : lay.n_poles].reshape(-1, 3)
        u = np.log(block.grid / likelihood.centre) / likelihood.spread
        # Responses h of all components and their derivatives, (10, components, grid).
        self._h = np.concatenate([modes, floors(tilts, u)], axis=1)
        # The forces change little over a resolution: the gain follows the kernel.
        place, width = likelihood.bumps[..., None]
        self._bump = np.exp(-0.5 * ((block.frequency - place) / width) ** 2)
        gain = np.ones((n, block.frequency.size))
        gain[:m] = np.exp(0.5 * p[lay.bumps] @ self._bump)
        self._gain = gain[:, None] * gain

    @property
    def strength(self) -> FloatArray:
        """PSD of each modal force in each channel, shape ``(channels, modes)``."""
        m = self._layout.n_modes
        return np.asarray(self._phi[:, :m] ** 2 * np.diag(self._s)[:m])

    @property
    def floor(self) -> FloatArray:
        """PSD of the part of each floor incoherent with modes, shape ``(channels, grid)``."""
        m = self._layout.n_modes
        own = np.sum(self._root[m:, m:] ** 2, axis=1)
        return np.asarray(np.abs(self._h[0, m:]) ** 2 * own[:, None])

    @cached_property
    def _modal(self) -> ComplexArray:
        """D, shape ``(components, components, n)``."""
        h = self._h[0]
        modal = self._block.smear(self._s[..., None] * h[:, None] * h[None].conj())
        return modal * self._gain if self._layout.n_bumps else modal

    @cached_property
    def expected(self) -> ComplexArray:
        """E, shape ``(n, channels, channels)``."""
        expected = np.moveaxis(_congruent(self._phi.T, self._modal), -1, 0).copy()
        return expected if self._block.foreign is None else expected + self._block.foreign

    def misfit(self) -> float:
        """Σ n (ln det E + tr E⁻¹ W)."""
        root = np.linalg.cholesky(self.expected)
        white = np.linalg.solve(self.expected, self._block.matrix)
        log_det = 2 * np.log(np.diagonal(root, axis1=-2, axis2=-1).real).sum(axis=-1)
        return float(self._block.count @ (log_det + np.trace(white, axis1=-2, axis2=-1).real))

    def derivatives(self) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian of the misfit (README.md)."""
        count, eye = self._block.count, np.eye(self._layout.n_channels)
        whiten = np.linalg.inv(np.linalg.cholesky(self.expected))
        adjoint = whiten.conj().swapaxes(1, 2)
        excess = eye - whiten @ self._block.matrix @ adjoint
        row, w = self._slopes()
        # The columns of Φ for the floors are the unit vectors of the channels.
        basis = _frequency_last(whiten @ self._phi)
        g = _frequency_last(adjoint @ (count[:, None, None] * excess) @ whiten)
        b = _congruent(self._phi, g)  # Φᵀ G Φ, (components, components, n)
        size, n = self._layout.bumps.start, count.size
        excess_last = _frequency_last(excess) * count
        weight = _frequency_last(eye - 2 * excess) * count
        gradient, hessian = np.zeros(size), np.zeros((size, size))
        along, own, heights = np.zeros((size, n)), np.zeros(n), np.zeros(n)
        step = max(1, _CACHED // (eye.size * row.size))
        for part in (slice(first, first + step) for first in range(0, n, step)):
            near = basis[..., part]
            half = _combined(near, w[..., part].conj().swapaxes(0, 1)).conj()
            half = near[:, row][:, None] * half[None]
            slopes = half + half.conj().swapaxes(0, 1)  # (channels, channels, unknowns, part)
            slopes, by_gain = slopes[:, :, :size], slopes[:, :, size:].sum(axis=2)
            turned = _combined(weight[..., part], slopes)
            gradient += _inner(slopes, excess_last[:, :, None, part])[:, 0]
            hessian += _inner(slopes, turned)
            if self._layout.n_bumps:
                # Heights change E as the gain of the forces does, times their bump.
                across = _combined(weight[..., part], by_gain[:, :, None])
                along[:, part] = np.sum((by_gain[:, :, None] * turned.conj()).real, axis=(0, 1))
                own[part] = np.sum((by_gain * across[:, :, 0].conj()).real, axis=(0, 1))
                heights[part] = np.sum((by_gain * excess_last[..., part].conj()).real, axis=(0, 1))
        hessian += self._curvature(w[:size], g, b)
        if not self._layout.n_bumps:
            return gradient, hessian
        along += self._with_gain(row[:size], w[:size], b)
        own += self._gains(b)
        mixed = along @ self._bump.T
        return np.append(gradient, heights @ self._bump.T), np.block(
            [[hessian, mixed], [mixed.T, (self._bump * own) @ self._bump.T]]
        )

    def _slopes(self) -> tuple[NDArray[np.intp], ComplexArray]:
        """Rows of the slopes of E in the basis of Φ's columns and the channels.

        Returns the index of b in the basis and the row w of each unknown, E_a = b (Φ w)ᵀ + adjoint,
        shapes ``(unknowns,)`` and ``(unknowns, components, n)``.
        """
        lay, h, s = self._layout, self._h, self._s
        pole, slope = _columns(lay.pole)
        driven, _ = _columns(lay.force)
        by_pole = s[pole, :, None] * h[slope, pole][:, None] * h[0].conj()
        pairs = self._block.smear(h[0][:, None] * h[0].conj())
        w = [self._block.smear(by_pole), self._change[..., None] * pairs[driven]]
        row = [pole, driven]
        if lay.n_bumps:
            w = [part * self._gain[i] for part, i in zip(w, row, strict=True)]
        if lay.shape:
            channel, mode = _columns(lay.shape)
            row.append(lay.n_modes + channel)
            w.append(self._modal[mode])
        if lay.n_bumps:
            row.append(np.arange(lay.n_modes))
            w.append(self._modal[: lay.n_modes] / 2)
        return np.concatenate(row), np.concatenate(w)

    @cached_property
    def _change(self) -> FloatArray:
        """Change of the row and column of S that belong to each force, ``(forces, components)``."""
        driven, force = _columns(self._layout.force)
        return np.asarray(self._scale[driven, None] * self._root.T[force])

    def _curvature(self, w: ComplexArray, g: ComplexArray, b: ComplexArray) -> FloatArray:
        """Σ tr G E_ab over all pairs of unknowns but the heights, the counts in G; b = Φᵀ G Φ."""
        lay = self._layout
        curvature = np.zeros((lay.bumps.start, lay.bumps.start))
        pull = np.tensordot(self._phi.T, g, axes=(1, 0))  # Φᵀ G, (components, channels, n)
        if lay.n_bumps:
            b = b * self._gain
        if self._block.kernel is not None:
            b = self._block.kernel.spread(b)
        turned = b.swapaxes(0, 1)
        self._by_poles(curvature, turned)
        self._by_forces(curvature, turned)
        if lay.shape:
            self._by_shapes(curvature, w, g, pull)
        return curvature

    def _by_poles(self, curvature: FloatArray, turned: ComplexArray) -> None:
        """Add the part of two unknowns of h: Q = Σ_ij S_ij B_ji h_i h_j*."""
        h, n = self._h, self._layout.n_poles
        component, slope = _columns(self._layout.pole)
        weight = self._s[..., None] * turned
        first = h[slope, component]
        pairs = weight[component[:, None], component]
        term = np.einsum("abk,ak,bk->ab", pairs, first, first.conj())
        pull = np.sum(weight * h[0].conj()[None], axis=1)
        # Of the second derivatives of h those of one component are not zero.
        one, other = np.nonzero(component[:, None] == component)
        second = h[SECOND[slope[one] - 1, slope[other] - 1], component[one]]
        term[one, other] += np.sum(pull[component[one]] * second, axis=1)
        curvature[:n, :n] += 2 * term.real

    def _by_forces(self, curvature: FloatArray, turned: ComplexArray) -> None:
        """Add the part of two forces, and of a force and an unknown of h."""
        lay, h = self._layout, self._h
        driven, force = _columns(lay.force)
        overlap = np.einsum("ijk,ik,jk->ij", turned, h[0], h[0].conj()).real
        overlap *= np.outer(self._scale, self._scale)
        same = force[:, None] == force
        curvature[lay.forces, lay.forces] += 2 * same * overlap[driven[:, None], driven]
        component, slope = _columns(lay.pole)
        mixed = np.einsum("ajk,ak,jk->aj", turned[component], h[slope, component], h[0].conj()).real
        # S changes in row and column.
        term = (driven[:, None] == component) * (self._change @ mixed.T)
        term += self._change[:, component] * mixed[:, driven].T
        curvature[lay.forces, : lay.n_poles] += 2 * term
        curvature[: lay.n_poles, lay.forces] += 2 * term.T

    def _by_shapes(
        self, curvature: FloatArray, w: ComplexArray, g: ComplexArray, pull: ComplexArray
    ) -> None:
        """Add the part of two shapes, and of a shape and an unknown of D."""
        lay = self._layout
        channel, mode = _columns(lay.shape)
        own = np.tensordot(self._modal, g, axes=(2, 2))  # (i, j, d, c)
        own = own[mode[:, None], mode, channel, channel[:, None]]
        curvature[lay.shapes, lay.shapes] += 2 * own.real
        inner = w[: lay.shapes.start]
        along = np.einsum("ajk,jck->ac", inner, pull)
        row = np.array([i for i, *_ in (*lay.pole, *lay.force)], dtype=int)
        across = inner.conj() @ pull[row].swapaxes(1, 2)  # (a, i, c)
        term = across[:, mode, channel] + np.where(row[:, None] == mode, along[:, channel], 0)
        curvature[: lay.shapes.start, lay.shapes] += 2 * term.real
        curvature[lay.shapes, : lay.shapes.start] += 2 * term.real.T

    def _with_gain(self, row: NDArray[np.intp], w: ComplexArray, b: ComplexArray) -> FloatArray:
        """Compute tr G E_ab of the unknowns and the log gain of the forces, ``(unknowns, n)``."""
        power = self._power[:, None] + self._layout.coloured[:, None, None]
        return np.asarray(2 * np.sum((w * b.swapaxes(0, 1)[row]).real * power, axis=1))

    def _gains(self, b: ComplexArray) -> FloatArray:
        """Compute tr G E_aa of the log gain of the forces, ``(n,)``."""
        power = (self._power[:, None] + self._power) ** 2
        return np.asarray(np.einsum("ijk,jik,ij->k", self._modal, b, power).real)

    @property
    def _power(self) -> FloatArray:
        """Power of the gain of the forces in the response of each component."""
        return (np.arange(self._layout.n_components) < self._layout.n_modes) / 2


def _columns(pairs: Sequence[tuple[int, int]]) -> NDArray[np.intp]:
    return np.array(pairs, dtype=np.intp).reshape(-1, 2).T


def _congruent(basis: FloatArray, matrix: ComplexArray) -> ComplexArray:
    """Bᵀ M B at each frequency, which is the last axis."""
    half = np.tensordot(basis.T, matrix, axes=(1, 0))
    return np.asarray(np.tensordot(half, basis, axes=(1, 0)).swapaxes(1, 2))


def _combined(matrix: ComplexArray, vectors: ComplexArray) -> ComplexArray:
    """Σ_d M_cd v_d at each frequency, the last axis; axes between are carried along."""
    # One product per pair: their axes are too short for a loop inside.
    return np.array([sum(m * v for m, v in zip(row, vectors, strict=True)) for row in matrix])


def _inner(a: ComplexArray, b: ComplexArray) -> FloatArray:
    """Σ tr A_i B_j of Hermitian matrices ``(channels, channels, i or j, n)``, shape ``(i, j)``."""
    pairs = zip(a.reshape(-1, *a.shape[2:]), b.reshape(-1, *b.shape[2:]), strict=True)
    parts = (np.ascontiguousarray(x).view(float) @ y.view(float).T for x, y in pairs)
    return np.asarray(sum(parts))


def _frequency_last(matrices: ComplexArray | FloatArray) -> ComplexArray:
    return np.ascontiguousarray(np.moveaxis(matrices, 0, -1), dtype=np.complex128)


class Marginal(NamedTuple):
    """Posterior of ``[ln f, ln ζ]``, all other unknowns marginalised."""

    mean: FloatArray
    cov: FloatArray
    decrement: float  # Newton decrement g H⁻¹ g; infinite where there is no maximum
    log_evidence: float = -np.inf  # up to a constant of the data


def marginalise(likelihood: Likelihood, p: FloatArray) -> Marginal:
    """Return mean and covariance of ``[ln f, ln ζ]`` by Laplace's approximation.

    The posterior is averaged over the widths of the priors of coherence and bends of floors,
    weighted by their evidence (README.md). ``p`` is near the posterior mode.
    """
    n, layout = 2 * likelihood.layout.n_modes, likelihood.layout
    points = likelihood._at(p)
    gradient, hessian = likelihood.derivatives(p, points)
    try:
        root = np.linalg.cholesky(hessian)  # exists at a maximum only
    except np.linalg.LinAlgError:
        return Marginal(p[:n], np.full((n, n), np.nan), np.inf)
    cov = np.linalg.inv(hessian)
    # The search ends at a small gradient: one Newton step to the centre of the normal.
    step = cov @ gradient
    decrement = float(gradient @ step)
    evidence = 0.5 * decrement - likelihood.value(p, points) - np.log(np.diag(root)).sum()
    p = p - step
    groups = (layout.shared, layout.common, layout.bends)
    index = np.array([unknown for group in groups for unknown in group], dtype=int)
    precision = np.linalg.inv(cov[np.ix_(index, index)])
    follow = cov[:n, index] @ precision  # regression of ln f and ln ζ on these unknowns
    gain, mean, narrowed = _narrow(p[index], precision, [len(group) for group in groups])
    weight = softmax(gain)
    moved = (mean - p[index]) @ follow.T
    estimate = p[:n] + weight @ moved
    apart = p[:n] + moved - estimate
    less = cov[np.ix_(index, index)] - np.tensordot(weight, narrowed, axes=1)
    cov = cov[:n, :n] - follow @ less @ follow.T + (weight[:, None] * apart).T @ apart
    evidence += logsumexp(gain) - layout.n_bumps * np.log(likelihood.bump_std)
    return Marginal(estimate, np.asarray(cov, dtype=np.float64), decrement, float(evidence))


def _narrow(
    x: FloatArray, precision: FloatArray, sizes: list[int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Evaluate narrower priors of groups of unknowns, whose posterior is normal under the widest.

    Returns the log evidence of each choice over the widest, shape ``(n_choices,)``, and means and
    covariances of the unknowns, ``(n_choices, n)`` and ``(n_choices, n, n)``.
    """
    choices = (constants.WIDTHS_SHARED, constants.WIDTHS_COMMON, constants.WIDTHS_BEND)
    widths = np.array(list(product(*choices)))
    widest = np.array([choice[-1] for choice in choices])
    # Precision of the narrower prior less that of the prior in ``precision``.
    extra = np.repeat(widths**-2 - widest**-2, sizes, axis=1)
    narrower = precision + extra[:, :, None] * np.eye(x.size)
    cov = np.asarray(np.linalg.inv(narrower), dtype=np.float64)
    mean = cov @ (precision @ x)
    shift = mean - x
    cost = np.einsum("ki,ij,kj->k", shift, precision, shift) + np.sum(extra * mean**2, axis=1)
    log_det = np.linalg.slogdet(narrower)[1]
    gain = -0.5 * (cost + log_det) - np.log(widths) @ sizes
    return np.asarray(gain - gain[-1]), mean, cov
