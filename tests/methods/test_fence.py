"""Thin posts are not carved away by the rays that pass beside them, nor do they fill the gaps."""

import fence
import numpy as np
import pytest

from taichi_mrf.queries.points import FREE, OCCUPIED


@pytest.mark.usefixtures("one_backend")
def test_posts_of_a_fence_stay_and_gaps_stay_open() -> None:
    m = fence.mapped(fence.lidar(np.arange(65.0, 115.0, 0.35), 32), 12.0, 0.05, fence.FIRST, scans=8)
    posts, gaps = (m.state(fence.post_points(12.0, aside)) for aside in (0.0, 0.5 * fence.GAP_M))
    assert (posts == OCCUPIED).mean() > 0.5
    assert (gaps == FREE).mean() > 0.5
    assert (gaps == OCCUPIED).mean() < 0.02
    read = m.calibrated()
    posts, gaps = (read.state(fence.post_points(12.0, aside)) for aside in (0.0, 0.5 * fence.GAP_M))
    assert (posts == OCCUPIED).mean() > 0.7
    assert (posts == FREE).mean() < 0.15
    assert (gaps == OCCUPIED).mean() < 0.02


@pytest.mark.usefixtures("one_backend")
def test_posts_stay_in_voxels_wider_than_they_are_if_rays_may_pass() -> None:
    camera, shares = fence.lidar(np.arange(65.0, 115.0, 0.35), 32), {}
    for pass_through in (0.0, 0.1):
        m = fence.mapped(camera, 12.0, 0.1, fence.FIRST, scans=8, pass_through=pass_through)
        posts, gaps = (m.state(fence.post_points(12.0, aside)) for aside in (0.0, 0.5 * fence.GAP_M))
        shares[pass_through] = (posts == OCCUPIED).mean()
        assert (gaps == FREE).mean() > 0.9
    assert shares[0.1] > 0.9
    assert shares[0.1] > shares[0.0] + 0.3
