"""What machines of one description teach about a young one: a prior learned from the fleet.

The prior of a stage description is about one machine of a fleet that nobody has seen. A part of its
variance is between fleets, the rest v between the machines of one: in the coordinate z in which the
prior of a law's pace (its life, or its rate) is a standard normal distribution,

    z of a machine ~ N(m, v),   mean m of the fleet ~ N(0, 1 - v),   v ~ U(0, 1),

so that a machine of an unknown fleet has the description's prior, whatever v is. Likewise the
machines of a fleet follow a law with a probability s ~ Beta(k w, k (1 - w)), w being that of the
description and k the number of laws to choose from; and so with the values of the grid of scatter.

The data D of a machine, of which the posterior under the description has draws of z, say of this

    p(D | m, v, s) / p(D) = s P / w E[p(z | m, v) / p(z)] + (1 - s) (1 - P) / (1 - w)

with P the posterior probability of the law and E the mean over its draws. Machines multiply. m, v
and s are integrated over a grid, not maximised, so that few teachers leave the description's prior
nearly as it is. Each law is learned by itself, with all else as the description has it.

References
----------
Gelman2013, chapter 5, for hierarchical models.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import msgspec
import numpy as np
from scipy.special import betainc, logsumexp, softmax

from lmshealth._arrays import FloatArray
from lmshealth._serialize import fingerprint
from lmshealth.prognosis.life_likelihood import scatter_prior
from lmshealth.prognosis.life_posterior import LifePosterior
from lmshealth.prognosis.remaining_life import identifiable_limits
from lmshealth.stage.constants import INFORMED
from lmshealth.stage.degradation_laws import AnyLaw, Law
from lmshealth.stage.description import ScatterPrior, Stage
from lmshealth.stage.priors import Lognormal, Normal

LEAST_TEACHERS = 3
# A law less probable than this is not what a remaining life rests on.
_WORTH = 0.05
# Grid of the mean and of the variance between the machines of a fleet, with its log prior. A fleet
# whose machines are more alike than by a fifth of the prior's width is of no further use.
_MEAN = np.linspace(-3.0, 3.0, 41)[:, None]
_VARIANCE = (np.arange(12) + 0.5) / 12
_LOG_PRIOR = -0.5 * (_MEAN**2 / (1 - _VARIANCE) + np.log(1 - _VARIANCE))
_SHARE_EDGES = np.sin(np.linspace(0, np.pi / 2, 33)) ** 2
# What is learned is told no finer, so that one log more does not change all priors of a fleet.
_DIGITS = 2
# By the field of a law that is the prior of its pace: the natural parameter it is of, and its unit.
_PACES = {"life_km": ("life_m", 1e3), "rate_per_km": ("rate_per_m", 1e-3)}
_N_SCATTER = 500
_SCATTERS = tuple(field.name for field in fields(ScatterPrior))

Pace = Lognormal | Normal


@dataclass(frozen=True, slots=True, eq=False)
class LawEvidence:
    """What a machine says of one of several laws, or values, of which every machine has one.

    Attributes
    ----------
    prior, posterior : float
        Probability that the machine has it, by the description and by its logs.
    pace : ndarray
        Ln likelihood of mean and variance of the fleet if it has, relative to the description's
        prior, shape ``(n_means, n_variances)``, or ``(1, 1)`` where there is no pace to learn.
    """

    prior: float
    posterior: float
    pace: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MachineEvidence:
    """What one machine teaches the others.

    Attributes
    ----------
    laws : dict
        By health parameter, then by kind of law.
    scatter : dict
        By field of `ScatterPrior`, of each value.
    informed : float
        Part of the prior's variance of a law's pace that the logs have removed: the least of all
        laws by which the machine may come to a limit.
    """

    laws: dict[str, dict[str, LawEvidence]]
    scatter: dict[str, tuple[LawEvidence, ...]]
    informed: float


@dataclass(frozen=True, slots=True)
class LawPrior:
    """What is believed of a law beforehand: by the description, then by the fleet.

    Attributes
    ----------
    parameter, kind : str
        Which.
    share : tuple of float
        Probability that a machine follows it.
    field : str
        Which prior of the law is learned: ``life_km`` or ``rate_per_km``; empty for none.
    pace : tuple of prior, or None
        That prior.
    """

    parameter: str
    kind: str
    share: tuple[float, float]
    field: str
    pace: tuple[Pace, Pace] | None


@dataclass(frozen=True, slots=True)
class FleetPrior:
    """The prior that other machines of a fleet have taught a young one.

    Attributes
    ----------
    n_machines : int
        Number of the others.
    laws : tuple of LawPrior
        Of all health parameters.
    scatter : ScatterPrior
        What is believed of the scatter of logs about a life.
    """

    n_machines: int
    laws: tuple[LawPrior, ...]
    scatter: ScatterPrior

    def apply_to(self, stage: Stage) -> Stage:
        """Put the prior into the description; the digest follows from both."""
        known = {(law.parameter, law.kind): law for law in self.laws}
        parameters = tuple(
            msgspec.structs.replace(
                parameter,
                law=tuple(_changed(law, known[parameter.name, law.kind]) for law in parameter.laws),
            )
            for parameter in stage.parameters
        )
        return replace(
            stage,
            description=msgspec.structs.replace(stage.description, parameter=parameters),
            digest=fingerprint(stage.digest, self.laws, self.scatter),
            scatter=self.scatter,
        )


def machine_evidence(stage: Stage, life: LifePosterior) -> MachineEvidence:
    """Say what the logs of a machine teach of its fleet.

    A law that begins anew at a step has the prior of one from the baseline on, and teaches as much.

    Parameters
    ----------
    stage : Stage
        The description itself: by a prior that others have taught their lessons would count twice.
    life : LifePosterior
        Posterior of the machine under it.
    """
    told = {j for j, _ in identifiable_limits(stage, life.modes)}
    laws: dict[str, dict[str, LawEvidence]] = {}
    informed = 1.0
    for j, parameter in enumerate(stage.parameters):
        total = sum(law.weight for law in parameter.laws)
        laws[parameter.name] = {}
        for law in parameter.laws:
            z, weight = _pace_draws(life, j, law)
            after = min(float(weight.sum()), 1.0)
            # What the machine does not follow it says nothing of.
            pace = np.zeros(_LOG_PRIOR.shape if _pace_field(law) else (1, 1))
            if _pace_field(law) and after:
                pace = pace_likelihood(z, weight / after)
                if j in told and after >= _WORTH:
                    informed = min(informed, 1 - float(np.cov(z, aweights=weight)))
            laws[parameter.name][law.kind] = LawEvidence(law.weight / total, after, pace)
    return MachineEvidence(laws, _scatter_heard(stage, life), informed)


def pace_likelihood(z: FloatArray, weight: FloatArray) -> FloatArray:
    """Say how likely the data of a machine are in a fleet, over how likely by the description.

    Parameters
    ----------
    z : ndarray
        Draws of the pace under the description, as its prior makes standard, shape ``(n,)``.
    weight : ndarray
        They sum to one, shape ``(n,)``.

    Returns
    -------
    ndarray
        Ln of the mean of N(z; m, v) / N(z; 0, 1), shape ``(n_means, n_variances)``.
    """
    columns = [
        logsumexp(0.5 * z**2 - 0.5 * (z - _MEAN) ** 2 / v, axis=1, b=weight) - 0.5 * np.log(v)
        for v in _VARIANCE
    ]
    return np.column_stack(columns)


def needs_fleet_prior(lesson: MachineEvidence) -> bool:
    """Tell whether a machine's own logs say too little of how its life ends.

    So it is while they have removed less than half of the prior's variance of the pace of a law
    that leads to a limit and that it follows with a probability of 5 % or more: its remaining life
    is then mostly what was believed beforehand. A machine without wear is young in this sense
    however far it has travelled, until hardly anything speaks for a law by which it would wear.
    """
    return lesson.informed < INFORMED


def fleet_priors(stage: Stage, lessons: Mapping[str, MachineEvidence]) -> dict[str, FleetPrior]:
    """Learn a prior for each young machine from all the others.

    All others teach, those too that show no wear: without them all machines would seem to wear, and
    to wear fast.

    Parameters
    ----------
    stage : Stage
        The description of all of them.
    lessons : mapping of str to MachineEvidence
        By machine, in any order.

    Returns
    -------
    dict of str to FleetPrior
        By young machine; empty where fewer than three others teach.
    """
    machines, n_machines = sorted(lessons), len(lessons) - 1
    young = [machine for machine in machines if needs_fleet_prior(lessons[machine])]
    if n_machines < LEAST_TEACHERS or not young:
        return {}
    laws: dict[str, list[LawPrior]] = {name: [] for name in young}
    for parameter in stage.parameters:
        found: dict[str, list[LawPrior]] = {name: [] for name in young}
        for law in parameter.laws:
            heard = {name: lessons[name].laws[parameter.name][law.kind] for name in machines}
            for name, belief in _beliefs(heard, young, len(parameter.laws)).items():
                found[name].append(_learned(parameter.name, law, heard[name].prior, belief))
        for name, own in found.items():
            laws[name] += _of_one(own)
    scatters: dict[str, list[tuple[float, ...]]] = {name: [] for name in young}
    for field in _SCATTERS:
        columns = zip(*(lessons[name].scatter[field] for name in machines), strict=True)
        values = [dict(zip(machines, column, strict=True)) for column in columns]
        learned = [_beliefs(heard, young, len(values)) for heard in values]
        for name in young:
            scatters[name].append(tuple(_rounded(belief[name].share) for belief in learned))
    return {
        name: FleetPrior(n_machines, tuple(laws[name]), ScatterPrior(*scatters[name]))
        for name in young
    }


@dataclass(frozen=True, slots=True)
class _Belief:
    """Probability that a machine follows a law; mean and standard deviation of z if it does."""

    share: float
    mean: float
    std: float


def _beliefs(heard: Mapping[str, LawEvidence], young: Sequence[str], n: int) -> dict[str, _Belief]:
    """Give what all others teach each young machine of one of n laws or values."""
    share, log_prior = _hyperprior(heard[young[0]], n)
    total = log_prior
    for one in heard.values():
        total = total + _log_lesson(one, share)
    return {name: _predicted(share, total - _log_lesson(heard[name], share)) for name in young}


def _hyperprior(heard: LawEvidence, n: int) -> tuple[FloatArray, FloatArray]:
    """Give nodes of the share, and the log prior of share, mean and variance at the nodes.

    Shapes ``(n_shares,)`` and ``(n_shares, n_means, n_variances)``.
    """
    own = _LOG_PRIOR if heard.pace.size > 1 else np.zeros((1, 1))
    if n == 1:
        return np.ones(1), own[None]
    a, b = n * heard.prior, n * (1 - heard.prior)
    mass = np.diff(betainc(a, b, _SHARE_EDGES))
    # The mean of each cell is its node, so that the mean of all is that of the description.
    with np.errstate(invalid="ignore", divide="ignore"):
        node = heard.prior * np.diff(betainc(a + 1, b, _SHARE_EDGES)) / mass
        log_mass = np.log(mass)
    node = np.where(mass > 0, node, (_SHARE_EDGES[1:] + _SHARE_EDGES[:-1]) / 2)
    return np.clip(node, _SHARE_EDGES[:-1], _SHARE_EDGES[1:]), log_mass[:, None, None] + own


def _log_lesson(heard: LawEvidence, share: FloatArray) -> FloatArray:
    """Give ln p(D | m, v, s) / p(D), ``(n_shares, n_means, n_variances)``."""
    with np.errstate(divide="ignore"):
        has = np.log(share * heard.posterior / heard.prior)
        if share.size == 1:
            return has[:, None, None] + heard.pace
        lacks = np.log((1 - share) * (1 - heard.posterior) / (1 - heard.prior))
    return np.logaddexp(has[:, None, None] + heard.pace, lacks[:, None, None])


def _predicted(share: FloatArray, log_posterior: FloatArray) -> _Belief:
    """Average over the hyperparameters; z by the moments of the mixture that it then has."""
    weight = softmax(log_posterior) * share[:, None, None]
    mean_share = float(weight.sum())
    of_pace = weight.sum(axis=0) / mean_share
    if of_pace.size == 1:
        return _Belief(mean_share, 0.0, 1.0)
    mean = np.sum(of_pace * _MEAN)
    variance = np.sum(of_pace * (_VARIANCE + _MEAN**2)) - mean**2
    return _Belief(mean_share, float(mean), float(np.sqrt(variance)))


def _of_one(laws: Sequence[LawPrior]) -> list[LawPrior]:
    """Let the laws of a parameter, each learned by itself, share one probability."""
    total = sum(law.share[1] for law in laws)
    return [replace(law, share=(law.share[0], _rounded(law.share[1] / total))) for law in laws]


def _learned(parameter: str, law: AnyLaw, before: float, belief: _Belief) -> LawPrior:
    pace, field = None, _pace_field(law)
    if field:
        prior = getattr(law, field)
        placed = prior.placed(belief.mean, belief.std)
        pace = (prior, type(prior)(*(_rounded(value) for value in msgspec.structs.astuple(placed))))
    return LawPrior(parameter, law.kind, (before, _rounded(belief.share)), field, pace)


def _changed(law: AnyLaw, learned: LawPrior) -> AnyLaw:
    changes: dict[str, object] = {"weight": learned.share[1]}
    if learned.pace is not None:
        changes[learned.field] = learned.pace[1]
    return msgspec.structs.replace(law, **changes)


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _pace_field(law: Law) -> str:
    """Name the field of a law that is the prior of its pace; empty where that is not learned."""
    if isinstance(getattr(law, "life_km", None), Lognormal):
        return "life_km"
    # A normal prior of a length would be cut at 0, and be normal no more; that of a rate is not.
    return "rate_per_km" if isinstance(getattr(law, "rate_per_km", None), Pace) else ""


def _pace_draws(life: LifePosterior, j: int, law: AnyLaw) -> tuple[FloatArray, FloatArray]:
    """Give draws of z under a law of a parameter, and weights that add up to its probability."""
    values, weights = [np.empty(0)], [np.empty(0)]
    field = _pace_field(law)
    for way in life.scenarios:
        if way.scenario.paths[j].law.kind != law.kind:
            continue
        chains = way.chains
        z = np.zeros(chains.shape[0] * chains.shape[1])
        if field:
            name, unit = _PACES[field]
            own = way.scenario.split(chains.reshape(z.size, -1))[j]
            pace = own[:, law.names.index(name)] / unit
            z = getattr(law, field).standard(pace)
        values.append(z)
        weights.append(np.full(z.size, way.probability / z.size))
    return np.concatenate(values), np.concatenate(weights)


def _scatter_heard(stage: Stage, life: LifePosterior) -> dict[str, tuple[LawEvidence, ...]]:
    """Say how probable each value of the grid of scatter is, averaged over scenarios."""
    weights = [
        way.density.weights(way.mixture_draws[:: max(1, len(way.mixture_draws) // _N_SCATTER)])
        for way in life.scenarios
    ]
    heard = {}
    for field in _SCATTERS:
        before = np.array(getattr(scatter_prior(stage), field))
        after = np.zeros(before.size)
        for way, weight in zip(life.scenarios, weights, strict=True):
            values = np.unique(getattr(way.density.life.grid, field))
            has = np.equal.outer(values, getattr(way.density.grid, field))
            after += way.probability * (has @ weight)
        none = np.zeros((1, 1))
        pairs = zip((before / before.sum()).tolist(), after.tolist(), strict=True)
        heard[field] = tuple(LawEvidence(b, min(a, 1.0), none) for b, a in pairs)
    return heard
