"""Whole maps against the oracle in NumPy, and what such a map must do whatever its numbers are."""

import dataclasses

import numpy as np
import pytest
import small_room
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from one_pixel import ONE_PIXEL, random_pose
from oracles import visibility as reference
from oracles.forward import Noise

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.errors import CapacityError, ConfigError
from taichi_mrf.methods.visibility.map import VisibilityMap
from taichi_mrf.methods.visibility.plug import TABLE_I
from taichi_mrf.queries.points import OCCUPIED, UNKNOWN
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

pytestmark = pytest.mark.usefixtures("backend")

VOXEL = 0.2
NEAR = VolumeConfig(dense_bricks=32)
"""Volume of a dense map (Vulkan), which need not reach far here."""

STEREO = PolynomialNoise((0.0, 0.0, 0.0028))
"""0.14 pixels of disparity at a baseline of 0.12 m and a focal length of 420."""


def centres(voxels: list[reference.Voxel]) -> np.ndarray:
    return (np.array(voxels, np.float64).reshape(-1, 3) + 0.5) * VOXEL


def close_calls(scan: dict[reference.Voxel, reference.Seen], *others: dict) -> bool:
    """True if float32 could decide otherwise than float64: at q_min, at q_max, or where a ray is sure."""
    sure = any(abs(p - reference.SURE) < 1e-4 for seen in scan.values() for p in seen.inside)
    return sure or any(scan != other for other in others)


@pytest.mark.backends
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    pixels=st.sampled_from([(1, 1), (3, 2), (4, 4)]),
    scans=st.integers(1, 10),
    sigma=st.sampled_from([(0.02,), (0.01, 0.0, 0.1), (0.3,)]),
    bias=st.sampled_from([(0.0,), (0.1,), (0.02, -0.03)]),
    max_range=st.sampled_from([0.0, 0.7]),
    max_depth=st.sampled_from([1.1, 3.0]),
    q_max=st.sampled_from([0.62, 0.7, 0.8]),
    volume=st.sampled_from([None, ((-1.2, -1.0, -2.0), (1.0, 1.2, 0.8))]),
)
def test_scans_equal_the_oracles(
    seed: int,
    pixels: tuple[int, int],
    scans: int,
    sigma: tuple[float, ...],
    bias: tuple[float, ...],
    max_range: float,
    max_depth: float,
    q_max: float,
    volume: reference.Box | None,
) -> None:
    """Scans from about the same place, so that later ones see far, and across what earlier ones met."""
    rng = np.random.default_rng(seed)
    camera = PinholeCamera(pixels[0], pixels[1], 6.0, 6.0, (pixels[0] - 1) / 2, (pixels[1] - 1) / 2)
    config = dataclasses.replace(TABLE_I, max_range=max_range, q_max=q_max)
    box = NEAR if volume is None else dataclasses.replace(NEAR, lower=volume[0], upper=volume[1])
    m = VisibilityMap(
        VOXEL, PolynomialNoise(sigma, bias), visibility=config, volume=box, min_depth=0.2, max_depth=max_depth
    )
    noise, known = Noise(sigma, bias), {}
    looks = [(random_pose(rng, 0.5), rng.uniform(0.3, 1.8, camera.shape)) for _ in range(2)]
    for number in range(scans):
        T, depth = looks[number % 2]
        depth = depth.astype(np.float32)
        scan, *others = (
            reference.follow(known, depth, T, camera, VOXEL, noise, c, max_depth, volume)
            for c in (
                config,
                dataclasses.replace(config, q_min=config.q_min + 1e-5, q_max=config.q_max + 1e-5),
                dataclasses.replace(config, q_min=config.q_min - 1e-5, q_max=config.q_max - 1e-5),
            )
        )
        assume(not close_calls(scan, *others))
        assume(all(length > 0.01 for seen in scan.values() for length in seen.length))
        known = reference.integrate(known, scan, config)
        m.add_keyframe(depth, T, camera)
    voxels = sorted(known)
    # float32 rounds P(I) where sigma is small, and what one scan leaves of that adds up over all of them.
    np.testing.assert_allclose(m.occupancy(centres(voxels)), [known[v] for v in voxels], atol=1e-5 * scans)
    mapped, _ = m.voxels(0.0)
    assert {tuple(v) for v in np.floor(mapped / VOXEL).astype(int).tolist()} == set(voxels)


def along(direction: tuple[float, float, float], origin: tuple[float, float, float]) -> np.ndarray:
    """A camera whose only pixel looks along an axis of the world."""
    z = np.array(direction)
    x = np.roll(z, 1)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = origin
    return T


def repeat(m: VisibilityMap, depth: float, T: np.ndarray, times: int) -> None:
    for _ in range(times):
        m.add_keyframe(np.full((1, 1), depth, np.float32), T, ONE_PIXEL)


def test_probabilities_stay_within_their_bounds() -> None:
    m = VisibilityMap(
        VOXEL, PolynomialNoise((0.01,)), volume=NEAR, lowest=0.2, highest=0.9, visibility=TABLE_I
    )
    repeat(m, 1.1, along((0, 0, 1), (0.1, 0.1, 0.1)), 60)
    p = m.occupancy(np.array([[0.1, 0.1, z] for z in (0.1, 0.7, 1.3)]))
    np.testing.assert_allclose(p, [0.2, 0.2, 0.9], atol=1e-6)


def test_measurements_through_a_known_wall_are_not_believed() -> None:
    """An artefact in OctoMap: wrong matches, scan by scan, 2 m behind a wall."""
    noise, T = PolynomialNoise((0.01,)), along((0, 0, 1), (0.1, 0.1, 0.1))
    m = VisibilityMap(VOXEL, noise, volume=NEAR, visibility=TABLE_I)
    repeat(m, 2.1, T, 60)  # a wall at z = 2.2 m
    wall, behind = np.array([[0.1, 0.1, 2.3]]), np.array([[0.1, 0.1, 2.7 + VOXEL * i] for i in range(10)])
    before = m.occupancy(wall)[0]
    assert before == pytest.approx(0.971, abs=1e-6)
    untouched = m.state(behind)
    repeat(m, 4.1, T, 3)
    np.testing.assert_array_equal(m.state(behind), untouched)
    assert (untouched == UNKNOWN).all()
    assert m.occupancy(wall)[0] < before  # but the wall itself is in full view, and doubted
    assert m.state(wall)[0] == OCCUPIED


def belief(m: VisibilityMap) -> dict[tuple[float, ...], float]:
    at, p = m.voxels(0.0)
    return dict(zip(map(tuple, at.tolist()), p.tolist(), strict=True))


def test_the_order_of_the_rays_does_not_change_a_bit() -> None:
    """A camera turned upside down has the same rays, and the image's last pixel is its first."""
    upright, turned = (
        VisibilityMap(VOXEL, STEREO, volume=NEAR, max_depth=6.0, visibility=TABLE_I),
        VisibilityMap(VOXEL, STEREO, volume=NEAR, max_depth=6.0, visibility=TABLE_I),
    )
    camera = small_room.frames()[0].camera
    rolled = dataclasses.replace(camera, cx=camera.width - 1 - camera.cx, cy=camera.height - 1 - camera.cy)
    for frame in small_room.frames()[:4] * 2:
        T, depth = frame.T_world_camera, frame.depth_m
        upright.add_keyframe(depth, T, camera)
        turned.add_keyframe(depth[::-1, ::-1].copy(), T @ np.diag([-1.0, -1.0, 1.0, 1.0]), rolled)
    assert belief(upright) == belief(turned)


# Bad input.


def test_impossible_parameters_are_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="did you mean 'q_max'"):
        VisibilityMap(qmax=0.5)
    with pytest.raises(ConfigError, match=r"visibility\.q_max must be more than visibility\.q_min"):
        VisibilityMap(q_min=0.8)


def test_a_scan_that_would_not_fit_is_refused_and_leaves_the_map_as_it_was() -> None:
    m = VisibilityMap(0.02, STEREO, volume=VolumeConfig(memory_limit_gb=0.005), visibility=TABLE_I)
    with pytest.raises(CapacityError, match="choose larger voxels"):
        small_room.add(m, small_room.frames()[0])
    assert len(m.voxels(0.0)[0]) == 0
    assert not m.keyframes
