"""Every kind of file that poses can come from, and which of them opens a given file.

A new kind is a module that ends with ``KIND = PoseKind(...)`` and its line in KINDS; the first entry that
recognises a file opens it.
"""

from collections.abc import Callable
from pathlib import Path

from taichi_mrf.datasets.base import when_called
from taichi_mrf.datasets.open3d_json import is_trajectory_json, read_trajectory_json
from taichi_mrf.datasets.pose_sources.base import ChangedPoses, FrameKey, PoseKind, PoseSource, WatchedFile
from taichi_mrf.datasets.pose_sources.graph_file import SUFFIXES, is_pose_graph, read_pose_graph
from taichi_mrf.datasets.ros.names import METADATA, is_bag
from taichi_mrf.datasets.ros.names import SUFFIXES as BAGS
from taichi_mrf.datasets.trajectories import Trajectory, read_trajectory, valid_poses
from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import exists, is_folder


def _poses_in(trajectory: Trajectory) -> ChangedPoses:
    """The valid poses of a trajectory by stamp, or by number. Raises DatasetError if there is none."""
    keys, poses = valid_poses(trajectory)
    kind: type[FrameKey] = float if trajectory.layout == "stamped" else int
    return dict(zip(map(kind, keys), poses, strict=True))


def _watched(read: Callable[[Path], ChangedPoses]) -> Callable[[Path, str], PoseSource]:
    """Opener of a text file that ``read`` reads."""

    def open_file(path: Path, query: str) -> WatchedFile:
        if query:
            raise DatasetError(f"{path}: takes no options after a question mark; bags do")
        return WatchedFile(path, read)

    return open_file


def _graph_poses(path: Path) -> ChangedPoses:
    return {int(number): T for number, T in read_pose_graph(path, with_edges=False).poses.items()}


BAG = PoseKind(
    "ROS bag",
    f"a bag ({', '.join(BAGS)}, or a folder with {METADATA}) with a Path, tf or poses",
    is_bag,
    when_called("taichi_mrf.datasets.ros.pose_history:open_history"),
)
RTABMAP = PoseKind(
    "RTAB-Map",
    "a database (.db)",
    lambda path: path.suffix == ".db",
    when_called("taichi_mrf.datasets.rtabmap.recording:open_poses"),
)
GRAPH = PoseKind(
    "pose graph",
    f"VERTEX_SE3:QUAT or VERTEX3 lines ({', '.join(SUFFIXES)})",
    is_pose_graph,
    _watched(_graph_poses),
)
OPEN3D = PoseKind(
    "Open3D trajectory",
    "a PinholeCameraTrajectory or a PoseGraph (.json)",
    lambda path: path.suffix == ".json",
    _watched(lambda path: _poses_in(_open3d(path))),
)
TRAJECTORY = PoseKind(
    "trajectory",
    "lines of stamp tx ty tz qx qy qz qw (TUM), of 12 or 16 numbers (KITTI), or a .log",
    lambda path: not is_folder(path),
    _watched(lambda path: _poses_in(read_trajectory(path))),
)

KINDS: tuple[PoseKind, ...] = (BAG, RTABMAP, GRAPH, OPEN3D, TRAJECTORY)


def open_pose_source(name: str | Path) -> PoseSource:
    """Open a file of poses, which may follow later if its name says of which kind it is; options of a bag
    follow a question mark. Raises DatasetError, whose text names the file."""
    text, query = str(name), ""
    if not exists(text) and "?" in text:
        text, _, query = text.rpartition("?")
    path = Path(text)
    kind = next((kind for kind in KINDS if kind.recognises(path)), None)
    if kind is None:
        looked_for = "; ".join(f"{each.name}: {each.looks_for}" for each in KINDS)
        raise DatasetError(f"{path}: holds no poses that can be read; looked for {looked_for}")
    return kind.open(path, query)


def _open3d(path: Path) -> Trajectory:
    if not is_trajectory_json(path):
        raise DatasetError(f"{path}: is no {OPEN3D.looks_for}")
    return read_trajectory_json(path)
