"""A sequence of pictures of an analytic scene: what the built-in synthetic sequences have in common.

A pattern can be printed on every surface of a scene, for what looks at colour. It is value noise in space:
random numbers at the corners of cubes, interpolated between them, in three sizes of cubes. So a surface looks
the same from everywhere.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.datasets.base import Dataset, StatedSensor
from taichi_mrf.datasets.options import PRIMESENSE, ReadOptions, parse_options, require
from taichi_mrf.datasets.synthetic.analytic_scene import Scene
from taichi_mrf.errors import BackendError, DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.simulate import KINECT_1, simulate
from taichi_mrf.system import runtime

CUBES_M = (0.4, 0.13, 0.045)
"""Sides of the cubes in metres."""

CONTRAST = 0.35
"""The largest share by which each size makes paint brighter or darker."""

_PERIOD = 64
"""The numbers repeat after so many cubes."""


def mottled(
    picture: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: PinholeCamera, T_world_camera: Pose
) -> NDArray[np.uint8]:
    """A colour picture, (H, W, 3), with the pattern on all surfaces at their axial depth, (H, W) metres."""
    points_m = points_at(camera, depth_m) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    shaded = picture * pattern(points_m, depth_m / camera.fx)[..., None]
    return np.clip(np.round(shaded), 0, 255).astype(np.uint8)


def pattern(points_m: NDArray[np.floating], pixel_m: NDArray[np.floating]) -> NDArray[np.float32]:
    """(...): the factor on the brightness of points (..., 3) of the world, of which a pixel covers
    ``pixel_m`` (...) metres. Cubes smaller than two pixels fade away, as a lens would have it."""
    factor = np.ones(points_m.shape[:-1], np.float32)
    for cube_m in CUBES_M:
        shown = np.clip(cube_m / (2 * np.maximum(pixel_m, 1e-9)) - 1, 0, 1).astype(np.float32)
        factor *= 1 + CONTRAST * shown * (2 * _value_noise(points_m / cube_m) - 1)
    return factor


def _value_noise(at: NDArray[np.floating]) -> NDArray[np.float32]:
    """(...): between 0 and 1 at places (..., 3), in sides of a cube."""
    cell = np.floor(at)
    share = (at - cell).astype(np.float32)
    share = share * share * (3 - 2 * share)
    corners = [(cell.astype(np.int64) + side) % _PERIOD for side in (0, 1)]
    weights = 1 - share, share
    value = np.zeros(at.shape[:-1], np.float32)
    for x, y, z in np.ndindex(2, 2, 2):
        weight = weights[x][..., 0] * weights[y][..., 1] * weights[z][..., 2]
        value += weight * _numbers()[corners[x][..., 0], corners[y][..., 1], corners[z][..., 2]]
    return value


@lru_cache(maxsize=1)
def _numbers() -> NDArray[np.float32]:
    return np.random.default_rng(0).random((_PERIOD,) * 3, np.float32)


FRAMES_PER_SECOND = 5.0
"""Of scenes in which nothing moves: sets the stamps only."""


@dataclass(frozen=True)
class RenderOptions:
    """The options of every built-in scene."""

    frames: int = 32
    """Views, evenly spread over the camera's path."""

    width: int = 320
    """Columns of the images; the field of view across is always that of a Kinect 1."""

    height: int = 240
    """Rows of the images."""

    noise: Literal["kinect", "none"] = "kinect"
    """Noise of the depth images: that of a Kinect 1, or none."""

    texture: Literal["plain", "mottled"] = "plain"
    """Paint of the colour images: plain, or with a pattern of spots of 4 to 40 cm on everything."""

    seed: int = 0
    """Starts the random numbers of the noise; a frame's noise depends on this and its index alone."""

    def __post_init__(self) -> None:
        require(self, frames=(1, 1_000_000), width=(8, 10_000), height=(8, 10_000), seed=0)

    def camera(self) -> PinholeCamera:
        """The Kinect 1's field of view on this many pixels, which are square."""
        focal = PRIMESENSE.fx * self.width / PRIMESENSE.width
        return PinholeCamera(
            self.width, self.height, focal, focal, cx=(self.width - 1) / 2, cy=(self.height - 1) / 2
        )


@dataclass
class RenderedSequence(Dataset):
    """Pictures of a scene, with the truth beside them. Reading a frame needs Taichi to run
    (:func:`taichi_mrf.init`), else BackendError."""

    camera: PinholeCamera
    options: RenderOptions = RenderOptions()
    color: bool = True

    @property
    @abstractmethod
    def scene(self) -> Scene:
        """The solids that never move, in the world frame."""

    @abstractmethod
    def pose_at(self, index: int) -> Pose:
        """T_world_camera of an existing frame, (4, 4)."""

    def scene_at(self, index: int) -> Scene:
        """The solids at the time of a frame."""
        return self.scene

    def stamp_at(self, index: int) -> float:
        """The time of a frame in seconds."""
        return index / FRAMES_PER_SECOND

    def lit(self, scene: Scene, T_world_camera: Pose) -> Scene:
        """A scene with the lamp for a colour picture from this pose."""
        return scene

    @cached_property
    def frame_names(self) -> Sequence[str]:
        place = self.name.partition(":")[2]
        return [f"{place}-{index:04d}" for index in range(self.options.frames)]

    @property
    def stated(self) -> StatedSensor:
        """The reach of a Kinect, however far the scene is."""
        return StatedSensor(reach_m=SensorConfig().max_depth)

    def pose(self, index: int) -> Pose:
        if not 0 <= index < self.options.frames:
            raise IndexError(f"{self.name} has {self.options.frames} frames, there is no frame {index}")
        return self.pose_at(index)

    def clean_depth(self, index: int) -> NDArray[np.float32]:
        """True axial depth of a frame, (H, W) float32 in metres."""
        return self._render(index, color=False)[0]

    def signed_distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """True distance, (N,) in metres, of points (N, 3) to the nearest surface of :attr:`scene`; negative
        in a solid."""
        return self.scene.signed_distance(points)

    def stamps(self) -> Sequence[float]:
        return [self.stamp_at(index) for index in range(self.options.frames)]

    def read(self, index: int) -> Frame:
        """Render one frame, with the noise that the options ask for."""
        depth_m, color = self._render(index, self.color)
        if self.options.noise == "kinect":
            depth_m = simulate(depth_m, self.camera, KINECT_1, seed=(self.options.seed, index))
        name, stamp = self.frame_names[index], self.stamp_at(index)
        return Frame(depth_m, self.pose(index), self.camera, stamp, name, color)

    def _render(self, index: int, color: bool) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
        T_world_camera = self.pose(index)
        if runtime.active() is None:
            raise BackendError(f"{self.name} is rendered with Taichi: call taichi_mrf.init() first")
        # Imported late: a wrong option, or the list of frames, should not wait for Taichi to load.
        from taichi_mrf.datasets.synthetic.analytic_render import render

        scene = self.scene_at(index)
        lit = self.lit(scene, T_world_camera) if color else scene
        depth_m, picture = render(lit, self.camera, T_world_camera, color)
        if picture is not None and self.options.texture == "mottled":
            picture = mottled(picture, depth_m, self.camera, T_world_camera)
        return depth_m, picture


AnySequence = TypeVar("AnySequence", bound=RenderedSequence)


def open_scene(kind: type[AnySequence], name: str, query: str, options: ReadOptions) -> AnySequence:
    """Open a built-in scene with the options after the question mark of its name. Raises DatasetError for an
    option that does not exist (naming the nearest), a value of the wrong type or out of range, and for a
    depth scale, which rendered depth does not have."""
    if options.depth_scale is not None:
        raise DatasetError(f"{name}: takes no depth_scale: its depth is in metres")
    chosen = parse_options(type(kind.options), query, name)
    return kind(name, options.camera or chosen.camera(), options=chosen, color=options.color)
