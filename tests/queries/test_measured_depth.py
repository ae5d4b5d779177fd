"""Depths at which rays meet the measured surface near their likeliest voxel, against NumPy."""

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf import MRFMap, PolynomialNoise
from taichi_mrf.queries.measured_depth import NONE, MeasuredDepth
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.voxels.distance_field import DistanceField, blended_sums
from taichi_mrf.voxels.layout import BRICK, VOXELS, offsets_in_brick

# Written out, and not imported: these tests hold the value.
AROUND = 2
GRAZING = 3.0
NEAR_M = 0.075
NEAR_VOXELS = 1.5
STEP = 0.5
MARGIN = 1
LEAST_WEIGHT = 0.02

CAMERA = PinholeCamera(24, 18, 20.0, 20.0, 11.5, 8.5)
SIDE = 3  # bricks
pytestmark = pytest.mark.usefixtures("backend")


def field_of(weight: NDArray, distance: NDArray) -> DistanceField:
    """A field over SIDE^3 bricks from the origin, from boxes (24, 24, 24) of weights and mean distances."""
    bricks = np.stack(np.unravel_index(np.arange(SIDE**3), (SIDE,) * 3), axis=1).astype(np.int32)
    x, y, z = (bricks[:, None] * BRICK + offsets_in_brick()).reshape(-1, 3).T
    w = weight[x, y, z].reshape(-1, VOXELS).astype(np.float32)
    d = (weight * distance)[x, y, z].reshape(-1, VOXELS).astype(np.float32)
    return DistanceField(bricks, w, d, np.zeros_like(w))


def by_brick(voxels: NDArray) -> NDArray:
    """Values of a box (24, 24, 24) as those of its bricks, (27, 512)."""
    split = voxels.reshape((SIDE, BRICK) * 3).transpose(0, 2, 4, 1, 3, 5)
    return split.reshape(SIDE**3, VOXELS)


def plane(normal: NDArray, at: float, random: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Weights with holes and noisy distances of a plane, in voxels; positive towards the origin."""
    centres = np.indices((SIDE * BRICK,) * 3).transpose(1, 2, 3, 0) + 0.5
    distance = at - centres @ normal + 0.1 * random.normal(size=centres.shape[:3])
    weight = random.uniform(0.005, 1.0, distance.shape) * (np.abs(distance) < 4)
    weight[random.uniform(size=weight.shape) < 0.02] = 0
    return weight, distance


def blended_mean(field: DistanceField) -> NDArray:
    """The oracle's mean distances, (24, 24, 24)."""
    weight, distance, _ = field.box(np.full(3, -MARGIN), SIDE * BRICK + 2 * MARGIN)
    own = weight[(slice(MARGIN, -MARGIN),) * 3]
    total, moment = blended_sums(weight, distance)
    known = (own > 0) & (total > LEAST_WEIGHT)
    return np.where(known, moment / np.maximum(total, LEAST_WEIGHT), NONE)


def distance_at(mean: NDArray, place: NDArray) -> tuple[float, NDArray]:
    """The oracle's trilinear distance and gradient at a place in voxels; NONE where a corner has none."""
    corner = np.floor(place - 0.5).astype(int)
    x, y, z = place - 0.5 - corner
    if (corner < 0).any() or (corner + 1 >= mean.shape[0]).any():
        return NONE, np.zeros(3)
    block = mean[tuple(slice(c, c + 2) for c in corner)]
    if (block >= NONE).any():
        return NONE, np.zeros(3)
    of = [np.array([1 - x, x]), np.array([1 - y, y]), np.array([1 - z, z])]
    slope = np.array([-1.0, 1.0])
    value = np.einsum("ijk,i,j,k", block, *of)
    gradient = [
        np.einsum("ijk,i,j,k", block, *(slope if a == b else of[b] for b in range(3))) for a in range(3)
    ]
    return float(value), np.array(gradient)


def crossing(
    mean: NDArray, free: NDArray, origin: NDArray, direction: NDArray, likeliest: float, near: float
) -> float:
    """The oracle's depth of the surface on a ray in voxels, NaN without one."""
    to_voxels = float(np.linalg.norm(direction))
    step, before = STEP / to_voxels, NONE
    t = max(0.0, likeliest - GRAZING * near / to_voxels)
    with np.errstate(divide="ignore"):
        faces = np.stack([-origin / direction, (8 * SIDE * BRICK // 3 - origin) / direction])
    t = max(t, float(faces.min(axis=0).max()))
    end = min(likeliest + GRAZING * near / to_voxels, float(faces.max(axis=0).min()))
    while t <= end:
        here, gradient = distance_at(mean, origin + t * direction)
        if here <= 0 < before < NONE:
            meets = t - step * here / (here - before)
            along = abs(gradient @ direction) / max(float(np.linalg.norm(gradient)), 1e-6)
            steps = (meets + np.arange(-AROUND, AROUND + 1) / to_voxels)[:, None] * direction
            i, j, k = np.floor(origin + steps).astype(int).T
            if abs(meets - likeliest) * along <= near and not free[i, j, k].all():
                return meets
        before, t = here, t + step
    return float("nan")


@pytest.mark.parametrize("voxel_size", [0.02, 0.25])
def test_rays_end_where_the_blended_distance_changes_its_sign(voxel_size: float) -> None:
    random = np.random.default_rng(3)
    normal = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    field = field_of(*plane(normal, 13.0, random))
    mean, near = blended_mean(field), max(NEAR_VOXELS, NEAR_M / voxel_size)
    T = np.eye(4)
    T[:3, 3] = np.array([11.0, 12.0, -8.0]) * voxel_size
    rays = CAMERA.rays().reshape(-1, 3).astype(np.float64) / voxel_size
    origin = T[:3, 3] / voxel_size
    true = (13.0 - origin @ normal) / (rays @ normal)
    off = random.uniform(-2, 2, len(true)) * near * voxel_size / np.abs(rays @ normal) / voxel_size
    likeliest = (true + off).astype(np.float32)
    likeliest[:5] = np.nan
    free = np.ones((SIDE * BRICK,) * 3, bool)
    free[11:] = random.uniform(size=free[11:].shape) < 0.5
    found = MeasuredDepth(field, by_brick(free), voxel_size).near(
        likeliest.reshape(CAMERA.shape), CAMERA, T, 100 * voxel_size
    )
    expected = np.array(
        [
            np.nan if np.isnan(d) else crossing(mean, free, origin, r, d, near)
            for r, d in zip(rays, likeliest, strict=True)
        ]
    )
    answered = ~np.isnan(expected)
    assert 0.15 < answered.mean() < 0.85
    # A step that begins a rounding later may meet a hole, or a distance on the other side of the bound.
    same = answered == ~np.isnan(found.reshape(-1))
    assert same.mean() > 0.98
    both = answered & same
    np.testing.assert_allclose(found.reshape(-1)[both], expected[both], atol=2e-3 * voxel_size)
    assert np.abs(expected[both] - true[both]).mean() < 0.3 * voxel_size


def test_a_field_without_bricks_answers_nothing() -> None:
    empty = DistanceField(np.zeros((0, 3), np.int32), *np.zeros((3, 0, VOXELS), np.float32))
    found = MeasuredDepth(empty, np.zeros((0, VOXELS), bool), 0.1).near(
        np.ones(CAMERA.shape, np.float32), CAMERA, np.eye(4), 10.0
    )
    assert np.isnan(found).all()


def test_a_field_of_sums_that_lie_together_is_the_same() -> None:
    field = field_of(*plane(np.array([0.6, 0.0, 0.8]), 12.0, np.random.default_rng(0)))
    depth = np.full(CAMERA.shape, 1.2, np.float32)
    ours, theirs = (
        MeasuredDepth(each, np.zeros((SIDE**3, VOXELS), bool), 0.1).near(depth, CAMERA, np.eye(4), 5.0)
        for each in (DistanceField.of(field.bricks, field.sums), field)
    )
    np.testing.assert_array_equal(ours, theirs)


def test_a_ray_that_may_pass_ends_on_the_measured_surface_alone() -> None:
    """In fine voxels a surface is spread so far that rays are likelier to pass it than not."""
    draw, sigma_m = np.random.default_rng(0), 0.02
    m = MRFMap(0.05, PolynomialNoise(sigma=(sigma_m,)), max_depth=3.0)
    for _ in range(3):
        noisy_m = 1.0 + sigma_m * draw.standard_normal(CAMERA.shape)
        m.add_keyframe(noisy_m.astype(np.float32), np.eye(4), CAMERA)
    m.infer()
    m.view = m.view.with_occlusion(most=-4.0)  # no voxel stops more than one ray in fifty
    assert np.isnan(m.render_depth(CAMERA, np.eye(4), by="omega")).all()
    depth_m = m.render_depth(CAMERA, np.eye(4))
    np.testing.assert_allclose(np.nanmedian(depth_m), 1.0, atol=sigma_m)
    assert np.isfinite(depth_m).mean() > 0.8
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert np.isnan(m.render_depth(CAMERA, away)).all()
