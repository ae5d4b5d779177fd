"""Command ``taichi-mrf export``: check the names, load the map, write each file, print the list."""

import json
import math
import os
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from taichi_mrf.cli.options.saved_maps import Export
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.config.registry import methods_with
from taichi_mrf.errors import ConfigError, MapFileError, TaichiMRFError
from taichi_mrf.export.chunk_store import SUFFIX, new_store
from taichi_mrf.export.formats import export_map, export_note, require_libraries
from taichi_mrf.methods.capabilities import can_freeze, has_layers
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import in_chunks, take_part
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import atomic_path
from taichi_mrf.system.files import exists, is_file, is_folder


def run_export(options: Export) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError.

    All names are checked before the map is read. Files are made beside their places and moved there when all
    are complete: if one fails, none is written.
    """
    _check_names(options)
    runtime.init(options.arch)
    console = Terminal()
    m = _opened(options)
    written: list[dict[str, Any]] = []
    with ExitStack() as stack:
        made: list[tuple[Path, Path]] = []
        for path in options.to:
            staging = Path(stack.enter_context(_staging(path)))
            begin = time.perf_counter()
            files = _export(m, staging / path.name, path, options)
            seconds = round(time.perf_counter() - begin, 3)
            made += [(file, path.parent / file.name) for file in files]
            written += [{"file": str(path.parent / file.name), "seconds": seconds} for file in files]
        for file, place in made:
            _move(file, place)
    for entry in written:
        entry["bytes"] = _size(Path(entry["file"]))
        if not options.json:
            _print_file(console, entry)
    for path in options.to:
        note = export_note(m, path, options.options)
        if note is not None and not options.json:
            console.print_line(f"{path.name}: {note}")
    if options.json:
        print(json.dumps(written, indent=2))
    return 0


def _check_names(options: Export) -> None:
    """Check what can be checked without the map. Raises TaichiMRFError."""
    if not options.to:
        raise ConfigError("--to needs at least one file")
    places = [os.path.realpath(path) for path in options.to]
    for path, place in zip(options.to, places, strict=True):
        require_libraries(path)
        if place == os.path.realpath(options.map):
            raise ConfigError(f"{path}: the map itself would be overwritten")
        if places.count(place) > 1:
            raise ConfigError(f"{path}: is named twice")
        folder = _nearest_folder(path)
        if not is_folder(folder):
            raise MapFileError(f"{path}: cannot be written: {folder} is not a folder")
        if not os.access(folder, os.W_OK):
            raise MapFileError(f"{path}: cannot be written: Permission denied")
        if exists(path) and not is_file(path) and path.suffix != SUFFIX:
            raise MapFileError(f"{path}: cannot be written: it is not a regular file")


def _staging(path: Path) -> "tempfile.TemporaryDirectory[str]":
    """A folder beside the file, or beside the first folder to be made, so that moving it is a rename."""
    return tempfile.TemporaryDirectory(prefix=".export-", dir=_nearest_folder(path))


def _nearest_folder(path: Path) -> Path:
    """The innermost of the folders around a file that exists; export makes the others."""
    return next(parent for parent in path.absolute().parents if exists(parent))


def _export(m: VoxelMap, staged: Path, path: Path, options: Export) -> list[Path]:
    """Make one file; an error names the place that it is for."""
    try:
        return export_map(m, staged, options.options)
    except TaichiMRFError as error:
        raise type(error)(str(error).replace(str(staged.parent), str(path.parent))) from error


def _move(file: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    with new_store(place) if is_folder(file) else atomic_path(place) as temporary:
        os.replace(file, temporary)


def _opened(options: Export) -> VoxelMap:
    """The map, the part of a map in chunks, or the layer of a map that was asked for."""
    layered = options.layer != "both" or options.at is not None
    if options.map.suffix == SUFFIX:
        if layered:
            raise ConfigError(f"--layer and --at need the map.npz of a run; {options.map} has no keyframes")
        return take_part(ChunkedMap.open(options.map), options.lower, options.upper)
    m = load_map(options.map)
    whole = in_chunks(m)
    if whole is not None:
        if layered:
            raise ConfigError(
                f"--layer and --at need a map in memory; {options.map} was mapped with volume.window_m and "
                f"has {len(whole.chunks)} chunks in {whole.store.path.name}"
            )
        return take_part(whole, options.lower, options.upper)
    if options.lower is not None or options.upper is not None:
        raise ConfigError(f"--lower and --upper need a map in chunks (.zarr); {options.map} is not one")
    return _layer(m, options) if layered else m


def _layer(m: OccupancyMap, options: Export) -> VoxelMap:
    """The layer of a map, as of the time that was asked for."""
    if not has_layers(m):
        able = methods_with("has_layers")
        raise ConfigError(f"--layer and --at need a map of {able}; {options.map} is one of {m.METHOD.name}")
    if m.config.time.is_static:
        raise ConfigError(
            f"--layer and --at need a map of a world that may change, mapped with --time.half-life-s; "
            f"{options.map} is one of a static world"
        )
    stamp_s = options.at
    if stamp_s is not None:
        first_s = min((keyframe.stamp_s for keyframe in m.keyframes.values()), default=-math.inf)
        stamp_s += m.now_s if stamp_s < 0 else 0.0
        if stamp_s < first_s and not (can_freeze(m) and m.frozen):
            raise ConfigError(
                f"--at {options.at:g}: {options.map} has no keyframe at that time; "
                f"they are from {first_s:.10g} to {m.now_s:.10g} s"
            )
    return m.layer(options.layer, stamp_s)


def _size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _print_file(console: Terminal, entry: dict[str, Any]) -> None:
    console.print_line(f"{entry['file']} ({entry['bytes'] / 1e6:.2f} MB, {entry['seconds']:.1f} s)")
