"""Modal map: closed-loop frequencies over a grid of guide preload and mount stiffness."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.dynamics.stages import Condition, Stage

Array = NDArray[np.float64]

PRELOAD_RANGE = (0.2, 2.2)
MOUNT_RANGE = (0.25, 2.2)
# Enough that ln f is met within 1e-5 between the nodes, see `leave_out_error`.
PRELOAD_NODES = 13
MOUNT_NODES = 17

Range = tuple[float, float]


def lobatto_nodes(limits: Range, count: int) -> Array:
    """Return Chebyshev-Lobatto nodes, ascending, spread over the logarithm of a range."""
    low, high = np.log(limits)
    unit = -np.cos(np.pi * np.arange(count) / (count - 1))
    return np.asarray(np.exp(low + (high - low) * (unit + 1) / 2))


def modal_map(
    stage: Stage, *, nodes: tuple[int, int] = (PRELOAD_NODES, MOUNT_NODES)
) -> pd.DataFrame:
    """Return the map as rows of guide_preload, mount_stiffness, mode, frequency_hz."""
    rows = []
    for preload in lobatto_nodes(PRELOAD_RANGE, nodes[0]):
        for mount in lobatto_nodes(MOUNT_RANGE, nodes[1]):
            for name, value in guide_frequencies(stage, preload, mount).items():
                rows.append((float(preload), float(mount), name, value))
    return pd.DataFrame(rows, columns=["guide_preload", "mount_stiffness", "mode", "frequency_hz"])


def guide_frequencies(stage: Stage, preload: float, mount: float) -> dict[str, float]:
    """Return the closed-loop frequencies (Hz) of roll, pitch and yaw in a condition."""
    modes = closed_loop_modes(stage, Condition(float(preload), float(mount)))
    found = {mode.name: mode.frequency_hz for mode in modes}
    return {name: found[name] for name in GUIDE_MODES}


def _unit(values: Array, limits: Range) -> Array:
    """Return the logarithm of values scaled to −1..1 over a range."""
    low, high = np.log(limits)
    return np.asarray(2 * (np.log(values) - low) / (high - low) - 1)


def chebyshev_fit(table: pd.DataFrame, mode: str) -> Array:
    """Return tensor Chebyshev coefficients (preload, mount) of ln f through all nodes."""
    grid = table[table["mode"] == mode].pivot(
        index="guide_preload", columns="mount_stiffness", values="frequency_hz"
    )
    first = _unit(grid.index.to_numpy(dtype=float), PRELOAD_RANGE)
    second = _unit(grid.columns.to_numpy(dtype=float), MOUNT_RANGE)
    left = np.linalg.inv(chebyshev.chebvander(first, first.size - 1))
    right = np.linalg.inv(chebyshev.chebvander(second, second.size - 1))
    return np.asarray(left @ np.log(grid.to_numpy(dtype=float)) @ right.T)


def leave_out_error(
    stage: Stage, table: pd.DataFrame, points: Iterable[tuple[float, float]]
) -> dict[str, float]:
    """Return per mode the largest error of ln f at (preload, mount) points not in the map."""
    fits = {name: chebyshev_fit(table, name) for name in GUIDE_MODES}
    worst = dict.fromkeys(GUIDE_MODES, 0.0)
    for preload, mount in points:
        first = _unit(np.array(preload), PRELOAD_RANGE)
        second = _unit(np.array(mount), MOUNT_RANGE)
        for name, value in guide_frequencies(stage, preload, mount).items():
            guess = float(chebyshev.chebval2d(first, second, fits[name]))
            worst[name] = max(worst[name], abs(guess - float(np.log(value))))
    return worst
