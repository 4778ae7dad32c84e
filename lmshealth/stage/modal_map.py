"""Modal map: Chebyshev surrogate of ln frequency over ln health parameters (README.md, "Map")."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.polynomial.chebyshev import chebder, chebvander

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth._private.files import read_table
from lmshealth.errors import BadStage, OutsideMap
from lmshealth.stage import constants

# The degree is raised until the error of ln f is far below that of any measurement.
_MAX_DEGREE, _NEGLIGIBLE = 14, 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ModalMap:
    """Chebyshev surrogate of ln frequency over ln health parameters."""

    parameters: tuple[str, ...]
    modes: tuple[str, ...]
    low: FloatArray  # low, high: bounds of ln parameter, shape ``(n_parameters,)``
    high: FloatArray
    # Tensor Chebyshev coefficients, shape ``(d_1 + 1, ..., d_P + 1, n_modes)``.
    coefficients: FloatArray
    # Largest error of ln f at inner grid points, each left out of the fit, ``(n_modes,)``.
    leave_out_error: FloatArray

    def inside(self, x: FloatArray) -> BoolArray:
        """Return which points, shape ``(n_points, n_parameters)``, lie inside the grid."""
        return np.asarray(np.all((x >= self.low) & (x <= self.high), axis=-1))

    def ln_frequency(self, x: FloatArray) -> FloatArray:
        """Evaluate ln of frequency in Hz, ``(n_points, n_modes)``.

        At ln parameters ``(n_points, n_parameters)``. `OutsideMap` is raised for a point outside
        the grid: there is no extrapolation.
        """
        return _evaluate(self.coefficients, self._unit(x))

    def gradient(self, x: FloatArray) -> FloatArray:
        """Differentiate ln frequency by the ln parameters, ``(n_points, n_modes, n_parameters)``.

        Parameters and errors are those of `ln_frequency`.
        """
        unit = self._unit(x)
        slopes = [
            _evaluate(chebder(self.coefficients, scl=scale, axis=axis), unit)
            for axis, scale in enumerate(2 / (self.high - self.low))
        ]
        return np.stack(slopes, axis=-1)

    def _unit(self, x: FloatArray) -> FloatArray:
        """Scale points to the range -1 to 1; refuse those outside."""
        inside = self.inside(x)
        if not inside.all():
            worst = np.exp(x[~inside][0])
            raise OutsideMap(
                f"parameters {dict(zip(self.parameters, worst.tolist(), strict=True))} lie outside "
                f"the modal map ({np.exp(self.low)} to {np.exp(self.high)}); make a wider map"
            )
        return np.asarray(2 * (x - self.low) / (self.high - self.low) - 1)


def read_map(path: str, parameters: tuple[str, ...]) -> ModalMap:
    """Read a modal map and fit its surrogate.

    It is a CSV file with one column per health parameter, then ``mode`` and ``frequency_hz``: a
    full grid. `BadStage` if columns are missing or unknown, values are not positive, or the grid is
    not full.
    """
    try:
        content = read_table(Path(path))
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise BadStage(f"{path}: cannot read the modal map: {why}") from error
    try:
        # Blank lines are kept, so that the index of a row gives its line.
        table = pd.read_csv(BytesIO(content), skip_blank_lines=False).dropna(how="all")
    except ValueError:
        # A description may name any file: nothing of one that is no table is quoted.
        raise BadStage(f"{path}: it is not a modal map: no table of numbers with commas") from None
    needed = {*parameters, "mode", "frequency_hz"}
    missing, extra = needed - set(table.columns), set(table.columns) - needed
    if missing:
        there = "it is not a modal map" if missing == needed else f"there are {list(table.columns)}"
        raise BadStage(f"{path}: no column {sorted(missing)}; {there}")
    if extra:
        raise BadStage(
            f"{path}: columns {sorted(extra)} are not parameters of the stage description; "
            "describe them as [[parameter]] or make the map without them"
        )
    numbers = table[[*parameters, "frequency_hz"]].apply(pd.to_numeric, errors="coerce")
    for name, column in numbers.items():
        low, high = constants.FREQUENCY_HZ if name == "frequency_hz" else constants.VALUE
        wrong = ~column.between(low, high).to_numpy()
        if wrong.any():
            found = f"{_line(path, table, wrong)}: {name} is {table[name].iloc[wrong.argmax()]}"
            raise BadStage(f"{found}; needed is a positive number, {low:g} to {high:g}")
    unnamed = table["mode"].isna().to_numpy()
    if unnamed.any():
        raise BadStage(f"{_line(path, table, unnamed)}: a mode without a name")
    table = table.assign(**numbers, mode=table["mode"].astype(str))
    twice = table.duplicated([*parameters, "mode"]).to_numpy()
    if twice.any():
        raise BadStage(f"{_line(path, table, twice)}: a mode occurs twice at one grid point")
    return _fit(path, table, parameters)


def _line(path: str, table: pd.DataFrame, wrong: BoolArray) -> str:
    """Name the line of the first wrong row; line 1 holds the column names."""
    return f"{path}: line {table.index[wrong][0] + 2}"


def _fit(path: str, table: pd.DataFrame, parameters: tuple[str, ...]) -> ModalMap:
    modes = tuple(table["mode"].unique())
    wide = table.pivot(index=list(parameters), columns="mode", values="frequency_hz")
    axes = [np.unique(table[name]) for name in parameters]
    n_grid = int(np.prod([axis.size for axis in axes]))
    values = wide[list(modes)].to_numpy(dtype=float)
    if values.shape[0] != n_grid or np.isnan(values).any():
        raise BadStage(
            f"{path}: {np.isfinite(values).sum()} values where a full grid of {n_grid} points "
            f"with modes {list(modes)} needs {n_grid * len(modes)}"
        )
    if min(axis.size for axis in axes) < 3:
        found = {name: axis.size for name, axis in zip(parameters, axes, strict=True)}
        raise BadStage(f"{path}: every parameter needs at least 3 grid values, there are {found}")
    for name, axis in zip(parameters, axes, strict=True):
        if (axis[1:] / axis[:-1]).min() < constants.LEAST_STEP:
            raise BadStage(f"{path}: grid values of {name} are equal but for rounding")
    points = np.log(wide.index.to_frame().to_numpy(dtype=float))
    low, high = points.min(axis=0), points.max(axis=0)
    unit = 2 * (points - low) / (high - low) - 1
    sizes, miss = _choose_sizes(unit, np.log(values), [axis.size for axis in axes])
    basis = _basis(unit, sizes)
    coefficients = np.linalg.lstsq(basis, np.log(values), rcond=None)[0]
    coefficients = coefficients.reshape(*sizes, len(modes))
    return ModalMap(parameters, modes, low, high, coefficients, miss)


def _evaluate(coefficients: FloatArray, unit: FloatArray) -> FloatArray:
    """Sum a tensor Chebyshev series at points ``(n_points, n_parameters)`` from -1 to 1."""
    *sizes, n_modes = coefficients.shape
    return np.asarray(_basis(unit, sizes) @ coefficients.reshape(-1, n_modes))


def _basis(unit: FloatArray, sizes: Sequence[int]) -> FloatArray:
    """Return the products of the polynomials of all parameters at points, ``(n_points, n)``."""

    def product(a: FloatArray, b: FloatArray) -> FloatArray:
        return (a[:, :, None] * b[:, None]).reshape(len(a), a.shape[1] * b.shape[1])

    each = (chebvander(x, size - 1) for x, size in zip(unit.T, sizes, strict=True))
    return reduce(product, each)


def _choose_sizes(
    unit: FloatArray, values: FloatArray, grid: list[int]
) -> tuple[list[int], FloatArray]:
    """Choose the coefficients of each axis with the least error at inner grid points left out.

    The largest error of each mode is returned, too, ``(n_modes,)`` (README.md, "Modal map").
    """
    interior = np.all(np.abs(unit) < 1 - 1e-9, axis=1)
    best: tuple[list[int], FloatArray] | None = None
    for degree in range(1, min(max(grid) - 1, _MAX_DEGREE) + 1):
        # One less than the axis permits keeps fits without a point well posed.
        sizes = [min(degree + 1, n - 1) for n in grid]
        span = np.linalg.qr(_basis(unit, sizes))[0]
        residual = values - span @ (span.T @ values)
        rest = 1 - np.sum(span**2, axis=1)
        error = np.abs(residual / rest[:, None])[interior].max(axis=0)
        if best is None or error.max() < best[1].max():
            best = sizes, error
        if error.max() < _NEGLIGIBLE:
            break
    assert best is not None  # at least 3 grid values: degree 1 is always tried
    return best
