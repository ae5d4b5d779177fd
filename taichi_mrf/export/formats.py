"""Which file a map is written to, by the name's extension: the one list of all formats."""

import difflib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError
from taichi_mrf.export.arrays import write_arrays
from taichi_mrf.export.chunk_blocks import write_chunks
from taichi_mrf.export.chunk_store import SUFFIX
from taichi_mrf.export.level_map import level_map
from taichi_mrf.export.map_server import grey_image, write_map_server
from taichi_mrf.export.mesh_file import write_mesh
from taichi_mrf.export.octomap import write_bt, write_ot
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.export.ply import write_voxels
from taichi_mrf.export.surface import smooth_surface, voxel_surface
from taichi_mrf.geometry.up import Up, plan_axes, up_from_name, up_name, up_of_first, y_up
from taichi_mrf.queries.known_bricks import QueriedMap
from taichi_mrf.queries.points import OCCUPIED, UNKNOWN

_DEFAULTS = ExportOptions()


class ExportedMap(QueriedMap, Protocol):
    """What exports need of a map; every map of methods/protocol.py has it."""

    @property
    def config(self) -> Config: ...

    def voxels(self, min_probability: float = 0.5) -> tuple[NDArray[np.float64], NDArray[np.float32]]: ...


Writer = Callable[[ExportedMap, Path, ExportOptions], list[Path]]
"""Writes a map to a file, and returns the files that were written."""


def export_map(m: ExportedMap, path: str | Path, options: ExportOptions = _DEFAULTS) -> list[Path]:
    """Write a map in the format that the file's extension stands for; returns what was written, which for a
    2D map is two files. A file appears whole or not at all.

    Raises ConfigError for an extension that no format has and for options that do not fit the map,
    MapFileError if the file cannot be written, CapacityError if memory would not do, TaichiMRFError if the
    format needs a library that is not installed.
    """
    return writer_of(path)(m, Path(path), options)


def writer_of(path: str | Path) -> Writer:
    """Who writes a file of this name. Raises ConfigError, which names the nearest extension there is."""
    suffix = Path(path).suffix.lower()
    if suffix in _WRITERS:
        return _WRITERS[suffix]
    known = ", ".join(_WRITERS)
    if not suffix:
        raise ConfigError(f"{path}: the extension says the format, and there is none; known are {known}")
    near = difflib.get_close_matches(suffix, _WRITERS, 1, cutoff=0.0)[0]
    raise ConfigError(f"{path}: there is no format {suffix}; did you mean {near}? known are {known}")


def extensions() -> Sequence[str]:
    """The extensions of all formats."""
    return tuple(_WRITERS)


def export_note(m: ExportedMap, path: str | Path, options: ExportOptions = _DEFAULTS) -> str | None:
    """What a user should be told about a file that was written: how a floor plan lies in the world."""
    if _WRITERS.get(Path(path).suffix.lower()) is not _level_map:
        return None
    reason = "--up" if options.up != "auto" else "the first keyframe's image"
    if options.up == "auto" and not m.keyframes:
        reason = "the map has no keyframes to tell; --up sets another"
    return f"{_plan_note(_up(m, options))} ({reason})"


def _up(m: ExportedMap, options: ExportOptions) -> Up:
    return up_of_first(m.keyframes.values()) if options.up == "auto" else up_from_name(options.up)


def _plan_note(up: Up) -> str:
    right, forwards = ("xyz"[axis] for axis in plan_axes(up))
    return f"up is {up_name(up)}: columns run along {right}, rows from the bottom along {forwards}"


def _points_or_surface(m: ExportedMap, path: Path, options: ExportOptions) -> list[Path]:
    if options.cubes or options.mesh:
        return _surface(m, path, options)
    write_voxels(path, *m.voxels(options.threshold), m.voxel_size)
    return [path]


def _surface(m: ExportedMap, path: Path, options: ExportOptions) -> list[Path]:
    make = voxel_surface if options.cubes else smooth_surface
    surface = make(m, options.threshold)
    if not len(surface.triangles):
        raise ConfigError(f"{path}: no voxel has a probability of {options.threshold:g}: there is no surface")
    T_gltf_world = y_up(_up(m, options)) if path.suffix.lower() == ".glb" else None
    write_mesh(path, surface, m.voxel_size, T_gltf_world)
    return [path]


def _octomap_binary(m: ExportedMap, path: Path, options: ExportOptions) -> list[Path]:
    write_bt(path, m)
    return [path]


def _octomap(m: ExportedMap, path: Path, options: ExportOptions) -> list[Path]:
    write_ot(path, m)
    return [path]


def _level_map(m: ExportedMap, path: Path, options: ExportOptions) -> list[Path]:
    up = _up(m, options)
    found = level_map(m, options.z_min, options.z_max, options.occupied_from, options.free_below, up)
    image = grey_image(found.state == OCCUPIED, found.state != UNKNOWN)
    note = _plan_note(up)
    return write_map_server(path.parent, image, found.cell_size, found.lower_corner_m, path.stem, note)


def _arrays(m: ExportedMap, path: Path, options: ExportOptions) -> list[Path]:
    write_arrays(path, m)
    return [path]


def _chunks(m: ExportedMap, path: Path, options: ExportOptions) -> list[Path]:
    write_chunks(path, m, m.config)
    return [path]


def _page(m: ExportedMap, path: Path, options: ExportOptions) -> list[Path]:
    from taichi_mrf.export.page import write_page  # viser takes a second to import

    write_page(path, m, options.threshold, _up(m, options))
    return [path]


_WRITERS: dict[str, Writer] = {
    ".ply": _points_or_surface,
    ".bt": _octomap_binary,
    ".ot": _octomap,
    ".glb": _surface,
    ".obj": _surface,
    ".stl": _surface,
    ".pgm": _level_map,
    ".yaml": _level_map,
    ".npz": _arrays,
    ".html": _page,
    SUFFIX: _chunks,
}
