"""Each mapping method maps a wall: the tests with kernels that `make check` runs."""

from dataclasses import replace

import numpy as np
import pytest
from sliding_camera import ALL_FRAMES, WALL_M, sequence

from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.sections import WavemapConfig
from taichi_mrf.mapping.pipeline import map_sequence


@pytest.mark.smoke
@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("method", sorted(METHODS))
def test_the_space_before_the_camera_is_free_and_the_wall_is_not(method: str) -> None:
    wide = WavemapConfig(angle_sigma_deg=1.0)  # this camera's pixels are further apart than an OS0's beams
    m = map_sequence(sequence(), replace(ALL_FRAMES, method=method, wavemap=wide)).map
    depths_m = np.array([0.15, WALL_M + 0.5 * ALL_FRAMES.voxel_size])
    near, wall = m.occupancy(np.stack([np.full(2, 0.05), np.full(2, 0.05), depths_m], axis=1))
    unseen = m.occupancy([[0.05, 0.05, -1.0]])[0]
    # A visibility map reaches the wall only after many more views.
    assert near < unseen <= wall
