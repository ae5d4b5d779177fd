"""7-Scenes (Shotton et al., CVPR 2013): frame-NNNNNN.depth.png, .color.png or .jpg, .pose.txt.

Depth is 16-bit millimetres, 0 and 65535 mean none; a pose file holds T_world_camera as a 4 x 4 matrix.
The depth camera has no published calibration; 585 585 320 240 is what the data set's page gives. The colour
camera has none at all; COLOR was found by turning and shifting it until the edges in depth lie on edges in
colour. A recording in this format with another camera counts as registered.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.color_camera import ColorCamera
from taichi_mrf.datasets.hints import pose_files_hint
from taichi_mrf.datasets.intrinsics import find_camera
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.recording import LOST, RecordedFrame, first_file, recording
from taichi_mrf.datasets.trajectories import is_lost, read_matrix_file
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera

NAME = "7-Scenes"
CAMERA = PinholeCamera(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0)
COLOR = ColorCamera(
    PinholeCamera(width=640, height=480, fx=526.6, fy=526.6, cx=320.0, cy=240.0),
    np.array(
        [
            [1.0, -0.0079, 0.0004, -0.0244],
            [0.0079, 1.0, -0.0037, 0.0],
            [-0.0004, 0.0037, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    ),
)
"""Found on 20 frames of the red kitchen: the gradient of the colour image at edges of depth is 2.6 times its
mean, and without registration 1.4 times. The angles are so small that their sines stand for them."""
STEPS_PER_METRE = 1000.0
FRAMES_PER_SECOND = 30.0

_FILE = re.compile(r"(frame-(\d+))\.(depth\.png|pose\.txt)")


def open_folder(folder: Path, options: ReadOptions) -> Dataset:
    """List the frames in the order of their numbers. A frame that has only one of its two files is
    listed, and named in an error when it is read."""
    numbers: dict[str, int] = {}
    for path in folder.iterdir():
        match = _FILE.fullmatch(path.name)
        if match:
            numbers[match[1]] = int(match[2])
    if not any((folder / f"{name}.pose.txt").is_file() for name in numbers):
        remedy = "write each T_world_camera, a 4 x 4 matrix, into frame-NNNNNN.pose.txt"
        hint = pose_files_hint(folder, [folder / f"{name}.depth.png" for name in numbers], remedy)
        if hint is not None:
            raise DatasetError(f"{folder}: {hint}")
    tracked = [name for name in numbers if not is_lost(folder / f"{name}.pose.txt")]
    if not tracked:
        raise DatasetError(f"{folder}: tracking was lost in all {len(numbers)} images")
    frames = [_frame(folder, name, numbers[name]) for name in sorted(tracked, key=lambda n: (numbers[n], n))]
    camera, notes = find_camera(folder, options, CAMERA, NAME, (frame.depth_file for frame in frames))
    color = COLOR if camera == CAMERA else None
    return recording(
        folder, options, camera, frames, STEPS_PER_METRE, NAME, notes, len(numbers), LOST, color_camera=color
    )


def _frame(folder: Path, name: str, number: int) -> RecordedFrame:
    pose_file, depth_file = folder / f"{name}.pose.txt", folder / f"{name}.depth.png"
    color_file = first_file(folder / f"{name}.color.{suffix}" for suffix in ("png", "jpg"))
    read, stamp = partial(read_matrix_file, pose_file), number / FRAMES_PER_SECOND
    return RecordedFrame(name, stamp, read, str(pose_file), depth_file, color_file)
