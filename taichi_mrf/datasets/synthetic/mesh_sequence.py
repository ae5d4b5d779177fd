"""``mesh:FILE?poses=FILE``: a triangle mesh seen from recorded poses, with the truth and a simulated sensor.

More options follow after ``&``, as in ``mesh:house.ply?poses=T_world_camera.txt&noise=kinect&seed=1``; the
fields of :class:`MeshOptions` are the options. The mesh's frame is the world; their file
is in any layout that recordings use (trajectories.py). Paths are relative to the working folder.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Row, Table
from taichi_mrf.datasets.options import PRIMESENSE, ReadOptions, parse_options
from taichi_mrf.datasets.synthetic.mesh_scene import MeshScene, load_mesh
from taichi_mrf.datasets.trajectories import read_trajectory
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.simulate import KINECT_1, KINECT_1_LATERAL, simulate

NAME = "mesh:"

SENSORS = {"kinect": KINECT_1, "kinect-lateral": KINECT_1_LATERAL}


@dataclass(frozen=True)
class MeshOptions:
    """The options of a mesh."""

    poses: str = ""
    """The file of poses T_world_camera, one for each frame."""

    noise: Literal["none", "kinect", "kinect-lateral"] = "none"
    """Noise of the depth images: none, the axial noise of a Kinect 1, or its lateral noise too."""

    seed: int = 0
    """Starts the random numbers of the noise; a frame's noise depends on this and its index alone."""

    width: int = PRIMESENSE.width
    """Columns of the images."""

    height: int = PRIMESENSE.height
    """Rows of the images."""

    fx: float | None = None
    """Focal length across, in pixels; left out, the field of view across is that of a Kinect 1."""

    fy: float | None = None
    """Focal length down, in pixels; left out, that across."""

    cx: float | None = None
    """Column of the principal point; left out, the middle of the image."""

    cy: float | None = None
    """Row of the principal point; left out, the middle of the image."""

    def __post_init__(self) -> None:
        if not self.poses:
            raise ConfigError("needs ?poses=FILE, the camera's poses T_world_camera")
        for name, least in (("width", 8), ("height", 8), ("seed", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name} must be at least {least}, not {getattr(self, name)}")
        self.camera()

    def camera(self) -> PinholeCamera:
        """The camera that these options describe. Raises ConfigError if it is invalid."""
        fx = PRIMESENSE.fx * self.width / PRIMESENSE.width if self.fx is None else self.fx
        return PinholeCamera(
            self.width,
            self.height,
            fx,
            fx if self.fy is None else self.fy,
            (self.width - 1) / 2 if self.cx is None else self.cx,
            (self.height - 1) / 2 if self.cy is None else self.cy,
        )


@dataclass
class MeshSequence(Table[Row]):
    """A mesh as a sequence of frames, rendered on request, with ground truth."""

    camera: PinholeCamera
    scene: MeshScene = field(kw_only=True)
    options: MeshOptions = field(kw_only=True)

    def clean_depth(self, index: int) -> NDArray[np.float32]:
        """True axial depth of a frame, (H, W) float32 in metres, 0 where the ray meets no triangle."""
        return self.scene.render_depth(self.camera, self.pose(index))

    def load(self, index: int, row: Row, T_world_camera: Pose) -> Frame:
        """Render one frame, with the noise that the options ask for."""
        depth_m = self.clean_depth(index)
        if self.options.noise != "none":
            sensor = SENSORS[self.options.noise]
            depth_m = simulate(depth_m, self.camera, sensor, seed=(self.options.seed, index))
        return Frame(depth_m, T_world_camera, self.camera, row.stamp, row.name)


def open_mesh(source: str, options: ReadOptions) -> MeshSequence:
    """Open ``FILE?poses=FILE&...``, what follows ``mesh:`` in a source's name.

    Raises DatasetError, whose text names the file or the option, for a mesh or a file of poses that cannot
    be read, for a wrong option, for a depth scale, which rendered depth does not have, and if the
    libraries that meshes need are not installed.
    """
    file, _, query = source.partition("?")
    name = f"{NAME}{file}"
    if not file:
        raise DatasetError(f"{NAME} needs a file: {NAME}FILE?poses=FILE")
    if options.depth_scale is not None:
        raise DatasetError(f"{name}: takes no depth_scale: its depth is in metres")
    chosen = parse_options(MeshOptions, query, name)
    scene = MeshScene(load_mesh(Path(file)))
    trajectory = read_trajectory(Path(chosen.poses))
    stem, stamped = Path(file).stem, trajectory.layout == "stamped"
    rows = [
        Row(f"{stem}-{i:04d}", pose.key if stamped else float(i), pose.T_world_camera, pose.source)
        for i, pose in enumerate(trajectory.poses)
    ]
    return MeshSequence(stem, options.camera or chosen.camera(), rows=rows, scene=scene, options=chosen)
