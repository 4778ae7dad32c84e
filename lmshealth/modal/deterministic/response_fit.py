"""Fit of a frequency response: number of modes, noise and distortion, covariance."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray, ReadOnly, stack
from lmshealth.modal import constants
from lmshealth.modal.credibility import (
    Credibility,
    dependence,
    neighbour_correlation,
    small_sample,
    widened,
)
from lmshealth.modal.deterministic.likelihood import BandSpectra, ModalLikelihood, pole_terms
from lmshealth.modal.deterministic.poles import (
    PoleFit,
    best_pole,
    evidence_needed,
    maximise,
    vector_fit,
)
from lmshealth.modal.deterministic.responses import Ordinates, smooth_noise
from lmshealth.modal.modes import paired

# Powers of s, downwards and upwards. Weak modes outside the band bias those inside by up to one
# standard deviation with four powers, by half of one with six. Powers enter in pairs: an even one
# for elasticity, an odd one for loss.
FEWEST_POWERS, _MOST_POWERS, _POWER_STEP = 6, 8, 2
# A transient is smooth over a band: powers of s.
TRANSIENT_POWERS = (-1, 0, 1)
# Damping ratios at which modes are searched for, and the largest one.
_TRIED_DAMPING, _MOST_DAMPING = (0.003, 0.01, 0.03, 0.1), 0.7
# Damping ratio that is left of a mode all of whose damping is that of a window, at most.
NO_DAMPING = 1e-9
# Relative singular value below which a direction of the powers is dropped.
_THIN = 1e-12
# Tolerance in log likelihood of a fit.
_TOLERANCE = 1e-4
# Lines over which the noise of a record that is not periodic is averaged.
_NOISE_LINES = 41
# Least standard deviation of unknown noise over the largest response: six digits.
_DIGITS = 1e-6
# Gain in -2 ln L at fixed poles from which on a larger model is fitted.
_WORTH = 2.0
# Lines of an end of the band.
_END = 3
_ROUNDS = 4
# Standard deviation of the prior of ln f and ln ζ: directions without data stay this uncertain.
_PRIOR_STD = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class ResponseFit(ReadOnly):
    """A rational transfer function with its uncertainty, modes ascending in frequency.

    ``chi_square`` is the squared error over the variance of the noise per degree of freedom: about
    one where the response is rational but for noise, NaN where the noise is unknown.
    """

    # Lines of the fit, without outliers. Noise that was unknown before is that of the residual.
    ordinates: Ordinates
    # Hz and amplitude of lines that are no response to the input, (n_outliers, 2)
    outliers: FloatArray
    estimate: FloatArray  # [ln f, ln ζ], (2 n_modes,)
    cov: FloatArray  # its covariance, linear unknowns marginalised, (2 n_modes, 2 n_modes)
    credibility: tuple[Credibility, ...]  # factors of it, (n_modes,)
    noise_cov: FloatArray  # the part of it by noise alone: scatter of repeated measurements
    snr: FloatArray  # power at the resonance over noise and distortion in one line, (n_modes,)
    over_distortion: FloatArray  # the same over the distortion alone; infinite where there is none
    response: ComplexArray  # fitted, at the lines
    chi_square: float
    distortion: float  # error beyond noise over the response: nonlinear, or a missing term
    colour: float  # correlation of errors of neighbouring lines, where it is significant

    @property
    def missed(self) -> float:
        """Error beyond the noise of periods as a share of the answer, at most 1."""
        o = self.ordinates
        beyond = np.sum(np.abs(o.answer - o.given * self.response) ** 2 - o.noise)
        share = float(beyond / np.sum(np.abs(o.answer) ** 2))
        return float(np.sqrt(np.clip(share, 0, 1)))


def fit_response(ordinates: Ordinates) -> ResponseFit:
    """Fit poles, residues and residual terms to the response of a band.

    Order, noise, distortion and covariance are those of the section "Frequency responses" in the
    README of the folder [Pintelon2012].
    """
    start = np.empty(0), (-FEWEST_POWERS, FEWEST_POWERS)
    state = _restart(_grow(_settle(ordinates, *start, ordinates.noise)))
    for _ in range(_ROUNDS):
        keep = _inliers(state)
        if keep.all() or keep.sum() < (1 - constants.MOST_OUTLIERS) * ordinates.frequency.size:
            break
        state = _grow(_without_lines(state, keep))
    state = _shrink(state)
    state = _settle(state.ordinates, state.theta, state.powers, state.variance, rounds=_ROUNDS)
    return _conclude(state, ordinates)


def without_window(fit: ResponseFit, time_constant: float) -> ResponseFit:
    """Remove the damping that an exponential window exp(-t/τ) has added, 1/τ of ζω.

    A mode whose decay is that of the window keeps one below `NO_DAMPING`.
    """
    m = fit.estimate.size // 2
    w, zeta = 2 * np.pi * np.exp(fit.estimate[:m]), np.exp(fit.estimate[m:])
    decay = np.maximum(zeta * w - 1 / time_constant, NO_DAMPING / 2 * w)
    own = np.hypot(w * np.sqrt(1 - zeta**2), decay)
    turn = np.eye(2 * m)
    turn[m:, m:] = np.diag(zeta * w / decay)
    turn[m:, :m] = turn[m:, m:] - np.eye(m)
    return replace(
        fit,
        estimate=np.log(np.concatenate([own / (2 * np.pi), decay / own])),
        cov=turn @ fit.cov @ turn.T,
        noise_cov=turn @ fit.noise_cov @ turn.T,
    )


Powers = tuple[int, int]
"""Lowest and highest power of s."""


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """A model at its maximum of likelihood, with the variance of its error."""

    ordinates: Ordinates
    powers: Powers
    poles: PoleFit
    variance: FloatArray  # of the error, (n_lines,)
    distortion: float  # as a share of H
    background: ComplexArray  # with real sizes: modes outside the band in H, (n_lines, n)

    @property
    def theta(self) -> FloatArray:
        """``[ln f, ln ζ]`` of the modes, shape ``(2 n_modes,)``."""
        return self.poles.p

    @property
    def modes(self) -> tuple[FloatArray, FloatArray]:
        """Natural frequency in Hz and damping ratio, shape ``(n_modes,)`` each."""
        return self.poles.frequency, self.poles.damping_ratio

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return self.poles.likelihood.n_modes

    @property
    def error(self) -> ComplexArray:
        """Measured less fitted answer, shape ``(n_lines,)``."""
        real, imag = np.split(self.poles.at.fits[0].residual[:, 0], 2)
        return np.asarray((real + 1j * imag) * np.sqrt(self.variance))

    @property
    def residues(self) -> ComplexArray:
        """Residues times the spacing of the lines, shape ``(n_modes,)``."""
        return np.array([self.poles.sizes(i)[0][0, 0] for i in range(self.n_modes)], dtype=complex)

    def _modal(self) -> ComplexArray:
        """Return the parts of H by the modes, shape ``(n_modes, n_lines)``."""
        (block,) = self.poles.likelihood.blocks
        (up, _), (down, _) = pole_terms(block, *self.modes)
        return np.asarray(up * self.residues[:, None] + down * self.residues.conj()[:, None])

    @property
    def response(self) -> ComplexArray:
        """The fitted H, shape ``(n_lines,)``."""
        sizes = self.poles.at.fits[0].sizes[0, : self.background.shape[1], 0]
        return np.asarray(self._modal().sum(axis=0) + self.background @ sizes)

    @property
    def parts(self) -> FloatArray:
        """Sum of the powers of the parts of H: of modes and background, shape ``(n_lines,)``."""
        # Powers and poles of a background may cancel each other; modes do not.
        modal = self._modal()[self.modes[1] <= constants.FRF_MOST_DAMPING]
        rest = self.response - modal.sum(axis=0)
        return np.asarray(np.sum(np.abs(modal) ** 2, axis=0) + np.abs(rest) ** 2)

    @property
    def white(self) -> ComplexArray:
        """Whitened error of the response, its phase relative to the input."""
        given = self.ordinates.given
        turn = np.abs(given) / np.where(given == 0, 1, given)
        return np.asarray(self.error * turn / np.sqrt(self.variance))

    @property
    def cost(self) -> float:
        """Twice the negative log likelihood."""
        return 2 * float(np.sum(np.log(self.variance) + np.abs(self.white) ** 2))

    @property
    def colour(self) -> float:
        """Correlation of neighbouring errors where it is clear."""
        return neighbour_correlation(self.white)

    @property
    def dependent_lines(self) -> float:
        """Number of lines that count as one independent line."""
        return dependence(self.colour)

    @property
    def penalty(self) -> float:
        """Gain that modes and background need."""
        (low, high), each = self.powers, 6 if self.ordinates.transient else 4
        heavy = int(np.count_nonzero(self.modes[1] > constants.FRF_MOST_DAMPING))
        modes = 2 * evidence_needed(self.poles.likelihood)
        background = constants.FRF_BACKGROUND_COST * (each * heavy + high - low)
        return float((self.n_modes - heavy) * modes + background)


def _unknowns(ordinates: Ordinates, theta: FloatArray, powers: Powers) -> int:
    """Count real unknowns."""
    each, more = (6, len(TRANSIENT_POWERS)) if ordinates.transient else (4, 0)
    return each * theta.size // 2 + powers[1] - powers[0] + 1 + more


def _solve(
    ordinates: Ordinates,
    theta: FloatArray,
    powers: Powers,
    variance: FloatArray,
    *,
    refine: bool = False,
) -> _State:
    """Fit the linear unknowns, with ``refine`` the poles, too, at known variances of the lines."""
    frequency, given, n = ordinates.frequency, ordinates.given, theta.size // 2
    s = 1j * frequency / np.sqrt(frequency[0] * frequency[-1])
    columns = s[:, None] ** np.arange(powers[0], powers[1] + 1)
    columns = columns / np.linalg.norm(given[:, None] * columns, axis=0)
    base, size, turn = np.linalg.svd(stack(given[:, None] * columns), full_matrices=False)
    kept = size > _THIN * size[0]
    base, background = base[:, kept], columns @ (turn[kept] / size[kept, None]).T
    if ordinates.transient:
        base = np.hstack([base, stack(s[:, None] ** np.array(TRANSIENT_POWERS))])
    block = BandSpectra(
        frequency, ordinates.answer[None, :, None], 1 / ordinates.spacing, np.inf, base,
        force=given, transient=ordinates.transient, noise=variance,
    )  # fmt: skip
    likelihood = ModalLikelihood.of_known_noise(block, n)
    p = likelihood.clip(theta)
    if refine:
        poles = maximise(likelihood, p, np.arange(2 * n), tolerance=_TOLERANCE)
    else:
        poles = PoleFit(likelihood, p, likelihood.evaluate(p))
    return _State(ordinates, powers, poles, variance, 0.0, background)


def _gain(larger: _State, smaller: _State, dependent_lines: float = 1.0) -> float:
    """Return the gain of the larger of two models, less its penalty."""
    return (smaller.cost - larger.cost) / dependent_lines - larger.penalty + smaller.penalty


def _settle(
    ordinates: Ordinates,
    theta: FloatArray,
    powers: Powers,
    variance: FloatArray,
    *,
    rounds: int = 2,
) -> _State:
    """Maximise the likelihood over poles and variance alternately."""
    distortion = 0.0
    for _ in range(rounds):
        state = _solve(ordinates, theta, powers, variance, refine=True)
        theta, before = state.theta, variance
        variance, distortion = _error_variance(state)
        if np.abs(np.log(variance / before)).max() < 0.05:
            break
    return replace(_solve(ordinates, theta, powers, variance), distortion=distortion)


def _error_variance(state: _State) -> tuple[FloatArray, float]:
    """Return the variance of the error of each line, and the distortion as a share of H."""
    ordinates, n = state.ordinates, state.variance.size
    # Corrected for the degrees of freedom of the fit.
    left = n - _unknowns(ordinates, state.theta, state.powers) / 2
    power = np.abs(state.error) ** 2 * (n / left)
    if not ordinates.scatter:
        # Lines that were measured before have as many digits as the file.
        floor = (_DIGITS * np.abs(ordinates.answer).max()) ** 2 if ordinates.periodic else 0.0
        return np.maximum(smooth_noise(power, state.parts, _NOISE_LINES), floor), 0.0
    parts = state.parts * np.abs(ordinates.given) ** 2

    def cost(ln_share: float) -> float:
        total = ordinates.noise + np.exp(ln_share) * parts
        return 2 * float(np.sum(np.log(total) + power / total))

    found = minimize_scalar(cost, bounds=(np.log(1e-12), 0.0), method="bounded")
    if cost(-np.inf) - found.fun < constants.DISTORTED:
        return ordinates.noise, 0.0
    share = float(np.exp(found.x))
    return ordinates.noise + share * parts, float(np.sqrt(share))


def _without_lines(state: _State, keep: BoolArray) -> _State:
    """Fit without some of the lines."""
    return _settle(state.ordinates.only(keep), state.theta, state.powers, state.variance[keep])


def _inliers(state: _State) -> BoolArray:
    """Return which lines are no outliers; in a record neighbours of an outlier count as ones."""
    # Over a variance from ν degrees of freedom the error has heavier tails: (1 + x/ν)^-ν.
    freedom = state.ordinates.freedom if state.ordinates.scatter else _NOISE_LINES
    rare = (state.white.size / constants.OUTLIER_FALSE_ALARM) ** (1 / freedom)
    odd = np.abs(state.white) ** 2 > freedom * (rare - 1)
    if not state.ordinates.periodic:
        return np.asarray(np.convolve(odd, np.ones(5), mode="same") == 0)
    # Lines of a distorted resonance are no outliers.
    f, zeta = state.modes
    near = np.abs(state.ordinates.frequency[:, None] - f) < 2 * zeta * f
    distorted = state.variance > 2 * state.ordinates.noise
    return np.asarray(~odd | (distorted & near.any(axis=1)))


def _grow(state: _State) -> _State:
    """Add modes and powers while the criterion improves."""
    fewest = (1 - constants.MOST_OUTLIERS) * state.variance.size
    while True:
        trials = [
            _settle(state.ordinates, *order, state.variance)
            for order in _larger(state)
            if _unknowns(state.ordinates, *order) < state.variance.size
        ]
        gains = [_gain(t, state) if _is_admissible(t, state) else -np.inf for t in trials]
        if not gains or max(gains) <= 0:
            return state
        larger = _without_outliers(trials[int(np.argmax(gains))], state)
        if larger.variance.size < fewest:
            return state
        state = larger


def _restart(state: _State) -> _State:
    """Start from vector fits where the error exceeds the noise, or this is unknown."""
    ordinates = state.ordinates
    if not ordinates.periodic or (ordinates.scatter and state.distortion == 0):
        return state
    best = state
    for n in range(1, constants.FRF_MOST_MODES + 1):
        if not ordinates.scatter and n > best.n_modes + 1:
            break
        (block,) = state.poles.likelihood.blocks
        block = replace(block, noise=ordinates.noise)
        theta = np.log(np.concatenate(vector_fit(block, state.background, n)))
        if _unknowns(ordinates, theta, state.powers) >= state.variance.size:
            break
        trial = _settle(ordinates, theta, state.powers, ordinates.noise)
        less = trial.distortion <= constants.LESS_DISTORTED * best.distortion
        if less and _gain(trial, best) > 0 and _is_admissible(trial, best):
            best = trial
    return best if best is state else _grow(_shrink(best))


def _without_outliers(larger: _State, smaller: _State) -> _State:
    """Remove lines that a mode narrower than their distance explains, unless others need it."""
    keep = _wide_enough(larger)
    if keep.all():
        return larger
    without = _without_lines(larger, keep)
    if larger.ordinates.periodic and _gain(without, _without_lines(smaller, keep)) > 0:
        return larger
    return without


def _larger(state: _State) -> list[tuple[FloatArray, Powers]]:
    """Return models with a further mode or two further powers that may be worth a fit."""
    ordinates, theta, (low, high), n = state.ordinates, state.theta, state.powers, state.n_modes
    larger: list[tuple[FloatArray, Powers]] = []
    if low > -_MOST_POWERS:
        larger.append((theta, (low - _POWER_STEP, high)))
    if high < _MOST_POWERS:
        larger.append((theta, (low, high + _POWER_STEP)))
    profile = state.poles.at.profile
    gains = [
        2 * (profile - _solve(ordinates, *order, state.variance).poles.at.profile)
        for order in larger
    ]
    if n < constants.FRF_MOST_MODES:
        f, zeta, gain = best_pole(state.poles, *_places(ordinates))
        larger.append((np.insert(theta, [n, 2 * n], np.log([f, zeta])), state.powers))
        gains.append(2 * gain)
    return [order for order, gain in zip(larger, gains, strict=True) if gain > _WORTH]


def _places(ordinates: Ordinates) -> tuple[FloatArray, FloatArray]:
    """Return frequencies in Hz and damping ratios at which a further mode is tried."""
    low, high = ordinates.frequency[[0, -1]].tolist()
    grids = [np.geomspace(low, high, 2 + int(np.log(high / low) / z)) for z in _TRIED_DAMPING]
    zeta = [
        np.clip(ordinates.spacing / f, z, _MOST_DAMPING)
        for z, f in zip(_TRIED_DAMPING, grids, strict=True)
    ]
    return np.concatenate(grids), np.concatenate(zeta)


def _is_admissible(trial: _State, before: _State) -> bool:
    """Return whether modes are not one distorted resonance, and not an end of the band."""
    narrow = ~_wide_enough(trial)
    # A mode narrower than a line at an end of the band represents one outside.
    if narrow[:_END].any() or narrow[-_END:].any():
        return False
    # Each mode within a half-power bandwidth of others must reduce the distortion.
    if not (crowded := _crowded(trial)):
        return True
    further = max(1, crowded - _crowded(before))
    return trial.distortion <= constants.LESS_DISTORTED**further * before.distortion


def _crowded(state: _State) -> int:
    """Count modes within a half-power bandwidth of one below."""
    f, zeta = state.modes
    width = (zeta * f)[order := np.argsort(f)]
    near = np.abs(f[order][:, None] - f[order]) < np.maximum.outer(width, width)
    return int(np.count_nonzero(np.triu(near, 1).any(axis=0)))


def _wide_enough(state: _State) -> BoolArray:
    """Return which lines are not the centre of a mode that is narrower than their distance."""
    f, zeta = state.modes
    frequency = state.ordinates.frequency
    is_narrow = 2 * zeta * f < state.ordinates.spacing
    if state.ordinates.periodic:
        inside = np.abs(frequency[:, None] - f) <= constants.BANDWIDTHS_OF_LINES * zeta * f
        is_narrow &= inside.sum(axis=0) < constants.LINES_OF_MODE
    narrow = f[is_narrow]
    keep = np.ones(frequency.size, dtype=bool)
    keep[np.argmin(np.abs(frequency[:, None] - narrow), axis=0)] = False
    return keep


def _shrink(state: _State) -> _State:
    """Remove modes that the others have made superfluous; correlated errors reduce their gain."""
    while n := state.n_modes:
        trials = [
            _settle(state.ordinates, np.delete(state.theta, [i, i + n]), state.powers,
                    state.variance)
            for i in range(n)
        ]  # fmt: skip
        gains = [_gain(state, trial, state.dependent_lines) for trial in trials]
        if min(gains) > 0:
            break
        state = trials[int(np.argmin(gains))]
    return state


def _conclude(state: _State, everything: Ordinates) -> ResponseFit:
    """Collect estimates with their covariance, modes ascending."""
    ordinates, m = state.ordinates, state.n_modes
    rank = np.argsort(state.theta[:m], kind="stable")
    both = paired(rank, m)
    noise_cov, cov, credibility = _covariances(state)
    f, zeta = state.modes
    peak = np.abs(state.residues * ordinates.spacing / (2 * np.pi * zeta * f)) ** 2
    level = state.variance / np.abs(ordinates.given) ** 2
    distortion = state.distortion**2 * np.interp(f, ordinates.frequency, state.parts)
    over = np.divide(peak, distortion, out=np.full(m, np.inf), where=distortion > 0)
    outlying = ~np.isin(everything.frequency, ordinates.frequency)
    expected = np.interp(everything.frequency, ordinates.frequency, state.response)
    error = (everything.answer - everything.given * expected)[outlying]
    excess = np.sum(np.abs(state.error) ** 2 / ordinates.noise)
    excess /= state.variance.size - _unknowns(ordinates, state.theta, state.powers) / 2
    if not (ordinates.scatter or ordinates.transient):
        ordinates = replace(ordinates, noise=state.variance)
    return ResponseFit(
        ordinates=ordinates,
        outliers=np.column_stack([everything.frequency[outlying], np.abs(error)]),
        estimate=state.theta[both],
        cov=cov[np.ix_(both, both)],
        credibility=tuple(credibility[i] for i in rank),
        noise_cov=noise_cov[np.ix_(both, both)],
        snr=(peak / np.interp(f, ordinates.frequency, level))[rank],
        over_distortion=over[rank],
        response=state.response,
        chi_square=float(excess) if ordinates.scatter else float("nan"),
        distortion=state.distortion,
        colour=state.colour,
    )


def _covariances(state: _State) -> tuple[FloatArray, FloatArray, tuple[Credibility, ...]]:
    """Return the covariance of ``[ln f, ln ζ]`` by noise, and by noise and distortion.

    The factors of the second on that of a known variance and independent lines are returned, too.
    """
    ordinates, lines = state.ordinates, state.dependent_lines
    slope = np.sqrt(2) * state.poles.at.fits[0].tangent[:, :, 0].T
    prior = np.eye(slope.shape[1]) / _PRIOR_STD**2
    inverse = np.asarray(np.linalg.inv(slope.T @ slope + prior), dtype=np.float64)
    if not ordinates.scatter:
        by_noise = inverse * small_sample(min(_NOISE_LINES, state.variance.size))
        error, cov = by_noise, by_noise * lines
    else:
        share = np.tile(ordinates.noise / state.variance, 2)[:, None]
        by_noise = inverse @ (slope.T @ (share * slope) + prior) @ inverse
        by_noise *= small_sample(ordinates.freedom, unbiased=True)
        by_distortion = inverse @ (slope.T @ ((1 - share) * slope)) @ inverse
        f, zeta = state.modes
        own = np.tile(np.sqrt(np.maximum(lines, 2 * zeta * f / ordinates.spacing)), 2)
        error = by_noise + by_distortion
        cov = by_noise * lines + by_distortion * np.outer(own, own)
    credibility = (Credibility(),) * state.n_modes
    credibility = widened(credibility, "noise-estimate", inverse, error)
    return by_noise, cov, widened(credibility, "dependent-lines", error, cov)
