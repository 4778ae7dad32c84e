"""Modal map: Chebyshev surrogate of ln frequency over ln health parameters (README.md, "Map")."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from io import StringIO
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.polynomial.chebyshev import chebder, chebvander

from lmshealth._private.arrays import BoolArray, FloatArray, one_thread
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
        within = (x >= self.low) & (x <= self.high)
        # Faster than a reduction over so short an axis.
        return np.asarray(reduce(np.logical_and, np.moveaxis(within, -1, 0)))

    def ln_frequency(self, x: FloatArray) -> FloatArray:
        """Evaluate ln of frequency in Hz, ``(n_points, n_modes)``.

        At ln parameters ``(n_points, n_parameters)``. `OutsideMap` is raised for a point outside
        the grid: there is no extrapolation.
        """
        return _evaluate(self.coefficients, self._unit(x))

    def alone(self, base: FloatArray) -> tuple[FloatArray, ...]:
        """Return the series of each parameter while all others are at a base ``(n_parameters,)``.

        Chebyshev coefficients of each, ``(d + 1, n_modes)``.
        """
        at_base = [table[:, 0] for table in _tables(self._unit(base[None]), self._sizes)]

        def of(j: int) -> FloatArray:
            found = self.coefficients
            for axis in reversed(range(len(at_base))):
                if axis != j:
                    found = np.tensordot(at_base[axis], found, (0, axis))
            return np.asarray(found)

        return tuple(map(of, range(len(at_base))))

    def ln_frequency_and_alone(self, x: FloatArray, alone: Sequence[FloatArray]) -> FloatArray:
        """Return `ln_frequency`, then that of each parameter by the series of `alone`.

        Shape ``(1 + n_parameters, n_points, n_modes)``.
        """
        tables = _tables(self._unit(x), self._sizes)
        whole = self.coefficients.reshape(-1, len(self.modes)).T @ reduce(_products, tables)
        each = (own.T @ table for own, table in zip(alone, tables, strict=True))
        return np.swapaxes([whole, *each], 1, 2)

    @property
    def _sizes(self) -> tuple[int, ...]:
        return self.coefficients.shape[:-1]

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
        if not ((x >= self.low) & (x <= self.high)).all():
            worst = np.exp(x[~self.inside(x)][0])
            raise OutsideMap(
                f"parameters {dict(zip(self.parameters, worst.tolist(), strict=True))} lie outside "
                f"the modal map ({np.exp(self.low)} to {np.exp(self.high)}); make a wider map"
            )
        return np.asarray(2 * (x - self.low) / (self.high - self.low) - 1)


@one_thread
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
        header, *records = csv.reader(StringIO(content.decode("utf-8-sig"), newline=""))
        if any(len(cells) > len(header) for cells in records):
            raise ValueError
    except (ValueError, csv.Error):
        # A description may name any file: nothing of one that is no table is quoted.
        raise BadStage(f"{path}: it is not a modal map: no table of numbers with commas") from None
    header, needed = [name.strip() for name in header], {*parameters, "mode", "frequency_hz"}
    missing, extra = needed - set(header), set(header) - needed
    extra |= {name for name in header if header.count(name) > 1}
    if missing:
        there = "it is not a modal map" if missing == needed else f"there are {header}"
        raise BadStage(f"{path}: no column {sorted(missing)}; {there}")
    if extra:
        raise BadStage(
            f"{path}: columns {sorted(extra)} are not parameters of the stage description; "
            "describe them as [[parameter]] or make the map without them"
        )
    # Blank lines count, and hold nothing.
    rows = {
        line: dict(zip_longest(header, map(str.strip, cells), fillvalue=""))
        for line, cells in enumerate(records, start=2)
        if any(map(str.strip, cells))
    }
    grid = [_column(path, rows, name, constants.VALUE) for name in parameters]
    frequency = _column(path, rows, "frequency_hz", constants.FREQUENCY_HZ)
    seen = set[tuple[str, ...]]()
    for (line, row), *point in zip(rows.items(), *grid, strict=True):
        if not row["mode"]:
            raise BadStage(f"{path}: line {line}: a mode without a name")
        if (one := (row["mode"], *point)) in seen:
            raise BadStage(f"{path}: line {line}: a mode occurs twice at one grid point")
        seen.add(one)
    return _fit(path, parameters, np.array(grid), [row["mode"] for row in rows.values()], frequency)


def _column(
    path: str, rows: Mapping[int, Mapping[str, str]], name: str, limits: tuple[float, float]
) -> FloatArray:
    """Return the numbers of a column, ``(n_rows,)``; refuse those out of their limits."""
    low, high = limits
    found = []
    for line, row in rows.items():
        try:
            number = float(row[name].replace("_", "?"))  # which Python takes for a part of a number
        except ValueError:
            number = np.nan
        if not low <= number <= high:
            shown = row[name] or "nan" if np.isnan(number) else number
            what = f"{path}: line {line}: {name} is {shown}"
            raise BadStage(f"{what}; needed is a positive number, {low:g} to {high:g}")
        found.append(number)
    return np.array(found)


def _fit(
    path: str,
    parameters: tuple[str, ...],
    grid: FloatArray,
    names: Sequence[str],
    frequency: FloatArray,
) -> ModalMap:
    """Fit the surrogate to frequencies ``(n_rows,)`` at grid points ``(n_parameters, n_rows)``."""
    modes = tuple(dict.fromkeys(names))
    axes = [np.unique(values) for values in grid]
    sizes = [axis.size for axis in axes]
    n_grid = math.prod(sizes)
    if len(names) != n_grid * len(modes):  # no mode is twice at a point
        raise BadStage(
            f"{path}: {len(names)} values where a full grid of {n_grid} points "
            f"with modes {list(modes)} needs {n_grid * len(modes)}"
        )
    if min(sizes) < 3:
        found = dict(zip(parameters, sizes, strict=True))
        raise BadStage(f"{path}: every parameter needs at least 3 grid values, there are {found}")
    for name, axis in zip(parameters, axes, strict=True):
        if (axis[1:] / axis[:-1]).min() < constants.LEAST_STEP:
            raise BadStage(f"{path}: grid values of {name} are equal but for rounding")
    order = np.lexsort((*grid[::-1], [modes.index(name) for name in names]))
    values = frequency[order].reshape(len(modes), n_grid).T
    points = np.log(grid[:, order[:n_grid]].T)
    low, high = points.min(axis=0), points.max(axis=0)
    unit = 2 * (points - low) / (high - low) - 1
    degrees, miss = _choose_sizes(unit, np.log(values), sizes)
    basis = _basis(unit, degrees)
    solved = np.linalg.lstsq(basis, np.log(values), rcond=None)[0]
    coefficients = np.asarray(solved, dtype=float).reshape(*degrees, len(modes))
    return ModalMap(parameters, modes, low, high, coefficients, miss)


def _evaluate(coefficients: FloatArray, unit: FloatArray) -> FloatArray:
    """Sum a tensor Chebyshev series at points ``(n_points, n_parameters)`` from -1 to 1."""
    *sizes, n_modes = coefficients.shape
    return np.asarray(_basis(unit, sizes) @ coefficients.reshape(-1, n_modes))


def _basis(unit: FloatArray, sizes: Sequence[int]) -> FloatArray:
    """Return the products of the polynomials of all parameters at points, ``(n_points, n)``."""
    return reduce(_products, _tables(unit, sizes)).T


def _tables(unit: FloatArray, sizes: Sequence[int]) -> list[FloatArray]:
    """Return the polynomials of each parameter at points, ``(d + 1, n_points)``."""
    return [chebvander(x, size - 1).T for x, size in zip(unit.T, sizes, strict=True)]


def _products(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the products of two sets of polynomials, ``(n_a n_b, n_points)``."""
    return (a[:, None] * b).reshape(len(a) * len(b), a.shape[1])


def _choose_sizes(
    unit: FloatArray, values: FloatArray, grid: list[int]
) -> tuple[list[int], FloatArray]:
    """Choose the coefficients of each axis with the least error at inner grid points left out."""
    # The largest error of each mode is returned, too, ``(n_modes,)`` (README.md, "Modal
    # map").
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
