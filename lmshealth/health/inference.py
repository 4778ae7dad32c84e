"""Health without a law: the health parameters at single epochs, from the drifts of the modes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.errors import BadStage, BadTable, NotConverged, NotEnoughData
from lmshealth.health.ensemble_sampling import (
    Sample,
    flattened,
    sample,
    start_from_prior,
    start_near,
    stream,
    thin,
)
from lmshealth.health.epoch_posterior import EpochPosterior, MachineDrifts
from lmshealth.health.laplace import approximate
from lmshealth.health.results import Health
from lmshealth.stage.description import Stage
from lmshealth.stage.identifiability import identifiability_of, identifiable_parameters
from lmshealth.stage.priors import JointPrior, combine_priors
from lmshealth.tracking.read_tables import Drifts
from lmshealth.tracking.track import Track

_N_KEPT = 1000  # draws of each ensemble
_N_SEARCHED = 200
# What share of the draws must be left by reweighting them for wider priors: with less, they do not
# reach far enough and new ones are made.
_LEAST_SHARE = 0.8
# Priors that the map keeps from getting wider by this say nothing about what hangs on them.
_LEAST_WIDENING = 1.2
_LEVELS = (0.05, 0.5, 0.95)
_N_JUDGED = 500  # draws by which the fit is judged


def epochs_to_infer(track: Drifts | Track, stage: Stage, most: int) -> tuple[int, ...]:
    """Choose at most so many epochs after the baseline, always with the last one."""
    columns = [track.modes.index(name) for name in stage.informative if name in track.modes]
    usable = np.flatnonzero(_drifted(track)[:, columns].any(axis=1))
    if usable.size <= most:
        return tuple(usable.tolist())
    # Counted from the last, which a single epoch must be.
    spaced = np.unique(np.linspace(usable.size - 1, 0, most).round().astype(int))
    return tuple(usable[spaced].tolist())


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
    track : Drifts or Track
        Drifts with covariance.
    stage : Stage
        Parameters, priors and modal map.
    seed : int or sequence of int
        Epoch k has the stream ``SeedSequence([*seed, k])``.
    epochs : sequence of int, optional
        Indices of the track; by default at most 40.
    mapper : callable
        ``map`` or the same of a pool of processes.

    Raises
    ------
    BadStage
        If the description has no health parameters.
    NotEnoughData
        If no mode of the track is on the map, or there is no epoch after the baseline.

    Examples
    --------
    A simulated machine has 72 % of its preload left, and 87 % of its mount stiffness:

    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage = lmshealth.load_stage("lms-y")
    >>> track = lmshealth.track(examples.history(), stage)
    >>> health = lmshealth.infer(track, stage, seed=0, epochs=[len(track.recorded_at) - 1])
    >>> for name, median in zip(health.parameters, health.latest(0.5)):
    ...     print(f"{name}: {median:.0%}")
    guide_preload: 72%
    mount_stiffness: 87%
    >>> low, high = health.latest(0.05), health.latest(0.95)
    >>> bool((low < [0.72, 0.87]).all() and (high > [0.72, 0.87]).all())
    True
    """
    modes = _usable_modes(track, stage)
    chosen = _chosen(track, stage, epochs)
    tasks = [EpochPosterior.of(stage, *_seen(track, modes, k)) for k in chosen]
    return _infer_all(track.stage, track, chosen, tasks, seed, mapper)


def infer_together(
    machines: Sequence[tuple[Drifts | Track, Stage]],
    shared: Sequence[str],
    seed: int | Sequence[int],
    *,
    epochs: Sequence[int] | None = None,
    mapper: Callable[..., object] = map,
) -> Health:
    """Infer the health of machines that share parts, such as one guide that serves both.

    Epochs are those of the first machine. Of every other one its last epoch not later counts: what
    is shared is taken not to have changed since then, and all baselines to be of the same state of
    what is shared.

    Parameters
    ----------
    machines : sequence of (Drifts or Track, Stage)
        At least two.
    shared : sequence of str
        Parameters that are one; the others are named ``<machine>:<parameter>``.
    seed, epochs, mapper
        As in `infer`; epochs count those of the first machine.

    Raises
    ------
    BadStage
        If a description does not have a shared parameter, or another prior of it.
    BadTable
        If two machines have one name.
    NotEnoughData
        As in `infer`; also if another machine has no epoch yet.

    Examples
    --------
    One guide serves an X and a Y configuration; a fifth of its preload is lost, and a tenth of the
    mount stiffness of Y:

    >>> from datetime import UTC, datetime
    >>> import numpy as np
    >>> import lmshealth
    >>> from lmshealth.tracktable import Drifts
    >>> machines = []
    >>> for name, health in (("lms-x", [0.8, 1.0]), ("lms-y", [0.8, 0.9])):
    ...     stage = lmshealth.load_stage(name)
    ...     modes, when = stage.informative, (datetime(2026, 7, 1, tzinfo=UTC),)
    ...     drift, cov = stage.drift(np.log([health]), modes), 1e-6 * np.eye(len(modes))[None]
    ...     seen = Drifts(name, when, np.array([1e6]), modes, drift, cov)
    ...     machines.append((seen, stage))
    >>> both = lmshealth.infer_together(machines, ["guide_preload"], seed=0)
    >>> rows = zip(both.parameters, both.latest(0.5), both.informed_parameters())
    >>> for name, median, informed in rows:
    ...     print(f"{name}: {median:.2f}" if informed else f"{name}: not informed")
    guide_preload: 0.80
    lms-x:mount_stiffness: not informed
    lms-y:mount_stiffness: 0.90
    """
    names, columns = _places(machines, shared)
    modes = [_usable_modes(track, stage) for track, stage in machines]
    first, stage = machines[0]
    usable = {t.stage: epochs_to_infer(t, own, len(t.recorded_at)) for t, own in machines}
    tasks, kept = [], []
    for k in _chosen(first, stage, epochs):
        views, priors = [], []
        for (track, own), used, places in zip(machines, modes, columns, strict=True):
            row = k if track is first else _last_before(track, usable[track.stage], first, k)
            if row is not None:
                views.append(MachineDrifts(own, *_seen(track, used, row), places))
                priors.append(own.prior)
        if len(views) == len(machines):
            prior = combine_priors(priors, columns)
            prior = JointPrior(names, prior.priors, prior.low, prior.high)
            tasks.append(EpochPosterior(prior, tuple(views)))
            kept.append(k)
    if not kept:
        raise NotEnoughData(
            f"{first.stage}: at none of its epochs had {machines[1][0].stage} one before; "
            "name the machine whose logs end last first"
        )
    label = " + ".join(track.stage for track, _ in machines)
    return _infer_all(label, first, tuple(kept), tasks, seed, mapper)


def _places(
    machines: Sequence[tuple[Drifts | Track, Stage]], shared: Sequence[str]
) -> tuple[tuple[str, ...], list[tuple[int, ...]]]:
    """Name all parameters, and say where those of each machine stand among them."""
    machine_names = [track.stage for track, _ in machines]
    twice = [name for k, name in enumerate(machine_names) if name in machine_names[:k]]
    if twice:
        raise BadTable(
            f"two machines are called {twice[0]!r}; their own parameters need names apart: give "
            "the tables a column stage"
        )
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


def _last_before(
    track: Drifts | Track, usable: Sequence[int], first: Drifts | Track, k: int
) -> int | None:
    """Last usable epoch of a track not later than one of another track."""
    before = [row for row in usable if track.recorded_at[row] <= first.recorded_at[k]]
    return before[-1] if before else None


def _usable_modes(track: Drifts | Track, stage: Stage) -> tuple[str, ...]:
    if not stage.parameters:
        raise BadStage(f"{stage.name}: no [[parameter]] to infer")
    modes = tuple(name for name in stage.informative if name in track.modes)
    if not modes:
        raise NotEnoughData(
            f"{track.stage}: none of the modes {list(stage.informative)} was tracked"
        )
    return modes


def _chosen(track: Drifts | Track, stage: Stage, epochs: Sequence[int] | None) -> tuple[int, ...]:
    chosen = tuple(epochs if epochs is not None else epochs_to_infer(track, stage, 40))
    if not chosen:
        raise NotEnoughData(
            f"{track.stage}: no epoch has a drift of any of the modes {list(stage.informative)} "
            "with a standard deviation above 0; those of the baseline itself have none"
        )
    return chosen


def _drifted(track: Drifts | Track) -> BoolArray:
    """Tell which drifts are there and not those of the baseline, ``(n_epochs, n_modes)``."""
    variance = np.einsum("kii->ki", track.drift_cov)
    return np.asarray(np.isfinite(track.drift) & np.isfinite(variance) & (variance > 0))


def _seen(
    track: Drifts | Track, modes: tuple[str, ...], k: int
) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Modes that are there at an epoch, their drifts and covariance."""
    there = _drifted(track)[k]
    modes = tuple(name for name in modes if there[track.modes.index(name)])
    columns = [track.modes.index(name) for name in modes]
    return modes, track.drift[k][columns], np.array(track.drift_cov[k][np.ix_(columns, columns)])


@dataclass(frozen=True, slots=True, eq=False)
class _Epoch:
    """Posterior of one epoch; ln parameters, arrays of shape ``(n_parameters,)`` if not told."""

    draws: FloatArray  # (n_ensembles, n_draws, n_parameters)
    ess_bulk: FloatArray
    ess_tail: FloatArray
    r_hat: FloatArray
    converged: bool
    laplace_shift: FloatArray
    laplace_ratio: FloatArray
    prior_shift: FloatArray
    prior_ratio: FloatArray
    fit: float
    at_edge: BoolArray


def draw(posterior: EpochPosterior, seed: np.random.SeedSequence) -> Sample:
    """Draw ln parameters from the posterior of an epoch.

    Raises
    ------
    NotConverged
        With the chains.
    """
    return _draw(posterior, seed)[0]


def _draw(
    posterior: EpochPosterior, seed: np.random.SeedSequence
) -> tuple[Sample, FloatArray, FloatArray]:
    """Sample, and the mean and width it has by Laplace's approximation."""
    begin = posterior.prior.quantile(_spread(_N_SEARCHED, len(posterior.prior.names)))
    low, high = posterior.prior.support
    normal = approximate(posterior.log_probability, begin, low, high)
    if normal is None:
        start = start_from_prior(posterior.log_probability, posterior.draw_prior)
        nothing = np.full(low.size, np.nan)
        return sample(posterior.log_probability, start, seed), nothing, nothing
    start = start_near(normal.mode, normal.cov, posterior.log_probability)
    return sample(posterior.log_probability, start, seed), normal.mode, normal.std


def _spread(n: int, n_dim: int) -> FloatArray:
    """Levels that fill the unit cube evenly, the same ones every time: ``(n, n_dim)``."""
    from scipy.stats import qmc

    return np.asarray(qmc.Halton(n_dim, scramble=False).random(n + 1)[1:])


def _infer_epoch(posterior: EpochPosterior, seed: int | Sequence[int], epoch: int) -> _Epoch:
    chain_seed, wider_seed = stream(seed, epoch).spawn(2)
    unknown = np.full(len(posterior.prior.names), np.nan)
    try:
        found, mode, std = _draw(posterior, chain_seed)
    except NotConverged as error:
        chains = np.asarray(error.chains)
        if chains.ndim != 4:  # no start: the description is at fault, not this epoch
            raise
        draws = thin(flattened(chains), _N_KEPT)
        x = draws.reshape(-1, draws.shape[-1])
        return _Epoch(
            draws=draws,
            ess_bulk=unknown,
            ess_tail=unknown,
            r_hat=unknown,
            converged=False,
            laplace_shift=unknown,
            laplace_ratio=unknown,
            prior_shift=unknown,
            prior_ratio=unknown,
            fit=posterior.fit(x[:: x.shape[0] // _N_JUDGED]),
            at_edge=posterior.at_edge(x),
        )
    x = found.flat
    low, middle, high = np.quantile(x, _LEVELS, axis=0)
    try:
        wider = _wider_quantiles(posterior, found, wider_seed)
    except NotConverged:  # what the check cannot say does not touch the posterior itself
        wider = np.full((len(_LEVELS), x.shape[1]), np.nan)
    return _Epoch(
        draws=found.thinned(_N_KEPT),
        ess_bulk=found.ess_bulk,
        ess_tail=found.ess_tail,
        r_hat=found.r_hat,
        converged=True,
        laplace_shift=(x.mean(axis=0) - mode) / std,
        laplace_ratio=x.std(axis=0) / std,
        prior_shift=(wider[1] - middle) / x.std(axis=0),
        prior_ratio=(wider[2] - wider[0]) / (high - low),
        fit=posterior.fit(x[:: x.shape[0] // _N_JUDGED]),
        at_edge=posterior.at_edge(x),
    )


def _wider_quantiles(
    posterior: EpochPosterior, found: Sample, seed: np.random.SeedSequence
) -> FloatArray:
    """Quantiles of the ln parameters under priors twice as wide, shape ``(3, n_parameters)``.

    NaN for a parameter whose prior hardly gets wider, because the map ends.
    """
    quantiles = _under_wider_priors(posterior, found, seed)
    ends = np.array([[_LEVELS[0]], [_LEVELS[-1]]])
    before, after = (
        np.ptp(prior.quantile(ends), axis=0)
        for prior in (posterior.prior, posterior.widened().prior)
    )
    return np.where(after < _LEAST_WIDENING * before, np.nan, quantiles)


def _under_wider_priors(
    posterior: EpochPosterior, found: Sample, seed: np.random.SeedSequence
) -> FloatArray:
    x, wider = found.flat, posterior.widened()
    log_weight = wider.prior.log_density(x) - posterior.prior.log_density(x)
    weight = np.exp(log_weight - log_weight.max())
    if weight.sum() ** 2 / np.sum(weight**2) < _LEAST_SHARE * weight.size:
        return np.quantile(_draw(wider, seed)[0].flat, _LEVELS, axis=0)
    return np.column_stack(
        [np.quantile(column, _LEVELS, weights=weight, method="inverted_cdf") for column in x.T]
    )


def _infer_all(
    name: str,
    track: Drifts | Track,
    chosen: tuple[int, ...],
    tasks: Sequence[EpochPosterior],
    seed: int | Sequence[int],
    mapper: Callable[..., object],
) -> Health:
    # Arrays are small: threads inside linear algebra would only wait for one another.
    with threadpool_limits(1, user_api="blas"):
        found: list[_Epoch] = list(mapper(_infer_epoch, tasks, [seed] * len(tasks), chosen))  # type: ignore[call-overload]
    prior = tasks[0].prior
    variance = prior.variance
    low, high = prior.quantile(np.array([[0.05], [0.95]]))
    x = np.stack([one.draws for one in found])
    flat = x.reshape(len(found), -1, x.shape[-1])

    def stacked(what: str) -> FloatArray:
        return np.stack([getattr(one, what) for one in found])

    return Health(
        stage=name,
        recorded_at=tuple(track.recorded_at[k] for k in chosen),
        travel=track.travel[list(chosen)],
        parameters=prior.names,
        chains=np.exp(x),
        ess_bulk=stacked("ess_bulk"),
        ess_tail=stacked("ess_tail"),
        r_hat=stacked("r_hat"),
        converged=np.array([one.converged for one in found]),
        informed=np.clip(1 - flat.var(axis=1) / variance, 0, 1),
        prior_width=np.exp(high) - np.exp(low),
        identifiable=_identifiable(tasks, variance),
        correlation=np.stack([np.atleast_2d(np.corrcoef(one, rowvar=False)) for one in flat]),
        laplace_shift=stacked("laplace_shift"),
        laplace_ratio=stacked("laplace_ratio"),
        prior_shift=stacked("prior_shift"),
        prior_ratio=stacked("prior_ratio"),
        fit=np.array([one.fit for one in found]),
        at_edge=np.stack([one.at_edge for one in found]),
        seed=tuple(np.atleast_1d(seed).tolist()),
    )


def _identifiable(tasks: Sequence[EpochPosterior], prior: FloatArray) -> BoolArray:
    """Tell what the modes that an epoch has could tell, ``(n_epochs, n_parameters)``."""
    known: dict[tuple[tuple[str, ...], ...], BoolArray] = {}
    machines = [identifiability_of(view.stage) for view in tasks[0].machines]
    for task in tasks:
        modes = tuple(view.modes for view in task.machines)
        if modes not in known:
            cut = [seen.restricted_to(own) for seen, own in zip(machines, modes, strict=True)]
            known[modes] = identifiable_parameters(
                cut, [view.columns for view in task.machines], prior
            )
    return np.stack([known[tuple(view.modes for view in task.machines)] for task in tasks])
