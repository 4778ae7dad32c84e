"""Health without a law: posterior of the health parameters at one epoch, from the drifts.

The drifts δ of the tracked modes have covariance C from the filter. The modal map predicts h(x);
its sensitivities are believed to a relative standard deviation m, so that the error of mode i has
the variance E_i(x) = Σ_j (m h_i^j)², h^j being the drift that parameter j causes alone. Then
δ ~ N(h(x), C + E(x)), with x the ln parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.errors import BadStage, NotConverged, NotEnoughData
from lmshealth.results import Health
from lmshealth.sampling import sample, stream
from lmshealth.stage import Stage
from lmshealth.tracks import Track

_N_KEPT = 4000
_PRIOR_DRAWS = 20_000


def epochs_to_infer(track: Track, stage: Stage, most: int) -> tuple[int, ...]:
    """Choose at most so many epochs after the baseline, always with the last one."""
    columns = [track.modes.index(name) for name in stage.informative if name in track.modes]
    variance = np.einsum("kii->ki", track.drift_cov)[:, columns]
    usable = np.flatnonzero(np.all(np.isfinite(variance) & (variance > 0), axis=1))
    if usable.size <= most:
        return tuple(usable.tolist())
    # Counted from the last, which a single epoch must be.
    spaced = np.unique(np.linspace(usable.size - 1, 0, most).round().astype(int))
    return tuple(usable[spaced].tolist())


def infer(
    track: Track,
    stage: Stage,
    seed: int | Sequence[int],
    *,
    epochs: Sequence[int] | None = None,
    mapper: Callable[..., object] = map,
) -> Health:
    """Infer the health parameters at several epochs.

    Parameters
    ----------
    track : Track
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
    """
    if not stage.parameters:
        raise BadStage(f"{stage.name}: no [[parameter]] to infer")
    modes = tuple(name for name in stage.informative if name in track.modes)
    if not modes:
        raise NotEnoughData(
            f"{track.stage}: none of the modes {list(stage.informative)} was tracked"
        )
    chosen = tuple(epochs if epochs is not None else epochs_to_infer(track, stage, 40))
    if not chosen:
        raise NotEnoughData(f"{track.stage}: no epoch after the baseline")
    columns = [track.modes.index(name) for name in modes]
    tasks = [
        EpochPosterior(stage, modes, track.drift[k][columns], _block(track.drift_cov[k], columns))
        for k in chosen
    ]
    results = list(mapper(_infer_epoch, tasks, [seed] * len(tasks), chosen))  # type: ignore[call-overload]
    return _collect(track, stage, chosen, results)


def _block(matrix: FloatArray, index: list[int]) -> FloatArray:
    return np.array(matrix[np.ix_(index, index)])


@dataclass(frozen=True, slots=True, eq=False)
class EpochPosterior:
    """Log posterior of the ln parameters at one epoch.

    Attributes
    ----------
    stage : Stage
        Parameters, priors and modal map.
    modes : tuple of str
        Modes used.
    drift : ndarray
        Shape ``(n_modes,)``.
    cov : ndarray
        Its covariance, shape ``(n_modes, n_modes)``.
    """

    stage: Stage
    modes: tuple[str, ...]
    drift: FloatArray
    cov: FloatArray

    def log_prior(self, x: FloatArray) -> FloatArray:
        """Log prior of ln parameters, truncated at the map's grid, shape ``(n_points,)``."""
        total = np.where(self._map_holds(x), 0.0, -np.inf)
        for j, parameter in enumerate(self.stage.parameters):
            total = total + parameter.prior.log_density(np.exp(x[:, j])) + x[:, j]
        return np.asarray(total)

    def log_probability(self, x: FloatArray) -> FloatArray:
        """Log posterior of ln parameters up to a constant, shape ``(n_points,)``."""
        total = self.log_prior(x)
        inside = np.isfinite(total)
        if inside.any():
            total[inside] += self._log_likelihood(x[inside])
        return total

    def draw_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw ln parameters from the prior inside the map, shape ``(n, n_parameters)``."""
        return draw_prior(self.stage, rng, n)

    def _map_holds(self, x: FloatArray) -> np.ndarray:
        assert self.stage.modal_map is not None  # infer() has checked
        return self.stage.modal_map.inside(x)

    def _log_likelihood(self, x: FloatArray) -> FloatArray:
        n, n_parameters = x.shape
        drift = self.stage.drift(one_at_a_time(self.stage, x), self.modes)
        drift = drift.reshape(n_parameters + 1, n, -1)
        model_std = self.stage.description.map.model_std if self.stage.description.map else 0.0
        own = model_std**2 * np.sum(drift[1:] ** 2, axis=0)
        cov = self.cov + own[:, :, None] * np.eye(len(self.modes))
        off = self.drift - drift[0]
        solved = np.linalg.solve(cov, off[..., None])[..., 0]
        return np.asarray(-0.5 * (np.sum(off * solved, axis=1) + np.linalg.slogdet(cov)[1]))


def one_at_a_time(stage: Stage, x: FloatArray) -> FloatArray:
    """Stack points with copies in which one parameter at a time leaves its baseline.

    Parameters
    ----------
    stage : Stage
        Says where the baseline is.
    x : ndarray
        ln parameters, shape ``(n_points, n_parameters)``.

    Returns
    -------
    ndarray
        The points, then for each parameter the points with all others at baseline,
        shape ``((1 + n_parameters) n_points, n_parameters)``.
    """
    stacked = np.empty((x.shape[1] + 1, *x.shape))
    stacked[0] = x
    stacked[1:] = stage.baseline_point
    for j in range(x.shape[1]):
        stacked[1 + j, :, j] = x[:, j]
    return stacked.reshape(-1, x.shape[1])


def draw_prior(stage: Stage, rng: np.random.Generator, n: int) -> FloatArray:
    """Draw ln parameters from the priors, truncated at the map, shape ``(n, n_parameters)``."""
    found = np.empty((0, len(stage.parameters)))
    for _ in range(100):
        values = np.column_stack(
            [p.prior.quantile(rng.uniform(1e-12, 1 - 1e-12, n)) for p in stage.parameters]
        )
        x = np.log(values[np.all(values > 0, axis=1)])
        assert stage.modal_map is not None  # a stage with parameters has a map
        found = np.concatenate([found, x[stage.modal_map.inside(x)]])
        if found.shape[0] >= n:
            return found[:n]
    raise BadStage(f"{stage.name}: the priors put almost nothing inside the modal map")


@dataclass(frozen=True, slots=True, eq=False)
class _Epoch:
    draws: FloatArray
    ess: FloatArray
    r_hat: FloatArray
    converged: bool


def _infer_epoch(posterior: EpochPosterior, seed: int | Sequence[int], epoch: int) -> _Epoch:
    try:
        found = sample(posterior.log_probability, posterior.draw_prior, stream(seed, epoch))
    except NotConverged as error:
        chains = np.asarray(error.chains)
        draws = chains.reshape(-1, chains.shape[-1])
        bad = np.full(draws.shape[1], np.nan)
        return _Epoch(_thin(draws), bad, bad, converged=False)
    return _Epoch(_thin(found.draws), found.ess, found.r_hat, converged=True)


def _thin(draws: FloatArray) -> FloatArray:
    index = np.linspace(0, draws.shape[0] - 1, _N_KEPT).round().astype(int)
    return np.asarray(draws[index])


def _collect(track: Track, stage: Stage, chosen: tuple[int, ...], results: list[_Epoch]) -> Health:
    prior = draw_prior(stage, np.random.default_rng(0), _PRIOR_DRAWS)
    prior_std = prior.std(axis=0)
    low, high = np.quantile(np.exp(prior), [0.05, 0.95], axis=0)
    x = np.stack([result.draws for result in results])
    recorded: tuple[datetime, ...] = tuple(track.recorded_at[k] for k in chosen)
    return Health(
        stage=track.stage,
        recorded_at=recorded,
        travel=track.travel[list(chosen)],
        parameters=tuple(parameter.name for parameter in stage.parameters),
        samples=np.exp(x),
        ess=np.stack([result.ess for result in results]),
        r_hat=np.stack([result.r_hat for result in results]),
        converged=np.array([result.converged for result in results]),
        informed=np.clip(1 - (x.std(axis=1) / prior_std) ** 2, 0, 1),
        prior_width=high - low,
    )
