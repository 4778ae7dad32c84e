"""Smoother: the states of all epochs given all logs."""

from dataclasses import dataclass

import numpy as np

from lmshealth._private.arrays import FloatArray, ReadOnly
from lmshealth.stage.description import Stage
from lmshealth.tracking.filters.published_filter import smooth_states
from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed(ReadOnly):
    """Modes at every epoch given all logs; fields are as in `Track`, ``(n_epochs, n_modes)``."""

    ln_frequency: FloatArray
    ln_frequency_std: FloatArray
    ln_damping: FloatArray
    ln_damping_std: FloatArray
    drift: FloatArray
    drift_std: FloatArray


def smooth(history: History, followed: Track, stage: Stage | None = None) -> Smoothed:
    """Smooth a history by the Rauch-Tung-Striebel recursion of its published filter [Rauch1965].

    The steps and nuisances of its track are in the model; the stage is that of `track`.
    `ValueError` for a track without nuisances, which `track` did not make.
    """
    if followed.nuisances is None:
        raise ValueError(f"the track of {followed.stage} has no nuisances: filter it by `track`")
    space = StateSpace(history, stage, followed.steps)
    mean, cov = smooth_states(space, followed.nuisances)
    contrast = space.drift
    size = contrast.shape[1]
    drift = mean[:, :size] @ contrast.T
    variance = np.einsum("mi,kij,mj->km", contrast, cov[:, :size, :size], contrast)
    early = np.arange(len(history.logs)) < history.baselines[0]
    drift[early], variance[early] = np.nan, np.nan
    std = np.sqrt(np.maximum(np.einsum("kii->ki", cov), 0.0)) * followed.widening[:, None]
    unseen = space.damping.start + np.flatnonzero(np.isnan(followed.ln_damping).all(axis=0))
    mean[:, unseen], std[:, unseen] = np.nan, np.nan
    return Smoothed(
        ln_frequency=mean[:, space.level],
        ln_frequency_std=std[:, space.level],
        ln_damping=mean[:, space.damping],
        ln_damping_std=std[:, space.damping],
        drift=drift,
        drift_std=np.sqrt(np.maximum(variance, 0.0)) * followed.widening[:, None],
    )
