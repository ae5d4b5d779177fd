"""``realsense:``: depth images from an Intel RealSense camera that is plugged in, or from a recording of one.

``realsense:width=848&height=480&fps=30`` is a camera, as long as it is plugged in; ``realsense:FILE`` is what
its library has recorded. ``?poses=FILE`` gives the poses of the depth camera in TUM's layout, by the stamps
of its images. Without a file they are found from the images while mapping, and from the camera's gyroscope if
it has one (motion.py). With ``?poses=still`` all frames have one pose, at the origin, level, looking along x.

A recording is played once when it is opened, for the numbers and stamps of its depth images, and again as
they are read: it can only be played forwards, so frames are best read in their order.
"""

import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset, EndlessNames, NumberedRow, Table, start_pose
from taichi_mrf.datasets.entries import REALSENSE
from taichi_mrf.datasets.images import measured
from taichi_mrf.datasets.options import TRACK, ReadOptions, parse_options
from taichi_mrf.datasets.realsense.motion import MotionModule, motion_or_note, recorded_motion
from taichi_mrf.datasets.timed_poses import (
    INTERPOLATION_GAP,
    TimedPoses,
    largest_gap,
    read_timed_poses,
    within_gap,
)
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.motion import AccelerationSamples, GyroSamples
from taichi_mrf.system.files import exists, is_file
from taichi_mrf.system.libraries import library

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


def _camera_of(depth: Any) -> PinholeCamera:
    """The camera of a stream of depth."""
    k = depth.as_video_stream_profile().get_intrinsics()
    return PinholeCamera(k.width, k.height, k.fx, k.fy, k.ppx, k.ppy)


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
            self.camera = _camera_of(profile.get_stream(rs.stream.depth))
            self.depth_scale = float(profile.get_device().first_depth_sensor().get_depth_scale())
        except RuntimeError as error:
            raise DatasetError(f"{self._path}: cannot be played: {' '.join(str(error).split())}") from error
        self._pipeline = pipeline


@dataclass
class RealSenseRecording(Table[NumberedRow]):
    """The depth images of a recording, and what its IMU measured."""

    player: Player = field(kw_only=True)
    gyro: GyroSamples | None = field(kw_only=True, default=None)
    acceleration: AccelerationSamples | None = field(kw_only=True, default=None)

    def __post_init__(self) -> None:
        self.player.rewind()
        self._coming = self.player.images()
        self._last = -1
        """The index of the frame that was read last; the player stands behind it."""

    def load(self, index: int, row: NumberedRow, T_world_camera: Pose) -> Frame:
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


TIMEOUT_MS = 500
"""A camera that delivers nothing for this long has missed an image; after MISSES in a row it is lost."""

MISSES = 4

STILL = "still"
"""In place of a file of poses: the camera stands still."""

NO_IMU = "none"
"""In place of the camera's IMU: track without."""

TRACKED = "the camera is tracked by its images; ?poses=FILE gives its poses, ?poses=still if it stands"
ENDLESS = "the stream never ends: --keep-live N bounds the memory, --keyframes.* selects fewer keyframes"


@dataclass(frozen=True)
class RealSenseOptions:
    """The depth stream that is requested; the camera must offer exactly this one."""

    width: int = 640
    """Columns of the images."""

    height: int = 480
    """Rows of the images."""

    fps: int = 30
    """Images in a second."""

    poses: str = TRACK
    """A file of the camera's poses: stamp tx ty tz qx qy qz qw; or track, to find them from the images; or
    still, for a camera that stands still."""

    imu: str = ""
    """none, to track the camera without its gyroscope and accelerometer."""


@dataclass
class RealSenseCamera(Dataset):
    """A RealSense camera. ``pipeline`` is pyrealsense2's, started; ``depth_scale`` is metres a step;
    ``align`` is the library's, which brings colour to the depth camera's pixels, None without colour;
    ``motion`` is its IMU, None if it has none or is not tracked; ``started`` if an image has come."""

    pipeline: Any = None
    align: Any = None
    motion: MotionModule | None = None
    depth_scale: float = 0.001
    trajectory: TimedPoses | None = None
    largest_gap: float = INTERPOLATION_GAP
    T_world_camera: Pose = field(default_factory=start_pose)
    misses: int = 0
    started: bool = False

    @property
    def endless(self) -> bool:
        return True

    @property
    def frame_names(self) -> Sequence[str]:
        return EndlessNames("realsense-")

    def read(self, index: int) -> Frame:
        """The camera's next image, whatever the index. Raises FrameError if none comes in time, DatasetError
        if that has happened several times in a row."""
        name = self.frame_names[index]
        try:
            frames = self.pipeline.wait_for_frames(TIMEOUT_MS)
            image, color = aligned_images(frames, self.align)
            steps = np.asanyarray(image.get_data())
        except RuntimeError as error:
            self.misses += 1
            if self.misses >= MISSES:
                raise DatasetError(f"{REALSENSE} the camera is lost: {error}") from error
            raise FrameError(f"{name}: no image from the camera: {error}") from error
        self.misses = 0
        if steps.shape != self.camera.shape:
            raise FrameError(f"{name}: the image has the shape {steps.shape}, not {self.camera.shape}")
        depth_m = (measured(steps) * np.float32(self.depth_scale)).astype(np.float32)
        stamp, gyro, acceleration = image.get_timestamp() / 1000.0, None, None
        if self.motion is not None:
            clock = image.get_frame_timestamp_domain()
            if not self.started:
                self.T_world_camera = start_pose(self.motion.up(stamp, clock))
            gyro, acceleration = self.motion.gyro(clock), self.motion.acceleration(clock)
        self.started = True
        pose = self._pose(name, stamp)
        return Frame(depth_m, pose, self.camera, stamp, name, color, gyro=gyro, acceleration=acceleration)

    def _pose(self, name: str, stamp: float) -> Pose:
        if self.trajectory is None:
            return self.T_world_camera
        pose = self.trajectory.at(stamp, self.largest_gap)
        if pose is None:
            raise FrameError(f"{name}: no poses within {self.largest_gap:g} s of its stamp {stamp:.3f} s")
        return pose


def open_realsense(text: str, options: ReadOptions) -> Dataset:
    """Start the first RealSense camera that is found, or open a recording: ``FILE?option=value&...``, where
    either may be missing. Raises DatasetError for a missing library (with how to install it), for an error of
    the library, for a wrong option, and for a depth scale, which the camera reports itself."""
    file, wanted = _file_and_options(text)
    if options.depth_scale is not None:
        raise DatasetError(f"{REALSENSE} takes no depth_scale: the camera reports its own")
    tracked = options.track or wanted.poses == TRACK
    from_file = not tracked and wanted.poses != STILL
    trajectory = read_timed_poses(Path(wanted.poses)) if from_file else None
    rs = library("pyrealsense2", f"{REALSENSE} needs", "realsense", DatasetError)
    gap = largest_gap(options)
    source: RealSenseCamera | RealSenseRecording
    if wanted.imu not in ("", NO_IMU):
        raise DatasetError(f"{REALSENSE}{file}: imu may be {NO_IMU}, not {wanted.imu!r}")
    with_imu = tracked and wanted.imu != NO_IMU
    if file:
        source = _open_recording(rs, Path(file), trajectory, gap, options, with_imu)
    else:
        source = _open_camera(rs, wanted, trajectory, gap, options, with_imu)
    source.tracked = tracked
    if tracked:
        source.notes.insert(0, TRACKED)
    return source


def _file_and_options(text: str) -> tuple[str, RealSenseOptions]:
    """The text after the colon, as a file's name and options; options alone need no question mark."""
    file, mark, query = text.partition("?")
    if not mark and "=" in text and not exists(Path(text)):
        file, query = "", text
    return file, parse_options(RealSenseOptions, query, f"{REALSENSE}{file}")


def _open_camera(
    rs: Any,
    wanted: RealSenseOptions,
    trajectory: TimedPoses | None,
    gap: float,
    options: ReadOptions,
    with_imu: bool,
) -> RealSenseCamera:
    notes, align, started = [ENDLESS], None, None
    if options.color:
        started = _started(rs, wanted, color=True)
        if isinstance(started, str):
            notes.append(f"color: the camera gives depth alone: {started}")
        else:
            align = rs.align(rs.stream.depth)
    if started is None or isinstance(started, str):
        started = _started(rs, wanted, color=False)
    if isinstance(started, str):
        raise DatasetError(f"{REALSENSE} cannot be started: {started}")
    pipeline, profile = started
    depth, motion = profile.get_stream(rs.stream.depth), None
    if with_imu:
        motion, said = motion_or_note(MotionModule, rs, profile.get_device(), depth)
        notes += said
    source = RealSenseCamera(
        REALSENSE,
        options.camera or _camera_of(depth),
        notes=notes,
        pipeline=pipeline,
        align=align,
        motion=motion,
        depth_scale=float(profile.get_device().first_depth_sensor().get_depth_scale()),
        trajectory=trajectory,
        largest_gap=gap,
    )
    weakref.finalize(source, pipeline.stop)
    if motion is not None:
        weakref.finalize(source, motion.stop)
    return source


def _started(rs: Any, wanted: RealSenseOptions, color: bool) -> tuple[Any, Any] | str:
    """A started pipeline and its profile, or what the library says. The colour stream may have any size."""
    pipeline, config = rs.pipeline(), rs.config()
    config.enable_stream(rs.stream.depth, wanted.width, wanted.height, rs.format.z16, wanted.fps)
    if color:
        config.enable_stream(rs.stream.color, 0, 0, rs.format.rgb8, wanted.fps)
    try:
        return pipeline, pipeline.start(config)
    except RuntimeError as error:
        return str(error)


def _open_recording(
    rs: Any, path: Path, trajectory: TimedPoses | None, gap: float, options: ReadOptions, with_imu: bool
) -> RealSenseRecording:
    if not is_file(path):
        raise DatasetError(f"{REALSENSE}{path}: no such file")
    player = Player(rs, path, options.color)
    images = [listed for listed, _ in player.images()]
    if not images:
        raise DatasetError(f"{path}: contains no depth images")
    notes: list[str] = []
    gyro = acceleration = up = None
    if with_imu:
        motion, notes = motion_or_note(recorded_motion, rs, path)
        if motion is not None:
            clock = images[0].clock
            gyro, acceleration = motion.gyro(clock), motion.acceleration(clock)
            up = motion.up(images[0].stamp, clock, wait_s=0)
    still = start_pose(up)
    poses = [still if trajectory is None else trajectory.at(each.stamp, gap) for each in images]
    stamps, known = [each.stamp for each in images], () if trajectory is None else trajectory.stamps
    posed, dropped = within_gap(stamps, poses, gap, "depth images", str(path), "?poses=FILE", known)
    source = RealSenseRecording(
        path.stem,
        options.camera or player.camera,
        notes=notes + dropped,
        dropped=len(images) - len(posed),
        player=player,
        rows=[
            NumberedRow(f"realsense-{each.number:06d}", each.stamp, pose, str(path), each.number)
            for each, pose in ((images[i], pose) for i, pose in posed)
        ],
        gyro=gyro,
        acceleration=acceleration,
    )
    weakref.finalize(source, player.close)
    return source
