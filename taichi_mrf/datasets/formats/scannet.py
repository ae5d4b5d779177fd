"""ScanNet (Dai et al., CVPR 2017), extracted from its .sens files: depth/, color/, pose/, intrinsic/.

Depth is 16-bit millimetres; ``pose/N.txt`` holds T_world_camera of the depth camera as a 4 x 4 matrix, of
-inf where tracking was lost: such images are left out and counted. ``intrinsic/intrinsic_depth.txt`` is the
camera's 4 x 4 matrix. Where each image has intrinsics of its own, they are ``intrinsic/N.txt``.

``color/N.jpg`` (or .png) has a camera of its own, ``intrinsic/intrinsic_color.txt``, and is registered to
depth. ``extrinsic_depth.txt`` and ``extrinsic_color.txt`` take points of the two cameras to a common frame;
a file that is missing stands for the identity.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.color_camera import ColorCamera
from taichi_mrf.datasets.hints import hint_for
from taichi_mrf.datasets.images import DEPTH_SUFFIXES
from taichi_mrf.datasets.intrinsics import find_camera, own_cameras, read_camera
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.recording import LOST, RecordedFrame, first_file, recording
from taichi_mrf.datasets.trajectories import is_lost, read_matrix_file
from taichi_mrf.errors import DatasetError, KeyframeError, naming
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_text

NAME = "ScanNet"
CAMERA = PinholeCamera(width=640, height=480, fx=577.870605, fy=577.870605, cx=319.5, cy=239.5)
"""The camera of most scenes."""

INTRINSICS = "intrinsic/intrinsic_depth.txt"
COLOR_CAMERA = PinholeCamera(width=1296, height=968, fx=1170.187988, fy=1170.187988, cx=647.75, cy=483.75)
"""The colour camera of most scenes."""

COLOR_INTRINSICS = "intrinsic/intrinsic_color.txt"
STEPS_PER_METRE = 1000.0
FRAMES_PER_SECOND = 30.0


def open_folder(folder: Path, options: ReadOptions) -> Dataset:
    """List the tracked images in the order of their numbers. One whose pose is missing is listed, and named
    in an error when it is read."""
    found = (p for p in (folder / "depth").iterdir() if p.suffix in DEPTH_SUFFIXES and p.stem.isdecimal())
    images = sorted(found, key=lambda path: int(path.stem))
    if not images:
        hint = hint_for(folder / "depth")
        raise DatasetError(f"{folder / 'depth'}: {hint or 'contains no N.png'}")
    tracked = [path for path in images if not is_lost(folder / "pose" / f"{path.stem}.txt")]
    if not tracked:
        raise DatasetError(f"{folder / 'pose'}: tracking was lost in all {len(images)} images")
    if options.camera is None and options.intrinsics is None and (folder / INTRINSICS).is_file():
        camera = read_camera(folder / INTRINSICS, CAMERA, iter(tracked))
        notes: list[str] = []
    else:
        camera, notes = find_camera(folder, options, CAMERA, NAME, iter(tracked))
    own = own_cameras([_own_camera(folder, path) for path in tracked], options)
    if own[0] is not None:
        camera, notes = own[0], []
    frames = [_frame(folder, path, each) for path, each in zip(tracked, own, strict=True)]
    color_camera = _color_camera(folder, frames) if options.color else None
    if color_camera is None and options.color and any(frame.color_file for frame in frames):
        notes.append(f"colours are not read: there is no {folder / COLOR_INTRINSICS}")
    return recording(
        folder,
        replace(options, color=color_camera is not None),
        camera,
        frames,
        STEPS_PER_METRE,
        NAME,
        notes,
        len(images),
        LOST,
        color_camera=color_camera,
    )


def _color_camera(folder: Path, frames: Sequence[RecordedFrame]) -> ColorCamera | None:
    """The colour camera beside the depth camera; None if there are no colour images, or their intrinsics are
    not known. Raises DatasetError for files that are not valid, or intrinsics of images of another size."""
    path = folder / COLOR_INTRINSICS
    images: Iterator[Path] = (frame.color_file for frame in frames if frame.color_file is not None)
    first = next(images, None)
    if first is None or not path.is_file():
        return None
    camera = read_camera(path, COLOR_CAMERA, (first, *images))
    T_base_depth, T_base_color = (_extrinsics(folder, name) for name in ("depth", "color"))
    return ColorCamera(camera, inverse(T_base_color) @ T_base_depth)


def _extrinsics(folder: Path, camera: str) -> Pose:
    """The pose of a camera in the frame of the device."""
    path = folder / f"intrinsic/extrinsic_{camera}.txt"
    if not path.is_file():
        return np.eye(4)
    with naming(path, KeyframeError):
        return read_matrix_file(path)


def _own_camera(folder: Path, image: Path) -> PinholeCamera | None:
    """The camera of one image, None if there is no file of it, or its focal length is zero."""
    path = folder / "intrinsic" / f"{image.stem}.txt"
    if not path.is_file() or re.match(r"[\s\[]*0[0.]*(e\S*)?[\s,]", read_text(path, DatasetError)):
        return None
    return read_camera(path, CAMERA, iter([image]))


def _frame(folder: Path, path: Path, camera: PinholeCamera | None) -> RecordedFrame:
    pose_file = folder / "pose" / f"{path.stem}.txt"
    color_file = first_file(folder / "color" / f"{path.stem}.{suffix}" for suffix in ("jpg", "png"))
    read, stamp = partial(read_matrix_file, pose_file), int(path.stem) / FRAMES_PER_SECOND
    return RecordedFrame(path.stem, stamp, read, str(pose_file), path, color_file, camera=camera)
