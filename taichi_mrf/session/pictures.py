"""Depth images and accuracy as small coloured pictures."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import FrameError
from taichi_mrf.evaluation.accuracy import NO_ANSWER, NOT_JUDGED, RIGHT, WRONG, judge_view
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.queries.view import Answer
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.unrolled import covering, unrolled
from taichi_mrf.viewer.messages import Images

THUMBNAIL_WIDTH = 160
"""Most columns of the picture that hangs in a keyframe's frustum."""

IMAGE_WIDTH = 320
"""Most columns of the images beside the map."""

THUMBNAIL_PIXELS, IMAGE_PIXELS = 2400, 320 * 240
"""About the most pixels of both where images are unrolled."""

_NO_DEPTH = np.array([90, 90, 90], np.uint8)

ACCURACY_COLORS = np.zeros((4, 3), np.uint8)
"""RGB for each value of an accuracy image; distinguishable with red-green colour blindness."""
ACCURACY_COLORS[NOT_JUDGED] = 40, 40, 40
ACCURACY_COLORS[NO_ANSWER] = 170, 170, 170
ACCURACY_COLORS[WRONG] = 213, 94, 0
ACCURACY_COLORS[RIGHT] = 0, 114, 178


def thumbnail(camera: Camera, depth_m: NDArray[np.float32]) -> tuple[Camera, NDArray[np.uint8]]:
    """A small picture (h, w, 3) of a depth image (H, W) in metres, 0 for none, and the camera that tells its
    place in the scene: a pinhole itself, of any other the camera of the unrolled picture's pixels."""
    if isinstance(camera, PinholeCamera):
        step = _step(depth_m.shape[1], THUMBNAIL_WIDTH)
        return camera, depth_colors(depth_m[::step, ::step])
    picture = unrolled(camera)
    step = _step_of(picture.camera, THUMBNAIL_PIXELS)
    return picture.camera.thinned(step), depth_colors(picture.image(depth_m)[::step, ::step])


def outlined(camera: Camera) -> Camera:
    """A camera of few pixels that looks where another does, to be drawn; a pinhole is the same."""
    return camera if isinstance(camera, PinholeCamera) else covering(camera, THUMBNAIL_PIXELS)


def depth_colors(
    depth_m: NDArray[np.float32], bounds: tuple[float, float] | None = None
) -> NDArray[np.uint8]:
    """(H, W) depth -> (H, W, 3) uint8 of the turbo scale between two depths (default: those in the image);
    grey where there is none, which is 0 or NaN."""
    there = np.isfinite(depth_m) & (depth_m > 0)
    near, far = bounds or depth_bounds(depth_m)
    share = np.clip((np.where(there, depth_m, near) - near) / max(far - near, 1e-6), 0.0, 1.0)
    colors = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(there[..., None], colors, _NO_DEPTH).astype(np.uint8)


def depth_bounds(depth_m: NDArray[np.float32]) -> tuple[float, float]:
    """The depths between which nearly all of an image lies, in metres."""
    measured = depth_m[np.isfinite(depth_m) & (depth_m > 0)]
    if not len(measured):
        return 0.0, 1.0
    near, far = np.quantile(measured, [0.01, 0.99])
    return float(near), float(far)


def view_images(
    m: OccupancyMap,
    name: str,
    camera: Camera,
    T_world_camera: Pose,
    depth_m: NDArray[np.float32] | None,
) -> Images:
    """Measured depth, rendered depth and accuracy of a view; ``depth_m`` is None if the image is no longer
    in memory. An image without a flat plane is unrolled.

    A pixel is right if the map's answer lies within 1.5 sigma of the measurement, sigma being one voxel.
    """
    flat = isinstance(camera, PinholeCamera)
    step = _step(camera.width, IMAGE_WIDTH) if flat else _step_of(camera, IMAGE_PIXELS)
    small = camera.thinned(step)
    picture = unrolled(small)
    # A map that is still growing has another surface after each keyframe.
    by: Answer = "surface" if m.settled else "omega"
    rendered = m.render_depth(small, T_world_camera, by)
    if depth_m is None:
        nothing = np.full((*picture.camera.shape, 3), _NO_DEPTH, np.uint8)
        score = "its depth image was dropped when it was frozen"
        return Images(name, nothing, depth_colors(picture.image(rendered)), nothing, score)
    measured = np.ascontiguousarray(depth_m[::step, ::step])
    bounds = depth_bounds(measured)
    verdict, score = np.full(small.shape, NOT_JUDGED, np.int8), "nothing to judge: no measurement"
    try:
        judged = judge_view(m, measured, T_world_camera, small, by=by).accuracy("1.5sigma")
    except FrameError:  # no pixel holds a measurement within the sensor's range
        pass
    else:
        verdict = judged.image
        score = f"{judged.score:.0%} right within 1.5 sigma, {judged.unanswered:.0%} without a surface"
    return Images(
        name,
        depth_colors(picture.image(measured), bounds),
        depth_colors(picture.image(rendered), bounds),
        ACCURACY_COLORS[picture.image(verdict, NOT_JUDGED)],
        score,
    )


def _step(width: int, most: int) -> int:
    """The stride with which at most ``most`` of ``width`` pixels are taken."""
    return -(-width // most)


def _step_of(camera: Camera, most: int) -> int:
    """The stride along both sides with which about ``most`` pixels are taken; of a row every one counts."""
    share = camera.width * camera.height / most
    return max(1, math.ceil(share if camera.height == 1 else math.sqrt(share)))
