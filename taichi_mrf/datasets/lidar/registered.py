"""Decision whether the points of scans are in the world's frame or in the sensor's.

Files do not tell. Registered clouds of neighbouring scans overlap as they are, those of a sensor at its
poses; and a scan lies around the place of its sensor, which sees all of its points and none behind another.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.conventions import Conventions
from taichi_mrf.datasets.derived import pose_of
from taichi_mrf.errors import DatasetError, KeyframeError
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms

_PLACES = 4
_MOVED_M, _TURNED = 1.0, 0.3
"""Scans further apart are compared, in metres or radians; nearer ones overlap either way."""

_LEAST_POINTS = 200
_SAMPLES, _NEIGHBOURS = 2000, 15_000
"""Points of a scan that look for the nearest of another, and of how many of that one."""

_CELL_M, _OF_A_PLANE, _PLANE_M = 0.2, 10, 1.0
"""One point in a cell is kept, so many of them make a plane, and it ends so far away from its middle."""

_FLOOR_M, _FITS_M = 0.02, 0.3
"""Distances below are those of noise; clouds that fit are no further apart."""

_CLEARLY, _TWICE = 1.5, 2.0
_FAR = 4.0
"""A sensor is far from the origin if it is so many times as far as its points are from their centre."""

_BIN_RAD, _BEHIND = 0.02, 1.3
MOST_HIDDEN = 0.25
"""Share of the points of a scan that lie behind others; edges and leaves make a tenth."""

_T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Of a camera that looks along the lidar's x."""

_MISTAKES = (
    "the poses are those of the world in the sensor: --poses-are inverse",
    "the poses are a camera's, z ahead: KITTI's calib.txt belongs beside velodyne, else "
    "--mounting 0,0,0,0.5,-0.5,0.5,0.5",
)

Points = NDArray[np.float64]


def in_world(
    count: int, read_pose: Callable[[int], Pose], read_points: Callable[[int], Points]
) -> bool | None:
    """True if points are in the world's frame, False if in the sensor's, None if nothing tells. Looks at a
    few scans. ``read_pose`` gives T_world_sensor and ``read_points`` points (N, 3) as they are in their file;
    scans that cannot be read (DatasetError, KeyframeError) are passed over. Raises DatasetError if poses are
    clearly the inverse, or a camera's."""
    votes, overlaps = [], []
    for first in np.unique(np.linspace(0, count, _PLACES + 1).astype(int)[:_PLACES]) if count else []:
        try:
            T_first, points = read_pose(int(first)), finite(read_points(int(first)))
            if len(points) < _LEAST_POINTS:
                continue
            votes.append(_vote(points, T_first[:3, 3]))
            second = _partner(int(first), count, T_first, read_pose)
            if second is None:
                continue
            others = finite(read_points(second))
            if len(others) >= _LEAST_POINTS:
                overlaps.append(_distances(points, others, T_first, read_pose(second)))
        except (DatasetError, KeyframeError):
            continue
    if sum(votes) != 0:
        return sum(votes) > 0
    if not overlaps:
        return None
    as_they_are, posed, *wrong = np.exp(np.log(overlaps).mean(axis=0))
    # With wrong poses clouds of the sensor's frame may fit better as they are.
    if as_they_are < min(_FITS_M, *(each / _CLEARLY for each in (posed, *wrong))):
        return True
    if min(wrong) < min(_FITS_M, posed / _TWICE, as_they_are / _TWICE):
        raise DatasetError(f"clouds fit together best if {_MISTAKES[int(np.argmin(wrong))]}")
    return False if _CLEARLY * posed < as_they_are else None


def hidden(points: Points, place: NDArray[np.float64]) -> float:
    """The share of points (N, 3) that lie behind others, seen from a ``place`` (3,): a sensor there cannot
    have measured them."""
    rays = points - place
    range_m = np.linalg.norm(rays, axis=1)
    rays, range_m = rays[range_m > 0], range_m[range_m > 0]
    if len(rays) == 0:
        return 0.0
    polar = np.arcsin(np.clip(rays[:, 2] / range_m, -1, 1)), np.arctan2(rays[:, 1], rays[:, 0])
    _, where = np.unique(np.floor(np.stack(polar) / _BIN_RAD), axis=1, return_inverse=True)
    where = where.reshape(-1)
    nearest = np.full(where.max() + 1, np.inf)
    np.minimum.at(nearest, where, range_m)
    return float((range_m > _BEHIND * nearest[where]).mean())


def of_sensor(points: Points, T_world_sensor: Pose) -> Points:
    """Points (N, 3) of the world's frame in the sensor's."""
    T = inverse(T_world_sensor)
    with np.errstate(invalid="ignore", over="ignore"):
        moved: Points = points @ T[:3, :3].T + T[:3, 3]
    return moved


def read_of_sensor(
    read: Callable[[], Points], in_world: bool | None, conventions: Conventions, T_recorded: Pose
) -> Points:
    """The points of a scan in the sensor's frame, into which those of the world's are taken."""
    points_m = read()
    return of_sensor(points_m, pose_of(T_recorded, conventions)) if in_world else points_m


def finite(points: Points) -> Points:
    """The points that are measurements."""
    return points[np.isfinite(points).all(axis=1) & points.any(axis=1)]


def _vote(points: Points, place: NDArray[np.float64]) -> int:
    """1 if a scan lies around the place of its sensor, -1 if around the origin, 0 if it cannot be told."""
    centre = np.median(points, axis=0)
    spread = np.median(np.linalg.norm(points - centre, axis=1))
    if np.linalg.norm(place) > _FAR * spread:
        to_place, to_origin = np.linalg.norm(centre - place), np.linalg.norm(centre)
        return int(_TWICE * to_place < to_origin) - int(_TWICE * to_origin < to_place)
    behind_from_place, behind_from_origin = hidden(points, place), hidden(points, np.zeros(3))
    return int(_TWICE * behind_from_place < behind_from_origin > MOST_HIDDEN) - int(
        _TWICE * behind_from_origin < behind_from_place > MOST_HIDDEN
    )


def _partner(first: int, count: int, T_world_first: Pose, read_pose: Callable[[int], Pose]) -> int | None:
    """The next scan that is far enough away, else the one that is farthest; None if there is no other."""
    best, farthest = None, 0.0
    for other in range(first + 1, count):
        try:
            turn, moved = tangent_norms(T_world_first, read_pose(other))
        except (DatasetError, KeyframeError):
            continue
        apart = max(turn / _TURNED, moved / _MOVED_M)
        if apart > farthest:
            best, farthest = other, apart
        if farthest >= 1:
            break
    return best


def _distances(first: Points, second: Points, T_first: Pose, T_second: Pose) -> tuple[float, ...]:
    """The geometric mean of the distances from the points of a scan to the surfaces of another: as they are,
    at the poses, at the inverse poses, and if the poses are a camera's."""
    from scipy.spatial import cKDTree  # takes a third of a second to import

    first, second = _thinned(first, _SAMPLES), _thinned(second, _NEIGHBOURS)
    tree = cKDTree(second)
    _, near = tree.query(second, _OF_A_PLANE)
    apart = second[near] - second[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(apart.transpose(0, 2, 1) @ apart)[1][:, :, 0]

    def mean(T: Pose) -> float:
        moved = first @ T[:3, :3].T + T[:3, 3]
        away_m, nearest = tree.query(moved)
        from_plane_m = np.abs(((moved - second[nearest]) * normals[nearest]).sum(axis=1))
        distance_m = np.where(away_m < _PLANE_M, from_plane_m, away_m)
        return float(np.exp(np.log(np.maximum(distance_m, _FLOOR_M)).mean()))

    T_second_first = inverse(T_second) @ T_first
    of_camera = inverse(_T_CAMERA_LIDAR) @ T_second_first @ _T_CAMERA_LIDAR
    return tuple(map(mean, (np.eye(4), T_second_first, T_second @ inverse(T_first), of_camera)))


def _thinned(points: Points, most: int) -> Points:
    """At most so many of the points (N, 3), one in a cell: the rings of a lidar are no surfaces."""
    points = points[np.random.default_rng(0).permutation(len(points))]
    _, first = np.unique(np.floor(points / _CELL_M), axis=0, return_index=True)
    return points[np.sort(first)[:most]]
