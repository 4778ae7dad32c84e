"""Calibration of a stage description: lives drawn from it, through the chain of real logs."""

from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
from numpy.linalg import LinAlgError
from scipy.stats import binom

from lmshealth._private.arrays import FloatArray
from lmshealth._private.result import Result
from lmshealth._private.tables import spell
from lmshealth.batch.workers import Progress, processes
from lmshealth.calibration import constants
from lmshealth.calibration.lives import KINDS, Kind, Life, Schedule, draw
from lmshealth.calibration.ranks import (
    LEVEL,
    N_DRAWS,
    Row,
    holm,
    judge,
    judge_places,
    place,
    share_row,
)
from lmshealth.errors import BadQuestion, NotConverged, NotEnoughData
from lmshealth.life.health import health_of
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.life.prognosis import Prognosis, identifiable_limits, prognosis_of
from lmshealth.life.verdict import OUTSIDE_MAP, degraded_below, degraded_words, doubt_of_names
from lmshealth.life.verdict import judge as judge_state
from lmshealth.machine.service import decide, remaining_days
from lmshealth.stage.description import Stage
from lmshealth.stage.identifiability import identifiability_of
from lmshealth.tracking.constants import FALSE_ALARM_PROBABILITY
from lmshealth.tracking.history import History
from lmshealth.tracking.track import accepted_estimates, track

Task = tuple[Kind | None, int]  # of a life: its kind, None for any; its number

DRAWN = "as described"
"""Population of the lives of all kinds, with the probabilities of the description."""
DAYS = "days left"
FIRST = "remaining, first"
LEVELS = (0.5, 0.9)
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


class LifeOutcome(msgspec.Struct, frozen=True):
    """What is true of one life, and what the chain finds."""

    kind: Kind
    drawn: bool  # from the whole description; else further life of its kind
    number: int
    # By quantity: what is true, its place among the draws, 5, 25, 50, 75 and 95 % quantiles.
    truth: dict[str, float] = {}
    places: dict[str, float] = {}
    quantiles: dict[str, tuple[float, ...]] = {}
    # Places among draws of wrong width, by the factor on it (controls).
    controls: dict[str, dict[str, float]] = {}
    verdict: str = ""
    published: bool = False  # whether health of some parameter is
    degraded: tuple[str, ...] = ()  # words of the parameters that truly are
    losses: dict[str, float] = {}  # true, of the parameters that change, by word
    still: bool = False  # whether the tracker's declared rate of false alarms holds for it
    alarm: int | None = None  # number of the log that raises the first alarm
    service: str = ""  # kind of the service date
    wait: float = np.inf  # days until it
    failed: str = ""  # why there is no posterior


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often central intervals of a quantity contain the truth."""

    kind: str  # of lives, or `DRAWN`
    quantity: str
    level: float  # stated coverage
    hits: int
    n: int
    share: float
    low: float  # low, high: 95 % Clopper-Pearson interval of the share
    high: float
    p_value: float  # exact, two-sided, of the level
    # ``as stated``, ``too narrow`` or ``too wide``: of lives `DRAWN` by Holm's rule, of one kind if
    # the 99.9 % interval of the share excludes the level.
    verdict: str
    width: float  # median width of the intervals that end; of health in shares of the baseline
    n_ends: int  # intervals that end within the horizon


@dataclass(frozen=True, slots=True)
class Rate:
    """How often something happens in lives of a kind."""

    kind: str
    what: str
    hits: int
    n: int
    share: float
    low: float  # low, high: 95 % Clopper-Pearson interval of the share
    high: float
    at_most: float | None = None  # stated
    p_value: float = np.nan  # exact, of no more than that
    exceeded: bool = False  # whether Holm's rule rejects it
    median_log: float | None = None  # median number of the log at which it happens


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CalibrationCheck(Result):
    """Coverage, ranks and detection of lives drawn from a stage description."""

    stage: str
    schedule: Schedule
    seed: int
    outcomes: tuple[LifeOutcome, ...]
    coverage: tuple[Coverage, ...]
    rates: tuple[Rate, ...]
    # Of lives `DRAWN`, by quantity: judgement of the ranks, see `judge` of `ranks`.
    ranks: dict[str, Row]
    controls: dict[str, Row]  # likewise, of intervals of wrong width, which must fail
    # Exact p values of the checks of the verdict: of ranks and intervals of lives `DRAWN`, and of
    # rates that are stated; and whether each passes Holm's rule at `constants.FALSE_VERDICT`.
    p_values: dict[str, float]
    passed: dict[str, bool]

    def title(self) -> str:
        """Return what was checked."""
        n = len(self.outcomes)
        return f"Calibration of {self.stage} on {n} lives: coverage of central intervals"

    def to_columns(self) -> dict[str, Any]:
        """Return the coverage of each kind of life, quantity and level."""
        names = Coverage.__slots__
        return {name: [getattr(one, name) for one in self.coverage] for name in names}

    @property
    def wrong(self) -> tuple[str, ...]:
        """Names of the checks that are not as stated."""
        return tuple(name for name, fine in self.passed.items() if not fine)

    @property
    def without_result(self) -> dict[str, int]:
        """Reasons of lives without a posterior, and how many lives have them."""
        return dict(Counter(one.failed for one in self.outcomes if one.failed))

    @property
    def blind(self) -> tuple[str, ...]:
        """Controls that the check does not find wrong: it could not find such a fault.

        Found is what Holm's rule rejects even if all else is as stated.
        """
        strictest = constants.FALSE_VERDICT / max(len(self.p_values), 1)
        return tuple(
            name
            for name, row in self.controls.items()
            if min(one["p_value"] for one in (row, *row["coverage"])) > strictest
        )


def check_calibration(
    stage: Stage,
    schedule: Schedule | None = None,
    *,
    lives: int = 100,
    seed: int = 0,
    workers: int = 1,
    progress: Progress | None = None,
) -> CalibrationCheck:
    """Check what coverage, detection and dates a stage description leads to.

    Lives are drawn from its map, priors, laws and sensors at the level of modal estimates of each
    log, and go through the tracker, the posterior of the life, verdict and service date.

    Parameters
    ----------
    stage, schedule : Stage, Schedule, optional
        Description with health parameters, and number, distance and duration of logs.
    lives, seed, workers : int
        Lives drawn from the description, beside which each kind of life gets at least a quarter as
        many; seed of all random numbers; processes.
    progress : callable, optional
        Called with a name, and numbers of finished and of all lives.

    Raises
    ------
    BadStage
        If the description has no health parameter, or its laws leave its map.
    BadQuestion
        If a number of the schedule is out of range.

    References
    ----------
    Talts2018, Sailynoja2022

    Examples
    --------
    Few lives do not suffice for a judgement; every result is there all the same:

    >>> import lmshealth
    >>> from lmshealth.calibration.lives import Schedule
    >>> stage = lmshealth.load_stage("lms-y")
    >>> found = lmshealth.check_calibration(stage, Schedule(logs=12), lives=1, seed=1)
    >>> sorted({one.kind for one in found.outcomes})
    ['foreign change', 'healthy', 'wearing']
    >>> found.coverage[0].kind, found.coverage[0].quantity, found.coverage[0].n
    ('as described', 'guide preload now', 1)
    """
    resolved = (schedule or Schedule()).resolved(stage)
    found = draw_outcomes(stage, resolved, lives=lives, seed=seed, workers=workers)
    outcomes = []
    for one, total in found:
        outcomes.append(one)
        if progress:
            progress("lives", len(outcomes), total)
    return summarise(stage, resolved, outcomes, seed=seed)


def draw_outcomes(
    stage: Stage, schedule: Schedule, *, lives: int, seed: int, workers: int
) -> Generator[tuple[LifeOutcome, int], None, None]:
    """Yield the outcome of each life when it is there, with the number of all lives."""
    if lives < 1:
        raise BadQuestion(f"{lives} lives: needed is at least 1")
    identifiability_of(stage)  # refuses a description without parameters or map
    least = int(np.ceil(constants.LEAST_OF_KIND * lives))
    tasks: list[Task] = [(None, k) for k in range(lives)]
    kinds = [_drawn(stage, schedule, seed, task)[1].kind for task in tasks]
    for kind in KINDS:
        if kind == "wearing" and not any(law.names for p in stage.parameters for law in p.laws):
            continue
        tasks += [(kind, k) for k in range(least - kinds.count(kind))]
    with processes(workers) as pool:
        work = partial(outcome_of, stage, schedule, seed)
        crash = partial(_crashed, stage, schedule, seed)
        for _, outcome in pool.map_unordered(work, tasks, crash):
            yield outcome, len(tasks)


def _seeds(seed: int, task: Task) -> list[int]:
    kind, number = task
    return [seed, 0 if kind is None else 1 + KINDS.index(kind), number]


def _drawn(
    stage: Stage, schedule: Schedule, seed: int, task: Task
) -> tuple[np.random.Generator, Life, LifeOutcome]:
    """Return a life with the generator that drew it, and an outcome without results."""
    rng = np.random.default_rng(_seeds(seed, task))
    life = draw(rng, stage, schedule, task[0])
    return rng, life, LifeOutcome(life.kind, task[0] is None, task[1])


def _crashed(stage: Stage, schedule: Schedule, seed: int, task: Task, why: str) -> LifeOutcome:
    return msgspec.structs.replace(_drawn(stage, schedule, seed, task)[2], failed=why)


def outcome_of(stage: Stage, schedule: Schedule, seed: int, task: Task) -> LifeOutcome:
    """Draw a life of a kind, or of any, by its number; pass it through the chain of real logs."""
    rng, drawn, base = _drawn(stage, schedule, seed, task)
    history = drawn.history
    try:
        tracked = track(history, stage)
        if doubt := doubt_of_names(stage, history, tracked):
            return msgspec.structs.replace(base, failed=doubt)
        accepted = accepted_estimates(history, tracked, doubtful=True)
        posterior = fit_life(accepted, stage, _seeds(seed, task), chains=False)
        prognosis = prognosis_or_none(posterior, accepted, stage)
        health = health_of(posterior, accepted, stage, (len(history.logs) - 1,))
    except (NotEnoughData, NotConverged, LinAlgError) as why:
        return msgspec.structs.replace(base, failed=f"{type(why).__name__}: {why}")
    judged = judge_state(stage, history, health, tracked)
    service = decide(prognosis, stage.description.decision)
    true, draws = true_quantities(drawn, stage, rng), quantities(posterior, stage, prognosis)
    parts = list(zip(stage.parameters, drawn.parts, drawn.health, strict=True))
    alarms = [event.found_at + 1 for event in tracked.events if event.kind == "alarm"]
    shown = {name: own for name, own in draws.items() if name in shown_quantities(stage)}
    return msgspec.structs.replace(
        base,
        still=drawn.still,
        truth=true,
        places=ranks_of(true, draws, rng),
        quantiles={
            name: tuple(np.quantile(own, _QUANTILES, method="inverted_cdf").tolist())
            for name, own in shown.items()
        },
        controls={
            f"{factor:g}": ranks_of(true, {k: _widened(v, factor) for k, v in shown.items()}, rng)
            for factor in constants.WRONG_WIDTHS
        },
        verdict=judged.verdict,
        published=bool(health.publishable_parameters().any()),
        degraded=tuple(p.word for p, _, h in parts if h < degraded_below(p) / p.baseline),
        losses={p.word: float(1 - h) for p, part, h in parts if part.changes},
        alarm=min(alarms, default=None),
        service=service.kind,
        wait=service.wait,
    )


def _widened(draws: FloatArray, factor: float) -> FloatArray:
    """Widen draws about their median; where that never ends, draw out the time until the end."""
    middle = float(np.quantile(draws, 0.5, method="inverted_cdf"))
    return middle + factor * (draws - middle) if np.isfinite(middle) else factor * draws


def prognosis_or_none(posterior: LifePosterior, history: History, stage: Stage) -> Prognosis | None:
    """Return the prognosis of a life, None where no limit is identifiable."""
    if not identifiable_limits(stage, posterior.modes):
        return None
    return prognosis_of(posterior, history, stage)


def shown_quantities(stage: Stage) -> tuple[str, ...]:
    """Return the names of the quantities whose coverage is published: health, and date."""
    return (*(f"{spell(p.name)} now" for p in stage.parameters), DAYS)


def true_quantities(drawn: Life, stage: Stage, rng: np.random.Generator) -> dict[str, float]:
    """Return what is true of a life: whether parameters change, health, travel and days left."""
    horizon = 1000 * stage.description.usage.horizon_km
    found: dict[str, float] = {}
    for p, part, health in zip(stage.parameters, drawn.parts, drawn.health, strict=True):
        name = spell(p.name)
        found |= {f"{name} changes": part.changes, f"{name} now": float(health)}
        found[f"{name} off its law"] = float(part.off[-1])
    left = []
    for j, p in identifiable_limits(stage, drawn.history.modes):
        assert p.limit is not None
        left.append(drawn.parts[j].left(rng, drawn.now, p.limit.below / p.baseline, horizon))
        found[f"remaining, {spell(p.name)}"] = left[-1]
    if left:
        found |= {FIRST: min(left), DAYS: drawn.days(rng, min(left))}
    for k, mode in enumerate(drawn.history.modes):
        found[f"{mode} moves alone"] = drawn.lone == k
    return {name: float(value) for name, value in found.items()}


def quantities(
    posterior: LifePosterior, stage: Stage, prognosis: Prognosis | None
) -> dict[str, FloatArray]:
    """Return draws of the same quantities from the posterior, ``(n_draws,)`` each."""
    n = posterior.rate.shape[0]
    changes = np.concatenate(
        [
            np.tile([bool(p.law.names) for p in one.scenario.paths], (n, one.n_mixture_draws, 1))
            for one in posterior.scenarios
        ],
        axis=1,
    )
    found: dict[str, FloatArray] = {}
    for j, p in enumerate(stage.parameters):
        name = spell(p.name)
        found[f"{name} changes"] = changes[..., j].ravel().astype(float)
        found[f"{name} now"] = posterior.health[..., j].ravel()
        found[f"{name} off its law"] = posterior.off[..., j].ravel()
    if prognosis is not None:
        left = prognosis.censored()
        for k, parameter in enumerate(prognosis.parameters[:-1]):
            found[f"remaining, {spell(parameter)}"] = left[:, k]
        found |= {FIRST: left[:, -1], DAYS: remaining_days(prognosis)[:, -1]}
    lone = posterior.lone.ravel()
    for k, mode in enumerate(posterior.modes):
        found[f"{mode} moves alone"] = (lone == k).astype(float)
    return found


def ranks_of(
    truth: dict[str, float], draws: dict[str, FloatArray], rng: np.random.Generator
) -> dict[str, float]:
    """Return the places of truths among few draws, all of the same draws of the posterior."""
    n = min(own.size for own in draws.values())
    some = rng.permutation(n)[:N_DRAWS]
    table = np.column_stack([own[some] for own in draws.values()])
    found = place(table, np.array([truth[name] for name in draws]), rng)
    return dict(zip(draws, found.round(6).tolist(), strict=True))


def judged_ranks(places: Sequence[dict[str, float]]) -> dict[str, Row]:
    """Judge the ranks of every quantity, of the lives that have it."""
    names = dict.fromkeys(name for own in places for name in own)
    return {n: judge(np.array([own[n] for own in places if n in own])) for n in names}


def summarise(
    stage: Stage, schedule: Schedule, outcomes: Iterable[LifeOutcome], *, seed: int
) -> CalibrationCheck:
    """Summarise outcomes, of which some may be missing after an interruption."""
    found = sorted(outcomes, key=lambda one: (not one.drawn, KINDS.index(one.kind), one.number))
    drawn = [one for one in found if one.drawn]
    groups = {DRAWN: drawn} | {kind: [o for o in found if o.kind == kind] for kind in KINDS}
    groups = {name: own for name, own in groups.items() if own}
    shown = shown_quantities(stage)
    coverage = [
        row
        for kind, own in groups.items()
        for quantity in shown
        for level in LEVELS
        if (row := _coverage(kind, quantity, level, own))
    ]
    ranks = judged_ranks([one.places for one in drawn])
    controls = {
        f"{name}, {words}": row
        for factor, words in constants.WRONG_WIDTHS.items()
        for name, row in judged_ranks([o.controls.get(f"{factor:g}", {}) for o in drawn]).items()
    }
    rates = [row for kind, own in groups.items() for row in _rates(kind, own, stage)]
    p_values = {f"{name}: ranks are uniform": row["p_value"] for name, row in ranks.items()}
    p_values |= {_check_of(one): one.p_value for one in coverage if one.kind == DRAWN}
    p_values |= {_check_of(one): one.p_value for one in rates if one.at_most is not None}
    _, rejected = holm(list(p_values.values()), constants.FALSE_VERDICT, len(p_values))
    passed = dict(zip(p_values, (~rejected).tolist(), strict=True))
    coverage = [replace(one, verdict=_verdict(one, passed.get(_check_of(one)))) for one in coverage]
    rates = [replace(one, exceeded=not passed.get(_check_of(one), True)) for one in rates]
    return CalibrationCheck(
        stage=stage.name,
        schedule=schedule,
        seed=seed,
        outcomes=tuple(found),
        coverage=tuple(coverage),
        rates=tuple(rates),
        ranks=ranks,
        controls=controls,
        p_values=p_values,
        passed=passed,
    )


def _check_of(one: Coverage | Rate) -> str:
    """Name the check of a coverage or a rate."""
    if isinstance(one, Rate):
        return f"{one.kind}: {one.what}"
    intervals = f"{one.quantity}: {one.level:.0%} intervals"
    return intervals if one.kind == DRAWN else f"{one.kind}: {intervals}"


def _verdict(one: Coverage, passed: bool | None) -> str:
    """Return how intervals are, where the verdict has no such check by their own p value."""
    if one.p_value > 1 - LEVEL if passed is None else passed:
        return "as stated"
    return "too narrow" if one.share < one.level else "too wide"


def _coverage(
    kind: str, quantity: str, level: float, lives: Sequence[LifeOutcome]
) -> Coverage | None:
    """Return the coverage of central intervals of a quantity; None where no life has it."""
    own = [one for one in lives if quantity in one.places]
    if not own:
        return None
    places = np.array([one.places[quantity] for one in own])
    row = judge_places(places, level)
    shown = share_row(row["hits"], row["n"], 0.95) | {"p_value": row["p_value"], "verdict": ""}
    ends = np.array([one.quantiles[quantity] for one in own])
    ends = ends[np.isfinite(ends).all(axis=1)]  # the same lives at all levels
    first = 1 if level == LEVELS[0] else 0
    width = float(np.median(ends[:, -1 - first] - ends[:, first])) if len(ends) else np.nan
    return Coverage(kind, quantity, level, width=width, n_ends=len(ends), **shown)


def _rates(kind: str, lives: Sequence[LifeOutcome], stage: Stage) -> Iterator[Rate]:
    """Yield how often health is published, losses and foreign changes are found, and alarms."""

    def rate(what: str, hits: Iterable[bool], **more: Any) -> Iterator[Rate]:
        seen = [bool(one) for one in hits]
        if seen:
            row = share_row(sum(seen), len(seen), 0.95)
            if more.get("at_most") is not None:  # None where a service is chosen by its cost
                more["p_value"] = float(binom.sf(sum(seen) - 1, len(seen), more["at_most"]))
            yield Rate(kind, what, **row, **more)

    done = [one for one in lives if not one.failed]
    yield from rate("health is published", (one.published for one in lives))
    if kind == DRAWN:
        dated = [one for one in done if DAYS in one.truth and one.truth[DAYS] > 0]
        accepted = stage.description.decision.accepted
        early = (one.truth[DAYS] < one.wait for one in dated)
        yield from rate("limit reached before the service date", early, at_most=accepted)
        yield from rate("a service date within the horizon", (o.service != "later" for o in dated))
        return
    sound = [one for one in done if not one.degraded]
    wrong = (bool(degraded_words(one.verdict)) for one in sound)
    yield from rate("reported as degraded, nothing is (false)", wrong)
    if kind == "foreign change":
        yield from rate("reported as outside the map", (o.verdict == OUTSIDE_MAP for o in sound))
    if kind == "healthy":
        yield from rate("alarm of the tracker (false)", (o.alarm is not None for o in done))
        still = (one.alarm is not None for one in done if one.still)
        yield from rate(
            "alarm of the tracker, nothing moves (false)", still, at_most=FALSE_ALARM_PROBABILITY
        )
    if kind == "wearing":
        for low, high in pairwise(constants.LOSSES):
            found = [
                word in degraded_words(one.verdict)
                for one in done
                for word, loss in one.losses.items()
                if low <= loss < high
            ]
            span = f"{100 * low:g} to {100 * high:g} %" if high < 1 else f"{100 * low:g} % or more"
            yield from rate(f"a loss of {span} is reported as degraded", found)
        worn = [one for one in done if one.degraded]
        logs = [one.alarm for one in worn if one.alarm is not None]
        median = float(np.median(logs)) if logs else None
        seen = (one.alarm is not None for one in worn)
        yield from rate("alarm by the last log, of degraded machines", seen, median_log=median)
