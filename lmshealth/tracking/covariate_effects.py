"""Effects of temperature, payload and position on the modes, with the estimates that show them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lmshealth._private.arrays import FloatArray, freeze
from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.covariates import Regressor, regressors
from lmshealth.tracking.history import History
from lmshealth.tracking.smoother import smooth
from lmshealth.tracking.track import Effect, Track, accepted_estimates


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
    columns = regressors(history.covariates, stage, history.recorded_at)
    if not columns:
        return ()
    taken = accepted_estimates(history, track)
    known = {(e.mode, e.covariate): e for e in track.effects}
    short = len(taken.logs) <= constants.MOST_SMOOTHED
    level = (smooth(taken, track, stage) if short else track).ln_frequency
    moved, mode_of = covariate_shifts(history, track, stage), taken.mode_of()
    rest = taken.ln_frequency - level[:, mode_of] - moved[:, mode_of] - _offsets(taken, known)
    found = []
    for covariate in stage.description.covariate:
        own = [r for r in columns if r.name.removesuffix("^2") == covariate.name]
        for mode in track.modes if own else ():
            effects = tuple(known[mode, r.name] for r in own)
            at, values = history.columns(mode), history.covariates[covariate.name]
            epochs, series = np.nonzero(np.isfinite(rest[:, at]) & np.isfinite(values)[:, None])
            explained = _explained(own, effects)
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
    columns = regressors(history.covariates, stage, history.recorded_at)
    known = {(e.mode, e.covariate): e for e in track.effects}
    moved = np.zeros((len(history.logs), len(track.modes)))
    for m, mode in enumerate(track.modes):
        own = [r for r in columns if (mode, r.name) in known]
        moved[:, m] += _explained(own, tuple(known[mode, r.name] for r in own))
    return moved


def _explained(columns: Sequence[Regressor], effects: Sequence[Effect]) -> FloatArray:
    return np.asarray(sum(e.coefficient * r.values for r, e in zip(columns, effects, strict=True)))


def _offsets(history: History, known: dict[tuple[str, str], Effect]) -> FloatArray:
    """Return the offsets of ln f by sources, servo and sensors, shape ``(n_logs, n_series)``."""
    offsets = np.zeros_like(history.ln_frequency)
    for i, one in enumerate(history.series):
        bias = known.get((one.mode, f"bias:{one.source}"))
        offsets[:, i] = 0.0 if bias is None else bias.coefficient
        for step in history.steps:
            if step.changes_modes or step.source not in ("", one.source):
                continue
            effect = known[one.mode, f"{step.kind}:{step.name or step.source}"]
            offsets[step.there, i] += effect.coefficient
    return offsets
