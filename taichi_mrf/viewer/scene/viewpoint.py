"""From where browsers look at the map: a sensible first view, and the view that follows the camera."""

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.geometry.up import Up, up_vector

_GROWTH = 1.2
"""The first view is chosen anew when the map has grown by this factor."""

_PANEL_SHARE = 0.2
"""How far the map's middle lies left of the window's, as a share of the map's size: the panel covers the
right."""

_BEHIND_M, _ABOVE_M, _AHEAD_M = 1.5, 0.7, 2.0


class ViewpointController:
    """Owns the cameras of the browsers, as far as the page moves them."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self.up: Up = (2, 1)
        self._camera: Pose | None = None
        self._seen_size = 0.0
        self._view: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._placed: dict[int, NDArray[np.float64]] = {}

    def set_up(self, up: Up) -> None:
        """Which way is up, from the first keyframe on."""
        self.up = up
        self._seen_size, self._view = 0.0, None
        self._server.scene.set_up_direction(up_vector(up))

    def joined(self, client: int) -> None:
        """Give a new browser the view that the others began with, once there is one."""
        handle = self._server.get_clients().get(client)
        if handle is not None:
            self._placed[client] = handle.camera.position
            if self._view is not None:
                self._point(handle, *self._view)

    def camera_moved(self, T_world_camera: Pose, follow: bool) -> None:
        """Remember the mapping camera, and look over its shoulder if ``follow``."""
        self._camera = T_world_camera
        if follow:
            self.follow()

    def follow(self) -> None:
        """Look over the mapping camera's shoulder, if there is one."""
        if self._camera is None:
            return
        T_world_camera = self._camera
        position, forward = T_world_camera[:3, 3], T_world_camera[:3, 2]
        up = up_vector(self.up)
        eye, target = position - _BEHIND_M * forward + _ABOVE_M * up, position + _AHEAD_M * forward
        for client in self._server.get_clients().values():
            self._point(client, eye, target)

    def look_at_everything(self) -> None:
        """Choose the view anew, for everybody: what there is to see has changed."""
        self._seen_size = 0.0
        for id, client in self._server.get_clients().items():
            self._placed[id] = client.camera.position

    def map_grew(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Look at the whole box from ``low`` to ``high`` (metres): those who come later, and those who have
        not moved their view yet."""
        size = float(np.linalg.norm(high - low))
        if size < _GROWTH * self._seen_size:
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
        right = np.cross(up, aside) / np.linalg.norm(aside)
        target = centre + _PANEL_SHARE * size * right
        eye = target + 0.5 * size * aside / np.linalg.norm(aside) + 0.7 * size * up
        self._view = eye, target
        start = self._server.initial_camera
        start.position, start.look_at = eye, target
        for id, client in self._server.get_clients().items():
            if np.allclose(client.camera.position, self._placed.get(id, np.inf), atol=1e-3):
                self._point(client, eye, target)

    def _point(
        self, client: viser.ClientHandle, eye: NDArray[np.float64], target: NDArray[np.float64]
    ) -> None:
        with client.atomic():
            client.camera.up_direction = up_vector(self.up)
            client.camera.position = eye
            client.camera.look_at = target
        self._placed[client.client_id] = eye
