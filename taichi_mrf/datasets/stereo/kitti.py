"""Rectified stereo pairs in KITTI's odometry layout (A. Geiger, P. Lenz and R. Urtasun, CVPR 2012).

- ``image_l`` and ``image_r`` (or ``image_0`` and ``image_1``): a pair has one numbered name in both
- ``calib.txt``: the 3 x 4 projections P0 and P1 of the left and right camera, row by row, 12 numbers each: in
  lines that begin with ``P0:`` and ``P1:``, else in the first two lines. P1 is K [I | (-b, 0, 0)], baseline b
- ``poses.txt``: for each pair the 3 x 4 matrix from the left camera to the first left camera, so the world
  has that camera's axes: y down, z forward
- ``times.txt``: for each pair its stamp in seconds; without it the pairs are KITTI's 0.1 s apart
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.stereo.matching import StereoRig
from taichi_mrf.datasets.stereo.pairs import RecordedPair, StereoPairs, first_size, noise_note, read_times
from taichi_mrf.datasets.trajectories import read_trajectory
from taichi_mrf.errors import ConfigError, DatasetError, naming
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_text

FOLDERS = (("image_l", "image_r"), ("image_0", "image_1"))
CALIBRATION, POSES, TIMES = "calib.txt", "poses.txt", "times.txt"
SECONDS_PER_FRAME = 0.1
IMAGE_SUFFIXES = (".png", ".jpg", ".pgm")

_SAME = 1e-6
"""Largest difference, relative to the focal length, of matrix entries that count as equal."""


def open_folder(folder: Path, options: ReadOptions) -> Dataset:
    """List the pairs in the order of their names. One that lacks an image is listed, and named in an error
    when it is read."""
    if options.depth_scale is not None:
        raise DatasetError(f"{folder}: takes no depth_scale: depth comes from stereo pairs")
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
            raise DatasetError(f"{path}: contains {count} {what} for {len(names)} stereo pairs")
    pairs = []
    for name, stamp, pose in zip(names, stamps, poses.poses, strict=True):
        images = folder / left / name, folder / right / name
        pairs.append(RecordedPair(images[0].stem, stamp, pose.T_world_camera, pose.source, *images))
    return StereoPairs(
        name=folder.name,
        camera=rig.camera,
        notes=[noise_note(rig, left, right), *stamp_notes],
        rows=pairs,
        baseline_m=rig.baseline_m,
        color=options.color,
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


def _stamps(path: Path, count: int) -> tuple[list[float], list[str]]:
    """Each pair's stamp in seconds, and a note where they are assumed."""
    if not path.is_file():
        note = f"no {TIMES} in {path.parent}: assumed {SECONDS_PER_FRAME:g} s from one pair to the next"
        return [SECONDS_PER_FRAME * i for i in range(count)], [note]
    return read_times(path), []


def read_rig(path: Path, width: int, height: int) -> StereoRig:
    """The rig of images of ``width`` x ``height`` pixels.

    Raises DatasetError, whose text names the file, if it cannot be read, lacks P0 or P1, or if these are
    not two equal pinhole cameras, the first at the origin and the second to its right.
    """
    P_left, P_right = _read_projections(path)
    K = P_left[:, :3]
    fx = K[0, 0]
    if fx <= 0 or K[0, 1] or K[1, 0] or tuple(K[2]) != (0.0, 0.0, 1.0):
        raise DatasetError(
            f"{path}: P0 is not the matrix of a pinhole camera without skew: fx 0 cx 0 / 0 fy cy 0 / 0 0 1 0"
        )
    if np.abs(K - P_right[:, :3]).max() > _SAME * fx:
        raise DatasetError(f"{path}: P0 and P1 differ in focal length or principal point: no rectified pair")
    if np.abs(P_left[:, 3]).max() > _SAME * fx or np.abs(P_right[1:, 3]).max() > _SAME * fx:
        raise DatasetError(f"{path}: P0 must be at the origin, and P1 moved along x alone")
    with naming(path, ConfigError):
        camera = PinholeCamera(width, height, float(fx), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        return StereoRig(camera, baseline_m=-float(P_right[0, 3] / fx))


def _read_projections(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """P0 and P1, (3, 4) each."""
    text = read_text(path, DatasetError)
    lines = [words for line in text.splitlines() if (words := line.split())]
    labelled = {words[0]: words[1:] for words in lines if words[0].endswith(":")}
    rows = labelled or {f"P{i}:": words for i, words in enumerate(lines)}
    return _projection(path, "P0", rows), _projection(path, "P1", rows)


def _projection(path: Path, name: str, rows: dict[str, list[str]]) -> NDArray[np.float64]:
    words = rows.get(f"{name}:")
    if words is None:
        raise DatasetError(f"{path}: {name} is missing")
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        raise DatasetError(f"{path}: {name} contains something that is not a number") from None
    if len(numbers) != 12 or not np.isfinite(numbers).all():
        raise DatasetError(
            f"{path}: {name} must be 12 finite numbers (a 3 x 4 matrix), it has {len(numbers)}"
        )
    return numbers.reshape(3, 4)
