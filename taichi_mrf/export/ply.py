"""Occupied voxels as a PLY point cloud, which MeshLab, CloudCompare, Blender and Open3D open."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.export.atomic import atomic_path
from taichi_mrf.export.colors import LOWEST, marginal_colors

_VERTEX = np.dtype(
    [
        *[(name, "<f4") for name in ("x", "y", "z")],
        *[(name, "u1") for name in ("red", "green", "blue")],
        ("occupancy", "<f4"),
    ]
)
_PLY_TYPES = {"f": "float", "u": "uchar"}


def write_voxels(
    path: str | Path, centres: NDArray[np.floating], probability: NDArray[np.floating], voxel_size: float
) -> None:
    """Write voxels as one coloured point each (binary, little-endian). Raises MapFileError.

    ``centres`` (N, 3) and ``voxel_size`` are in metres, world frame. Besides its position a vertex has
    the property ``occupancy``, its marginal (N,), and the colour that stands for it.
    """
    vertices = np.empty(len(centres), dtype=_VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = centres[:, axis]
    colors = marginal_colors(probability)
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colors[:, channel]
    vertices["occupancy"] = probability
    properties = [f"property {_PLY_TYPES[_VERTEX[name].kind]} {name}" for name in _VERTEX.names or ()]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment voxel_size {voxel_size:.9g} metres",
        "comment occupancy is the marginal probability that the voxel is occupied",
        f"comment color is viridis from occupancy {LOWEST} to 1",
        f"element vertex {len(vertices)}",
        *properties,
        "end_header",
    ]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(vertices.data)
