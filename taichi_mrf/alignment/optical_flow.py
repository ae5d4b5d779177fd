"""Motion of a camera between two colour images, from corners that are followed by optical flow.

Corners of the earlier image that have depth are points in space. Where the later image shows them gives its
pose (perspective n points), whatever shape the place has: along a bare wall, depth alone does not determine
the way.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

MOST_CORNERS, LEAST_QUALITY, APART_PX = 400, 0.01, 5.0
"""Corners that are followed, how strong each has to be beside the strongest, and how far apart they are."""

WINDOW_PX, HALVINGS = 15, 4
"""Side of the window around a corner that is compared, and how often images are halved for wide motions."""

THERE_AND_BACK_PX = 0.7
"""A corner that is followed back ends at most this far from where it began."""

LARGEST_JUMP = 0.05
"""A corner whose neighbours differ in depth by more than this share lies on an edge that hides something."""

LEAST_CORNERS, LEAST_SHARE = 30, 0.5
"""Corners that must agree on one motion, and their least share of those that were followed."""

AGREE_PX = 0.7
"""A corner agrees with a motion if that puts it at most this far from where it is seen."""

_SQUARE = np.ones((3, 3), np.uint8)


def motion_between(earlier: Frame, later: Frame) -> Pose | None:
    """``T_earlier_later`` (4, 4), the later camera in the earlier one's frame; None if the images do not
    tell: without colour, of a camera that is no pinhole, or if too few corners agree on one motion."""
    camera = later.camera
    if earlier.color is None or later.color is None or earlier.camera != camera:
        return None
    if not isinstance(camera, PinholeCamera):
        return None
    before, now = _alike_bright(earlier.color, later.color)
    corners = _corners(before, earlier.depth_m)
    if len(corners) < LEAST_CORNERS:
        return None
    corners, seen = _followed(before, now, corners)
    if len(corners) < LEAST_CORNERS:
        return None
    u, v = corners.round().astype(np.intp).T
    points = camera.directions(*corners.astype(np.float64).T) * earlier.depth_m[v, u, None]
    return _pose_of(points.astype(np.float64), seen.astype(np.float64), camera)


def _alike_bright(*colors: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """Grey images, all as dark on average as the darkest: exposure may have changed between them."""
    greys = [cv2.cvtColor(color, cv2.COLOR_RGB2GRAY) for color in colors]
    means = [max(1.0, float(grey[grey > 0].mean())) if grey.any() else 1.0 for grey in greys]
    return [
        np.asarray(cv2.convertScaleAbs(grey, alpha=min(means) / mean), np.uint8)
        for grey, mean in zip(greys, means, strict=True)
    ]


def _corners(grey: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Columns and rows (N, 2) of corners with a depth that does not jump around them."""
    known = np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float32)
    farthest, nearest = cv2.dilate(known, _SQUARE), cv2.erode(known, _SQUARE)
    smooth = (nearest > 0) & (farthest - nearest < LARGEST_JUMP * known)
    mask = smooth.astype(np.uint8)
    found = cv2.goodFeaturesToTrack(grey, MOST_CORNERS, LEAST_QUALITY, APART_PX, mask=mask)
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found, np.float32).reshape(-1, 2)


def _followed(
    before: NDArray[np.uint8], now: NDArray[np.uint8], corners: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Those corners (n, 2) that are found in the later image, and where, (n, 2)."""
    window = (WINDOW_PX, WINDOW_PX)
    ahead, found, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, None, winSize=window, maxLevel=HALVINGS)
    back, held, _ = cv2.calcOpticalFlowPyrLK(now, before, ahead, None, winSize=window, maxLevel=HALVINGS)
    returned = np.linalg.norm(back - corners, axis=1) < THERE_AND_BACK_PX
    kept = (found.ravel() > 0) & (held.ravel() > 0) & returned
    return corners[kept], ahead[kept]


def _pose_of(points: NDArray[np.float64], seen: NDArray[np.float64], camera: PinholeCamera) -> Pose | None:
    """Pose of a camera that sees points (n, 3) at columns and rows (n, 2); None if too few agree."""
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    found, rotation, position, agree = cv2.solvePnPRansac(
        points, seen, K, None, reprojectionError=AGREE_PX, iterationsCount=200, confidence=0.999
    )
    if not found or agree is None or len(agree) < max(LEAST_CORNERS, LEAST_SHARE * len(points)):
        return None
    rows = agree.ravel()
    rotation, position = cv2.solvePnPRefineLM(points[rows], seen[rows], K, None, rotation, position)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], position.ravel()
    return inverse(T)
