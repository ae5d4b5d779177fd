"""A sequence of pictures of an analytic scene: what the built-in synthetic sequences have in common."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.datasets.base import Dataset, StatedSensor
from taichi_mrf.datasets.options import PRIMESENSE
from taichi_mrf.datasets.synthetic.analytic_scene import Scene
from taichi_mrf.datasets.synthetic.texture import mottled
from taichi_mrf.errors import BackendError, ConfigError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.simulate import KINECT_1, simulate
from taichi_mrf.system import runtime

FRAMES_PER_SECOND = 5.0
"""Of scenes in which nothing moves: sets the stamps only."""


@dataclass(frozen=True)
class RenderOptions:
    """The options of every built-in scene."""

    frames: int = 32
    """Views, evenly spread over the camera's way."""

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
        self.require(frames=1, width=8, height=8, seed=0)

    def require(self, **least: int) -> None:
        """Raise ConfigError for the first of these fields that is less than its least value."""
        for name, value in least.items():
            if getattr(self, name) < value:
                raise ConfigError(f"{name} must be at least {value}, not {getattr(self, name)}")

    def camera(self) -> PinholeCamera:
        """The Kinect 1's field of view on this many pixels, which are square."""
        focal = PRIMESENSE.fx * self.width / PRIMESENSE.width
        return PinholeCamera(
            self.width, self.height, focal, focal, cx=(self.width - 1) / 2, cy=(self.height - 1) / 2
        )


@dataclass
class RenderedSequence(Dataset):
    """Pictures of a scene, with the truth beside them.

    Reading a frame needs Taichi to run (:func:`taichi_mrf.init`), else BackendError.
    """

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
        """The names of the frames in order, for reports."""
        place = self.name.partition(":")[2]
        return [f"{place}-{index:04d}" for index in range(self.options.frames)]

    @property
    def stated(self) -> StatedSensor:
        """The reach of a Kinect, however far the scene is."""
        return StatedSensor(reach_m=SensorConfig().max_depth)

    def pose(self, index: int) -> Pose:
        """T_world_camera of a frame, (4, 4). Raises IndexError if there is no such frame."""
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
        """When each frame was taken, in seconds."""
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
