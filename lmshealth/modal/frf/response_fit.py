"""Fit the modes of a response: how many there are, how large the error is, how sure they are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from lmshealth._arrays import BoolArray, ComplexArray, FloatArray, freeze
from lmshealth.modal.frf.rational import (
    HEAVY,
    Order,
    Ordinates,
    Solution,
    best_place,
    refine,
    slopes,
    solve,
)
from lmshealth.modal.frf.responses import smooth_noise

_MOST_MODES = 8
# Powers of s beside the modes, downwards and upwards. Modes beside the band, too weak for a power
# to show by itself, bias those in it by up to one standard deviation where four are fitted, by
# half of one where six are; that costs a few percent of it. Powers enter in twos: an even one for
# what is elastic, an odd one for what is lost.
_FEWEST_POWERS, _MOST_POWERS, _POWER_STEP = 6, 8, 2
# Gain in -2 ln L that a mode needs beyond the Bayesian information criterion: a place for it is
# searched for, and the best of many places gains by chance. A background, of powers and of poles
# damped too heavily to be modes, needs less (Akaike's criterion, per unknown): nobody reads it,
# and what it lacks, too weak to be seen, would bias the modes by more than it costs.
_EVIDENCE_MARGIN = 10.0
_BACKGROUND_COSTS = 2.0
# Lines over which the noise of a record that does not repeat is averaged.
_NOISE_LINES = 41
# Gain in -2 ln L before anything else has moved, from which on a larger model is fitted.
_WORTH = 2.0
# Gain in -2 ln L from which on a distortion is believed: 1 % of linear responses show as much.
_DISTORTED = 6.6
# Two modes within a half-power bandwidth are believed where they leave so much less distortion.
_LESS_DISTORTED = 1 / 3
# Lines of an end of the band.
_END = 3
_ROUNDS = 4
# Standard deviation of ln f and ln ζ before anything is measured: what data say nothing about stays
# as unknown as that, and leaves all else as it is.
_PRIOR_STD = 10.0
# Probability that noise alone gives an outlier somewhere, and share of lines that may be outliers.
_FALSE_ALARM, _MOST_OUTLIERS = 1e-3, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class ResponseFit:
    """A rational transfer function with its uncertainty.

    Attributes
    ----------
    ordinates : Ordinates
        The lines it was fitted to; outliers are not among them.
    outliers : ndarray
        Frequency in Hz and amplitude, in the unit of the output, of lines that are no answer to
        the input, shape ``(n_outliers, 2)``.
    estimate : ndarray
        ``[ln f, ln ζ]``, shape ``(2 n_modes,)``, modes ascending in frequency.
    cov : ndarray
        Their covariance, residues and residual terms marginalised, shape
        ``(2 n_modes, 2 n_modes)``.
    noise_cov : ndarray
        The part of it by noise alone: how estimates scatter when the same is recorded again.
    snr : ndarray
        Power of each mode's response at its resonance over that of noise and distortion in one
        line, shape ``(n_modes,)``.
    over_distortion : ndarray
        The same over that of the distortion alone; infinite where there is none.
    response : ndarray of complex
        The fitted response at the lines.
    chi_square : float
        Mean squared error over the variance of the noise, corrected for what was fitted: about
        one where nothing but noise keeps the response from being rational. NaN where the noise is
        not known by itself: without periods.
    distortion : float
        Error as a share of the response beyond the noise: by a nonlinearity or a lacking term.
    colour : float
        Correlation of the whitened errors of neighbouring lines, where it is beyond chance.
    """

    ordinates: Ordinates
    outliers: FloatArray
    estimate: FloatArray
    cov: FloatArray
    noise_cov: FloatArray
    snr: FloatArray
    over_distortion: FloatArray
    response: ComplexArray
    chi_square: float
    distortion: float
    colour: float

    def __post_init__(self) -> None:
        freeze(self)


def fit_response(ordinates: Ordinates) -> ResponseFit:
    """Fit poles, residues and residual terms to the response of a band.

    Modes enter one by one where the error left shows them best, powers of s at either end, as
    long as an information criterion gains; a mode that others have made superfluous leaves again.

    Noise of a periodic excitation is known from the scatter over periods. An error beyond it is
    taken to be a share of each part of the response, random in phase, as that of a weak
    nonlinearity under a random multisine is; the share is found by maximum likelihood and its
    variance added. Otherwise the noise is what is left over, averaged over neighbouring lines.

    The covariance is that of the Fisher information, widened where errors of neighbouring lines
    are found to be alike; those of a distortion are taken to be within a half-power bandwidth.

    Parameters
    ----------
    ordinates : Ordinates
        Of a band.

    Returns
    -------
    ResponseFit
        Without modes where none improves it.

    References
    ----------
    Pintelon2012
    """
    start = Order(np.empty(0), -_FEWEST_POWERS, _FEWEST_POWERS)
    state = _grow(_settle(ordinates, start, ordinates.noise))
    for _ in range(_ROUNDS):
        keep = _credible(state)
        if keep.all() or keep.sum() < (1 - _MOST_OUTLIERS) * ordinates.frequency.size:
            break
        state = _grow(_left(state, keep))
    state = _shrink(state)
    state = _settle(state.ordinates, state.order, state.variance, _ROUNDS)
    return _conclude(state, ordinates)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """An order at its maximum of likelihood, with the variance that it leaves."""

    ordinates: Ordinates
    order: Order
    variance: FloatArray
    distortion: float
    solution: Solution

    @property
    def white(self) -> ComplexArray:
        """Whitened error of the response: in phase with the input, which may change by line."""
        given = self.ordinates.given
        turn = np.abs(given) / np.where(given == 0, 1, given)
        return np.asarray(self.solution.error * turn / np.sqrt(self.variance))

    @property
    def cost(self) -> float:
        """Twice the negative log likelihood."""
        return 2 * float(np.sum(np.log(self.variance) + np.abs(self.white) ** 2))

    @property
    def colour(self) -> float:
        """Correlation of neighbouring errors where it is beyond chance, by three of its std."""
        white = self.white
        n = white.size
        found = np.sum((white[1:] * white[:-1].conj()).real) / np.sum(np.abs(white) ** 2)
        return float(found) if found > 3 / np.sqrt(2 * n) else 0.0

    @property
    def alike(self) -> float:
        """So many lines are worth one that is independent."""
        return (1 + self.colour) / (1 - self.colour)

    @property
    def penalty(self) -> float:
        """What modes and background must gain to be worth it."""
        order = self.order
        each = 4 if self.ordinates.periodic else 6
        heavy = int(np.count_nonzero(order.modes[1] > HEAVY))
        modes = each * np.log(2 * self.variance.size) + _EVIDENCE_MARGIN
        background = _BACKGROUND_COSTS * (each * heavy + order.high - order.low)
        return float((order.n_modes - heavy) * modes + background)


def _gain(larger: _State, smaller: _State) -> float:
    """Tell by how much the larger of two models is the better one."""
    return smaller.cost - larger.cost - larger.penalty + smaller.penalty


def _settle(ordinates: Ordinates, order: Order, variance: FloatArray, rounds: int = 2) -> _State:
    """Find poles and variance of greatest likelihood, turn by turn."""
    for _ in range(rounds):
        order = refine(ordinates, order, variance)
        solution = solve(ordinates, order, variance)
        before = variance
        variance, distortion = _left_over(ordinates, order, solution)
        if np.abs(np.log(variance / before)).max() < 0.05:
            break
    solution = solve(ordinates, order, variance)
    return _State(ordinates, order, variance, distortion, solution)


def _left_over(ordinates: Ordinates, order: Order, solution: Solution) -> tuple[FloatArray, float]:
    """Variance of the error of each line, and the share of the response that is distortion."""
    n = solution.error.size
    # What is fitted takes some of the error along.
    power = np.abs(solution.error) ** 2 * (n / (n - order.unknowns(ordinates.periodic) / 2))
    if not ordinates.periodic:
        return smooth_noise(power, solution.parts, _NOISE_LINES), 0.0
    parts = solution.parts * np.abs(ordinates.given) ** 2

    def cost(ln_share: float) -> float:
        total = ordinates.noise + np.exp(ln_share) * parts
        return 2 * float(np.sum(np.log(total) + power / total))

    found = minimize_scalar(cost, bounds=(np.log(1e-12), 0.0), method="bounded")
    if cost(-np.inf) - found.fun < _DISTORTED:
        return ordinates.noise, 0.0
    share = float(np.exp(found.x))
    return ordinates.noise + share * parts, float(np.sqrt(share))


def _left(state: _State, keep: BoolArray) -> _State:
    """Leave lines out."""
    return _settle(state.ordinates.only(keep), state.order, state.variance[keep])


def _credible(state: _State) -> BoolArray:
    """Tell which lines answer the input; next to an outlier of a record none does."""
    # Over a variance from ν degrees of freedom the error has heavier tails: (1 + x/ν)^-ν.
    freedom = state.ordinates.freedom if state.ordinates.periodic else _NOISE_LINES
    rare = (state.white.size / _FALSE_ALARM) ** (1 / freedom)
    odd = np.abs(state.white) ** 2 > freedom * (rare - 1)
    if not state.ordinates.periodic:
        return np.asarray(np.convolve(odd, np.ones(5), mode="same") == 0)
    # A distorted resonance has lines of its own that are far off.
    f, zeta = state.order.modes
    near = np.abs(state.ordinates.frequency[:, None] - f) < 2 * zeta * f
    distorted = state.variance > 2 * state.ordinates.noise
    return np.asarray(~odd | (distorted & near.any(axis=1)))


def _grow(state: _State) -> _State:
    """Add modes and powers as long as the criterion gains."""
    fewest = (1 - _MOST_OUTLIERS) * state.variance.size
    while True:
        trials = [
            _settle(state.ordinates, order, state.variance)
            for order in _larger(state)
            if order.unknowns(state.ordinates.periodic) < state.variance.size
        ]
        gains = [_gain(t, state) if _is_meant(t, state) else -np.inf for t in trials]
        if not gains or max(gains) <= 0:
            return state
        best = trials[int(np.argmax(gains))]
        keep = _wide_enough(best)
        if keep.sum() < fewest:
            return state
        state = best if keep.all() else _left(state, keep)


def _larger(state: _State) -> list[Order]:
    """List models of one mode or one power more that may be worth a fit."""
    ordinates, order = state.ordinates, state.order
    larger = []
    if order.low > -_MOST_POWERS:
        larger.append(replace(order, low=order.low - _POWER_STEP))
    if order.high < _MOST_POWERS:
        larger.append(replace(order, high=order.high + _POWER_STEP))
    error = np.sum(np.abs(state.white) ** 2)
    gains = [
        2 * float(error - np.sum(np.abs(solution.error) ** 2 / state.variance))
        for solution in (solve(ordinates, o, state.variance) for o in larger)
    ]
    if order.n_modes < _MOST_MODES:
        f, zeta, gain = best_place(ordinates, state.variance, state.solution)
        larger.append(order.with_mode(f, zeta))
        gains.append(gain)
    return [o for o, gain in zip(larger, gains, strict=True) if gain > _WORTH]


def _is_meant(trial: _State, before: _State) -> bool:
    """Tell whether modes are more than one distorted resonance, and more than a band's end.

    Modes within a half-power bandwidth must leave much less distortion. What is narrower than a
    line at an end of the band stands for a mode beyond it.
    """
    narrow = ~_wide_enough(trial)
    if narrow[:_END].any() or narrow[-_END:].any():
        return False
    f, zeta = trial.order.modes
    half = zeta * f
    near = np.abs(f[:, None] - f) < np.maximum(half[:, None], half)
    if near.sum() == f.size:
        return True
    return trial.distortion <= _LESS_DISTORTED * before.distortion


def _wide_enough(state: _State) -> BoolArray:
    """Tell which lines are not what a mode of less than a line's width stands for."""
    f, zeta = state.order.modes
    frequency = state.ordinates.frequency
    narrow = f[2 * zeta * f < state.ordinates.spacing]
    keep = np.ones(frequency.size, dtype=bool)
    keep[np.argmin(np.abs(frequency[:, None] - narrow), axis=0)] = False
    return keep


def _shrink(state: _State) -> _State:
    """Leave out modes that the others have made superfluous.

    Errors that are alike in neighbouring lines tell less than independent ones: what a mode gains
    counts by as much less.
    """
    while state.order.n_modes:
        trials = [
            _settle(state.ordinates, state.order.without_mode(i), state.variance)
            for i in range(state.order.n_modes)
        ]
        gains = [(t.cost - state.cost) / state.alike - state.penalty + t.penalty for t in trials]
        if min(gains) > 0:
            break
        state = trials[int(np.argmin(gains))]
    return state


def _conclude(state: _State, everything: Ordinates) -> ResponseFit:
    """Collect estimates with their covariance, modes ascending."""
    ordinates, order, solution = state.ordinates, state.order, state.solution
    m, n = order.n_modes, state.variance.size
    rank = np.argsort(order.theta[:m], kind="stable")
    both = np.concatenate([rank, rank + m])
    noise_cov, cov = _covariances(state)
    f, zeta = order.modes
    centre = np.sqrt(ordinates.frequency[0] * ordinates.frequency[-1])
    peak = np.abs(solution.residues / (zeta * f / centre)) ** 2
    level = state.variance / np.abs(ordinates.given) ** 2
    twisted = state.distortion**2 * np.interp(f, ordinates.frequency, solution.parts)
    clear = np.divide(peak, twisted, out=np.full(m, np.inf), where=twisted > 0)
    lost = ~np.isin(everything.frequency, ordinates.frequency)
    expected = np.interp(everything.frequency, ordinates.frequency, solution.response)
    strange = (everything.answer - everything.given * expected)[lost]
    excess = np.sum(np.abs(solution.error) ** 2 / ordinates.noise)
    excess /= n - order.unknowns(ordinates.periodic) / 2
    return ResponseFit(
        ordinates=ordinates,
        outliers=np.column_stack([everything.frequency[lost], np.abs(strange)]),
        estimate=order.theta[both],
        cov=cov[np.ix_(both, both)],
        noise_cov=noise_cov[np.ix_(both, both)],
        snr=(peak / np.interp(f, ordinates.frequency, level))[rank],
        over_distortion=clear[rank],
        response=solution.response,
        chi_square=float(excess) if ordinates.periodic else float("nan"),
        distortion=state.distortion,
        colour=state.colour,
    )


def _covariances(state: _State) -> tuple[FloatArray, FloatArray]:
    """Covariance of ``[ln f, ln ζ]`` by noise, and by all there is.

    Weights from variances of ν degrees of freedom cost (ν - 1)/(ν - 2). Errors that are alike in
    neighbouring lines count for fewer. Distortion is not taken to be independent from line to line
    even where it looks so: within a half-power bandwidth it may bend a resonance one way, as a
    spring that depends on position does, so that its lines there count as one.
    """
    ordinates = state.ordinates
    slope = slopes(ordinates, state.order, state.variance, state.solution)
    prior = np.eye(slope.shape[1]) / _PRIOR_STD**2
    inverse = np.asarray(np.linalg.inv(slope.T @ slope + prior), dtype=np.float64)
    if not ordinates.periodic:
        freedom = min(_NOISE_LINES, state.variance.size)
        by_noise = inverse * (freedom / (freedom - 2))
        return by_noise, by_noise * state.alike
    share = np.tile(ordinates.noise / state.variance, 2)[:, None]
    by_noise = inverse @ (slope.T @ (share * slope) + prior) @ inverse
    by_noise *= (ordinates.freedom - 1) / (ordinates.freedom - 2)
    by_distortion = inverse @ (slope.T @ ((1 - share) * slope)) @ inverse
    f, zeta = state.order.modes
    lines = np.tile(np.sqrt(np.maximum(state.alike, 2 * zeta * f / ordinates.spacing)), 2)
    return by_noise, by_noise * state.alike + by_distortion * np.outer(lines, lines)
