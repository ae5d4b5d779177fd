"""Rays that are not followed all the way, or not in the first sweep: which, and what comes of it."""

from itertools import permutations
from typing import Literal

import numpy as np
import pytest
import small_room
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from one_pixel import VOXEL, allocated, look_along, marginals
from oracles import inference as reference
from oracles.forward import Noise

from taichi_mrf.config.inference import InferenceConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.inference.keyframe import RayList
from taichi_mrf.inference.prior import prior_probability
from taichi_mrf.inference.ray_list import BITS, RayLattice
from taichi_mrf.inference.schedule import content_key
from taichi_mrf.inference.sweep import CLEAR_VOXELS
from taichi_mrf.kernels.bundles import kernel
from taichi_mrf.kernels.types import I32, I32Array
from taichi_mrf.methods.mrf import keyframe_allocator
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.system.compiler import ti

pytestmark = pytest.mark.usefixtures("backend")


@kernel
def find_held(rays: RayList, lattice: RayLattice, width: I32, held: I32Array) -> None:
    for i in range(rays.number):
        held[i] = lattice.holds(rays, i, width)


@pytest.mark.parametrize("stride", [1, 2, 3, 4, 9, 16])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_lattice_has_one_in_so_many_rays_of_each_row_and_column(stride: int, level: int) -> None:
    columns, rows = 48, 32
    wide, high = 2 ** ((level + 1) // 2), 2 ** (level // 2)
    u, v = np.meshgrid(np.arange(columns) * wide, np.arange(rows) * high)
    width = columns * wide
    blocks, depth = ti.ndarray(ti.i32, columns * rows), ti.ndarray(ti.f32, columns * rows)
    blocks.from_numpy((((v * width + u) << BITS) + level).reshape(-1).astype(np.int32))
    held = ti.ndarray(ti.i32, columns * rows)
    find_held(RayList(blocks, depth, columns * rows, wide), RayLattice.of(stride), width, held)
    image = held.to_numpy().reshape(rows, columns)
    for first in range(0, columns, stride):
        whole = image[:, first : first + stride]
        if whole.shape[1] == stride:
            assert (whole.sum(axis=1) == 1).all()
    # No two rows in a root of the stride have the same rays.
    for shift in range(1, int(np.sqrt(stride))):
        assert not (image[:-shift] & image[shift:]).any()


@settings(max_examples=20, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 2),
    sigma=st.floats(0.01, 0.05),
    sample=st.sampled_from([1, 2, 4]),
    scouts=st.sampled_from([1, 2, 4, 9]),
    compiled=st.sampled_from(
        [
            ("sum-product", "replay", True),
            ("sum-product", "retrace", False),
            ("max-product", "replay", True),
        ]
    ),
    sweeps=st.integers(1, 3),
)
def test_strides_equal_the_numpy_schedule(
    seed: int,
    count: int,
    sigma: float,
    sample: int,
    scouts: int,
    compiled: tuple[Literal["sum-product", "max-product"], Literal["replay", "retrace"], bool],
    sweeps: int,
) -> None:
    method, return_pass, lengths = compiled
    rng = np.random.default_rng(seed)
    camera = PinholeCamera(3, 2, 8.0, 8.0, 1.0, 0.5)
    config = InferenceConfig(
        method=method, return_pass=return_pass, segment_lengths=lengths, sweeps=sweeps,
        first_sweep_stride=sample, free_space_stride=scouts,
        message_precision="float32", min_length=0.0, outlier_floor=1e-3,
    )  # fmt: skip
    sensor = Noise((sigma,), (0.0,))
    m = MRFMap(VOXEL, PolynomialNoise((sigma,)), inference=config, max_depth=1.5)
    rays = {}
    middle = rng.uniform(-1, 1, 3)
    for _ in range(count):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        T = look_along(middle - 0.7 * direction, direction, rng)
        depth = rng.uniform(0.6, 0.9, camera.shape).astype(np.float32)
        with pytest.MonkeyPatch.context() as patch:
            # Rays of so small an image are no neighbours: each may cross bricks that no other one does.
            patch.setattr(keyframe_allocator, "SCOUTS", 1)
            id = m.add_keyframe(depth, T, camera)
        rays[id] = reference.cast(depth, T, camera, VOXEL, sensor, config, 1.5, CLEAR_VOXELS)
    assert m.keyframes[id].ray_list.number == camera.width * camera.height
    every = [each for cast in rays.values() for ray in cast for each in (ray, ray.thinned) if each]
    # float32 may take the other way round a corner.
    assume(all(s.length > 0.01 for ray in every for s in ray.segments))
    order = sorted(m.keyframes.values(), key=content_key)
    voxels = allocated(m)
    m.infer()
    expected = reference.infer([rays[k.id] for k in order], voxels, prior_probability(config, VOXEL), config)
    seen = sorted({s.voxel for ray in every for s in ray.segments} & voxels)
    np.testing.assert_allclose(marginals(m, seen), [reference.logistic(expected[v]) for v in seen], atol=1e-3)


def room(strides: dict[str, int], order: tuple[int, ...]) -> MRFMap:
    m = MRFMap(small_room.VOXEL_SIZE, **strides)
    for i in order:
        small_room.add(m, small_room.frames()[i])
    return m


STRIDES = {"first_sweep_stride": 4, "free_space_stride": 4}


def test_a_map_with_strides_does_not_depend_on_its_history() -> None:
    maps = []
    for order in list(permutations((0, 1, 2)))[::2]:
        m = room(STRIDES, (3, *order))
        m.renew()
        m.remove_keyframe(min(m.keyframes))
        m.infer()
        maps.append(m.occupancy(small_room.probes()))
    for other in maps[1:]:
        np.testing.assert_array_equal(other, maps[0])


def test_the_second_sweep_follows_all_rays() -> None:
    whole, sampled = room({}, (0,)), room({"first_sweep_stride": 4}, (0,))
    whole.infer(sweeps=1)
    sampled.infer(sweeps=1)
    few = sampled.last_voxel_steps
    assert 0.2 * whole.last_voxel_steps < few < 0.3 * whole.last_voxel_steps
    apart = np.abs(sampled.voxels(0.0)[1] - whole.voxels(0.0)[1])
    assert apart.max() > 0.2
    # One keyframe's messages follow from the prior alone, so the second sweep replaces them.
    sampled.infer(sweeps=2)
    np.testing.assert_allclose(sampled.voxels(0.0)[1], whole.voxels(0.0)[1], atol=1e-3)
    # Of what it had no messages for, it takes a first sweep again.
    sampled.infer(sweeps=1)
    assert sampled.last_voxel_steps == few


def test_a_wall_and_the_space_before_it_stay_with_fewer_rays() -> None:
    camera = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
    wall = np.full(camera.shape, 1.53, np.float32)
    maps = []
    for stride in (1, 4, 16):
        m = MRFMap(0.05, PolynomialNoise((0.01,)), ray_density=0.0, free_space_stride=stride)
        m.add_keyframe(wall, np.eye(4), camera)
        m.infer()
        maps.append(m)
    whole, steps = maps[0], maps[0].last_voxel_steps
    centres = whole.voxels(0.0)[0]
    inside = np.abs(centres[:, :2]).max(axis=1) < 0.5
    before, near = inside & (centres[:, 2] < 1.35), inside & (np.abs(centres[:, 2] - 1.53) < 0.05)
    assert before.sum() > 1000 < 10 * near.sum()
    for m in maps[1:]:
        assert m.last_voxel_steps < 0.7 * steps
        free = m.occupancy(centres[before]) < 0.01
        assert free.mean() > 0.999 * (whole.occupancy(centres[before]) < 0.01).mean()
        np.testing.assert_allclose(m.occupancy(centres[near]), whole.occupancy(centres[near]), atol=1e-3)


@pytest.mark.parametrize("name", ["first_sweep_stride", "free_space_stride"])
@pytest.mark.parametrize("value", [0, -1, 1025])
def test_a_stride_out_of_range_is_refused(name: str, value: int) -> None:
    with pytest.raises(ConfigError, match=f"inference.{name}"):
        InferenceConfig(**{name: value})  # type: ignore[arg-type]
