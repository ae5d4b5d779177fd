"""``realsense:``: depth images from an Intel RealSense camera that is plugged in, as long as it is.

The camera is taken to stand still: its pose is one and the same for all frames, at the origin, level, looking
along x. Poses of a camera that moves come in a later version. Options follow the name,
``realsense:width=848&height=480&fps=30``.
"""

import importlib
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, overload

import numpy as np

from taichi_mrf.camera import PinholeCamera
from taichi_mrf.datasets.base import Dataset, ReadOptions
from taichi_mrf.datasets.query_options import parse_options
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.frame import Frame
from taichi_mrf.poses import Pose, look_at

NAME = "realsense:"

TIMEOUT_MS = 500
"""A camera that sends nothing for so long has missed an image; it is lost after MISSES in a row."""

MISSES = 4

NOTES = (
    "the camera is taken to stand still: poses of one that moves come in a later version",
    "frames come without end: --keep-live N bounds the memory, --keyframes.* thins them out",
)


@dataclass(frozen=True)
class RealSenseOptions:
    """What the camera is asked for; it must offer this very depth stream."""

    width: int = 640
    """Columns of the images."""

    height: int = 480
    """Rows of the images."""

    fps: int = 30
    """Images in a second."""


class _EndlessNames(Sequence[str]):
    """Names of frames that are counted as they come."""

    def __len__(self) -> int:
        return 2**31 - 1

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> list[str]: ...
    def __getitem__(self, index: int | slice) -> str | list[str]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return f"realsense-{index:06d}"


@dataclass
class RealSense(Dataset):
    """A RealSense camera. ``pipeline`` is pyrealsense2's, started; ``depth_scale`` is metres a step."""

    endless: ClassVar[bool] = True

    pipeline: Any = None
    depth_scale: float = 0.001
    T_world_camera: Pose = field(default_factory=lambda: look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    misses: int = 0

    @property
    def frame_names(self) -> Sequence[str]:
        """Names without end."""
        return _EndlessNames()

    def read(self, index: int) -> Frame:
        """The camera's next image, whatever the index. Raises FrameError if none comes in time, DatasetError
        if that has happened several times in a row."""
        name = self.frame_names[index]
        try:
            image = self.pipeline.wait_for_frames(TIMEOUT_MS).get_depth_frame()
            steps = np.asanyarray(image.get_data())
        except RuntimeError as error:
            self.misses += 1
            if self.misses >= MISSES:
                raise DatasetError(f"{NAME} the camera is lost: {error}") from error
            raise FrameError(f"{name}: no image from the camera: {error}") from error
        self.misses = 0
        if steps.shape != self.camera.shape:
            raise FrameError(f"{name}: the image has the shape {steps.shape}, not {self.camera.shape}")
        depth_m = (steps * np.float32(self.depth_scale)).astype(np.float32)
        return Frame(depth_m, self.T_world_camera, self.camera, image.get_timestamp() / 1000.0, name)


def open_realsense(query: str, options: ReadOptions) -> RealSense:
    """Start the first RealSense camera that is found.

    Raises DatasetError, whose text says what to install or what the camera's library says, for a wrong
    option, and for a depth scale, which the camera knows itself.
    """
    wanted = parse_options(RealSenseOptions, query.removeprefix("?"), NAME)
    if options.depth_scale is not None:
        raise DatasetError(f"{NAME} has no depth_scale, the camera knows its own")
    try:
        rs = importlib.import_module("pyrealsense2")
    except ImportError as error:
        raise DatasetError(
            f"{NAME} needs pyrealsense2, which is not installed: pip install 'taichi-mrf[realsense]'"
        ) from error
    pipeline, config = rs.pipeline(), rs.config()
    config.enable_stream(rs.stream.depth, wanted.width, wanted.height, rs.format.z16, wanted.fps)
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise DatasetError(f"{NAME} cannot be started: {error}") from error
    stream = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
    camera = PinholeCamera(stream.width, stream.height, stream.fx, stream.fy, stream.ppx, stream.ppy)
    scale = float(profile.get_device().first_depth_sensor().get_depth_scale())
    source = RealSense(
        NAME, options.camera or camera, notes=list(NOTES), pipeline=pipeline, depth_scale=scale
    )
    weakref.finalize(source, pipeline.stop)
    return source
