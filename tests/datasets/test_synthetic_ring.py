"""The built-in ring corridor: it leads back to its beginning, and nothing stands in the way."""

import itertools

import numpy as np
import pytest

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.synthetic.corridor import OVERLAP_M, SmoothWay, SyntheticRing
from taichi_mrf.geometry.poses import as_pose, tangent_norms

SMALL = "synthetic:ring?frames=60&width=80&height=60&noise=none"


def opened(source: str) -> SyntheticRing:
    ring = open_dataset(source)
    assert isinstance(ring, SyntheticRing)
    return ring


@pytest.mark.parametrize("length", [24, 60])
def test_the_camera_keeps_clear_and_comes_back(length: int) -> None:
    ring = opened(f"{SMALL}&length={length}")
    poses = [ring.way.pose_at(metres) for metres in np.arange(0.0, ring.way.length_m, 0.1)]
    assert ring.signed_distance([T[:3, 3] for T in poses]).min() > 0.3
    assert 0.9 * (length + OVERLAP_M) < ring.way.length_m < length + OVERLAP_M
    # The last metres are the first ones once more, in the same direction.
    again = [tangent_norms(T, ring.way.pose_at(OVERLAP_M - 0.5)) for T in poses[-10:]]
    assert min(shifted for _, shifted in again) < 0.2
    assert min(turned for turned, _ in again) < 0.6
    assert np.ptp([T[:3, 3] for T in poses], axis=0)[:2].min() > length / 6 - 1
    turns, steps = np.transpose([tangent_norms(a, b) for a, b in itertools.pairwise(poses)])
    assert steps.max() < 0.12
    assert np.degrees(turns.max()) < 15
    for T in poses[::40]:
        np.testing.assert_allclose(as_pose(T), T, atol=1e-12)


def test_a_way_goes_where_its_corners_are_and_rounds_them() -> None:
    way = SmoothWay([(0.0, 0.0), (10.0, 0.0), (10.0, 8.0)], rounding_m=2.0, floor_z=-1.0)
    begin, end = way.pose_at(0.0), way.pose_at(way.length_m)
    np.testing.assert_allclose(begin[:2, 3], [0, 0], atol=0.05)
    np.testing.assert_allclose(end[:2, 3], [10, 8], atol=0.05)
    assert 17 < way.length_m < 18
    # In the middle of the first side it walks along x, upright, 1.5 m over the floor.
    middle = way.pose_at(5.0)
    assert middle[2, 3] == pytest.approx(0.5, abs=0.04)
    assert middle[0, 2] > 0.9
    assert middle[2, 1] < -0.95
    corner = min(np.linalg.norm(way.pose_at(s)[:2, 3] - (10, 0)) for s in np.arange(9, 11, 0.05))
    assert 0.05 < corner < 0.5


def test_it_is_closed_and_bare_walls_are_seen_through_nothing(backend: str) -> None:
    furnished, bare = opened(SMALL), opened(f"{SMALL}&walls=bare")
    assert len(bare.scene.solids) == 7 < len(furnished.scene.solids)
    for index in range(0, 60, 12):
        T, seen = bare.pose(index), bare.clean_depth(index)
        assert (furnished.clean_depth(index) <= seen + 1e-4).all()
        assert (furnished.clean_depth(index) < seen - 0.05).any()
        points = (bare.camera.rays() * seen[..., None]).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
        assert (seen > 0).all()
        assert np.abs(bare.signed_distance(points)).max() < 2e-3
