"""An MRFMap as one .npz file.

The file holds the parameters, the bricks with their beliefs, and the keyframes' images and poses. It does not
hold the messages: they are the largest part of a map in memory and can be computed from the rest. It holds
the beliefs so that a loaded map answers queries at once, and with dates also what all evidence says together,
from which what moves follows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.inference.voxel_share import VoxelShare
from taichi_mrf.methods.map_file import (
    FORMAT,
    MapHeader,
    StoredKeyframe,
    open_map_file,
    read_bricks,
    read_header,
    read_places,
)
from taichi_mrf.methods.mrf.frozen_arrays import (
    WaitingMessages,
    dated_arrays,
    ray_arrays,
    read_dated,
    read_rays,
    read_shares,
    read_waiting,
    share_arrays,
    waiting_arrays,
    waiting_of,
)
from taichi_mrf.methods.mrf.inferring import show
from taichi_mrf.methods.mrf.kept_rays import RayShare
from taichi_mrf.methods.mrf.moving_window import MovingWindow
from taichi_mrf.methods.mrf.parts import MapParts
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.npz_file import NpzFile
from taichi_mrf.voxels.layers import LAYERS, pixel_layers
from taichi_mrf.voxels.layout import VOXELS


@dataclass(frozen=True)
class MapContents:
    """The contents of an MRFMap's file. ``belief`` and ``evidence`` are (n, 512) log-odds of the ``bricks``
    (n, 3); of a dated map ``total`` (n, 512) are those of all evidence together, whatever its age, and
    ``frozen_dated`` is what frozen keyframes say of the voxels, and as of when (n), and ``waiting`` what
    others of them have still to say;
    ``frozen_owners`` (n,) counts the frozen keyframes that own each brick, ``frozen_crossed`` (m, 3)
    are the bricks that they crossed, and ``frozen`` their names by id. ``parked`` names the files of the
    chunks that are not in memory (parked_chunks.py). ``layers`` are the values (n, 512, ...) of those that
    pixels feed, ``shares`` what frozen keyframes gave to these, and ``kept`` what they measured."""

    header: MapHeader
    bricks: NDArray[np.int32]
    belief: NDArray[np.float32]
    evidence: NDArray[np.float32] | None
    total: NDArray[np.float32] | None
    frozen_dated: tuple[NDArray[np.float32], NDArray[np.float64]] | None
    waiting: list[WaitingMessages]
    frozen_owners: NDArray[np.int32]
    frozen_crossed: NDArray[np.int32]
    frozen: dict[int, str]
    parked: list[str]
    layers: Mapping[str, NDArray]
    shares: Mapping[str, VoxelShare]
    kept: RayShare


def save(m: OccupancyMap, parts: MapParts, next_id: int, path: Path, window: MovingWindow | None) -> None:
    """MRFMap.save; ``window`` is the map's, if it has one."""
    stored = [StoredKeyframe.of(keyframe) for keyframe in parts.keyframes.values()]
    header = MapHeader(m.config, m.noise, stored, next_id, parts.settled, m.up, m.promise)
    parked = [] if window is None else window.save_beside(path, m)
    write_contents(path, contents_of(header, parts, parked))
    if window is not None:
        window.saved(path)


def contents_of(header: MapHeader, parts: MapParts, parked: list[str]) -> MapContents:
    """The contents to store; ``parked`` names the files of the chunks that are not in memory."""
    registry, pool, dated = parts.registry, parts.pool, parts.dated
    slots, layers = pool.in_order, parts.layers.items()
    live = np.zeros(pool.capacity, np.int32)
    for keyframe in parts.keyframes.values():
        live[registry.topology.slots(keyframe.footprint.window.bricks_of(keyframe.footprint.surface))] += 1
    return MapContents(
        header,
        pool.bricks[slots],
        pool.read("belief", slots),
        None if pool.evidence is None else pool.read("evidence", slots),
        None if dated is None else pool.read("total", slots),
        None if dated is None else dated.read_frozen(slots),
        [] if dated is None else waiting_of(dated),
        pool.owners[slots] - live[slots],
        registry.frozen_crossed,
        parts.frozen,
        parked,
        {name: found for name, layer in layers if (found := layer.stored(slots, header.settled)) is not None},
        {name: layer.frozen for name, layer in layers},
        parts.kept.share,
    )


def place_contents(contents: MapContents, parts: MapParts) -> NDArray[np.int32]:
    """Place keyframes, and what frozen ones have left, in an empty map; returns the slots of the bricks."""
    slots = np.zeros(0, np.int32)
    if len(contents.bricks):
        slots = parts.registry.restore(contents.bricks, contents.frozen_owners)
    parts.registry.see_for_good(contents.frozen_crossed)
    for name, share in contents.shares.items():
        parts.layers[name].restore(share)
    parts.kept.restore(contents.kept)
    parts.frozen = dict(contents.frozen)
    for k in contents.header.keyframes:
        image = parts.image(contents.header.noise, k.depth_m, k.camera, k.color, **k.own.arguments())
        placed = (image, k.T_world_camera, k.stamp_s)
        parts.keyframes[k.id] = parts.allocator.place(k.id, k.name, *placed)
    return slots


def show_contents(contents: MapContents, parts: MapParts, slots: NDArray[np.int32]) -> None:
    """Let queries read the beliefs of a file whose bricks and keyframes are placed."""
    pool, dated = parts.pool, parts.dated
    if len(slots):
        if contents.evidence is not None:
            pool.write("evidence", slots, contents.evidence)
        if dated is not None and contents.frozen_dated is not None:
            dated.restore_frozen(slots, *contents.frozen_dated)
            for each in contents.waiting:
                at = parts.registry.topology.slots(each.bricks)
                dated.wait(each.stamp_s, each.content, at, each.messages)
        show(parts, slots, contents.belief)
        if dated is not None and contents.total is not None:
            pool.write("total", slots, contents.total)
        for name, values in contents.layers.items():
            parts.layers[name].show(slots, values)
    parts.messages_lost, parts.settled = bool(parts.keyframes), contents.header.settled


def write_contents(path: Path, contents: MapContents) -> None:
    """Write the file under a temporary name and rename it into place. Raises MapFileError."""
    arrays = {
        **contents.header.arrays(),
        "bricks": contents.bricks,
        "belief": contents.belief,
        "frozen_owners": contents.frozen_owners,
        "frozen_crossed": contents.frozen_crossed,
        "frozen_ids": np.array(list(contents.frozen), np.int64),
        "frozen_names": np.array(list(contents.frozen.values()), np.str_),
    }
    if contents.evidence is not None:
        arrays["evidence"] = contents.evidence
    if contents.total is not None:
        arrays["total"] = contents.total
    if contents.parked:
        arrays["parked"] = np.array(contents.parked, np.str_)
    if contents.frozen_dated is not None:
        arrays |= dated_arrays(*contents.frozen_dated) | waiting_arrays(contents.waiting)
    if contents.waiting:
        arrays["format"] = np.asarray(FORMAT)  # a version that passes over them would lose evidence
    arrays |= {name: values for name, values in contents.layers.items() if values.any()}
    arrays |= share_arrays(contents.shares) | ray_arrays(contents.kept)
    write_npz(path, arrays, manifest=True)


def read_contents(path: Path) -> MapContents:
    """Read a file back. Raises MapFileError, which names the file and what is wrong."""
    with open_map_file(path, "mrf") as file:
        header = read_header(path, file)
        bricks, belief = read_bricks(path, file)
        n = len(bricks)
        frozen_ids = file.integers("frozen_ids", (None,), 0, header.next_id - 1).tolist()
        live = [keyframe.id for keyframe in header.keyframes]
        if len({*frozen_ids, *live}) < len(frozen_ids) + len(live):
            raise MapFileError(f"{path}: damaged: frozen_ids holds a keyframe's id twice")
        return MapContents(
            header,
            bricks,
            belief,
            file.array("evidence", "f", (n, VOXELS)) if "evidence" in file else None,
            file.array("total", "f", (n, VOXELS)).astype(np.float32) if "total" in file else None,
            read_dated(file, n),
            read_waiting(path, file, bricks),
            file.integers("frozen_owners", (n,), 0, len(frozen_ids)).astype(np.int32),
            read_places(path, file, "frozen_crossed"),
            dict(zip(frozen_ids, file.array("frozen_names", "U", (len(frozen_ids),)).tolist(), strict=True)),
            file.array("parked", "U", (None,)).tolist() if "parked" in file else [],
            {name: _read_layer(file, name, n) for name in pixel_layers() if name in file},
            read_shares(path, file, bricks),
            read_rays(path, file),
        )


def _read_layer(file: NpzFile, name: str, bricks: int) -> NDArray:
    layer, shape = LAYERS[name], (bricks, VOXELS, *LAYERS[name].shape)
    range_ = np.iinfo(layer.dtype)
    return file.integers(name, shape, range_.min, range_.max).astype(layer.dtype)
