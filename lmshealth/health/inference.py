"""Inference of the health parameters at single epochs from the drifts of the modes."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from lmshealth._private.arrays import BoolArray, FloatArray, ReadOnly
from lmshealth._private.seeds import stream
from lmshealth.errors import BadStage, BadTable, NotConverged, NotEnoughData
from lmshealth.health import constants
from lmshealth.health.ensemble_sampling import (
    Sample,
    flattened,
    sample,
    sample_by_importance,
    start_from_prior,
    start_near,
    thin,
)
from lmshealth.health.epoch_posterior import EpochPosterior, MachineDrifts
from lmshealth.health.laplace import Laplace, approximate
from lmshealth.health.results import CHECKS, Health
from lmshealth.stage.description import Stage
from lmshealth.stage.identifiability import identifiability_of, identifiable_parameters
from lmshealth.stage.priors import combine_priors
from lmshealth.tracking.read_tables import Drifts
from lmshealth.tracking.track import Track

_N_KEPT = 1000  # draws kept of each ensemble
_N_SEARCHED = 200  # points of the prior among which the search for the mode starts
_N_FIT = 500  # draws that the fit is computed from
# Effective share of draws that reweighting for wider priors must leave; with less they do not
# cover the wider posterior, and it is sampled.
_MIN_SHARE = 0.8
_LEVELS = (0.05, 0.5, 0.95)


def epochs_to_infer(track: Drifts | Track, stage: Stage, most: int) -> tuple[int, ...]:
    """Choose at most so many epochs after the baseline, with the last, nested as logs are added.

    Of the others those whose number divides by the highest power of two go first, and of these the
    latest: after one more log, no epoch is among them that was not before, or was not the last.
    """
    columns = [track.modes.index(name) for name in stage.informative if name in track.modes]
    usable = np.flatnonzero(_has_drift(track)[:, columns].any(axis=1))
    number = np.arange(usable.size)
    power = np.where(number > 0, number & -number, 2 * number.size + 1)
    power[-1:] = 4 * number.size + 1
    chosen = np.lexsort((number, power))[max(usable.size - most, 0) :]
    return tuple(usable[np.sort(chosen)].tolist())


def infer(
    track: Drifts | Track,
    stage: Stage,
    seed: int | Sequence[int],
    *,
    epochs: Sequence[int] | None = None,
    mapper: Callable[..., object] = map,
) -> Health:
    """Infer the health parameters at several epochs.

    Parameters
    ----------
    track, stage : Drifts or Track, Stage
        Drifts with covariance; parameters, priors and modal map.
    seed, epochs : int or sequence of int, sequence of int
        Epoch k has the stream ``SeedSequence([*seed, k])``; by default at most 40 of the track.
    mapper : callable
        ``map``, or that of a pool of processes.

    Raises
    ------
    BadStage
        If the description has no health parameter.
    NotEnoughData
        If no mode of the track is on the map, or no epoch follows the baseline.

    Examples
    --------
    A simulated machine with 72 % of its preload and 87 % of its mount stiffness left:

    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage = lmshealth.load_stage("lms-y")
    >>> track = lmshealth.track(examples.history(), stage)
    >>> health = lmshealth.infer(track, stage, seed=1, epochs=[len(track.recorded_at) - 1])
    >>> for name, median in zip(health.parameters, health.latest(0.5)):
    ...     print(f"{name}: {median:.0%}")
    guide_preload: 71%
    mount_stiffness: 88%
    >>> low, high = health.latest(0.05), health.latest(0.95)
    >>> bool((low < [0.72, 0.87]).all() and (high > [0.72, 0.87]).all())
    True
    """
    modes = _usable_modes(track, stage)
    chosen = _chosen(track, stage, epochs)
    tasks = [EpochPosterior.of(stage, *_drifts_at(track, modes, k)) for k in chosen]
    return _infer_all(track.stage, track, chosen, tasks, seed, mapper)


def infer_together(
    machines: Sequence[tuple[Drifts | Track, Stage]],
    shared: Sequence[str],
    seed: int | Sequence[int],
    *,
    epochs: Sequence[int] | None = None,
    mapper: Callable[..., object] = map,
) -> Health:
    """Infer the health of machines that share parts, such as one guide in two configurations.

    Each epoch of the first machine is combined with the last epoch, not later, of every other one:
    shared parts are assumed unchanged since then, and all baselines of one state of them.

    Parameters
    ----------
    machines, shared : sequence of (Drifts or Track, Stage), sequence of str
        At least two; shared parameters: the others are named ``<machine>:<parameter>``.
    seed, epochs, mapper
        As in `infer`; epochs count those of the first machine.

    Raises
    ------
    BadStage
        If a description lacks a shared parameter or has another prior of it.
    BadTable
        If two machines have one name.
    NotEnoughData
        As in `infer`, or if another machine has no epoch by then.

    Examples
    --------
    One guide serves an X and a Y configuration; it has lost a fifth of its preload, and Y a tenth
    of its mount stiffness:

    >>> from datetime import UTC, datetime
    >>> import numpy as np
    >>> import lmshealth
    >>> from lmshealth.tracking.read_tables import Drifts
    >>> machines = []
    >>> for name, health in (("lms-x", [0.8, 1.0]), ("lms-y", [0.8, 0.9])):
    ...     stage = lmshealth.load_stage(name)
    ...     modes, when = stage.informative, (datetime(2026, 7, 1, tzinfo=UTC),)
    ...     drift, cov = stage.drift(np.log([health]), modes), 1e-6 * np.eye(len(modes))[None]
    ...     drifts = Drifts(name, when, np.array([1e6]), modes, drift, cov)
    ...     machines.append((drifts, stage))
    >>> both = lmshealth.infer_together(machines, ["guide_preload"], seed=0)
    >>> rows = zip(both.parameters, both.latest(0.5), both.publishable_parameters())
    >>> for name, median, publishable in rows:
    ...     print(f"{name}: {median:.2f}" if publishable else f"{name}: not informed")
    guide_preload: 0.80
    lms-x:mount_stiffness: not informed
    lms-y:mount_stiffness: 0.90
    """
    names, columns = _place_parameters(machines, shared)
    modes = [_usable_modes(track, stage) for track, stage in machines]
    first, stage = machines[0]
    usable = [epochs_to_infer(track, own, len(track.recorded_at)) for track, own in machines]
    prior = replace(combine_priors([own.prior for _, own in machines], columns), names=names)
    tasks, kept = [], []
    for k in _chosen(first, stage, epochs):
        rows = [k]
        for (track, _), own in zip(machines[1:], usable[1:], strict=True):
            rows += [r for r in own if track.recorded_at[r] <= first.recorded_at[k]][-1:]
        if len(rows) == len(machines):
            parts = zip(machines, modes, rows, columns, strict=True)
            drifts = tuple(
                MachineDrifts(own, *_drifts_at(track, used, row), places)
                for (track, own), used, row, places in parts
            )
            tasks.append(EpochPosterior(prior, drifts))
            kept.append(k)
    if not kept:
        missing = f"none of its epochs has an epoch of {machines[1][0].stage} at or before it"
        needed = "name the machine whose logs end last first"
        raise NotEnoughData(f"{first.stage}: {missing}; {needed}")
    label = " + ".join(track.stage for track, _ in machines)
    return _infer_all(label, first, tuple(kept), tasks, seed, mapper)


def _place_parameters(
    machines: Sequence[tuple[Drifts | Track, Stage]], shared: Sequence[str]
) -> tuple[tuple[str, ...], list[tuple[int, ...]]]:
    """Name all parameters; return the indices of those of each machine among them."""
    machine_names = [track.stage for track, _ in machines]
    twice = [name for k, name in enumerate(machine_names) if name in machine_names[:k]]
    if twice:
        needed = "their own parameters need different names: give the tables a column stage"
        raise BadTable(f"two machines are called {twice[0]!r}; {needed}")
    names: list[str] = []
    columns = []
    for track, stage in machines:
        own = [parameter.name for parameter in stage.parameters]
        missing = [name for name in shared if name not in own]
        if missing:
            raise BadStage(f"{stage.name}: no parameter {missing} to share; there are {own}")
        full = [name if name in shared else f"{track.stage}:{name}" for name in own]
        names += [name for name in full if name not in names]
        columns.append(tuple(names.index(name) for name in full))
    return tuple(names), columns


def _usable_modes(track: Drifts | Track, stage: Stage) -> tuple[str, ...]:
    if not stage.parameters:
        raise BadStage(f"{stage.name}: no [[parameter]] to infer")
    modes = tuple(name for name in stage.informative if name in track.modes)
    if not modes:
        needed = list(stage.informative)
        raise NotEnoughData(f"{track.stage}: none of the modes {needed} was tracked")
    return modes


def _chosen(track: Drifts | Track, stage: Stage, epochs: Sequence[int] | None) -> tuple[int, ...]:
    most = constants.MAX_EPOCHS
    chosen = tuple(epochs if epochs is not None else epochs_to_infer(track, stage, most))
    if not chosen:
        raise NotEnoughData(
            f"{track.stage}: no epoch has a drift of any of the modes {list(stage.informative)} "
            "with a standard deviation above 0; those of the baseline itself have none"
        )
    return chosen


def _has_drift(track: Drifts | Track) -> BoolArray:
    """Return which modes have a drift that is not the baseline's, ``(n_epochs, n_modes)``."""
    variance = np.einsum("kii->ki", track.drift_cov)
    return np.asarray(np.isfinite(track.drift) & np.isfinite(variance) & (variance > 0))


def _drifts_at(
    track: Drifts | Track, modes: tuple[str, ...], k: int
) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Return the modes present at an epoch, their drifts and covariance."""
    present = _has_drift(track)[k]
    modes = tuple(name for name in modes if present[track.modes.index(name)])
    columns = [track.modes.index(name) for name in modes]
    return modes, track.drift[k][columns], np.array(track.drift_cov[k][np.ix_(columns, columns)])


@dataclass(frozen=True, slots=True, eq=False)
class Epoch(ReadOnly):
    """Result of one epoch: draws of ln parameters ``(n_ensembles, n_draws, n_parameters)``.

    All else is as in `Health`.
    """

    draws: FloatArray
    converged: bool
    fit: float
    at_edge: BoolArray
    checks: FloatArray  # in the order of `CHECKS`, ``(n_checks, n_parameters)``


def draw(
    posterior: EpochPosterior,
    seed: np.random.SeedSequence,
    n_ensembles: int = constants.N_ENSEMBLES,
) -> Sample:
    """Draw ln parameters of an epoch by emcee, started from Laplace's approximation if possible."""
    normal = laplace(posterior)
    if normal is None:
        start = start_from_prior(posterior.log_probability, posterior.prior.draw)
    else:
        start = start_near(normal.mode, normal.cov, posterior.log_probability)
    return sample(posterior.log_probability, start, seed, n_ensembles)


def laplace(posterior: EpochPosterior) -> Laplace | None:
    """Approximate the posterior of an epoch by a normal distribution, if that is possible."""
    from scipy.stats import qmc  # late: it takes longer to import than all else here

    low, high = posterior.prior.support
    halton = qmc.Halton(low.size, scramble=False).random(_N_SEARCHED + 1)[1:]
    return approximate(posterior.log_probability, posterior.prior.quantile(halton), low, high)


def _drawn(posterior: EpochPosterior, seed: np.random.SeedSequence) -> tuple[Sample, bool]:
    """Draw by importance sampling, else by chains; return which of them it was."""
    by_importance, by_chains = seed.spawn(2)
    logp, prior = posterior.log_probability, posterior.prior
    try:
        return sample_by_importance(logp, prior.draw, by_importance), True
    except NotConverged:
        return draw(posterior, by_chains), False


def _infer_epoch(
    posterior: EpochPosterior, seed: int | Sequence[int], epoch: int, judged: bool
) -> Epoch:
    """Sample one epoch; where it is judged, by chains too."""
    chain_seed, wider_seed, judge_seed = stream(seed, epoch).spawn(3)
    missing = np.full(len(posterior.prior.names), np.nan)
    found: dict[str, Any] = dict.fromkeys(CHECKS, missing)
    try:
        drawn, weighted = _drawn(posterior, chain_seed)
    except NotConverged as error:
        chains = np.asarray(error.chains)
        if chains.ndim != 4:  # no start: a fault of the description, not of this epoch
            raise
        draws = thin(flattened(chains), _N_KEPT)
        x = np.concatenate(draws)
    else:
        draws, x = thin(drawn.draws, _N_KEPT), drawn.flat
        found |= {name: getattr(drawn, name) for name in ("ess_bulk", "ess_tail", "r_hat")}
        if (normal := laplace(posterior)) is not None:
            found["laplace_shift"] = (x.mean(axis=0) - normal.mode) / normal.std
            found["laplace_ratio"] = x.std(axis=0) / normal.std
        with suppress(NotConverged):  # only the check is missing
            wider = _wider_quantiles(posterior, drawn, wider_seed)
            found |= _change("prior", drawn, wider)
        if judged and weighted:
            with suppress(NotConverged):  # only the judge is missing
                other = draw(posterior, judge_seed, constants.JUDGE_ENSEMBLES).flat
                found |= _change("judge", drawn, np.quantile(other, _LEVELS, axis=0))
    converged = bool(np.isfinite(found["r_hat"]).all())
    fit, edge = posterior.fit(x[:: max(x.shape[0] // _N_FIT, 1)]), posterior.at_edge(x)
    return Epoch(draws, converged, fit, edge, np.stack([found[name] for name in CHECKS]))


def _change(name: str, drawn: Sample, quantiles: FloatArray) -> dict[str, FloatArray]:
    """Return shift and ratio of quantiles ``(3, n_parameters)`` from draws, as in `Health`."""
    low, middle, high = np.quantile(drawn.flat, _LEVELS, axis=0)
    shift = (quantiles[1] - middle) / drawn.flat.std(axis=0)
    return {f"{name}_shift": shift, f"{name}_ratio": np.ptp(quantiles[::2], axis=0) / (high - low)}


def _wider_quantiles(
    posterior: EpochPosterior, drawn: Sample, seed: np.random.SeedSequence
) -> FloatArray:
    """Return quantiles of ln parameters under wider priors, shape ``(3, n_parameters)``.

    NaN for a parameter whose prior the map hardly lets widen.
    """
    x, prior = drawn.flat, posterior.prior
    wider = replace(posterior, prior=prior.widened(constants.PRIOR_FACTOR))
    log_weight = wider.prior.log_density(x) - prior.log_density(x)
    weight = np.exp(log_weight - log_weight.max())
    if weight.sum() ** 2 / np.sum(weight**2) < _MIN_SHARE * weight.size:
        quantiles = np.quantile(_drawn(wider, seed)[0].flat, _LEVELS, axis=0)
    else:
        options: dict[str, Any] = {"weights": weight, "method": "inverted_cdf"}
        quantiles = np.column_stack([np.quantile(one, _LEVELS, **options) for one in x.T])
    ends = np.array([[_LEVELS[0]], [_LEVELS[-1]]])
    before, after = (np.ptp(one.quantile(ends), axis=0) for one in (prior, wider.prior))
    return np.where(after < constants.MIN_WIDENING * before, np.nan, quantiles)


def _infer_all(
    name: str,
    track: Drifts | Track,
    chosen: tuple[int, ...],
    tasks: Sequence[EpochPosterior],
    seed: int | Sequence[int],
    mapper: Callable[..., object],
) -> Health:
    judged = [k % constants.JUDGED_EVERY == 0 or k == chosen[-1] for k in chosen]
    # Arrays are small: threads inside linear algebra would only wait for one another.
    with threadpool_limits(1, user_api="blas"):
        columns = tasks, [seed] * len(tasks), chosen, judged
        found: list[Epoch] = list(mapper(_infer_epoch, *columns))  # type: ignore[call-overload]
    stacked = {one.name: np.stack([getattr(e, one.name) for e in found]) for one in fields(Epoch)}
    x, prior = stacked.pop("draws"), tasks[0].prior
    stacked |= dict(zip(CHECKS, np.swapaxes(stacked.pop("checks"), 0, 1), strict=True))
    variance = prior.variance
    low, high = prior.quantile(np.array([[0.05], [0.95]]))
    flat = x.reshape(len(found), -1, x.shape[-1])
    return Health(
        stage=name,
        recorded_at=tuple(track.recorded_at[k] for k in chosen),
        travel=track.travel[list(chosen)],
        parameters=prior.names,
        chains=np.exp(x),
        informed=np.clip(1 - flat.var(axis=1) / variance, 0, 1),
        prior_width=np.exp(high) - np.exp(low),
        identifiable=_identifiable(tasks, variance),
        correlation=np.stack([np.atleast_2d(np.corrcoef(one, rowvar=False)) for one in flat]),
        seed=tuple(np.atleast_1d(seed).tolist()),
        **stacked,
    )


def _identifiable(tasks: Sequence[EpochPosterior], prior: FloatArray) -> BoolArray:
    """Return the identifiable parameters by the modes of each epoch, as `Health` has them."""
    models = [identifiability_of(machine.stage) for machine in tasks[0].machines]
    columns = [machine.columns for machine in tasks[0].machines]

    @cache
    def by_modes(*modes: tuple[str, ...]) -> BoolArray:
        cut = [one.restricted_to(own) for one, own in zip(models, modes, strict=True)]
        return identifiable_parameters(cut, columns, prior)

    return np.stack([by_modes(*(machine.modes for machine in task.machines)) for task in tasks])
