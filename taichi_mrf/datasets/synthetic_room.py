"""``synthetic:room``: a furnished room that needs no download, with ground truth and a simulated sensor.

Options follow a question mark, ``synthetic:room?frames=60&width=640&height=480&noise=none&seed=1``; the
fields of :class:`RoomOptions` are all there are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf import runtime
from taichi_mrf.camera import PinholeCamera
from taichi_mrf.datasets.analytic_scene import Scene
from taichi_mrf.datasets.base import Dataset, ReadOptions
from taichi_mrf.datasets.intrinsics import PRIMESENSE
from taichi_mrf.datasets.query_options import parse_options
from taichi_mrf.datasets.room_furniture import camera_pose, room_scene
from taichi_mrf.errors import BackendError, ConfigError, DatasetError
from taichi_mrf.frame import Frame
from taichi_mrf.poses import Pose
from taichi_mrf.sensor.simulate import KINECT_1, simulate

NAME = "synthetic:room"
FRAMES_PER_SECOND = 5.0
"""Sets the stamps only; at 32 frames the camera then takes 6.4 s for its round."""


@dataclass(frozen=True)
class RoomOptions:
    """What the name of the built-in room may be followed by."""

    frames: int = 32
    """Views, evenly spread over the camera's closed way."""

    width: int = 320
    """Columns of the images; the field of view across is always that of a Kinect 1."""

    height: int = 240
    """Rows of the images."""

    noise: Literal["kinect", "none"] = "kinect"
    """What the depth images suffer: the noise of a Kinect 1, or nothing."""

    seed: int = 0
    """Starts the random numbers of the noise; a frame's noise depends on this and its index alone."""

    def __post_init__(self) -> None:
        for name, least in (("frames", 1), ("width", 8), ("height", 8), ("seed", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name} must be at least {least}, not {getattr(self, name)}")

    def camera(self) -> PinholeCamera:
        """The Kinect 1's field of view on this many pixels, which are square."""
        focal = PRIMESENSE.fx * self.width / PRIMESENSE.width
        return PinholeCamera(
            self.width, self.height, focal, focal, cx=(self.width - 1) / 2, cy=(self.height - 1) / 2
        )


@dataclass
class SyntheticRoom(Dataset):
    """The synthetic room as a sequence of frames, with the truth beside it.

    Reading a frame needs Taichi to run (:func:`taichi_mrf.init`), else BackendError.
    """

    options: RoomOptions = RoomOptions()
    color: bool = True

    @cached_property
    def scene(self) -> Scene:
        """The solids in the room, in the world frame."""
        return room_scene()

    @cached_property
    def frame_names(self) -> Sequence[str]:
        """What reports call the frames, in their order."""
        return [f"room-{index:04d}" for index in range(self.options.frames)]

    def pose(self, index: int) -> Pose:
        """T_world_camera of a frame, (4, 4)."""
        if not 0 <= index < self.options.frames:
            raise IndexError(f"{self.name} has {self.options.frames} frames, there is no frame {index}")
        return camera_pose(index / self.options.frames)

    def clean_depth(self, index: int) -> NDArray[np.float32]:
        """True axial depth of a frame, (H, W) float32 in metres."""
        return self._render(self.pose(index), color=False)[0]

    def signed_distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """True distance, (N,) in metres, of points (N, 3) to the nearest surface; negative in a solid."""
        return self.scene.signed_distance(points)

    def read(self, index: int) -> Frame:
        """Render one frame, with the noise that the options ask for."""
        T_world_camera = self.pose(index)
        depth_m, color = self._render(T_world_camera, self.color)
        if self.options.noise == "kinect":
            depth_m = simulate(depth_m, self.camera, KINECT_1, seed=(self.options.seed, index))
        name, stamp = self.frame_names[index], index / FRAMES_PER_SECOND
        return Frame(depth_m, T_world_camera, self.camera, stamp, name, color)

    def _render(
        self, T_world_camera: Pose, color: bool
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
        if runtime.active() is None:
            raise BackendError(f"{self.name} is rendered with Taichi: call taichi_mrf.init() first")
        # Imported late: a wrong option, or the list of frames, should not wait for Taichi to load.
        from taichi_mrf.datasets.analytic_render import render

        return render(self.scene, self.camera, T_world_camera, color)


def open_synthetic_room(query: str, options: ReadOptions) -> SyntheticRoom:
    """Open the room with the options after the question mark of its name.

    Raises DatasetError for an option that does not exist (naming the nearest), a value of the wrong
    type or out of range, and for a depth scale, which rendered depth does not have.
    """
    if options.depth_scale is not None:
        raise DatasetError(f"{NAME}: has no depth_scale, its depth is in metres")
    room = parse_options(RoomOptions, query, NAME)
    return SyntheticRoom(NAME, options.camera or room.camera(), options=room, color=options.color)
