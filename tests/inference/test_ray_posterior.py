"""The posterior of rays against float64 NumPy, ray by ray and voxel by voxel."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from one_pixel import VOXEL, allocated, look_along, marginals, well_cut
from oracles import inference as reference
from oracles.forward import Noise

from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.inference.ray_posterior import FreeLogs, RayVisitor, follow_rays
from taichi_mrf.inference.workers import workers_without_trace
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, Template
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.window import WindowIndex

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends]

CAMERA = PinholeCamera(3, 1, 8.0, 8.0, 1.0, 0.0)
MAX_DEPTH = 0.7


@dataclass(frozen=True)
class _Record(RayVisitor):
    """Writes down what rays find; rays of odd numbers are left out, and none goes beyond ``enough``."""

    here: F32Array
    found: F32Array
    enough: F32

    @ti.func
    def wants(self, rays: Template, number: I32) -> I32:
        return 1 - number % 2

    @ti.func
    def meet(self, ahead: Template, sight: Template, voxel: I32, here: F32) -> I32:
        ti.atomic_add(self.here[voxel], here)
        return ti.cast(ahead.explained < self.enough, ti.i32)

    @ti.func
    def end(self, ahead: Template, sight: Template, beyond: F32):  # noqa: ANN202 (Taichi takes no None)
        # Added, not assigned: an array that is not read comes back from Vulkan undefined where no ray writes.
        self.found[4 * sight.number] += ahead.explained
        self.found[4 * sight.number + 1] += ahead.visibility
        self.found[4 * sight.number + 2] += beyond
        self.found[4 * sight.number + 3] += sight.begin


def _followed(m: MRFMap, enough: float) -> tuple[np.ndarray, np.ndarray]:
    """Notes of the visitor on the map's last keyframe, by voxels of the pool and by rays."""
    *_, k = m.keyframes.values()
    pool, window, index = m.view.pool, k.footprint.window, WindowIndex()
    index.fill(window, k.visible.cells, k.visible.slots)
    model = m._parts.sweeper.model()
    here = np.zeros(pool.capacity * VOXELS, np.float32)
    found = np.zeros((k.ray_list.number, 4), np.float32)
    follow_rays(
        k.ray_list, k.image.sensor,
        window.viewpoint(k.T_world_camera), index.space(window), model, FreeLogs.of(pool, model),
        workers_without_trace(), _Record(here, found.reshape(-1), enough),
    )  # fmt: skip
    runtime.settle()
    return here, found


def _brick(voxel: reference.Voxel) -> tuple[int, ...]:
    return tuple(i // BRICK for i in voxel)


def _passed(ray: reference.Ray, open_bricks: set[tuple[int, ...]]) -> set[tuple[int, ...]]:
    """The bricks that a ray passes as empty space: no voxel of them is likelier occupied than by the prior,
    and the ray leaves them before the depths that can have made its measurement."""
    densities: dict[tuple[int, ...], float] = {}
    before = ray.segments[: int(np.argmax(ray.densities))] if ray.densities else []
    for segment, density in zip(before, ray.densities, strict=False):
        brick = _brick(segment.voxel)
        densities[brick] = max(densities.get(brick, 0.0), density)
    found = {brick: density for brick, density in densities.items() if brick in open_bricks}
    assume(not any(1e-11 < density < 1e-6 for density in found.values()))  # where the support begins
    return {brick for brick, density in found.items() if density < 1e-11}


@example(seed=198, sigma=0.0625, enough=0.2, pass_through=0.2)  # a brick that is passed
@settings(max_examples=10, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    seed=st.integers(0, 2**32 - 1), sigma=st.floats(0.04, 0.2), enough=st.sampled_from([0.2, 1e9]),
    pass_through=st.sampled_from([0.0, 0.2]),
)  # fmt: skip
def test_rays_find_what_numpy_finds(seed: int, sigma: float, enough: float, pass_through: float) -> None:
    rng = np.random.default_rng(seed)
    config = InferenceConfig(ray_density=0.0, pass_through=pass_through)
    m = MRFMap(VOXEL, PolynomialNoise((sigma,)), inference=config, max_depth=MAX_DEPTH)
    T = look_along(rng.uniform(-1, 1, 3), rng.normal(size=3), rng)
    depth = rng.uniform(0.5, 0.8, CAMERA.shape).astype(np.float32)
    m.add_keyframe(depth, T, CAMERA)
    m.infer()
    rays = reference.cast(depth, T, CAMERA, VOXEL, Noise((sigma,)), max_depth=MAX_DEPTH)
    assume(well_cut(rays[::2], 99))
    voxels = sorted(allocated(m))
    p = dict(zip(voxels, marginals(m, voxels).tolist(), strict=True))
    here, found = _followed(m, enough)
    expected: dict[reference.Voxel, float] = {}
    open_bricks = {_brick(v) for v in voxels} - {_brick(v) for v in voxels if p[v] > 1.02 * m.prior}
    for number, ray in enumerate(rays):
        visibility, explained = 1.0, 0.0
        passed = _passed(ray, open_bricks)
        for segment, density in zip(ray.segments, ray.densities, strict=True):
            if _brick(segment.voxel) in passed:
                continue
            if segment.voxel in p and number % 2 == 0 and explained < enough:
                assume(abs(explained - enough) > 1e-3)
                free = (1 - (1 - pass_through) * p[segment.voxel]) ** segment.length
                one = (1 - free) * density * visibility
                expected[segment.voxel] = expected.get(segment.voxel, 0.0) + one
                explained += one
                visibility *= free
        wanted = [explained, visibility, visibility * ray.beyond, 0.0] if number % 2 == 0 else [0.0] * 4
        np.testing.assert_allclose(found[number], wanted, rtol=2e-3, atol=1e-5)
    assert here.sum() == pytest.approx(sum(expected.values()), rel=2e-3)
    slots = m.view.pool.in_order
    by_voxel = here.reshape(-1, VOXELS)[slots].ravel()
    assert sorted(by_voxel[by_voxel > 1e-4]) == pytest.approx(
        sorted(v for v in expected.values() if v > 1e-4), rel=5e-3, abs=1e-4
    )


def test_rays_see_what_their_shared_path_lets_through() -> None:
    """Two keyframes have seen a wall in front of the surface that a third one's rays measure."""
    camera, sigma, far = PinholeCamera(2, 1, 20.0, 20.0, 0.5, 0.0), 0.03, np.full((1, 2), 1.2, np.float32)
    config = InferenceConfig(ray_density=1e3)  # both pixels have a ray, and are one group
    m = MRFMap(VOXEL, PolynomialNoise((sigma,)), inference=config, max_depth=1.5)
    rng = np.random.default_rng(7)
    T = look_along(rng.uniform(-1, 1, 3), rng.normal(size=3), rng)
    for depth in (np.float32(0.4) * far, np.float32(0.4) * far, far):
        m.add_keyframe(depth, T, camera)
    m.infer()
    group = reference.cast_as_group(far, T, camera, VOXEL, Noise((sigma,)), max_depth=1.5)
    voxels = sorted(allocated(m))
    p = dict(zip(voxels, marginals(m, voxels).tolist(), strict=True))
    closed = {_brick(v) for v in voxels if p[v] > 1.02 * m.prior}
    visibility, explained = 1.0, 0.0
    for segment in group.common:
        if segment.voxel in p and _brick(segment.voxel) in closed:
            visibility *= (1 - p[segment.voxel]) ** segment.length
    assert 0.05 < visibility < 0.95
    ray = group.rays[0]
    for segment, density in zip(ray.segments, ray.densities, strict=True):
        if segment.voxel in p:
            free = (1 - p[segment.voxel]) ** segment.length
            explained += (1 - free) * density * visibility
            visibility *= free
    _, found = _followed(m, 1e9)
    # A visitor may look at all of the ray: it begins at the camera, not where the rays part.
    wanted = [explained, visibility, visibility * ray.beyond, 0.0]
    np.testing.assert_allclose(found[0], wanted, rtol=2e-3, atol=1e-5)
