"""``taichi-mrf info``: the backend that would be used, and what else there is; or what is in a source of
frames, or in a saved map."""

import json
import shlex
import zipfile
from collections.abc import Callable
from dataclasses import asdict, fields
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from taichi_mrf.cli.options.saved_maps import Info
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.config.registry import octomap_method
from taichi_mrf.config.schema import Arch, Config
from taichi_mrf.config.text import differences
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.entries import ROBOTS
from taichi_mrf.datasets.recorded_noise import note_of_filling, proposed_voxel_size, some_depths
from taichi_mrf.datasets.registry import format_name, is_rendered, topics_in
from taichi_mrf.datasets.ros.bag import BagSummary
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.datasets.summary import UNUSED_COLOR, note_unused_color, summarise
from taichi_mrf.errors import DatasetError
from taichi_mrf.export.octomap_reader import read_octomap
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.map_file import method_of, open_map_file, read_header
from taichi_mrf.methods.mrf.parked_chunks import folder_beside
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.origins import origins_of
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.system import runtime
from taichi_mrf.system.files import is_file, is_folder
from taichi_mrf.voxels.layers import pixel_layers
from taichi_mrf.voxels.layout import BRICK, CHUNK_VOXELS, VOXELS

CANNOT_BE_MAPPED = 2
"""Exit status for a recording that ``map`` refuses."""

Facts = dict[str, Any]


def run_info(options: Info) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    console = Terminal()
    if options.source is not None and is_map(options.source):
        facts = map_facts(options.source)
        if options.json:
            print(json.dumps(facts, indent=2))
        else:
            print_map(console, facts)
    elif options.json:
        facts = _backend_facts(options.arch) if options.source is None else _source_facts(options)
        print(json.dumps(facts, indent=2))
        return 0 if facts.get("problem") is None else CANNOT_BE_MAPPED
    elif options.source is None:
        _print_backends(console, options.arch)
    elif not _print_source(console, options.source, options.arch, options.reading):
        return CANNOT_BE_MAPPED
    return 0


def _backend_facts(arch: Arch) -> dict[str, Any]:
    runtime.init(arch)
    choice = runtime.choice()
    assert choice is not None
    return {
        "backend": choice.name,
        "device": choice.device,
        "compiler": choice.compiler,
        "backends": {
            status.name: {"device": status.device, "problem": status.problem} for status in runtime.backends()
        },
        "versions": runtime.versions(),
    }


def _source_facts(options: Info) -> dict[str, Any]:
    assert options.source is not None
    facts: dict[str, Any] = {"source": options.source}
    bag = topics_in(options.source)
    if bag is not None:
        facts["topics"] = [
            {"name": topic.name, "type": topic.type, "messages": topic.messages} for topic in bag.topics
        ]
    if is_rendered(options.source):
        runtime.init(options.arch)
    dataset = open_dataset(options.source, color=False, **options.reading.keywords())
    note_unused_color(dataset, options.source, options.reading)
    notes = [*dataset.notes, *note_of_filling(some_depths(dataset))]
    found = summarise(dataset)
    content = {field.name: getattr(found, field.name) for field in fields(found)}
    content["camera"] = _camera_facts(found.camera)
    content["voxel_size"] = proposed_voxel_size(dataset)
    return facts | {"format": format_name(options.source)} | content | {"notes": notes}


def _camera_facts(camera: Camera) -> dict[str, Any]:
    """A camera as plain values: all of a pinhole, of others the kind and the size of their images."""
    if isinstance(camera, PinholeCamera):
        return asdict(camera)
    return {"kind": type(camera).__name__, "width": camera.width, "height": camera.height}


def _camera_words(camera: Camera) -> str:
    size = f"{camera.width} x {camera.height}"
    if isinstance(camera, PinholeCamera):
        return f"{size}, fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g}"
    moving = "" if origins_of(camera) is None else ", of a sensor that moves during a scan"
    if isinstance(camera, RayTable) and not camera.has_pattern:
        return f"{camera.width} rays without a pattern{moving}"
    return f"{type(camera).__name__}, {size} rays{moving}"


def _print_backends(console: Terminal, arch: Arch) -> None:

    runtime.init(arch)
    choice = runtime.choice()
    assert choice is not None
    table = Table("backend", "here", "can do", title="Backends", title_justify="left")
    for status in runtime.backends():
        here = status.device if status.problem is None else f"no: {status.problem}"
        table.add_row(status.name, here, status.ability)
    console.print(f"Runs on {choice.name}: {choice.device}, {choice.reason}.")
    for name, why in choice.rejected.items():
        console.print(f"Not on {name}: {why}.")
    console.print(table)
    for name, version in runtime.versions().items():
        console.print_line(f"{name} {version}")


def _print_source(console: Terminal, source: str, arch: Arch, reading: SourceFlags) -> bool:
    """Print what is in a source; returns whether it can be mapped."""
    bag = topics_in(source)
    if bag is not None:
        _print_topics(console, bag)
    if is_rendered(source):
        runtime.init(arch)
    try:
        dataset = open_dataset(source, color=False, **reading.keywords())
        note_unused_color(dataset, source, reading)
    except DatasetError as error:
        if bag is None:
            raise
        console.print_line(f"It cannot be mapped as it is: {error}")
        for name in bag.sources:
            if bag.flags or name != source:  # that has just been refused, and the error says what it needs
                console.print_line(_command(f"{shlex.quote(name)}{bag.flags}", name.startswith(ROBOTS)))
        return False
    usable = _print_frames(console, format_name(source), dataset)
    if usable:
        console.print_line(_map_command(source, dataset, reading))
    return usable


def _map_command(source: str, dataset: Dataset, reading: SourceFlags) -> str:
    """The command that maps a source as it was read here, with what was found in it. Noise and reach that a
    recording states need no flag."""
    words = [source, *reading.words()]
    words += ["--color"] if UNUSED_COLOR in dataset.notes else []
    return _command(shlex.join(words), dataset.endless)


def _command(words: str, endless: bool) -> str:
    return f"taichi-mrf live {words}" if endless else f"taichi-mrf map {words} --out DIR"


def _print_topics(console: Terminal, bag: BagSummary) -> None:
    table = Table(title=f"Topics in {bag.duration:.1f} s", title_justify="left")
    for heading in ("topic", "type", "messages", "Hz", "holds"):
        table.add_column(heading, overflow="fold")
    for topic in bag.topics:
        rate = bag.rate(topic)
        hz = "" if rate is None else f"{rate:.1f}"
        table.add_row(topic.name, topic.type, str(topic.messages), hz, bag.remarks.get(topic.name, ""))
    console.print(table)
    for transform in bag.transforms:
        console.print_line(f"tf {transform}")


def _print_frames(console: Terminal, format_name: str, dataset: Dataset) -> bool:
    found, camera = summarise(dataset), dataset.camera
    table = Table(show_header=False, title=dataset.name, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    table.add_row("format", format_name)
    table.add_row("frames", "without end" if found.frames is None else str(found.frames))
    table.add_row("camera", _camera_words(camera))
    if found.seconds is not None:
        table.add_row("time", f"{found.seconds:.1f} s")
    if found.depth_range is not None:
        low, high = found.depth_range
        table.add_row(
            "depth", f"{low:.2f} to {high:.2f} m (1 to 99 %), in {found.measured:.0%} of the pixels"
        )
        dataset.notes += note_of_filling(some_depths(dataset))
        size_cm = 100 * proposed_voxel_size(dataset)
        table.add_row("voxel size", f"{size_cm:g} cm fits; map takes it unless --voxel-size is given")
    if found.centre_range is not None:
        axes = (f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", *found.centre_range, strict=True))
        table.add_row("camera path", f"{', '.join(axes)} m")
    console.print(table)
    for note in [*dataset.notes, *([found.problem] if found.problem else [])]:
        console.print_line(f"Note: {note}")
    return found.usable and found.problem is None  # map stops at the first broken frame


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
    if facts.get("free_space"):
        table.add_row("free space", facts["free_space"])
    held = [*facts.get("pixel_layers", ()), *(["surface"] if facts.get("surface") else [])]
    if held or "surface" in facts:
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
        file.check()
        parked = len(file.array("parked", "U", (None,))) if "parked" in file else 0
        beside = {image for keyframe in header.keyframes for image in keyframe.own.images}
        beside |= {"color" for keyframe in header.keyframes if keyframe.color is not None}
        fed = [
            name
            for name, made in pixel_layers().items()
            if made.image in beside or name in file or f"{made.stored}_numbers" in file
        ]
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
        "free_space": None if header.promise is None else header.promise.sentence(),
        "chunks_outside_window": parked,
        "pixel_layers": fed,
        "configuration": _changed_parameters(header.config),
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
        "pixel_layers": list(m.pixel_layers),
        "configuration": _changed_parameters(m.config),
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


def _changed_parameters(config: Config) -> Facts:
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
