"""Which unknown is which: every one has one place."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from lmshealth.modal.ambient.whittle import lay_out


@pytest.mark.parametrize(("m", "n"), list(product(range(4), range(1, 5))))
def test_every_unknown_has_one_place(m: int, n: int) -> None:
    """Poles, forces and shapes follow each other without gap, and fill all places."""
    layout = lay_out([i % n for i in range(m)], n)
    assert len(layout.pole) == layout.n_poles == layout.forces.start
    assert layout.forces.stop == layout.shapes.start
    assert layout.shapes.stop == layout.size == 2 * m + 3 * n + len(layout.force) + m * (n - 1)
    assert len(set(layout.pole)) == layout.n_poles
    assert len(set(layout.force)) == len(layout.force)
    assert all(j < i or (j == i < m) for i, j in layout.force)


def test_parts_that_floors_share_are_those_of_their_rows() -> None:
    """Of two modes and three channels: six shared with modes, three with other floors."""
    layout = lay_out([0, 1], 3)
    pairs = {k: layout.force[k - layout.forces.start] for k in (*layout.shared, *layout.common)}
    assert {pairs[k] for k in layout.shared} == set(product((2, 3, 4), (0, 1)))
    assert {pairs[k] for k in layout.common} == {(3, 2), (4, 2), (4, 3)}
    assert [layout.pole[k] for k in layout.bends] == [(2, 3), (3, 3), (4, 3)]


def test_a_single_channel_tells_what_neighbours_share_and_no_more() -> None:
    """Of three modes in one channel the first and the last have no force in common."""
    layout = lay_out([0, 0, 0], 1)
    assert (2, 0) not in layout.force
    assert {(1, 0), (2, 1)} <= set(layout.force)
    assert layout.shape == ()
    assert np.array(layout.force).max() == 3
