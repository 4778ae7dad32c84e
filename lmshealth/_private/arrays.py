"""Types of arrays, checks of those of frozen results, and what several folders compute alike."""

from collections.abc import Callable
from datetime import datetime
from functools import wraps
from typing import Any, ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

Given = ParamSpec("Given")
Result = TypeVar("Result")

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]


def one_thread(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Let linear algebra use one thread while a function runs.

    Its arrays are small: threads would wait for one another, and sum in another order.
    """

    # `threadpool_limits.wrap` may look for libraries once, before SciPy has loaded its own.
    @wraps(function)
    def limited(*args: Given.args, **named: Given.kwargs) -> Result:
        with threadpool_limits(1, user_api="blas"):
            return function(*args, **named)

    return limited


def freeze(result: Any, *shapes: tuple[str, *tuple[int, ...]]) -> None:
    """Make every array field of a frozen dataclass read-only, and require the shapes of some.

    These are names separated by blanks, then the lengths of the axes. `ValueError` names the field,
    its shape and the one needed. Fields of moments, or of tuples of them, become `plain_moment`.
    """
    for names, *shape in shapes:
        for name in names.split():
            found = getattr(result, name).shape
            if found != tuple(shape):
                raise ValueError(f"{name} has shape {found}, needed {tuple(shape)}")
    for name in result.__dataclass_fields__:
        value = getattr(result, name)
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        elif isinstance(value, datetime):
            object.__setattr__(result, name, plain_moment(value))
        elif isinstance(value, tuple) and value and isinstance(value[0], datetime):
            object.__setattr__(result, name, tuple(map(plain_moment, value)))


def plain_moment(moment: datetime) -> datetime:
    """Return a moment of a subclass, such as a Timestamp of pandas, as the datetime that it is.

    Arithmetic with a Timestamp has other limits and errors, and it cannot be packed. `ValueError`
    for NaT.
    """
    return moment if type(moment) is datetime else datetime.fromisoformat(moment.isoformat())


class ReadOnly:
    """Base of frozen dataclasses whose arrays are read-only."""

    __slots__ = ()

    def __post_init__(self) -> None:
        freeze(self)


class Rows:
    """Base of dataclasses whose fields share their first axis: they are indexed as arrays are."""

    __slots__ = ()

    def __getitem__(self, chosen: Any) -> Self:
        """Return some of the rows, by index or mask."""
        return self.with_each(lambda own: own[chosen])

    def with_each(self, change: Callable[..., Any], *others: Any) -> Self:
        """Return a function of each field, and of the same field of other objects."""
        own: Any = self
        names, each = own.__dataclass_fields__, (self, *others)
        return type(self)(*(change(*(getattr(one, name) for one in each)) for name in names))


def stack(values: ComplexArray) -> FloatArray:
    """Stack real above imaginary parts."""
    return np.concatenate([values.real, values.imag])


def diagonal(matrices: FloatArray) -> FloatArray:
    """Return the diagonals of ``(..., n, n)`` matrices as a writeable view."""
    view: FloatArray = np.einsum("...ii->...i", matrices)
    return view


def pivots(matrix: FloatArray, most: int, *, least: float = -np.inf) -> list[int]:
    """Return the pivots of a Cholesky decomposition of a covariance, ``(n, n)``, largest first.

    At most so many; those whose variance, given the pivots before, is below ``least`` are none.
    """
    order: list[int] = []
    while len(order) < min(most, len(matrix)):
        left = np.diagonal(matrix).copy()
        left[order] = -np.inf
        # The first of equals, whatever their rounding.
        best = int(np.argmax(left >= left.max() - 1e-9))
        if left[best] < least:
            break
        order.append(best)
        matrix = matrix - np.outer(matrix[:, best], matrix[best]) / max(left[best], 1e-300)
    return order


def finite_or_none(value: float) -> float | None:
    """Return a number, or None where it is not finite."""
    return float(value) if np.isfinite(value) else None
