"""Length and number of logs that detect a loss of health (README.md: Planning)."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri

from lmshealth.errors import BadQuestion
from lmshealth.stage.description import Stage
from lmshealth.stage.identifiability import LONGEST, MOST_LOGS, Identifiability, identifiability_of

DURATIONS = (10.0, 20.0, 60.0, 120.0, 300.0, 600.0)

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

    Examples
    --------
    How long must one log be to see that a twentieth of the preload is lost?

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
    test = _Test(power, false_alarm)
    information = identifiability_of(stage)
    j = _asked(stage, parameter, loss)
    _expect_shown(stage, information, j)
    size = -np.log1p(-loss)

    def power_of(duration: float, n_logs: int) -> float:
        return test.power(size, information.std(j, information.drift_variance(duration, n_logs)))

    seconds = range(max(1, int(np.ceil(information.least_duration))), LONGEST + 1)
    place = bisect_left(seconds, power, key=lambda duration: power_of(duration, 1))
    return Plan(
        parameter=parameter,
        loss=loss,
        power=power,
        false_alarm=false_alarm,
        n_baseline=information.n_baseline,
        efforts=tuple(_effort(information, j, test, size, duration) for duration in durations),
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


def _asked(stage: Stage, parameter: str, loss: float) -> int:
    """Find the parameter, and refuse a loss that is none or lies beyond the map."""
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
    stage.drift(lost[None], stage.informative)  # the map refuses what lies beyond its grid
    return j


def _expect_shown(stage: Stage, information: Identifiability, j: int) -> None:
    """Refuse a parameter of which even endless logs would tell less than its prior does.

    Then only the map's own error is left, in what the other parameters do to the modes.
    """
    cov = np.linalg.inv(information.precision(information.limiting_variance()))
    # Half of the prior's variance would be left: results call that not told by the data.
    if cov[j, j] < information.prior[j] / 2:
        return
    name = information.parameters[j]
    moved = ", ".join(
        f"{mode.name} {slope:.2g}"
        for mode, slope in zip(information.modes, information.slopes[:, j], strict=True)
    )
    rest = [other for other in information.parameters if other != name]
    raise BadQuestion(
        f"{stage.name}: the modes do not show {name}: ln f moves by so much per ln of it: {moved}. "
        f"Besides what {', '.join(rest) or 'nothing else'} does to them it would be known to "
        f"{100 * np.sqrt(cov[j, j]):.0f} % even from endless logs, the prior alone knows it to "
        f"{100 * np.sqrt(information.prior[j]):.0f} %. Track a mode that depends on it more, or "
        "improve the map"
    )


def _effort(
    information: Identifiability, j: int, test: _Test, size: float, duration: float
) -> Effort:
    if duration < information.least_duration:
        return Effort(duration, None, "too-short")

    def std(n_logs: int, n_baseline: int | None = None) -> float:
        return information.std(j, information.drift_variance(duration, n_logs, n_baseline))

    counts = range(1, MOST_LOGS + 1)
    place = bisect_left(counts, test.wanted, key=lambda n: test.power(size, std(n)))
    hindrance: Hindrance = ""
    if place == len(counts):
        best = test.power(size, std(MOST_LOGS, MOST_LOGS))
        hindrance = "baseline" if best >= test.wanted else "parameters"
    return Effort(
        duration=duration,
        n_logs=None if hindrance else counts[place],
        hindrance=hindrance,
        power=test.power(size, std(1)),
        smallest_loss=test.smallest_loss(std(1)),
        smallest_loss_many=test.smallest_loss(std(information.n_baseline)),
    )
