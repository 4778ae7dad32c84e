"""Whittle likelihood of the modes of a cluster in all channels, with exact derivatives.

The ordinates of all channels at one frequency are complex normal with the matrix

    E(f) = Φ D(f) Φ*,   D_ij = S_ij h_i h_j*,   S = L L*,   Φ = [shapes, 1],

over modes and noise floors. Means W of n ordinates suffice where E is constant between them:

    -ln p = Σ n (ln det E + tr E⁻¹ W).

Unknowns, in this order: ln f (m), ln ζ (m), static responses (m), e_c, d_c and b_c of each floor,
L row by row up to its diagonal (which is one for the floors), the shapes but for the reference
channel of each mode, and the heights of bumps of the log spectrum of the modal forces, of which
there are none at first. All are in phase at first; then the forces of different modes and the
shapes have parts in quadrature, which follow those in phase.
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
from scipy.optimize import brentq
from scipy.special import logsumexp, softmax

from lmshealth._private.arrays import ComplexArray, FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.expected_periodogram import MeanOrdinates


@dataclass(frozen=True)
class Layout:
    """Places of the unknowns; the floors of the channels are the components after the modes."""

    n_modes: int
    n_channels: int
    force: tuple[tuple[int, int], ...]  # row and column of each unknown of L
    shape: tuple[tuple[int, int], ...]  # channel and mode of each unknown of the shapes
    # force_in_phase, shape_in_phase: how many of these, the first ones, are; the others are not.
    force_in_phase: int
    shape_in_phase: int
    n_bumps: int = 0  # of the log spectrum of the modal forces; their heights are the last unknowns

    @cached_property
    def n_components(self) -> int:
        """Number of modes and floors."""
        return self.n_modes + self.n_channels

    @cached_property
    def n_poles(self) -> int:
        """Number of the unknowns of h, which come first: three per mode and per floor."""
        return 3 * self.n_components

    @cached_property
    def pole(self) -> list[tuple[int, int]]:
        """Component of each unknown of h, and the index of its derivative of h."""
        modes = [(i, q) for q in (1, 2, 3) for i in range(self.n_modes)]
        floors = [(i, q) for i in range(self.n_modes, self.n_components) for q in (1, 2, 3)]
        return modes + floors

    @cached_property
    def forces(self) -> slice:
        """Unknowns of L."""
        return slice(self.n_poles, self.n_poles + len(self.force))

    @cached_property
    def shared(self) -> list[int]:
        """Unknowns of L that make floors coherent with modes."""
        m, first = self.n_modes, self.forces.start
        return [first + a for a, (i, j) in enumerate(self.force) if i >= m > j]

    @cached_property
    def quadrature(self) -> list[int]:
        """Unknowns of forces and shapes that are not in phase."""
        forces = range(self.forces.start + self.force_in_phase, self.forces.stop)
        return [*forces, *range(self.shapes.start + self.shape_in_phase, self.shapes.stop)]

    @cached_property
    def units(self) -> tuple[ComplexArray | FloatArray, ComplexArray | FloatArray]:
        """Unit of each unknown of `force` and of `shape`: 1, or i where it is not in phase."""
        if not self.quadrature:
            return np.ones(len(self.force)), np.ones(len(self.shape))
        force, shape = np.arange(len(self.force)), np.arange(len(self.shape))
        return (
            np.where(force < self.force_in_phase, 1, 1j),
            np.where(shape < self.shape_in_phase, 1, 1j),
        )

    def extended(self, p: FloatArray) -> FloatArray:
        """Return unknowns of this layout as those of one with quadrature, all of it zero."""
        more = [np.zeros(len(own)) for own in (self.off_diagonal, self.shape)]
        upto, shapes, rest = np.split(p, [self.forces.stop, self.shapes.stop])
        return np.concatenate([upto, more[0], shapes, more[1], rest])

    def with_quadrature(self) -> Layout:
        """Return the layout with the parts in quadrature of modal forces and of shapes."""
        return replace(self, force=self.force + self.off_diagonal, shape=self.shape * 2)

    @cached_property
    def off_diagonal(self) -> tuple[tuple[int, int], ...]:
        """Row and column of the unknowns of L that forces of different modes have."""
        return tuple((i, j) for i, j in self.force if j < i < self.n_modes)

    @cached_property
    def common(self) -> list[int]:
        """Unknowns of L that make floors coherent with each other."""
        m, first = self.n_modes, self.forces.start
        return [first + a for a, (_, j) in enumerate(self.force) if j >= m]

    @cached_property
    def bends(self) -> list[int]:
        """Unknowns b of the floors."""
        return list(range(self.n_poles - 3 * self.n_channels + 2, self.n_poles, 3))

    @cached_property
    def statics(self) -> list[int]:
        """Static responses of the modes."""
        return list(range(2 * self.n_modes, 3 * self.n_modes))

    @cached_property
    def shapes(self) -> slice:
        """Unknowns of the shapes."""
        return slice(self.forces.stop, self.forces.stop + len(self.shape))

    @cached_property
    def bumps(self) -> slice:
        """Heights of the bumps."""
        return slice(self.shapes.stop, self.size)

    @cached_property
    def places(self) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], ...]:
        """Columns of `pole`, `force` and `shape`."""
        pairs = (self.pole, self.force, self.shape)
        columns = (np.array(own, dtype=np.intp).reshape(-1, 2).T for own in pairs)
        return tuple((first, second) for first, second in columns)

    @cached_property
    def power(self) -> FloatArray:
        """Power of the gain of forces in the response of each component."""
        return (np.arange(self.n_components) < self.n_modes) / 2

    @cached_property
    def size(self) -> int:
        """Number of unknowns."""
        return self.n_poles + len(self.force) + len(self.shape) + self.n_bumps


def lay_out(reference: Sequence[int], n_channels: int) -> Layout:
    """Return the places of the unknowns; ``reference`` is the channel in which a shape is one."""
    m = len(reference)
    # A single channel only shows which forces neighbours share.
    modes = [(i, j) for i in range(m) for j in range(i + 1) if n_channels > 1 or i - j < 2]
    floors = [(m + c, j) for c in range(n_channels) for j in range(m + c)]
    shape = [(c, i) for i in range(m) for c in range(n_channels) if c != reference[i]]
    force = *modes, *floors
    return Layout(m, n_channels, force, tuple(shape), len(force), len(shape))


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
    ones (11, 12, 13, 22, 23, 33); the third unknown, the static response, is added by the caller.
    With d = 1/h, h_a = -d_a h² and h_ab = (2 d_a d_b h - d_ab) h².
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


# Newton decrement, a square in standard deviations, below which the search ends, and most steps:
# fits take 20, and up to 250 where modes stand 80 dB above floors that only a few directions show.
_ARRIVED, _MOST_STEPS = 1e-5, 400
# First and least radius of the trust region, and shares of the expected gain: steps count above
# the first share, the radius shrinks below the second and grows above the third.
_FIRST_RADIUS, _LEAST_RADIUS, _ACCEPTED, _POOR, _GOOD = 0.3, 1e-9, 0.15, 0.25, 0.75
# Slopes of E that are computed at a time: more channels would not fit into the processor's cache.
_CACHED = 1 << 14


@dataclass(frozen=True, eq=False)
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
    known_floors: bool = False  # whether further directions determine their level
    narrowest: float = 0.0  # half-power bandwidth in Hz below which a pole is a line
    # Models at the latest unknowns, by the bytes of these.
    _latest: dict[bytes, list[_Point]] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def prior_std(self) -> FloatArray:
        """Standard deviations of the weak priors, shape ``(n_unknowns,)``."""
        lay = self.layout
        forces = np.full(len(lay.force), constants.PRIOR_FORCE)
        forces[np.array(lay.shared, dtype=int) - lay.forces.start] = constants.WIDTHS_SHARED[-1]
        forces[np.array(lay.common, dtype=int) - lay.forces.start] = constants.WIDTHS_COMMON[-1]
        forces[lay.force_in_phase :] = constants.PRIOR_QUADRATURE[0]
        shapes = np.full(len(lay.shape), constants.PRIOR_SHAPE)
        shapes[lay.shape_in_phase :] = constants.PRIOR_QUADRATURE[1]
        return np.concatenate(
            [
                np.repeat([constants.PRIOR_LN_F, constants.PRIOR_LN_ZETA], lay.n_modes),
                np.full(lay.n_modes, constants.WIDTHS_STATIC[-1]),
                np.tile(constants.PRIOR_FLOORS[self.known_floors], lay.n_channels),
                forces,
                shapes,
                np.full(lay.n_bumps, self.bump_std),
            ]
        )

    def with_quadrature(self) -> Likelihood:
        """Return the likelihood with the parts in quadrature of modal forces and of shapes."""
        layout = self.layout.with_quadrature()
        return replace(self, layout=layout, start=self.layout.extended(self.start))

    def coloured(self, bumps: FloatArray, std: float) -> Likelihood:
        """Return the likelihood with bumps, ``(2, n_bumps)``, and the prior std of heights."""
        n = bumps.shape[1]
        layout, start = replace(self.layout, n_bumps=n), np.append(self.start, np.zeros(n))
        return replace(self, layout=layout, start=start, bumps=bumps, bump_std=std)

    def with_bump_std(self, std: float) -> Likelihood:
        """Return the likelihood with another prior of the heights, for which no model changes."""
        other = replace(self, bump_std=std)
        other._latest.update(self._latest)
        return other

    def value(self, p: FloatArray) -> float:
        """Negative log posterior up to a constant."""
        with np.errstate(over="ignore"):
            prior = 0.5 * float(np.sum(((p - self.start) / self.prior_std) ** 2))
        return prior + self.data_value(p)

    def derivatives(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Exact gradient and Hessian of `value`, shapes ``(n_unknowns,)`` and square."""
        gradient = (p - self.start) / self.prior_std**2
        hessian = np.diag(1 / self.prior_std**2)
        for point in self._at(p):
            gradient = gradient + point.derivatives[0]
            hessian = hessian + point.derivatives[1]
        return gradient, hessian

    def data_value(self, p: FloatArray) -> float:
        """Negative log likelihood without the priors; infinite where E is singular or overflows."""
        with np.errstate(over="ignore", invalid="ignore"), suppress(np.linalg.LinAlgError):
            value = sum(point.misfit for point in self._at(p))
            if np.isfinite(value):
                return value
        return np.inf

    def expected(self, p: FloatArray) -> list[ComplexArray]:
        """Compute E of each block, shape ``(n, n_channels, n_channels)``."""
        return [point.expected for point in self._at(p)]

    def _at(self, p: FloatArray) -> list[_Point]:
        key = p.tobytes()
        if key not in self._latest:
            while len(self._latest) > 1:
                del self._latest[next(iter(self._latest))]
            with np.errstate(over="ignore", invalid="ignore"):
                self._latest[key] = [_Point(self, p, block) for block in self.blocks]
        return self._latest[key]

    def shapes(self, p: FloatArray) -> ComplexArray | FloatArray:
        """Shapes of the modes, shape ``(n_channels, n_modes)``."""
        lay = self.layout
        phi: FloatArray = np.ones((lay.n_channels, lay.n_modes), dtype=lay.units[1].dtype)
        if lay.shape:
            phi[lay.places[2]] = 0.0
            np.add.at(phi, lay.places[2], lay.units[1] * p[lay.shapes])
        return phi

    def strength(self, p: FloatArray) -> FloatArray:
        """PSD of each modal force in each channel, shape ``(n_channels, n_modes)``."""
        return self._at_modes(p).strength

    def forces(self, p: FloatArray) -> ComplexArray | FloatArray:
        """Covariance of the modal forces, shape ``(n_modes, n_modes)``."""
        m = self.layout.n_modes
        return self._at_modes(p).forces[:m, :m]

    def signal_to_noise(self, p: FloatArray) -> FloatArray:
        """Modal signal-to-noise ratios S φ² / (4 ζ² N), shape ``(n_channels, n_modes)``."""
        m, point = self.layout.n_modes, self._at_modes(p)
        return point.strength / (4 * np.exp(2 * p[m : 2 * m]) * point.floor)

    def _at_modes(self, p: FloatArray) -> _Point:
        m = self.layout.n_modes
        at = MeanOrdinates(np.exp(p[:m]), np.empty((m, 0, 0), dtype=complex), np.ones(m), None)
        return _Point(self, p, at)

    def minimise(self, start: FloatArray) -> FloatArray:
        """Find the posterior mode by Newton's method in a trust region, from ``(n_unknowns,)``.

        The search ends where a pole becomes a line: it would take many steps to no damping.
        """
        p, radius, found = start, _FIRST_RADIUS, self._finite_derivatives(start)
        if found is None:
            return start
        value, (slope, curvature) = self.value(start), found
        for _ in range(_MOST_STEPS):
            # Of a small radius what is gained is below the rounding of the value.
            if radius < _LEAST_RADIUS or self.collapsed(p):
                break
            newton = _newton_step(slope, curvature)
            if newton is not None and -float(slope @ newton) < _ARRIVED:
                break
            if newton is not None and np.linalg.norm(newton) <= radius:
                step, growth = newton, 1
            else:
                step, growth = _step_to(radius, slope, curvature), 2
            moved = p + step
            after = self.value(moved)
            share = (value - after) / -float(slope @ step + 0.5 * step @ curvature @ step)
            if share > _ACCEPTED and (found := self._finite_derivatives(moved)) is not None:
                p, value, (slope, curvature) = moved, after, found
                radius *= growth if share > _GOOD else 1 / 4 if share < _POOR else 1
            else:
                radius /= 4
        return p

    def collapsed(self, p: FloatArray) -> list[int]:
        """Return the modes whose poles are lines."""
        bandwidth = 2 * np.exp(p[: 2 * self.layout.n_modes].reshape(2, -1).sum(axis=0))
        return np.flatnonzero(bandwidth < self.narrowest).tolist()

    def _finite_derivatives(self, p: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return `derivatives`; None where they overflow."""
        with suppress(np.linalg.LinAlgError), np.errstate(over="ignore", invalid="ignore"):
            found = self.derivatives(p)
            if all(np.isfinite(part).all() for part in found):
                return found
        return None


def _newton_step(slope: FloatArray, curvature: FloatArray) -> FloatArray | None:
    """Return the step to the minimum of a quadratic; None if it has none."""
    with suppress(np.linalg.LinAlgError):
        return np.asarray(-cho_solve(cho_factor(curvature), slope))
    return None


def _step_to(radius: float, slope: FloatArray, curvature: FloatArray) -> FloatArray:
    """Return the step of this length to the least value of a quadratic (Moré and Sorensen)."""
    values, vectors = np.linalg.eigh(curvature)
    along = vectors.T @ slope
    least = max(0.0, 1e-12 * np.abs(values).max() - values[0])

    def excess(shift: float) -> float:
        return float(1 / radius - 1 / np.linalg.norm(along / (values + shift)))

    step = -along / (values + least)
    if excess(least) > 0:
        most = 2 * (least + float(np.linalg.norm(slope)) / radius)
        step = -along / (values + brentq(excess, least, most, rtol=1e-6))
    else:  # no slope along the lowest curvature
        step[0] += np.sqrt(radius**2 - step @ step)
    return np.asarray(vectors @ step)


class _Point:
    """Model of a block at one point; frequency is the last axis unless stated otherwise."""

    def __init__(self, likelihood: Likelihood, p: FloatArray, block: MeanOrdinates) -> None:
        self._block, self._scale = block, likelihood.scale
        self._layout = lay = likelihood.layout
        m, n = lay.n_modes, lay.n_components
        self._root = np.zeros((n, n), dtype=lay.units[0].dtype)
        self._root[range(m, n), range(m, n)] = 1.0
        driven, force = lay.places[1]
        np.add.at(self._root, (driven, force), lay.units[0] * self._scale[driven] * p[lay.forces])
        self._phi = np.concatenate([likelihood.shapes(p), np.eye(lay.n_channels)], axis=1)
        self.forces = np.asarray(self._root @ self._root.conj().T)  # S, of modes and floors
        f, zeta = np.exp(p[: 2 * m].reshape(2, m, 1))
        modes = receptance(f, zeta, block.grid)
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
        return np.asarray(np.abs(self._phi[:, :m]) ** 2 * np.diag(self.forces)[:m].real)

    @property
    def floor(self) -> FloatArray:
        """PSD of the part of each floor incoherent with modes, shape ``(channels, grid)``."""
        m = self._layout.n_modes
        own = np.sum(np.abs(self._root[m:, m:]) ** 2, axis=1)
        return np.asarray(np.abs(self._h[0, m:]) ** 2 * own[:, None])

    @cached_property
    def _modal(self) -> ComplexArray:
        """D, shape ``(components, components, n)``."""
        h = self._h[0]
        modal = self._block.smear(self.forces[..., None] * h[:, None] * h[None].conj())
        return modal * self._gain if self._layout.n_bumps else modal

    @cached_property
    def expected(self) -> ComplexArray:
        """E, shape ``(n, channels, channels)``."""
        half = np.tensordot(self._phi, self._modal, axes=(1, 0))
        expected = np.tensordot(half, self._phi.conj(), axes=(1, 1)).transpose(1, 0, 2).copy()
        return expected if self._block.foreign is None else expected + self._block.foreign

    @cached_property
    def _whitening(self) -> tuple[ComplexArray, ComplexArray]:
        """C⁻¹ with C Cᴴ = E, and C⁻¹ W C⁻ᴴ; shapes as `expected`."""
        whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(self.expected)), dtype=np.complex128)
        return whiten, whiten @ self._block.matrix @ whiten.conj().swapaxes(1, 2)

    @cached_property
    def misfit(self) -> float:
        """Σ n (ln det E + tr E⁻¹ W)."""
        whiten, white = (np.diagonal(part, axis1=1, axis2=2).real for part in self._whitening)
        return float(self._block.count @ (white - 2 * np.log(whiten)).sum(axis=1))

    @cached_property
    def derivatives(self) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian of the misfit (README.md)."""
        count, eye = self._block.count[:, None, None], np.eye(self._layout.n_channels)
        packing, size = _packing(len(eye)), self._layout.bumps.start
        whiten, white = self._whitening
        excess = count * (eye - white)
        row, w = self._slopes
        gradient = np.zeros(self._layout.size)
        hessian = self._curvature(whiten.conj().swapaxes(1, 2) @ excess @ whiten)
        # The columns of Φ for the floors are the unit vectors of the channels.
        near = whiten @ self._phi
        first, w = packing.pack(excess), np.ascontiguousarray(w.transpose(2, 1, 0))
        step = max(1, _CACHED // (eye.size * row.size))
        for part in (slice(at, at + step) for at in range(0, len(count), step)):
            slopes = packing.slopes(near[part], near[part].conj() @ w[part], row)
            if self._layout.n_bumps:
                # Heights change E as the gain of the forces does, times their bump.
                heights = slopes[:, :, size:].sum(axis=2, keepdims=True) * self._bump.T[part, None]
                slopes = np.concatenate([slopes[:, :, :size], heights], axis=2)
            turned = packing.product(count[part] * (2 * white[part] - eye)) @ slopes
            slopes = slopes.reshape(-1, gradient.size)
            gradient += first[part].ravel() @ slopes
            hessian += slopes.T @ turned.reshape(slopes.shape)
        return gradient, hessian

    @cached_property
    def _slopes(self) -> tuple[NDArray[np.intp], ComplexArray]:
        """Rows of the slopes of E in the basis of Φ's columns and the channels.

        Returns the index of b in the basis and the row w of each unknown, E_a = b (Φ̄ w)ᵀ + adjoint,
        shapes ``(unknowns,)`` and ``(unknowns, components, n)``.
        """
        lay, h, s = self._layout, self._h, self.forces
        (pole, slope), (driven, _), (channel, mode) = lay.places
        by_pole = s[pole, :, None] * h[slope, pole][:, None] * h[0].conj()
        pairs = self._block.smear(h[0][:, None] * h[0].conj())
        row = [pole, driven, lay.n_modes + channel]
        by_shape = lay.units[1][:, None, None] * self._modal[mode]
        w = [self._block.smear(by_pole), self._change[..., None] * pairs[driven], by_shape]
        if lay.n_bumps:
            w[:2] = [part * self._gain[i] for part, i in zip(w[:2], row[:2], strict=True)]
            row.append(np.arange(lay.n_modes))
            w.append(self._modal[: lay.n_modes] / 2)
        return np.concatenate(row), np.concatenate(w)

    @cached_property
    def _change(self) -> ComplexArray:
        """Change of the row of S that belongs to each force, ``(forces, components)``.

        That of the column is its adjoint.
        """
        driven, force = self._layout.places[1]
        unit = self._layout.units[0] * self._scale[driven]
        return np.asarray(unit[:, None] * self._root.conj().T[force])

    def _curvature(self, g: ComplexArray) -> FloatArray:
        """Σ tr G E_ab over all pairs of unknowns, the counts in G."""
        lay, (row, w) = self._layout, self._slopes
        size = lay.bumps.start
        curvature = np.zeros((lay.size, lay.size))
        g = np.ascontiguousarray(np.moveaxis(g, 0, -1))
        # Φ* G, (components, channels, n), and the transpose of Φ* G Φ
        pull = np.tensordot(self._phi.conj().T, g, axes=(1, 0))
        turned = np.tensordot(self._phi.T, pull, axes=(1, 1))
        if lay.n_bumps:
            (pole, _), (driven, _), (_, mode) = lay.places
            power = lay.power[:, None] + lay.power
            part = (w[:size] * turned[row[:size]]).real
            along = 2 * np.einsum("ajk,aj->ak", part, power[np.concatenate([pole, driven, mode])])
            own = np.einsum("ijk,ijk,ij->k", self._modal, turned, power**2).real
            curvature[:size, size:] = along @ self._bump.T
            curvature[size:, :size] = curvature[:size, size:].T
            curvature[size:, size:] = (self._bump * own) @ self._bump.T
            turned = turned * self._gain
        if self._block.kernel is not None:
            turned = self._block.kernel.spread(turned)
        self._by_poles(curvature, turned)
        self._by_forces(curvature, turned)
        if lay.shape:
            self._by_shapes(curvature, g, pull)
        return curvature

    def _by_poles(self, curvature: FloatArray, turned: ComplexArray) -> None:
        """Add the part of two unknowns of h: Q = Σ_ij S_ij B_ji h_i h_j*."""
        h, n = self._h, self._layout.n_poles
        component, slope = self._layout.places[0]
        weight = self.forces[..., None] * turned
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
        driven, force = lay.places[1]
        overlap = np.einsum("ijk,ik,jk->ij", turned, h[0], h[0].conj())
        unit = lay.units[0] * self._scale[driven]
        same = (force[:, None] == force) * np.outer(unit, unit.conj())
        curvature[lay.forces, lay.forces] += 2 * (same * overlap[driven[:, None], driven]).real
        component, slope = lay.places[0]
        mixed = np.einsum("ajk,ak,jk->aj", turned[component], h[slope, component], h[0].conj())
        # S changes in row and column.
        term = (driven[:, None] == component) * (self._change @ mixed.T)
        term += self._change.conj()[:, component] * mixed[:, driven].T
        curvature[lay.forces, : lay.n_poles] += 2 * term.real
        curvature[: lay.n_poles, lay.forces] += 2 * term.real.T

    def _by_shapes(self, curvature: FloatArray, g: ComplexArray, pull: ComplexArray) -> None:
        """Add the part of two shapes, and of a shape and an unknown of D."""
        lay, first = self._layout, self._layout.shapes.start
        channel, mode = lay.places[2]
        row, inner = (own[:first] for own in self._slopes)
        own = np.tensordot(self._modal, g, axes=(2, 2))  # (i, j, d, c)
        unit = lay.units[1]
        own = own[mode[:, None], mode, channel, channel[:, None]] * np.outer(unit, unit.conj())
        curvature[lay.shapes, lay.shapes] += 2 * own.real
        along = np.einsum("ajk,jck->ac", inner, pull)
        across = inner.conj() @ pull[row].swapaxes(1, 2)  # (a, i, c)
        term = across[:, mode, channel] + np.where(row[:, None] == mode, along[:, channel], 0)
        term = unit * term
        curvature[:first, lay.shapes] += 2 * term.real
        curvature[lay.shapes, :first] += 2 * term.real.T


class _Packing:
    """Hermitian matrices as real vectors: the lower triangle, which keeps inner products."""

    def __init__(self, n: int) -> None:
        self._row, self._column = np.tril_indices(n)
        self._off = np.flatnonzero(self._row != self._column)
        self._scale = np.where(self._row == self._column, 1.0, np.sqrt(2))
        # The matrices of which the elements of the vectors are coefficients.
        basis = np.zeros((n * n, n, n), dtype=complex)
        parts = np.append(1 / self._scale, np.full(self._off.size, 1j / np.sqrt(2)))
        row, column = (np.append(own, own[self._off]) for own in (self._row, self._column))
        basis[range(n * n), row, column] = parts
        basis[range(n * n), column, row] = parts.conj()
        table = np.einsum("lca,kab->bckl", basis, basis).reshape(n * n, 1, -1)
        self._table = np.concatenate([table.real, -table.imag], axis=1).reshape(2 * n * n, -1)

    def pack(self, matrices: ComplexArray) -> FloatArray:
        """Return vectors ``(n, size)`` of matrices ``(n, n_channels, n_channels)``."""
        return self._join((matrices[:, self._row, self._column] * self._scale)[..., None])[..., 0]

    def slopes(
        self, near: ComplexArray, other: ComplexArray, index: NDArray[np.intp]
    ) -> FloatArray:
        """Return vectors ``(n, size, n_unknowns)`` of b cᵀ + adjoint.

        The column b of each unknown is that of this index in ``near``.
        """
        row, column, scale = self._row, self._column, self._scale[:, None]
        lower = (near[:, row] * scale)[..., index] * other[:, column]
        lower += ((near[:, column] * scale)[..., index] * other[:, row]).conj()
        return self._join(lower)

    def _join(self, lower: ComplexArray) -> FloatArray:
        return np.concatenate([lower.real, lower[:, self._off].imag], axis=1)

    def product(self, matrices: ComplexArray) -> FloatArray:
        """Return P with aᵀ P b = Re tr A M B for packed A and B, ``(n, size, size)``."""
        flat = np.ascontiguousarray(matrices).view(np.float64).reshape(len(matrices), -1)
        size = matrices.shape[1] ** 2
        return np.asarray(flat @ self._table).reshape(-1, size, size)


_packing = lru_cache(maxsize=4)(_Packing)


class Marginal(NamedTuple):
    """Posterior of ``[ln f, ln ζ]``, all other unknowns marginalised."""

    mean: FloatArray
    cov: FloatArray
    decrement: float  # Newton decrement g H⁻¹ g; infinite where there is no maximum
    log_evidence: float = -np.inf  # up to a constant of the data


def marginalise(likelihood: Likelihood, p: FloatArray) -> Marginal:
    """Return mean and covariance of ``[ln f, ln ζ]`` by Laplace's approximation.

    The posterior is averaged over the widths of the priors of coherence and bends of floors and of
    static responses, weighted by their evidence (README.md). ``p`` is near the posterior mode.
    """
    n, layout = 2 * likelihood.layout.n_modes, likelihood.layout
    gradient, hessian = likelihood.derivatives(p)
    try:
        root = np.linalg.cholesky(hessian)  # exists at a maximum only
    except np.linalg.LinAlgError:
        return Marginal(p[:n], np.full((n, n), np.nan), np.inf)
    cov = np.linalg.inv(hessian)
    # The search ends at a small gradient: one Newton step to the centre of the normal.
    step = cov @ gradient
    decrement = float(gradient @ step)
    evidence = 0.5 * decrement - likelihood.value(p) - np.log(np.diag(root)).sum()
    p = p - step
    groups = (layout.shared, layout.common, layout.bends, layout.statics)
    index = np.array([unknown for group in groups for unknown in group], dtype=int)
    precision = np.linalg.inv(cov[np.ix_(index, index)])
    follow = cov[:n, index] @ precision  # regression of ln f and ln ζ on these unknowns
    x = (p - likelihood.start)[index]
    gain, mean, narrowed = _narrow(x, precision, [len(group) for group in groups])
    weight = softmax(gain)
    moved = (mean - x) @ follow.T
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
    choices = [
        choice if n else choice[-1:]
        for choice, n in zip(
            (
                constants.WIDTHS_SHARED,
                constants.WIDTHS_COMMON,
                constants.WIDTHS_BEND,
                constants.WIDTHS_STATIC,
            ),
            sizes,
            strict=True,
        )
    ]
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
