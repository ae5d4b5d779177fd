"""Keyframes with a noise model or a sigma for each pixel of their own: all that a map does with them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_room
from hypothesis import given, settings
from hypothesis import strategies as st
from inputs_frames import of_frames
from live_scene import FakeLink, finished, marginals, session_of
from numpy.typing import NDArray
from one_pixel import VOXEL, ExactMap, allocated, random_pose
from oracles import inference as reference
from oracles.forward import Noise
from plugged_noise import PixelNoise, SquareNoise, UniformLaw

from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.inference.prior import prior_probability
from taichi_mrf.inference.ray_list import RayBundler, block_of
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.map_file import StoredKeyframe
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.visibility.map import VisibilityMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.noise import PatchNoise, PolynomialNoise
from taichi_mrf.sensor.own_evidence import OwnEvidence
from taichi_mrf.sensor.pose_doubt import covariance_of
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.resident import on_host
from taichi_mrf.system.types import I32, AnyArray, I32Array
from taichi_mrf.tune.trial import judge
from taichi_mrf.viewer.messages import Switch

pytestmark = pytest.mark.usefixtures("one_backend")

BIASED = PolynomialNoise((0.01, 0.0, 0.006), (0.3,))
PROBES = np.random.default_rng(0).uniform(-2.0, 2.0, (2000, 3))
COARSE = PolynomialNoise((0.01, 0.0, 0.006), (0.01,))


def stating(number: int, noise: PolynomialNoise | None = None) -> Frame:
    """A frame of the room with a sigma of its own at most pixels: coarse on the left, fine on the right."""
    frame = small_room.frames()[number]
    sigma = np.geomspace(0.1, 0.008, frame.camera.width) * np.ones((frame.camera.height, 1))
    sigma[::7] = 0.0
    return replace(frame, noise=noise, sigma_m=sigma.astype(np.float32))


def test_a_keyframes_noise_is_that_of_a_map_which_has_it() -> None:
    own, m, other = (MRFMap(small_room.VOXEL_SIZE, noise) for noise in (None, COARSE, None))
    for frame in small_room.frames()[:2]:
        ids = [small_room.add(own, replace(frame, noise=COARSE)), small_room.add(m, frame)]
        small_room.add(other, frame)
        # One by one: full inference takes keyframes in the order of their contents, of which noise is a part.
        for each in (own, m, other):
            each.infer(sweeps=1, keyframes=[ids[0]])
    assert marginals(own) == marginals(m)
    assert marginals(own) != marginals(other)


def test_the_models_sigma_given_for_each_pixel_changes_nothing() -> None:
    frame = small_room.frames()[0]
    plain = small_room.build([0])
    sigma = plain.noise.table(frame.camera).at_pixels(frame.depth_m)[0].astype(np.float32)
    same = small_room.build([replace(frame, sigma_m=sigma)])
    assert same.keyframes[0].ray_list.number == plain.keyframes[0].ray_list.number
    centres, p = plain.voxels(0.0)
    np.testing.assert_allclose(same.occupancy(centres), p, atol=1e-3)
    assert (
        marginals(small_room.build([replace(frame, sigma_m=np.zeros_like(sigma))])).keys()
        == marginals(plain).keys()
    )


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_messages_equal_those_of_numpy_with_a_noise_for_each_ray(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera, T = PinholeCamera(2, 2, 4.0, 4.0, 0.5, 0.5), random_pose(rng)
    depth = rng.uniform(0.5, 1.0, (2, 2)).astype(np.float32)
    sigma = rng.uniform(0.03, 0.3, (2, 2)).astype(np.float32)
    config = InferenceConfig(sweeps=1, free_share=0.0)
    rays = []
    for v, u in np.ndindex(2, 2):
        one = np.zeros_like(depth)
        one[v, u] = depth[v, u]
        rays += reference.cast(one, T, camera, VOXEL, Noise((float(sigma[v, u]),), (0.02,)), 1.5)
    m = ExactMap(VOXEL, PolynomialNoise((0.1,), (0.02,)), inference=config, max_depth=1.5)
    m.add_keyframe(depth, T, camera, sigma_m=sigma)
    m.infer()
    prior = prior_probability(config, VOXEL)
    expected = reference.infer([rays], allocated(m), prior, config, ExactMap.LIMITS)
    p = np.array([reference.logistic(x) for x in expected.values()])
    found = m.marginals.occupancy((np.array(list(expected)) + 0.5) * VOXEL)
    assert np.mean(np.abs(found - p) < 1e-3) > 0.98  # float32 may take the other way round a corner


@kernel
def _blocks(rays: I32Array, width: I32, out: AnyArray) -> None:
    for i in range(rays.shape[0]):
        u, v, wide, high = block_of(rays[i], width)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = u, v, wide, high


def blocks(image: DepthImage) -> NDArray[np.int32]:
    """(n, 4): first column and row of each ray's block, its columns and rows."""
    rays = RayBundler(0.5, InferenceConfig(ray_density=0.02)).rays_of(image)
    out = np.zeros((rays.number, 4), np.int32)
    _blocks(on_host(rays.blocks)[: rays.number], image.camera.width, out)
    return out


def test_pixels_of_other_sigmas_share_no_ray() -> None:
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    depth = np.ones(camera.shape, np.float32)
    model = PolynomialNoise((0.02,))
    plain = blocks(DepthImage.upload(depth, camera, model))
    assert plain[:, 2].max() > 4
    sigma = np.full(camera.shape, 0.02, np.float32)
    np.testing.assert_array_equal(
        blocks(DepthImage.upload(depth, camera, model, own=OwnEvidence(None, 1.1 * sigma))), plain
    )
    sigma[:, 21:] = 0.05
    sigma[7, 5] = 0.3
    found = blocks(DepthImage.upload(depth, camera, model, own=OwnEvidence(None, sigma)))
    assert len(plain) < len(found) < depth.size / 4
    assert (found[:, 2] * found[:, 3]).sum() == depth.size
    for u, v, wide, high in found:
        assert np.ptp(sigma[v : v + high, u : u + wide]) == 0


edits = st.lists(
    st.tuples(st.sampled_from(["add", "remove", "move", "infer"]), st.integers(0, 3)), max_size=7
)


@settings(max_examples=5)
@given(history=edits)
def test_edits_in_any_order_end_in_the_same_map_bit_for_bit(history: list[tuple[str, int]]) -> None:
    frames = [stating(0), stating(1, COARSE), small_room.frames()[2], replace(stating(0), sigma_m=None)]
    m, present = MRFMap(small_room.VOXEL_SIZE), {}
    for verb, number in history:
        if verb == "add" and number not in present:
            present[number] = small_room.add(m, frames[number])
        elif verb == "remove" and number in present:
            m.remove_keyframe(present.pop(number))
        elif verb == "move" and number in present:
            m.move_keyframe(present[number], frames[3 - number].T_world_camera)
            m.move_keyframe(present[number], frames[number].T_world_camera)
        elif verb == "infer":
            m.infer(sweeps=1)
    for number in range(3):
        if number not in present:
            small_room.add(m, frames[number])
    if 3 in present:
        m.remove_keyframe(present[3])
    m.infer()
    assert marginals(m) == marginals(small_room.build(frames[:3]))


def test_saved_maps_keep_what_keyframes_state(tmp_path: Path) -> None:
    camera = small_room.frames()[0].camera
    patches = PatchNoise(np.full((4, 2), 0.01), np.full((4, 1), 0.002), 80, camera)
    frames = [stating(0, COARSE), replace(small_room.frames()[1], noise=patches), small_room.frames()[2]]
    m = small_room.build(frames)
    m.freeze_keyframe(2)
    m.infer()
    m.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    assert marginals(loaded) == marginals(m)
    assert dict(loaded.frozen) == dict(m.frozen) != {}
    for id, keyframe in loaded.keyframes.items():
        assert keyframe.own.content() == m.keyframes[id].own.content()
    for each in (m, loaded):
        each.move_keyframe(0, frames[2].T_world_camera)
        each.infer()
    assert marginals(loaded) == marginals(m)


def test_recursive_maps_use_and_save_it(tmp_path: Path) -> None:
    for kind, parameters in ((LogOddsMap, {"correct_bias": True}), (VisibilityMap, {})):
        m, plain, coarse = (kind(small_room.VOXEL_SIZE, n, **parameters) for n in (None, None, BIASED))
        small_room.add(m, replace(small_room.frames()[0], noise=BIASED))
        small_room.add(plain, small_room.frames()[0])
        small_room.add(coarse, small_room.frames()[0])
        assert marginals(m) == marginals(coarse) != marginals(plain)
        m.save(tmp_path / "map.npz")
        loaded = kind.load(tmp_path / "map.npz")
        loaded.move_keyframe(0, small_room.frames()[0].T_world_camera)
        loaded.infer()
        assert marginals(loaded) == marginals(coarse)
    stated = VisibilityMap(small_room.VOXEL_SIZE)
    small_room.add(stated, stating(0))
    assert marginals(stated) != marginals(plain)
    stored = stated.keyframes[0]
    assert isinstance(stored, StoredKeyframe)
    assert stored.own.sigma_m is not None


def test_a_live_run_switches_them_off_and_on_bit_for_bit() -> None:
    link = FakeLink()
    frames = [stating(0), stating(1, COARSE), stating(2)]
    session = session_of(link, of_frames(frames))
    before = marginals(finished(session))
    assert before == marginals(small_room.build(frames))
    for on in (False, True):
        link.ask(Switch(1, on=on))
        assert (marginals(finished(session)) == before) is on


def test_held_out_frames_are_judged_by_their_own_noise_and_aligned_by_it() -> None:
    m = small_room.build([stating(0), stating(1)])
    frame = stating(2)
    judged, plain = judge(m, frame), judge(m, small_room.frames()[2])
    sigma, _ = judged.noise.at_pixels(frame.depth_m)
    stated = (frame.sigma_m > 0) & (frame.depth_m > 0)
    np.testing.assert_allclose(sigma[stated], frame.sigma_m[stated], rtol=1e-5)
    assert judged.log_likelihood() != plain.log_likelihood()
    parts = (frame.depth_m, frame.T_world_camera, frame.camera)
    scores = m.ray_scores(*parts, frame.own)
    assert not np.array_equal(scores, m.ray_scores(*parts), equal_nan=True)


@pytest.mark.parametrize(
    ("make", "given"),
    [
        (MRFMap, {}),
        (MRFMap, {"pose_covariance": covariance_of(0.02, 0.005)}),
        (LogOddsMap, {}),
        (VisibilityMap, {}),
    ],
    ids=["mrf", "mrf, doubtful poses", "log_odds", "visibility"],
)
def test_a_class_of_its_own_maps_as_the_polynomial_of_the_same_values(
    make: type, given: dict[str, Any]
) -> None:
    """These are sums of powers of two, so that both round alike."""
    least_m, growth, offset_m = 2.0**-7, 2.0**-8, 2.0**-6
    found = []
    for noise in (SquareNoise(least_m, growth, offset_m), PolynomialNoise((least_m, 0, growth), (offset_m,))):
        m = make(small_room.VOXEL_SIZE)
        for frame in (stating(0), stating(1)):
            m.add_keyframe(
                frame.depth_m, frame.T_world_camera, frame.camera,
                noise=noise, sigma_m=frame.sigma_m, **given,
            )  # fmt: skip
        m.infer()
        found.append(m.occupancy(PROBES))
    assert np.std(found[0]) > 0.02
    np.testing.assert_allclose(*found, atol=1e-6)


@pytest.mark.parametrize("law", [Sensor, UniformLaw])
def test_a_sigma_of_each_pixel_leaves_the_law_of_measurements(law: type[Sensor]) -> None:
    """A law with edges may round to the other side of one."""
    found = []
    for of_model, stated in ((2.0**-6, 2.0**-5), (2.0**-5, None), (2.0**-6, None)):
        m = MRFMap(small_room.VOXEL_SIZE)
        for frame in small_room.frames()[:2]:
            noise = PixelNoise(np.full(frame.camera.shape, of_model, np.float32), law)
            sigma_m = None if stated is None else np.full(frame.camera.shape, stated, np.float32)
            parts = (frame.depth_m, frame.T_world_camera, frame.camera)
            m.add_keyframe(*parts, noise=noise, sigma_m=sigma_m)
        m.infer()
        found.append(m.occupancy(PROBES))
    stated_off, model_off = (np.abs(found[0] - other).mean() for other in found[1:])
    assert stated_off < 1e-3 * model_off
