"""Tests of the modal map."""

import numpy as np
import pytest

from models.dynamics.modal_map import (
    MOUNT_RANGE,
    PRELOAD_RANGE,
    guide_frequencies,
    leave_out_error,
    lobatto_nodes,
    modal_map,
)
from models.dynamics.stages import STAGES


def test_nodes_hold_the_ends():
    """Chebyshev-Lobatto nodes ascend from one end of the range to the other."""
    nodes = lobatto_nodes((0.2, 2.2), 9)
    assert np.all(np.diff(nodes) > 0)
    np.testing.assert_allclose(nodes[[0, -1]], (0.2, 2.2))


@pytest.mark.slow
def test_map_reproduces_points_left_out():
    """The Chebyshev fit meets ln f within 1e-5 for mounts up to as new, within 3e-5 everywhere.

    On mounts stiffer than new roll and pitch of Y cross: they repel each other a little, and a
    polynomial does not follow that bend.
    """
    rng = np.random.default_rng(0)
    low, high = np.log([PRELOAD_RANGE, MOUNT_RANGE]).T
    points = [tuple(np.exp(rng.uniform(low, high))) for _ in range(60)]
    lived, stiffer = ([p for p in points if (p[1] > 1.0) == beyond] for beyond in (False, True))
    assert lived and stiffer
    for stage in STAGES.values():
        table = modal_map(stage)
        assert max(leave_out_error(stage, table, lived).values()) < 1e-5
        assert max(leave_out_error(stage, table, stiffer).values()) < 3e-5


def test_causes_can_be_separated_in_y_and_not_in_x():
    """Roll and pitch answer preload and mount differently in Y; X does not see its mount."""

    def slopes(stage, mode):
        step = 0.01
        up, down = np.exp([step, -step])
        ends = (((up, 1.0), (down, 1.0)), ((1.0, up), (1.0, down)))
        return [
            np.log(guide_frequencies(stage, *a)[mode] / guide_frequencies(stage, *b)[mode])
            / (2 * step)
            for a, b in ends
        ]

    y = np.array([slopes(STAGES["lms-y"], mode) for mode in ("roll", "pitch")])
    assert np.linalg.cond(y) < 10
    assert max(slopes(STAGES["lms-x"], mode)[1] for mode in ("roll", "pitch", "yaw")) < 0.02
