"""Keyframes that the page keeps, and in the scene: small frusta or rings with their depth images, the
camera's path, the current camera; and the target of a click into the scene: a voxel, or a pixel of a
keyframe's picture."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
import viser.transforms as vtf
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.origins import origins_of
from taichi_mrf.viewer.messages import CurrentCamera, KeyframeInfo
from taichi_mrf.viewer.scene.coloring import pale
from taichi_mrf.viewer.scene.widgets import change

FRUSTUM_M = 0.075
"""Distance of a frustum's picture from its camera, metres."""

RING_M = 0.2
"""Radius of the rings of a lidar, whose maps are of larger places, metres."""

_GIZMO_M, _GIZMO_OF_MAP = 0.5, 0.05
"""Least length of a gizmo's arrows, metres, and their length over the diagonal of a large map."""

MOST_FROZEN = 50
MOST_WAYPOINTS = 2000
LEAST_TO_MERGE = 4096
"""From this number on, the bricks that dropped keyframes crossed are merged."""

_COLORS = {"on": (38, 130, 142), "off": (170, 170, 170), "frozen": (70, 100, 190)}
_CHOSEN = (230, 0, 126)
_PATH = (230, 0, 126)
_AHEAD = (190, 195, 202)
CLOSED = 3.0
"""The first and the last column meet if their directions differ by less than so many columns."""


def placement(T_world_camera: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A pose as viser takes it: the rotation as a unit quaternion, w first, and the position in metres."""
    wxyz = np.asarray(vtf.SO3.from_matrix(T_world_camera[:3, :3]).wxyz, np.float64)
    return wxyz, T_world_camera[:3, 3]


def draw_lines(
    scene: viser.SceneApi, name: str, lines: ArrayLike, color: Any, thickness: float = 2.0, **place: Any
) -> None:
    """Draw lines (n, 2, 3), in metres, as wide on the screen wherever they are; ``color`` is RGB, or one for
    each end (n, 2, 3)."""
    points = np.asarray(lines, np.float32)
    scene.add_line_segments(name, points, color, thickness=thickness, thickness_units="screen", **place)


class ShownKeyframes:
    """The keyframes that the page keeps, by number: all that can be changed, and the latest frozen ones. Of
    older frozen keyframes only positions and crossed bricks are kept, so that the memory of an endless run
    stays bounded."""

    def __init__(self) -> None:
        self.keyframes: dict[int, KeyframeInfo] = {}
        self._old_path: list[tuple[bool, float, NDArray[np.float64]]] = []  # of earlier maps or not, stamp
        self._old_crossed: list[NDArray[np.int32]] = []
        self._merged = 0
        self._every, self._forgotten = 1, 0

    def put(self, keyframe: KeyframeInfo) -> list[int]:
        """Keep a keyframe that is new or has changed; returns the numbers of keyframes that are forgotten for
        it."""
        self.keyframes[keyframe.id] = keyframe
        frozen = [id for id in sorted(self.keyframes) if self.keyframes[id].state == "frozen"]
        forgotten = frozen[: max(0, len(frozen) - MOST_FROZEN)]
        for id in forgotten:
            self._forget(id)
        return forgotten

    def path(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The camera's path, lines (n, 2, 3) in metres, world, oldest first, and the stamps (n,) of their
        ends; a long path is thinned out. None leads from an earlier map's last keyframe to the first after
        it."""
        known = (self.keyframes[id] for id in sorted(self.keyframes))
        path = [*self._old_path, *((k.earlier, k.stamp_s, k.T_world_camera[:3, 3]) for k in known)]
        steps = [(a, b, s) for (before, _, a), (after, s, b) in itertools.pairwise(path) if before == after]
        lines = np.array([step[:2] for step in steps], np.float64).reshape(-1, 2, 3)
        return lines, np.array([step[2] for step in steps])

    def crossed(self) -> list[NDArray[np.int32]]:
        """Bricks (n, 3) that rays of keyframes cross; keyframes that are off are left out."""
        seen = [keyframe.crossed for keyframe in self.keyframes.values() if keyframe.state != "off"]
        return [*self._old_crossed, *seen]

    def _forget(self, id: int) -> None:
        keyframe = self.keyframes.pop(id)
        self._old_crossed.append(keyframe.crossed)
        # Merged only when they have doubled, so that each brick is sorted a few times at most.
        if sum(map(len, self._old_crossed)) > max(2 * self._merged, LEAST_TO_MERGE):
            self._old_crossed = [np.unique(np.concatenate(self._old_crossed), axis=0).astype(np.int32)]
            self._merged = len(self._old_crossed[0])
        if self._forgotten % self._every == 0:
            self._old_path.append((keyframe.earlier, keyframe.stamp_s, keyframe.T_world_camera[:3, 3]))
        self._forgotten += 1
        if len(self._old_path) > MOST_WAYPOINTS:
            self._old_path = self._old_path[::2]
            self._every *= 2


class KeyframeLayer:
    """Owns the scene nodes /keyframes, /path, /camera and /gizmo."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._root = scene.add_frame("/keyframes", show_axes=False)
        self.roster = ShownKeyframes()
        self.chosen: int | None = None
        self.gizmo: viser.TransformControlsHandle | None = None
        self.held = False
        """True while a user drags the gizmo."""
        # viser remembers each name that was ever removed, so names are used again.
        self._places: dict[int, int] = {}
        self._free_places: list[int] = []
        self._pictures = self._path = True
        self._until_s: float | None = None

    @property
    def keyframes(self) -> dict[int, KeyframeInfo]:
        """The known keyframes, by number."""
        return self.roster.keyframes

    def put(self, keyframe: KeyframeInfo) -> None:
        """Show a keyframe that is new or has changed."""
        forgotten = self.roster.put(keyframe)
        for id in forgotten:
            self._scene.remove_by_name(f"{self._name(id)}/picture")
            self._free_places.append(self._places.pop(id))  # its node is the next one's
        if self.chosen in forgotten:
            self.release()
            self.chosen = min(self.keyframes)
        if keyframe.id in self.keyframes:
            self._draw(keyframe)
        if keyframe.id == self.chosen:
            self._place_gizmo(keyframe)

    def choose(self, id: int | None) -> None:
        """Mark a keyframe as the one that the buttons change."""
        before, self.chosen = self.chosen, id
        for each in (before, id):
            if each in self._places:
                self._draw(self.keyframes[each])

    def show(self, keyframes: bool, pictures: bool, path: bool) -> None:
        """Show or hide the frusta, the depth images in them, and the path with the current camera."""
        change(self._root, visible=keyframes)
        self._path = path
        self._show_path()
        if pictures != self._pictures:
            self._pictures = pictures
            for id in list(self._places):
                self._draw(self.keyframes[id])

    def show_until(self, stamp_s: float | None) -> None:
        """Highlight the camera's path up to a time, and hide the keyframes after it and the camera of now;
        None: all of it."""
        if stamp_s != self._until_s:
            self._until_s = stamp_s
            self.draw_path()
            self._show_path()
            for id in self._places:
                shown = self._is_until(self.keyframes[id])
                change(self._scene.get_handle_by_name(self._name(id)), visible=shown)

    def _is_until(self, keyframe: KeyframeInfo) -> bool:
        return self._until_s is None or keyframe.stamp_s <= self._until_s

    def draw_path(self) -> None:
        """Draw the camera's path through all keyframes, in the order of their numbers."""
        lines, stamps_s = self.roster.path()
        if len(lines):
            ahead = np.zeros(len(lines), bool) if self._until_s is None else stamps_s > self._until_s
            colors = np.where(ahead[:, None], _AHEAD, _PATH).astype(np.uint8)
            colors = np.repeat(colors[:, None], 2, axis=1)
            draw_lines(self._scene, "/path", lines, colors, visible=self._path)

    def show_camera(self, camera: CurrentCamera) -> None:
        """Show the camera of the latest frame."""
        self._outline("/camera", camera.T_world_camera, camera.camera, _PATH, thickness=3.0, enlarged=2.0)
        self._show_path()

    def _show_path(self) -> None:
        for name, shown in (("/path", self._path), ("/camera", self._path and self._until_s is None)):
            node = self._scene.get_handle_by_name(name)
            if node is not None:
                change(node, visible=shown)

    def grab(self, map_m: ArrayLike | None) -> viser.TransformControlsHandle:
        """Put a gizmo on the chosen keyframe. There must be one. ``map_m`` (2, 3) are the lowest and highest
        corner of the map, which the gizmo grows with."""
        self.release()
        assert self.chosen is not None
        wxyz, position = placement(self.keyframes[self.chosen].T_world_camera)
        across_m = 0.0 if map_m is None else float(np.linalg.norm(np.ptp(map_m, axis=0)))
        length_m = max(_GIZMO_M, _GIZMO_OF_MAP * across_m)
        self.gizmo = self._scene.add_transform_controls(
            "/gizmo", scale=length_m, depth_test=False, wxyz=wxyz, position=position
        )
        return self.gizmo

    def release(self) -> None:
        """Take the gizmo away."""
        self.held = False
        if self.gizmo is not None:
            self.gizmo.remove()
            self.gizmo = None

    def _place_gizmo(self, keyframe: KeyframeInfo) -> None:
        """Move the gizmo to its keyframe, unless a user is dragging it."""
        if self.gizmo is None or self.held:
            return
        if keyframe.state == "frozen":
            self.release()
            return
        self.gizmo.wxyz, self.gizmo.position = placement(keyframe.T_world_camera)

    def clear(self) -> None:
        """Remove all keyframes."""
        self.release()
        for id in self._places:
            self._scene.remove_by_name(self._name(id))
        self._places.clear()
        self._free_places.clear()
        self.roster = ShownKeyframes()
        self.chosen = self._until_s = None
        for name in ("/path", "/camera"):
            self._scene.remove_by_name(name)

    def _draw(self, keyframe: KeyframeInfo) -> None:
        id, is_chosen = keyframe.id, keyframe.id == self.chosen
        if id not in self._places:
            self._places[id] = self._free_places.pop() if self._free_places else len(self._places)
        name = self._name(id)
        picture = keyframe.picture if self._pictures and keyframe.state != "off" else None
        color = _COLORS[keyframe.state]
        if keyframe.earlier:
            color, picture = tuple(pale(color).tolist()), None if picture is None else pale(picture)
        flat = isinstance(keyframe.camera, PinholeCamera)
        self._outline(
            name,
            keyframe.T_world_camera,
            keyframe.camera,
            _CHOSEN if is_chosen else color,
            thickness=3.0 if is_chosen else 1.5,
            picture=picture if flat else None,
        )
        change(self._scene.get_handle_by_name(name), visible=self._is_until(keyframe))
        if flat or picture is None or picture.shape[:2] != keyframe.camera.shape:
            self._scene.remove_by_name(f"{name}/picture")
        else:
            self._scene.add_point_cloud(
                f"{name}/picture",
                points=on_sphere(keyframe.camera, RING_M).reshape(-1, 3),
                colors=picture.reshape(-1, 3),
                point_size=RING_M / max(keyframe.camera.pixels_per_radian, 1.0),
                point_shape="square",
                precision="float16",
            )

    def _name(self, id: int) -> str:
        return f"/keyframes/{self._places[id]}"

    def _outline(
        self,
        name: str,
        T_world_camera: Pose,
        camera: Camera,
        color: tuple[int, int, int],
        thickness: float,
        enlarged: float = 1.0,
        picture: NDArray[np.uint8] | None = None,
    ) -> None:
        """Draw a frustum, or what a camera without a flat image sees on a sphere: rings."""
        wxyz, position = placement(T_world_camera)
        if not isinstance(camera, PinholeCamera):
            rings = border(camera, enlarged * RING_M)
            draw_lines(self._scene, name, rings, color, thickness, wxyz=wxyz, position=position)
            return
        fov, aspect = _view_angles(camera)
        self._scene.add_camera_frustum(
            name,
            fov,
            aspect,
            scale=enlarged * _frustum_scale(fov, aspect),
            thickness=thickness,
            thickness_units="screen",
            color=color,
            image=picture,
            format="jpeg",
            jpeg_quality=70,
            cast_shadow=False,
            receive_shadow=False,
            wxyz=wxyz,
            position=position,
        )


def _view_angles(camera: PinholeCamera) -> tuple[float, float]:
    """Vertical field of view in radians, and width over height at unit depth."""
    return 2 * float(np.arctan(camera.height / 2 / camera.fy)), (camera.width / camera.fx) / (
        camera.height / camera.fy
    )


def _frustum_scale(fov: float, aspect: float) -> float:
    """viser scales a frustum to one unit of volume; this is the scale that puts its picture at FRUSTUM_M."""
    y = np.tan(fov / 2)
    return FRUSTUM_M * float(np.cbrt(y * y * aspect / 3))


def on_sphere(camera: Camera, radius_m: float) -> NDArray[np.float32]:
    """Pixels of a camera on a sphere around it, (H, W, 3), metres, camera frame. Each pixel of a moving
    camera lies as far from where its ray starts."""
    rays, origins = camera.rays(), origins_of(camera)
    points = radius_m * rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return (points if origins is None else points + origins).astype(np.float32)


def border(camera: Camera, radius_m: float) -> NDArray[np.float32]:
    """The border of a camera's image on the sphere, as line segments (n, 2, 3): two rings if it sees all
    around, otherwise one closed line."""
    points = on_sphere(camera, radius_m)
    middle = points[len(points) // 2]
    steps = np.linalg.norm(np.diff(middle, axis=0), axis=-1)
    gap = float(np.linalg.norm(middle[-1] - middle[0]))
    all_around = len(middle) > 3 and gap < CLOSED * float(np.median(steps))
    if all_around:
        lines = [np.concatenate([row, row[:1]]) for row in (points[0], points[-1])]
    else:
        lines = [points[0], points[:, -1], points[-1], points[:, 0]]
    return np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])


def hits_of_sphere(origin: ArrayLike, direction: ArrayLike, radius_m: float) -> list[float]:
    """How far along a unit ``direction`` a ray meets a sphere around zero, nearest first, in metres."""
    start, along = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    nearest = -float(start @ along)
    under = radius_m**2 - float(start @ start) + nearest**2
    if under < 0:
        return []
    half = float(np.sqrt(under))
    return [t for t in (nearest - half, nearest + half) if t > 0]


@dataclass(frozen=True)
class Pixel:
    """A pixel of a keyframe's picture, and its distance from the viewpoint in metres. ``point`` (3,), in the
    world, is on the picture if that is not flat; its pixels are then not those of the keyframe's image."""

    keyframe: int
    u: float
    v: float
    range_m: float
    point: NDArray[np.float64] | None = None


def first_voxel(
    origin: ArrayLike, direction: ArrayLike, centres: NDArray[np.float64], side_m: float
) -> tuple[NDArray[np.float64], float] | None:
    """The centre of the nearest voxel that a ray hits, and its range in metres, of those with these centres
    (n, 3) and this side.

    The ray hits a voxel if it passes the centre at no more than half the diagonal of a face: about the size
    of the voxel's point on the screen.
    """
    start = np.asarray(origin, np.float64)
    along = np.asarray(direction, np.float64)
    along = along / np.linalg.norm(along)
    offset = centres - start
    range_m = offset @ along
    aside = np.linalg.norm(offset - range_m[:, None] * along, axis=1)
    met = np.flatnonzero((range_m > 0) & (aside <= np.sqrt(0.5) * side_m))
    if not len(met):
        return None
    first = met[np.argmin(range_m[met])]
    return centres[first], float(range_m[first])


def framed(
    camera: viser.CameraHandle, corners: NDArray[np.float64], points: NDArray[np.float64], side_m: float
) -> NDArray[np.float64]:
    """Of some points (n, 3) in metres, world, those that a browser's camera sees in a rectangle with these
    corners (2, 2), shares of the window. Of voxels of this side, those count that others do not hide; a
    slanted surface is some of them deep."""
    local = (points - camera.position) @ np.asarray(vtf.SO3(camera.wxyz).as_matrix())
    tall = np.tan(0.5 * camera.fov)
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = local[:, :2] / local[:, 2:]
    shares = 0.5 + 0.5 * slopes / (tall * camera.aspect, tall)
    inside = (local[:, 2] > 0) & ((shares >= corners[0]) & (shares <= corners[1])).all(axis=1)
    points, slopes, range_m = points[inside], slopes[inside], local[inside, 2]
    if not len(points):
        return points
    cells = np.floor(slopes * range_m.min() / (2.0 * side_m))
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    nearest_m = np.full(cell.max() + 1, np.inf)
    np.minimum.at(nearest_m, cell.reshape(-1), range_m)
    return points[range_m <= nearest_m[cell.reshape(-1)] + 4.0 * side_m]


def first_pixel(origin: ArrayLike, direction: ArrayLike, keyframes: Iterable[KeyframeInfo]) -> Pixel | None:
    """The pixel that a ray hits first, of all pictures of keyframes."""
    start = np.asarray(origin, np.float64)
    along = np.asarray(direction, np.float64)
    along = along / np.linalg.norm(along)
    hits = [hit for keyframe in keyframes if (hit := _pixel(start, along, keyframe)) is not None]
    return min(hits, key=lambda hit: hit.range_m, default=None)


def _pixel(start: NDArray[np.float64], along: NDArray[np.float64], keyframe: KeyframeInfo) -> Pixel | None:
    """The pixel where the ray crosses the picture, which stands FRUSTUM_M in front of the keyframe's
    camera, or lies on a sphere of radius RING_M around it."""
    R, t = keyframe.T_world_camera[:3, :3], keyframe.T_world_camera[:3, 3]
    origin, direction = R.T @ (start - t), R.T @ along
    if not isinstance(keyframe.camera, PinholeCamera):
        return _pixel_on_sphere(keyframe, origin, direction)
    if abs(direction[2]) < 1e-9:
        return None
    range_m = (FRUSTUM_M - origin[2]) / direction[2]
    x, y = (origin + range_m * direction)[:2] / FRUSTUM_M
    camera = keyframe.camera
    u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
    inside = -0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5
    return Pixel(keyframe.id, float(u), float(v), float(range_m)) if inside and range_m > 0 else None


def _pixel_on_sphere(
    keyframe: KeyframeInfo, origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> Pixel | None:
    """The nearer of the sphere's sides that has a pixel where the ray, in the camera frame, crosses it."""
    if origins_of(keyframe.camera) is not None:
        return _pixel_of_moving(keyframe, origin, direction)
    for range_m in hits_of_sphere(origin, direction, RING_M):
        point = origin + range_m * direction
        u, v, _ = keyframe.camera.project(point[None])[0]
        if not np.isnan(u):
            R, t = keyframe.T_world_camera[:3, :3], keyframe.T_world_camera[:3, 3]
            return Pixel(keyframe.id, float(u), float(v), range_m, R @ point + t)
    return None


def _pixel_of_moving(
    keyframe: KeyframeInfo, origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> Pixel | None:
    """The pixel that the ray, in the camera frame, passes at no more than about a pixel's width, on the
    nearer side of what is a sphere if the camera does not move."""
    points = on_sphere(keyframe.camera, RING_M).reshape(-1, 3).astype(np.float64)
    range_m = (points - origin) @ direction
    aside = np.linalg.norm(points - origin - range_m[:, None] * direction, axis=1)
    width_m = RING_M * np.sqrt(4 * np.pi / len(points))
    met = np.flatnonzero((range_m > 0) & (aside < width_m))
    if not len(met):
        return None
    near = met[range_m[met] < range_m[met].min() + width_m]
    best = int(near[np.argmin(aside[near])])
    v, u = divmod(best, keyframe.camera.width)
    R, t = keyframe.T_world_camera[:3, :3], keyframe.T_world_camera[:3, 3]
    return Pixel(keyframe.id, float(u), float(v), float(range_m[best]), R @ points[best] + t)
