"""A frame of a recording goes into a map as it is."""

import dataclasses

import numpy as np
import pytest
import small_room

import taichi_mrf as tm
from taichi_mrf.config.schema import PoseConfig, SensorConfig
from taichi_mrf.methods.registry import create_map


@pytest.mark.parametrize("method", ["mrf", "log_odds", "visibility", "wavemap"])
def test_a_frame_brings_its_arrays_its_evidence_and_its_colours(backend: str, method: str) -> None:
    frame = small_room.frames()[0]
    color = np.full((*frame.camera.shape, 3), 200, np.uint8)
    sigma_m = np.full(frame.camera.shape, 0.03, np.float32)
    frame = dataclasses.replace(frame, color=color, sigma_m=sigma_m, stamp=12.5)
    sensor = SensorConfig(pixel_sigma=True, sigma_scale=2.0)
    config = tm.Config(method=method, voxel_size=0.1, sensor=sensor, poses=PoseConfig(doubt_translation=0.01))
    m = create_map(config, frame.camera)
    k = m.keyframes[m.add(frame)]
    assert (k.name, k.stamp_s) == (frame.name, 12.5)
    np.testing.assert_array_equal(k.T_world_camera, frame.T_world_camera)
    np.testing.assert_array_equal(k.depth_m, frame.depth_m)
    assert k.own.sigma_m is not None
    np.testing.assert_allclose(k.own.sigma_m[frame.depth_m > 0], 0.06)
    assert k.own.pose_covariance is not None
    assert (k.color is None) == (method != "mrf")
