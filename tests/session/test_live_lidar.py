"""A live run of a lidar: what the page gets of keyframes that have no flat image, and clicks on them."""

import numpy as np
import pytest
from inputs_frames import of_frames
from live_scene import FakeLink, finished, session_of

from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.origins import points_at, starts_at
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.viewer.messages import (
    CurrentCamera,
    Images,
    KeyframeInfo,
    PixelRay,
    RayAnswer,
    RayThrough,
    Watch,
)

pytestmark = pytest.mark.usefixtures("one_backend")

HALF_M = np.array([2.2, 1.8, 1.1])
LIDAR = SphericalCamera(np.linspace(0.5, -0.5, 40), np.linspace(np.pi, -np.pi, 160, endpoint=False))


def session_scan(camera: Camera, index: int) -> Frame:
    """A scan of a room, by a lidar of this camera."""
    T = np.eye(4)
    T[:3, 3] = 0.5 * index, 0.1, 0.0
    rays, starts = camera.rays(), points_at(camera, np.zeros(camera.shape)) + T[:3, 3]
    with np.errstate(divide="ignore"):
        range_m = ((np.copysign(HALF_M, rays) - starts) / rays).min(axis=-1).astype(np.float32)
    return Frame(range_m, T, camera, float(index), f"scan {index}")


MOVES = np.tile(np.eye(4), (160, 1, 1))
MOVES[:, 0, 3] = np.linspace(-0.2, 0.3, 160)
CAMERAS = {
    "lidar": LIDAR,
    "free rays": RayTable(LIDAR.rays().reshape(-1, 3)),
    "moving lidar": RayTable.moving(LIDAR, MOVES),
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_keyframes_are_shown_unrolled_and_answer_clicks(camera: Camera) -> None:
    link = FakeLink()
    session = session_of(link, of_frames([session_scan(camera, index) for index in range(2)]))
    link.ask(Watch(images=True, view=None, baseline=False))
    finished(session)
    assert link.errors() == []
    keyframes = {info.id: info for info in link.of_type(KeyframeInfo)}
    assert sorted(keyframes) == [0, 1]
    for info in keyframes.values():
        assert info.picture.shape == (*info.camera.shape, 3)
        assert 1000 < info.camera.width * info.camera.height < 4000
        assert info.camera.width > 2 * info.camera.height
    assert link.of_type(CurrentCamera)[-1].camera.width < 200
    images = link.of_type(Images)[-1]
    assert images.measured.shape == images.rendered.shape == images.accuracy.shape
    assert images.measured.shape[1] > 2 * images.measured.shape[0]
    assert "% right within 1.5 sigma" in images.score

    u, v = (55, 20) if camera.height > 1 else (20 * 160 + 55, 0)
    frame = session_scan(camera, 1)
    start = frame.T_world_camera[:3, 3] + starts_at(camera, u, v)
    point = start + 0.15 * camera.rays()[v, u]
    link.ask(PixelRay(1, float(u), float(v)), RayThrough(tuple(point.tolist()), (0.0, 0.0, 3.0), 1))
    finished(session)
    by_number, by_place = link.of_type(RayAnswer)
    for answer in (by_number, by_place):
        assert answer.pixel == (u, v)
        assert answer.measured_m == pytest.approx(float(frame.depth_m[v, u]))
        np.testing.assert_allclose(answer.direction, camera.rays()[v, u], atol=1e-6)
        np.testing.assert_allclose(answer.origin, start, atol=1e-6)
