"""The rooms with thin things: closed forms against marching and sampling, and what views measure."""

import numpy as np
import pytest

from benchmarks.thin_paths import BALL_M, SPARE_M, crossings
from benchmarks.thin_rooms import SCENES, Sensor, spinning_lidar, take_views
from benchmarks.thin_shapes import Array, Box, Capsule, Disc, Shape, frame_along, voxels_of
from taichi_mrf import PinholeCamera

SMALL = Sensor(PinholeCamera(80, 60, 65, 65, 39.5, 29.5), (0.001504, -0.00152, 0.0019), 10.0)


def some_shape(kind: type, draw: np.random.Generator) -> Shape:
    at, way = draw.uniform(-0.2, 0.2, 3), draw.normal(size=3)
    if kind is Box:
        return Box(at, draw.uniform(0.005, 0.3, 3), frame_along(way))
    if kind is Capsule:
        return Capsule(at, at + 0.3 * way, draw.uniform(0.005, 0.1))
    return Disc(at, way / np.linalg.norm(way), draw.uniform(0.05, 0.3))


def points_in(shape: Shape, number: int, draw: np.random.Generator) -> Array:
    if isinstance(shape, Capsule):
        off = draw.normal(size=(number, 3))
        off *= (shape.radius_m * draw.uniform(size=(number, 1)) ** (1 / 3)) / np.linalg.norm(
            off, axis=1, keepdims=True
        )
        return shape.start_m + draw.uniform(size=(number, 1)) * (shape.end_m - shape.start_m) + off
    inside = draw.uniform(-1, 1, (number, 3)) * shape.half_m
    if isinstance(shape, Disc):
        inside = inside[np.hypot(inside[:, 0], inside[:, 1]) <= shape.radius_m]
    return shape.centre_m + inside @ shape.frame.T


def numbers(voxels: Array) -> Array:
    """One number (...) for each voxel (..., 3), of those up to 10,000 from the origin."""
    assert np.abs(voxels).max() < 10_000
    return (voxels + 10_000).astype(np.int64) @ np.array([400_000_000, 20_000, 1])


@pytest.mark.parametrize("kind", [Box, Capsule, Disc])
@pytest.mark.parametrize("seed", range(4))
def test_rays_enter_where_marching_by_distance_ends(kind: type, seed: int) -> None:
    draw = np.random.default_rng(seed)
    shape = some_shape(kind, draw)
    origin = np.array([2.0, -1.5, 1.0])
    rays = shape.centre_m + draw.normal(0, 0.25, (400, 3)) - origin
    depth = shape.depth(origin, rays)
    length, t, closest = np.linalg.norm(rays, axis=1), np.zeros(len(rays)), np.full(len(rays), np.inf)
    for _ in range(2000):
        distance = shape.distance(origin + t[:, None] * rays)
        closest = np.minimum(closest, distance)
        t = np.minimum(t + np.where(distance < 1e-7, 0, distance) / length, 5.0)  # a disc has no thickness
    hit = np.isfinite(depth)
    assert 5 < hit.sum() < 400
    np.testing.assert_allclose(t[hit], depth[hit], atol=1e-4)
    assert (closest[~hit] > 0).all()
    np.testing.assert_allclose(shape.distance(origin + depth[hit, None] * rays[hit]), 0, atol=1e-9)


@pytest.mark.parametrize("kind", [Box, Capsule, Disc])
@pytest.mark.parametrize("seed", range(4))
def test_a_shape_has_the_voxels_that_points_of_it_lie_in_and_no_others(kind: type, seed: int) -> None:
    draw, size = np.random.default_rng(seed), 0.07
    shape = some_shape(kind, draw)
    points = points_in(shape, 200_000, draw)
    np.testing.assert_allclose(shape.distance(points), 0, atol=1e-9)
    voxels = voxels_of(shape, size)
    assert len(np.unique(voxels, axis=0)) == len(voxels)
    sampled, found = numbers(np.floor(points / size)), numbers(voxels)
    assert np.isin(sampled, found).all()
    for voxel in voxels[~np.isin(found, sampled)]:  # a corner too small for a sample: one lies close to it
        low = voxel * size
        outside = np.linalg.norm(points - np.clip(points, low, low + size), axis=1)
        assert outside.min() < 0.2 * size


@pytest.mark.parametrize("name", ["room", "fence", "clutter", "yard"])
def test_every_measurement_ends_in_a_voxel_of_the_thing_that_it_meets(name: str) -> None:
    scene, size = SCENES[name](0), 0.05
    sensor = spinning_lidar(True) if name == "yard" else SMALL
    views = take_views(scene, sensor, 3, 0)
    ends = np.concatenate([view.points(sensor.camera) for view in views])
    thing = np.concatenate([view.thing[view.depth_m > 0] for view in views])
    assert len(np.unique(thing)) > 6
    for i in np.unique(thing):
        shape, here = scene.things[i].shape, ends[thing == i]
        np.testing.assert_allclose(shape.distance(here), 0, atol=1e-6)
        if np.ptp(shape.bounds_m, axis=0).prod() > 50:  # millions of voxels
            continue
        around = np.floor((here[:, None] + np.array([[-1e-6], [0], [1e-6]])) / size)
        assert np.isin(numbers(around), numbers(voxels_of(shape, size))).any(axis=1).all()


def test_views_follow_from_the_seed_and_their_noise_is_the_stated_one() -> None:
    scene = SCENES["room"](0)
    (one,), (same,), (other,) = (take_views(scene, SMALL, 1, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.depth_m, same.depth_m)
    assert not np.array_equal(one.T_world_camera, other.T_world_camera)
    off = (one.depth_m - one.true_m) / SMALL.sigma_at(one.true_m)
    assert abs(off.mean()) < 0.05
    assert abs(off.std() - 1) < 0.05


def test_paths_lead_through_a_thing_and_past_all() -> None:
    scene = SCENES["room"](0)
    paths = crossings(scene, SMALL, take_views(scene, SMALL, 20, 0))
    along = np.linspace(0, 1, 101)[:, None]
    through = [path for path in paths if path.through_m is not None]
    past = [path.past_m for path in paths if path.past_m is not None]
    assert len(through) > 8
    assert len(past) > 4
    for path in through:
        start, end = path.through_m
        own = [thing for thing in scene.things if thing.kind == path.kind]
        assert scene.clearance(start + along * (end - start), own).min() < 0.01
    for start, end in past:
        assert scene.clearance(start + along * (end - start)).min() > BALL_M + SPARE_M - 1e-3
