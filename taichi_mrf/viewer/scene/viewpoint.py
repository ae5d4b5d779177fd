"""The viewpoint of the browsers: a view of the whole map at first, and a view that follows the camera."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.geometry.up import Up, up_vector
from taichi_mrf.viewer.messages import SurfaceView

Side = Literal["home", "top", "front", "side", "fit"]
"""From where to look at the map: *home* is the opening view, *fit* the direction in which a browser looks."""

_GROWTH = 1.2
"""The first view is chosen again when the map has grown by this factor."""

_BACK, _ASIDE = 1.25, 0.2
"""The page's view is so many times as far away as the picture's, and moved aside by this share of half the
window's width: the panel covers the right side."""

_ASPECT = 1.6
"""Width over height of a usual window."""

PANEL_OF_WINDOW, _MARGIN = 0.27, 1.08
"""Share of a usual window's width that the panel covers; and the eye's distance over the least one."""

_STRAY = 0.01
"""Share of what is seen that a view may leave out beyond each edge of the window: the farthest specks."""

_LEAST_M = 1.0
"""Least distance of such a view from the middle of what is seen, which may be a single voxel."""

_UPRIGHT = 1e-3
"""The view from the top is so much off the vertical that the front is at the window's lower edge."""

_BEHIND_M, _ABOVE_M, _AHEAD_M = 1.5, 0.7, 2.0
_WIDE_RAD = np.deg2rad(75.0)
"""The vertical field of view, but of the picture's view and of views from a side."""

_LONG_RAD = np.deg2rad(5.0)
"""That of views from a side, which are plans nearly: depth changes the scale by some hundredths."""

_CLIPPED_M = 0.01, 1000.0
"""viser's own range of distances that are drawn. A plan is seen from far away: its range begins later, or the
depth buffer would mix up surfaces centimetres apart, but before viser's background, which is 1 m away."""


@dataclass(frozen=True)
class _View:
    """From where a browser looks: metres, world. A view of the ``whole`` map is moved aside for the panel in
    a wide window, and back in a narrow one; others suit every window."""

    eye_m: NDArray[np.float64]
    target_m: NDArray[np.float64]
    up: NDArray[np.float64]
    fov_rad: float = _WIDE_RAD
    whole: bool = False
    drawn_m: tuple[float, float] = _CLIPPED_M

    def within(self, aspect: float) -> "_View":
        """The view in a window of this width over height."""
        if not self.whole:
            return self
        along = self.target_m - self.eye_m
        if aspect <= 1:
            back = max(1.0, _ASPECT * (1 - PANEL_OF_WINDOW) / aspect)
            return replace(self, eye_m=self.target_m - back * along)
        half_m = aspect * np.tan(0.5 * self.fov_rad) * np.linalg.norm(along)
        aside = _ASIDE * half_m * _unit(np.cross(along, self.up))
        return replace(self, eye_m=self.eye_m + aside, target_m=self.target_m + aside)


class ViewpointController:
    """Moves the cameras of the browsers."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self.up: Up = (2, 1)
        self._camera: Pose | None = None
        self._forwards = np.zeros(3)
        self._following = False
        self._seen_size = 0.0
        self._view: _View | None = None
        self._as_pictured = False
        self._placed: dict[int, NDArray[np.float64]] = {}

    def set_up(self, up: Up) -> None:
        """Set which way is up, from the first keyframe on."""
        self.up = up
        self._view = None
        self.look_at_everything()
        self._server.scene.set_up_direction(up_vector(up))

    def joined(self, client: int) -> None:
        """Give a new browser the view that the others have: behind the camera, or of the whole map."""
        handle = self._server.get_clients().get(client)
        if handle is None:
            return
        self._placed[client] = handle.camera.position
        view = self._shared_view()
        if view is not None:
            self._point(handle, view)

    def start_over(self) -> None:
        """Forget which users have moved the view: another place is shown from now on."""
        self._placed = {id: client.camera.position for id, client in self._server.get_clients().items()}

    def camera_moved(self, T_world_camera: Pose, forwards: NDArray[np.float64]) -> None:
        """Store the pose of a camera that looks ``forwards`` (3,) in its own frame, and follow it if
        following is on."""
        self._camera, self._forwards = T_world_camera, T_world_camera[:3, :3] @ forwards
        if self._following:
            self._begin_there()
        self._follow()

    def set_following(self, on: bool) -> None:
        """Keep every browser's view behind the camera from now on, or leave it to the user."""
        if on != self._following:
            self._following = on
            self._begin_there()
            self._follow()

    def look_from(self, client: int, side: Side, points: NDArray[np.float64]) -> None:
        """Show one browser nearly all of some points (n, 3), in metres, world, beside the panel: from a side,
        or from where it looks now, and its user has then chosen a view; or the opening view again."""
        handle = self._server.get_clients().get(client)
        if handle is None:
            return
        if side == "home":
            if self._view is not None:
                self._point(handle, self._view)
            return
        camera, up = handle.camera, up_vector(self.up)
        front = -np.eye(3)[max(axis for axis in range(3) if axis != self.up[0])]
        sides = {"top": up + _UPRIGHT * front, "front": front, "side": np.cross(up, front)}
        towards = _unit(sides[side] if side in sides else camera.position - camera.look_at)
        fov_rad = _LONG_RAD if side in sides else camera.fov
        right = _unit(np.cross(up, towards))
        axes = np.stack([right, np.cross(towards, right), towards])
        covered = PANEL_OF_WINDOW if camera.aspect > 1 else 0.0
        eye = fitting_eye(points @ axes.T, camera.aspect, fov_rad, covered)
        target = np.array([*eye[:2], float(np.median(points @ towards))])
        distance = max(float(eye[2] - target[2]), _LEAST_M)
        eye[2] = target[2] + distance
        drawn_m = (min(distance / 100, 0.5), 100 * distance) if side in sides else (camera.near, camera.far)
        self._point(handle, _View(eye @ axes, target @ axes, up, fov_rad, drawn_m=drawn_m))
        del self._placed[client]

    def look_at_everything(self) -> None:
        """Choose the view again at the next :meth:`map_grew`; a view that a user has chosen stays."""
        self._seen_size, self._as_pictured = 0.0, False

    def look_as_pictured(self, view: SurfaceView) -> None:
        """Look at the surface as the picture of a run does, until :meth:`look_at_everything`: browsers that
        connect later, and those whose user has not moved the view."""
        if self._as_pictured:
            return
        self._as_pictured = True
        along = view.target_m - view.eye_m
        eye_m = view.target_m - _BACK * along
        self._begin_with(_View(eye_m, view.target_m, view.up, view.fov_rad, whole=True))

    def map_grew(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Look at the whole box from ``low`` to ``high`` (metres, world): browsers that connect later, and
        those whose user has not moved the view. While the view follows the camera it stays there."""
        size = float(np.linalg.norm(high - low))
        if size < _GROWTH * self._seen_size or self._as_pictured:
            return
        self._seen_size = size
        centre = (low + high) / 2
        up = up_vector(self.up)
        # Across the shorter level side, so that the longer one lies across the screen, and a little aslant.
        level = [axis for axis in range(3) if axis != self.up[0]]
        short, long = sorted(level, key=lambda axis: high[axis] - low[axis])
        aside = np.zeros(3)
        camera = centre if self._camera is None else self._camera[:3, 3]
        aside[short], aside[long] = np.sign(camera[short] - centre[short]) or 1.0, 0.35
        eye = centre + 0.5 * size * _unit(aside) + 0.7 * size * up
        self._begin_with(_View(eye, centre, up, whole=True))

    def _begin_with(self, view: _View) -> None:
        """Show this view to browsers that connect later, and to those whose user has not moved theirs."""
        self._view = view
        self._begin_there()
        if self._following:
            return
        for id, client in self._server.get_clients().items():
            if np.allclose(client.camera.position, self._placed.get(id, np.inf), atol=1e-3):
                self._point(client, view)

    def _follow(self) -> None:
        view = self._behind_camera() if self._following else None
        if view is not None:
            for client in self._server.get_clients().values():
                self._point(client, view)

    def _shared_view(self) -> _View | None:
        """The view that new browsers get; None before the first frame and keyframe."""
        behind = self._behind_camera() if self._following else None
        return self._view if behind is None else behind

    def _begin_there(self) -> None:
        """Let new browsers begin with the shared view. Pointing them alone is not enough: one that loads
        slowly takes its first view after it was pointed elsewhere."""
        view = self._shared_view()
        if view is not None:
            view, start = view.within(_ASPECT), self._server.initial_camera
            start.position, start.look_at = view.eye_m, view.target_m
            start.up, start.fov = view.up, view.fov_rad

    def _behind_camera(self) -> _View | None:
        """The view that looks over the camera's shoulder; None before the first frame."""
        if self._camera is None:
            return None
        position, forward = self._camera[:3, 3], self._forwards
        up = up_vector(self.up)
        return _View(position - _BEHIND_M * forward + _ABOVE_M * up, position + _AHEAD_M * forward, up)

    def _point(self, client: viser.ClientHandle, view: _View) -> None:
        view = view.within(client.camera.aspect)
        with client.atomic():
            client.camera.up_direction = view.up
            client.camera.position = view.eye_m
            client.camera.look_at = view.target_m
            client.camera.fov = view.fov_rad
            client.camera.near, client.camera.far = view.drawn_m
        self._placed[client.client_id] = view.eye_m


def fitting_eye(
    points: NDArray[np.float64], aspect: float, fov_rad: float, covered: float
) -> NDArray[np.float64]:
    """The nearest eye (3,) that sees nearly all points (n, 3) in a window, looking along -z, with x to the
    right and y upwards. A panel covers a share of the window's width on its right.

    An edge of slope s shows a point whose x - x_eye is at most s * (z_eye - z): that is, s * z_eye + x_eye is
    at least x + s * z, of all points but the stray ones; likewise for the other edges."""
    tall = np.tan(0.5 * fov_rad) / _MARGIN
    wide, z = aspect * tall, points[:, 2]
    edges = []
    for along, right, left in ((points[:, 0], wide * (1 - 2 * covered), wide), (points[:, 1], tall, tall)):
        high, low = np.quantile([right * z + along, left * z - along], 1 - _STRAY, axis=1)
        edges.append((high, low, right, left))
    z_eye = max((high + low) / (right + left) for high, low, right, left in edges)
    x_y = [0.5 * (high - right * z_eye - low + left * z_eye) for high, low, right, left in edges]
    return np.array([*x_y, z_eye])


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)
