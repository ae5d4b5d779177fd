"""Tries of a lidar: the held-out views of rays without a pattern are shown unrolled."""

import numpy as np
import pytest

from taichi_mrf.evaluation.accuracy import JudgedView
from taichi_mrf.queries.survey import SurfaceSurvey
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.tune.held_out_pictures import HeldOutPictures
from taichi_mrf.tune.history import History
from taichi_mrf.tune.working_set import coarse_stride

LIDAR = SphericalCamera(np.linspace(0.3, -0.3, 4), np.linspace(np.pi, -np.pi, 1800, endpoint=False))
FREE = RayTable(LIDAR.rays().reshape(-1, 3))


@pytest.mark.parametrize(("camera", "stride"), [(LIDAR, 11), (FREE, 1)], ids=["lidar", "free rays"])
def test_views_of_a_lidar_are_shown(camera: Camera, stride: int) -> None:
    assert coarse_stride(camera) == stride
    depth = np.full(camera.shape, 2.0, np.float32)
    survey = SurfaceSurvey(depth - 0.05, depth + 0.05, 0 * depth, depth, depth)
    view = JudgedView(depth, depth, survey, 0.1, 10.0, PolynomialNoise((0.02,)).table(camera))
    pictures = HeldOutPictures([Frame(depth, np.eye(4), camera, 0.0, "scan")])
    for pixel_stride in (stride, 1):
        pictures.keep(0, [view], pixel_stride, 0)
        shown = pictures.show(0, 0, History("scans"))
        assert shown is not None
        assert min(shown.accuracy.shape[0], shown.measured.shape[0]) >= 1
        assert 100 < shown.measured.shape[1] <= 320
