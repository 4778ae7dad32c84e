"""Duration and number of logs that detect a loss of health (README.md, "Planning")."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri

from lmshealth.errors import BadQuestion
from lmshealth.stage import constants
from lmshealth.stage.description import Stage
from lmshealth.stage.identifiability import Identifiability, identifiability_of

Hindrance = Literal["too-short", "baseline", "parameters", ""]


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
