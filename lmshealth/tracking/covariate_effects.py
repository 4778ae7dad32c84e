"""Effects of temperature, payload and position on the modes, with the estimates that show them."""

from dataclasses import dataclass

import numpy as np

from lmshealth._private.arrays import FloatArray, freeze
from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Effect, Track, accepted_estimates, smooth


@dataclass(frozen=True, slots=True, eq=False)
class CovariateEffect:
    """Effect of a covariate on a mode, and the n estimates that it was regressed on."""

    mode: str
    covariate: str
    reference: float  # the covariate at which the effect is zero
    effects: tuple[Effect, ...]  # per unit, and per unit squared where there is a curvature
    epochs: np.ndarray  # logs of the estimates, ``(n,)``
    values: FloatArray  # the covariate in these logs, ``(n,)``
    # ln f minus its smoothed level, steps, biases and other covariates, ``(n,)``. The level follows
    # the logs: residuals scatter less than the estimates' errors.
    measured: FloatArray

    def __post_init__(self) -> None:
        freeze(self, ("values measured", *self.epochs.shape))

    def explained(self, values: FloatArray) -> FloatArray:
        """Return the change of ln f at values of the covariate, shape of ``values``."""
        offset = values - self.reference
        return np.asarray(sum(e.coefficient * offset**p for p, e in enumerate(self.effects, 1)))

    def explained_std(self, values: FloatArray) -> FloatArray | None:
        """Return its standard deviation; None with a curvature, whose covariance is not kept."""
        if len(self.effects) > 1:
            return None
        return np.abs(values - self.reference) * self.effects[0].std

    @property
    def corrected(self) -> FloatArray:
        """Residuals of the measured changes, shape ``(n,)``."""
        return self.measured - self.explained(self.values)

    @property
    def seen(self) -> bool:
        """Whether any of the effects is more than two standard deviations from zero."""
        return any(abs(effect.coefficient) > 2 * effect.std for effect in self.effects)


def find_covariate_effects(
    history: History, track: Track, stage: Stage
) -> tuple[CovariateEffect, ...]:
    """Return the effect of every described covariate on every mode, without outliers of the track.

    The order is that of the description; a covariate that is unknown or never left its reference
    has no effect. In a long history the level is the filtered one.
    """
    space = StateSpace(history, stage, track.steps)
    columns, places = space.regressed, [at for _, _, at in space.effects]
    if not columns:
        return ()
    taken = accepted_estimates(history, track)
    short = len(taken.logs) <= constants.MOST_SMOOTHED
    level = (smooth(taken, track, stage) if short else track).ln_frequency
    coefficients = np.array([one.coefficient for one in track.effects[: len(places)]])
    logs, n_series = range(len(history.logs)), len(history.series)
    moved = np.array([space.matrix(k)[:n_series, places] @ coefficients for k in logs])
    rest = taken.ln_frequency - level[:, taken.mode_of()] - moved
    found = []
    for covariate in stage.description.covariate:
        own = [j for j, r in enumerate(columns) if r.name.removesuffix("^2") == covariate.name]
        for i, mode in enumerate(track.modes) if own else ():
            effects = tuple(track.effects[len(track.modes) * j + i] for j in own)
            at, values = history.columns(mode), history.covariates[covariate.name]
            epochs, series = np.nonzero(np.isfinite(rest[:, at]) & np.isfinite(values)[:, None])
            parts = zip(own, effects, strict=True)
            explained = np.sum([e.coefficient * columns[j].values for j, e in parts], axis=0)
            found.append(
                CovariateEffect(
                    mode=mode,
                    covariate=covariate.name,
                    reference=covariate.reference,
                    effects=effects,
                    epochs=epochs,
                    values=values[epochs],
                    measured=rest[:, at][epochs, series] + explained[epochs],
                )
            )
    return tuple(found)


def covariate_shifts(history: History, track: Track, stage: Stage) -> FloatArray:
    """Return the change of ln f of every mode by covariates, shape ``(n_logs, n_modes)``."""
    columns, n_modes = regressors(history.covariates, stage, history.recorded_at), len(track.modes)
    effects = track.effects[: len(columns) * n_modes]
    coefficients = np.array([one.coefficient for one in effects]).reshape(-1, n_modes)
    values = np.array([one.values for one in columns]).reshape(-1, len(history.logs))
    return np.asarray(values.T @ coefficients)
