"""Which voxels stand clear of surfaces, and which clusters of them count."""

from dataclasses import replace

import numpy as np
import pytest
from queried_maps import HandMap, map_of

from taichi_mrf.queries.changed_things import CORE_VOXELS, Surfaces, stands_clear


@pytest.fixture
def floor(one_backend: str) -> HandMap:
    """Free space over a floor at voxels of height 0."""
    log_odds = np.full((16, 16, 32), -5.0)
    log_odds[:, :, 0] = 3.0
    return map_of(one_backend, (0, 0, 0), log_odds)


def surfaces_of(floor: HandMap, voxel_size: float) -> Surfaces:
    return Surfaces(replace(floor, voxel_size=voxel_size).view.pool, voxel_size)


@pytest.mark.parametrize(
    ("voxel_size", "nearest"),
    [
        pytest.param(0.1, 4, id="three voxels where these are large"),
        pytest.param(0.05, 4, id="15 cm"),
        pytest.param(0.02, 8, id="15 cm in small voxels"),
        pytest.param(0.01, 16, id="more than a brick away"),
    ],
)
def test_the_slack_beside_surfaces(floor: HandMap, voxel_size: float, nearest: int) -> None:
    column = np.array([(5, 5, z) for z in range(32)], np.int32)
    clear = surfaces_of(floor, voxel_size).clear(column)
    np.testing.assert_array_equal(clear, np.arange(32) >= nearest)


def test_parts_of_a_thing_count_together(floor: HandMap) -> None:
    # 2 voxels wide: one is missing between the first two, five between the first and the last.
    surfaces, half = surfaces_of(floor, 0.05), CORE_VOXELS // 2
    cells = np.stack(np.unravel_index(np.arange(half), (2, 2, half)), axis=1)
    one, near, far = (np.add(cells, (x, 2, 10)).astype(np.int32) for x in (2, 5, 9))
    assert not stands_clear(one, surfaces).any()
    assert stands_clear(np.concatenate([one, near]), surfaces).all()
    assert not stands_clear(np.concatenate([one, far]), surfaces).any()
