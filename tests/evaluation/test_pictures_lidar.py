"""Pictures of maps by lidar: images are unrolled, and walls face the sensor."""

from pathlib import Path

import numpy as np
import pytest

from taichi_mrf.evaluation.pictures.run_pictures import depth_comparison, write_pictures
from taichi_mrf.evaluation.pictures.surfaces import seen_surfaces
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera

pytestmark = pytest.mark.usefixtures("one_backend")

HALF_M = np.array([2.2, 1.8, 1.1])
LIDAR = SphericalCamera(np.linspace(0.6, -0.6, 40), np.linspace(np.pi, -np.pi, 160, endpoint=False))


@pytest.mark.parametrize("camera", [LIDAR, RayTable(LIDAR.rays().reshape(-1, 3))], ids=["lidar", "free rays"])
def test_a_room_by_lidar_is_drawn(tmp_path: Path, camera: RayTable) -> None:
    m = MRFMap(0.1, PolynomialNoise((0.02,)))
    for x in (-0.5, 0.4):
        T = np.eye(4)
        T[0, 3] = x
        with np.errstate(divide="ignore"):
            range_m = ((np.copysign(HALF_M, camera.rays()) - T[:3, 3]) / camera.rays()).min(axis=-1)
        m.add_keyframe(range_m.astype(np.float32), T, camera)
    m.infer()
    written = write_pictures(tmp_path, m, [])
    assert [path.name for path in written] == ["surface.png", "top_view.png", "depth.png"]
    image = np.asarray(depth_comparison(m, []).axes[0].images[0].get_array())
    assert image.shape[1] > 2 * image.shape[0]
    surfaces = seen_surfaces(m)
    wall = surfaces.normals_at(np.array([[2.2, 0.3, 0.2], [-0.2, -1.8, 0.1]]))
    np.testing.assert_allclose(
        wall / np.linalg.norm(wall, axis=1, keepdims=True), [[-1, 0, 0], [0, 1, 0]], atol=0.2
    )
