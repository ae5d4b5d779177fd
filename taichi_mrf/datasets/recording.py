"""A recording in files: the reader behind every folder format.

A format only lists the files of each frame; a frame is checked here, when it is read.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.color_camera import ColorCamera, without_black
from taichi_mrf.datasets.confidence import Confidence
from taichi_mrf.datasets.depth_scale import PLAUSIBLE_MEDIAN_M, USUAL, Evidence, gather
from taichi_mrf.datasets.images import look_at_depth, note_of_largest, read_color, read_depth, read_grey
from taichi_mrf.errors import DatasetError, FrameError, KeyframeError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

ASKED = "--depth-scale"
"""Where a scale comes from that the caller gives."""

_LOOKED_AT = 4
"""Images of which the kind and the share of the largest value are found when a recording is opened."""


@dataclass(frozen=True)
class RecordedFrame:
    """The files of one frame.

    ``read_pose`` gives T_world_camera. It raises DatasetError, which names the file, or KeyframeError
    for an invalid pose; ``pose_source`` then names the file, or the file and the line. ``camera`` is its own,
    None for the recording's.
    """

    name: str
    stamp: float
    depth_file: Path
    read_pose: Callable[[], Pose]
    pose_source: str
    color_file: Path | None = None
    confidence_file: Path | None = None
    camera: PinholeCamera | None = None


@dataclass
class Recording(Dataset):
    """Frames in files, read on request.

    ``steps_per_metre`` is the scale of the depth images and ``scale_source`` where it comes from; if it is
    ``scale_assumed``, no file says so and :meth:`check_scale` may find another. ``color_camera`` took the
    colour images, unless they are registered to depth. ``confidence`` tells what images of confidence mean,
    where there are some.
    """

    camera: PinholeCamera
    frames: Sequence[RecordedFrame] = ()
    steps_per_metre: float = 1000.0
    scale_source: str = "the format's"
    scale_assumed: bool = False
    color: bool = True
    color_camera: ColorCamera | None = None
    confidence: Confidence | None = None
    _names: list[str] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._names = [frame.name for frame in self.frames]

    @property
    def frame_names(self) -> Sequence[str]:
        """The names of the frames in order, for errors and reports."""
        return self._names

    @property
    def recorded_sigma(self) -> tuple[float, ...] | None:
        """What the confidence is relative to, None without."""
        return None if self.confidence is None else self.confidence.sigma

    @property
    def sigma_origin(self) -> str:
        """Where the confidence's comes from."""
        return super().sigma_origin if self.confidence is None else self.confidence.origin

    @property
    def states_pixel_sigma(self) -> bool:
        """Whether frames have images of confidence."""
        return any(frame.confidence_file is not None for frame in self.frames)

    def stamps(self) -> Sequence[float]:
        """When each frame was taken, in seconds."""
        return [frame.stamp for frame in self.frames]

    def pose(self, index: int) -> Pose:
        """The pose of one frame. Raises FrameError, which names the frame and the file."""
        recorded = self.frames[index]
        try:
            return recorded.read_pose()
        except KeyframeError as error:
            raise FrameError(f"frame {recorded.name}: {recorded.pose_source}: {error}") from error
        except DatasetError as error:
            raise FrameError(f"frame {recorded.name}: {error}") from error

    def read(self, index: int) -> Frame:
        """Read one frame from disk.

        Raises FrameError, which names the frame and the file, if the depth or colour image is missing,
        damaged, of the wrong type or of another size than the camera's, or if the pose is missing or
        invalid. Raises IndexError outside 0 to len - 1.
        """
        if not 0 <= index < len(self.frames):
            raise IndexError(f"{self.name} has {len(self.frames)} frames, there is no frame {index}")
        recorded = self.frames[index]
        camera = recorded.camera or self.camera
        T_world_camera = self.pose(index)
        color = sigma_m = None
        try:
            depth_m = read_depth(recorded.depth_file, self.steps_per_metre, camera)
            if self.color and recorded.color_file is not None:
                color = self._read_color(recorded.color_file, depth_m, camera)
            if self.confidence is not None and recorded.confidence_file is not None:
                sigma_m = self._read_sigma(recorded.confidence_file, depth_m, self.confidence, camera)
        except DatasetError as error:
            raise FrameError(f"frame {recorded.name}: {error}") from error
        parts = (camera, recorded.stamp, recorded.name, color, sigma_m)
        return Frame(depth_m, T_world_camera, *parts)

    def _read_sigma(
        self, path: Path, depth_m: NDArray[np.float32], confidence: Confidence, camera: PinholeCamera
    ) -> NDArray[np.float32]:
        """The sigma of each pixel, from an image of its confidence. Raises DatasetError."""
        levels = read_grey(path)
        try:
            return confidence.sigma_m(levels, depth_m, camera)
        except DatasetError as error:
            raise DatasetError(f"{path}: {error}") from error

    def _read_color(
        self, path: Path, depth_m: NDArray[np.float32], camera: PinholeCamera
    ) -> NDArray[np.uint8]:
        """The colours of the depth image's pixels. Raises DatasetError."""
        if self.color_camera is None:
            return without_black(_of_size(read_color(path), path, camera))
        color = read_color(path, self.color_camera.camera)
        return self.color_camera.registered(color, depth_m, camera)

    def check_scale(self, poses_are_used: bool) -> list[str]:
        """Compare neighbouring frames at the recorded poses, and note which scale is used and why.

        An assumed scale is replaced by a usual one with which neighbouring frames agree clearly better; one
        that a file or the caller gives is kept, and a note says that another would agree better.
        """
        apart = max(1, len(self.frames) // _LOOKED_AT)
        looked = [
            look_at_depth(frame.depth_file, frame.camera or self.camera)
            for frame in self.frames[::apart][:_LOOKED_AT]
        ]
        if looked and looked[0][0] and self.scale_source != ASKED:
            self.steps_per_metre, self.scale_source = 1.0, "metres, as the images hold floats"
        own = self.steps_per_metre
        found = gather(
            len(self.frames) if poses_are_used else min(1, len(self.frames)),
            lambda index: self.frames[index].read_pose(),
            lambda index: read_depth(self.frames[index].depth_file, 1.0, self.camera),
            self.camera,
            tuple(dict.fromkeys((own, *USUAL))),
        )
        notes = note_of_largest([share for _, share in looked])
        better = found.better_than(own)
        if better is not None and self.scale_assumed:
            self.steps_per_metre = better
            notes.append(
                f"depth: {better:g} steps per metre, found by comparing neighbouring frames at the recorded "
                f"poses: their depths differ by {found.disagreement[better]:.1%}, by "
                f"{found.disagreement[own]:.1%} at {own:g} ({self.scale_source}); --depth-scale sets another"
            )
        elif better is not None:
            notes.append(
                f"depth: {own:g} steps per metre ({self.scale_source}) do not fit the recorded poses: "
                f"neighbouring frames differ by {found.disagreement[own]:.1%}, at {better:g} by "
                f"{found.disagreement[better]:.1%}; check --depth-scale"
            )
        elif self.scale_assumed:
            notes.append(
                f"depth: {own:g} steps per metre ({self.scale_source}){_evidence(found, own)}; "
                "--depth-scale sets another"
            )
        median_m = None if found.median is None else found.median / self.steps_per_metre
        if median_m is not None and not PLAUSIBLE_MEDIAN_M[0] <= median_m <= PLAUSIBLE_MEDIAN_M[1]:
            notes.append(
                f"depth: {self.steps_per_metre:g} steps per metre make a median depth of {median_m:.3g} m, "
                "which is not plausible; check --depth-scale"
            )
        return notes


def _of_size(color: NDArray[np.uint8], path: Path, camera: PinholeCamera) -> NDArray[np.uint8]:
    """A registered colour image with the depth image's pixels. Raises DatasetError if it is not the same
    view."""
    (height, width), (rows, columns) = camera.shape, color.shape[:2]
    if (rows, columns) == (height, width):
        return color
    if columns < width or abs(columns * height - rows * width) > 0.01 * rows * width:
        raise DatasetError(
            f"{path}: the colour image has {columns} x {rows} pixels, depth {width} x {height}, which is not "
            "the same view; without --color only depth is read"
        )
    scaled: NDArray[np.uint8] = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA).astype(
        np.uint8
    )
    return scaled


def _evidence(found: Evidence, steps_per_metre: float) -> str:
    """What supports a scale, in words."""
    words = []
    if found.median is not None:
        words.append(f"the median depth is {found.median / steps_per_metre:.2f} m")
    if steps_per_metre in found.disagreement:
        words.append(
            f"neighbouring frames differ by {found.disagreement[steps_per_metre]:.1%} at the recorded poses"
        )
    return f": {', '.join(words)}" if words else ""
