"""A map's messages (map_sink.py) as entities of a Rerun recording, in an .rrd file.

What belongs to the map as a whole holds at all times. Each keyframe's camera appears at its stamp on the time
line STAMP, in seconds since 1970.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from taichi_mrf.datasets.timed_poses import quaternion
from taichi_mrf.export.map_server import LevelMap
from taichi_mrf.export.map_sink import (
    CLOUD,
    COSTMAP,
    PATH,
    SURFACE,
    MapSink,
    Points,
    nanoseconds,
    occupancy_cells,
    plan_pose,
)
from taichi_mrf.export.surface import Surface
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.geometry.up import Up, up_name
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.system.atomic import atomic_path
from taichi_mrf.system.libraries import library
from taichi_mrf.voxels.colors import marginal_colors

KEYFRAMES, STAMP = "/map/keyframes", "stamp"


def require_rerun() -> Any:
    """Rerun's library. Raises TaichiMRFError without the extra ``rerun``."""
    return library("rerun", ".rrd files need", "rerun")


class RerunSink:
    """A MapSink that logs to a ``recording``; ``cameras`` are those of keyframes by their stamps."""

    def __init__(self, recording: Any, cameras: Mapping[float, Camera], up: Up) -> None:
        self._rerun, self._recording, self._cameras = require_rerun(), recording, cameras
        self._keyframes = 0
        sign, axis = up_name(up).rpartition("-")[1:]
        upwards = f"RIGHT_HAND_{axis.upper()}_{'DOWN' if sign else 'UP'}"
        self._log("/", getattr(self._rerun.ViewCoordinates, upwards))

    def transform(self, T_world_camera: Pose, stamp_s: float) -> None:
        """Log a keyframe's pose (4, 4), with what a pinhole camera sees."""
        make, camera = self._rerun, self._cameras.get(stamp_s)
        parts = [make.Transform3D(translation=T_world_camera[:3, 3], mat3x3=T_world_camera[:3, :3])]
        if isinstance(camera, PinholeCamera):  # Rerun counts from a pixel's corner
            parts.append(
                make.Pinhole(
                    resolution=(camera.width, camera.height), focal_length=(camera.fx, camera.fy),
                    principal_point=(camera.cx + 0.5, camera.cy + 0.5),
                )
            )  # fmt: skip
        self._recording.set_time(STAMP, timestamp=np.datetime64(nanoseconds(stamp_s), "ns"))
        self._log(f"{KEYFRAMES}/{self._keyframes}", *parts, static=False)
        self._keyframes += 1

    def path(self, T_world_camera: Mapping[float, Pose]) -> None:
        """Log the places of keyframes, in the order of their stamps, as a line."""
        places_m = [T_world_camera[stamp_s][:3, 3] for stamp_s in sorted(T_world_camera)]
        self._log(PATH, self._rerun.LineStrips3D([places_m]))

    def voxels(self, points: Points, stamp_s: float) -> None:
        """Log voxels as points of half their size, beside their probabilities."""
        shown = marginal_colors(points.probability) if points.colors is None else points.colors
        logged = self._rerun.Points3D(points.centres_m, radii=points.sizes_m / 2, colors=shown)
        self._log(CLOUD, logged, self._rerun.AnyValues(probability=points.probability))

    def surface(self, surface: Surface, stamp_s: float) -> None:
        mesh = self._rerun.Mesh3D(
            vertex_positions=surface.vertices_m, triangle_indices=surface.triangles,
            vertex_normals=surface.normals, vertex_colors=surface.colors,
        )  # fmt: skip
        self._log(SURFACE, mesh)

    def costmap(self, level: LevelMap, height_m: float, stamp_s: float) -> None:
        """Log a floor plan, whose first row is the last of the image."""
        cells, T_world_plan = np.flipud(occupancy_cells(level)), plan_pose(level, height_m)
        make = self._rerun
        grid = make.GridMap(
            data=cells.tobytes(), cell_size=level.cell_size, translation=T_world_plan[:3, 3],
            quaternion=make.Quaternion(xyzw=quaternion(T_world_plan[:3, :3])),
            format=make.components.ImageFormat(*cells.shape[::-1], color_model="L", channel_datatype="U8"),
            colormap=make.components.Colormap.RvizMap,
        )  # fmt: skip
        self._log(COSTMAP, grid)

    def octomap(self, decided: VoxelMap, cells: bool, stamp_s: float) -> None:
        """Nothing: Rerun has no octree, and the voxels are there."""

    def _log(self, entity: str, *parts: Any, static: bool = True) -> None:
        self._recording.log(entity, *parts, static=static, strict=True)


def write_rrd(path: Path, log: Callable[[MapSink], None], cameras: Mapping[float, Camera], up: Up) -> None:
    """Write what ``log`` logs to a file. Raises MapFileError, and TaichiMRFError without the extra
    ``rerun``."""
    recording = require_rerun().RecordingStream("taichi-mrf", recording_id=path.stem, send_properties=False)
    recording.set_log_time_enabled(False)
    content = recording.binary_stream()  # in memory: of a full disk Rerun's own file only warns
    log(RerunSink(recording, cameras, up))
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.read())
