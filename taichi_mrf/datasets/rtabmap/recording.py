"""A database of RTAB-Map as a recording, and as a source of poses that change.

Each node with a depth image is a frame, named by its number. Its pose is the one after the last optimisation;
of a database without any, the odometry's. Depth is registered to the colour camera. The tables were read as
RTAB-Map 0.11 to 0.23 define them.
"""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Row, Table, start_pose
from taichi_mrf.datasets.color_camera import without_black
from taichi_mrf.datasets.images import decode_color, decode_unchanged, note_of_largest, share_of_largest
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.pose_sources.base import ChangedPoses, PoseSource
from taichi_mrf.datasets.pose_sources.watched import WatchedFile
from taichi_mrf.datasets.rtabmap.blobs import NodeCamera, decode_depth, depth_size, node_camera
from taichi_mrf.datasets.rtabmap.database import LOOP_CLOSURES, Node, RtabmapDatabase
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

STEPS_PER_METRE = 1000.0
_LOOKED_AT = 4
"""Images whose numbers are looked at when a database is opened."""


@dataclass(frozen=True)
class PosedNode(Row):
    """A node with its camera."""

    pose: Pose
    node: Node
    camera: NodeCamera


@dataclass
class RtabmapRecording(Table[PosedNode]):
    """The nodes of a database that have depth and a pose."""

    camera: PinholeCamera
    database: RtabmapDatabase = field(kw_only=True)
    own_cameras: bool = True
    """Each node has the camera that is stored with it, not one that the caller named."""

    steps_per_metre: float = STEPS_PER_METRE
    color: bool = True

    def check_scale(self, poses_are_used: bool) -> list[str]:
        """A note of whole numbers that are no measurements; the unit is known."""
        shares = []
        for row in self.rows[:: -(-len(self.rows) // _LOOKED_AT)]:
            try:
                depth, _ = self.database.images(row.node.id, color=False)
                shares.append(share_of_largest(decode_unchanged(depth, row.pose_source)))
            except DatasetError:  # of another kind than PNG, or reported when its frame is read
                continue
        return note_of_largest(shares)

    def load(self, index: int, row: PosedNode, T_world_camera: Pose) -> Frame:
        """Decode a node's images."""
        where = f"{self.database.path}: node {row.node.id}"
        depth, image = self.database.images(row.node.id, self.color)
        depth_m = decode_depth(depth, f"{where}: depth", self.steps_per_metre)
        height, width = depth_m.shape
        try:
            camera = row.camera.of_images(width, height) if self.own_cameras else self.camera
        except ConfigError as error:
            raise DatasetError(str(error)) from error
        if depth_m.shape != camera.shape:
            raise DatasetError(
                f"{where}: depth is {width} x {height}, the camera {camera.width} x {camera.height}"
            )
        color = None if image is None else _thinned(decode_color(image, f"{where}: image"), camera)
        return Frame(depth_m, T_world_camera, camera, row.stamp, row.name, color)


def _thinned(color: NDArray[np.uint8], camera: PinholeCamera) -> NDArray[np.uint8]:
    """The pixels of a colour image that a depth image of fewer rows and columns has kept."""
    rows, columns = (np.arange(n) * of // n for n, of in zip(camera.shape, color.shape, strict=False))
    return without_black(np.ascontiguousarray(color[rows][:, columns]))


def open_database(path: Path, options: ReadOptions) -> RtabmapRecording:
    """List the nodes that can be frames. Raises DatasetError, which names the file, if there are none."""
    database = RtabmapDatabase(path)
    nodes, dropped, notes = _posed_nodes(database, options.track)
    if not nodes:
        why = f"none of {dropped} nodes with depth has a pose" if dropped else "no node has a depth image"
        raise DatasetError(f"{path}: {why}")
    size = depth_size(database.images(nodes[0].node.id, color=False)[0])
    if size is None:
        raise DatasetError(
            f"{path}: node {nodes[0].node.id}: the depth image is of an unknown format, or damaged"
        )
    links = database.links()
    loops = sum(kind in LOOP_CLOSURES for kind, _ in links)
    notes.append(f"{len(links)} links between nodes, {loops} of them close a loop")
    return RtabmapRecording(
        name=path.stem,
        camera=options.camera or nodes[0].camera.of_images(*size),
        notes=notes,
        dropped=dropped,
        distortion=nodes[0].camera.distortion,
        database=database,
        rows=nodes,
        own_cameras=options.camera is None and options.intrinsics is None,
        steps_per_metre=options.depth_scale or STEPS_PER_METRE,
        color=options.color,
    )


def _posed_nodes(database: RtabmapDatabase, track: bool = False) -> tuple[list[PosedNode], int, list[str]]:
    """The nodes with depth and a pose, how many with depth have none, and notes."""
    version, optimised = database.version, database.optimised_poses()
    nodes = {node.id: node for node in database.nodes()}
    found, without = [], 0
    for id, blob in database.calibrations():
        node = nodes.get(id)
        if node is None:
            continue
        T_world_body = start_pose() if track else optimised.get(id) if optimised else node.T_odom_body
        if T_world_body is None:
            without += 1
            continue
        camera = node_camera(blob, version, f"{database.path}: node {id}")
        T_world_camera = T_world_body if track else T_world_body @ camera.T_body_camera
        found.append(
            PosedNode(f"{id:06d}", node.stamp, T_world_camera, f"{database.path}: node {id}", node, camera)
        )
    if optimised and not track:
        return found, without, ["poses as RTAB-Map last optimised them"]
    notes = [] if track else ["poses of the odometry: the database holds no optimised ones"]
    sessions = Counter(each.node.session for each in found).most_common()
    if len(sessions) > 1:
        (longest, count), *others = sessions
        left_out = ", ".join(f"{session} ({nodes} nodes)" for session, nodes in others)
        notes.append(
            f"session {longest} ({count} nodes) is read, not {left_out}: each has an odometry of its own; "
            "optimise them in RTAB-Map to have all"
        )
        without += len(found) - count
        found = [each for each in found if each.node.session == longest]
    return found, without, notes


def changing_poses(path: Path) -> ChangedPoses:
    """The poses T_world_camera of all nodes with depth by their stamps. Raises DatasetError."""
    database = RtabmapDatabase(path)
    try:
        nodes, _, _ = _posed_nodes(database)
    finally:
        database.close()
    return {each.stamp: each.pose for each in nodes}


def open_poses(path: Path, query: str) -> PoseSource:
    if query:
        raise DatasetError(f"{path}: takes no options after a question mark; bags do")
    return WatchedFile(path, changing_poses, beside=("-wal", "-journal"), is_text=False)
