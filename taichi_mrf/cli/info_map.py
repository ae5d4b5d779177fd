"""Facts of a saved map for ``taichi-mrf info``: method, voxel size, extent, keyframes, configuration."""

import zipfile
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.config.registry import octomap_method
from taichi_mrf.config.schema import Config
from taichi_mrf.config.text import differences
from taichi_mrf.export.octomap_reader import read_octomap
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.map_file import method_of, open_map_file, read_header
from taichi_mrf.methods.mrf.parked_chunks import folder_beside
from taichi_mrf.system.files import is_file, is_folder
from taichi_mrf.voxels.layout import BRICK, CHUNK_VOXELS, VOXELS

Facts = dict[str, Any]


def is_map(source: str) -> bool:
    """True if the name is that of a saved map: the file of a run, a map in chunks, a file of OctoMap's.

    An .npz of other arrays, such as laser scans, is not a map.
    """
    path = Path(source)
    suffix = path.suffix.lower()
    if suffix not in _READERS or not (is_folder(path) if suffix == ".zarr" else is_file(path)):
        return False
    return suffix != ".npz" or _is_map_file(path)


def map_facts(source: str) -> Facts:
    """Facts of a saved map, as plain values, lengths in metres. Raises MapFileError."""
    path = Path(source)
    made = datetime.fromtimestamp(path.stat().st_mtime).astimezone().isoformat(timespec="seconds")
    return {"map": source, **_READERS[path.suffix.lower()](path), "written": made}


def print_map(console: Terminal, facts: Facts) -> None:
    """The facts as a table."""
    table = Table(show_header=False, title=facts["map"], title_justify="left")
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    table.add_row("format", facts["format"])
    table.add_row("method", facts["method"])
    table.add_row("voxels", f"{facts['voxels']:,} of {facts['voxel_size']:g} m")
    if facts["extent"] is not None:
        corners = zip("xyz", *facts["extent"], strict=True)
        table.add_row("extent", ", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in corners) + " m")
    if facts.get("up"):
        table.add_row("up", facts["up"])
    if "keyframes" in facts:
        names = facts["keyframe_names"]
        table.add_row("keyframes", str(facts["keyframes"]) + (f", {names[0]} to {names[1]}" if names else ""))
        if facts["stamps_s"] is not None:
            first, last = facts["stamps_s"]
            table.add_row("time", f"{last - first:.1f} s, stamps {first:.10g} to {last:.10g}")
        half_life = facts["half_life_s"]
        table.add_row("world", f"may change, half-life {half_life:g} s" if half_life else "static")
        table.add_row("inferred", "yes" if facts["inferred"] else "no: it is inferred when it is opened")
    if "surface" in facts:
        held = [name for name in ("colors", "surface") if facts[name]]
        table.add_row("also holds", " and ".join(held) or "neither colors nor surface")
    if facts.get("chunks_outside_window"):
        folder = folder_beside(Path(facts["map"])).name
        table.add_row("outside window", f"{facts['chunks_outside_window']} chunks, in {folder}")
    for name, value in facts.get("configuration", {}).items():
        table.add_row(name, str(value))
    table.add_row("written", facts["written"])
    console.print(table)
    if "keyframes" in facts:
        console.print_line(f"taichi-mrf live {facts['map']} shows it in the browser.")


def _run_map(path: Path) -> Facts:
    with open_map_file(path) as file:
        header, bricks = read_header(path, file), file.array("bricks", "i", (None, 3))
        method = method_of(file)
        parked = len(file.array("parked", "U", (None,))) if "parked" in file else 0
    names = [keyframe.name for keyframe in header.keyframes]
    stamps = [keyframe.stamp_s for keyframe in header.keyframes]
    return {
        "format": "map of a run (.npz)",
        "method": method,
        "voxel_size": header.config.voxel_size,
        "voxels": len(bricks) * VOXELS,
        "extent": _extent(bricks, BRICK * header.config.voxel_size),
        "up": header.up_axis or None,
        "keyframes": len(names),
        "keyframe_names": [names[0], names[-1]] if names else [],
        "stamps_s": [min(stamps), max(stamps)] if stamps else None,
        "half_life_s": header.config.time.half_life_s,
        "inferred": header.settled,
        "chunks_outside_window": parked,
        "configuration": _changed(header.config),
    }


def _chunked_map(path: Path) -> Facts:
    m = ChunkedMap.open(path)
    return {
        "format": "map in chunks (.zarr)",
        "method": m.config.method,
        "voxel_size": m.voxel_size,
        "voxels": len(m.chunks) * CHUNK_VOXELS**3,
        "extent": [corner.tolist() for corner in m.extent] if len(m.chunks) else None,
        "up": m.header.up or None,
        "colors": m.has_colors,
        "surface": m.has_surface,
        "configuration": _changed(m.config),
    }


def _octomap(path: Path) -> Facts:
    leaves = read_octomap(path)
    bricks, _ = leaves.bricks()
    return {
        "format": f"OctoMap ({path.suffix})",
        "method": octomap_method().name,
        "voxel_size": leaves.voxel_size,
        "voxels": leaves.voxels,
        "extent": _extent(np.asarray(bricks), BRICK * leaves.voxel_size),
    }


_READERS: dict[str, Callable[[Path], Facts]] = {
    ".npz": _run_map,
    ".zarr": _chunked_map,
    ".bt": _octomap,
    ".ot": _octomap,
}


def _changed(config: Config) -> Facts:
    """The parameters that differ from the defaults, by name."""
    values = {}
    for name in differences(Config(), config):
        value: Any = config
        for part in name.split("."):
            value = getattr(value, part)
        values[name] = list(value) if isinstance(value, tuple) else value
    return values


def _extent(bricks: NDArray[np.integer], side_m: float) -> list[list[float]] | None:
    """Two corners of the box around all bricks, (n, 3) in bricks; None without any."""
    if not len(bricks):
        return None
    return [(bricks.min(axis=0) * side_m).tolist(), ((bricks.max(axis=0) + 1) * side_m).tolist()]


def _is_map_file(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as file:
            return {"keyframe_ids.npy", "format.npy"} <= set(file.namelist())
    except (OSError, zipfile.BadZipFile):
        return True  # reading it as a map reports what is wrong with it
