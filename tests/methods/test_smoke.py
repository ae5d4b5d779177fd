"""Each mapping method maps a wall: the tests with kernels that `make check` runs."""

from dataclasses import replace

import numpy as np
import pytest
from sliding_camera import ALL_FRAMES, WALL_M, sequence

from taichi_mrf.config.registry import METHODS
from taichi_mrf.mapping.pipeline import map_sequence


@pytest.mark.smoke
@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("method", sorted(METHODS))
def test_a_wall_is_occupied_and_the_space_before_it_free(method: str) -> None:
    m = map_sequence(sequence(), replace(ALL_FRAMES, method=method)).map
    depths = np.array([0.5 * WALL_M, WALL_M + 0.5 * ALL_FRAMES.voxel_size])
    before, wall = m.occupancy(np.stack([np.full(2, 0.05), np.zeros(2), depths], axis=1))
    unseen = m.occupancy([[0.05, 0.0, -1.0]])[0]
    assert before < unseen < wall
