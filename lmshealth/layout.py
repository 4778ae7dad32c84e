"""Which unknown of the likelihood is which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Layout:
    """Which unknown is which.

    Attributes
    ----------
    n_modes, n_channels : int
        Numbers of modes and of channels, whose floors are the components after the modes.
    force : tuple of (int, int)
        Row and column of each unknown of L.
    shape : tuple of (int, int)
        Channel and mode of each unknown of the shapes.
    """

    n_modes: int
    n_channels: int
    force: tuple[tuple[int, int], ...]
    shape: tuple[tuple[int, int], ...]

    @property
    def n_components(self) -> int:
        """Number of modes and floors."""
        return self.n_modes + self.n_channels

    @property
    def n_poles(self) -> int:
        """Number of the first unknowns, those of h: two per mode, three per floor."""
        return 2 * self.n_modes + 3 * self.n_channels

    @property
    def pole(self) -> list[tuple[int, int]]:
        """Component of each of the first unknowns, and which derivative of h belongs to it."""
        modes = [(i, q) for q in (1, 2) for i in range(self.n_modes)]
        floors = [(i, q) for i in range(self.n_modes, self.n_components) for q in (1, 2, 3)]
        return modes + floors

    @property
    def forces(self) -> slice:
        """Unknowns of L."""
        return slice(self.n_poles, self.n_poles + len(self.force))

    @property
    def shared(self) -> list[int]:
        """Unknowns of L by which floors share the forces of modes."""
        m, first = self.n_modes, self.forces.start
        return [first + a for a, (i, j) in enumerate(self.force) if i >= m > j]

    @property
    def common(self) -> list[int]:
        """Unknowns of L by which floors share the forces of other floors."""
        m, first = self.n_modes, self.forces.start
        return [first + a for a, (_, j) in enumerate(self.force) if j >= m]

    @property
    def bends(self) -> list[int]:
        """Unknowns b of the floors."""
        return list(range(2 * self.n_modes + 2, self.n_poles, 3))

    @property
    def shapes(self) -> slice:
        """Unknowns of the shapes."""
        return slice(self.forces.stop, self.size)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.n_poles + len(self.force) + len(self.shape)


def lay_out(reference: Sequence[int], n_channels: int) -> Layout:
    """Lay the unknowns out.

    Parameters
    ----------
    reference : sequence of int
        Of each mode the channel in which its shape is one.
    n_channels : int
        Number of channels.
    """
    m = len(reference)
    # A single channel tells no more than which forces neighbours share.
    modes = [(i, j) for i in range(m) for j in range(i + 1) if n_channels > 1 or i - j < 2]
    floors = [(m + c, j) for c in range(n_channels) for j in range(m + c)]
    shape = [(c, i) for i in range(m) for c in range(n_channels) if c != reference[i]]
    return Layout(m, n_channels, (*modes, *floors), tuple(shape))
