"""Replica (Straub et al., 2019) as rendered for NICE-SLAM (Zhu et al., CVPR 2022) and its followers.

``results/depthNNNNNN.png`` and ``results/frameNNNNNN.jpg``; ``traj.txt`` holds for each image T_world_camera
as a 4 x 4 matrix in a line; ``cam_params.json``, beside them or in the folder above, has the camera and the
steps of the depth images per metre.
"""

import json
import re
from pathlib import Path

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.intrinsics import find_camera
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.recording import RecordedFrame, first_file, recording
from taichi_mrf.datasets.trajectories import RecordedPose, read_trajectory
from taichi_mrf.errors import ConfigError, DatasetError, naming
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_text

NAME = "Replica (NICE-SLAM)"
CAMERA = PinholeCamera(width=1200, height=680, fx=600.0, fy=600.0, cx=599.5, cy=339.5)
STEPS_PER_METRE = 6553.5
PARAMETERS, POSES = "cam_params.json", "traj.txt"
FRAMES_PER_SECOND = 30.0

_DEPTH = re.compile(r"depth(\d+)\.png")


def open_folder(folder: Path, options: ReadOptions) -> Dataset:
    """List the images in the order of their numbers, the n-th with the n-th pose."""
    numbers = {int(m[1]): p for p in (folder / "results").iterdir() if (m := _DEPTH.fullmatch(p.name))}
    images = [numbers[number] for number in sorted(numbers)]
    if not (folder / POSES).is_file():
        raise DatasetError(f"{folder / POSES}: is missing")
    trajectory = read_trajectory(folder / POSES)
    if trajectory.layout != "rows" or len(trajectory.poses) != len(images):
        raise DatasetError(
            f"{folder / POSES}: expected a 4 x 4 matrix in each of {len(images)} lines, one for each depth "
            f"image, found {len(trajectory.poses)} poses"
        )
    parameters = first_file((folder / PARAMETERS, folder.parent / PARAMETERS))
    recorded, steps = (CAMERA, STEPS_PER_METRE) if parameters is None else _read_parameters(parameters)
    camera, notes = find_camera(folder, options, recorded, NAME, iter(images))
    if parameters is not None and camera == recorded:
        notes = []
    rows = [_frame(path, pose) for path, pose in zip(images, trajectory.poses, strict=True)]
    source, stated = str(parameters or NAME), parameters is not None
    return recording(folder, options, camera, rows, steps, source, notes, scale_stated=stated)


def _frame(path: Path, pose: RecordedPose) -> RecordedFrame:
    number = path.stem.removeprefix("depth")
    color_file = first_file(path.with_name(f"frame{number}{suffix}") for suffix in (".jpg", ".png"))
    stamp = int(number) / FRAMES_PER_SECOND
    return RecordedFrame(path.stem, stamp, pose.T_world_camera, pose.source, path, color_file)


def _read_parameters(path: Path) -> tuple[PinholeCamera, float]:
    """The camera and the steps per metre of cam_params.json."""
    text = read_text(path, DatasetError)
    try:
        values = json.loads(text)["camera"]
        intrinsics = [float(values[name]) for name in ("fx", "fy", "cx", "cy")]
        size, scale = (int(values["w"]), int(values["h"])), float(values["scale"])
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError):
        raise DatasetError(f"{path}: camera needs the numbers w, h, fx, fy, cx, cy and scale") from None
    if not 0 < scale < float("inf"):
        raise DatasetError(f"{path}: scale must be a positive number of steps per metre, not {scale:g}")
    with naming(path, ConfigError):
        return PinholeCamera(*size, *intrinsics), scale
