"""Identifiability of health parameters by the tracked modes, and plans of logs that detect losses.

README.md, "Identifiability" and "Planning".

`ambient_bound` is the Cramér-Rao bound of one mode identified from ambient accelerations in noise.
"""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, Self

import numpy as np
from scipy.special import ndtr, ndtri

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.errors import BadQuestion, BadStage
from lmshealth.stage import constants
from lmshealth.stage.description import ModeSpec, Stage

# Prior standard deviation of the logarithm of the noise level. Without it an ever smaller noise
# would still cost what an unknown part of its spectrum does.
NOISE_STD = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Identifiability:
    """Information of the tracked modes about small changes of the ln health parameters."""

    parameters: tuple[str, ...]
    modes: tuple[ModeSpec, ...]  # tracked modes on the map
    slopes: FloatArray  # d ln f / d ln parameter at the baseline, shape ``(n_modes, n_parameters)``
    prior: FloatArray  # prior variances of the ln parameters, shape ``(n_parameters,)``
    # model_std, common_std, leave_out: relative standard deviations of the map's sensitivities, of
    # each and in common, and error of ln f of its surrogate, shape ``(n_modes,)``.
    model_std: float
    leave_out: FloatArray
    n_baseline: int  # logs of the baseline
    common_std: float = 0.0

    @property
    def least_duration(self) -> float:
        """Duration in s of a log from which every mode can be identified."""
        widths = [2 * mode.damping_ratio * mode.frequency_hz for mode in self.modes]
        return constants.LEAST_RESOLUTION / min(widths)

    def log_variance(self, duration: float) -> FloatArray:
        """Bound the variance of ln f of each mode in one log, shape ``(n_modes,)``."""
        return np.asarray(self.log_std(duration)[0] ** 2)

    def log_std(self, duration: float) -> FloatArray:
        """Bound the standard deviations of ln f and ln ζ in one log, shape ``(2, n_modes)``."""
        return np.sqrt([_bound(mode, duration) for mode in self.modes]).T

    def drift_variance(
        self, duration: float, n_logs: int, n_baseline: int | None = None
    ) -> FloatArray:
        """Bound the variance of the drift of each mode, shape ``(n_modes,)``."""
        return self.log_variance(duration) * (1 / n_logs + 1 / (n_baseline or self.n_baseline))

    def limiting_variance(self) -> FloatArray:
        """Bound the variance of the drifts by unlimited logs, shape ``(n_modes,)``."""
        return self.drift_variance(constants.LONGEST_LOG, constants.MOST_LOGS, constants.MOST_LOGS)

    def restricted_to(self, modes: Sequence[str]) -> Self:
        """Return the identifiability by some of the modes only."""
        rows = [k for k, mode in enumerate(self.modes) if mode.name in modes]
        kept = tuple(self.modes[k] for k in rows)
        return replace(self, modes=kept, slopes=self.slopes[rows], leave_out=self.leave_out[rows])

    def precision(self, noise: FloatArray, *, exact_map: bool = False) -> FloatArray:
        """Return the posterior precision of all ln parameters, Λ⁻¹ + Sᵀ (C + E + c² S Λ Sᵀ)⁻¹ S.

        For variances of the drifts, ``(n_modes,)``; shape ``(n_parameters, n_parameters)``. The
        error of the map grows with the drifts: E, diagonal, and c² S Λ Sᵀ, in common, are those of
        parameters anywhere in their priors, and 0 by an exact map, or for a change close to the
        baseline.
        """
        error = self.model_std**2 * self.slopes**2 @ self.prior + self.leave_out**2
        information = self.slopes.T @ (
            self.slopes / (noise + (0.0 if exact_map else error))[:, None]
        )
        if not exact_map:
            lost = self.common_std**2 * self.prior[:, None] * information
            information = information @ np.linalg.inv(np.eye(self.prior.size) + lost)
        return np.asarray(np.diag(1 / self.prior) + information)

    def std(self, noise: FloatArray, *, exact_map: bool = False) -> FloatArray:
        """Return the posterior standard deviations of the ln parameters, as `precision` does."""
        return np.sqrt(np.diag(np.linalg.inv(self.precision(noise, exact_map=exact_map))))

    def identifiable(self) -> BoolArray:
        """Decide which parameters unlimited logs would inform, shape ``(n_parameters,)``."""
        left = self.std(self.limiting_variance()) ** 2
        return np.asarray(1 - left / self.prior >= constants.INFORMED)

    def change_std(self, noise: FloatArray) -> FloatArray:
        """Return the standard deviations of small changes of the ln parameters.

        Each has no prior of its own; the others have theirs. Shape ``(n_parameters,)``.
        """
        information = self.std(noise, exact_map=True) ** -2 - 1 / self.prior
        with np.errstate(divide="ignore"):
            return np.asarray(np.maximum(information, 0.0) ** -0.5)


def identifiability_of(stage: Stage) -> Identifiability:
    """Linearise the modal map of a stage at the baseline; refuse a description without one."""
    if stage.modal_map is None or stage.description.map is None:
        missing = "no [map], so nothing links health to frequencies"
        raise BadStage(f"{stage.name}: {missing}; describe [[parameter]] and [map]")
    rows = [stage.modal_map.modes.index(name) for name in stage.informative]
    return Identifiability(
        parameters=stage.prior.names,
        modes=tuple(mode for mode in stage.modes if mode.name in stage.informative),
        slopes=stage.modal_map.gradient(stage.baseline_point[None])[0, rows],
        prior=stage.prior.variance,
        model_std=stage.description.map.model_std,
        leave_out=stage.modal_map.leave_out_error[rows],
        n_baseline=stage.description.baseline.logs,
        common_std=stage.description.map.common_std,
    )


@lru_cache(maxsize=1 << 14)
def _bound(mode: ModeSpec, duration: float) -> tuple[float, float]:
    """Bound the variances of ln f and ln ζ in the band that is fitted; infinite by short logs."""
    f, zeta = mode.frequency_hz, mode.damping_ratio
    if 2 * zeta * f * duration < constants.LEAST_RESOLUTION:
        return np.inf, np.inf
    longest = constants.MOST_ORDINATES / (2 * constants.BAND_HALF_WIDTH * zeta * f)
    if duration > longest:
        of_f, of_zeta = _bound(mode, longest)
        return of_f * longest / duration, of_zeta * longest / duration
    band = (f * (1 - constants.BAND_HALF_WIDTH * zeta), f * (1 + constants.BAND_HALF_WIDTH * zeta))
    of_f, of_zeta = np.diag(ambient_bound(f, zeta, mode.snr, duration, band=band)).tolist()
    return of_f, of_zeta


def ambient_bound(
    frequency: float,
    damping_ratio: float,
    snr: float,
    duration: float,
    *,
    band: tuple[float, float],
    n_channels: int = 1,
) -> FloatArray:
    """Bound the covariance of [ln f, ln ζ], ``(2, 2)``, by ambient accelerations in white noise.

    Of the channels' covariance S D φφᵀ + S_e I one eigenvalue is S D + S_e and all others are S_e:
    further channels inform about the noise, and about the mode only by the sum of their SNR. See
    [Au2014].

    The natural frequency is in Hz, the modal signal-to-noise ratio S / (4 ζ² S_e) summed over the
    channels, the duration of the record in s: for n records of one length divide the result by n.
    In the band (Hz) the noise is white, with one unknown level in all channels.
    """
    f = fourier_frequencies(duration, band)
    beta2 = (frequency / f) ** 2
    damped = 4 * damping_ratio**2 * beta2
    under = (1 - beta2) ** 2 + damped
    modal = 4 * damping_ratio**2 * snr / under
    share = modal / (modal + 1)
    # Derivatives of ln(S D + S_e) by ln f, ln ζ, ln S and ln S_e.
    by_frequency = share * (4 * beta2 * (1 - beta2) - 2 * damped) / under
    slopes = np.stack([by_frequency, -2 * share * damped / under, share, 1 - share])
    fisher = slopes @ slopes.T
    fisher[3, 3] += (n_channels - 1) * f.size + NOISE_STD**-2
    return marginal_covariance(fisher, 2)


def fourier_frequencies(duration: float, band: tuple[float, float]) -> FloatArray:
    """List the Fourier frequencies in Hz within a band, zero excluded."""
    low, high = band
    return np.arange(max(1.0, np.ceil(low * duration)), np.floor(high * duration) + 1) / duration


def marginal_covariance(fisher: FloatArray, n: int) -> FloatArray:
    """Invert an information matrix for its first ``n`` parameters, the others unknown."""
    scale = np.sqrt(np.diag(fisher))
    inverse = np.linalg.inv(fisher / np.outer(scale, scale))
    return np.asarray((inverse / np.outer(scale, scale))[:n, :n])


Hindrance = Literal["too-short", "baseline", "parameters", ""]


# Plans


@dataclass(frozen=True, slots=True)
class Effort:
    """Detection by logs of one duration."""

    duration: float  # of each log in s
    n_logs: int | None  # least number of logs now that reaches the power
    # Why no number does: logs ``too-short`` for identification; the ``baseline``, where a longer
    # one would do; other ``parameters`` that change the modes alike.
    hindrance: Hindrance
    power: float = np.nan  # of one log now; NaN, as the others, for logs too short
    # Smallest fraction lost that is detected with the required power, by one log now and by as many
    # as the baseline has.
    smallest_loss: float = np.nan
    smallest_loss_many: float = np.nan
    # Standard deviation of the ln parameter anywhere in its prior, by as many logs as the baseline
    # has, with the error of the map: as `lmshealth stage` has it.
    value_std: float = np.nan


@dataclass(frozen=True, slots=True)
class Plan:
    """Logs that detect the loss of one parameter."""

    parameter: str
    loss: float  # fraction of its baseline value that is lost
    power: float  # probability to detect this loss
    false_alarm: float  # probability to detect one where there is none
    n_baseline: int  # logs of the baseline, of the same duration as those now
    efforts: tuple[Effort, ...]  # one per duration
    # Least whole seconds from which one log now reaches the power; None where an hour does not.
    duration_of_one: int | None


def plan(
    stage: Stage,
    parameter: str,
    loss: float,
    *,
    power: float = 0.95,
    false_alarm: float = 0.01,
    durations: Sequence[float] = constants.DURATIONS,
) -> Plan:
    """Plan the logs that detect the loss of a health parameter.

    Parameters
    ----------
    stage : Stage
        Modes with their modal SNR, modal map, priors, and number of logs of the baseline.
    parameter, loss : str, float
        Name of the parameter, and fraction of its baseline value that is lost.
    power, false_alarm : float
        Required probability to detect the loss, and probability to detect one where there is none.
    durations : sequence of float
        Durations of logs in s to compare.

    Raises
    ------
    BadStage, OutsideMap
        If the description has no map, or priors outside of it; if it does not reach to the loss.
    BadQuestion
        If there is no such parameter, the modes do not identify it, or a number is out of range.

    References
    ----------
    Au2014

    Examples
    --------
    Duration of one log that detects the loss of a twentieth of the preload:

    >>> import lmshealth
    >>> stage = lmshealth.load_stage("lms-y")
    >>> found = lmshealth.plan(stage, "guide_preload", 0.05)
    >>> found.duration_of_one, found.n_baseline
    (12, 5)
    >>> for effort in found.efforts[:2]:
    ...     print(f"{effort.duration:.0f} s: {effort.n_logs} of them, {effort.power:.0%} for one")
    10 s: 2 of them, 91% for one
    20 s: 1 of them, 100% for one
    """
    if not 0 < false_alarm < power < 1:
        raise BadQuestion(
            f"power {power:g} at false-alarm probability {false_alarm:g}: needed 0 < false alarm "
            "< power < 1, for example 0.95 at 0.01"
        )
    for duration in durations:
        if not 0 < duration < np.inf:
            raise BadQuestion(f"a log of {duration:g} s: needed a finite duration above 0")
    information = identifiability_of(stage)
    j = _index(stage, parameter, loss)
    _expect_identifiable(stage, information, j)
    test = _OneSidedTest(information, j, -np.log1p(-loss), power, false_alarm)
    seconds = range(max(1, int(np.ceil(information.least_duration))), constants.LONGEST_LOG + 1)
    place = bisect_left(seconds, power, key=lambda duration: test.power(duration, 1))
    efforts = tuple(test.effort(duration) for duration in durations)
    shortest = seconds[place] if place < len(seconds) else None
    return Plan(parameter, loss, power, false_alarm, information.n_baseline, efforts, shortest)


@dataclass(frozen=True, slots=True)
class _OneSidedTest:
    """One-sided test of a change of one ln parameter by Gaussian estimates of logs."""

    information: Identifiability
    index: int  # of the parameter
    size: float  # of the loss in the ln parameter
    required: float  # power
    false_alarm: float

    def std(self, duration: float, n_logs: int, n_baseline: int | None = None) -> float:
        """Return the standard deviation of the change."""
        noise = self.information.drift_variance(duration, n_logs, n_baseline)
        return float(self.information.change_std(noise)[self.index])

    def power(self, duration: float, n_logs: int, n_baseline: int | None = None) -> float:
        """Return the probability to detect the loss."""
        std = self.std(duration, n_logs, n_baseline)
        return float(ndtr(self.size / std + ndtri(self.false_alarm)))

    def effort(self, duration: float) -> Effort:
        """Return what logs of one duration detect."""
        if duration < self.information.least_duration:
            return Effort(duration, None, "too-short")
        counts = range(1, constants.MOST_LOGS + 1)
        place = bisect_left(counts, self.required, key=lambda n: self.power(duration, n))
        hindrance: Hindrance = ""
        if place == len(counts):
            best = self.power(duration, constants.MOST_LOGS, constants.MOST_LOGS)
            hindrance = "baseline" if best >= self.required else "parameters"
        n_logs, many = None if hindrance else counts[place], self.information.n_baseline
        noise = self.information.drift_variance(duration, many)
        value_std = float(self.information.std(noise)[self.index])
        gap = float(ndtri(self.required) - ndtri(self.false_alarm))
        power = self.power(duration, 1)
        one, more = (float(-np.expm1(-self.std(duration, n) * gap)) for n in (1, many))
        return Effort(duration, n_logs, hindrance, power, one, more, value_std)


def _index(stage: Stage, parameter: str, loss: float) -> int:
    """Return the index of the parameter; refuse a loss out of range or outside the map."""
    names = [p.name for p in stage.parameters]
    if parameter not in names:
        raise BadQuestion(f"{stage.name}: no parameter {parameter!r}; there are {names}")
    if not 0 < loss < 1:
        needed = "needed is the fraction lost, between 0 and 1: 0.05 for 5 %"
        raise BadQuestion(f"{parameter}={loss:g}: {needed}")
    j = names.index(parameter)
    lost = stage.baseline_point.copy()
    lost[j] += np.log1p(-loss)
    stage.drift(lost[None], stage.informative)  # the map refuses points outside its grid
    return j


def _expect_identifiable(stage: Stage, information: Identifiability, j: int) -> None:
    """Refuse a parameter that even unlimited logs do not inform."""
    left = information.std(information.limiting_variance())[j] ** 2
    if left < (1 - constants.INFORMED) * information.prior[j]:
        return
    name = information.parameters[j]
    pairs = zip(information.modes, information.slopes[:, j], strict=True)
    slopes = ", ".join(f"{mode.name} {slope:.2g}" for mode, slope in pairs)
    rest = [other for other in information.parameters if other != name]
    raise BadQuestion(
        f"{stage.name}: the modes do not identify {name}. Its sensitivities d ln f / d ln {name} "
        f"are: {slopes}. With {', '.join(rest) or 'no other parameter'} unknown, its standard "
        f"deviation is {100 * np.sqrt(left):.0f} % even after unlimited logs, and "
        f"{100 * np.sqrt(information.prior[j]):.0f} % in the prior. Track a mode that depends on "
        "it more, or improve the map"
    )
