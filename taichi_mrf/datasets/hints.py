"""Hints for data that no reader supports: laser scans, clouds without poses, meshes, maps, a text for each
image."""

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from taichi_mrf.datasets.laser.readers import holds_scans
from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import is_file, is_folder, read_text

_LIDAR = (".las", ".laz", ".bin", ".velodyne")
_MESHES = (".ply", ".obj", ".stl", ".glb", ".off")
_OCTOMAPS = (".bt", ".ot")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
ONE_FILE = (
    "write them into poses.txt in this folder, for each image a line of the 12 numbers of the first three "
    "rows of T_world_camera"
)
LIDAR_POSES = (
    "contains lidar point clouds without poses; scans are read from a folder with one .npz, .ply, .pcd, .las "
    "or .bin for each and poses.npz or a file of poses beside them, KITTI's from velodyne/ with calib.txt "
    "and poses.txt"
)
_POSE_TEXTS = (".txt", ".pose", ".cam", ".info")


def hint_for(path: Path) -> str | None:
    """What a file, or most of a folder, holds instead of depth images, and which command reads it; None if
    it is unknown."""
    if holds_scans(path):
        return (
            "contains scans of a 2D laser scanner, not depth images; map them with: "
            f"taichi-mrf laser {shlex.quote(str(path))} --out DIR"
        )
    if is_folder(path):
        children = [child for child in sorted(path.iterdir()) if is_file(child)]
        scans = [child for child in children if holds_scans(child)]
        if scans:
            names = ", ".join(child.name for child in scans[:8])
            return f"contains 2D laser scans; pass one of {names} to taichi-mrf laser"
        kinds = {kind for child in children if (kind := _kind(child))}
        return kinds.pop() if len(kinds) == 1 else None
    return _kind(path)


def _kind(path: Path) -> str | None:
    suffix = path.suffix.lower()
    if suffix in _LIDAR:
        return LIDAR_POSES
    if suffix in _MESHES:
        return (
            f"contains a mesh or points ({path.name}), not depth images; "
            f"'mesh:{path}?poses=FILE' renders depth images of a mesh; a lidar's scans need poses beside them"
        )
    if suffix in _OCTOMAPS:
        return f"contains an OctoMap ({path.name}), not depth images; taichi-mrf import reads it"
    if suffix == ".sens":
        return "is ScanNet's packed format; extract it to depth/, pose/ and intrinsic/ with ScanNet's tools"
    return None


def pose_files_hint(folder: Path, images: Sequence[Path], remedy: str = ONE_FILE) -> str | None:
    """How to read a recording with poses, and perhaps intrinsics, in a text file for each image; None if
    there are no such files. ``remedy`` says where the reader expects the poses."""
    places = [folder, *(child for child in sorted(folder.iterdir()) if is_folder(child))]
    for place in places:
        texts = [
            p for p in sorted(place.iterdir()) if p.suffix in _POSE_TEXTS and any(map(str.isdigit, p.stem))
        ]
        if len(texts) > 1 and 2 * len(texts) >= len(images):
            return _pose_file_hint(texts, remedy)
    return None


def _pose_file_hint(texts: Sequence[Path], remedy: str) -> str | None:
    """The hint, if the first file looks like the numbers of one frame."""
    try:
        text = read_text(texts[0], DatasetError)
    except DatasetError:
        return None
    rows = [[float(word) for word in _NUMBER.findall(line)] for line in text.splitlines()]
    counts = [len(row) for row in rows]
    flat = [number for row in rows for number in row]
    camera = next((rows[i : i + 3] for i in range(len(rows)) if counts[i : i + 3] == [3, 3, 3]), None)
    flags = "--camera fx,fy,cx,cy"
    if camera is not None:
        K = np.array(camera)
        flags = f"--camera {K[0, 0]:g},{K[1, 1]:g},{K[0, 2]:g},{K[1, 2]:g}"
    if camera is None and len(flat) not in (7, 8, 12, 16, 21, 25):
        return None
    return (
        f"{len(texts)} text files such as {texts[0].name} hold one pose each, in a layout that is not read: "
        f"{remedy}, and pass {flags} and --depth-scale (1000 for millimetres)"
    )
