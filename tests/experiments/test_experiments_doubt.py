"""Maps with and without the covariance of poses: what is found of a recording, and how it is judged."""

from dataclasses import replace

import numpy as np
import pytest
import small_room

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.experiments.doubtful_poses import AND_POSE, DOUBTFUL, EXACT, SENSOR, recording
from taichi_mrf.experiments.scenes import Scene, SceneView
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.simulate import KINECT_1

pytestmark = pytest.mark.usefixtures("one_backend")


def test_half_of_the_held_out_views_say_how_far_poses_are_off_and_the_others_judge() -> None:
    views = [
        SceneView(f.name, f.T_world_camera, f.depth_m, f.depth_m, f.depth_m > 0) for f in small_room.frames()
    ]
    # The views that are aligned stand wrong by 3 cm along each axis, in turns this way and that.
    for number, i in enumerate(range(1, len(views), 4)):
        off = moved(views[i].T_world_camera, (-1) ** number * np.array([0.03, 0.03, 0.03, 0, 0, 0]))
        views[i] = replace(views[i], T_world_camera=off)
    noise = PolynomialNoise(KINECT_1.sigma, KINECT_1.bias)
    scene = Scene("room", small_room.frames()[0].camera, noise, VolumeConfig(), 10.0, views)
    result = recording(scene, small_room.VOXEL_SIZE, 0)
    translation, rotation = result["off"]
    assert 0.02 < translation < 0.04
    assert rotation < 0.02
    rows = {(m, v): result[f"{m}, {v}"] for m in (EXACT, DOUBTFUL) for v in (SENSOR, AND_POSE)}
    for m in (EXACT, DOUBTFUL):  # the noise of a view changes what is predicted, not where the map is
        assert rows[m, SENSOR]["5cm"] == rows[m, AND_POSE]["5cm"]
        assert rows[m, SENSOR]["log_likelihood"] != rows[m, AND_POSE]["log_likelihood"]
    assert rows[EXACT, SENSOR]["5cm"] != rows[DOUBTFUL, SENSOR]["5cm"]
    assert all(0 < row["calibration"] < 0.5 for row in rows.values())
