"""A recording of Intel's RealSense library, played by that library: ``realsense:FILE?poses=FILE``, or
without poses.

The file is played once when it is opened, for the numbers and stamps of its depth images, and again as they
are read: a recording can only be played forwards, so frames are best read in their order.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Row, Table
from taichi_mrf.datasets.images import measured
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.motion import AccelerationSamples, GyroSamples

END_MS = 500
"""A recording that delivers no image for this long has ended: it is read from disk without waiting."""


@dataclass(frozen=True)
class RecordedImage:
    """A depth image of a recording: the number that the camera gave it, its stamp in seconds, and by which
    clock that is (the library's timestamp domain)."""

    number: int
    stamp: float
    clock: Any


def aligned_images(frames: Any, align: Any) -> tuple[Any, NDArray[np.uint8] | None]:
    """The depth image of the library's ``frames``, and with its ``align`` the colours (H, W, 3) of the depth
    image's pixels, None if there are none."""
    if align is None:
        return frames.get_depth_frame(), None
    both = align.process(frames)
    depth, color = both.get_depth_frame(), both.get_color_frame()
    return depth, np.array(color.get_data(), np.uint8) if color else None


class Player:
    """A recording in play. ``camera`` is its depth camera, ``depth_scale`` metres a step of its images."""

    def __init__(self, rs: Any, path: Path, color: bool = False) -> None:
        """Open the file with the library ``rs`` (pyrealsense2), with ``color`` also its colour images if it
        has any. Raises DatasetError, which names the file."""
        self._rs, self._path = rs, path
        self._pipeline: Any = None
        self._align: Any = None
        if color:
            try:
                self._start(color=True)
                self._align = rs.align(rs.stream.depth)
                return
            except DatasetError:
                pass  # as a recording without colour does
        self._start()

    def images(self) -> Iterator[tuple[RecordedImage, tuple[Any, NDArray[np.uint8] | None]]]:
        """The depth images from here to the end, each with the colours (H, W, 3) of its pixels or None."""
        while True:
            try:
                found = aligned_images(self._pipeline.wait_for_frames(END_MS), self._align)
            except RuntimeError:
                return
            image = found[0]
            number, stamp = image.get_frame_number(), image.get_timestamp() / 1000.0
            yield RecordedImage(number, stamp, image.get_frame_timestamp_domain()), found

    def rewind(self) -> None:
        """Start again from the first image."""
        self.close()
        self._start(color=self._align is not None)

    def close(self) -> None:
        """Close the file."""
        if self._pipeline is not None:
            self._pipeline.stop()
            self._pipeline = None

    def _start(self, color: bool = False) -> None:
        rs = self._rs
        pipeline, config = rs.pipeline(), rs.config()
        try:
            config.enable_device_from_file(str(self._path), repeat_playback=False)
            config.enable_stream(rs.stream.depth)
            if color:
                config.enable_stream(rs.stream.color, rs.format.rgb8)
            # Before the start: in real time images are dropped, often the first one.
            resolved = config.resolve(rs.pipeline_wrapper(pipeline))
            resolved.get_device().as_playback().set_real_time(False)
            profile = pipeline.start(config)
            stream = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
            self.depth_scale = float(profile.get_device().first_depth_sensor().get_depth_scale())
        except RuntimeError as error:
            raise DatasetError(f"{self._path}: cannot be played: {' '.join(str(error).split())}") from error
        self.camera = PinholeCamera(stream.width, stream.height, stream.fx, stream.fy, stream.ppx, stream.ppy)
        self._pipeline = pipeline


@dataclass(frozen=True)
class RealSenseFrame(Row):
    """A frame, and the number that the camera gave its image."""

    number: int


@dataclass
class RealSenseRecording(Table[RealSenseFrame]):
    """The depth images of a recording, and what its IMU measured."""

    player: Player = field(kw_only=True)
    gyro: GyroSamples | None = field(kw_only=True, default=None)
    acceleration: AccelerationSamples | None = field(kw_only=True, default=None)

    def __post_init__(self) -> None:
        self.player.rewind()
        self._coming = self.player.images()
        self._last = -1
        """The index of the frame that was read last; the player stands behind it."""

    def load(self, index: int, row: RealSenseFrame, T_world_camera: Pose) -> Frame:
        """Play on to an image, from the beginning if it lies behind."""
        if index <= self._last:
            self.player.rewind()
            self._coming = self.player.images()
        self._last = index
        images = next((images for found, images in self._coming if found.number == row.number), None)
        if images is None:
            self._last = len(self)  # the player is at the end
            raise DatasetError(f"{self.name}: the image is missing when the file is played again")
        image, color = images
        steps = np.asanyarray(image.get_data())
        if steps.shape != self.camera.shape:
            raise DatasetError(f"the image has the shape {steps.shape}, not {self.camera.shape}")
        depth_m = (measured(steps) * np.float32(self.player.depth_scale)).astype(np.float32)
        parts = (T_world_camera, self.camera, row.stamp, row.name, color)
        return Frame(depth_m, *parts, gyro=self.gyro, acceleration=self.acceleration)
