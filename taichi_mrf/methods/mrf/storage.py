"""An MRFMap as one .npz file.

The file holds the parameters, the bricks with their beliefs, and the keyframes' images and poses. It does not
hold the messages: they are the largest part of a map in memory and can be computed from the rest. It holds
the beliefs so that a loaded map answers queries at once, and with dates also what all evidence says together,
from which what moves follows.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.inference.brick_sums import LARGEST, BrickSums
from taichi_mrf.inference.color_sums import ColorShare
from taichi_mrf.inference.dated import DatedBelief
from taichi_mrf.inference.dated_channels import NEVER
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.methods.brick_registry import BrickRegistry
from taichi_mrf.methods.map_file import MapHeader, open_map_file, read_bricks, read_header, read_places
from taichi_mrf.methods.mrf.coloring import MapColors
from taichi_mrf.methods.mrf.kept_rays import KeptRays, RayShare
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.npz_file import NpzFile
from taichi_mrf.voxels.distance_field import VALUES
from taichi_mrf.voxels.layout import VOXELS, grid_keys
from taichi_mrf.voxels.topology import SparseTopology

_SHARE = ("bricks", "numbers", "rg", "bw")

_BEFORE_ALL = float(np.finfo(np.float64).min)
"""Stands for no stamp at all: a file holds finite numbers only."""


@dataclass(frozen=True)
class MapContents:
    """The contents of an MRFMap's file. ``belief`` and ``evidence`` are (n, 512) log-odds of the ``bricks``
    (n, 3); of a dated map ``total`` (n, 512) are those of all evidence together, whatever its age, and
    ``frozen_dated`` is what frozen keyframes say of the voxels, and as of when (n);
    ``frozen_owners`` (n,) counts the frozen keyframes that own each brick, ``frozen_crossed`` (m, 3)
    are the bricks that they crossed, and ``frozen`` their names by id. ``parked`` names the files of the
    chunks that are not in memory (parked_chunks.py). ``colors`` (n, 512, 4) are those of the voxels, or (0,
    512, 4), ``frozen_colors`` what frozen keyframes gave to them, and ``kept`` what they measured."""

    header: MapHeader
    bricks: NDArray[np.int32]
    belief: NDArray[np.float32]
    evidence: NDArray[np.float32] | None
    total: NDArray[np.float32] | None
    frozen_dated: tuple[NDArray[np.float32], NDArray[np.float64]] | None
    frozen_owners: NDArray[np.int32]
    frozen_crossed: NDArray[np.int32]
    frozen: dict[int, str]
    parked: list[str]
    colors: NDArray[np.uint8]
    frozen_colors: ColorShare
    kept: RayShare


def contents_of(
    header: MapHeader,
    registry: BrickRegistry,
    keyframes: Iterable[Keyframe],
    frozen: dict[int, str],
    parked: Sequence[str] = (),
    dated: DatedBelief | None = None,
    colors: MapColors | None = None,
    kept: KeptRays | None = None,
) -> MapContents:
    """The contents to store; ``keyframes`` are those that are not frozen."""
    pool = registry.pool
    slots = pool.in_order
    live = np.zeros(pool.capacity, np.int32)
    for keyframe in keyframes:
        live[registry.topology.slots(keyframe.footprint.window.bricks_of(keyframe.footprint.surface))] += 1
    return MapContents(
        header,
        pool.bricks[slots],
        pool.read("belief", slots),
        None if pool.evidence is None else pool.read("evidence", slots),
        None if dated is None else pool.read("total", slots),
        None if dated is None else dated.read_frozen(slots),
        pool.owners[slots] - live[slots],
        registry.frozen_crossed,
        frozen,
        list(parked),
        np.zeros((0, VOXELS, 4), np.uint8) if colors is None else colors.stored(slots, header.settled),
        ColorShare.nothing() if colors is None else colors.frozen,
        RayShare.nothing() if kept is None else kept.share,
    )


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
        arrays |= dated_arrays(*contents.frozen_dated)
    if len(contents.colors) and contents.colors.any():
        arrays["colors"] = contents.colors
    arrays |= color_arrays(contents.frozen_colors) | ray_arrays(contents.kept)
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
            file.integers("frozen_owners", (n,), 0, len(frozen_ids)).astype(np.int32),
            read_places(path, file, "frozen_crossed"),
            dict(zip(frozen_ids, file.array("frozen_names", "U", (len(frozen_ids),)).tolist(), strict=True)),
            file.array("parked", "U", (None,)).tolist() if "parked" in file else [],
            file.integers("colors", (n, VOXELS, 4), 0, 255).astype(np.uint8)
            if "colors" in file
            else np.zeros((0, VOXELS, 4), np.uint8),
            read_color_share(path, file, bricks),
            read_rays(path, file),
        )


def dated_arrays(belief: NDArray[np.float32], stamps: NDArray[np.float64]) -> dict[str, NDArray]:
    """Arrays of a file: beliefs of frozen keyframes in some bricks, (n, 512), and as of when, (n)."""
    return {"frozen_belief": belief, "frozen_stamps": np.maximum(stamps, _BEFORE_ALL)}


def read_dated(file: NpzFile, bricks: int) -> tuple[NDArray[np.float32], NDArray[np.float64]] | None:
    """Beliefs of frozen keyframes in a file's bricks, and as of when; None if it has none."""
    if "frozen_belief" not in file:
        return None
    belief = file.array("frozen_belief", "f", (bricks, VOXELS))
    stamps = file.array("frozen_stamps", "f", (bricks,)).astype(np.float64)
    return belief.astype(np.float32), np.where(stamps > _BEFORE_ALL, stamps, NEVER)


def color_arrays(share: ColorShare) -> dict[str, NDArray]:
    """Arrays of a file: colours by frozen keyframes; none without any."""
    arrays: dict[str, NDArray] = {f"frozen_color_{name}": getattr(share, name) for name in _SHARE}
    return arrays if len(share.numbers) else {}


def read_color_share(path: Path, file: NpzFile, bricks: NDArray[np.int32]) -> ColorShare:
    """Colours by frozen keyframes, from a file with bricks (n, 3). Raises MapFileError if it names others."""
    if "frozen_color_numbers" not in file:
        return ColorShare.nothing()
    numbers = file.integers("frozen_color_numbers", (None,), 0, VOXELS - 1).astype(np.int32)
    n, span = len(numbers), SparseTopology.HALF_SPAN
    share = ColorShare(
        file.integers("frozen_color_bricks", (n, 3), -span, span - 1).astype(np.int32),
        numbers,
        file.array("frozen_color_rg", "i", (n,)).astype(np.int64),
        file.array("frozen_color_bw", "i", (n,)).astype(np.int64),
    )
    known = np.isin(grid_keys(share.bricks), grid_keys(bricks)).all()
    if not known or (share.bw <= 0).any():
        raise MapFileError(f"{path}: damaged: frozen_color_bricks or frozen_color_bw are not of its voxels")
    return share


def ray_arrays(share: RayShare) -> dict[str, NDArray]:
    """Arrays of a file: rays of frozen keyframes; none without any."""
    arrays: dict[str, NDArray] = {}
    for name, found in (("distance", share.distances), ("vote", share.votes)):
        if len(found.bricks):
            arrays |= {f"frozen_{name}_bricks": found.bricks, f"frozen_{name}_sums": found.sums}
    return arrays


def read_rays(path: Path, file: NpzFile) -> RayShare:
    """Rays of frozen keyframes in a file. Raises MapFileError for sums that no keyframes have left."""
    return RayShare(_read_sums(path, file, "distance", VALUES), _read_sums(path, file, "vote", 1))


def _read_sums(path: Path, file: NpzFile, name: str, values: int) -> BrickSums:
    if f"frozen_{name}_bricks" not in file:
        return BrickSums.nothing(values)
    bricks = read_places(path, file, f"frozen_{name}_bricks")
    sums = file.integers(f"frozen_{name}_sums", (len(bricks), VOXELS, values), -LARGEST, LARGEST)
    if (values == VALUES and (sums[..., 0] < 0).any()) or (np.diff(grid_keys(bricks)) <= 0).any():
        raise MapFileError(f"{path}: damaged: frozen_{name}_bricks or _sums are not in order")
    return BrickSums(bricks, sums.astype(np.int32))
