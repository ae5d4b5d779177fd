"""Errors with heavy tails: the likelihood against float64, the messages by enumeration, and whole maps."""

from pathlib import Path

import numpy as np
import pytest
import small_room
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from live_scene import marginals as all_marginals
from one_pixel import EXACT, ONE_PIXEL, VOXEL, image, marginals, random_pose, well_cut
from oracles import inference as reference
from oracles.forward import TailedNoise
from plugged_noise import PixelNoise, UniformLaw

from taichi_mrf.config.inference import InferenceConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.kernels.bundles import kernel
from taichi_mrf.kernels.types import F32Array, Template
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.forward import AUTO, CENTRE, SEGMENT
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.pose_doubt import covariance_of
from taichi_mrf.sensor.tails import REACH, TailedSensor, Tails

pytestmark = pytest.mark.usefixtures("one_backend")

SIGMA, BIAS = (0.004, -0.002, 0.0025), (0.01, -0.02, 0.004)
EXACT_NOISE = TailedNoise(SIGMA, BIAS, share=0.1, widths=6.0)


@kernel
def _ask(
    sensor: Sensor, measured: F32Array, near: F32Array, far: F32Array, density: F32Array, support: F32Array,
    mode: Template,
) -> None:  # fmt: skip
    for i in range(measured.shape[0]):
        noise = sensor.noise_at(0, 0)
        density[i] = sensor.likelihood(measured[i], near[i], far[i], noise, 0.05, mode)
        support[i] = sensor.support(measured[i], noise)


def tailed(share: float, sigmas: float) -> Sensor:
    return Tails(share, sigmas).of(PolynomialNoise(SIGMA, BIAS).table(ONE_PIXEL).sensor(ONE_PIXEL))


@pytest.mark.parametrize("mode", [SEGMENT, CENTRE])
def test_likelihood_and_support(mode: int) -> None:
    rng = np.random.default_rng(0)
    measured = rng.uniform(0.5, 6, 2000).astype(np.float32)
    offset = rng.uniform(-20, 20, 2000) * EXACT_NOISE.sigma_at(measured)
    near = np.maximum(measured + offset, 0.1).astype(np.float32)
    far = (near + rng.uniform(0.01, 0.08, 2000)).astype(np.float32)
    density, support = np.zeros_like(measured), np.zeros_like(measured)
    _ask(tailed(0.1, 6.0), measured, near, far, density, support, mode)
    exact = EXACT_NOISE.density_at(measured, 0.5 * (near.astype(float) + far))
    if mode == SEGMENT:
        exact = EXACT_NOISE.density_over(measured, near, far)
    np.testing.assert_allclose(density, exact, rtol=1e-3, atol=1e-4)
    deviation = EXACT_NOISE.deviation(measured, support)
    inside = support > 0
    assert inside.mean() > 0.9
    np.testing.assert_allclose(deviation[inside], REACH * 6.0, rtol=0.02)


def test_no_tails_are_the_sensors_own_likelihood() -> None:
    measured = np.linspace(1, 4, 50, dtype=np.float32)
    found = []
    for sensor in (tailed(0.0, 6.0), PolynomialNoise(SIGMA, BIAS).table(ONE_PIXEL).sensor(ONE_PIXEL)):
        density = np.zeros_like(measured)
        near = np.full_like(measured, 2.0)
        _ask(sensor, measured, near, near + np.float32(0.05), density, np.zeros_like(measured), AUTO)
        found.append(density)
    assert found[0].any()
    np.testing.assert_allclose(*found, rtol=1e-6)


@settings(max_examples=10)
@given(
    seed=st.integers(0, 2**32 - 1),
    depth=st.floats(0.3, 0.7),
    sigma=st.floats(0.25, 0.6),  # so wide that every voxel of the ray lies in a brick near the surface
    prior=st.floats(0.02, 0.6),
    share=st.sampled_from([0.05, 0.4]),
    method=st.sampled_from(["sum-product", "max-product"]),
)
def test_one_ray_equals_enumeration(
    seed: int, depth: float, sigma: float, prior: float, share: float, method: str
) -> None:
    T = random_pose(np.random.default_rng(seed))
    config = InferenceConfig(prior=prior, tail_share=share, tail_sigmas=4.0, method=method, **EXACT)
    noise = TailedNoise((sigma,), (0.01,), share=share, widths=4.0)
    rays = reference.cast(image(depth), T, ONE_PIXEL, VOXEL, noise, config, max_depth=0.75)
    assume(well_cut(rays, 12))
    m = MRFMap(VOXEL, PolynomialNoise((sigma,), (0.01,)), inference=config, max_depth=0.75)
    m.add_keyframe(image(depth), T, ONE_PIXEL)
    m.infer(sweeps=2)
    exact = reference.enumerate_marginals(rays, prior, config.floor, method == "max-product")
    np.testing.assert_allclose(marginals(m, list(exact)), list(exact.values()), atol=1e-4)


def built(*numbers: int, **parameters: float) -> MRFMap:
    m = MRFMap(small_room.VOXEL_SIZE, PolynomialNoise((0.02,)), **parameters)
    for number in numbers:
        frame = small_room.frames()[number]
        m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, frame.name)
    m.infer()
    return m


def test_a_ray_that_is_off_by_many_sigma_clears_no_wall() -> None:
    """Five keyframes see a wall at 1 m, one sees it half a metre further away."""
    seen = []
    for share in (0.0, 0.1):
        m = MRFMap(
            0.1, PolynomialNoise((0.05,)), tail_share=share, tail_sigmas=10.0, prior=0.1, outlier_floor=0.0
        )
        for depth in (1.03, 1.03, 1.03, 1.03, 1.03, 1.53):
            m.add_keyframe(image(depth), np.eye(4), ONE_PIXEL)
        m.infer()
        seen.append(float(m.occupancy(np.array([[0.0, 0.0, 1.05]]))[0]))
    assert seen[1] > seen[0]


def test_edits_in_any_order_end_in_the_same_map(tmp_path: Path) -> None:
    frames = small_room.frames()
    edited = built(2, 1, tail_share=0.1)
    edited.move_keyframe(1, frames[0].T_world_camera, pose_covariance=covariance_of(0.02, 0.01))
    f = frames[0]
    edited.add_keyframe(f.depth_m, f.T_world_camera, f.camera, f.name)
    edited.infer()
    edited.remove_keyframe(0)
    edited.move_keyframe(1, frames[1].T_world_camera, pose_covariance=np.zeros((6, 6)))
    edited.infer()
    wanted = all_marginals(built(0, 1, tail_share=0.1))
    assert all_marginals(edited) == wanted != all_marginals(built(0, 1))
    edited.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    loaded.infer()
    assert all_marginals(loaded) == wanted


def test_every_noise_of_a_keyframe_has_tails_but_a_law_of_its_own() -> None:
    frame, tails = small_room.frames()[0], Tails(0.1, 5.0)
    noise = PolynomialNoise((0.02,))
    upload = DepthImage.upload(frame.depth_m, frame.camera, noise, tails=tails)
    doubted = upload.doubting(covariance_of(0.02, 0.01))
    assert isinstance(upload.sensor, TailedSensor)
    assert isinstance(doubted.sensor, TailedSensor)
    assert type(doubted.doubting(None).sensor) is TailedSensor
    assert type(DepthImage.upload(frame.depth_m, frame.camera, noise).sensor) is Sensor
    own = PixelNoise(np.full(frame.camera.shape, 0.02, np.float32), UniformLaw)
    sensor = own.table(frame.camera).sensor(frame.camera)
    assert tails.of(sensor) is sensor


@pytest.mark.parametrize("wrong", [{"tail_share": 1.0}, {"tail_share": -0.1}, {"tail_sigmas": 1.5}])
def test_impossible_tails_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=r"inference\.tail_"):
        InferenceConfig(**wrong)
