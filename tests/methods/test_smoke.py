"""Each mapping method maps a wall: the test with kernels that `make check` runs."""

from dataclasses import replace

import numpy as np
import pytest
from sliding_camera import ALL_FRAMES, CAMERA, WALL_M, sequence

from taichi_mrf.config.schema import Method
from taichi_mrf.mapping.pipeline import map_sequence

METHODS: tuple[Method, ...] = ("mrf", "log_odds", "visibility")


@pytest.mark.smoke
@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("method", METHODS)
def test_a_wall_is_mapped(method: Method) -> None:
    m = map_sequence(sequence(), replace(ALL_FRAMES, method=method)).map
    depth_m = m.render_depth(CAMERA, np.eye(4))
    assert np.nanmedian(np.abs(depth_m - WALL_M)) < ALL_FRAMES.voxel_size
