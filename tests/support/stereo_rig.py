"""Recordings of a stereo rig: in KITTI's layout, and as a YAML file describes it."""

from pathlib import Path

import numpy as np
import yaml
from datasets_recordings import row_of, write_image, write_rows
from stereo_scene import Layer, Pair, render

from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera

CAMERA = PinholeCamera(160, 60, 100.0, 101.0, 80.5, 29.0)
BASELINE = 0.25
COUNT = 3
P0 = np.array([[100.0, 0, 80.5, 0], [0, 101.0, 29.0, 0], [0, 0, 1, 0]])
P1 = P0 - np.array([[0, 0, 0, BASELINE * 100.0], [0, 0, 0, 0], [0, 0, 0, 0]])


DESCRIPTION = {
    "fx": 100.0,
    "fy": 101.0,
    "cx": 80.5,
    "cy": 29.0,
    "baseline": BASELINE,
    "left": "cam0/*.png",
    "right": "cam1/*.png",
    "poses": "poses.txt",
}


def pairs() -> list[Pair]:
    return [render([Layer((10 + i, 0.02, 0.05))], CAMERA.shape, seed=i) for i in range(COUNT)]


def pose(i: float) -> Pose:
    return look_at([0.1, 0, i], [3, 2, 9.0])


def write(folder: Path, names: list[str], **changes: object) -> Path:
    """A rig with images of these names; a change to None takes a field out."""
    for name, pair in zip(names, pairs(), strict=True):
        write_image(folder / "cam0" / f"{name}.png", pair.left)
        write_image(folder / "cam1" / f"{name}.png", pair.right)
    values = {name: value for name, value in {**DESCRIPTION, **changes}.items() if value is not None}
    (folder / "rig.yaml").write_text(yaml.safe_dump(values))
    write_rows(folder / "poses.txt", [pose(i) for i in range(COUNT)])
    return folder / "rig.yaml"


def poses() -> list[Pose]:
    """Of the recording in KITTI's layout, whose world is the first camera."""
    return [np.eye(4), *(pose(i) for i in range(1, COUNT))]


def write_kitti(folder: Path, left: str = "image_l", right: str = "image_r") -> Path:
    for i, pair in enumerate(pairs()):
        write_image(folder / left / f"{i:06d}.png", pair.left)
        write_image(folder / right / f"{i:06d}.png", pair.right)
    (folder / "calib.txt").write_text(f"{row_of(P0)}\n{row_of(P1)}")
    write_rows(folder / "poses.txt", [pose[:3] for pose in poses()])
    return folder
