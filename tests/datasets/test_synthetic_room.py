"""The synthetic room: its pictures agree with its geometry, that with plain formulas; with a pattern, and
with things that move."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from refusals import refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.synthetic.analytic_scene import KINDS, Scene, Solid, distance_to
from taichi_mrf.datasets.synthetic.rendered_sequence import CONTRAST, CUBES_M, pattern
from taichi_mrf.datasets.synthetic.room import (
    PERIOD_S,
    SCRIPTS,
    Place,
    Stay,
    SyntheticRoom,
    Thing,
    distance_to_solids,
    moving_room,
    placed,
    way,
)
from taichi_mrf.datasets.synthetic.room_furniture import (
    HEIGHT,
    LENGTH,
    ROOM_IN_WORLD,
    WIDTH,
    camera_pose,
    room_scene,
)
from taichi_mrf.errors import BackendError
from taichi_mrf.geometry.poses import as_pose, look_at, tangent_norms
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.system import runtime

SMALL = "synthetic:room?width=160&height=120&frames=60"
CAMERA = PinholeCamera(width=160, height=120, fx=131.25, fy=131.25, cx=79.5, cy=59.5)

number = st.floats(-2, 2)
size = st.floats(0.05, 1)
solids = st.builds(
    Solid,
    kind=st.sampled_from(KINDS),
    center=st.tuples(number, number, number),
    half_size=st.tuples(size, size, size),
    yaw=st.floats(-4, 4),
)


def world_rays(camera: PinholeCamera, T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions in the world, (H * W, 3), one metre of axial depth long."""
    return camera.rays().reshape(-1, 3) @ T[:3, :3].T


def sphere_traced(scene: Scene, eye: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ray parameters of the first surface: steps of the signed distance, which can pass no surface."""
    t = np.zeros(len(rays))
    length = np.linalg.norm(rays, axis=1)
    moving = np.arange(len(rays))
    for _ in range(400):
        distance = scene.signed_distance(eye + t[moving, None] * rays[moving])
        t[moving] += distance / length[moving]
        moving = moving[(distance > 1e-9) & (t[moving] < 20)]
    return t


def samples_on(solid: Solid, count: int) -> NDArray[np.float64]:
    """Points spread over a solid's surface, world frame, (N, 3)."""
    random = np.random.default_rng(0)
    a, b, c = solid.half_size
    if solid.kind == "sphere":
        directions = random.normal(size=(count, 3))
        return solid.center + a * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    if solid.kind == "cylinder":
        angle = random.uniform(0, 2 * np.pi, count)
        radius = np.where(np.arange(count) % 2 == 0, a, a * np.sqrt(random.uniform(0, 1, count)))
        z = np.where(
            np.arange(count) % 2 == 0, random.uniform(-c, c, count), c * random.choice([-1, 1], count)
        )
        return solid.center + np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    local = random.uniform(-1, 1, (count, 3))
    axis = random.integers(0, 3, count)
    local[np.arange(count), axis] = random.choice([-1.0, 1.0], count)
    local *= (a, b, c)
    cos, sin = np.cos(solid.yaw), np.sin(solid.yaw)
    return solid.center + local @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]).T


@given(solids)
def test_distance_is_zero_on_the_surface(solid: Solid) -> None:
    np.testing.assert_allclose(distance_to(solid, samples_on(solid, 200)), 0, atol=1e-9)


@given(solids, st.lists(st.tuples(number, number, number), min_size=1, max_size=5))
def test_distance_is_that_to_the_nearest_surface_point(solid: Solid, points: list[tuple]) -> None:
    surface = samples_on(solid, 20000)
    for point, signed in zip(points, distance_to(solid, np.array(points)), strict=True):
        nearest = np.linalg.norm(surface - point, axis=1).min()
        assert abs(signed) <= nearest + 1e-9  # no sample can be nearer than the surface
        assert nearest - abs(signed) < 0.12  # the samples lie this dense on the largest solid


@given(solids)
def test_the_sign_tells_inside_from_outside(solid: Solid) -> None:
    surface = samples_on(solid, 100)
    inwards = np.asarray(solid.center) - surface
    assert (distance_to(solid, surface + 0.1 * inwards) < 0).all()
    assert (distance_to(solid, surface - 0.1 * inwards) > 0).all()


@pytest.mark.parametrize("seed", range(6))
def test_pictures_of_random_scenes_agree_with_sphere_tracing(backend: str, seed: int) -> None:
    from taichi_mrf.datasets.synthetic.analytic_render import render

    random = np.random.default_rng(seed)
    scene = Scene(
        tuple(
            Solid(
                KINDS[i % 3],
                tuple(random.uniform(-1.5, 1.5, 3)),
                tuple(random.uniform(0.05, 0.5, 3)),
                random.uniform(-4, 4),
            )
            for i in range(12)
        ),
        light=(0, 0, 3),
    )
    eye = np.array([4.0 * np.cos(seed), 4.0 * np.sin(seed), random.uniform(-2, 2)])
    T = look_at(eye, (0, 0, 0))
    depth, _ = render(scene, CAMERA, T, color=False)
    rays = world_rays(CAMERA, T)
    expected = sphere_traced(scene, eye, rays)
    hit = np.abs(scene.signed_distance(eye + expected[:, None] * rays)) < 1e-6
    rendered = depth.ravel()
    # A ray that just touches an edge may count as either; no others.
    assert ((rendered > 0) != hit).sum() <= 2
    both = hit & (rendered > 0)
    assert both.sum() > 500
    off = np.abs(rendered - expected)[both]
    assert (off > 1e-4).sum() <= 2
    assert np.median(off) < 1e-6


def test_any_camera_sees_the_same_scene(backend: str) -> None:
    from taichi_mrf.datasets.synthetic.analytic_render import ray_depths, render

    scene = room_scene()
    T = look_at((0.1, -0.2, 1.4), (1.0, 0.5, 1.2))
    depth, _ = render(scene, CAMERA, T, color=False)
    off = np.abs(ray_depths(scene, CAMERA, T) - depth)
    assert (off > 1e-4).sum() <= 2  # at edges rounding decides
    lidar = SphericalCamera(np.radians([20.0, 0.0, -25.0]), np.radians(np.arange(0.0, 360.0, 6.0)))
    rays = lidar.rays().reshape(-1, 3) @ T[:3, :3].T
    off = np.abs(ray_depths(scene, lidar, T).ravel() - sphere_traced(scene, T[:3, 3], rays))
    assert (off > 1e-4).sum() <= 1


@pytest.mark.parametrize("index", range(0, 60, 7))
def test_clean_depth_lies_on_the_surface_and_before_all_others(backend: str, index: int) -> None:
    room = open_dataset(SMALL)
    T, depth = room.pose(index), room.clean_depth(index).astype(np.float64).ravel()
    rays = world_rays(room.camera, T)
    assert (depth > 0).all()  # the room is closed
    assert np.abs(room.signed_distance(T[:3, 3] + depth[:, None] * rays)).max() < 1e-4
    for share in (0.1, 0.3, 0.5, 0.7, 0.9, 0.97):
        assert room.signed_distance(T[:3, 3] + (share * depth)[:, None] * rays).min() > -1e-4


def test_the_room_is_a_furnished_room_around_the_origin() -> None:
    scene = room_scene()
    x, y, z = ROOM_IN_WORLD
    random = np.random.default_rng(0)
    points = random.uniform((-LENGTH / 2, -WIDTH / 2, 0), (LENGTH / 2, WIDTH / 2, HEIGHT), (20000, 3))
    solid = scene.signed_distance(points + ROOM_IN_WORLD) < 0
    assert 0.02 < solid.mean() < 0.2
    assert scene.signed_distance([(0, 0, 0)])[0] > 0
    assert x - LENGTH / 2 < 0 < x + LENGTH / 2
    assert y - WIDTH / 2 < 0 < y + WIDTH / 2
    assert z < 0 < z + HEIGHT
    assert {solid.kind for solid in scene.solids} == set(KINDS)


def test_the_camera_keeps_clear_moves_smoothly_and_closes_its_loop() -> None:
    scene = room_scene()
    count = 240
    poses = [camera_pose(i / count) for i in range(count)]
    eyes = np.array([T[:3, 3] for T in poses])
    assert scene.signed_distance(eyes).min() > 0.4  # the least depth of a Kinect
    steps = [tangent_norms(a, b) for a, b in zip(poses, poses[1:] + poses[:1], strict=True)]
    rotation, translation = np.array(steps).T
    assert rotation.max() < 4 * 2 * np.pi / count
    assert translation.max() < 2 * translation.mean()
    for T in poses:
        np.testing.assert_allclose(as_pose(T), T, atol=1e-12)
        assert T[2, 1] < 0  # the image's down is the world's down


def test_all_walls_and_most_of_the_room_are_seen(backend: str) -> None:
    room = open_dataset("synthetic:room?width=80&height=60&frames=30&noise=none")
    points = []
    for i in range(len(room)):
        T, depth = room.pose(i), room.clean_depth(i).astype(np.float64).reshape(-1, 1)
        points.append(T[:3, 3] + depth * world_rays(room.camera, T) - ROOM_IN_WORLD)
    cloud = np.concatenate(points)
    np.testing.assert_allclose(cloud.min(axis=0), (-LENGTH / 2, -WIDTH / 2, 0), atol=1e-3)
    np.testing.assert_allclose(cloud.max(axis=0), (LENGTH / 2, WIDTH / 2, HEIGHT), atol=1e-3)


def test_frames_are_deterministic_whatever_the_order(backend: str) -> None:
    once = {i: open_dataset(SMALL).read(i) for i in (2, 5)}
    room = open_dataset(SMALL)
    for i in (5, 2):
        again = room.read(i)
        np.testing.assert_array_equal(again.depth_m, once[i].depth_m)
        np.testing.assert_array_equal(again.color, once[i].color)
    assert (open_dataset(SMALL + "&seed=1").read(2).depth_m != once[2].depth_m).any()


def test_noise_is_that_of_a_kinect(backend: str) -> None:
    room = open_dataset("synthetic:room?width=640&height=480&frames=60")
    clean, noisy = room.clean_depth(50).astype(np.float64), room.read(50).depth_m.astype(np.float64)
    seen = noisy > 0
    assert 0.8 < seen.mean() < 0.999
    sigma = 0.001504 - 0.00152 * clean + 0.0019 * clean**2
    step = 0.00285 * clean**2
    expected = np.sqrt(sigma**2 + step**2 / 12)  # rounding to steps adds a twelfth of their square
    normalised = ((noisy - clean) / expected)[seen]
    assert abs(normalised.mean()) < 0.02
    assert normalised.std() == pytest.approx(1, abs=0.05)


def test_without_noise_a_frame_holds_the_clean_depth(backend: str) -> None:
    room = open_dataset(SMALL + "&noise=none")
    frame = room.read(3)
    np.testing.assert_array_equal(frame.depth_m, room.clean_depth(3))
    np.testing.assert_array_equal(frame.T_world_camera, room.pose(3))
    assert frame.camera == room.camera == CAMERA
    assert frame.name == room.frame_names[3]
    assert frame.color.shape == (120, 160, 3)
    assert len(np.unique(frame.color.reshape(-1, 3), axis=0)) > 500
    assert open_dataset(SMALL, color=False).read(3).color is None


def test_options_and_defaults() -> None:
    room = open_dataset("synthetic:room")
    assert len(room) == len(room.frame_names) == 32
    assert room.moving_scene is None
    assert room.scene_at(3) is room.scene
    assert room.stamp_at(5) == 1.0
    assert room.camera == PinholeCamera(320, 240, 262.5, 262.5, 159.5, 119.5)
    assert len(open_dataset("synthetic:room?frames=7&seed=3&noise=none")) == 7
    assert open_dataset("synthetic:room", camera=CAMERA).camera == CAMERA
    with pytest.raises(IndexError):
        room.read(32)
    with pytest.raises(IndexError):
        room.read(-1)


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("room?frame=3", "unknown parameter 'frame'; did you mean 'frames'?"),
        ("room?frames=many", "frames must be of type int"),
        ("room?frames=", "frames must be of type int"),
        ("room?frames=0", "frames must be at least 1"),
        ("room?frames=1000000000000", "frames must be at most 1000000, not 1000000000000"),
        ("corridor?width=1000000", "width must be at most 10000, not 1000000"),
        ("room?width=-640", "width must be at least"),
        ("room?noise=some", "noise must be one of kinect, none"),
        ("room?frames", "name=value"),
        ("room?frames=[", "name=value"),
        ("room?moving=cat", "moving must be one of none, things, door, walker"),
        ("corridor?room=3", "did you mean 'rooms'?"),
        ("corridor?rooms=0", "rooms must be at least 1"),
        ("corridor?frames=0", "frames"),
        ("ring?length=20", "length must be at least 24"),
        ("ring?wall=bare", "walls"),
        ("ring?walls=no", "no"),
    ],
)
def test_wrong_options_are_named(source: str, problem: str) -> None:
    source = f"synthetic:{source}"
    assert refused(source, problem).startswith(source.partition("?")[0])


@pytest.mark.parametrize("name", ["room", "corridor", "ring"])
def test_a_depth_scale_has_no_meaning_here(name: str) -> None:
    refused(f"synthetic:{name}", "depth_scale", depth_scale=5000.0)


def test_rendering_before_taichi_runs_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "active", lambda: None)
    with pytest.raises(BackendError, match=r"call taichi_mrf\.init\(\) first"):
        open_dataset(SMALL).read(0)


MOTTLED_SIZE = "synthetic:room?width=80&height=60&frames=60"


def test_a_pattern_is_continuous_and_neither_brightens_nor_darkens() -> None:
    points_m = np.random.default_rng(1).uniform(-5, 5, (20_000, 3))
    fine = np.full(len(points_m), 1e-3)
    factor = pattern(points_m, fine)
    assert abs(factor.mean() - 1) < 0.01
    assert factor.std() > 0.1
    assert factor.max() <= (1 + CONTRAST) ** 3
    assert factor.min() >= (1 - CONTRAST) ** 3
    step = np.array([1e-4, -1e-4, 1e-4])
    # The slope of smoothed interpolation is at most 1.5 for each cube's side and axis.
    steepest = factor.max() * 3 * 2 * CONTRAST * 1.5 / (1 - CONTRAST) / min(CUBES_M)
    assert np.abs(pattern(points_m + step, fine) - factor).max() < steepest * 1e-4
    # Wide pixels see plain paint.
    np.testing.assert_array_equal(pattern(points_m, np.full(len(points_m), 0.5)), 1.0)


@pytest.mark.usefixtures("one_backend")
def test_a_mottled_room_has_the_same_depth_and_the_pattern_of_its_points() -> None:
    plain, mottled = open_dataset(MOTTLED_SIZE), open_dataset(f"{MOTTLED_SIZE}&texture=mottled")
    assert isinstance(mottled, SyntheticRoom)
    a, b = plain.read(7), mottled.read(7)
    np.testing.assert_array_equal(a.depth_m, b.depth_m)
    assert a.color is not None
    assert b.color is not None
    depth_m = mottled.clean_depth(7).astype(np.float64)
    points = mottled.camera.rays() * depth_m[..., None]
    T = mottled.pose(7)
    expected = a.color * pattern(points @ T[:3, :3].T + T[:3, 3], depth_m / mottled.camera.fx)[..., None]
    assert np.abs(b.color - np.clip(expected, 0, 255)).max() <= 1.0
    assert (a.color != b.color).any(axis=-1).mean() > 0.8


VARIANTS = range(4)
coordinate = st.floats(-2, 2)
HERE, THERE = Place(1.0, 2.0), Place(3.0, 2.0, 0.5, math.pi)


def inside(solids: tuple[Solid, ...]) -> NDArray[np.float64]:
    """Points spread in some solids, at least 2 cm or half their thickness deep."""
    random = np.random.default_rng(0)
    points = []
    for solid in solids:
        half = np.maximum(np.array(solid.half_size) - 0.02, 0.5 * np.array(solid.half_size))
        if solid.kind != "box":
            half[:2] *= math.sqrt(0.5)  # the square within the circle
        if solid.kind == "sphere":
            half *= 0.8
        local = random.uniform(-1, 1, (150, 3)) * half
        c, s = math.cos(solid.yaw), math.sin(solid.yaw)
        points.append(solid.center + local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
    return np.concatenate(points)


@given(
    coordinate,
    coordinate,
    coordinate,
    st.floats(-4, 4),
    st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1),
)
def test_a_placed_solid_is_the_same_solid_elsewhere(
    x: float, y: float, z: float, yaw: float, points: list[tuple[float, float, float]]
) -> None:
    solid = Solid("box", (0.3, -0.2, 0.5), (0.4, 0.2, 0.1), 0.7)
    c, s = math.cos(yaw), math.sin(yaw)
    moved = np.array(points) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (x, y, z)
    there = distance_to_solids(placed([solid], Place(x, y, z, yaw)), moved)
    np.testing.assert_allclose(there, distance_to(solid, np.array(points)), atol=1e-9)


def test_a_thing_is_where_its_stays_say() -> None:
    ball = Solid("sphere", (0, 0, 1), (0.1, 0.1, 0.1))
    thing = Thing("ball", (ball,), (Stay(2.0, 8.0, HERE, HERE), Stay(10.0, 12.0, HERE, THERE)))
    assert [bool(thing.solids_at(t)) for t in (0.0, 2.0, 7.9, 8.0, 9.9, 10.0, 12.0)] == [
        False, True, True, False, False, True, False,
    ]  # fmt: skip
    (halfway,) = thing.solids_at(11.0)
    np.testing.assert_allclose(halfway.center, (2.0, 2.0, 1.25))
    assert halfway.yaw == pytest.approx(math.pi / 2)
    assert [stay.stands for stay in thing.stays] == [True, False]
    assert not thing.walks
    (moved,) = thing.moved_by((1.0, 0.0, -1.0)).solids_at(2.0)
    np.testing.assert_allclose(moved.center, (2.0, 2.0, 0.0))


def test_a_way_takes_as_long_as_its_length() -> None:
    first, second = way(3.0, 0.5, [(0, 0), (2, 0), (2, 1)])
    assert (first.start_s, first.end_s, second.end_s) == (3.0, 7.0, 9.0)
    assert first.place(5.0) == Place(1.0, 0.0)
    assert second.begin.yaw == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("script", SCRIPTS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_camera_keeps_clear(script: str, variant: int) -> None:
    scene = moving_room(script, variant)
    for stamp in np.arange(0, 2 * PERIOD_S, 1.0):
        eye = scene.camera.pose(stamp)[:3, 3]
        assert scene.at(stamp).signed_distance(eye)[0] > 0.4, stamp  # the least depth of a Kinect


@pytest.mark.parametrize("script", SCRIPTS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_things_pass_through_nothing(script: str, variant: int) -> None:
    scene = moving_room(script, variant)
    for stamp in np.arange(0, PERIOD_S, 1.7):
        for thing in scene.things:
            solids = thing.solids_at(stamp)
            if not solids:
                continue
            within = inside(solids)
            assert distance_to_solids(solids, within).max() < -0.005
            assert scene.static.signed_distance(within).min() > 0, (stamp, thing.name)
            others = [s for other in scene.things if other is not thing for s in other.solids_at(stamp)]
            assert distance_to_solids(others, within).min() > 0, (stamp, thing.name)


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_repeats_itself_and_another_variant_is_another_scene(script: str) -> None:
    scene, other = moving_room(script), moving_room(script, 1)
    stamps = np.arange(0.5, PERIOD_S, 1.0)
    assert all(scene.at(t) == scene.at(t + PERIOD_S) for t in stamps)
    assert any(scene.at(t) != other.at(t) for t in stamps)
    assert len({scene.at(t).solids for t in stamps}) > 1


def test_the_door_opens_onto_a_room_and_closes() -> None:
    scene = moving_room("door")
    (door,) = scene.things
    middle = placed(door.solids[:1], door.stays[0].begin)[0].center
    behind = (middle[0], middle[1] - 0.8, middle[2])
    shut, wide, again = (scene.at(t).signed_distance([middle, behind]) for t in (5.0, 30.0, 55.0))
    assert shut[0] < 0 < wide[0] - 0.3
    assert again[0] == shut[0]
    assert min(shut[1], wide[1], again[1]) > 0.3


def test_frames_show_what_is_there_at_their_time(one_backend: str) -> None:
    room = open_dataset("synthetic:room?moving=things&frames=40&width=80&height=60&noise=none", color=False)
    scene = room.moving_scene
    ball = scene.things[0]
    shown = []
    for index in (15, 25):
        frame = room.read(index)
        assert frame.stamp == index
        np.testing.assert_array_equal(frame.T_world_camera, scene.camera.pose(index))
        np.testing.assert_array_equal(frame.depth_m, room.clean_depth(index))
        points = room.camera.rays() * frame.depth_m[..., None].astype(np.float64)
        points = points.reshape(-1, 3) @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]
        assert np.abs(scene.at(index).signed_distance(points)).max() < 1e-4
        shown.append((np.abs(distance_to_solids(ball.solids_at(25), points)) < 1e-4).sum())
    assert shown[0] == 0
    assert shown[1] > 50
