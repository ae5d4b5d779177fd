"""Read-only interface of a map, for queries, exporters and evaluation, whatever stores the voxels.

Maps of all methods have it (methods/brick_map.py), and so have a map of another time or by what is occupied
(methods/mrf/map_reading.py) and a box of a map in chunks (methods/chunked_part.py).
"""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.geometry.up import Up
from taichi_mrf.queries.points import checked_points
from taichi_mrf.queries.view import Answer, View
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.system import tensors
from taichi_mrf.voxels.distance_field import DistanceSource
from taichi_mrf.voxels.layers import COLORS
from taichi_mrf.voxels.layout import VOXELS


class Placed(Protocol):
    """Interface of a keyframe, as queries need it: its pose."""

    @property
    def T_world_camera(self) -> Pose: ...


class PixelValues(Protocol):
    """A layer of voxels that pixels feed (voxels/layers.py)."""

    def __bool__(self) -> bool:
        """True if any voxel may have a value."""
        ...

    def at(self, points: ArrayLike) -> NDArray[Any]:
        """Values (N, ...) of the voxels that hold points (N, 3) in metres."""
        ...

    def within(self, slots: NDArray[np.int32]) -> NDArray[Any]:
        """Values of the voxels of some bricks of ``view.pool``, (n,) slots -> (n, 512, ...)."""
        ...


class PixelReader(Protocol):
    """The reading of layers that pixels feed, of a map that has ``pixel_layers``."""

    @property
    def pixel_layers(self) -> Mapping[str, PixelValues]:
        """The layers of voxels that pixels feed, by name (voxels/layers.py)."""
        return {}

    @property
    def has_colors(self) -> bool:
        """True if any voxel may have a colour: a keyframe has been added with a colour image."""
        return bool(self.pixel_layers.get(COLORS))

    @tensors.in_kind("points")
    def colors(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Colours of the voxels at (N, 3) points in metres, (N, 4) uint8: red, green, blue, and how much of
        the voxel was seen, 0 for nothing."""
        layer = self.pixel_layers.get(COLORS)
        return np.zeros((len(checked_points(points)), 4), np.uint8) if layer is None else layer.at(points)

    def colors_in(self, slots: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Colours of the voxels of some bricks of ``view.pool``, (n,) slots -> (n, 512, 4)."""
        layer = self.pixel_layers.get(COLORS)
        return np.zeros((len(slots), VOXELS, 4), np.uint8) if layer is None else layer.within(slots)


class VoxelMap(PixelReader, Protocol):
    """Bricks of voxels measured by a sensor."""

    voxel_size: float
    view: View
    """Casts rays through the map."""

    @property
    def config(self) -> Config: ...

    @property
    def sensor(self) -> SensorConfig: ...

    @property
    def noise(self) -> NoiseModel: ...

    @property
    def seen_free_log_odds(self) -> float:
        """Log-odds of a place that rays cross but that has no brick."""
        ...

    @property
    def keyframes(self) -> Mapping[int, Placed]: ...

    @property
    def up(self) -> Up | None:
        """The world axis that is up in the image of the first keyframe that was added, which may have been
        removed since; None before it."""
        ...

    @property
    def decided(self) -> Any:
        """The map whose log-odds say which voxels are occupied, perhaps this one; it can be queried and
        exported, but not changed."""
        ...

    @property
    def marginals(self) -> Any:
        """The map by its marginals alone, perhaps this one: for queries and exports, as ``decided``."""
        ...

    def occupancy(self, points: ArrayLike) -> NDArray[np.float32]:
        """Probability of occupied at (N, 3) points in metres, (N,) float32, as in ``decided``."""
        ...

    def state(self, points: ArrayLike) -> NDArray[np.int8]:
        """UNKNOWN, FREE or OCCUPIED at (N, 3) points in metres, (N,) int8."""
        ...

    def voxels(self, min_probability: float = 0.5) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Voxels of at least this probability, as in ``decided``: centres (N, 3) in metres, and (N,)."""
        ...

    def occupied_within(self, points: ArrayLike, radius_m: float) -> NDArray[np.float32]:
        """The probability that something lies within ``radius_m`` of points (N, 3), in metres: (N,)."""
        ...

    def path_collision(self, points: ArrayLike, radius_m: float) -> NDArray[np.float32]:
        """The probability that a ball collides along a path (N, 3) -> (), or paths (P, N, 3) -> (P,)."""
        ...

    def render_depth(
        self, camera: Camera, T_world_camera: ArrayLike, by: Answer = "surface"
    ) -> NDArray[np.float32]:
        """Axial depth of the surface that each pixel most likely sees, (H, W) float32, NaN where there is
        none: the measured one near the likeliest voxel, or ``by="omega"`` the middle of that voxel."""
        ...

    def measured_depth(
        self, likeliest_m: NDArray[np.float32], camera: Camera, T_world_camera: ArrayLike
    ) -> NDArray[np.float32]:
        """Axial depth (H, W) of the measured surface where it is near the likeliest voxels, NaN elsewhere."""
        ...

    @property
    def has_surface(self) -> bool:
        """True if it holds the surface measured by all its keyframes."""
        ...

    def surface(self) -> Any:
        """The surface that the keyframes measured (export.fused_surface.FusedSurface). Raises ConfigError if
        it is not held."""
        ...

    def surface_field(self) -> DistanceSource:
        """The signed distances that they measured."""
        ...
