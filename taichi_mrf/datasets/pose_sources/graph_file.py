"""Pose graphs in text files: g2o (``VERTEX_SE3:QUAT``, ``EDGE_SE3:QUAT``) and TORO, which GTSAM reads too
(``VERTEX3``, ``EDGE3``: roll, pitch and yaw in radians, R = Rz(yaw) Ry(pitch) Rx(roll)).

A vertex is the pose T_world_camera of the frame with its number. An edge's information is that of metres and
radians, as GTSAM and the example of Ceres take it; g2o's own error has half the angle. GTSAM's symbols, such
as x12, are keys with a letter in the highest of eight bytes; the rest is the number. Landmarks, parameters
and other lines are passed over. A graph in the plane is refused: it does not say where a camera is in space.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.timed_poses import quaternion
from taichi_mrf.datasets.trajectories import floats, pose_from_quaternion
from taichi_mrf.errors import DatasetError, KeyframeError, naming
from taichi_mrf.geometry.pose_edge import PoseEdge
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.system.atomic import write_text
from taichi_mrf.system.files import open_regular, read_text

SUFFIXES = (".g2o", ".toro", ".graph")

_VERTICES = {"VERTEX_SE3:QUAT": 7, "VERTEX3": 6}
_EDGES = {"EDGE_SE3:QUAT": 7, "EDGE3": 6}
_PLANAR = ("VERTEX_SE2", "VERTEX2", "VERTEX")
_INFORMATION = 21
_UPPER = np.triu_indices(6)
_LETTER_BITS = 56
"""Below GTSAM's letter."""


@dataclass(frozen=True)
class PoseGraph:
    """The poses (4, 4) of a graph's vertices by number, and its edges."""

    poses: Mapping[int, Pose]
    edges: Sequence[PoseEdge]


def is_pose_graph(path: Path) -> bool:
    """True if a file is a pose graph, by the ending of its name or its first line."""
    if path.suffix in SUFFIXES:
        return True
    try:
        with open_regular(path, DatasetError) as file:
            words = file.read(4096).split(maxsplit=1)
    except (DatasetError, OSError):
        return False
    return bool(words) and words[0].startswith((b"VERTEX", b"EDGE"))


def read_pose_graph(path: Path, with_edges: bool = True) -> PoseGraph:
    """Read a graph, or its vertices alone. Raises DatasetError, which names the file and the line, if it
    cannot be read, holds no pose in space, or a line has not the numbers that it should."""
    poses: dict[int, Pose] = {}
    keys: dict[int, int] = {}
    edges: list[PoseEdge] = []
    for number, line in enumerate(read_text(path, DatasetError).split("\n"), start=1):
        words = line.split()
        tag, where = words[0] if words else "", f"{path} line {number}"
        if tag in _PLANAR:
            raise DatasetError(
                f"{where}: {tag} is a pose in the plane; a camera's pose needs VERTEX_SE3:QUAT or VERTEX3"
            )
        if tag in _VERTICES:
            key, vertex = _key(words, 1, where)
            if keys.setdefault(vertex, key) != key:
                raise DatasetError(f"{where}: the number {vertex} stands for another vertex already")
            poses[vertex] = _pose(_numbers(words, 2, _VERTICES[tag], where), where)
        elif tag in _EDGES and with_edges:
            count = _EDGES[tag]
            ends = _key(words, 1, where)[1], _key(words, 2, where)[1]
            T_first_second = _pose(_numbers(words, 3, count, where), where)
            edges.append(PoseEdge(*ends, T_first_second, _information(words[3 + count :], where)))
    if not poses:
        raise DatasetError(f"{path}: contains no {' or '.join(_VERTICES)}")
    return PoseGraph(poses, edges)


def write_pose_graph(path: Path, graph: PoseGraph) -> None:
    """Write a graph as g2o, edges without information with the identity. The letters of GTSAM's keys are
    lost. Raises MapFileError."""
    lines = [f"VERTEX_SE3:QUAT {number} {_words(_seven(T))}" for number, T in graph.poses.items()]
    for edge in graph.edges:
        information = np.eye(6) if edge.information is None else edge.information
        numbers = np.concatenate([_seven(edge.T_first_second), information[_UPPER]])
        lines.append(f"EDGE_SE3:QUAT {edge.first} {edge.second} {_words(numbers)}")
    write_text(path, "\n".join(lines) + "\n")


def _seven(T: Pose) -> NDArray[np.float64]:
    """x y z qx qy qz qw."""
    return np.concatenate([T[:3, 3], quaternion(T[:3, :3])])


def _words(numbers: NDArray[np.float64]) -> str:
    """With all their digits."""
    return " ".join(repr(float(number)) for number in numbers)


def _key(words: Sequence[str], place: int, where: str) -> tuple[int, int]:
    """A vertex's key, and its number without GTSAM's letter."""
    try:
        key = int(words[place])
    except (IndexError, ValueError):
        raise DatasetError(f"{where}: {words[0]} needs the number of a vertex") from None
    if not 0 <= key < 1 << 64:
        raise DatasetError(f"{where}: {key} cannot be the number of a vertex")
    return key, key & ((1 << _LETTER_BITS) - 1)


def _numbers(words: Sequence[str], first: int, count: int, where: str) -> NDArray[np.float64]:
    numbers = floats(words[first : first + count], f"{where}:")
    if len(numbers) < count:
        raise DatasetError(
            f"{where}: {words[0]} has {len(numbers)} numbers after its vertices, needs {count}"
        )
    return np.array(numbers)


def _pose(values: NDArray[np.float64], where: str) -> Pose:
    """The pose of x y z qx qy qz qw, or of x y z roll pitch yaw."""
    with naming(where, KeyframeError):
        return as_pose(pose_from_quaternion(values) if len(values) == 7 else _from_angles(values))


def _from_angles(values: NDArray[np.float64]) -> Pose:
    if not np.isfinite(values).all():
        raise KeyframeError("a pose contains a value that is not finite (NaN or infinity)")
    (roll, pitch, yaw), T = values[3:], np.eye(4)
    for angle, (a, b) in ((roll, (1, 2)), (pitch, (2, 0)), (yaw, (0, 1))):
        R = np.eye(3)
        R[a, a] = R[b, b] = math.cos(angle)
        R[b, a] = math.sin(angle)
        R[a, b] = -R[b, a]
        T[:3, :3] = R @ T[:3, :3]
    T[:3, 3] = values[:3]
    return T


def _information(words: Sequence[str], where: str) -> NDArray[np.float64] | None:
    """The matrix (6, 6) of its upper triangle, row by row."""
    if not words:
        return None
    numbers = floats(words, f"{where}:")
    if len(numbers) != _INFORMATION or not np.isfinite(numbers).all():
        raise DatasetError(f"{where}: expected {_INFORMATION} finite numbers of an information matrix")
    information = np.zeros((6, 6))
    information[_UPPER] = numbers
    information.T[_UPPER] = numbers
    return information
