"""Health parameters of a life at its epochs: `infer`, and its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, diagonal, freeze
from lmshealth._private.result import Result
from lmshealth._private.serialize import stream
from lmshealth._private.tables import TABLES
from lmshealth.errors import BadQuestion, BadStage, NotEnoughData
from lmshealth.io.log import utc_day
from lmshealth.life import constants
from lmshealth.life.posterior.data import clock_and_steps, clock_travel, with_clock
from lmshealth.life.posterior.fit import LifePosterior, LoneMode, fit_life
from lmshealth.life.posterior.likelihood import default_scatter
from lmshealth.stage.constants import INFORMED
from lmshealth.stage.description import Stage
from lmshealth.stage.identifiability import identifiability_of
from lmshealth.tracking.history import History, Series
from lmshealth.tracking.read_tables import Drifts

if TYPE_CHECKING:
    from xarray import DataTree

# Quantiles in the tables of a posterior.
QUANTILES = {"median": 0.5, "q05": 0.05, "q25": 0.25, "q75": 0.75, "q95": 0.95}
_STEP = 1 << 19  # of the random stream
_EXACT = 1e-12  # variance of ln f at the baseline of a table of drifts
# Diagnostics with one number per epoch and parameter.
CHECKS = ("r_hat", "ess_bulk", "ess_tail", "judge_shift", "judge_ratio")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Health(Result):
    """Health parameters at several epochs given all logs, in their units.

    All epochs are of the same draws of the life, in one order, that the remaining life is of too.
    Arrays have the shape ``(n_epochs, n_parameters)`` where none is stated.
    """

    stage: str  # identity of the machine
    recorded_at: tuple[datetime, ...]  # ascending, the last is now
    travel: FloatArray  # odometer in m, ``(n_epochs,)``
    parameters: tuple[str, ...]
    chains: FloatArray  # draws, ``(n_epochs, n_ensembles, n_draws, n_parameters)``
    modes: tuple[str, ...]  # from which health is inferred
    # Index of the mode that moves alone in each draw of the last epoch, by a cause that the map
    # does not have, or -1, ``(n_ensembles, n_draws)``; these modes, the most probable first.
    lone: np.ndarray
    lone_modes: tuple[LoneMode, ...]
    # What drew the probable scenarios: ``emcee``, or ``importance`` in an update, ``(n_epochs,)``.
    sampler: tuple[str, ...]
    # Smallest effective sample size of the chains, for the middle and for the 5 and 95 % quantiles
    # (of importance sampling by the weights, for both), and largest rank-normalised split R-hat:
    # of the chains of each scenario, as draws of their mixture are in the order of scenarios.
    ess_bulk: FloatArray
    ess_tail: FloatArray
    r_hat: FloatArray
    # Change of the median of ln parameter from importance sampling to emcee, in posterior standard
    # deviations, and ratio of the 90 % intervals; NaN where emcee did not run.
    judge_shift: FloatArray
    judge_ratio: FloatArray
    informed: FloatArray  # share of the prior variance of ln parameter that the data removed
    prior_width: FloatArray  # width of the prior's 90 % interval
    # Whether unlimited logs with the modes inform the parameter on average over the priors. An
    # unidentifiable one may be `informed` by chance: near 0 the map has no error.
    identifiable: BoolArray
    correlation: FloatArray  # of ln parameters, ``(n_epochs, n_parameters, n_parameters)``
    fit: FloatArray  # probability of residuals as large as those of the life, ``(n_epochs,)``
    at_edge: BoolArray  # whether the posterior ends at an end of the map, which bounds the value
    seed: tuple[int, ...]

    def __post_init__(self) -> None:
        n, p = len(self.recorded_at), len(self.parameters)
        freeze(
            self,
            ("chains", n, *self.chains.shape[1:3], p),
            (" ".join(["informed prior_width at_edge identifiable", *CHECKS]), n, p),
            ("correlation", n, p, p),
            ("lone", *self.chains.shape[1:3]),
            ("travel fit", n),
        )

    def relative_to(self, baselines: FloatArray) -> Health:
        """Return the posterior of the parameters divided by their baseline values."""
        width = self.prior_width / baselines
        return replace(self, chains=self.chains / baselines, prior_width=width)

    @property
    def samples(self) -> FloatArray:
        """Draws of all ensembles, shape ``(n_epochs, n_draws, n_parameters)``."""
        return self.chains.reshape(self.chains.shape[0], -1, self.chains.shape[-1])

    @property
    def ess(self) -> FloatArray:
        """Smaller effective sample size, shape ``(n_epochs, n_parameters)``."""
        return np.minimum(self.ess_bulk, self.ess_tail)

    def publishable_parameters(self) -> BoolArray:
        """Return which values of the last epoch may be published, shape ``(n_parameters,)``.

        The logs are explained, and the parameter is identifiable and informed.
        """
        seen = self.identifiable[-1] & (self.informed[-1] >= INFORMED)
        return np.asarray(self.explained & seen)

    @property
    def explained(self) -> bool:
        """Whether some life of the parameters, or a mode that moved alone, explains the logs."""
        return not self.fit[-1] < constants.MIN_FIT

    def quantile(self, level: float | FloatArray) -> FloatArray:
        """Return quantiles at every epoch, shape ``(..., n_epochs, n_parameters)``."""
        return np.asarray(np.quantile(self.samples, level, axis=1))

    def latest(self, level: float | FloatArray) -> FloatArray:
        """Return quantiles at the last epoch, shape ``(..., n_parameters)``."""
        return np.asarray(np.quantile(self.samples[-1], level, axis=0))

    def risen(self, baselines: FloatArray) -> BoolArray:
        """Return which parameters are above their baselines, which no wear does, at the last epoch.

        Of those that may be published; shape ``(n_parameters,)`` as of the baselines.
        """
        above = self.latest(np.array(0.05)) > constants.RISEN * baselines
        return np.asarray(above & self.publishable_parameters())

    def title(self) -> str:
        """Return machine, number of epochs, and the last one."""
        n = len(self.recorded_at)
        last = f"; posterior at {utc_day(self.recorded_at[-1])}" if n else ""
        return f"Health of {self.stage}: {n} epochs{last}"

    def digest_columns(self) -> dict[str, Any]:
        """Return quantiles and diagnostics of the last epoch."""
        names = ("parameter", "median", "q05", "q95", "informed", "identifiable")
        return {name: self.to_columns()[name][-len(self.parameters) :] for name in names}

    def to_columns(self) -> dict[str, Any]:
        """Return the columns of ``health.csv``, one row per epoch and parameter."""
        n, p = len(self.recorded_at), len(self.parameters)
        quantiles = self.quantile(np.array(list(QUANTILES.values())))
        columns = TABLES["health"].read(
            self,
            recorded_at=np.array([moment.isoformat() for moment in self.recorded_at])[:, None],
            travel_km=self.travel[:, None] / 1000,
            parameter=self.parameters,
            converged=True,
            sampler=np.array(self.sampler)[:, None],
            fit=self.fit[:, None],
            **dict(zip(QUANTILES, quantiles, strict=True)),
        )
        names = enumerate(self.parameters)
        columns |= {f"correlation_{name}": self.correlation[:, :, j] for j, name in names}
        return {name: np.broadcast_to(own, (n, p)).ravel() for name, own in columns.items()}

    def to_arviz(self) -> DataTree:
        """Return the draws, with the ensembles as chains, and the diagnostics for ArviZ.

        ``to_arviz().to_netcdf(file, engine="h5netcdf")`` writes a file for
        ``xarray.open_datatree``.
        """
        import arviz_base  # late: its import takes a second

        # xarray has no time zones: moments in UTC.
        moments = [moment.astimezone(UTC).replace(tzinfo=None) for moment in self.recorded_at]
        coords = {"epoch": np.array(moments, dtype="datetime64[us]")}
        draws = np.moveaxis(self.chains, 0, 2)  # chain, draw, epoch
        checks = {
            f"{what}_{name}": getattr(self, what)[:, j]
            for what in ("informed", "identifiable", "at_edge", *CHECKS)
            for j, name in enumerate(self.parameters)
        }
        pairs = combinations(enumerate(self.parameters), 2)
        checks |= {f"correlation_{a}_{b}": self.correlation[:, i, j] for (i, a), (j, b) in pairs}
        checks |= {"travel_m": self.travel, "fit": self.fit}
        posterior = {name: draws[..., j] for j, name in enumerate(self.parameters)}
        return arviz_base.from_dict(
            {"posterior": posterior, "checks_data": checks},
            coords=coords,
            dims={name: ["epoch"] for name in (*posterior, *checks)},
            attrs={"/": {"stage": self.stage, "seed": " ".join(map(str, self.seed))}},
        )


def infer(
    history: History,
    stage: Stage,
    seed: int | Sequence[int],
    *,
    epochs: int | Sequence[int] = constants.MAX_EPOCHS,
    chains: bool = True,
) -> Health:
    """Infer the health parameters at several epochs from all logs of a life.

    Parameters
    ----------
    history, stage : History, Stage
        Modal estimates of all logs, without outliers and with the steps of its track
        (`accepted_estimates`); laws, priors, covariates and modal map.
    seed, chains : int or sequence of int, bool
        As in `fit_life`.
    epochs : int or sequence of int
        Logs at which health is published, in order, with the last one at the end, or at most how
        many.

    Raises
    ------
    BadStage, NotEnoughData, NotConverged
        As `fit_life`.
    BadQuestion
        If epochs are not increasing numbers of logs since the baseline, with the last at the end.

    Examples
    --------
    A simulated machine with 72 % of its preload and 87 % of its mount stiffness left:

    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage = lmshealth.load_stage("lms-y")
    >>> health = lmshealth.infer(examples.history(), stage, seed=1, chains=False)
    >>> for name, median in zip(health.parameters, health.latest(0.5)):
    ...     print(f"{name}: {median:.0%}")
    guide_preload: 71%
    mount_stiffness: 89%
    >>> low, high = health.latest(0.05), health.latest(0.95)
    >>> bool((low < [0.72, 0.87]).all() and (high > [0.72, 0.87]).all())
    True
    """
    if isinstance(epochs, int | np.integer):
        chosen = epochs_to_publish(history, stage, int(epochs))
    else:
        chosen = tuple(map(int, epochs))
        first, last = history.baseline, len(history.logs) - 1
        if [*chosen] != sorted(set(chosen)) or chosen[-1:] != (last,) or chosen[0] < first:
            raise BadQuestion(
                f"epochs = {[*chosen]}: needed are numbers of logs from {first} to {last} in "
                f"order, the last of which is {last}: health is published up to now"
            )
    return health_of(fit_life(history, stage, seed, chains=chains), history, stage, chosen)


def epochs_to_publish(history: History, stage: Stage, most: int) -> tuple[int, ...]:
    """Choose at most so many logs after the baseline, with the last, nested as logs are added.

    Of the others those whose number divides by the highest power of two go first, and of these the
    latest: after one more log, no epoch is among them that was not before, or was not the last.
    """
    columns = [i for i, one in enumerate(history.series) if one.mode in stage.informative]
    there: BoolArray = np.asarray(np.isfinite(history.ln_frequency[:, columns]).any(axis=1))
    there[: history.baseline + 1] = False
    there[-1:] = True
    usable = np.flatnonzero(there)
    return tuple(usable[_thinned(usable.size, most)].tolist())


def _thinned(n: int, most: int) -> list[int]:
    """Choose at most so many of n epochs, as `epochs_to_publish` does."""
    if most < 1:
        raise BadQuestion(f"epochs = {most}: needed at least 1")
    number = np.arange(n)
    power = np.where(number > 0, number & -number, 2 * n + 1)
    power[-1:] = 4 * n + 1
    chosen = np.lexsort((number, power))[max(n - most, 0) :]
    return [int(k) for k in np.sort(chosen)]


def health_of(life: LifePosterior, history: History, stage: Stage, epochs: Sequence[int]) -> Health:
    """Return the health of a life at logs of its history, the last of which is now."""
    by_clock = with_clock(history, stage)
    moments = clock_and_steps(by_clock)[0][list(epochs)]
    past_rng, prior_rng = map(np.random.default_rng, stream(life.seed, _STEP).spawn(2))
    past = life.health_at(moments[:-1], past_rng)
    baseline = np.exp(stage.baseline_point)
    chains = np.concatenate([past, life.health[None]]) * baseline
    n, p = len(epochs), len(life.parameters)
    with np.errstate(divide="ignore"):
        x = np.log(chains)
    flat = x.reshape(n, -1, p)
    prior = life.prior_at(moments, prior_rng)
    variance = prior.var(axis=1)
    width = np.ptp(np.quantile(np.exp(prior), (0.05, 0.95), axis=1), axis=0)
    seen = identifiability_of(stage).restricted_to(life.modes).identifiable()
    assert stage.modal_map is not None  # a life has one
    low, high = stage.modal_map.low, stage.modal_map.high
    margin = constants.EDGE_SHARE * (high - low)
    least, middle, most = np.quantile(flat, (0.05, 0.5, 0.95), axis=1)
    # Laws stay on the map; a deviation from them, whose effect is linear, may leave it.
    on_map = ((middle >= low) & (middle <= high)).all(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        informed = np.clip(1 - flat.var(axis=1) / variance, 0, 1)
        correlation = [np.atleast_2d(np.corrcoef(one, rowvar=False)) for one in flat]
    return Health(
        stage=life.stage,
        recorded_at=tuple(history.recorded_at[k] for k in epochs),
        travel=by_clock.travel[list(epochs)],
        parameters=life.parameters,
        chains=chains,
        modes=life.modes,
        lone=life.lone,
        lone_modes=life.lone_modes,
        sampler=(life.sampler,) * n,
        ess_bulk=np.full((n, p), min(life.ess, constants.N_DRAWS)),
        ess_tail=np.full((n, p), min(life.ess, constants.N_DRAWS)),
        r_hat=np.full((n, p), life.worst_r_hat),
        judge_shift=np.tile(life.judge_shift, (n, 1)),
        judge_ratio=np.tile(life.judge_ratio, (n, 1)),
        informed=np.where(variance > 0, informed, 0.0),
        prior_width=width * baseline,
        identifiable=np.tile(seen, (n, 1)),
        correlation=np.stack(correlation),
        fit=np.where(on_map, life.fit, 0.0),
        at_edge=(least < low + margin) | (most > high - margin),
        seed=life.seed,
    )


def infer_drifts(
    drifts: Drifts, stage: Stage, seed: int | Sequence[int], *, epochs: int = constants.MAX_EPOCHS
) -> Health:
    """Infer the health parameters from a table of drifts, each epoch from its own drifts alone.

    Drifts that a filter has made of the logs are not independent from epoch to epoch, so that they
    are no data of a life. The prior is that of `infer` at the travel of the epoch; without an
    odometer parameters may change by as much as their priors in the description allow. Importance
    sampling draws them: two moments leave directions in which a chain would take very long.

    Raises
    ------
    BadStage
        If the description has no health parameter.
    NotEnoughData
        If no mode of the map has a drift.

    Examples
    --------
    Drifts, known to 0.1 %, of a machine that has lost a fifth of its preload in 1,000 km:

    >>> from datetime import UTC, datetime
    >>> import numpy as np
    >>> import lmshealth
    >>> from lmshealth.tracking.read_tables import Drifts
    >>> stage = lmshealth.load_stage("lms-y")
    >>> modes, when = stage.informative, (datetime(2026, 7, 1, tzinfo=UTC),)
    >>> drift, cov = stage.drift(np.log([[0.8, 1.0]]), modes), 1e-6 * np.eye(len(modes))[None]
    >>> drifts = Drifts("axis 7", when, np.array([1e6]), modes, drift, cov)
    >>> health = lmshealth.infer_drifts(drifts, stage, seed=0)
    >>> low, high = health.latest(0.05), health.latest(0.95)
    >>> bool(low[0] < 0.8 < high[0] and low[1] < 1.0 <= high[1] + 1e-9)
    True
    """
    if not stage.parameters:
        raise BadStage(f"{stage.name}: no [[parameter]] to infer")
    seconds = np.array([moment.timestamp() for moment in drifts.recorded_at])
    travel = clock_travel(drifts.travel, seconds, stage)
    drifts = replace(drifts, travel=travel)
    has_clock = bool(np.isfinite(travel).all())
    if not has_clock:
        # The state of a law follows from its travel, which is not known without an odometer.
        stage = stage.with_laws({one.name: None for one in stage.parameters})
        drifts = replace(drifts, travel=np.arange(1.0, 1 + len(drifts.recorded_at)))
    # Their covariances are those of a filter, which has allowed for scatter already.
    scatter = default_scatter()
    walk, scale = ((1.0,) + (0.0,) * (len(p) - 1) for p in (scatter.walk, scatter.noise_scale))
    stage = replace(stage, scatter=replace(scatter, walk=walk, noise_scale=scale))
    histories = {k: _of_drifts(drifts, stage, k) for k in range(len(drifts.recorded_at))}
    usable = [k for k, one in histories.items() if one is not None]
    if not usable:
        raise NotEnoughData(
            f"{drifts.stage}: no epoch has a drift of any of the modes {list(stage.informative)} "
            "with a standard deviation above 0; those of the baseline itself have none"
        )
    found, published = [], [usable[i] for i in _thinned(len(usable), epochs)]
    for k in published:
        history = histories[k]
        assert history is not None
        own = (*np.atleast_1d(seed).tolist(), k)
        life = fit_life(history, stage, own, chains=False, min_logs=2)
        found.append(health_of(life, history, stage, [1]))
    names = ("chains", "informed", "prior_width", "identifiable", "correlation", "fit")
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in found])
        for name in (*names, "at_edge", *CHECKS)
    }
    joined["travel"] = travel[published] if has_clock else np.full(len(found), np.nan)
    return replace(
        found[-1],
        recorded_at=tuple(one.recorded_at[0] for one in found),
        sampler=tuple(one.sampler[0] for one in found),
        seed=tuple(np.atleast_1d(seed).tolist()),
        **joined,
    )


def _of_drifts(drifts: Drifts, stage: Stage, k: int) -> History | None:
    """Return a history of baseline and drifts at an epoch; None without a drift or travel."""
    variance = np.einsum("kii->ki", drifts.drift_cov)
    there = np.isfinite(drifts.drift) & np.isfinite(variance) & (variance > 0)
    modes = [m for m in stage.informative if m in drifts.modes and there[k, drifts.modes.index(m)]]
    if not modes:
        return None
    # A baseline has drifts of variance 0; without one the odometer counts from its 0.
    before = [j for j in range(k) if (variance[j] == 0).any() and not there[j].any()]
    begin = drifts.travel[before[-1]] if before else 0.0
    if drifts.travel[k] <= begin:
        return None
    n, columns = len(modes), [drifts.modes.index(mode) for mode in modes]
    cov = np.zeros((2, 2 * n, 2 * n))
    diagonal(cov)[:] = _EXACT
    cov[1, :n, :n] = drifts.drift_cov[k][np.ix_(columns, columns)]
    return History(
        stage=drifts.stage,
        logs=("baseline", f"epoch {k}"),
        recorded_at=(drifts.recorded_at[before[-1] if before else 0], drifts.recorded_at[k]),
        travel=np.array([begin, drifts.travel[k]]),
        covariates={},
        modes=tuple(modes),
        series=tuple(Series(mode, "") for mode in modes),
        ln_frequency=np.array([np.zeros(n), drifts.drift[k][columns]]),
        ln_damping=np.zeros((2, n)),
        cov=cov,
        loop_error=np.full(2, np.nan),
        baselines=(0,),
    )
