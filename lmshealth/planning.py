"""Planning: how long and how many logs must be, for a loss of health to be seen.

Two groups of logs are compared, those of now and those of the baseline, all of one length T. The
drifts δ of the modes between them have the covariance C = R(T) (1/N + 1/N_baseline), where R is the
Cramér-Rao bound of ln f of one log: independent from log to log, and from mode to mode. With the
sensitivities S of the modal map at the baseline, δ = S x + ε for small changes x of the
ln parameters. All parameters but the one asked for, j, are unknown, with the variances Λ of their
priors, and that one is estimated by generalised least squares:

    V = C + S_o Λ_o S_oᵀ,    x̂ = s_jᵀ V⁻¹ δ / (s_jᵀ V⁻¹ s_j),    σ² = 1 / (s_jᵀ V⁻¹ s_j).

A loss is called where x̂ < -z σ, z being the normal quantile that leaves the false-alarm
probability. Its power to see the loss l is then Φ(-ln(1 - l)/σ - z), on average over the priors of
the other parameters.

Neglected, so that a plan is the best that can be had:

- temperature and other covariates, and the random walk of frequencies between logs: both groups of
  logs are to be taken in the same state, and what wanders common to a group is not averaged away;
- that modes whose bands overlap are estimated together: the more alike the channels see them the
  more this costs;
- what identification loses against the bound;
- the bend of the map: S is that of small changes;
- the error of the map (`model_std`). Of the parameter asked for it changes the size that a drift
  is taken for, and with it the smallest loss in proportion, but makes no drift where nothing has
  changed. Of the others it counts once they have moved far themselves; it decides here only whether
  a parameter is shown at all.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri

from lmshealth.arrays import FloatArray
from lmshealth.bandfit import BAND
from lmshealth.bounds import ambient_bound
from lmshealth.errors import BadQuestion, BadStage
from lmshealth.modal import LEAST_RESOLUTION
from lmshealth.stage import ModeSpec, ParameterSpec, Stage

DURATIONS = (10.0, 20.0, 60.0, 120.0, 300.0, 600.0)
# What is more than this is no plan: further logs would add nothing that the baseline lets through.
_MOST_LOGS, _LONGEST = 10_000, 3600
_PRIOR_POINTS = 4096

Hindrance = Literal["too-short", "baseline", "parameters", ""]


@dataclass(frozen=True, slots=True)
class Effort:
    """What logs of one length can do.

    Attributes
    ----------
    duration : float
        Of each log in s.
    n_logs : int or None
        Least number of logs now that has the power; None where none has.
    hindrance : str
        Why none has: ``too-short`` to be identified at all; the ``baseline``, of which a longer
        one would do; the other ``parameters``, which change the modes alike. Else empty.
    power : float
        Of one log now. This and what follows is NaN for logs too short.
    smallest_loss, smallest_loss_many : float
        Fraction lost that is seen with the power asked for: by one log now, and by as many as the
        baseline has.
    """

    duration: float
    n_logs: int | None
    hindrance: Hindrance
    power: float = np.nan
    smallest_loss: float = np.nan
    smallest_loss_many: float = np.nan


@dataclass(frozen=True, slots=True)
class Plan:
    """How to see one parameter's loss.

    Attributes
    ----------
    parameter : str
        Its name.
    loss : float
        Fraction of its baseline value that is lost.
    power, false_alarm : float
        Probabilities to call a loss where there is this one, and where there is none.
    n_baseline : int
        Logs of the baseline, each as long as those of now.
    efforts : tuple of Effort
        One per length of logs.
    duration_of_one : int or None
        Least whole seconds at which one log now has the power; None where an hour has not.
    """

    parameter: str
    loss: float
    power: float
    false_alarm: float
    n_baseline: int
    efforts: tuple[Effort, ...]
    duration_of_one: int | None


def plan(
    stage: Stage,
    parameter: str,
    loss: float,
    *,
    power: float = 0.95,
    false_alarm: float = 0.01,
    durations: Sequence[float] = DURATIONS,
) -> Plan:
    """Plan the logs by which a loss of a health parameter is seen.

    Parameters
    ----------
    stage : Stage
        Modes with their modal SNR, modal map, priors, and number of logs of the baseline.
    parameter : str
        Which parameter.
    loss : float
        Fraction of its baseline value that is lost.
    power : float
        Probability wanted to see it.
    false_alarm : float
        Probability to call a loss where there is none.
    durations : sequence of float
        Lengths of logs in s to compare.

    Returns
    -------
    Plan

    Raises
    ------
    BadStage
        If the description has no map, or priors outside of it.
    BadQuestion
        If there is no such parameter, the modes do not show it, or a number is out of range.
    OutsideMap
        If the map does not reach to the loss.

    References
    ----------
    Au2014
    """
    test = _Test(power, false_alarm)
    view = _view(stage, parameter, loss)
    view.expect_shown(stage)
    size = -np.log1p(-loss)

    def power_of(duration: float, n_logs: int) -> float:
        return test.power(size, view.std(view.drift_variance(duration, n_logs)))

    seconds = range(max(1, int(np.ceil(view.least_duration))), _LONGEST + 1)
    place = bisect_left(seconds, power, key=lambda duration: power_of(duration, 1))
    return Plan(
        parameter=parameter,
        loss=loss,
        power=power,
        false_alarm=false_alarm,
        n_baseline=view.n_baseline,
        efforts=tuple(_effort(view, test, size, duration) for duration in durations),
        duration_of_one=seconds[place] if place < len(seconds) else None,
    )


@dataclass(frozen=True, slots=True)
class _Test:
    """A one-sided test of a Gaussian estimate."""

    wanted: float
    false_alarm: float

    def __post_init__(self) -> None:
        if not 0 < self.false_alarm < self.wanted < 1:
            raise BadQuestion(
                f"power {self.wanted:g} at false-alarm probability {self.false_alarm:g}: needed "
                "0 < false alarm < power < 1, for example 0.95 at 0.01"
            )

    def power(self, size: float, std: float) -> float:
        """Probability to call a loss of this size, in ln parameter."""
        return float(ndtr(size / std + ndtri(self.false_alarm)))

    def smallest_loss(self, std: float) -> float:
        """Fraction lost that is called with the power wanted."""
        return float(-np.expm1(-std * (ndtri(self.wanted) - ndtri(self.false_alarm))))


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """One parameter as the modes show it.

    ``own`` and ``others`` are sensitivities d ln f / d ln parameter, shapes ``(n_modes,)`` and
    ``(n_modes, n_others)``, with the variances of ln parameter in the priors.
    """

    parameter: str
    modes: tuple[ModeSpec, ...]
    own: FloatArray
    own_prior: float
    others: FloatArray
    others_prior: FloatArray
    map_error: FloatArray
    least_duration: float
    n_baseline: int
    # Bounds by length of log: many questions are asked of few lengths.
    known: dict[float, FloatArray] = field(default_factory=dict)

    def log_variance(self, duration: float) -> FloatArray:
        """Bound the variance of ln f of each mode in one log, shape ``(n_modes,)``."""
        if duration not in self.known:
            self.known[duration] = np.array([_bound(mode, duration) for mode in self.modes])
        return self.known[duration]

    def drift_variance(
        self, duration: float, n_logs: int, n_baseline: int | None = None
    ) -> FloatArray:
        """Bound the variance of the drift of each mode, shape ``(n_modes,)``."""
        return self.log_variance(duration) * (1 / n_logs + 1 / (n_baseline or self.n_baseline))

    def std(self, noise: FloatArray) -> float:
        """Tell how well drifts with this noise, shape ``(n_modes,)``, estimate ln parameter."""
        cov = np.diag(noise) + (self.others * self.others_prior) @ self.others.T
        information = float(self.own @ np.linalg.solve(cov, self.own))
        return float(1 / np.sqrt(information)) if information > 0 else np.inf

    def expect_shown(self, stage: Stage) -> None:
        """Refuse a parameter of which even endless logs would tell less than its prior does.

        Then only the map's own error is left, in what the other parameters do to the modes.
        """
        endless = self.drift_variance(_LONGEST, _MOST_LOGS, _MOST_LOGS)
        std, prior = self.std(endless + self.map_error), np.sqrt(self.own_prior)
        # Half of the prior's variance would be left: results call that not told by the data.
        if std < prior:
            return
        moved = ", ".join(
            f"{mode.name} {slope:.2g}" for mode, slope in zip(self.modes, self.own, strict=True)
        )
        rest = [p.name for p in stage.parameters if p.name != self.parameter]
        known = f"to {100 * std:.0f} %" if std < 1 else "no better than by guessing"
        raise BadQuestion(
            f"{stage.name}: the modes do not show {self.parameter}: ln f moves by so much per ln "
            f"of it: {moved}. Besides what {', '.join(rest) or 'nothing else'} does to them it "
            f"would be known {known} even from endless logs, the prior alone knows it to "
            f"{100 * prior:.0f} %. Track a mode that depends on it more, or improve the map"
        )


def _view(stage: Stage, parameter: str, loss: float) -> _View:
    if stage.modal_map is None or stage.description.map is None:
        raise BadStage(
            f"{stage.name}: no [map], so nothing links health to frequencies; "
            "describe [[parameter]] and [map]"
        )
    names = [p.name for p in stage.parameters]
    if parameter not in names:
        raise BadQuestion(f"{stage.name}: no parameter {parameter!r}; there are {names}")
    if not 0 < loss < 1:
        raise BadQuestion(
            f"{parameter}={loss:g}: needed is the fraction lost, between 0 and 1: 0.05 for 5 %"
        )
    j = names.index(parameter)
    lost = stage.baseline_point.copy()
    lost[j] += np.log1p(-loss)
    stage.modal_map.ln_frequency(lost[None])  # it refuses what lies beyond its grid
    rows = [stage.modal_map.modes.index(name) for name in stage.informative]
    slopes = stage.modal_map.gradient(stage.baseline_point[None])[0, rows]
    prior = np.array([_prior_variance(stage, k, p) for k, p in enumerate(stage.parameters)])
    others, others_prior = np.delete(slopes, j, axis=1), np.delete(prior, j)
    wrong = stage.description.map.model_std**2 * others**2 @ others_prior
    return _View(
        parameter=parameter,
        modes=tuple(mode for mode in stage.modes if mode.name in stage.informative),
        own=slopes[:, j],
        own_prior=float(prior[j]),
        others=others,
        others_prior=others_prior,
        map_error=wrong + stage.modal_map.leave_out_error[rows] ** 2,
        least_duration=LEAST_RESOLUTION
        / min(2 * mode.damping_ratio * mode.frequency_hz for mode in stage.modes),
        n_baseline=stage.description.baseline.logs,
    )


def _prior_variance(stage: Stage, column: int, parameter: ParameterSpec) -> float:
    """Variance of ln parameter in its prior, which ends where the map does."""
    assert stage.modal_map is not None  # _view() has checked
    levels = (np.arange(_PRIOR_POINTS) + 0.5) / _PRIOR_POINTS
    values = parameter.prior.quantile(levels)
    x = np.log(values[values > 0])
    x = x[(x >= stage.modal_map.low[column]) & (x <= stage.modal_map.high[column])]
    if x.size < 2:
        raise BadStage(
            f"{stage.name}: the prior of {parameter.name} puts almost nothing inside the modal map"
        )
    return float(np.var(x))


def _bound(mode: ModeSpec, duration: float) -> float:
    """Bound the variance of ln f in the band that identification uses."""
    f, zeta = mode.frequency_hz, mode.damping_ratio
    band = (f * (1 - BAND * zeta), f * (1 + BAND * zeta))
    return float(ambient_bound(f, zeta, mode.snr, duration, band=band)[0, 0])


def _effort(view: _View, test: _Test, size: float, duration: float) -> Effort:
    if duration < view.least_duration:
        return Effort(duration, None, "too-short")

    def std(n_logs: int, n_baseline: int | None = None) -> float:
        return view.std(view.drift_variance(duration, n_logs, n_baseline))

    counts = range(1, _MOST_LOGS + 1)
    place = bisect_left(counts, test.wanted, key=lambda n: test.power(size, std(n)))
    hindrance: Hindrance = ""
    if place == len(counts):
        best = test.power(size, std(_MOST_LOGS, _MOST_LOGS))
        hindrance = "baseline" if best >= test.wanted else "parameters"
    return Effort(
        duration=duration,
        n_logs=None if hindrance else counts[place],
        hindrance=hindrance,
        power=test.power(size, std(1)),
        smallest_loss=test.smallest_loss(std(1)),
        smallest_loss_many=test.smallest_loss(std(view.n_baseline)),
    )
