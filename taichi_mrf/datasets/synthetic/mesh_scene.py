"""A scene that is a triangle mesh in a file: reading it, and taking depth images of it.

Files are read with trimesh and rays are cast by Embree (embreex), which are only needed for meshes and come
with the extra ``mesh``. World frame, metres.

The surfaces of an analytic scene can be such a mesh. Solids may overlap, so there are triangles inside of
other solids too; no camera sees them.

``mesh:FILE?poses=FILE``: a triangle mesh seen from recorded poses, with the truth and a simulated sensor.

More options follow after ``&``, as in ``mesh:house.ply?poses=T_world_camera.txt&noise=kinect&seed=1``; the
fields of :class:`MeshOptions` are the options. The mesh's frame is the world; their file is in any layout
that recordings use (trajectories.py). Paths are relative to the working folder.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Row, Table
from taichi_mrf.datasets.options import PRIMESENSE, ReadOptions, parse_options, require
from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid
from taichi_mrf.datasets.trajectories import read_trajectory
from taichi_mrf.errors import ConfigError, DatasetError, said
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.origins import origins_of
from taichi_mrf.sensor.simulate import KINECT_1, KINECT_1_LATERAL, simulate
from taichi_mrf.system.files import exists, is_file
from taichi_mrf.system.libraries import library


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles in the world: ``vertices`` (V, 3) float64 in metres, ``triangles`` (T, 3) int32 indices of
    vertices. They need not be closed, nor wound in any order."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]

    @property
    def corners(self) -> NDArray[np.float64]:
        """The three corners of each triangle, (T, 3, 3)."""
        return self.vertices[self.triangles]


class MeshScene:
    """A mesh that depth images can be taken of."""

    def __init__(self, mesh: TriangleMesh) -> None:
        """Raises DatasetError if Embree is not installed."""
        self.mesh = mesh
        self._rays = _library("embreex.rtcore_scene")
        self._construction = _library("embreex.mesh_construction")
        # Embree counts in float32, which is most exact around zero.
        corners = mesh.vertices if len(mesh.vertices) else np.zeros((1, 3))
        self._middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        self._radius = 1.001 * float(np.linalg.norm(corners - self._middle, axis=1).max())

    @cached_property
    def _tree(self) -> Any:
        # Robust: no ray slips through the common edge of two triangles.
        tree = self._rays.EmbreeScene(robust=True)
        vertices = np.ascontiguousarray(self.mesh.vertices - self._middle, np.float32)
        self._construction.TriangleMesh(tree, vertices, np.ascontiguousarray(self.mesh.triangles, np.int32))
        return tree

    def render_depth(
        self, camera: Camera, T_world_camera: Pose, beyond_m: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Depth, (H, W) float32 in metres (axial for a pinhole), of the first triangle on the ray through
        each pixel's centre, from either side, beyond the depths (H, W) if given; 0 where it meets none."""
        if not len(self.mesh.triangles):
            return np.zeros(camera.shape, np.float32)
        rays = camera.rays()
        directions = (rays.reshape(-1, 3) @ T_world_camera[:3, :3].T).astype(np.float32)
        origins, starts = np.empty_like(directions), origins_of(camera)
        origins[:] = T_world_camera[:3, 3] - self._middle
        if starts is not None:
            turned = np.broadcast_to(starts, rays.shape).reshape(-1, 3) @ T_world_camera[:3, :3].T
            origins += turned.astype(np.float32)
        depth_m, begin = np.zeros((2, len(directions)), np.float32)
        if beyond_m is not None:
            begin[:] = beyond_m.reshape(-1)
            origins += begin[:, None] * directions
        near = self._near(origins, directions)
        # Directions are one metre of depth long, so that is what Embree's ray parameter is.
        hit = self._tree.run(origins[near], directions[near], query="INTERSECT", output=True)
        depth_m[near] = np.where(hit["primID"] >= 0, begin[near] + hit["tfar"], np.float32(0))
        return depth_m.reshape(camera.shape)

    def _near(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.int64]:
        """The rays that meet a ball around the mesh: a small thing before a camera needs no others."""
        along = (origins * directions).sum(axis=1)
        square = (directions * directions).sum(axis=1)
        outside = (origins * origins).sum(axis=1) - np.float32(self._radius**2)
        return np.flatnonzero((outside <= 0) | ((along < 0) & (along * along >= outside * square)))


def load_mesh(path: Path) -> TriangleMesh:
    """Read a triangle mesh from a PLY, OBJ, STL, OFF or glTF file, its parts joined into one. Raises
    DatasetError, which names the file, if trimesh is not installed, if the file is missing or cannot be read
    as a mesh, and for a mesh without triangles or with vertices that are not finite."""
    trimesh = _library("trimesh")
    if not is_file(path):
        raise DatasetError(f"{path}: {'is not a file' if exists(path) else 'the mesh is missing'}")
    try:
        loaded = trimesh.load_mesh(path, process=False)
        vertices = np.array(loaded.vertices, np.float64).reshape(-1, 3)
        # A point cloud has no faces.
        triangles = np.array(getattr(loaded, "faces", ()), np.int32).reshape(-1, 3)
    except Exception as error:  # trimesh's readers raise many kinds of errors
        raise DatasetError(f"{path}: cannot be read as a mesh: {said(error)}") from error
    if len(triangles) == 0:
        raise DatasetError(f"{path}: contains no triangles")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise DatasetError(f"{path}: a triangle names vertex {triangles.max()} of {len(vertices)}")
    if not np.isfinite(vertices).all():
        raise DatasetError(f"{path}: contains a vertex that is not finite")
    return TriangleMesh(vertices, triangles)


def _library(name: str) -> Any:
    return library(name, "meshes need", "mesh", DatasetError)


def scene_mesh(scene: Scene, sag_m: float = 5e-5) -> TriangleMesh:
    """All solids of a scene as one mesh. Boxes are exact; round solids have their corners on the true
    surface, and their triangles lie at most ``sag_m`` inside of it."""
    vertices: list[NDArray[np.float64]] = []
    triangles: list[NDArray[np.int64]] = []
    first = 0
    for solid in scene.solids:
        points, faces = _lathed(solid, sag_m)
        c, s = math.cos(solid.yaw), math.sin(solid.yaw)
        vertices.append(points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + solid.center)
        triangles.append(faces + first)
        first += len(points)
    return TriangleMesh(np.concatenate(vertices), np.concatenate(triangles).astype(np.int32))


def _lathed(solid: Solid, sag_m: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners and triangles of a solid around the origin: rings of corners from its bottom to its top."""
    if solid.kind == "box":
        around = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * solid.half_size[:2]
        heights, widths = np.array([-1, -1, 1, 1]) * solid.half_size[2], np.array([0.0, 1.0, 1.0, 0.0])
    else:
        radius = solid.half_size[0]
        # Half the sag for each of a sphere's two directions.
        count = max(8, math.ceil(math.pi / math.acos(1 - min(0.5 * sag_m / radius, 0.5))))
        angle = 2 * np.pi * np.arange(count) / count
        around = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        if solid.kind == "sphere":
            rise = np.pi * (np.arange(count // 2 + 2) / (count // 2 + 1) - 0.5)
            heights, widths = radius * np.sin(rise), np.cos(rise)
        else:
            heights = np.array([-1, -1, 1, 1]) * solid.half_size[2]
            widths = np.array([0.0, 1.0, 1.0, 0.0])
    rings, count = len(heights), len(around)
    points = np.empty((rings, count, 3))
    points[..., :2] = widths[:, None, None] * around
    points[..., 2] = heights[:, None]
    ring, spoke = np.indices((rings - 1, count))
    here, beside = ring * count + spoke, ring * count + (spoke + 1) % count
    # The first and the last ring are points, where one triangle of each pair would have no area.
    lower = np.stack([here, beside, beside + count], axis=-1)[1:]
    upper = np.stack([here, beside + count, here + count], axis=-1)[:-1]
    return points.reshape(-1, 3), np.concatenate([lower, upper]).reshape(-1, 3)


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
        require(self, width=8, height=8, seed=0)
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
        depth_m = self.clean_depth(index)
        if self.options.noise != "none":
            sensor = SENSORS[self.options.noise]
            depth_m = simulate(depth_m, self.camera, sensor, seed=(self.options.seed, index))
        return Frame(depth_m, T_world_camera, self.camera, row.stamp, row.name)


def open_mesh(source: str, options: ReadOptions) -> MeshSequence:
    """Open ``FILE?poses=FILE&...``, what follows ``mesh:`` in a source's name. Raises DatasetError, which
    names the file or the option, for a mesh or poses that cannot be read, a wrong option, a depth scale,
    which rendered depth does not have, and if the libraries that meshes need are missing."""
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
