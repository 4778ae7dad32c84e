"""Types of arrays, and checks of the arrays of frozen results."""

from dataclasses import fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]


def freeze(result: Any) -> None:
    """Make every array field of a frozen dataclass read-only."""
    for item in fields(result):
        value = getattr(result, item.name)
        if isinstance(value, np.ndarray):
            value.setflags(write=False)


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
        own: Any = self
        some: Self = type(own)(*(getattr(own, item.name)[chosen] for item in fields(own)))
        return some


def stack(values: ComplexArray) -> FloatArray:
    """Stack real above imaginary parts."""
    return np.concatenate([values.real, values.imag])


def expect_shape(name: str, array: np.ndarray[Any, Any], shape: tuple[int, ...]) -> None:
    """Require the shape of a field; `ValueError` names the field, its shape and the one needed."""
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, needed {shape}")
