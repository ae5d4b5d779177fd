"""A robot's own body from its URDF: which pixels of its sensor it covers at the positions of its joints.

URDF files are read with yourdfpy, which comes with the extra ``robot``. Each part of the body is grown by a
margin once, and seen from the sensor at each frame (synthetic/mesh_scene.py). A part around the sensor, such
as its housing, hides nothing and is left out.
"""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.files import read_yaml
from taichi_mrf.config.values import nearest
from taichi_mrf.datasets.conventions import Conventions
from taichi_mrf.datasets.derived import axial_depth
from taichi_mrf.datasets.own_body import OwnBody
from taichi_mrf.datasets.synthetic.mesh_scene import MeshScene, TriangleMesh
from taichi_mrf.errors import ConfigError, DatasetError, FrameError, naming, said
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.files import is_file, read_text
from taichi_mrf.system.libraries import library

Floats = NDArray[np.float64]

_FLAT, _ROUND = 1e-3, math.radians(60)
"""Angles between the normals of two triangles: below the first they are one plane, above the second sharp."""

_STEP = math.radians(30)
"""Round sides of what is grown have corners so far apart."""


@dataclass(frozen=True)
class Joints:
    """The positions (T, J) of joints by their ``names`` at ``stamps`` (T,), which rise; one row without
    stamps holds always. Radians, and metres of sliding joints."""

    names: tuple[str, ...]
    positions: Floats
    stamps: Floats | None = None

    def at(self, frame: Frame) -> dict[str, float]:
        """The positions at a frame's stamp, linear between rows. Raises FrameError outside of their time."""
        row = self.positions[0]
        if self.stamps is not None:
            first, last = self.stamps[[0, -1]]
            if not first <= frame.stamp <= last:
                raise FrameError(
                    f"frame {frame.name}: was taken at {frame.stamp:.3f} s, joints are known from "
                    f"{first:.3f} to {last:.3f} s; --skip-bad-frames leaves such frames out"
                )
            row = np.array([np.interp(frame.stamp, self.stamps, each) for each in self.positions.T])
        return dict(zip(self.names, row.tolist(), strict=True))


def read_joints(path: Path) -> Joints:
    """Positions from a YAML file, ``name: value``, or a CSV table with the columns stamp and a joint each.
    Raises DatasetError, which names the file, and the line of a table."""
    if path.suffix.lower() != ".csv":
        with naming("", ConfigError):
            values = read_yaml(path)
        if not isinstance(values, dict) or not all(isinstance(x, int | float) for x in values.values()):
            raise DatasetError(f"{path}: expected joints as 'name: value', or a .csv of stamp and joints")
        return Joints(tuple(map(str, values)), np.array([list(values.values())], np.float64))
    text = read_text(path, DatasetError, "the table is missing")
    head, *lines = [line for line in text.splitlines() if line.strip()] or [""]
    names, rows = tuple(word.strip() for word in head.split(",")), list[list[float]]()
    if len(names) < 2 or names[0] != "stamp":
        raise DatasetError(f"{path}: its first line must be stamp,JOINT,... with the names of joints")
    for number, line in enumerate(lines, start=2):
        try:
            rows.append([float(word) for word in line.split(",")])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != len(names) or not all(map(math.isfinite, rows[-1])):
            raise DatasetError(f"{path}: line {number}: expected {len(names)} numbers, not '{line[:60]}'")
    table = np.array(rows).reshape(-1, len(names))
    if not len(table) or (np.diff(table[:, 0]) <= 0).any():
        raise DatasetError(f"{path}: expected rows whose stamps rise")
    return Joints(names[1:], table[:, 1:], table[:, 0])


class RobotModel:
    """A URDF, its joints, and the link whose frame is the sensor's."""

    def __init__(self, body: OwnBody, conventions: Conventions) -> None:
        """Of the ``conventions``, that of depth is still to be undone in frames. Raises DatasetError, which
        names the file, if one cannot be read or a name is not in it, and without yourdfpy."""
        assert body.robot is not None
        path = Path(body.robot)
        urdf = library("yourdfpy", "a robot's URDF needs", "robot", DatasetError)
        if not is_file(path):
            raise DatasetError(f"{path}: the URDF is missing")
        try:
            self._robot: Any = urdf.URDF.load(str(path), filename_handler=partial(_mesh_file, path))
        except DatasetError:
            raise
        except Exception as error:  # yourdfpy and the XML reader raise many kinds of errors
            raise DatasetError(f"{path}: cannot be read as a URDF: {said(error)}") from error
        self._link, self._conventions = body.camera_link or "", conventions
        links, joints = list(self._robot.link_map), list(self._robot.joint_map)
        if self._link not in links:
            raise DatasetError(f"{path}: --camera-link: no link '{self._link}'; {nearest(self._link, links)}")
        self._joints = read_joints(Path(body.joints)) if body.joints else Joints((), np.zeros((1, 0)))
        for name in self._joints.names:
            if name not in joints:
                raise DatasetError(f"{body.joints}: {path} has no joint '{name}'; {nearest(name, joints)}")
        self._robot.update_cfg(dict(zip(self._joints.names, self._joints.positions[0].tolist(), strict=True)))
        self._margin_m = body.body_margin
        self._parts: dict[str, tuple[MeshScene, MeshScene | None]] = {}  # grown, and as it is if it is closed
        around: list[str] = []
        graph = self._robot.scene.graph
        for node in graph.nodes_geometry:
            geometry = self._robot.scene.geometry[graph.get(node)[1]]
            mesh = TriangleMesh(np.array(geometry.vertices, np.float64), np.array(geometry.faces, np.int32))
            if _is_around(mesh, inverse(self._T_camera_part(node))[:3, 3], body.body_margin):
                around.append(str(node))
            else:
                solid = MeshScene(mesh) if body.body_space == "free" and geometry.is_watertight else None
                self._parts[node] = MeshScene(grown(mesh, body.body_margin)), solid
        if not self._parts:
            raise DatasetError(f"{path}: has no geometry except around {self._link}")
        self.note = f"own body: {len(self._parts)} parts of {path}, grown by {body.body_margin:g} m"
        self.note += f"; around the sensor, and left out: {', '.join(around)}" if around else ""

    def _T_camera_part(self, node: str) -> Pose:
        return np.array(self._robot.get_transform(node, self._link), np.float64)

    def covered(self, frame: Frame) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """The pixels (H, W) of a frame whose ray meets the grown body, but for those that measure something
        in front of it; and the depth at which those that measure it leave the first closed part, less the
        margin, 0 where they meet none. Raises FrameError if the joints' positions are not known then."""
        self._robot.update_cfg(self._joints.at(frame))
        depth_m = axial_depth(frame.depth_m, frame.camera, self._conventions)
        covered, free_m = np.zeros(depth_m.shape, bool), np.zeros(depth_m.shape, np.float32)
        nearest_m = np.full(depth_m.shape, np.inf, np.float32)
        for node, (around, solid) in self._parts.items():
            T_part_camera = inverse(self._T_camera_part(node))
            hit = around.render_depth(frame.camera, T_part_camera)
            covered |= (hit > 0) & ((depth_m >= hit) | (depth_m <= 0))
            if solid is not None and hit.any():
                enter = solid.render_depth(frame.camera, T_part_camera)
                leave = solid.render_depth(frame.camera, T_part_camera, enter + np.float32(1e-4))
                nearer = (leave > 0) & (enter < nearest_m)
                nearest_m[nearer], free_m[nearer] = enter[nearer], leave[nearer]
        return covered, np.maximum(free_m - np.float32(self._margin_m), 0) * (covered & (depth_m > 0))


def _mesh_file(urdf: Path, fname: str) -> str:
    """The file of a mesh that a URDF names: a path from its folder, or one of a package around it."""
    name = fname.removeprefix("file://")
    inside = name.removeprefix("package://")
    parents = urdf.absolute().parents
    places = [urdf.parent / name]
    if inside != name:
        places = [folder / rest for folder in parents for rest in (inside, inside.partition("/")[2])]
    found = next((place for place in places if is_file(place)), None)
    if found is None:
        raise DatasetError(
            f"{urdf}: the mesh {fname} is missing; it was looked for from {parents[0]} upwards"
        )
    return str(found)


def _is_around(mesh: TriangleMesh, point: Floats, margin_m: float) -> bool:
    """True if a point (3,) lies in a closed mesh, or within a margin of it: by the solid angle of the
    triangles (Van Oosterom and Strackee, 1983)."""
    closest = library("trimesh", "meshes need", "mesh", DatasetError).triangles.closest_point
    corners = mesh.corners
    near = np.linalg.norm(closest(corners, np.broadcast_to(point, (len(corners), 3))) - point, axis=1)
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(each, axis=1) for each in (a, b, c))
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (a * c).sum(1) * lb
    angle = 2 * np.arctan2((a * np.cross(b, c)).sum(1), below).sum()
    return bool(near.min() <= margin_m or abs(angle) > 2 * np.pi)


def grown(mesh: TriangleMesh, margin_m: float) -> TriangleMesh:
    """A surface around all that lies within a margin of a mesh's triangles, and their own. Round sides are
    polyhedra inscribed in it, so that no ray meets it that passes the mesh at more than the margin."""
    points, first = np.unique(np.round(mesh.vertices, 7), axis=0, return_inverse=True)
    faces = first.reshape(-1)[mesh.triangles]
    sides = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    area = np.linalg.norm(sides, axis=1)
    faces, normals = faces[area > 1e-14], sides[area > 1e-14] / area[area > 1e-14, None]
    soup = [points[faces]]
    if margin_m <= 0:
        return _of_soup(soup)
    soup += [points[faces] + sign * margin_m * normals[:, None] for sign in (-1, 1)]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    ends, begins, counts = np.unique(edges[order], axis=0, return_index=True, return_counts=True)
    owner = order // 3
    one, other = normals[owner[begins]], normals[owner[np.minimum(begins + 1, len(owner) - 1)]]
    other = np.where((one * other).sum(1, keepdims=True) < 0, -other, other)
    bent = np.arccos(np.clip((one * other).sum(1), -1, 1))
    sharp = (counts != 2) | (bent > _ROUND)
    soft = ~sharp & (bent > _FLAT)
    for sign in (-1, 1):
        soup += _bridges(points[ends[soft]], sign * margin_m * one[soft], sign * margin_m * other[soft])
    soup += [_tubes(points[ends[sharp]], margin_m)]
    ball = library("trimesh", "meshes need", "mesh", DatasetError).creation.icosphere
    for steps, some in ((0, soft), (1, sharp)):  # holes at soft corners are narrow
        corner = ball(steps, margin_m)
        soup += [points[np.unique(ends[some])][:, None, None] + corner.vertices[corner.faces]]
    return _of_soup(soup)


def _bridges(ends: Floats, one: Floats, other: Floats) -> list[Floats]:
    """Triangles (N, 3, 3) between the offsets (N, 3) of the two faces along edges (N, 2, 3)."""
    a, b = ends[:, 0], ends[:, 1]
    middle = one + other
    middle *= (np.linalg.norm(one, axis=1) / np.linalg.norm(middle, axis=1))[:, None]
    found = []
    for p, q in ((one, middle), (middle, other)):
        found += [np.stack([a + p, b + p, b + q], 1), np.stack([a + p, b + q, a + q], 1)]
    return found


def _tubes(ends: Floats, radius_m: float) -> Floats:
    """Triangles (M, 3, 3) of tubes around edges (N, 2, 3)."""
    along = ends[:, 1] - ends[:, 0]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    helper = np.eye(3)[np.abs(along).argmin(axis=1)] if len(along) else along
    u = np.cross(along, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    angle = np.arange(0, 2 * np.pi - 1e-9, _STEP)
    v = np.cross(along, u)
    ring = radius_m * (np.cos(angle)[:, None, None] * u + np.sin(angle)[:, None, None] * v)
    beside = np.roll(ring, -1, axis=0)
    a, b = ends[:, 0], ends[:, 1]
    quads = [np.stack([a + ring, b + ring, b + beside], 2), np.stack([a + ring, b + beside, a + beside], 2)]
    return np.concatenate(quads).reshape(-1, 3, 3)


def _of_soup(soup: list[Floats]) -> TriangleMesh:
    corners = np.concatenate([each.reshape(-1, 3, 3) for each in soup])
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3))
