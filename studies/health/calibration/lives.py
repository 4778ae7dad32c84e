"""Epochs drawn from the estimator's own model: what is true, and the drifts that it makes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track, track
from studies.harness.data.histories import make_history, map_std

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Life:
    """A track with the true parameters of some of its epochs, ``(n_epochs, n_parameters)``."""

    track: Track
    epochs: tuple[int, ...]
    truth: Array


def assuming(machine: Stage, share: float) -> Stage:
    """Return the same stage with a share of the error of its map."""
    assert machine.description.map is not None
    less = share * machine.description.map.model_std
    spec = msgspec.structs.replace(machine.description.map, model_std=less)
    return replace(machine, description=msgspec.structs.replace(machine.description, map=spec))


def draw(rng: np.random.Generator, machine: Stage, n_epochs: int) -> Life:
    """Draw a life: a real track gives the covariances, the model all that is true.

    The relative errors of the map's sensitivities, one per parameter and mode, are those of the
    life; parameters and the errors of the drifts are drawn again at every epoch.
    """
    followed = track(history(rng, machine), machine)
    n = len(followed.logs)
    epochs = tuple(np.linspace(n - 1, 0, n_epochs, endpoint=False).round().astype(int)[::-1])
    names = [name for name in machine.informative if name in followed.modes]
    columns = np.array([followed.modes.index(name) for name in names])
    shape = len(machine.parameters), columns.size
    error = map_std(rng, machine) * rng.standard_normal(shape)
    truth = parameters(rng, machine, n_epochs)
    drift = followed.drift.copy()
    for k, x in zip(epochs, truth, strict=True):
        made = machine.drift(x[None], tuple(names))[0]
        for j in range(x.size):
            alone = machine.baseline_point.copy()
            alone[j] = x[j]
            made = made + error[j] * machine.drift(alone[None], tuple(names))[0]
        cov = followed.drift_cov[k][np.ix_(columns, columns)]
        drift[k, columns] = rng.multivariate_normal(made, cov, method="eigh")
    return Life(replace(followed, drift=drift), tuple(int(k) for k in epochs), truth)


def parameters(rng: np.random.Generator, machine: Stage, n: int) -> Array:
    """Draw ln parameters from the priors of the description, those outside the map again."""
    assert machine.modal_map is not None
    found: list[Array] = []
    while len(found) < n:
        uniform = rng.uniform(size=len(machine.parameters))
        pairs = zip(machine.parameters, uniform, strict=True)
        x = np.log([float(one.prior.quantile(np.asarray(u))) for one, u in pairs])
        if machine.modal_map.inside(x[None]).all():
            found.append(x)
    return np.array(found)


def history(rng: np.random.Generator, machine: Stage) -> History:
    """Make a machine that does not change: 8 to 80 logs of estimates, good ones or poor ones.

    Reported standard deviations of ln f are between 0.0002 and 0.005 and differ from mode to mode
    and log to log; temperature is regressed, and in half of the lives payload.
    """
    modes = [mode for mode in machine.modes if mode.tracked]
    n, m = int(rng.integers(8, 81)), len(modes)
    level = np.exp(rng.uniform(*np.log([2e-4, 5e-3])) + 0.3 * rng.standard_normal(m))
    std = level * np.exp(0.2 * rng.standard_normal((n, m)))
    spread = np.hstack([std, np.full((n, m), 0.05)])
    covariates = {"temperature_c": 21 + 3 * rng.standard_normal(n)}
    if rng.random() < 0.5:
        covariates["payload_kg"] = rng.choice([10.0, 20.0, 30.0], size=n)
    travel = 1000 * np.cumsum(rng.uniform(10, 200, n))
    frequency, damping = np.log([(mode.frequency_hz, mode.damping_ratio) for mode in modes]).T
    estimates = (
        frequency + std * rng.standard_normal((n, m)),
        damping + 0.05 * rng.standard_normal((n, m)),
        spread[:, :, None] ** 2 * np.eye(2 * m),
    )
    names = [mode.name for mode in modes]
    return make_history(names, travel, estimates, covariates=covariates)
