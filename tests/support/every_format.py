"""A writer of a small recording for every format of depth images: what holds for all is tested on all."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from datasets_recordings import CAMERA, FORMATS, Content, arrays, write_npz, write_record3d, write_stray
from inputs_bags import writing
from rtabmap_database import OPTICAL, Database, calibration, encoded, rvl

from taichi_mrf.geometry.poses import inverse


def write_steps(folder: Path, content: Content) -> Path:
    """An .npz of whole numbers."""
    whole = {"depth_m": np.stack(content.depth), "depth_scale": np.array(1000.0)}
    return write_npz(folder.with_suffix(".npz"), arrays(content) | whole)


def write_bag(packed: bool, folder: Path, content: Content) -> Path:
    """A ROS 1 bag with the depth images of a recording, as they are or packed."""
    path = folder.with_suffix(".bag")
    with writing(path, "ros1") as bag:
        bag.camera_info("/depth/camera_info", "optical", CAMERA)
        for i, image in enumerate(content.depth):
            if packed:
                bag.compressed_depth("/depth/image/compressedDepth", 1 + 0.1 * i, "optical", image)
            else:
                bag.image("/depth/image", 1 + 0.1 * i, "optical", image, "16UC1")
            bag.pose_stamped("/camera/pose", 1 + 0.1 * i, "map", content.poses[i])
    return path


WHOLE_NUMBERS: dict[str, Callable[[Path, Content], Path]] = {
    **{name: each.write for name, each in FORMATS.items()},
    "npz": write_steps,
    "bag": partial(write_bag, False),
    "bag, packed": partial(write_bag, True),
}


def write_database(folder: Path, content: Content) -> Path:
    """A database of RTAB-Map, optimised, whose poses are of a body; each second depth image is packed."""
    path = folder.with_suffix(".db")
    database = Database(path)
    bodies = {i: T @ inverse(OPTICAL) for i, T in enumerate(content.poses, start=1)}
    for i, T in bodies.items():
        depth, color = (encoded, rvl)[i % 2](content.depth[i - 1]), encoded(content.color[i - 1])
        database.add(i, 99.0 + i, T, depth, calibration(CAMERA), color)
    database.optimise(bodies)
    database.link(1, 2, 0, inverse(bodies[1]) @ bodies[2], np.eye(6))
    database.connection.close()
    return path


EVERY: dict[str, Callable[[Path, Content], Path]] = {
    **WHOLE_NUMBERS,
    "Stray Scanner": write_stray,
    "Record3D": lambda folder, content: write_record3d(folder.with_suffix(".r3d"), content),
    "RTAB-Map": write_database,
}
