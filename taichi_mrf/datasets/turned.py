"""Images that are stored turned by quarters or mirrored, as those of a phone that is held upright, while
poses are the sensor's: their cameras, and their pixels put back.

A stored image is the sensor's, first mirrored (left and right exchanged) and then turned to the left so many
times (conventions.TURNS).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.conventions import TURNS
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera


def stored_camera(recorded: PinholeCamera, turned: str) -> PinholeCamera:
    """The camera of the images as they are stored, whose size ``recorded`` has. Its intrinsics are the
    sensor's, unless images are turned by a quarter and its principal point is nearer to the middle of these
    than to that of the sensor's."""
    if turned not in TURNS:
        return recorded
    quarters, mirrored = TURNS[turned]
    width, height = recorded.width, recorded.height
    if quarters % 2:
        width, height = height, width
        if _off_middle(recorded) <= _off_middle(replace(recorded, width=width, height=height)):
            return recorded
    camera = replace(recorded, width=width, height=height)
    return _turned_left(_mirrored(camera) if mirrored else camera, quarters)


def sensor_camera(recorded: PinholeCamera, turned: str) -> PinholeCamera:
    """The camera of the images once they are put back."""
    if turned not in TURNS:
        return recorded
    quarters, mirrored = TURNS[turned]
    camera = _turned_left(stored_camera(recorded, turned), 4 - quarters)
    return _mirrored(camera) if mirrored else camera


def put_back(stored: NDArray, turned: str) -> NDArray:
    """An image (H, W, ...) as the sensor took it."""
    if turned not in TURNS:
        return stored
    quarters, mirrored = TURNS[turned]
    image = np.rot90(stored, -quarters)
    return image[:, ::-1] if mirrored else image


def of_image_size(recorded: PinholeCamera, size: tuple[int, int] | None, turned: str) -> PinholeCamera:
    """A camera of stored images of this (width, height), if it states the sensor's, or one of which they are
    a smaller copy."""
    if size is None or not TURNS.get(turned, (0,))[0] % 2 or not turn_hint(recorded, size):
        return recorded
    return replace(recorded, width=recorded.height, height=recorded.width)


def turn_hint(camera: PinholeCamera, size: tuple[int, int]) -> str:
    """Hint for an error about images whose (width, height) is the camera's, or a smaller copy's, exchanged;
    empty for others."""
    is_exchanged = size[0] * camera.width == size[1] * camera.height and size[0] != size[1]
    return "; --image-is turned-left (or turned-right) reads images that were turned" if is_exchanged else ""


def T_sensor_stored(turned: str) -> Pose:
    """The axes of the stored image in the sensor's frame, (4, 4): a rotation about the optical axis, and a
    reflection of x if it is mirrored."""
    T = np.eye(4)
    quarters, mirrored = TURNS.get(turned, (0, False))
    to_the_left = np.array([[0.0, 1.0], [-1.0, 0.0]])  # what points right points up, which is -y, afterwards
    T[:2, :2] = (np.linalg.matrix_power(to_the_left, quarters) @ np.diag([-1.0 if mirrored else 1.0, 1.0])).T
    return T


def _off_middle(camera: PinholeCamera) -> float:
    return abs(camera.cx - (camera.width - 1) / 2) + abs(camera.cy - (camera.height - 1) / 2)


def _mirrored(camera: PinholeCamera) -> PinholeCamera:
    return replace(camera, cx=camera.width - 1 - camera.cx)


def _turned_left(camera: PinholeCamera, quarters: int) -> PinholeCamera:
    """The camera of images that are turned to the left so many times."""
    for _ in range(quarters % 4):
        k = camera
        camera = PinholeCamera(k.height, k.width, k.fy, k.fx, k.cy, k.width - 1 - k.cx)
    return camera
