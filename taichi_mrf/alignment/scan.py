"""The query of a search in a whole map: points as if one sensor had seen them all at once.

They are from a few frames of a recording. A map of which only voxels are left is searched for by its surface,
around places in its free space: depth images rendered of it would have steps where voxels have faces, and few
of them fit anywhere.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from taichi_mrf.alignment.oriented_points import STRIDE, OrientedPoints, oriented_points
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.seen_through import Sightlines, looked_through
from taichi_mrf.alignment.surfels import Planes
from taichi_mrf.alignment.whole_map import WholeMap
from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.inference.keyframe import DepthImage, checked_depth
from taichi_mrf.queries.points import UNKNOWN
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import sees_around
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import NoiseModel

REACH = 60
"""Voxels from a place up to which a map's surface is part of its scan: at least RULES.whole_aside_m."""


@dataclass(frozen=True)
class Scan:
    """Some ``points`` in the frame of a pose ``T_recording_scan`` (4, 4) of their own world, in which ``up``
    (3,) points up to 45 degrees.

    ``looks_through`` tells the share of a mapped surface that cannot be there if the scan was taken at a pose
    (4, 4) in the map. ``colors`` (N, 3) uint8 are those of the points, 0 0 0 where they are not known, or
    None. ``frames`` are the names of those that the points are from, ``views`` how many; the sensor sees
    ``around`` or not.
    """

    T_recording_scan: Pose
    points: OrientedPoints
    up: NDArray[np.float64]
    looks_through: Callable[[Planes, Pose], float]
    colors: NDArray[np.uint8] | None = None
    frames: tuple[str, ...] = ()
    views: int = RULES.whole_fewest
    around: bool = False

    @cached_property
    def lever_m(self) -> float:
        """Distance of a typical point, metres."""
        return float(np.median(np.linalg.norm(self.points.points, axis=1)))

    def points_from(self, T_map_scan: Pose) -> NDArray[np.float64]:
        """The points (N, 3), in metres in the map, from a pose (4, 4)."""
        return self.points.points.astype(np.float64) @ T_map_scan[:3, :3].T + T_map_scan[:3, 3]

    def alike(self, whole: WholeMap, T_map_scan: Pose) -> float:
        """Correlation of the points' brightness with that of a map where they lie from a pose (4, 4); NaN
        unless both have enough colours."""
        if self.colors is None or whole.colors is None:
            return float("nan")
        there = whole.colors(self.points_from(T_map_scan))
        both = (there[:, 3] > 0) & self.colors.any(axis=1)
        if both.sum() < RULES.whole_colored:
            return float("nan")
        seen, mapped = self.colors[both] @ _BRIGHTNESS, there[both, :3] @ _BRIGHTNESS
        spread = float(seen.std() * mapped.std())  # none where all is of one brightness
        return float(np.cov(seen, mapped, bias=True)[0, 1]) / spread if spread > 0 else float("nan")


_BRIGHTNESS = np.array([0.299, 0.587, 0.114])


def scan_of(frames: Sequence[Frame], sensor: SensorConfig, noise: NoiseModel) -> Scan:
    """Some frames of a recording as one scan, in the frame of the middle one's camera. ``sensor`` and
    ``noise`` are the map's. Raises KeyframeError for depth that is none."""
    images = [
        DepthImage.upload(
            checked_depth(frame.depth_m, frame.camera, sensor.min_depth), frame.camera, noise,
            own=frame.own_for(sensor),
        )
        for frame in frames
    ]  # fmt: skip
    T_recording_scan = frames[len(frames) // 2].T_world_camera
    T_scan_camera = [inverse(T_recording_scan) @ frame.T_world_camera for frame in frames]
    around = sees_around(images[0].camera)
    sights = [Sightlines.of(image) for image in images] if around else []

    def looks_through(surface: Planes, T_map_scan: Pose) -> float:
        """The share that the images look through, in the mean."""
        poses = [T_map_scan @ T for T in T_scan_camera]
        if around:
            shares = [sight.seen_through(surface, T) for sight, T in zip(sights, poses, strict=True)]
        else:
            shares = [looked_through(surface, image, T) for image, T in zip(images, poses, strict=True)]
        return float(np.mean(shares))

    parts = [
        oriented_points(image, sensor.max_depth).about(RULES.whole_points // len(images)) for image in images
    ]
    pairs = list(zip(parts, T_scan_camera, strict=True))
    points = OrientedPoints(
        np.concatenate([part.points @ T[:3, :3].T + T[:3, 3] for part, T in pairs]).astype(np.float32),
        np.concatenate([part.normals @ T[:3, :3].T for part, T in pairs]).astype(np.float32),
        np.concatenate([part.sigmas for part in parts]),
        np.concatenate([part.places for part in parts]),
    )
    seen = [
        frame.color[tuple(STRIDE * part.places.T[::-1])]
        for frame, part in zip(frames, parts, strict=True)
        if frame.color is not None
    ]
    colors = np.concatenate(seen) if len(seen) == len(frames) else None
    up = np.mean(
        [T[:3, :3] @ image.camera.up for image, T in zip(images, T_scan_camera, strict=True)], axis=0
    )
    names = tuple(frame.name for frame in frames)
    return Scan(T_recording_scan, points, up, looks_through, colors, names, len(frames), around)


def scans_of(m: VoxelMap, seen: WholeMap) -> Iterator[Scan]:
    """Scans of the surface of a map, as ``seen``, around free places that are apart: those with the most
    surface near first."""
    surface, reach_m = seen.surface.planes(), max(RULES.whole_aside_m, REACH * m.voxel_size)
    around = cKDTree(surface.points_m)
    number = around.query_ball_point(seen.cameras_m, reach_m, return_length=True)
    taken: list[NDArray[np.float64]] = []
    for place_m in seen.cameras_m[np.argsort(-number, kind="stable")]:
        if all(np.linalg.norm(place_m - other_m) > reach_m / 3 for other_m in taken):
            taken.append(place_m)
            yield _scan_around(place_m, m, seen, np.sort(around.query_ball_point(place_m, reach_m)))
        if len(taken) == RULES.whole_stretches:
            return


def _scan_around(place_m: NDArray[np.float64], m: VoxelMap, seen: WholeMap, near: NDArray[np.int64]) -> Scan:
    """The points of the surface ``near`` a place (3,), by their numbers."""
    T, surface = np.eye(4), seen.surface.planes()
    T[:3, 3] = place_m
    points_m, marginals = surface.points_m[near], m.marginals

    def looks_through(walls: Planes, T_map_scan: Pose) -> float:
        """The share that lies where this map is free, of all that lies where it is known."""
        T_here_map = T @ inverse(T_map_scan)
        there_m = walls.points_m @ T_here_map[:3, :3].T + T_here_map[:3, 3]
        there_m = there_m[marginals.state(there_m) != UNKNOWN]
        return seen.in_free(there_m) if len(there_m) else 0.0

    points = OrientedPoints(
        (points_m - place_m).astype(np.float32),
        surface.normals[near].astype(np.float32),
        np.full(len(near), m.voxel_size / 4, np.float32),
        np.zeros((len(near), 2), np.int32),
    )
    known = None if seen.colors is None else seen.colors(points_m)
    colors = None if known is None else np.where(known[:, 3:] > 0, known[:, :3], 0)
    return Scan(T, points, seen.up, looks_through, colors)
