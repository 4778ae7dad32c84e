"""Assessment of one machine: track, health, prognosis and verdict; update by its fleet.

Everything here is a function of its arguments: no store, no file, no process, no clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date
from itertools import compress, takewhile

import numpy as np
from numpy.linalg import LinAlgError

from lmshealth._private.arrays import FloatArray
from lmshealth._private.serialize import fingerprint, seed_of, stream
from lmshealth._private.tables import fact
from lmshealth.errors import BadQuestion, LmshealthError, NotEnoughData
from lmshealth.io.log import Notice, Refusal, utc_day
from lmshealth.io.refusal import listed
from lmshealth.life import constants, fleet_prior
from lmshealth.life.health import Health, epochs_to_publish, health_of
from lmshealth.life.posterior.data import with_clock
from lmshealth.life.posterior.exploration import LifeStart
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.life.prognosis import Prognosis, parameters_with_limit, prognosis_of
from lmshealth.life.verdict import (
    NO_HEALTH,
    OUTSIDE_MAP,
    Verdict,
    doubt_of_names,
    judge,
    undeclared_events,
)
from lmshealth.machine.constants import DRIFT_SIGMA
from lmshealth.machine.service import Service, decide, without_limits
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.spectra_summary import Waterfall
from lmshealth.stage.description import Stage, expect_stage
from lmshealth.tracking.covariates import covariate_notices
from lmshealth.tracking.history import (
    History,
    build_history,
    contradiction_notices,
    doubt_of_clock,
    missing_mode_notices,
)
from lmshealth.tracking.maintenance import (
    NO_MAINTENANCE,
    RESETS,
    Maintenance,
    baseline_notices,
    maintenance_notices,
    restored,
)
from lmshealth.tracking.track import (
    Track,
    accepted_estimates,
    known_shifts,
    outlier_refusals,
    track,
)

_CARRIED_STEP = 1 << 23  # of the random stream
_LEAST_HEALTH = 1e-3  # that is carried: less is past every limit
_NAMELESS = ("ambiguous", "unconfirmed")  # reasons of estimates whose name is not certain


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Assessment:
    """All results of one machine, as far as its data carry them."""

    stage: Stage  # description that the logs were analysed with
    history: History  # history, judgement: modal estimates of all logs, and the verdict
    digests: tuple[str, ...]  # SHA-256 of each log of the history
    track: Track | None  # none without an estimate of a tracked mode
    health: Health | None  # none without a health parameter, or with too few logs
    prognosis: Prognosis | None  # none without health, or without a limit
    judgement: Verdict
    refused: tuple[Refusal, ...]  # everything of its readable logs that was not analysed
    notices: tuple[Notice, ...]  # about logs and maintenance; `notices` of this folder adds others
    seed: int  # seed of all random streams
    # Spectra of the logs of the history; None when no log covers the band of the modes.
    waterfall: Waterfall | None = None
    # Estimates of the last log, and of the first one of the baseline.
    latest: LogEstimates | None = None
    at_baseline: LogEstimates | None = None
    # Evidence for the fleet prior; None without a posterior of the life.
    evidence: fleet_prior.MachineEvidence | None = None
    # Fleet prior of the prognosis; None when it rests on the prior of the description.
    fleet: fleet_prior.FleetPrior | None = None
    # Lives before the present baseline, and what those of the fleet support; None with too few.
    ended: tuple[fleet_prior.EndedLife, ...] = ()
    calibration: fleet_prior.Calibration | None = None
    # Draws of ln health at the present baseline, over that at commissioning, of what no work has
    # restored, ``(n, n_parameters)``; None where nothing is lost.
    carried: FloatArray | None = None
    doubt: str = ""  # why names of modes, odometer or dates are in doubt; then there is no health
    today: date | None = None  # day of its status; None for that of the last log
    lost: tuple[Refusal, ...] = ()  # its logs that were refused as a whole, without estimates

    def __repr__(self) -> str:
        judged, service = self.judgement, self.service()
        at = f"{utc_day(judged.recorded_at)}: {judged.verdict}"
        lines = [f"Assessment of {judged.stage} at {at}", judged.why]
        lines += [f"Service: {service.kind} {service.by or ''}".rstrip()] * bool(self.prognosis)
        parts = ("history", "track", "health", "prognosis")
        there = ", ".join(name for name in parts if getattr(self, name) is not None)
        lines.append(f"{len(self.history.logs)} logs, {len(self.refused)} refusals; with {there}")
        return "\n".join(lines)

    @property
    def restored(self) -> set[str]:
        """Parameters that work after the last log has restored."""
        work = {notice.where for notice in self.notices if notice.code == "no-log-since"}
        return restored({one.name: one.word for one in self.stage.parameters}, work)

    @property
    def limits_left(self) -> Prognosis | None:
        """The remaining life without the limits that later work has restored; None without any."""
        return without_limits(self.prognosis, self.restored)

    def service(self) -> Service:
        """Choose the day of the service by the rule of the description, for `limits_left`."""
        return decide(self.limits_left, self.stage.description.decision)

    @property
    def alarmed(self) -> tuple[str, ...]:
        """Modes with an alarm since the baseline, when no verdict explains it."""
        if self.judgement.verdict not in NO_HEALTH:
            return ()
        alarms = undeclared_events(self.track, self.history.baseline, "alarm")
        return tuple(dict.fromkeys(event.mode for event in alarms))

    @property
    def drifted(self) -> dict[str, tuple[float, float]]:
        """Modes whose drift no scatter explains: change of ln f and its standard deviations.

        Only while the baseline has too few logs for a verdict: later ones allow for wander. An
        estimate of the last log that the filter has left out counts too, before the next confirms
        it.
        """
        track, history = self.track, self.history
        n_logs = len(history.logs) - history.baseline
        if track is None or self.alarmed or n_logs >= self.stage.description.baseline.logs:
            return {}
        drift, variance = track.drift[-1].copy(), np.diagonal(track.drift_cov[-1]).copy()
        last = len(track.logs) - 1
        for mode in (mode for epoch, mode in track.outliers if epoch == last):
            own, (shift,) = history.columns(mode), known_shifts(history, track, self.stage, [last])
            there = np.isfinite(history.ln_frequency[-1, own])
            k, column = track.modes.index(mode), own[int(there.argmax())]
            drift[k] = (history.ln_frequency[-1] - shift)[column] - track.ln_frequency[-2, k]
            variance[k] = history.cov[-1, column, column] + track.ln_frequency_std[-2, k] ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = np.abs(drift) / np.sqrt(variance)
        found = zip(track.modes, drift.tolist(), ratios.tolist(), strict=True)
        return {mode: (size, n_std) for mode, size, n_std in found if DRIFT_SIGMA < n_std < np.inf}

    @property
    def left_out(self) -> dict[str, int]:
        """Modes whose last logs are outliers of the track, and how many of these.

        A log of which no estimate has a name that is certain deviates at all of them: a jump may
        have moved modes to the places of others.
        """
        history, outliers = self.history, set(self.track.outliers if self.track else ())
        seen = np.isfinite(history.ln_frequency)
        left: dict[str, int] = {}
        for mode in {mode for _, mode in outliers}:
            own = np.flatnonzero(seen[:, list(history.columns(mode))].any(axis=1)).tolist()
            last = (n for n, k in enumerate(own[::-1]) if (k, mode) not in outliers)
            if n := next(last, len(own)):
                left[mode] = n
        refused = [(one.log, one.mode) for one in self.refused if one.reason in _NAMELESS]
        nameless = {log for log, _ in refused}
        n_seen = 1 + int(np.flatnonzero(seen.any(axis=1)).max(initial=-1))
        last_logs = [*takewhile(nameless.__contains__, reversed(history.logs[n_seen:]))]
        if last_logs:
            for mode in {*left, *(mode for log, mode in refused if log in last_logs and mode)}:
                left[mode] = left.get(mode, 0) + len(last_logs)
        return dict(sorted(left.items()))

    @property
    def compared(self) -> LogEstimates | None:
        """The first log of the baseline, beside which the last is shown; None if it is the last."""
        latest, before = self.latest, self.at_baseline
        return before if latest and before and before.log != latest.log else None

    @property
    def latest_health(self) -> Health | None:
        """The health as fractions of the baseline, if it has an epoch and a parameter."""
        health = self.health
        if health is None or not (health.recorded_at and health.parameters):
            return None
        return health.relative_to(np.array([spec.baseline for spec in self.stage.parameters]))

    @property
    def risen(self) -> tuple[str, ...]:
        """Parameters that are above their baselines, which no wear does."""
        health = self.latest_health
        if health is None:
            return ()
        names = health.parameters
        return tuple(compress(names, health.risen(np.ones(len(names)))))

    def urgency(self, service: Service) -> tuple[int, float, float, str]:
        """Return a sort key: day of the service; sudden changes first, no verdict before safe ones.

        Days of the calendar: a machine whose last log is old may be overdue.
        """
        identity, verdict = self.judgement.stage, self.judgement.verdict
        if verdict in NO_HEALTH:
            return (0 if self.alarmed or self.drifted else 1), 0.0, 0.0, identity
        if verdict == "step":  # until its cause is known, no day of a service counts
            return 0, 0.0, 0.0, identity
        if verdict == OUTSIDE_MAP:  # after services that were overdue then
            return 0, float(self.judgement.recorded_at.toordinal()), 0.0, identity
        if self.prognosis is None:
            return (1 if verdict == "healthy" else 0), 0.0, 0.0, identity
        day = np.inf if service.by is None else float(service.by.toordinal())
        group = 2 if verdict == "healthy" and service.kind == "later" else 0
        return group, day, float(self.prognosis.beyond_horizon()[-1]), identity


def assess(
    logs: Sequence[LogEstimates],
    stage: Stage,
    *,
    work: Maintenance = NO_MAINTENANCE,
    today: date | None = None,
    epochs: int = 40,
    seed: int = 0,
) -> Assessment:
    """Compute track, health, prognosis and verdict of one machine.

    Parameters
    ----------
    logs : sequence of LogEstimates
        Modal estimates of the logs of one machine, at least one.
    stage : Stage
        Its description.
    work : Maintenance
        Maintenance done to it; that of other machines is left out.
    today : date, optional
        Day of its status (`make_status`); that of the last log by default.
    epochs : int
        Most epochs at which health is inferred.
    seed : int
        Of all random numbers.

    Returns
    -------
    Assessment
        Results that the data do not support are None, with the reason among the notices.

    Raises
    ------
    BadStage
        If the stage is no result of `load_stage`.
    NotEnoughData
        If the logs are of several machines.
    BadQuestion
        If a log is there twice, or epochs or seed are out of range.

    Examples
    --------
    Two logs are not enough for a baseline, and the verdict states that:

    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage = lmshealth.load_stage("lms-y")
    >>> found = lmshealth.assess(examples.readings()[:2], stage, epochs=1)
    >>> found.judgement.verdict, found.judgement.why
    ('not-enough-data', '2 usable logs since the baseline began; it needs 5.')
    >>> found.notices[0].what.split("; ")[1]
    'a life needs at least 3 logs and some travel'
    """
    expect_stage(stage)
    logs = [*logs]
    expect_settings(epochs, seed)
    names: dict[object, list[str]] = {}
    for one in logs:
        content = one.digest or (one.log, one.metadata.recorded_at)
        names.setdefault(content, []).append(one.log)
    for same in names.values():
        if len(same) > 1:
            raise BadQuestion(f"{listed(same)} are one log; needed is each log once")
    machines = sorted({one.metadata.stage or "" for one in logs})
    if len(machines) > 1:
        named = ", ".join(machines)
        raise NotEnoughData(f"logs are of {len(machines)} machines: {named}; needed is one")
    own = work.of(machines[0]) if machines else work
    found, _ = assess_from(logs, stage, own, epochs=epochs, seed=seed)
    return replace(found, today=today)


def expect_settings(epochs: int, seed: int) -> None:
    """Raise `BadQuestion` where there is no epoch, or no such seed."""
    if epochs < 1 or seed < 0:
        raise BadQuestion(f"epochs = {epochs}, seed = {seed}: needed are at least 1 and at least 0")


def assess_from(
    readings: Sequence[LogEstimates],
    stage: Stage,
    work: Maintenance,
    *,
    epochs: int,
    seed: int,
    before: LifeState | None = None,
) -> tuple[Assessment, LifeState | None]:
    """Assess a machine as `assess` does, from the state that its assessment before has left.

    Also returned is the state from which the next assessment begins.
    """
    made = _before_tracking(readings, stage, work, seed)
    history = made.history
    try:
        tracked = track(history, stage)
    except LmshealthError as error:
        notice = Notice("no-result", "serious", "", str(error))
        return replace(made, notices=(*made.notices, notice)), None
    by_log = {reading.log: reading for reading in readings}
    used = [by_log[log] for log in history.logs]
    doubt = doubt_of_clock(history, made.refused) or doubt_of_names(stage, history, tracked, used)
    refused = (*made.refused, *outlier_refusals(history, tracked, stage))
    judgement = judge(stage, history, None, tracked, doubt=doubt)
    made = replace(made, track=tracked, doubt=doubt, refused=refused, judgement=judgement)
    if doubt or not stage.parameters:
        return made, None
    try:
        accepted = accepted_estimates(history, tracked, doubtful=True)
        return _with_results(made, accepted, work, epochs, before)
    except LmshealthError as error:
        why = str(error)
    except LinAlgError as error:  # one machine must not end the run
        why = fact(
            "{stage}: its logs lead to a singular matrix ({error}); please report this with "
            "modes.csv",
            stage=history.stage,
            error=error,
        )
    notice = Notice("no-result", "serious", "", why)
    return replace(made, notices=(*made.notices, notice)), None


def _before_tracking(
    readings: Sequence[LogEstimates], stage: Stage, work: Maintenance, seed: int
) -> Assessment:
    """Return what is known of a machine before its modes are tracked."""
    history, refused = build_history(readings, stage, work.actions)
    notices = maintenance_notices(work, [reading.metadata.recorded_at for reading in readings])
    notices += missing_mode_notices(history, refused)
    notices += contradiction_notices(history, refused)
    notices += baseline_notices(refused, history.logs[history.baseline])
    notices += covariate_notices(history.covariates, stage)
    not_excited = [refusal for reading in readings for refusal in reading.modes.refused]
    by_log = {reading.log: reading for reading in readings}
    used = [by_log[log] for log in history.logs]
    return Assessment(
        stage=stage,
        history=history,
        digests=tuple(reading.digest for reading in used),
        track=None,
        health=None,
        prognosis=None,
        judgement=judge(stage, history, None),
        refused=(*not_excited, *refused),
        notices=tuple(notices),
        seed=seed,
        waterfall=Waterfall.stack([(reading.spectra, reading.modes.lines) for reading in used]),
        latest=used[-1] if used else None,
        at_baseline=used[history.baseline] if used else None,
    )


@dataclass(frozen=True, slots=True, eq=False)
class LifeState:
    """State from which the next assessment of a machine begins."""

    start: LifeStart  # draws of its posterior
    n_logs: int
    verdict: str
    # Fingerprint of the logs before the baseline, the lives that ended with them, and what these
    # have left, as in `Assessment`.
    past: str
    ended: tuple[fleet_prior.EndedLife, ...]
    carried: FloatArray | None


def _with_results(
    made: Assessment, history: History, work: Maintenance, epochs: int, before: LifeState | None
) -> tuple[Assessment, LifeState]:
    """Add what follows from the posterior of the life of accepted estimates.

    emcee draws it the first time, after each sixteenth log and where the verdict changes; otherwise
    importance sampling updates it.
    """
    stage, every = made.stage, constants.EMCEE_EVERY
    seed = seed_of(made.seed, history.stage, stage.digest)
    past = _past(made, work)
    if before is not None and before.past != past:  # draws of another life are no start of this
        before = None
    if before is None:
        ended = fleet_prior.ended_lives(history, stage, seed)
        carried = _carried(history, stage, work, seed)
    else:
        ended, carried = before.ended, before.carried
    made = replace(made, carried=carried)
    chains = before is None or len(history.logs) // every > before.n_logs // every
    start = None if before is None else before.start
    life = fit_life(history, stage, seed, chains=chains, before=start)
    found = _with_life(made, life, history, epochs)
    if before is not None and not chains and found.judgement.verdict != before.verdict:
        life = fit_life(history, stage, seed, before=start)
        found = _with_life(made, life, history, epochs)
    found = replace(found, ended=ended, evidence=fleet_prior.machine_evidence(stage, life))
    n_logs, verdict = len(history.logs), found.judgement.verdict
    return found, LifeState(life.start, n_logs, verdict, past, ended, carried)


def _carried(
    history: History, stage: Stage, work: Maintenance, seed: tuple[int, ...]
) -> FloatArray | None:
    """Draw what lives before the present baseline have left, as `Assessment.carried`.

    By their laws up to the next baseline, as wear goes on after their last log. Work restores the
    parameters that `restored` names. Of a life with too few logs nothing is known, and nothing is
    carried.
    """
    words = {one.name: one.word for one in stage.parameters}
    rng = np.random.default_rng(stream(seed, _CARRIED_STEP))
    left, moments = np.zeros((constants.N_DRAWS, len(words))), history.recorded_at
    travel = with_clock(history, stage).travel
    for begin, end, after in fleet_prior.lives_before(history):
        done = {a.action for a in work.actions if moments[end - 1] < a.recorded_at <= moments[end]}
        again = restored(words, done)
        if again < words.keys():
            with suppress(LmshealthError, LinAlgError):
                life = fit_life(history.first_logs(end), stage, seed, chains=False)
                health = life.health_at(np.array([travel[after] - travel[begin]]), rng)[0]
                draws = np.log(np.maximum(health, _LEAST_HEALTH)).reshape(-1, len(words))
                left += rng.choice(draws, len(left))
        left[:, [name in again for name in words]] = 0.0
    return left if left.any() else None


def _past(made: Assessment, work: Maintenance) -> str:
    """Return the fingerprint of all that is known of the logs before the baseline."""
    own, n = made.history, made.history.baseline
    stated = {name: values[:n] for name, values in own.covariates.items()}
    rows = own.recorded_at[:n], own.travel[:n], own.ln_frequency[:n], own.cov[:n]
    steps = [(step.kind, step.first, step.source) for step in own.steps if step.first < n]
    earlier = (one for one in work.actions if one.recorded_at <= own.recorded_at[n])
    done = [(one.recorded_at, one.action) for one in earlier if one.action in RESETS]
    return fingerprint(own.logs[:n], made.digests[:n], rows, stated, own.baselines, steps, done)


def _with_life(made: Assessment, life: LifePosterior, history: History, epochs: int) -> Assessment:
    """Add what follows from the draws of a life: health, remaining life and verdict."""
    stage, prognosis, notices = made.stage, None, made.notices
    if made.carried is not None:
        life = life.carrying(made.carried)
    health = health_of(life, history, stage, epochs_to_publish(history, stage, epochs))
    if parameters_with_limit(stage):
        try:
            prognosis = prognosis_of(life, history, stage)
        except NotEnoughData as error:
            notice = Notice("no-result", "serious", "", str(error))
            notices = (*(one for one in notices if one != notice), notice)
    judgement = judge(stage, made.history, health, made.track, doubt=made.doubt)
    return replace(made, health=health, prognosis=prognosis, judgement=judgement, notices=notices)


def with_fleet_prior(
    found: Assessment, prior: fleet_prior.FleetPrior, *, epochs: int, before: LifeState | None
) -> Assessment:
    """Recompute health, prognosis and verdict with the prior of a fleet; there must be a track.

    Coordinates of scenarios do not depend on what a fleet changes of a description: draws of the
    posterior by the description are the start of that with the prior of the fleet.
    """
    assert found.track is not None  # of a machine with evidence
    history = accepted_estimates(found.history, found.track, doubtful=True)
    stage = prior.apply_to(found.stage)
    seed = seed_of(found.seed, history.stage, stage.digest)
    start = None if before is None else before.start
    life = fit_life(history, stage, seed, chains=before is None, before=start)
    made = _with_life(replace(found, stage=stage), life, history, epochs)
    return replace(made, stage=found.stage, fleet=prior)


def with_calibration(found: Assessment, ended: Sequence[fleet_prior.EndedLife]) -> Assessment:
    """Calibrate a prognosis by the ended lives of the fleet; there must be one."""
    assert found.prognosis is not None
    return replace(found, calibration=fleet_prior.calibrate(found.prognosis, tuple(ended)))
