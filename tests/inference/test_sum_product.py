"""The marginals against brute force where the graph is a tree, and against float64 NumPy where it is not."""

import numpy as np
import pytest
import small_room
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from one_pixel import (
    ONE_PIXEL,
    VOXEL,
    ExactMap,
    ExactMapWithLengths,
    FineMap,
    allocated,
    crossing,
    image,
    look_along,
    marginals,
    random_pose,
    well_cut,
)
from oracles import inference as reference
from oracles.forward import Noise

from benchmarks.speed.profile import count_launches
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.inference.prior import prior_probability
from taichi_mrf.inference.schedule import content_key
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends]

# A sigma wide enough that every voxel of the short ray lies in a brick near the measured surface.
wide = st.floats(0.25, 0.6)
shallow = st.floats(0.3, 0.7)
seeds = st.integers(0, 2**32 - 1)
priors = st.floats(0.02, 0.6)


@settings(max_examples=40)
@given(
    seed=seeds,
    depth=shallow,
    sigma=wide,
    prior=priors,
    bias=st.floats(-0.05, 0.05),
    pass_through=st.sampled_from([0.0, 0.3]),
)
def test_one_ray_equals_enumeration(
    seed: int,
    depth: float,
    sigma: float,
    prior: float,
    bias: float,
    pass_through: float,
) -> None:
    rng = np.random.default_rng(seed)
    T = random_pose(rng)
    config = InferenceConfig(prior=prior, pass_through=pass_through, free_share=0.0)
    sensor = Noise((sigma,), (bias,))
    rays = reference.cast(image(depth), T, ONE_PIXEL, VOXEL, sensor, max_depth=0.75)
    assume(well_cut(rays, 12))
    m = ExactMap(VOXEL, PolynomialNoise((sigma,), (bias,)), inference=config, max_depth=0.75)
    m.add_keyframe(image(depth), T, ONE_PIXEL)
    m.infer(sweeps=2)
    exact = reference.enumerate_marginals(rays, prior, config.floor, pass_through)
    np.testing.assert_allclose(marginals(m, list(exact)), list(exact.values()), atol=1e-4)


@settings(max_examples=40, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    seed=seeds, depths=st.tuples(shallow, shallow), sigma=wide, prior=priors,
)  # fmt: skip
def test_two_rays_that_share_one_voxel_equal_enumeration(
    seed: int,
    depths: tuple[float, float],
    sigma: float,
    prior: float,
) -> None:
    m, rays, config = crossing(seed, depths, sigma, prior)
    assume(len({s.voxel for s in rays[0].segments} & {s.voxel for s in rays[1].segments}) == 1)
    m.infer(sweeps=6)
    exact = reference.enumerate_marginals(rays, prior, config.floor)
    np.testing.assert_allclose(marginals(m, list(exact)), list(exact.values()), atol=1e-4)


@settings(max_examples=30)
@given(
    seed=seeds,
    pixels=st.sampled_from([(1, 1), (2, 1), (2, 2)]),
    count=st.integers(1, 4),
    sigma=st.floats(0.02, 0.3),
    made_by=st.sampled_from([ExactMap, ExactMapWithLengths]),
    pass_through=st.sampled_from([0.0, 0.2]),
    sweeps=st.integers(1, 5),
    free_share=st.sampled_from([0.0, 0.25, 1.0]),
    alone=st.booleans(),
)
@example(
    seed=420930, pixels=(2, 1), count=3, sigma=0.0625, made_by=ExactMap,
    pass_through=0.0, sweeps=1, free_share=0.0, alone=True,
)  # fmt: skip
def test_loops_equal_the_numpy_schedule(
    seed: int,
    pixels: tuple[int, int],
    count: int,
    sigma: float,
    made_by: type[ExactMap | ExactMapWithLengths],
    pass_through: float,
    sweeps: int,
    free_share: float,
    alone: bool,
) -> None:
    """By each ray for itself, and by rays with a shared path."""
    rng = np.random.default_rng(seed)
    focal = 8.0 if alone else 20.0  # pixels close enough for a group, and never for one ray
    camera = PinholeCamera(pixels[0], pixels[1], focal, focal, (pixels[0] - 1) / 2, (pixels[1] - 1) / 2)
    config = InferenceConfig(
        sweeps=sweeps, pass_through=pass_through, outlier_floor=1e-3, free_share=free_share,
        ray_density=0.0 if alone else 1e3,
    )  # fmt: skip
    sensor = Noise((sigma,), (0.01,))
    m = made_by(VOXEL, PolynomialNoise((sigma,), (0.01,)), inference=config, max_depth=1.5)
    rays = {}
    middle = rng.uniform(-1, 1, 3)
    for _ in range(count):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        T = look_along(middle - 0.6 * direction, direction, rng)
        depth = rng.uniform(0.5, 0.8, camera.shape).astype(np.float32)
        id = m.add_keyframe(depth, T, camera)
        if alone or pixels == (1, 1):
            rays[id] = reference.cast(depth, T, camera, VOXEL, sensor, max_depth=1.5)
        else:
            rays[id] = [reference.cast_as_group(depth, T, camera, VOXEL, sensor, max_depth=1.5)]
    assume(all(s.length > 0.01 for cast in rays.values() for ray in cast for s in ray.segments))
    order = sorted(m.keyframes.values(), key=content_key)
    voxels = allocated(m)
    m.infer()
    prior = prior_probability(config, VOXEL)
    expected = reference.infer([rays[k.id] for k in order], voxels, prior, config, made_by.LIMITS)
    seen = sorted({s.voxel for cast in rays.values() for ray in cast for s in ray.segments} & voxels)
    got = marginals(m, seen)
    np.testing.assert_allclose(got, [reference.logistic(expected[v]) for v in seen], atol=1e-3)


@settings(max_examples=30)
@given(seed=seeds, depth=shallow, sigma=wide, prior=priors)
def test_messages_with_lengths_are_those_of_the_factor(
    seed: int, depth: float, sigma: float, prior: float
) -> None:
    """With lengths, a voxel stops the ray with 1 - (1 - m)^l: the factor, enumerated with those chances,
    must send the same message."""
    rng = np.random.default_rng(seed)
    T = random_pose(rng)
    sensor = Noise((sigma,))
    config = InferenceConfig(prior=prior, free_share=0.0)
    (ray,) = reference.cast(image(depth), T, ONE_PIXEL, VOXEL, sensor, max_depth=0.75)
    assume(well_cut([ray], 12))
    m = ExactMapWithLengths(VOXEL, PolynomialNoise((sigma,)), inference=config, max_depth=0.75)
    m.add_keyframe(image(depth), T, ONE_PIXEL)
    m.infer(sweeps=1)
    stops = np.array([1 - (1 - prior) ** s.length for s in ray.segments])
    voxels = [s.voxel for s in ray.segments]
    n = len(voxels)
    states = (np.arange(2**n)[:, None] >> np.arange(n)) & 1
    factor = np.full(2**n, ray.beyond)
    for i in reversed(range(n)):
        factor = np.where(states[:, i] == 1, ray.densities[i], factor)
    factor = factor + config.floor
    expected = []
    for i in range(n):
        others = np.delete(np.where(states == 1, stops, 1 - stops), i, axis=1).prod(axis=1) * factor
        ratio = others[states[:, i] == 1].sum() / others[states[:, i] == 0].sum()
        expected.append(ratio * prior / (ratio * prior + 1 - prior))
    np.testing.assert_allclose(marginals(m, voxels), expected, atol=1e-4)


def test_float16_messages_move_beliefs_a_little() -> None:
    """Cost of the default precision, against the same map in float32."""
    rng = np.random.default_rng(3)
    camera = PinholeCamera(24, 18, 20.0, 20.0, 11.5, 8.5)
    maps = {
        made_by.LIMITS.precision: made_by(VOXEL, PolynomialNoise((0.03,))) for made_by in (MRFMap, FineMap)
    }
    for _ in range(4):
        T = random_pose(rng, 0.1)
        depth = (1.5 / np.abs(camera.rays() @ T[:3, :3].T).max(axis=-1)).astype(np.float32)
        for m in maps.values():
            m.add_keyframe(depth, T, camera)
    for m in maps.values():
        m.infer()
    voxels = sorted(allocated(maps["float32"]))
    difference = np.abs(marginals(maps["float16"], voxels) - marginals(maps["float32"], voxels))
    assert 0 < difference.max() < 0.01


def test_the_host_waits_for_no_step_of_a_sweep(backend: str) -> None:
    if backend == "cpu":
        pytest.skip("on a CPU arrays of the host are handed to kernels as they are, and nobody waits")
    m = small_room.build([0, 1])
    with count_launches() as launches:
        m.infer(sweeps=1)
    # Each keyframe's order, and what has moved in the end.
    assert launches.waits == 2 * len(m.keyframes)
    assert launches.number > 6 * len(m.keyframes)
