"""What the camera carries along: a robot's arm is told, a floor that always looks the same is not."""

from pathlib import Path

import numpy as np
import pytest
from armed_room import record, write

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.doctor.carried import carried_along
from taichi_mrf.datasets.doctor.diagnosis import diagnose
from taichi_mrf.datasets.doctor.readings import Reading
from taichi_mrf.datasets.doctor.search import Search
from taichi_mrf.datasets.doctor.views import read_sample
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

CAMERA = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
HEIGHT_M, DOWN = 0.8, 0.5


@pytest.mark.usefixtures("one_backend")
def test_an_arm_before_the_camera_is_told(tmp_path: Path) -> None:
    room = record(tmp_path, [-0.4] * 12)
    texts = [each.text for each in diagnose(open_dataset(room.armed)).findings]
    (text,) = (each for each in texts if "moves with the camera" in each)
    assert "--mask FILE" in text
    sample = read_sample(open_dataset(room.armed))
    body = carried_along(Search(sample, Reading(), 1000.0), Reading())
    assert body is not None
    bar = room.is_bar(0)
    assert bar[body].mean() > 0.98
    assert body[bar].mean() > 0.9
    assert diagnose(open_dataset(room.plain)).findings == ()


def drive(folder: Path, step_m: float, bumper: bool) -> Path:
    """A robot that drives over an endless floor, to which its camera looks down, with a low wall of boxes at
    its left, and perhaps a bumper across the lowest rows."""
    T_robot_camera = np.eye(4)
    c, s = np.cos(DOWN), np.sin(DOWN)
    T_robot_camera[:3, :3] = np.array([[0, -s, c], [-1, 0, 0], [0, -c, -s]])
    rays = CAMERA.rays() @ T_robot_camera[:3, :3].T
    floor = np.where(rays[..., 2] < 0, -HEIGHT_M / np.minimum(rays[..., 2], -1e-9), 0.0)
    for index in range(30):
        T = T_robot_camera.copy()
        T[:3, 3] = [index * step_m, 0.0, HEIGHT_M]
        wall = np.where(rays[..., 1] > 0.01, 0.6 / np.maximum(rays[..., 1], 0.01), 1e3)
        along = T[0, 3] + wall * rays[..., 0]
        high = HEIGHT_M + wall * rays[..., 2] < 0.2 + 0.1 * (np.floor(along / 0.3) % 3)
        depth_m = np.minimum(floor, np.where(high, wall, np.inf))
        if bumper:
            depth_m[-8:, 10:50] = 0.3
        depth_m = np.where((depth_m > 0) & (depth_m < 8), depth_m, 0).astype(np.float32)
        write(folder, index, Frame(depth_m, T, CAMERA, float(index), f"{index}"), depth_m)
    return folder


def told(folder: Path) -> np.ndarray | None:
    return carried_along(Search(read_sample(open_dataset(folder)), Reading(), 1000.0), Reading())


def test_a_floor_that_looks_the_same_from_everywhere_is_not_carried_along(tmp_path: Path) -> None:
    assert told(drive(tmp_path / "drive", 0.1, bumper=False)) is None


def test_a_bumper_over_that_floor_is(tmp_path: Path) -> None:
    body = told(drive(tmp_path / "drive", 0.1, bumper=True))
    assert body is not None
    expected = np.zeros(CAMERA.shape, bool)
    expected[-8:, 10:50] = True
    assert expected[body].mean() > 0.95
    assert body[expected].mean() > 0.8


def test_a_camera_that_stands_still_tells_nothing(tmp_path: Path) -> None:
    assert told(drive(tmp_path / "still", 0.0, bumper=True)) is None
