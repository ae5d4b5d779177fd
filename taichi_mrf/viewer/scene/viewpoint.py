"""The viewpoint of the browsers: a view of the whole map at first, and a view that follows the camera."""

import itertools
from collections.abc import Callable
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

_GROWTH, _MORE_POINTS = 1.1, 1.25
"""The first view is chosen again when the map has grown by the first factor, or its number of voxels by the
second one."""

_UNTOLD = 4
"""A browser may still tell of so many of its last places while it has been sent to a new one."""

_ASPECT = 1.6
"""Width over height of a usual window."""

PANEL_OF_WINDOW, _STRIP_OF_WINDOW, _SHEET_OF_WINDOW = 0.27, 0.12, 0.45
"""Share of a usual window's width that the panel covers on the right, of its height that the strip of time
covers at the foot; and of a phone's height that the panel covers there while it is open."""

_MARGIN = 1.08
"""The eye's distance over the least one."""

_STRAY = 0.01
"""Share of what is seen that a view may leave out beyond each edge of the window: the farthest specks."""

_MOST_FITTED = 100_000
"""Of about so many points at most it is computed how far away a view must be."""

_LEAST_M = 1.0
"""Least distance of a view from the middle of what is seen, which may be a single voxel."""

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
    """From where a browser looks: metres, world. A view of points ``seen`` (n, 3) goes back and aside until
    nearly all of them are in the part of the window that nothing covers; one without suits every window."""

    eye_m: NDArray[np.float64]
    target_m: NDArray[np.float64]
    up: NDArray[np.float64]
    fov_rad: float = _WIDE_RAD
    seen: NDArray[np.float64] | None = None

    @property
    def drawn_m(self) -> tuple[float, float]:
        """The range of distances that are drawn."""
        if self.fov_rad > 2 * _LONG_RAD:
            return _CLIPPED_M
        distance = float(np.linalg.norm(self.eye_m - self.target_m))
        return min(distance / 100, 0.5), 100 * distance

    def within(self, aspect: float, foot: float) -> "_View":
        """The view in a window of this width over height, of which a share at the ``foot`` is covered."""
        if self.seen is None or not len(self.seen):
            return self
        seen = self.seen[:: 1 + len(self.seen) // _MOST_FITTED]
        towards = _unit(self.eye_m - self.target_m)
        right = _unit(np.cross(self.up, towards))
        axes = np.stack([right, np.cross(towards, right), towards])
        panel = PANEL_OF_WINDOW if aspect > 1 else 0.0
        eye = fitting_eye(seen @ axes.T, aspect, self.fov_rad, panel, foot)
        target = np.array([*eye[:2], float(np.median(seen @ towards))])
        eye[2] = max(float(eye[2]), target[2] + _LEAST_M)
        return replace(self, eye_m=eye @ axes, target_m=target @ axes)


class ViewpointController:
    """Moves the cameras of the browsers."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self.up: Up = (2, 1)
        self.has_strip = False
        """True if the page has a strip along the foot of wide windows."""
        self._camera: Pose | None = None
        self._forwards = np.zeros(3)
        self._following = False
        self._seen_size, self._seen_number = 0.0, 1
        self._view: _View | None = None
        self._pictured: _View | None = None
        self._beside = False
        self._placed: dict[int, list[NDArray[np.float64]]] = {}  # the last places of browsers, newest first

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
        self._placed[client] = [handle.camera.position]
        view = self._shared_view()
        if view is not None:
            self._point(handle, view)

    def start_over(self) -> None:
        """Forget which users have moved the view: another place is shown from now on."""
        self._placed = {id: [client.camera.position] for id, client in self._server.get_clients().items()}

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
            opening = self._shared_view()
            if opening is not None:
                self._point(handle, opening, asked=True)
            return
        camera, up = handle.camera, up_vector(self.up)
        front = -np.eye(3)[max(axis for axis in range(3) if axis != self.up[0])]
        sides = {"top": up + _UPRIGHT * front, "front": front, "side": np.cross(up, front)}
        towards = sides[side] if side in sides else camera.position - camera.look_at
        fov_rad = _LONG_RAD if side in sides else camera.fov
        self._point(handle, _View(towards, np.zeros(3), up, fov_rad, points), asked=True)
        del self._placed[client]

    def look_at_everything(self) -> None:
        """Choose the view again at the next :meth:`map_grew`; a view that a user has chosen stays."""
        self._seen_size, self._pictured = 0.0, None

    def look_as_pictured(self, view: SurfaceView, vertices: NDArray[np.float64]) -> None:
        """Look at the surface with these ``vertices`` (n, 3), metres, world, from where the picture of a run
        does, until :meth:`look_at_everything`: browsers that connect later, and those whose user has not
        moved the view."""
        if self._pictured is not None:
            return
        self._pictured = _View(view.eye_m, view.target_m, view.up, view.fov_rad, vertices)
        if not self._beside:
            self._begin_with(self._pictured)

    def look_beside(self, on: bool) -> None:
        """Look at a second map, too, which has come, at the next :meth:`map_grew`; or as before it came."""
        self._seen_size, self._beside = 0.0, on
        if self._pictured is not None and not on:
            self._begin_with(self._pictured)

    def map_grew(
        self,
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        seen: Callable[[], NDArray[np.float64]] = lambda: np.zeros((0, 3)),
        number: int = 0,
    ) -> None:
        """Look at the points (n, 3) that are ``seen`` in the box from ``low`` to ``high`` (metres, world), or
        else at the whole box: browsers that connect later, and those whose user has not moved the view. It is
        chosen again when the box or the ``number`` of points has grown. While the view follows the camera it
        stays there."""
        size = float(np.linalg.norm(high - low))
        grown = size >= _GROWTH * self._seen_size or number >= _MORE_POINTS * self._seen_number
        if not grown or (self._pictured is not None and not self._beside):
            return
        self._seen_size, self._seen_number = size, max(number, 1)
        centre = (low + high) / 2
        up = up_vector(self.up)
        # Across the shorter level side, so that the longer one lies across the screen, and a little aslant.
        level = [axis for axis in range(3) if axis != self.up[0]]
        short, long = sorted(level, key=lambda axis: high[axis] - low[axis])
        aside = np.zeros(3)
        camera = centre if self._camera is None else self._camera[:3, 3]
        aside[short], aside[long] = np.sign(camera[short] - centre[short]) or 1.0, 0.35
        eye = centre + 0.5 * _unit(aside) + 0.7 * up
        points = seen()
        corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
        self._begin_with(_View(eye, centre, up, seen=points if len(points) else corners))

    def _begin_with(self, view: _View) -> None:
        """Show this view to browsers that connect later, and to those whose user has not moved theirs."""
        self._view = view
        self._begin_there()
        if self._following:
            return
        for id, client in self._server.get_clients().items():
            if any(np.allclose(client.camera.position, at, atol=1e-3) for at in self._placed.get(id, ())):
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
            view = view.within(_ASPECT, self._foot(_ASPECT))
            start = self._server.initial_camera
            start.position, start.look_at = view.eye_m, view.target_m
            start.up, start.fov = view.up, view.fov_rad

    def _behind_camera(self) -> _View | None:
        """The view that looks over the camera's shoulder; None before the first frame."""
        if self._camera is None:
            return None
        position, forward = self._camera[:3, 3], self._forwards
        up = up_vector(self.up)
        return _View(position - _BEHIND_M * forward + _ABOVE_M * up, position + _AHEAD_M * forward, up)

    def _point(self, client: viser.ClientHandle, view: _View, asked: bool = False) -> None:
        """Show a view to a browser, whose user has ``asked`` for it or not."""
        view = view.within(client.camera.aspect, self._foot(client.camera.aspect, asked))
        with client.atomic():
            client.camera.up_direction = view.up
            client.camera.position = view.eye_m
            client.camera.look_at = view.target_m
            client.camera.fov = view.fov_rad
            client.camera.near, client.camera.far = view.drawn_m
        places = self._placed.get(client.client_id, [])
        self._placed[client.client_id] = [view.eye_m, *places[: _UNTOLD - 1]]

    def _foot(self, aspect: float, asked: bool = False) -> float:
        """Share of a window's height that is covered at its foot. On a phone the panel is folded at first;
        who asks for a view has opened it."""
        if aspect > 1:
            return _STRIP_OF_WINDOW if self.has_strip else 0.0
        return _SHEET_OF_WINDOW if asked else 0.0


def fitting_eye(
    points: NDArray[np.float64], aspect: float, fov_rad: float, covered: float, foot: float = 0.0
) -> NDArray[np.float64]:
    """The nearest eye (3,) that sees nearly all points (n, 3) in a window, looking along -z, with x to the
    right and y upwards. Of the window's width the share ``covered`` is hidden on its right, of its height the
    share ``foot`` at its lower edge.

    An edge of slope s shows a point whose x - x_eye is at most s * (z_eye - z): that is, s * z_eye + x_eye is
    at least x + s * z, of all points but the stray ones; likewise for the other edges."""
    tall = np.tan(0.5 * fov_rad) / _MARGIN
    wide, z = aspect * tall, points[:, 2]
    edges = []
    across = points[:, 0], wide * (1 - 2 * covered), wide
    upwards = points[:, 1], tall, tall * (1 - 2 * foot)
    for along, right, left in (across, upwards):
        high, low = np.quantile([right * z + along, left * z - along], 1 - _STRAY, axis=1)
        edges.append((high, low, right, left))
    z_eye = max((high + low) / (right + left) for high, low, right, left in edges)
    x_y = [0.5 * (high - right * z_eye - low + left * z_eye) for high, low, right, left in edges]
    return np.array([*x_y, z_eye])


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)
