"""Footprints: the bricks that an image's rays cross, and those at its surfaces, against plain geometry.

A ray that grazes a brick's edge may or may not count, so two sets of bricks are worked out for each
image, with every brick a little smaller and a little larger than it is; the footprint lies between them.
"""

# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from oracles.forward import Noise
from oracles.traversal import clip_to_box, segments

from taichi_mrf.config.schema import SensorConfig, VolumeConfig
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.errors import CapacityError
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.inference.footprint import find_footprint, visible_box
from taichi_mrf.inference.keyframe import DepthImage, Footprint, RayList
from taichi_mrf.inference.ray_list import RayBundler, block_ray, end_of_shared_path
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.noise import NoiseModel, PatchNoise, PolynomialNoise
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, AnyArray, I32Array, Struct, Template, Vec3
from taichi_mrf.voxels.layout import BRICK, CHUNK
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, make_ray, walk_voxels
from taichi_mrf.voxels.window import Window

# Written out, and not imported: these tests hold the value.
END_SIGMAS = 3.0

pytestmark = pytest.mark.usefixtures("backend")

CAMERA = PinholeCamera(width=26, height=19, fx=22, fy=23, cx=12.3, cy=9.4)
NOISE = Noise((0.02, 0.0, 0.004), (0.01, -0.02))
VOXEL = 0.05
SENSOR = SensorConfig(max_depth=6.0)

GRAZING = 1e-3
"""In voxels."""

POSES = {
    "oblique": look_at((0.3, -0.2, 0.1), (2.0, 1.5, -0.4)),
    "negative": look_at((-7.1, -3.3, -2.2), (-9.0, -2.0, -3.0)),
    "far away": look_at((140.03, -260.02, 31.0), (139.0, -263.0, 30.5)),
    "axis-parallel": look_at((0.013, 0.021, 0.017), (1.013, 0.021, 0.017)),
}


def uploaded(
    depth_m: NDArray[np.float64], noise: NoiseModel | None = None, camera: PinholeCamera = CAMERA
) -> DepthImage:
    """An image as a map holds it; 0 is no measurement."""
    noise = noise or PolynomialNoise(NOISE.sigma, NOISE.bias)
    return DepthImage.upload(depth_m.astype(np.float32), camera, noise)


def scene(seed: int) -> NDArray[np.float64]:
    """Depths of a rough surface with holes, from 0.4 to 4 m."""
    random = np.random.default_rng(seed)
    v, u = np.indices(CAMERA.shape)
    depth = 2.2 + np.sin(u / 5 + seed) + 0.6 * np.cos(v / 3) + 0.1 * random.normal(size=CAMERA.shape)
    depth[random.random(CAMERA.shape) < 0.2] = 0
    return depth


@dataclass(frozen=True)
class Rays:
    """An image's rays in a window: (n,) measured, (3,) centre and (n, 3) directions in voxels for one
    metre of depth, and (n,) the depths at which surfaces may begin and rays end."""

    centre: NDArray[np.float64]
    directions: NDArray[np.float64]
    surface: NDArray[np.float64]
    end: NDArray[np.float64]


def rays_of(image: DepthImage, T: Pose, window: Window, max_depth: float, noise: Noise = NOISE) -> Rays:
    measured = image.to_numpy().reshape(-1).astype(np.float64)
    seen = measured > 0
    directions = image.camera.rays().reshape(-1, 3)[seen] @ T[:3, :3].T / window.voxel_size
    sigmas = END_SIGMAS
    end = noise.depth_of_deviation(measured[seen], -sigmas)
    surface = noise.depth_of_deviation(measured[seen], sigmas)
    return Rays(window.to_voxels(T[:3, 3]), directions, surface, np.minimum(end, max_depth))


def bricks_met(
    rays: Rays, window: Window, box: tuple[NDArray, NDArray], larger: float
) -> tuple[set[int], set[int]]:
    """Cells that rays cross, and cells that they cross beyond ``surface``, where bricks, the ends of rays
    and the box are all larger by some voxels (or smaller, if negative)."""
    cells = np.arange(window.cells, dtype=np.int32)
    low = np.stack(np.unravel_index(cells, window.shape), axis=1) * float(BRICK)
    lower = np.maximum(low - larger, box[0] - larger)
    upper = np.minimum(low + BRICK + larger, box[1] + larger)
    directions = np.where(rays.directions == 0, 1e-20, rays.directions)
    inside = (lower < upper).all(axis=1)
    crossed, surface = np.zeros(window.cells, bool), np.zeros(window.cells, bool)
    # Newton's method in float32 finds a depth to a hundredth of a sigma.
    depth_larger = larger / np.linalg.norm(rays.directions, axis=1) + np.copysign(0.001, larger)
    for direction, begin, end, slack in zip(directions, rays.surface, rays.end, depth_larger, strict=True):
        a, b = (lower - rays.centre) / direction, (upper - rays.centre) / direction
        enter = np.maximum(np.minimum(a, b).max(axis=1), 0)
        leave = np.minimum(np.maximum(a, b).min(axis=1), end + slack)
        met = inside & (leave > enter)
        crossed |= met
        surface |= met & (leave > begin - slack)
    return set(cells[crossed].tolist()), set(cells[surface].tolist())


def eighths_met(
    rays: Rays, window: Window, box: tuple[NDArray, NDArray]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How many eighths of each cell rays cross in front of ``surface``, at least and at most: where they are
    after 1, 3 and 5 sixths of their way through it. A cell in which a ray begins counts as crossed wholly."""
    cells = np.arange(window.cells, dtype=np.int32)
    low = np.stack(np.unravel_index(cells, window.shape), axis=1) * float(BRICK)
    lower, upper = np.maximum(low, box[0]), np.minimum(low + BRICK, box[1])
    directions = np.where(rays.directions == 0, 1e-20, rays.directions)
    least, most = np.zeros((2, window.cells, 8), bool)
    for direction, begin, end in zip(directions, rays.surface, rays.end, strict=True):
        a, b = (lower - rays.centre) / direction, (upper - rays.centre) / direction
        enter, leave = np.minimum(a, b).max(axis=1), np.minimum(np.maximum(a, b).min(axis=1), end)
        for found, larger in ((least, -GRAZING), (most, GRAZING)):
            met = (lower < upper).all(axis=1) & (leave - np.maximum(enter, 0) > -larger)
            met &= leave < begin + larger
            found[met & (enter < larger)] = True
            for sixth in (1, 3, 5):
                place = rays.centre + (enter + sixth / 6 * (leave - enter))[:, None] * direction
                for shift in np.ndindex(2, 2, 2):
                    shifted = place + 2 * larger * (np.array(shift) - 0.5)
                    number = (shifted - low >= BRICK / 2) @ np.array([4, 2, 1])
                    clear = (np.abs(place - low - BRICK / 2) > GRAZING).all(axis=1)
                    rows = met & clear if found is least else met
                    found[rows, number[rows]] = True
    return least.sum(axis=1), most.sum(axis=1)


def whole(window: Window) -> tuple[NDArray, NDArray]:
    return np.zeros(3), np.array(window.shape) * float(BRICK)


def assert_between(footprint: Footprint, rays: Rays, box: tuple[NDArray, NDArray]) -> None:
    least, most = (bricks_met(rays, footprint.window, box, larger) for larger in (-GRAZING, GRAZING))
    for found, must, may in zip((footprint.crossed, footprint.surface), least, most, strict=True):
        assert must
        assert must <= set(found.tolist()) <= may
        assert len(may - must) < 0.1 * len(must)  # or this test would say little
        assert (np.diff(found) > 0).all()
    assert set(footprint.surface.tolist()) < set(footprint.crossed.tolist())
    # More than half of a brick is seen, or a surface is near.
    fewest, largest = eighths_met(rays, footprint.window, box)
    crossed, near, seen = footprint.crossed, set(footprint.surface.tolist()), set(footprint.seen.tolist())
    assert near | set(crossed[fewest[crossed] > 4].tolist()) <= seen
    assert seen <= near | set(crossed[largest[crossed] > 4].tolist())
    assert near < seen < set(crossed.tolist())


def every_ray(image: DepthImage) -> RayList:
    return RayBundler(VOXEL, InferenceConfig(ray_density=0.0)).rays_of(image)


def footprint_of(
    image: DepthImage, T: Pose, volume: VolumeConfig | None = None, sensor: SensorConfig = SENSOR
) -> Footprint:
    return find_footprint(image, every_ray(image), T, VOXEL, sensor, volume or VolumeConfig())


@pytest.mark.parametrize("pose", POSES)
def test_crossed_and_surface_bricks(pose: str) -> None:
    image, T = uploaded(scene(0)), POSES[pose]
    footprint = footprint_of(image, T)
    rays = rays_of(image, T, footprint.window, SENSOR.max_depth)
    assert_between(footprint, rays, whole(footprint.window))


def test_surfaces_are_where_the_measurement_may_have_come_from() -> None:
    """Of a wall square to the camera: all bricks on the rays from 3 sigma before it to 3 sigma behind."""
    T = look_at((0.01, 0.2, 0.2), (1.0, 0.2, 0.2))
    image = uploaded(np.full(CAMERA.shape, 3.0), PolynomialNoise((0.1,)))
    footprint = footprint_of(image, T)
    brick_m = VOXEL * BRICK
    first, last = np.floor((0.01 + 3.0 + np.array([-0.3, 0.3])) / brick_m)
    x = footprint.window.bricks_of(footprint.surface)[:, 0]
    assert (x.min(), x.max()) == (first, last)
    assert footprint.window.bricks_of(footprint.crossed)[:, 0].min() == 0


@pytest.mark.parametrize("beyond", [0.35, 1.2])
def test_rays_can_go_on_beyond_their_end(beyond: float) -> None:
    """As if every ray ended so many metres of axial depth further away; surfaces begin where they did."""
    image, T = uploaded(scene(5)), POSES["oblique"]
    footprint = find_footprint(image, every_ray(image), T, VOXEL, SENSOR, VolumeConfig(), beyond_m=beyond)
    rays = rays_of(image, T, footprint.window, 1e9)
    further = replace(rays, end=np.minimum(rays.end + beyond, SENSOR.max_depth))
    assert_between(footprint, further, whole(footprint.window))
    assert len(footprint.crossed) > len(footprint_of(image, T).crossed)


@pytest.mark.parametrize("value", [0.0, 2.5])
def test_an_image_of_nothing_and_one_of_a_single_pixel(value: float) -> None:
    depth = np.zeros(CAMERA.shape)
    depth[7, 11] = value
    image, T = uploaded(depth), POSES["oblique"]
    footprint = footprint_of(image, T)
    if value:
        rays = rays_of(image, T, footprint.window, SENSOR.max_depth)
        cells, _, far = segments(rays.centre, rays.directions[0], 0.0, rays.end[0], BRICK)
        expected = np.ravel_multi_index(tuple(cells.T), footprint.window.shape)
        np.testing.assert_array_equal(footprint.crossed, np.sort(expected))
        np.testing.assert_array_equal(footprint.surface, np.sort(expected[far > rays.surface[0]]))
    else:
        assert footprint.crossed.tolist() == footprint.surface.tolist() == []
        assert footprint.crossed.dtype == np.int32
        assert len(footprint.window.bricks_of(footprint.crossed)) == 0


def test_rays_with_a_shared_path_cross_the_bricks_on_it() -> None:
    """A fine image of a wall: single rays begin far from the camera, and groups of them bring the rest. The
    bricks are those of all pixels, but for some that few of these graze."""
    camera = PinholeCamera(width=160, height=120, fx=130, fy=130, cx=79.5, cy=59.5)
    T = look_at((0.03, 0.21, 0.22), (1.0, 0.3, 0.2))
    image = uploaded(np.full(camera.shape, 3.0), camera=camera)
    bundled = RayBundler(VOXEL, InferenceConfig()).rays_of(image)
    assert bundled.group_number < 0.3 * bundled.number
    found = find_footprint(image, bundled, T, VOXEL, SENSOR, VolumeConfig())
    single = rays_of(image, T, found.window, SENSOR.max_depth)
    some = Rays(single.centre, *(each[::7] for each in (single.directions, single.surface, single.end)))
    must, _ = bricks_met(some, found.window, whole(found.window), -1.0)  # by a voxel at least
    may, _ = bricks_met(some, found.window, whole(found.window), 1.0)
    crossed = set(found.crossed.tolist())
    assert crossed <= may
    depth_m = (found.window.bricks_of(found.crossed)[:, 0] + 1) * BRICK * VOXEL
    assert (depth_m < 2.0).sum() > 20
    assert len(must - crossed) <= 0.02 * len(must)


def test_rays_end_at_max_depth_and_a_measurement_beyond_has_no_surface() -> None:
    depth = scene(3)
    depth[depth > 0] += 1.0
    sensor = replace(SENSOR, max_depth=2.6)
    image, T = uploaded(depth), POSES["oblique"]
    footprint = footprint_of(image, T, sensor=sensor)
    rays = rays_of(image, T, footprint.window, sensor.max_depth)
    assert_between(footprint, rays, whole(footprint.window))
    beyond = uploaded(np.full(CAMERA.shape, 5.0))
    footprint = footprint_of(beyond, T, sensor=sensor)
    assert len(footprint.crossed) > 50
    assert len(footprint.surface) == 0


def test_a_volume_cuts_the_rays() -> None:
    lower, upper = (0.45, -0.35, -0.85), (2.1, 1.55, 0.6)
    image, T = uploaded(scene(4)), POSES["oblique"]
    volume = VolumeConfig(lower=lower, upper=upper)
    footprint = footprint_of(image, T, volume)
    rays = rays_of(image, T, footprint.window, SENSOR.max_depth)
    box = footprint.window.to_voxels(lower), footprint.window.to_voxels(upper)
    assert_between(footprint, rays, box)
    bricks = footprint.window.bricks_of(footprint.crossed) * BRICK * VOXEL
    assert (bricks < np.array(upper)).all()
    assert (bricks + BRICK * VOXEL > np.array(lower)).all()
    everywhere = footprint_of(image, T)
    assert len(footprint.crossed) < 0.9 * len(everywhere.crossed)


def test_a_volume_behind_the_camera_is_not_seen() -> None:
    volume = VolumeConfig(lower=(-9, -9, -9), upper=(-8, -8, -8))
    footprint = footprint_of(uploaded(scene(5)), POSES["oblique"], volume)
    assert footprint.crossed.tolist() == footprint.surface.tolist() == []


def test_a_view_with_too_many_bricks_is_an_error() -> None:
    image = uploaded(np.full(CAMERA.shape, 5.0))
    with pytest.raises(CapacityError, match="voxel size of 1e-05 m"):
        find_footprint(image, every_ray(image), POSES["oblique"], 1e-5, SENSOR, VolumeConfig())


@ti.dataclass
class _Count(Struct):
    voxels: I32


@ti.func
def _count_voxel(count: Template, context: Template, index: I32, near: F32, far: F32):
    count.voxels += 1
    return 1


@kernel
def _count_voxels(
    rays: AnyArray, centre: Vec3, space: Space, out: I32Array, block: Template,
) -> None:  # fmt: skip
    if ti.static(block > 0):
        ti.loop_config(block_dim=block)
    for i in range(out.shape[0]):
        ray = make_ray(centre, Vec3(rays[i, 0], rays[i, 1], rays[i, 2]))
        begin, end = 0.0, rays[i, 3]
        clip(ray, begin, end, space.lower, space.upper)
        count = _Count(0)
        walk_voxels(ray, begin, end, space, _count_voxel, count, 0)
        out[i] = count.voxels


@kernel
def _count_steps(
    rays: RayList, sensor: Sensor, view: Viewpoint, space: Space, max_depth: F32,
    most: I32Array, groups: I32Array,
) -> None:  # fmt: skip
    """The most steps that a ray and the shared path of its group have together, as sum_product.send_messages
    writes them down, and how many groups have a shared path."""
    for group in range(rays.group_number):
        middle = block_ray(rays.groups[group], sensor, view)
        apart = end_of_shared_path(rays, group, middle, 0.0, max_depth)
        begin, end = 0.0, apart
        clip(middle, begin, end, space.lower, space.upper)
        shared = _Count(0)
        walk_voxels(middle, begin, end, space, _count_voxel, shared, 0)
        groups[0] += ti.cast(shared.voxels > 0, I32)
        for i in range(rays.first[group], rays.first[group + 1]):
            ray = block_ray(rays.blocks[i], sensor, view)
            begin, end = apart, ti.min(sensor.until(rays.depth[i], rays.last[i]), max_depth)
            clip(ray, begin, end, space.lower, space.upper)
            own = _Count(0)
            walk_voxels(ray, begin, end, space, _count_voxel, own, 0)
            ti.atomic_max(most[0], shared.voxels + own.voxels)


@pytest.mark.parametrize("voxel_size", [0.03, 0.06, 0.1])
@pytest.mark.parametrize("pose", [*POSES, "through corners"])
def test_longest_bounds_the_steps_of_a_ray_and_of_its_group(pose: str, voxel_size: float) -> None:
    """The traces of a sweep have no more room: one step more would be written into the next worker's."""
    T = POSES.get(pose, look_at((0.8, 0.8, 0.8), (3.0, 3.0, 3.0)))
    camera = PinholeCamera(160, 120, 130.0, 131.0, 79.5, 59.5)
    v, u = np.indices(camera.shape)
    image = uploaded(3.0 + np.sin(u / 30) + 0.6 * np.cos(v / 20), camera=camera)
    rays = RayBundler(voxel_size, InferenceConfig()).rays_of(image)
    footprint = find_footprint(image, rays, T, voxel_size, SENSOR, VolumeConfig())
    window = footprint.window
    lower, upper = window.clip_box(None, None)
    chunks, bricks = np.ones(window.cells // CHUNK**3, np.int32), np.zeros(window.cells, np.int32)
    most, groups = np.zeros((2, 1), np.int32)
    space = Space(window.shape_vector, lower, upper, chunks, bricks)
    _count_steps(rays, image.sensor, window.viewpoint(T), space, SENSOR.max_depth, most, groups)
    assert groups[0] > 10
    assert most[0] <= footprint.longest < 2 * most[0] + 50


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("pose", [*POSES, "through corners"])
def test_longest_bounds_the_voxels_on_every_ray(pose: str, bounded: bool) -> None:
    """For the oracle's rays and for the engine's own, which write as many steps into their traces."""
    T = POSES.get(pose, look_at((0.8, 0.8, 0.8), (3.0, 3.0, 3.0)))
    image = uploaded(scene(6))
    volume = VolumeConfig()
    if bounded:
        volume = VolumeConfig(tuple(T[:3, 3] - (9, 0.5, 9)), tuple(T[:3, 3] + (9, 1.3, 0.6)))
    footprint = footprint_of(image, T, volume)
    window = footprint.window
    rays = rays_of(image, T, window, SENSOR.max_depth)
    box_lower, box_upper = window.clip_box(volume.lower, volume.upper)
    expected = 0
    for direction, end in zip(rays.directions, rays.end, strict=True):
        interval = clip_to_box(
            rays.centre, direction, 0.0, end - 0.001, box_lower.to_numpy(), box_upper.to_numpy()
        )
        expected = max(expected, len(segments(rays.centre, direction, *interval)[1]))
    chunks, all_bricks = np.ones(window.cells // CHUNK**3, np.int32), np.zeros(window.cells, np.int32)
    counts = np.zeros(len(rays.end), np.int32)
    _count_voxels(
        np.column_stack([rays.directions, rays.end]).astype(np.float32), ti.Vector(rays.centre, ti.f32),
        Space(window.shape_vector, box_lower, box_upper, chunks, all_bricks), counts,
        8 if runtime.is_software() else 0,
    )  # fmt: skip
    assert counts.max() > 2 * CHUNK
    assert footprint.longest >= max(expected, counts.max())
    assert footprint.longest < 2 * expected + 50


def ray_ends(image: DepthImage, T: Pose, noise_of: dict[Noise, NDArray], max_depth: float) -> NDArray:
    """World points at which the rays end, (n, 3); ``noise_of`` tells each noise's pixels."""
    measured = image.to_numpy().reshape(-1).astype(np.float64)
    end = np.zeros(len(measured))
    for noise, pixels in noise_of.items():
        end[pixels] = noise.depth_of_deviation(measured[pixels], -END_SIGMAS)
    seen = measured > 0
    local = image.camera.rays().reshape(-1, 3)[seen] * np.minimum(end[seen], max_depth)[:, None]
    return local @ T[:3, :3].T + T[:3, 3]


def assert_holds(box: tuple[NDArray, NDArray], points: NDArray[np.float64]) -> None:
    assert (points >= box[0] - 1e-6).all()
    assert (points <= box[1] + 1e-6).all()


@pytest.mark.parametrize("max_depth", [6.0, 2.3])
@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize(
    "noise", [NOISE, Noise((0.3, -0.06)), Noise((0.001,), (-0.3,)), Noise((0.05,), (0.0, 0.2))]
)
def test_the_visible_box_holds_all_ray_ends(noise: Noise, pose: str, max_depth: float) -> None:
    camera = PinholeCamera(width=70, height=45, fx=50, fy=55, cx=30.2, cy=24.4)  # 3 x 2 tiles, two cut off
    random = np.random.default_rng(7)
    depth = random.uniform(0.3, 5, camera.shape) * (random.random(camera.shape) < 0.7)
    image = uploaded(depth, PolynomialNoise(noise.sigma, noise.bias), camera)
    T = POSES[pose]
    box = visible_box(image, T, max_depth, END_SIGMAS)
    assert_holds(
        box, np.concatenate([T[None, :3, 3], ray_ends(image, T, {noise: np.arange(depth.size)}, max_depth)])
    )


@pytest.mark.shared_data
def test_the_visible_box_holds_all_ray_ends_with_a_learnt_table(shared_data: Path) -> None:
    folder = shared_data / "coffin_world"
    sigma, bias = (np.load(folder / f"realsense_{n}_poly5x.npy").astype(float) for n in ("stddev", "bias"))
    camera = PinholeCamera(640, 480, 615, 615, 319.5, 239.5)
    depth = np.load(folder / "clean_depth.npz")["depth_m"][0].astype(np.float64)
    # One pixel in 16 x 16, each in one patch: enough for every tile and every polynomial.
    few = np.zeros(camera.shape)
    few[8::16, 8::16] = np.nan_to_num(depth[8::16, 8::16])
    image = uploaded(few, PatchNoise(sigma, bias, 20, camera), camera)
    T = POSES["oblique"]
    v, u = np.indices(camera.shape).reshape(2, -1) // 20
    pixels = {Noise(tuple(s), tuple(b)): np.flatnonzero(v * 32 + u == i)
              for i, (s, b) in enumerate(zip(sigma, bias, strict=True))}  # fmt: skip
    ends = ray_ends(image, T, pixels, 10.0)
    assert len(ends) > 500
    assert_holds(visible_box(image, T, 10.0, END_SIGMAS), ends)
