"""Pixels without a return: messages against brute force and NumPy, bricks, ranges, what stays as it was."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_room
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from live_scene import marginals
from numpy.typing import NDArray
from one_pixel import (
    ONE_PIXEL,
    VOXEL,
    ExactMap,
    ExactMapWithLengths,
    allocated,
    image,
    look_along,
    random_pose,
)
from one_pixel import marginals as marginals_at
from oracles import inference as reference
from oracles.forward import Noise
from oracles.traversal import segments

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.config.sections import InferenceConfig, TimeConfig
from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.prior import prior_probability
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.points import FREE, OCCUPIED
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.no_return import NoReturnLaw
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.types import F32Array

pytestmark = pytest.mark.usefixtures("backend")

ONE_BACKEND = pytest.mark.usefixtures("one_backend")

MODEL = SensorConfig(
    sigma=(0.3,), max_depth=0.7,
    no_return="model", no_return_share=0.2, no_return_depth=0.6, no_return_width=0.2,
)  # fmt: skip
FLOOR = 1e-9
"""For measurements. Missing returns have none."""


seeds = st.integers(0, 2**32 - 1)


def law_of(sensor: SensorConfig) -> NoReturnLaw:
    law = NoReturnLaw.of(sensor)
    assert law is not None
    return law


def unreturned(T: Pose, camera: PinholeCamera, law: NoReturnLaw) -> list[reference.Ray]:
    """The rays of all pixels of a camera, none of which got a return."""
    rays = []
    for direction in camera.rays().reshape(-1, 3) @ T[:3, :3].T:
        cells, near, far = segments(T[:3, 3], direction, law.begin_m, law.reach_m, VOXEL)
        lengths = (far - near) * np.linalg.norm(direction) / VOXEL
        parts = [
            reference.Segment((int(i), int(j), int(k)), length)
            for (i, j, k), length in zip(cells, lengths.tolist(), strict=True)
        ]
        rays.append(reference.Ray(parts, law.chance(0.5 * (near + far)).tolist(), 1.0))
    return rays


def in_bricks(ray: reference.Ray, voxels: set[reference.Voxel]) -> reference.Ray:
    """Rays pass places without a brick."""
    kept = [i for i, s in enumerate(ray.segments) if s.voxel in voxels]
    return reference.Ray([ray.segments[i] for i in kept], [ray.densities[i] for i in kept], ray.beyond)


@settings(max_examples=12, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    seed=seeds, depth=st.floats(0.3, 0.6), prior=st.floats(0.05, 0.6),
    sensor=st.sampled_from([MODEL, replace(MODEL, no_return="free", no_return_depth=0.5)]),
)  # fmt: skip
def test_a_measured_and_a_missing_return_equal_enumeration(
    seed: int, depth: float, prior: float, sensor: SensorConfig
) -> None:
    """Two rays with one voxel in common: the graph is a tree."""
    rng = np.random.default_rng(seed)
    shared = (rng.integers(-20, 20, 3) + rng.uniform(0.2, 0.8, 3)) * VOXEL
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    poses = [look_along(shared - d * rng.uniform(0.2, 0.3), d, rng) for d in directions]
    sensor = replace(sensor, max_depth=0.5)
    inference = InferenceConfig(prior=prior, outlier_floor=FLOOR, sweeps=5, free_share=0.0)
    (measured,) = reference.cast(
        image(depth), poses[0], ONE_PIXEL, VOXEL, Noise(sensor.sigma), sensor.max_depth
    )
    (missing,) = unreturned(poses[1], ONE_PIXEL, law_of(sensor))
    m = ExactMap.from_config(Config(voxel_size=VOXEL, sensor=sensor, inference=inference), ONE_PIXEL)
    m.add_keyframe(image(depth), poses[0], ONE_PIXEL)
    m.add_keyframe(image(0.0), poses[1], ONE_PIXEL, no_return=np.ones((1, 1), bool))
    voxels = allocated(m)
    rays = [in_bricks(ray, voxels) for ray in (measured, missing)]
    assume(len({s.voxel for s in rays[0].segments} & {s.voxel for s in rays[1].segments}) == 1)
    assume(all(s.length > 0.02 for ray in (measured, missing) for s in ray.segments))
    m.infer()
    exact = reference.enumerate_marginals(rays, prior, FLOOR)
    tolerance = 1e-4 if sensor.no_return == "model" else 2e-3  # chances of 0 are bounded by the clamp
    np.testing.assert_allclose(marginals_at(m, list(exact)), list(exact.values()), atol=tolerance)


@settings(max_examples=10)
@given(seed=seeds, lengths=st.booleans(), sweeps=st.integers(1, 3))
def test_both_kinds_of_rays_of_a_keyframe_equal_the_numpy_schedule(
    seed: int, lengths: bool, sweeps: int
) -> None:
    rng = np.random.default_rng(seed)
    camera, T = PinholeCamera(2, 2, 4.0, 4.0, 0.5, 0.5), random_pose(rng)
    depth = rng.uniform(0.3, 0.6, (2, 2)).astype(np.float32)
    missing = np.array([[True, False], [False, True]])
    depth[missing] = 0.0
    made_by = ExactMapWithLengths if lengths else ExactMap
    inference = InferenceConfig(sweeps=sweeps, outlier_floor=FLOOR, free_share=0.0)
    m = made_by.from_config(Config(voxel_size=VOXEL, sensor=MODEL, inference=inference), camera)
    m.add_keyframe(depth, T, camera, no_return=missing)
    rays = reference.cast(depth, T, camera, VOXEL, Noise(MODEL.sigma), MODEL.max_depth)
    without = unreturned(T, camera, law_of(MODEL))
    # What measured rays of the keyframe cross is not told by missing ones.
    crossed = {s.voxel for ray in rays for s in ray.segments}
    told = frozenset(s.voxel for ray in without for s in ray.segments) - crossed
    rays += [replace(without[i], told=told) for i in np.flatnonzero(missing)]
    assume(all(s.length > 0.01 for ray in rays for s in ray.segments))
    voxels = allocated(m)
    m.infer()
    prior = prior_probability(inference, VOXEL)
    expected = reference.infer([rays], voxels, prior, inference, made_by.LIMITS)
    seen = sorted({s.voxel for ray in rays for s in ray.segments} & voxels)
    assume(len(told & set(seen)) > 0)
    np.testing.assert_allclose(
        marginals_at(m, seen), [reference.logistic(expected[v]) for v in seen], atol=1e-3
    )


@kernel
def _chances(sensor: Sensor, depths: F32Array, out: F32Array) -> None:
    for i in depths:
        noise = sensor.noise_at(0, 0)
        out[i] = sensor.likelihood(0.0, depths[i] - 0.01, depths[i] + 0.01, noise, 0.1, 0)


@ONE_BACKEND
def test_the_law() -> None:
    law = law_of(MODEL)
    depths = np.linspace(0.01, 5.0, 50).astype(np.float32)
    out = np.zeros_like(depths)
    _chances(law.table(ONE_PIXEL).sensor(ONE_PIXEL), depths, out)
    np.testing.assert_allclose(out, law.chance(depths), rtol=1e-5)
    assert law.chance(0.6) == pytest.approx(0.2 + 0.8 * 0.5)
    assert law.chance(50.0) == pytest.approx(1.0)
    assert law.chance(law.reach_m) == pytest.approx(0.5)
    free = law_of(replace(MODEL, no_return="free", no_return_depth=0.4))
    assert free.reach_m == 0.4
    assert free.chance(0.4) < 1e-30
    assert NoReturnLaw.of(replace(MODEL, no_return="ignore")) is None
    assert NoReturnLaw.of(replace(MODEL, min_depth=0.65)) is None  # counts nowhere
    for wrong in ({"no_return_share": 0.5}, {"no_return_depth": 0.0}, {"no_return_width": -1.0}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            SensorConfig(**wrong)  # type: ignore[arg-type]


ROOM = SensorConfig(no_return="model", no_return_share=0.1, no_return_depth=6.0, no_return_width=1.0)


def in_room(sensor: SensorConfig = ROOM) -> MRFMap:
    camera = small_room.frames()[0].camera
    return MRFMap.from_config(Config(voxel_size=small_room.VOXEL_SIZE, sensor=sensor), camera)


def with_hole(number: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A frame's depth without the pixels of a box, which got no return."""
    depth = small_room.frames()[number].depth_m.copy()
    missing = np.zeros(depth.shape, bool)
    missing[10:110, 15:145] = True
    depth[missing] = 0.0
    return depth, missing


def add(m: MRFMap, number: int, state: bool = True) -> int:
    frame, (depth, missing) = small_room.frames()[number], with_hole(number)
    parts = (depth, frame.T_world_camera, frame.camera, frame.name)
    return m.add_keyframe(*parts, no_return=missing if state else None)


@ONE_BACKEND
def test_by_default_they_are_ignored_bit_for_bit() -> None:
    told, plain = in_room(SensorConfig()), in_room(SensorConfig())
    add(told, 0)
    add(plain, 0, state=False)
    for m in (told, plain):
        m.infer()
    assert marginals(told) == marginals(plain)
    assert told.keyframes[0].own.no_return is None
    other = in_room()
    add(other, 0, state=False)
    other.infer()
    assert marginals(other) == marginals(plain)
    log_odds = LogOddsMap(0.2)
    frame, (depth, missing) = small_room.frames()[0], with_hole(0)
    log_odds.add_keyframe(depth, frame.T_world_camera, frame.camera, no_return=missing)


@ONE_BACKEND
def test_rays_cross_bricks_and_create_none_and_nothing_is_free_below_the_minimum_range() -> None:
    sensor = replace(ROOM, min_depth=0.5)
    m, plain = in_room(sensor), in_room(sensor)
    add(m, 0)
    add(plain, 0, state=False)
    frame, (_, missing) = small_room.frames()[0], with_hole(0)
    assert set(map(tuple, m.view.pool.bricks[m.view.pool.in_use].tolist())) == set(
        map(tuple, plain.view.pool.bricks[plain.view.pool.in_use].tolist())
    )
    for each in (m, plain):
        each.infer()
    rays = frame.camera.rays()[55:65:2, 75:85:2].reshape(-1, 3)
    rays = rays @ frame.T_world_camera[:3, :3].T
    eye = frame.T_world_camera[:3, 3]
    assert missing[55:65, 75:85].all()
    inside = eye + 1.8 * rays
    assert (m.state(inside) == FREE).all()
    assert not (plain.state(inside) == FREE).any()
    alone, nothing = in_room(replace(sensor, min_depth=2.0)), np.zeros(frame.camera.shape, np.float32)
    parts = (nothing, frame.T_world_camera, frame.camera)
    k = alone.add_keyframe(*parts, no_return=np.ones(frame.camera.shape, bool))
    centres = (alone.crossed_bricks(k) + 0.5) * 8 * small_room.VOXEL_SIZE
    assert len(centres) > 10
    radius_m = np.sqrt(3) * 4 * small_room.VOXEL_SIZE
    assert np.linalg.norm(centres - eye, axis=1).min() > 2.0 - radius_m
    assert len(alone.view.pool.in_use) == 0


@ONE_BACKEND
def test_surfaces_that_others_measured_stay() -> None:
    """A keyframe sees a wall and another one, from the same place, gets no return from a part of it."""
    plain, m = in_room(), in_room()
    small_room.add(plain, small_room.frames()[0])
    small_room.add(m, small_room.frames()[0])
    add(m, 0)
    for each in (plain, m):
        each.infer()
    wall, _ = plain.marginals.voxels(0.8)
    assert len(wall) > 200
    assert (m.state(wall) == OCCUPIED).mean() > 0.99


@ONE_BACKEND
def test_edits_in_any_order_and_files_keep_it_bit_for_bit(tmp_path: Path) -> None:
    m = in_room()
    extra = add(m, 3)
    ids = {number: add(m, number) for number in (1, 0)}
    m.infer(sweeps=1)
    m.move_keyframe(ids[0], small_room.frames()[4].T_world_camera)
    m.remove_keyframe(extra)
    m.renew()
    m.move_keyframe(ids[0], small_room.frames()[0].T_world_camera)
    m.remove_keyframe(ids[1])
    add(m, 1)
    m.infer()
    straight = in_room()
    for number in (0, 1):
        add(straight, number)
    straight.infer()
    assert marginals(m) == marginals(straight)
    m.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    assert loaded.config.sensor == ROOM
    loaded.infer()
    assert marginals(loaded) == marginals(straight)
    plain = in_room()
    for number in (0, 1):
        add(plain, number, state=False)
    plain.infer()
    assert marginals(plain) != marginals(straight)
    straight.freeze_keyframe(0)
    straight.infer()


@ONE_BACKEND
def test_dated_maps_take_them() -> None:
    camera = small_room.frames()[0].camera
    config = Config(voxel_size=small_room.VOXEL_SIZE, sensor=ROOM, time=TimeConfig(half_life_s=100.0))
    m = MRFMap.from_config(config, camera)
    add(m, 0)
    add(m, 1)
    m.infer()
    assert m.settled


@ONE_BACKEND
def test_a_wrong_image_is_refused_and_a_return_counts_as_one() -> None:
    m, frame = in_room(), small_room.frames()[0]
    parts = (frame.depth_m, frame.T_world_camera, frame.camera)
    with pytest.raises(
        KeyframeError, match=r"no_return must be bool or float32 of the shape \(90, 120\), not float64"
    ):
        m.add_keyframe(*parts, no_return=np.zeros(frame.camera.shape))
    with pytest.raises(KeyframeError, match=r"not bool \(3,\)"):
        m.add_keyframe(*parts, no_return=np.zeros(3, bool))
    depth = np.full(frame.camera.shape, 0.01, np.float32)  # nearer than the minimum range
    depth[:5] = np.inf
    k = m.add_keyframe(depth, *parts[1:], no_return=np.ones(depth.shape, bool))
    kept = m.keyframes[k].own.no_return
    assert kept is not None
    assert kept[:5].all()
    assert not kept[5:].any()
