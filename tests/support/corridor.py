"""A long straight corridor as a stereo camera sees it from one end: the scene of the paper's Fig. 5a."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.methods.visibility.map import VisibilityMap
from taichi_mrf.methods.visibility.plug import TABLE_I
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

WIDTH_M, HEIGHT_M, LENGTH_M = 3.0, 2.5, 25.0

STEREO_LAMBDA = 0.0028
"""sigma_z / z^2 of eq. 7: 0.14 pixels of disparity at a baseline of 0.12 m and a focal length of 420."""

CAMERA_POSITION = (0.13, 0.07, 0.01)
"""From the middle of the corridor's begin, metres: off the grid's planes of symmetry."""


def camera(width: int = 160) -> PinholeCamera:
    """A VGA camera of focal length 420, or a smaller one with the same view."""
    scale = width / 640
    return PinholeCamera(
        width, width * 3 // 4, 420 * scale, 420 * scale, (width - 1) / 2, (width * 3 // 4 - 1) / 2
    )


def depth_image(camera: PinholeCamera) -> NDArray[np.float32]:
    """Axial depth in metres without noise: walls, floor, ceiling and the far end."""
    rays = camera.rays()
    depth = np.full(camera.shape, LENGTH_M - CAMERA_POSITION[2])
    for axis, extent in ((0, WIDTH_M), (1, HEIGHT_M)):
        along = rays[..., axis]
        wall = np.sign(along) * extent / 2 - CAMERA_POSITION[axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(along == 0, depth, np.minimum(depth, wall / along))
    return depth.astype(np.float32)


def pose() -> NDArray[np.float64]:
    """The camera looks along the corridor, which is z."""
    T = np.eye(4)
    T[:3, 3] = CAMERA_POSITION
    return T


def mapped_distance(m: VisibilityMap) -> float:
    """Metres from the sensor to the farthest voxel that is more likely occupied than not."""
    centres, _ = m.voxels(0.5)
    return float(np.linalg.norm(centres - CAMERA_POSITION, axis=1).max()) if len(centres) else 0.0


def grow(voxel_size: float, distance_m: float, camera: PinholeCamera, most: int = 300) -> list[float]:
    """The mapped distance after each update with the same image, until it reaches ``distance_m``."""
    noise, volume = PolynomialNoise((0.0, 0.0, STEREO_LAMBDA)), VolumeConfig(dense_bricks=64)
    m = VisibilityMap(voxel_size, noise, visibility=TABLE_I, volume=volume, max_depth=distance_m + 3)
    depth, curve = depth_image(camera), [0.0]
    while curve[-1] < distance_m and len(curve) <= most:
        m.add_keyframe(depth, pose(), camera)
        curve.append(mapped_distance(m))
    return curve[1:]
