"""A street recorded in KITTI's layout."""

from pathlib import Path

import numpy as np
from datasets_recordings import row_of, write_image, write_rows
from stereo_scene import Layer, Pair, render

from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera

SHAPE = (60, 160)


CAMERA = PinholeCamera(160, 60, 100.0, 101.0, 80.5, 29.0)


BASELINE = 0.25


P0 = np.array([[100.0, 0, 80.5, 0], [0, 101.0, 29.0, 0], [0, 0, 1, 0]])


P1 = P0 - np.array([[0, 0, 0, BASELINE * 100.0], [0, 0, 0, 0], [0, 0, 0, 0]])


COUNT = 3


def pairs() -> list[Pair]:
    return [render([Layer((10 + i, 0.02, 0.05))], SHAPE, seed=i) for i in range(COUNT)]


def poses() -> list[Pose]:
    return [np.eye(4), *(look_at([0.1, 0, i], [3, 2, 9.0]) for i in range(1, COUNT))]


def write_kitti(folder: Path, left: str = "image_l", right: str = "image_r") -> Path:
    for i, pair in enumerate(pairs()):
        write_image(folder / left / f"{i:06d}.png", pair.left)
        write_image(folder / right / f"{i:06d}.png", pair.right)
    (folder / "calib.txt").write_text(f"{row_of(P0)}\n{row_of(P1)}")
    write_rows(folder / "poses.txt", [pose[:3] for pose in poses()])
    return folder
