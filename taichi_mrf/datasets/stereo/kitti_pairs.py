"""Rectified stereo pairs in KITTI's odometry layout (A. Geiger, P. Lenz and R. Urtasun, CVPR 2012).

- ``image_l`` and ``image_r`` (or ``image_0`` and ``image_1``): a pair has one numbered name in both
- ``calib.txt``: the projections of the left and right camera (see ``stereo_calibration``)
- ``poses.txt``: for each pair the 3 x 4 matrix from the left camera to the first left camera, so the world
  has that camera's axes: y down, z forward
- ``times.txt``: for each pair its stamp in seconds; without it the pairs are KITTI's 0.1 s apart

Depth is not recorded: it is matched when a frame is read.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset, ReadOptions
from taichi_mrf.datasets.images import image_size, read_color
from taichi_mrf.datasets.stereo.calibration import read_rig
from taichi_mrf.datasets.stereo.matching import SIGMA_D_PX, StereoMatching, StereoRig, stereo_depth
from taichi_mrf.datasets.trajectories import RecordedPose, read_trajectory
from taichi_mrf.errors import DatasetError, FrameError, KeyframeError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

NAME = "KITTI stereo"
LOOKS_FOR = "image_l and image_r (or image_0 and image_1) with calib.txt and poses.txt"
FOLDERS = (("image_l", "image_r"), ("image_0", "image_1"))
CALIBRATION, POSES, TIMES = "calib.txt", "poses.txt", "times.txt"
SECONDS_PER_FRAME = 0.1
IMAGE_SUFFIXES = (".png", ".jpg", ".pgm")


@dataclass(frozen=True)
class RecordedPair:
    """Where one pair's images are, its stamp in seconds and its pose as it was written."""

    left_file: Path
    right_file: Path
    stamp: float
    pose: RecordedPose


@dataclass
class StereoPairs(Dataset):
    """Stereo pairs as depth frames of the left camera; ``color`` is the left image.

    ``matching`` may be set to other parameters before frames are read.
    """

    pairs: Sequence[RecordedPair] = ()
    baseline_m: float = 1.0
    color: bool = True
    matching: StereoMatching = field(default_factory=StereoMatching)

    @property
    def frame_names(self) -> Sequence[str]:
        """The images' names without their endings."""
        return [pair.left_file.stem for pair in self.pairs]

    @property
    def rig(self) -> StereoRig:
        """The left camera and the baseline."""
        return StereoRig(self.camera, self.baseline_m)

    def read(self, index: int) -> Frame:
        """Read and match one pair.

        Raises FrameError, which names the frame and the file, if an image is missing, damaged or of
        another size than the camera's, or if the pose is none. Raises IndexError outside 0 to len - 1.
        """
        if not 0 <= index < len(self.pairs):
            raise IndexError(f"{self.name} has {len(self.pairs)} frames, there is no frame {index}")
        pair = self.pairs[index]
        name = pair.left_file.stem
        try:
            T_world_camera = pair.pose.T_world_camera()
            left, right = self._read_image(pair.left_file), self._read_image(pair.right_file)
        except KeyframeError as error:
            raise FrameError(f"frame {name}: {pair.pose.source}: {error}") from error
        except DatasetError as error:
            raise FrameError(f"frame {name}: {error}") from error
        grey_left, grey_right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
        depth_m = stereo_depth(grey_left, grey_right, self.rig, self.matching)
        return Frame(depth_m, T_world_camera, self.camera, pair.stamp, name, left if self.color else None)

    def _read_image(self, path: Path) -> NDArray[np.uint8]:
        image = read_color(path)
        if image.shape[:2] != self.camera.shape:
            raise DatasetError(
                f"{path}: the image has {image.shape[1]} x {image.shape[0]} pixels, "
                f"the camera {self.camera.width} x {self.camera.height}"
            )
        return image


def recognises(folder: Path) -> bool:
    """Whether both image folders are there. That calibration or poses are missing is said on opening."""
    return any((folder / left).is_dir() and (folder / right).is_dir() for left, right in FOLDERS)


def open_folder(folder: Path, options: ReadOptions) -> Dataset:
    """List the pairs in the order of their names. One that lacks an image is listed, and named in an error
    when it is read."""
    if options.depth_scale is not None:
        raise DatasetError(f"{folder}: depth comes from stereo pairs, a depth_scale has nothing to act on")
    left, right = next(pair for pair in FOLDERS if all((folder / side).is_dir() for side in pair))
    names = sorted(_images(folder / left) | _images(folder / right), key=_number)
    if not names:
        raise DatasetError(f"{folder}: no numbered images in {left} or {right}")
    rig = _read_rig(folder, left, names, options)
    poses = read_trajectory(_needed(folder / POSES))
    if poses.layout != "rows":
        raise DatasetError(f"{poses.path}: expected a 3 x 4 matrix, row by row, in each line")
    stamps, stamp_notes = _stamps(folder / TIMES, len(names))
    for path, what, count in (
        (poses.path, "poses", len(poses.poses)),
        (folder / TIMES, "stamps", len(stamps)),
    ):
        if count != len(names):
            raise DatasetError(f"{path}: holds {count} {what} for {len(names)} stereo pairs")
    pairs = [
        RecordedPair(folder / left / name, folder / right / name, stamp, pose)
        for name, stamp, pose in zip(names, stamps, poses.poses, strict=True)
    ]
    return StereoPairs(
        name=folder.name,
        camera=rig.camera,
        notes=[noise_note(rig, left, right), *stamp_notes],
        pairs=pairs,
        baseline_m=rig.baseline_m,
        color=options.color,
    )


def noise_note(rig: StereoRig, left: str, right: str) -> str:
    """What a report should say of depth that is matched in the images ``left`` and ``right``."""
    lambda_ = rig.sigma()[2]
    return (
        f"depth comes from stereo: {left} and {right} by semi-global matching, "
        f"baseline {rig.baseline_m:.4f} m, fx {rig.camera.fx:.1f} px; with sigma_d = {SIGMA_D_PX:g} px "
        f"its sigma is lambda z^2, lambda = {lambda_:.3e} per metre (sensor.sigma: [0, 0, {lambda_:.3e}])"
    )


def _images(folder: Path) -> set[str]:
    """Names of the image files that are a number."""
    return {p.name for p in folder.iterdir() if p.stem.isdecimal() and p.suffix.lower() in IMAGE_SUFFIXES}


def _number(name: str) -> tuple[int, str]:
    return int(Path(name).stem), name


def _needed(path: Path) -> Path:
    if not path.is_file():
        raise DatasetError(f"{path}: is missing; a stereo recording needs {CALIBRATION} and {POSES}")
    return path


def _read_rig(folder: Path, left: str, names: Sequence[str], options: ReadOptions) -> StereoRig:
    calibration = _needed(folder / CALIBRATION)
    if options.camera is not None:
        recorded = read_rig(calibration, options.camera.width, options.camera.height)
        return StereoRig(options.camera, recorded.baseline_m)
    recorded = read_rig(calibration, *first_size(folder / left, (folder / left / name for name in names)))
    if options.intrinsics is None:
        return recorded
    camera = PinholeCamera(recorded.camera.width, recorded.camera.height, *options.intrinsics)
    return StereoRig(camera, recorded.baseline_m)


def first_size(where: Path, images: Iterable[Path]) -> tuple[int, int]:
    """(width, height) of the first image that can be read; a broken one is reported with its frame.

    Raises DatasetError, which names ``where`` they are, if none can be read."""
    for image in images:
        try:
            return image_size(image)
        except DatasetError:
            continue
    raise DatasetError(f"{where}: none of its images can be read")


def _stamps(path: Path, count: int) -> tuple[list[float], list[str]]:
    """Each pair's stamp in seconds, and a note where they are assumed."""
    if not path.is_file():
        note = f"no {TIMES} in {path.parent}: assumed {SECONDS_PER_FRAME:g} s from one pair to the next"
        return [SECONDS_PER_FRAME * i for i in range(count)], [note]
    return read_times(path), []


def read_times(path: Path) -> list[float]:
    """A file with a stamp in seconds a line. Raises DatasetError, which names the file and the line."""
    stamps = []
    for number, line in enumerate(_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            stamps.append(float(line))
        except ValueError:
            raise DatasetError(f"{path} line {number}: expected a stamp in seconds") from None
        if not np.isfinite(stamps[-1]):
            raise DatasetError(f"{path} line {number}: the stamp is not finite")
    return stamps


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:  # ValueError: no text, or a zero byte in the name
        raise DatasetError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
