"""PLY files, which MeshLab, CloudCompare, Blender and Open3D open: points and surfaces, both in colours.

All are binary and little-endian; a table of named columns defines a vertex.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.queries.change import STATES, MapChange
from taichi_mrf.queries.colored import beside_colors, shown_colors
from taichi_mrf.queries.points import OCCUPIED
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system.atomic import atomic_path
from taichi_mrf.voxels.colors import MARGINAL_NOTE, PHOTO_NOTE, marginal_colors
from taichi_mrf.voxels.layers import LAYERS

_COLOR = [(name, "u1") for name in ("red", "green", "blue")]
_TRIANGLE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint", "i4": "int"}
NO_ORIGIN = (0.0, 0.0, 0.0)


def write_voxels(
    path: str | Path,
    centres: NDArray[np.floating],
    probability: NDArray[np.floating],
    voxel_size: float,
    colors: NDArray[np.uint8] | None = None,
    sizes: NDArray[np.floating] | None = None,
    origin_m: tuple[float, float, float] = NO_ORIGIN,
    layers: Mapping[str, NDArray] = MappingProxyType({}),
) -> None:
    """Write voxels as one coloured point each. Raises MapFileError.

    ``centres`` (N, 3) and ``voxel_size`` are in metres, world frame. Besides its position a vertex has
    the property ``occupancy``, its marginal (N,), and its colour: of ``colors`` (N, 3), which cameras saw, or
    the one that stands for the marginal. With ``sizes`` (N,), in metres, some are cells of several voxels,
    and ``size`` is a property too. Positions are in a world whose origin is ``origin_m`` in the recorded one.
    ``layers`` hold values of other layers by name, (N, ...): properties of that name, numbered where a voxel
    has several.
    """
    comments = [
        f"voxel_size {voxel_size:.9g} metres",
        "occupancy is the probability that the voxel is occupied",
        MARGINAL_NOTE if colors is None else PHOTO_NOTE,
    ]
    extra = {"occupancy": np.asarray(probability, "<f4")}
    if sizes is not None:
        extra["size"] = np.asarray(sizes, "<f4")
        comments.append("size is the side in metres of the voxel, or of a cell that stands in for several")
    for layer, values in layers.items():
        comments.append(f"{layer} is {LAYERS[layer].about}")
        columns = values.reshape(len(values), -1).T
        names = [layer] if len(columns) == 1 else [f"{layer}_{number}" for number in range(len(columns))]
        extra |= dict(zip(names, columns, strict=True))
    shown = marginal_colors(probability) if colors is None else colors
    write_points(path, centres, shown, extra, comments, origin_m)


def photo_at(m: VoxelMap, points: NDArray[np.floating]) -> NDArray[np.uint8] | None:
    """Colours that cameras saw at points (N, 3) in metres, for :func:`write_voxels`; None without any."""
    return shown_colors(m, points) if m.has_colors else None


def layers_at(m: VoxelMap, points: NDArray[np.floating]) -> dict[str, NDArray]:
    """Values (N, ...) of a map's other layers that pixels feed, of the voxels that hold points (N, 3) in
    metres, for :func:`write_voxels`."""
    return {name: layer.at(points) for name, layer in beside_colors(m).items()}


def write_points(
    path: str | Path,
    points: NDArray[np.floating],
    colors: NDArray[np.uint8],
    extra: dict[str, NDArray],
    comments: Sequence[str],
    origin_m: tuple[float, float, float] = NO_ORIGIN,
) -> None:
    """Write points (N, 3) in metres with colours (N, 3) and further properties (N,) by name. Raises
    MapFileError."""
    _write(path, _vertices(points, colors, extra, origin_m), None, comments)


def write_surface(
    path: str | Path,
    vertices_m: NDArray[np.floating],
    triangles: NDArray[np.integer],
    colors: NDArray[np.uint8],
    extra: dict[str, NDArray],
    comments: Sequence[str],
    origin_m: tuple[float, float, float] = NO_ORIGIN,
) -> None:
    """Write triangles (T, 3) over vertices (V, 3) in metres, with colours (V, 3) and further properties (V,)
    by name. Raises MapFileError."""
    faces = np.empty(len(triangles), _TRIANGLE)
    faces["count"], faces["corners"] = 3, triangles
    _write(path, _vertices(vertices_m, colors, extra, origin_m), faces, comments)


def _vertices(
    points: NDArray[np.floating],
    colors: NDArray[np.uint8],
    extra: dict[str, NDArray],
    origin_m: tuple[float, float, float],
) -> NDArray:
    """A row a point, in the recorded world: far from its origin 32 bits would round to decimetres."""
    place = [(name, "<f8" if any(origin_m) else "<f4") for name in "xyz"]
    dtype = np.dtype([*place, *_COLOR, *((name, values.dtype) for name, values in extra.items())])
    vertices = np.empty(len(points), dtype=dtype)
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis] + origin_m[axis] if any(origin_m) else points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colors[:, channel]
    for name, values in extra.items():
        vertices[name] = values
    return vertices


def _write(path: str | Path, vertices: NDArray, faces: NDArray | None, comments: Sequence[str]) -> None:
    properties = [
        f"property {_PLY_TYPES[vertices.dtype[name].str[1:]]} {name}" for name in vertices.dtype.names or ()
    ]
    surface = (
        [f"element face {len(faces)}", "property list uchar int vertex_indices"] if faces is not None else []
    )
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {text}" for text in comments),
        f"element vertex {len(vertices)}",
        *properties,
        *surface,
        "end_header",
    ]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(vertices.data)
        if faces is not None:
            file.write(faces.data)


APPEARED, VANISHED = (213, 94, 0), (0, 114, 178)
"""RGB of voxels that are occupied only in the second map, and only in the first."""


def write_changes(
    path: str | Path,
    change: MapChange,
    voxel_size: float,
    origin_m: tuple[float, float, float] = NO_ORIGIN,
) -> int:
    """Write the voxels that are occupied in one of the maps only; returns how many. Their origin is
    ``origin_m`` in the recorded world. Raises MapFileError.

    Besides its position and colour a point has the properties ``before`` and ``after``, its states, and
    ``difference``, by how much its probability has grown.
    """
    shown = (change.before == OCCUPIED) | (change.after == OCCUPIED)
    appeared = change.after[shown] == OCCUPIED
    colors = np.where(appeared[:, None], APPEARED, VANISHED).astype(np.uint8)
    extra = {
        "before": change.before[shown].astype(np.uint8),
        "after": change.after[shown].astype(np.uint8),
        "difference": change.difference[shown].astype("<f4"),
    }
    states = ", ".join(f"{number} {name}" for number, name in enumerate(STATES))
    comments = [
        f"voxel_size {voxel_size:.9g} metres",
        f"before and after are states: {states}",
        f"color is {APPEARED} where a surface has appeared, {VANISHED} where one has vanished",
    ]
    write_points(path, change.points[shown], colors, extra, comments, origin_m)
    return int(shown.sum())
