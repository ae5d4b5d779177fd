"""A folder of depth images with images of labels beside them, which fill the layer of label_layer.py."""

from pathlib import Path

import colored_scene as scene
import numpy as np
from datasets_recordings import write_image, write_rows
from label_layer import LABELS
from numpy.typing import NDArray

THING, WALL = 3, 7


def write_scene(folder: Path) -> list[NDArray[np.uint8]]:
    """The views of the scene in millimetres; returns their labels."""
    found = []
    for i, place in enumerate(scene.PLACES):
        depth, color = scene.view(*place, seed=i)
        found.append(np.where((color == scene.RED).all(axis=-1), THING, WALL).astype(np.uint8))
        write_image(folder / "depth" / f"{i:05d}.png", np.rint(1000 * depth).astype(np.uint16))
        write_image(folder / LABELS / f"{i:05d}.png", found[-1])
    write_rows(folder / "poses.txt", [scene.pose(*place) for place in scene.PLACES])
    (folder / "camera.txt").write_text("48 36 40 40 23.5 17.5")
    return found
