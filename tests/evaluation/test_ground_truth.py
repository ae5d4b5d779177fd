"""Ground truth of occupancy against plain geometry: triangles cut with boxes, rays cut at every face."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from oracles.traversal import segments

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh, scene_mesh
from taichi_mrf.datasets.synthetic.room import SyntheticRoom
from taichi_mrf.errors import CapacityError, FrameError
from taichi_mrf.evaluation.occupancy_truth import (
    SLACK,
    OccupancyTruth,
    occupancy_truth,
    seen_voxels,
    surface_voxels,
)
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.voxels.layout import BRICK, CHUNK
from taichi_mrf.voxels.marks import count, marked_voxels

pytestmark = pytest.mark.usefixtures("backend")

CAMERA = PinholeCamera(width=22, height=17, fx=19, fy=20, cx=10.3, cy=8.2)
VOXEL = 0.1
Cells = set[tuple[int, int, int]]


def cells(voxels: NDArray[np.integer]) -> Cells:
    return set(map(tuple, voxels.tolist()))


def mesh_of(*triangles: object) -> TriangleMesh:
    vertices = np.array(triangles, np.float64).reshape(-1, 3)
    return TriangleMesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3))


def clipped(polygon: NDArray[np.float64], axis: int, value: float, sign: float) -> NDArray[np.float64]:
    """The part of a convex polygon, (n, 3), with sign * (x[axis] - value) >= 0."""
    side = sign * (polygon[:, axis] - value)
    out = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if side[i] >= 0:
            out.append(polygon[i])
        if side[i] * side[j] < 0:
            out.append(polygon[i] + (polygon[j] - polygon[i]) * side[i] / (side[i] - side[j]))
    return np.array(out).reshape(-1, 3)


def met_by(triangle: NDArray[np.float64], larger: float) -> Cells:
    """Voxels, of size 1 and larger by so much on each side, that still hold a part of a triangle after it
    was clipped by their six planes."""
    first = np.floor(triangle.min(axis=0) - 1).astype(int)
    last = np.floor(triangle.max(axis=0) + 1).astype(int)
    met = set()
    for cell in np.stack(np.meshgrid(*map(np.arange, first, last + 1)), axis=-1).reshape(-1, 3):
        part = triangle
        for axis in range(3):
            for value, sign in ((cell[axis] - larger, 1.0), (cell[axis] + 1 + larger, -1.0)):
                part = clipped(part, axis, value, sign) if len(part) else part
        if len(part):
            met.add(tuple(cell.tolist()))
    return met


coordinate = st.floats(-4, 4, allow_subnormal=False)
corner = st.tuples(coordinate, coordinate, coordinate)


@settings(max_examples=60)
@given(st.lists(st.tuples(corner, corner, corner), min_size=1, max_size=3))
def test_triangles_mark_the_voxels_they_pass_through(triangles: list) -> None:
    corners = np.array(triangles)
    found = cells(surface_voxels(mesh_of(*triangles), 1.0))
    edges = corners[:, [1, 2, 0]] - corners
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    # Slivers thinner than float32 resolves may lose voxels at their rim: no more than the outer bound.
    solid = corners[area > 1e-3]
    assert set().union(*(met_by(triangle, -1e-3) for triangle in solid)) <= found
    assert found <= set().union(*(met_by(triangle, 1e-3) for triangle in corners))


def test_a_large_far_triangle_keeps_its_digits() -> None:
    rng = np.random.default_rng(1)
    triangle = rng.uniform(-12, 12, (3, 3)) + np.array([3000.3, -4000.7, 77.1])
    found = cells(surface_voxels(mesh_of(triangle), 1.0))
    assert met_by(triangle, -1e-3) <= found <= met_by(triangle, 1e-3)
    assert len(found) > 100


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_surface_between_two_voxels_is_in_the_upper_one(axis: int) -> None:
    triangle = np.insert(np.array([[0.5, 0.5], [3.7, 0.5], [0.5, 3.7]]), axis, -2.0, axis=1)
    found = surface_voxels(mesh_of(triangle * 0.02), 0.02)
    assert (found[:, axis] == -2).all()
    below_the_diagonal = {(i, j) for i in range(4) for j in range(4) if i + j < 4.2}
    assert set(map(tuple, np.delete(found, axis, axis=1).tolist())) == below_the_diagonal


def test_surface_voxels_are_sorted_and_unique() -> None:
    found = surface_voxels(
        scene_mesh(Scene((Solid("sphere", (0, 0, 0), (0.7, 0.7, 0.7)),), (0, 0, 3))), VOXEL
    )
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, np.unique(found, axis=0))
    distance = np.linalg.norm((found + 0.5) * VOXEL, axis=1) - 0.7
    assert np.abs(distance).max() <= VOXEL * np.sqrt(3) / 2 + 1e-4
    inner = np.stack(np.meshgrid(*[np.arange(-9, 9)] * 3), axis=-1).reshape(-1, 3)
    corners = (inner[:, None] + np.stack(np.meshgrid(*[[0, 1]] * 3), axis=-1).reshape(-1, 3)) * VOXEL
    radius = np.linalg.norm(corners, axis=2)
    cut = inner[(radius.min(axis=1) < 0.699) & (radius.max(axis=1) > 0.701)]  # certainly on both sides
    assert cells(cut) <= cells(found)


def rough_depth(seed: int) -> NDArray[np.float32]:
    """Depths from 0.5 to 2.5 m with holes."""
    random = np.random.default_rng(seed)
    depth = random.uniform(0.5, 2.5, CAMERA.shape)
    depth[random.random(CAMERA.shape) < 0.2] = 0
    return depth.astype(np.float32)


VIEWS = [
    look_at((0.3, -0.2, 0.1), (2.0, 1.5, -0.4)),
    look_at((-1.1, -0.3, 0.2), (-2.0, 1.0, -1.0)),
    look_at((0.31, -0.2, 0.1), (2.0, 1.5, -0.4)),
]


@pytest.mark.parametrize("moved", [(0.0, 0.0, 0.0), (140.03, -260.02, 31.0)])
def test_seen_voxels_are_those_that_rays_cross_and_end_in(moved: tuple[float, ...]) -> None:
    poses = [T.copy() for T in VIEWS]
    for T in poses:
        T[:3, 3] += moved
    depths = [rough_depth(i) for i in range(3)]
    depths[1][0, :2] = (np.nan, -1.0)
    seen = seen_voxels(depths, poses, CAMERA, VOXEL)
    crossed, ended = (
        cells(marked_voxels(seen.crossed, seen.window)),
        cells(marked_voxels(seen.ended, seen.window)),
    )
    surely_crossed: Cells = set()
    maybe_crossed: Cells = set()
    maybe_ended: Cells = set()
    surely_ended: Cells = set()
    for depth, T in zip(depths, poses, strict=True):
        valid = np.isfinite(depth) & (depth > 0)
        for direction, z in zip(CAMERA.rays()[valid] @ T[:3, :3].T, depth[valid].astype(float), strict=True):
            slack = SLACK * VOXEL / np.linalg.norm(direction)
            voxels, near, far = segments(T[:3, 3], direction, 0.0, z - slack, VOXEL)
            long = far - near > 0.003 * VOXEL / np.linalg.norm(direction)
            surely_crossed |= cells(voxels[long])
            ends = T[:3, 3] + z * direction
            surely_ended |= cells(np.floor(ends / VOXEL).astype(int)[None]) if inside_well(ends) else set()
            voxels, _, _ = segments(T[:3, 3], direction, z - 1.5 * slack, z + 1.5 * slack, VOXEL)
            maybe_ended |= cells(voxels)
            maybe_crossed |= touched(T[:3, 3], direction, z)
    assert surely_crossed <= crossed <= maybe_crossed
    assert surely_ended <= ended <= maybe_ended
    assert len(crossed) == count(seen.crossed) > 500


def inside_well(point: NDArray[np.float64]) -> bool:
    share = point / VOXEL % 1
    return bool(((share > 1e-3) & (share < 1 - 1e-3)).all())


def touched(origin: NDArray[np.float64], direction: NDArray[np.float64], end: float) -> Cells:
    """Voxels within a thousandth of a voxel of a ray: those of rays beside it too."""
    near: Cells = set()
    for shift in np.stack(np.meshgrid(*[[-1e-3, 1e-3]] * 3), axis=-1).reshape(-1, 3):
        voxels, _, _ = segments(origin + shift * VOXEL, direction, 0.0, end, VOXEL)
        near |= cells(voxels)
    return near


def test_views_that_see_the_same_bricks_again_change_nothing() -> None:
    """A brick that is crossed entirely is stepped over from then on."""
    camera = PinholeCamera(width=80, height=60, fx=60, fy=60, cx=39.5, cy=29.5)
    wall = np.full(camera.shape, 4.0, np.float32)
    T = look_at((0.01, 0.02, 0.03), (1, 0.02, 0.03))
    once, thrice = (seen_voxels([wall] * n, [T] * n, camera, VOXEL) for n in (1, 3))
    np.testing.assert_array_equal(once.crossed, thrice.crossed)
    np.testing.assert_array_equal(once.ended, thrice.ended)
    assert (once.crossed.reshape(-1, 16) == -1).all(axis=1).sum() > 20


def wall_truth(depth: float, wall_at: float | None = None) -> OccupancyTruth:
    """A camera at the origin looks along x at a wall 4 m wide and high."""
    x = depth if wall_at is None else wall_at
    a, b, c, d = ((x, -2, -2), (x, 2, -2), (x, 2, 2), (x, -2, 2))
    image = np.full(CAMERA.shape, depth, np.float32)
    return occupancy_truth(
        mesh_of((a, b, c), (a, c, d)), [image], [look_at((0, 0, 0), (1, 0, 0))], CAMERA, VOXEL
    )


def test_a_wall_is_occupied_where_rays_end_and_free_in_front() -> None:
    truth = wall_truth(1.25)
    occupied, free = truth.occupied(), truth.free()
    assert (occupied[:, 0] == 12).all()
    ends = 1.25 * (CAMERA.rays().reshape(-1, 3) @ look_at((0, 0, 0), (1, 0, 0))[:3, :3].T)
    ends[:, 0] = 1.25  # all else of the wall is not seen
    assert cells(occupied) == cells(np.floor(ends / VOXEL).astype(int))
    assert set(free[:, 0]) == set(range(12))
    assert truth.counts == (len(occupied), len(free))


def test_a_wall_in_the_plane_between_voxels_is_in_neither() -> None:
    truth = wall_truth(1.2)
    assert not len(truth.occupied())
    assert set(truth.free()[:, 0]) == set(range(11))  # 11 is touched by the wall, so it is not judged


def test_what_no_ray_ends_in_is_not_occupied_and_what_none_crosses_not_free() -> None:
    truth = wall_truth(1.25, wall_at=0.65)  # rays pass the wall: as if it were seen from a hole
    assert truth.counts[0] == 0
    assert set(truth.free()[:, 0]) == set(range(13)) - {6}


def test_blocks_hold_every_judged_voxel_once() -> None:
    truth = wall_truth(1.25)
    centres, occupied = (np.concatenate(part) for part in zip(*truth.blocks(), strict=True))
    voxels = np.round(centres / VOXEL - 0.5).astype(int)
    np.testing.assert_allclose((voxels + 0.5) * VOXEL, centres, atol=1e-12)
    assert len(voxels) == sum(truth.counts) == len(cells(voxels))
    assert cells(voxels[occupied]) == cells(truth.occupied())
    assert cells(voxels[~occupied]) == cells(truth.free())


def test_the_rooms_truth_is_that_of_its_signed_distance() -> None:
    room = open_dataset("synthetic:room?frames=6&width=160&height=120&noise=none")
    assert isinstance(room, SyntheticRoom)
    indices = range(len(room))
    depths, poses = [room.clean_depth(i) for i in indices], [room.pose(i) for i in indices]
    truth = occupancy_truth(scene_mesh(room.scene), depths, poses, room.camera, 0.05)
    occupied, free = truth.occupied(), truth.free()
    assert len(occupied) > 10_000
    assert len(free) > 200_000
    # The nearest surface is at most half a diagonal away from the centre of a voxel that has one, and at
    # least half a side away from the centre of one that has none.
    distance = room.signed_distance((occupied + 0.5) * 0.05)
    assert np.abs(distance).max() <= 0.05 * np.sqrt(3) / 2 + 1e-4
    assert room.signed_distance((free + 0.5) * 0.05).min() >= 0.025 - 1e-4
    for depth, T in zip(depths, poses, strict=True):  # every ray ends in an occupied voxel
        ends = T[:3, 3] + depth[..., None] * (room.camera.rays() @ T[:3, :3].T)
        shares = ends.reshape(-1, 3) / 0.05
        deep = (np.abs(shares - np.round(shares)) > 0.02).all(axis=1)
        assert cells(np.floor(shares[deep]).astype(int)) <= cells(occupied)


def test_nothing_seen_is_nothing_judged() -> None:
    mesh = mesh_of(((0, 0, 0), (1, 0, 0), (0, 1, 0)))
    assert occupancy_truth(mesh, [], [], CAMERA, VOXEL).counts == (0, 0)
    blind = np.zeros(CAMERA.shape, np.float32)
    truth = occupancy_truth(mesh, [blind], [VIEWS[0]], CAMERA, VOXEL)
    assert truth.counts == (0, 0)
    assert truth.occupied().shape == truth.free().shape == (0, 3)
    assert list(truth.blocks()) == []


def test_triangles_without_area_and_outside_are_left_out() -> None:
    assert len(surface_voxels(mesh_of(((0, 0, 0), (1, 1, 1), (2, 2, 2))), VOXEL)) == 0
    far = mesh_of(((900, 0, 0), (901, 0, 0), (900, 1, 0)))
    image = np.full(CAMERA.shape, 1.0, np.float32)
    truth = occupancy_truth(far, [image], [VIEWS[0]], CAMERA, VOXEL)
    assert truth.counts[0] == 0 < truth.counts[1]


def test_wrong_input_is_one_clear_line() -> None:
    image = np.ones(CAMERA.shape, np.float32)
    with pytest.raises(FrameError, match="1 clean depth images do not match 2 poses"):
        seen_voxels([image], VIEWS[:2], CAMERA, VOXEL)
    with pytest.raises(FrameError, match=r"\(3, 3\)"):
        seen_voxels([image[:3, :3]], VIEWS[:1], CAMERA, VOXEL)
    with pytest.raises(CapacityError, match="choose larger voxels"):
        seen_voxels([image * 50], VIEWS[:1], CAMERA, BRICK * CHUNK * 1e-4)
