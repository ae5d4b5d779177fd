"""A stereo rig that a YAML file describes, and its recording."""

from pathlib import Path

import yaml
from datasets_recordings import write_image, write_rows
from stereo_scene import Layer, Pair, render

from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera

CAMERA = PinholeCamera(160, 60, 100.0, 101.0, 80.5, 29.0)


BASELINE = 0.25


COUNT = 3


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
