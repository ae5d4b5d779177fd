"""Writes a map in the format of a file's extension: the one list of all formats.

An .npz file holds plain arrays, which NumPy alone can read.
``voxels`` (n, 3) int32: coordinates of all known voxels; voxel i covers [i, i + 1) times ``voxel_size``, in
metres, along each axis. ``probability`` (n,) float32: of being occupied. ``state`` (n,) int8: 1 free, 2
occupied. ``free_bricks`` (k, 3) int32: free cubes of 8 voxels a side, whose voxels are not listed; brick i
covers [8 i, 8 i + 8) voxels. ``prior``: the probability of unknown voxels. ``origin`` (3,): where
the map's origin is in the recorded world, unless that is 0. Layers that pixels feed, but for colours, have
their values (n, ...) of the voxels under their names (voxels/layers.py).
"""

import difflib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.arguments import shown
from taichi_mrf.config.registry import METHODS
from taichi_mrf.errors import ArgumentTypeError, ConfigError
from taichi_mrf.export.chunk_blocks import write_chunks
from taichi_mrf.export.chunk_store import SUFFIX
from taichi_mrf.export.fused_surface import measured_surface
from taichi_mrf.export.map_server import LevelMap, grey_image, level_map, write_map_server
from taichi_mrf.export.map_sink import CLOUD, COSTMAP, OCTOMAP, PATH, SURFACE, MapSink, Points
from taichi_mrf.export.octomap import write_bt, write_ot
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.export.ply import NO_ORIGIN, layers_at, write_surface, write_voxels
from taichi_mrf.export.rerun_file import require_rerun, write_rrd
from taichi_mrf.export.robot_messages import require_libraries as require_message_libraries
from taichi_mrf.export.robot_messages import write_mcap
from taichi_mrf.export.surface import Surface, photographed, smooth_surface, voxel_surface
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.geometry.up import Z_UP, Up, plan_axes, up_from_name, up_name, y_up
from taichi_mrf.queries.cells import standing_cells
from taichi_mrf.queries.colored import beside_colors, shown_colors
from taichi_mrf.queries.known_bricks import BrickReader, seen_free_bricks
from taichi_mrf.queries.points import OCCUPIED, UNKNOWN, probability
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system.atomic import atomic_path, write_npz
from taichi_mrf.system.libraries import library
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layers import COLORS, LAYERS
from taichi_mrf.voxels.layout import BRICK, VOXELS, offsets_in_brick

_DEFAULTS = ExportOptions()

NO_SURFACE = (
    "the images of keyframes that measured the surface are not in the map, or not of all: map the recording "
    "again with --keep-surface, or export from the map.npz of a run"
)
"""Error for a missing measured surface, and its remedy."""

_BYTES_PER_VOXEL = 40


Writer = Callable[[VoxelMap, Path, ExportOptions], list[Path]]
"""Writes a map to a file, and returns the files that were written."""


def export_map(m: VoxelMap, path: str | Path, options: ExportOptions = _DEFAULTS) -> list[Path]:
    """Write a map to a file, in the format of its extension.

    ``m`` is any map, or a part of a chunked map (:func:`take_part`). The formats are ``.ply`` (points, or a
    mesh), ``.glb``, ``.obj`` and ``.stl`` (meshes), ``.bt`` and ``.ot`` (OctoMap), ``.pgm`` or ``.yaml`` (a
    2D map for ROS), ``.mcap`` (messages for Foxglove and ROS 2), ``.rrd`` (the same for Rerun), ``.npz``
    (arrays), ``.html`` (a page that shows the map) and ``.zarr`` (chunks, for :class:`ChunkedMap`).
    ``options`` are the formats' settings. A file is written completely or not at all.

    Returns the paths of the files written; a 2D map has two. Raises ArgumentTypeError if ``m`` is no map,
    ConfigError for an unknown extension and for options that do not fit the map, MapFileError if the file
    cannot be written, CapacityError if there is not enough memory, and TaichiMRFError if the format needs a
    library that is not installed.
    """
    if not hasattr(m, "view"):
        raise ArgumentTypeError(f"m must be a map, or a part of one from take_part, not {shown(m)}")
    return _format_of(path).write(m, Path(path), options)


def _format_of(path: str | Path) -> "ExportFormat":
    """The format of a file of this name. Raises ConfigError for an unknown extension."""
    suffix = Path(path).suffix.lower()
    if suffix in FORMATS:
        return FORMATS[suffix]
    known = ", ".join(FORMATS)
    if not suffix:
        raise ConfigError(f"{path}: no file extension: cannot choose an export format ({known})")
    near = difflib.get_close_matches(suffix, FORMATS, 1, cutoff=0.0)[0]
    raise ConfigError(f"{path}: unknown export format {suffix}; did you mean {near}? Choose from {known}")


def require_libraries(path: str | Path) -> None:
    """Raises TaichiMRFError if the format of a file's extension needs a library that is not installed, and
    ConfigError for an unknown one."""
    _format_of(path).require(f"{Path(path).suffix.lower()} files need")


def export_note(m: VoxelMap, path: str | Path, options: ExportOptions = _DEFAULTS) -> str | None:
    """A note for the user on a written file: what a mesh shows, how a floor plan lies in the world, and that
    its coordinates are not the recording's, if that is so."""
    origin = m.config.volume.origin
    local = any(origin) and not _format_of(path).in_world
    told = "its coordinates begin at {:.0f} {:.0f} {:.0f} of the recorded world".format(*origin)
    return "; ".join(filter(None, [_shown_note(m, path, options), told if local else None])) or None


def _shown_note(m: VoxelMap, path: str | Path, options: ExportOptions) -> str | None:
    writer = _format_of(path).write
    if writer is _surface or (writer is _points_or_surface and options.mesh):
        if options.cubes or not METHODS[m.config.method].measures_surface:
            return None
        if _with_rays(m, Path(path), options) is None:
            no_images = options.surface == "auto" and METHODS[m.config.method].can_freeze
            remedy = f"; {NO_SURFACE}" if no_images else ""
            return f"the surface where the marginal is {options.threshold:g}{remedy}"
        number = len(m.keyframes) + len(getattr(m, "frozen", ()))
        who = f"{number} keyframes" if number else "keyframes"
        return f"the surface that the rays of {who} measured"
    if writer is not _level_map:
        return None
    reason = "--up" if options.up != "auto" else "as in the map's first keyframe"
    if options.up == "auto" and m.up is None:
        reason = "assumed: the map does not hold which way is up; --up sets another"
    return f"{_plan_note(_up(m, options))} ({reason})"


def _up(m: VoxelMap, options: ExportOptions) -> Up:
    return m.up or Z_UP if options.up == "auto" else up_from_name(options.up)


def _plan_note(up: Up) -> str:
    right, forwards = ("xyz"[axis] for axis in plan_axes(up))
    return f"up is {up_name(up)}: columns run along {right}, rows from the bottom along {forwards}"


def _points_or_surface(m: VoxelMap, path: Path, options: ExportOptions) -> list[Path]:
    if options.cubes or options.mesh:
        return _surface(m, path, options)
    centres, p, sizes, colors = _points(m.decided, path, options)
    layers = layers_at(m.decided, centres)
    write_voxels(path, centres, p, m.voxel_size, colors, sizes, m.config.volume.origin, layers)
    return [path]


def _points(m: VoxelMap, path: Path, options: ExportOptions) -> Points:
    centres, p = m.voxels(options.threshold)
    sizes = np.full(len(p), m.voxel_size)
    if options.cells:
        cells = standing_cells(m, options.threshold)
        centres = np.concatenate([centres, *(each.centres(m.voxel_size) for each in cells)])
        p = np.concatenate([p, *(each.probability for each in cells)])
        sizes = np.concatenate([sizes, *(np.full(len(each), each.side * m.voxel_size) for each in cells)])
    colored = _photo(m, path, options)
    return Points(centres, p, sizes, None if colored is None else shown_colors(colored, centres))


def _surface(m: VoxelMap, path: Path, options: ExportOptions) -> list[Path]:
    if options.cubes:
        surface = voxel_surface(m.decided, options.threshold, options.cells)
    elif (measured := _with_rays(m, path, options)) is not None:
        surface = measured_surface(measured)
    else:
        surface = smooth_surface(m, options.threshold)
    if not len(surface.triangles):
        raise ConfigError(f"{path}: no voxel has a probability of {options.threshold:g}: there is no surface")
    colored = _photo(m, path, options)
    if colored is not None:
        surface = photographed(colored, surface, options.cubes)
    T_gltf_world = y_up(_up(m, options)) if path.suffix.lower() == ".glb" else None
    write_mesh(path, surface, m.voxel_size, T_gltf_world, m.config.volume.origin)
    return [path]


def _with_rays(m: VoxelMap, path: Path, options: ExportOptions) -> VoxelMap | None:
    """The map, if its mesh is to be what rays measured. Raises ConfigError if it has none."""
    if options.surface != "marginal" and m.has_surface:
        return m
    if options.surface == "rays":
        raise ConfigError(f"{path}: {NO_SURFACE}; --surface marginal needs none")
    return None


def _photo(m: VoxelMap, path: Path, options: ExportOptions) -> VoxelMap | None:
    """The map, if its colours are to be those that cameras saw. Raises ConfigError if it has none."""
    if m.has_colors and options.color_by != "marginal":
        return m
    if options.color_by == "photo":
        raise ConfigError(f"{path}: the map has no colours: map the recording with --color")
    return None


def _octomap_binary(m: VoxelMap, path: Path, options: ExportOptions) -> list[Path]:
    write_bt(path, m.decided, options.cells)
    return [path]


def _octomap(m: VoxelMap, path: Path, options: ExportOptions) -> list[Path]:
    write_ot(path, m.decided, _photo(m, path, options), options.cells)
    return [path]


def _level_map(m: VoxelMap, path: Path, options: ExportOptions) -> list[Path]:
    up = _up(m, options)
    found = _level(m.decided, options, up)
    image = grey_image(found.state == OCCUPIED, found.state != UNKNOWN)
    (x_m, y_m), (x, y), origin_m = found.lower_corner_m, found.axes, m.config.volume.origin
    corner_m = x_m + origin_m[x], y_m + origin_m[y]
    return write_map_server(path.parent, image, found.cell_size, corner_m, path.stem, _plan_note(up))


def _level(m: VoxelMap, options: ExportOptions, up: Up) -> LevelMap:
    return level_map(m, options.z_min, options.z_max, options.occupied_from, options.free_below, up)


@dataclass(frozen=True)
class MapToSend:
    """Source of messages: a map, and ``poses``, those of its keyframes by stamp in seconds."""

    m: VoxelMap
    options: ExportOptions
    poses: Mapping[float, Pose]

    @cached_property
    def decided(self) -> VoxelMap:
        """The reading of the map whose voxels are sent, found once for all messages."""
        return self.m.decided

    @property
    def stamp_s(self) -> float:
        """Stamp of the newest keyframe, 0 without one."""
        return max(self.poses, default=0.0)


def _messages(m: VoxelMap, path: Path, options: ExportOptions) -> list[Path]:
    write_mcap(path, lambda sink: _log_all(sink, m, options))
    return [path]


def _recording(m: VoxelMap, path: Path, options: ExportOptions) -> list[Path]:
    cameras = {k.stamp_s: k.camera for k in _keyframes(m)}
    write_rrd(path, lambda sink: _log_all(sink, m, options), cameras, _up(m, options))
    return [path]


def _keyframes(m: VoxelMap) -> Iterable[Any]:
    return getattr(m, "keyframes", {}).values()


def _log_all(sink: MapSink, m: VoxelMap, options: ExportOptions) -> None:
    sent = MapToSend(m, options, {k.stamp_s: k.T_world_camera for k in _keyframes(m)})
    for stamp_s in sorted(sent.poses):
        sink.transform(sent.poses[stamp_s], stamp_s)
    for log_message in MESSAGES.values():
        log_message(sink, sent)


def _log_costmap(channels: MapSink, sent: MapToSend) -> None:
    """Without a band of heights there is no costmap."""
    options, up = sent.options, _up(sent.m, sent.options)
    if options.z_min is not None or options.z_max is not None:
        channels.costmap(_level(sent.decided, options, up), up[1] * (options.z_min or 0.0), sent.stamp_s)


def _log_path(channels: MapSink, sent: MapToSend) -> None:
    if sent.poses:
        channels.path(sent.poses)


def _log_surface(channels: MapSink, sent: MapToSend) -> None:
    measured, threshold = _with_rays(sent.m, Path(SURFACE), sent.options), sent.options.threshold
    surface = smooth_surface(sent.m, threshold) if measured is None else measured_surface(measured)
    channels.surface(surface, sent.stamp_s)


MESSAGES: dict[str, Callable[[MapSink, MapToSend], None]] = {
    CLOUD: lambda to, sent: to.voxels(_points(sent.decided, Path(CLOUD), sent.options), sent.stamp_s),
    OCTOMAP: lambda to, sent: to.octomap(sent.decided, sent.options.cells, sent.stamp_s),
    COSTMAP: _log_costmap,
    PATH: _log_path,
    SURFACE: _log_surface,
}
"""The messages of a map by their topics, for files and servers; beside them are transforms of keyframes."""


def _arrays(m: VoxelMap, path: Path, options: ExportOptions) -> list[Path]:
    write_arrays(path, m)
    return [path]


def _chunks(m: VoxelMap, path: Path, options: ExportOptions) -> list[Path]:
    kept = options.surface == "rays" or (options.surface == "auto" and m.config.keep_surface)
    measured = _with_rays(m, path, options) if kept else None
    up = _up(m, options) if options.up != "auto" else None
    fed = beside_colors(m)
    if _photo(m, path, options) is not None:
        fed[COLORS] = m.pixel_layers[COLORS]
    write_chunks(path, m, up, fed, measured)
    return [path]


def _page(m: VoxelMap, path: Path, options: ExportOptions) -> list[Path]:
    from taichi_mrf.export.page import write_page  # viser takes a second to import

    write_page(path, m.decided, options.threshold, _up(m, options), _photo(m, path, options), options.cells)
    return [path]


@dataclass(frozen=True)
class ExportFormat:
    """The entry of a format: what writes it, what raises TaichiMRFError if a library that it needs is not
    installed, and whether it has coordinates of the recorded world, however far its origin is."""

    write: Writer
    require: Callable[[str], Any] = lambda who: None
    in_world: bool = False


def _trimesh(who: str) -> Any:
    return library("trimesh", who, "mesh")


FORMATS: dict[str, ExportFormat] = {
    ".ply": ExportFormat(_points_or_surface, in_world=True),
    ".bt": ExportFormat(_octomap_binary),
    ".ot": ExportFormat(_octomap),
    ".glb": ExportFormat(_surface, _trimesh),
    ".obj": ExportFormat(_surface, _trimesh, in_world=True),
    ".stl": ExportFormat(_surface, _trimesh),
    ".pgm": ExportFormat(_level_map, in_world=True),
    ".yaml": ExportFormat(_level_map, in_world=True),
    ".mcap": ExportFormat(_messages, require_message_libraries),
    ".rrd": ExportFormat(_recording, lambda who: require_rerun()),
    ".npz": ExportFormat(_arrays),
    ".html": ExportFormat(_page),
    SUFFIX: ExportFormat(_chunks, lambda who: library("zarr", "maps in chunks need", "store")),
}
"""Every format by its extension."""


def write_mesh(
    path: str | Path,
    surface: Surface,
    voxel_size: float,
    T_gltf_world: Pose | None = None,
    origin_m: tuple[float, float, float] = NO_ORIGIN,
) -> None:
    """Write a surface in the format of the file's extension: .ply, .glb, .obj or .stl, which has no colours.

    ``T_gltf_world`` is where the world stands in a .glb, in which y is up; the vertices stay in the world,
    and the file's only node holds it. A .ply and an .obj have coordinates of the recorded world, in which the
    map's origin is ``origin_m``; the numbers of the others are too short for a far one. Raises MapFileError,
    and TaichiMRFError without trimesh for all but .ply.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".ply":
        comments = [f"voxel_size {voxel_size:.9g} metres", surface.colors_note]
        extra: dict[str, NDArray] = {}
        if surface.normals is not None:
            extra |= dict(zip(("nx", "ny", "nz"), surface.normals.T, strict=True))
        if surface.std_m is not None:
            extra["std_m"] = surface.std_m
        write_surface(path, surface.vertices_m, surface.triangles, surface.colors, extra, comments, origin_m)
        return
    trimesh = _trimesh(f"{suffix} files need")
    far = suffix == ".obj" and any(origin_m)
    vertices_m = surface.vertices_m.astype(np.float64) + origin_m if far else surface.vertices_m
    mesh = trimesh.Trimesh(
        vertices_m, surface.triangles, vertex_normals=surface.normals,
        vertex_colors=surface.colors, process=False, validate=False,
    )  # fmt: skip
    whole = mesh
    if suffix == ".glb":
        whole = trimesh.Scene()
        transform = np.eye(4) if T_gltf_world is None else T_gltf_world
        whole.add_geometry(mesh, node_name="map", geom_name="map", transform=transform)
    content = whole.export(file_type=suffix[1:])
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode("ascii") if isinstance(content, str) else content)


def write_arrays(path: str | Path, m: VoxelMap) -> None:
    """Write the arrays described at the top of this file. Raises MapFileError, CapacityError."""
    reader, layers = BrickReader(m.decided), beside_colors(m.decided)
    count = len(reader.bricks) * VOXELS
    bytes_per_voxel = _BYTES_PER_VOXEL + sum(2 * LAYERS[name].nbytes for name in layers)
    check_memory(bytes_per_voxel * count, f"{count / 1e6:.3g} million voxels as arrays")
    voxels, probabilities, states = (
        [np.zeros((0, 3), np.int32)],
        [np.zeros(0, np.float32)],
        [np.zeros(0, np.int8)],
    )
    of_layers: dict[str, list[NDArray]] = {
        name: [np.zeros((0, *LAYERS[name].shape), LAYERS[name].dtype)] for name in layers
    }
    for bricks, log_odds, state in reader.batches(reader.bricks):
        row, number = np.nonzero(state != UNKNOWN)
        voxels.append(bricks[row] * BRICK + offsets_in_brick()[number])
        probabilities.append(probability(log_odds[row, number]))
        states.append(state[row, number])
        for name, layer in layers.items():
            of_layers[name].append(layer.within(reader.slots(bricks))[row, number])
    arrays: dict[str, NDArray[Any]] = {
        "voxels": np.concatenate(voxels),
        "probability": np.concatenate(probabilities),
        "state": np.concatenate(states),
        "free_bricks": seen_free_bricks(m),
        "voxel_size": np.asarray(m.voxel_size),
        "prior": probability(np.array([reader.pool.prior_log_odds], np.float32)).reshape(()),
    }
    if any(m.config.volume.origin):
        arrays["origin"] = np.array(m.config.volume.origin)
    arrays |= {name: np.concatenate(values) for name, values in of_layers.items()}
    write_npz(path, arrays)
