"""Sample of a recording for the search: some of its frames thinned out, poses around them, and pairs.

Pairs are chosen by how many frames lie between, and not by the poses, so that every assumption about poses is
tried on the same ones.
"""

import math
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.errors import FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

Floats = NDArray[np.float64]

PLACES = 5
"""Frames, evenly spread, that others are compared with."""

APART = (1, 2, 6, 24)
"""Steps in frames to the others: at one of them the camera has moved far enough and still sees the same."""

REACH_S = 1.0
"""Poses this many seconds around the frames are read, to try poses that are late or early."""

_POSE_SPACING_S = 0.1
_POSES_WITHIN_S = 7.0
_SAMPLES = 250


@dataclass(frozen=True)
class Sphere:
    """The directions around a scanner as an image of ``rows`` and twice as many columns; depth is range."""

    rows: int

    def project(self, points_m: Floats) -> Floats:
        """Column, row and range at which points (N, 3) are seen, (N, 3)."""
        x, y, z = points_m.T
        u = (np.arctan2(y, x) / np.pi + 1) * self.rows - 0.5
        v = (0.5 - np.arctan2(z, np.hypot(x, y)) / np.pi) * self.rows - 0.5
        inside = np.clip(u, 0, 2 * self.rows - 1), np.clip(v, 0, self.rows - 1)
        return np.stack([*inside, np.linalg.norm(points_m, axis=1)], axis=1)


@dataclass(frozen=True)
class View:
    """A frame as it is compared: some ``points`` (N, 3) that it measured, in the camera frame; the pixels
    ``u``, ``v`` (N,) of a pinhole camera that saw them; ``image`` (H, W) has all depths."""

    camera: PinholeCamera | Sphere
    image: NDArray[np.floating]
    points: Floats
    u: NDArray[np.int64]
    v: NDArray[np.int64]


@dataclass(frozen=True)
class Sample:
    """``views`` by frame, and ``pairs`` of them; ``poses`` (M, 4, 4) as recorded and ``stamps`` (M,) of the
    ``frames`` (M,)."""

    views: dict[int, View]
    pairs: list[tuple[int, int]]
    frames: NDArray[np.int64]
    stamps: Floats
    poses: Floats


def read_sample(dataset: Dataset, seconds: float = math.inf) -> Sample:
    """Read some frames; broken ones are passed over, and those that are left after so many seconds. Raises
    DatasetError if the source cannot be read, or if all of them are broken."""
    begin = time.monotonic()
    count = len(dataset)
    views: dict[int, View] = {}
    poses: dict[int, tuple[float, Pose]] = {}
    broken: FrameError | None = None

    firsts = dict.fromkeys(np.linspace(0, count - 1, PLACES + 1).round().astype(int)[:-1].tolist())
    pairs = [(i, i + apart) for apart in APART for i in firsts if i + apart < count]
    for index in sorted({i for pair in pairs for i in pair}):
        if time.monotonic() - begin > seconds:
            break
        try:
            frame = dataset.read(index)
        except FrameError as error:
            broken = broken or error
            continue
        poses[index] = (frame.stamp, frame.T_world_camera)
        view = view_of(frame)
        if view is not None:
            views[index] = view
    if broken is not None and not poses:
        raise broken
    stamps = dataset.stamps()
    for index in _neighbours(pairs, poses) if seconds == math.inf else ():
        if 0 <= index < count and index not in poses:
            with suppress(FrameError):
                poses[index] = (float(stamps[index]), dataset.pose(index))
    frames = np.array(sorted(poses), dtype=np.int64)
    T = np.array([poses[i][1] for i in frames]).reshape(-1, 4, 4)
    T[:, :3, 3] += dataset.origin_m  # a pose is written in another way before its origin is moved
    if count <= 2 * APART[-1]:  # so few frames that hardly any two see the same: all that are read count
        pairs = [(i, i + apart) for apart in APART for i in views]
    pairs = [(i, j) for i, j in pairs if i in views and j in views]
    return Sample(views, pairs, frames, np.array([poses[i][0] for i in frames]), T)


def _neighbours(pairs: list[tuple[int, int]], poses: dict[int, tuple[float, Pose]]) -> Iterable[int]:
    """Frames within REACH_S of those of the pairs, place by place, until reading them takes too long."""
    gaps = [poses[j][0] - poses[i][0] for i, j in pairs if i in poses and j in poses and j - i == 1]
    gap = float(np.median(gaps)) if gaps else 0.0
    if gap <= 0:
        return
    step, reach = max(1, round(_POSE_SPACING_S / gap)), int(np.ceil(REACH_S / gap))
    until = time.monotonic() + _POSES_WITHIN_S
    for first in dict.fromkeys(i for i, _ in pairs):
        for index in sorted({first, *(j for i, j in pairs if i == first)}):
            for near in range(index - reach, index + reach + 1, step):
                if time.monotonic() > until:
                    return
                yield near


def view_of(frame: Frame) -> View | None:
    """A frame's view; None if nothing is measured. What is not a pinhole's becomes an image of the directions
    around, since neighbours in a scan need not be neighbours in space."""
    camera, image = frame.camera, frame.depth_m
    if not (image > 0).any():
        return None
    none = np.empty(0, dtype=np.int64)
    if not isinstance(camera, PinholeCamera):
        points = frame.points_m[image > 0]
        sphere, ranges = _around(points)
        return View(sphere, ranges, points[:: max(1, len(points) // _SAMPLES)], none, none)
    return thinned(camera, image, _SAMPLES)


def thinned(camera: PinholeCamera, image: NDArray[np.floating], count: int) -> View:
    """The view of a depth image with about ``count`` points."""
    step = max(1, int(np.sqrt((image > 0).sum() / count)))
    v, u = (each * step for each in np.nonzero(image[::step, ::step] > 0))
    return View(camera, image, camera.directions(u, v) * image[v, u, None], u, v)


def _around(points: Floats) -> tuple[Sphere, Floats]:
    """Points (N, 3) of a scan as an image of ranges: the nearest of each square."""
    sphere = Sphere(int(np.clip(np.sqrt(len(points)) / 1.5, 8, 180)))
    u, v, ranges = sphere.project(points[np.argsort(-np.linalg.norm(points, axis=1))]).T
    image = np.zeros((sphere.rows, 2 * sphere.rows))
    image[np.rint(v).astype(int), np.rint(u).astype(int)] = ranges
    return sphere, image
