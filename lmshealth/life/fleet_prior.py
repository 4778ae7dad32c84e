"""What a fleet contributes: a prior of its laws (empirical Bayes), and calibration by ended lives.

README.md has both models.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import msgspec
import numpy as np
from numpy.linalg import LinAlgError
from scipy.special import betainc, softmax

from lmshealth._private.arrays import FloatArray
from lmshealth._private.serialize import fingerprint
from lmshealth.errors import LmshealthError
from lmshealth.life import constants
from lmshealth.life.posterior.data import with_clock
from lmshealth.life.posterior.fit import LifePosterior
from lmshealth.life.posterior.likelihood import NO_MODE, scatter_prior
from lmshealth.life.posterior.scenarios import laws_of
from lmshealth.life.prognosis import Prognosis, identifiable_limits, prognose
from lmshealth.stage.constants import INFORMED
from lmshealth.stage.degradation_laws import AnyLaw, Law
from lmshealth.stage.description import ParameterSpec, ScatterPrior, Stage
from lmshealth.stage.priors import Lognormal, Normal
from lmshealth.tracking.history import History

_MEAN, _VARIANCE = constants.FLEET_MEAN, constants.FLEET_VARIANCE
# Log prior of mean and variance at their grid: N(0, 1 - v) and U(0, 1).
_LOG_PRIOR = -0.5 * (_MEAN**2 / (1 - _VARIANCE) + np.log(1 - _VARIANCE))
_SHARE_EDGES = np.sin(np.linspace(0, np.pi / 2, 33)) ** 2
# By the field that is the prior of a law's pace: the natural parameter, and its unit.
_PACES = {"life_km": ("life_m", 1e3), "rate_per_km": ("rate_per_m", 1e-3)}
# Fields of `ScatterPrior`, and the constants that have their values.
_SCATTERS = {"walk": "WALK_STDS", "noise_scale": "NOISE_SCALES", "deviation": "DEVIATION_STDS"}
_NO_PACE = np.zeros((1, 1))

Pace = Lognormal | Normal
"""Prior of the pace of a law: of its life, or of its rate."""


@dataclass(frozen=True, slots=True, eq=False)
class LawEvidence:
    """Evidence of a machine on one of several laws, or values of the scatter.

    Its probability by the description and by the machine's logs; `pace` is the log likelihood of
    mean and variance of the fleet under the law, relative to the description's prior, shape
    ``(n_means, n_variances)``, or ``(1, 1)`` without a pace.
    """

    prior: float
    posterior: float
    pace: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MachineEvidence:
    """Evidence of one machine for the prior of the others.

    `laws` by health parameter and kind of law; `scatter` by field of `ScatterPrior`, of each value;
    `pace_informed` is the share of the prior variance of a law's pace that the logs removed, the
    least of all probable laws of identifiable parameters with a limit.
    """

    laws: dict[str, dict[str, LawEvidence]]
    scatter: dict[str, tuple[LawEvidence, ...]]
    pace_informed: float


@dataclass(frozen=True, slots=True)
class LawPrior:
    """Prior of a law of a health parameter by the description, then by the fleet.

    `share` is the probability that a machine follows the law; `pace` the prior of its pace, which
    is the law's `field` ``life_km`` or ``rate_per_km`` (empty and None without).
    """

    parameter: str
    kind: str
    share: tuple[float, float]
    field: str
    pace: tuple[Pace, Pace] | None


@dataclass(frozen=True, slots=True)
class FleetPrior:
    """Prior of a machine from the other `n_machines` of its fleet: laws, and scatter of logs."""

    n_machines: int
    laws: tuple[LawPrior, ...]
    scatter: ScatterPrior

    def apply_to(self, stage: Stage) -> Stage:
        """Return the stage with this prior, and a digest of both."""
        known = {(law.parameter, law.kind): law for law in self.laws}
        laws = {
            one.name: tuple(_with_prior(law, known[one.name, law.kind]) for law in one.laws)
            for one in stage.parameters
        }
        digest = fingerprint(stage.digest, self.laws, self.scatter)
        return replace(stage.with_laws(laws), digest=digest, scatter=self.scatter)


def machine_evidence(stage: Stage, life: LifePosterior) -> MachineEvidence:
    """Return the evidence of a machine for the prior of its fleet.

    The life is fitted under the description itself: with a fleet prior the evidence of others would
    count twice. A law that restarts at a step counts like one from the baseline on.
    """
    limited = {j for j, _ in identifiable_limits(stage, life.modes)}
    laws: dict[str, dict[str, LawEvidence]] = {}
    pace_informed = 1.0
    for j, parameter in enumerate(stage.parameters):
        laws[parameter.name] = {}
        shares = laws_of(parameter, stage.description.life.free)
        for law, share in shares[: len(parameter.laws)]:
            z, weight = _pace_draws(life, j, law)
            after = min(float(weight.sum()), 1.0)
            # A law that the machine does not follow has no evidence on its pace.
            pace = np.zeros(_LOG_PRIOR.shape) if _pace_field(law) else _NO_PACE
            if _pace_field(law) and after:
                pace = pace_likelihood(z, weight / after)
                if j in limited and after >= constants.MIN_LAW_PROBABILITY:
                    pace_informed = min(pace_informed, 1 - float(np.cov(z, aweights=weight)))
            laws[parameter.name][law.kind] = LawEvidence(share, after, pace)
    return MachineEvidence(laws, _scatter_evidence(stage, life), pace_informed)


def pace_likelihood(z: FloatArray, weight: FloatArray) -> FloatArray:
    """Return ln of the mean of N(z; m, v) / N(z; 0, 1) over draws, ``(n_means, n_variances)``.

    Of the standardised pace under the description ``(n,)``, with normalised weights ``(n,)``.
    """
    z, weight, columns = z[weight > 0], weight[weight > 0], []
    for v in _VARIANCE:
        ratio = 0.5 * z**2 - 0.5 * (z - _MEAN) ** 2 / v
        largest = ratio.max(axis=1)
        mean = np.exp(ratio - largest[:, None]) @ weight
        columns.append(largest + np.log(mean) - 0.5 * np.log(v))
    return np.column_stack(columns)


def needs_fleet_prior(evidence: MachineEvidence) -> bool:
    """Return whether a machine's own logs inform the pace of a probable law too little.

    So do those of a machine without wear, until a law by which it would wear is improbable.
    """
    return evidence.pace_informed < INFORMED


def fleet_priors(stage: Stage, evidence: Mapping[str, MachineEvidence]) -> dict[str, FleetPrior]:
    """Estimate a prior for each machine that needs one from all others of its description.

    Machines without wear count too: without them all machines would seem to wear, and fast. Empty
    with fewer than three others.
    """
    machines, n_others = sorted(evidence), len(evidence) - 1
    needy = [machine for machine in machines if needs_fleet_prior(evidence[machine])]
    if n_others < constants.MIN_MACHINES or not needy:
        return {}
    laws: dict[str, list[LawPrior]] = {name: [] for name in needy}
    for parameter in stage.parameters:
        predictives = []
        n_laws = len(laws_of(parameter, stage.description.life.free))
        for law in parameter.laws:
            own = {name: evidence[name].laws[parameter.name][law.kind] for name in machines}
            predictives.append(_predictives(own, needy, n_laws))
        for name in needy:
            found = [one[name] for one in predictives]
            laws[name] += _law_priors(parameter, evidence[name].laws[parameter.name], found)
    scatters: dict[str, list[tuple[float, ...]]] = {name: [] for name in needy}
    for field in _SCATTERS:
        columns = zip(*(evidence[name].scatter[field] for name in machines), strict=True)
        values = [dict(zip(machines, column, strict=True)) for column in columns]
        predictives = [_predictives(own, needy, len(values)) for own in values]
        for name in needy:
            scatters[name].append(tuple(_rounded(one[name].share) for one in predictives))
    return {
        name: FleetPrior(n_others, tuple(laws[name]), ScatterPrior(*scatters[name]))
        for name in needy
    }


@dataclass(frozen=True, slots=True)
class _Predictive:
    """Probability of a law for a machine; mean and standard deviation of z under the law."""

    share: float
    mean: float
    std: float


def _predictives(
    evidence: Mapping[str, LawEvidence], needy: Sequence[str], n: int
) -> dict[str, _Predictive]:
    """Return the predictive of one of n laws for each machine from the evidence of all others."""
    share, total = _hyperprior(evidence[needy[0]], n)
    for one in evidence.values():
        total = total + _log_evidence(one, share)
    others = {name: total - _log_evidence(evidence[name], share) for name in needy}
    return {name: _predictive(share, log_posterior) for name, log_posterior in others.items()}


def _hyperprior(evidence: LawEvidence, n: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes of the share, and the log prior there, ``(n_shares, n_means, n_variances)``."""
    own = _LOG_PRIOR if evidence.pace.size > 1 else _NO_PACE
    if n == 1:
        return np.ones(1), own[None]
    a, b = n * evidence.prior, n * (1 - evidence.prior)
    mass = np.diff(betainc(a, b, _SHARE_EDGES))
    # Each node is the mean of its cell, so that the mean share is the description's.
    with np.errstate(invalid="ignore", divide="ignore"):
        node = evidence.prior * np.diff(betainc(a + 1, b, _SHARE_EDGES)) / mass
        log_mass = np.log(mass)
    node = np.where(mass > 0, node, (_SHARE_EDGES[1:] + _SHARE_EDGES[:-1]) / 2)
    return np.clip(node, _SHARE_EDGES[:-1], _SHARE_EDGES[1:]), log_mass[:, None, None] + own


def _log_evidence(evidence: LawEvidence, share: FloatArray) -> FloatArray:
    """Return ln p(D | m, v, s) / p(D), shape ``(n_shares, n_means, n_variances)``."""
    with np.errstate(divide="ignore"):
        has = np.log(share * evidence.posterior / evidence.prior)
        if share.size == 1:
            return has[:, None, None] + evidence.pace
        lacks = np.log((1 - share) * (1 - evidence.posterior) / (1 - evidence.prior))
    return np.logaddexp(has[:, None, None] + evidence.pace, lacks[:, None, None])


def _predictive(share: FloatArray, log_posterior: FloatArray) -> _Predictive:
    """Average over the hyperparameters; z by the moments of its mixture."""
    weight = softmax(log_posterior) * share[:, None, None]
    mean_share = float(weight.sum())
    of_pace = weight.sum(axis=0) / mean_share
    if of_pace.size == 1:
        return _Predictive(mean_share, 0.0, 1.0)
    mean = np.sum(of_pace * _MEAN)
    variance = np.sum(of_pace * (_VARIANCE + _MEAN**2)) - mean**2
    return _Predictive(mean_share, float(mean), float(np.sqrt(variance)))


def _law_priors(
    parameter: ParameterSpec, own: Mapping[str, LawEvidence], predictives: Sequence[_Predictive]
) -> list[LawPrior]:
    """Return the priors of the laws of a parameter from their predictives for a machine."""
    # Laws are estimated one by one: their probabilities are normalised.
    shares = [_rounded(one.share) for one in predictives]
    found = []
    for law, share, predictive in zip(parameter.laws, shares, predictives, strict=True):
        pace, field = None, _pace_field(law)
        if field:
            prior = getattr(law, field)
            placed = prior.placed(predictive.mean, predictive.std)
            pace = (prior, type(prior)(*map(_rounded, msgspec.structs.astuple(placed))))
        both = own[law.kind].prior, _rounded(share / sum(shares))
        found.append(LawPrior(parameter.name, law.kind, both, field, pace))
    return found


def _with_prior(law: AnyLaw, fleet: LawPrior) -> AnyLaw:
    changes: dict[str, object] = {"weight": fleet.share[1]}
    if fleet.pace is not None:
        changes[fleet.field] = fleet.pace[1]
    return msgspec.structs.replace(law, **changes)


def _rounded(value: float) -> float:
    return float(f"{value:.{constants.FLEET_DIGITS}g}")


def _pace_field(law: Law) -> str:
    """Return the field of a law with the prior of its pace; empty without one."""
    if isinstance(getattr(law, "life_km", None), Lognormal):
        return "life_km"
    # A normal prior of a life would be cut at 0 and not stay normal; that of a rate is not cut.
    return "rate_per_km" if isinstance(getattr(law, "rate_per_km", None), Pace) else ""


def _pace_draws(life: LifePosterior, j: int, law: AnyLaw) -> tuple[FloatArray, FloatArray]:
    """Return draws of z under a law of a parameter, and weights that sum to its probability."""
    values, weights = [np.empty(0)], [np.empty(0)]
    field = _pace_field(law)
    for one in life.scenarios:
        if one.scenario.paths[j].law.kind != law.kind:
            continue
        chains = one.chains
        z = np.zeros(chains.shape[0] * chains.shape[1])
        if field:
            name, unit = _PACES[field]
            own = one.scenario.split(chains.reshape(z.size, -1))[j]
            pace = own[:, law.names.index(name)] / unit
            z = getattr(law, field).standard(pace)
        values.append(z)
        weights.append(np.full(z.size, one.probability / z.size))
    return np.concatenate(values), np.concatenate(weights)


def _scatter_evidence(stage: Stage, life: LifePosterior) -> dict[str, tuple[LawEvidence, ...]]:
    """Return the evidence on each value of the grid of scatter, averaged over scenarios."""
    weights = [one.density.weights(one.some_draws) for one in life.scenarios]
    found = {}
    for field, values in _SCATTERS.items():
        before = np.array(getattr(scatter_prior(stage), field))
        before, after = before / before.sum(), np.zeros(before.size)
        for one, weight in zip(life.scenarios, weights, strict=True):
            grid = one.density.grid
            has = np.equal.outer(getattr(constants, values), getattr(grid, field))
            # Beside a foreign cause random walks have their own prior: no evidence on this one.
            shows = (grid.lone == NO_MODE) & (grid.common == 0) if field == "walk" else True
            own = weight * shows
            after += one.probability * (has @ own + max(1 - own.sum(), 0.0) * before)
        pairs = zip(before.tolist(), after.tolist(), strict=True)
        found[field] = tuple(LawEvidence(b, min(a, 1.0), _NO_PACE) for b, a in pairs)
    return found


@dataclass(frozen=True, slots=True)
class EndedLife:
    """A life that maintenance ended, and the place of its end in what was predicted of it.

    `place` is the probability that was predicted for an end as early as the true one, the least
    over `constants.LIFE_SHARES` of the life. One that was serviced before any limit (not `reached`)
    counts as if it had ended at its last log: its true place is later.
    """

    place: float
    reached: bool


@dataclass(frozen=True, slots=True)
class FleetContribution:
    """What a machine contributes to its fleet: evidence for the prior, and its ended lives."""

    evidence: MachineEvidence | None
    ended: tuple[EndedLife, ...]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Remaining travel that a share of machines outlives at least, by the ended lives of a fleet.

    `coverage` is that share, 1 - k / (n + 1) for the k-th smallest place of n lives; `travel` in m
    is infinite beyond the horizon.
    """

    n_lives: int
    n_reached: int
    coverage: float
    travel: float


def lives_before(history: History) -> Iterator[tuple[int, int, int]]:
    """Yield first log, end and next baseline of each life before the present one.

    A life ends at the work after its baseline, which may be logs before the next baseline.
    """
    resets = [step.first for step in history.steps if step.kind == "reset"]
    for begin, after in pairwise(history.baselines):
        yield begin, min(next((first for first in resets if begin < first), after), after), after


def ended_lives(history: History, stage: Stage, seed: int | Sequence[int]) -> tuple[EndedLife, ...]:
    """Predict the ends of the lives before the present baseline, and compare with their ends.

    Lives without a prognosis, as they are too short, are left out.
    """
    found = []
    history = with_clock(history, stage)
    for _, end, _ in lives_before(history):
        try:
            found.append(_ended_life(history.first_logs(end), stage, seed))
        except (LmshealthError, LinAlgError):  # no ended life must end the present one
            continue
    return tuple(one for one in found if one is not None)


def _ended_life(history: History, stage: Stage, seed: int | Sequence[int]) -> EndedLife | None:
    clock, needed = history.clock(), stage.description.baseline.logs
    left = prognose(history, stage, seed, chains=False).remaining[:, -1]
    reached = bool(np.mean(left <= 0) >= constants.MIN_PAST)
    end = float(clock[-1] + (np.median(left) if reached else 0.0))
    places = []
    for share in constants.LIFE_SHARES:
        n = int(np.searchsorted(clock, share * end, side="right"))
        if n - history.baseline >= needed and clock[n - 1] < end:
            young = prognose(history.first_logs(n), stage, seed, chains=False)
            places.append(float(np.mean(young.remaining[:, -1] <= end - clock[n - 1])))
    return EndedLife(min(places), reached) if places else None


def calibrate(prognosis: Prognosis, lives: Sequence[EndedLife]) -> Calibration | None:
    """Return the calibrated remaining travel to any limit (split conformal, one-sided).

    None with fewer ended lives than `constants.CALIBRATED_RISK` needs.
    """
    n, places = len(lives), sorted(one.place for one in lives)
    k = int(constants.CALIBRATED_RISK * (n + 1))
    if k < 1:
        return None
    level, left = places[k - 1], 0.0
    if level > 0:  # else an end came before every draw, and no travel is supported
        left = float(np.quantile(prognosis.remaining[:, -1], level, method="inverted_cdf"))
    return Calibration(
        n_lives=n,
        n_reached=sum(one.reached for one in lives),
        coverage=1 - k / (n + 1),
        travel=np.inf if left > prognosis.horizon else max(left, 0.0),
    )
