"""The contributions of frozen keyframes as arrays of a file, a map's or a parked chunk's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.inference.brick_sums import LARGEST, VOTES, BrickSums
from taichi_mrf.inference.dated import DatedBelief
from taichi_mrf.inference.dated_channels import NEVER
from taichi_mrf.inference.voxel_share import VoxelShare
from taichi_mrf.methods.map_file import read_places
from taichi_mrf.methods.mrf.kept_rays import RayShare
from taichi_mrf.system.npz_file import NpzFile
from taichi_mrf.voxels.distance_field import VALUES
from taichi_mrf.voxels.layers import FromPixels, pixel_layers
from taichi_mrf.voxels.layout import VOXELS, grid_keys
from taichi_mrf.voxels.topology import SparseTopology

_BEFORE_ALL = float(np.finfo(np.float64).min)
"""Stands for no stamp at all: a file holds finite numbers only."""


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


@dataclass(frozen=True)
class WaitingMessages:
    """Messages (n, 512) of a frozen keyframe that wait for older ones (inference/dated.py), and the
    coordinates (n, 3) of their bricks."""

    stamp_s: float
    content: bytes
    bricks: NDArray[np.int32]
    messages: NDArray[np.floating]


def waiting_of(beliefs: DatedBelief) -> list[WaitingMessages]:
    """The waiting messages of a map whose bricks still exist."""
    found = []
    for each in beliefs.waiting():
        rows = np.flatnonzero(
            each.left & (beliefs.pool.identity[each.visible.slots] == each.visible.identity)
        )
        messages = each.messages.to_numpy()[: len(each.left) * VOXELS].reshape(-1, VOXELS)[rows]
        bricks = beliefs.pool.bricks[each.visible.slots[rows]]
        found.append(WaitingMessages(each.stamp_s, each.content, bricks, messages))
    return found


def waiting_arrays(waiting: Sequence[WaitingMessages]) -> dict[str, NDArray]:
    """Arrays of a file: the messages that wait; none without any."""
    if not waiting:
        return {}
    return {
        "waiting_stamps": np.array([each.stamp_s for each in waiting], np.float64),
        "waiting_content": np.stack([np.frombuffer(each.content, np.uint8) for each in waiting]),
        "waiting_counts": np.array([len(each.bricks) for each in waiting], np.int64),
        "waiting_bricks": np.concatenate([each.bricks for each in waiting]),
        "waiting_messages": np.concatenate([each.messages for each in waiting]),
    }


def read_waiting(path: Path, file: NpzFile, bricks: NDArray[np.int32]) -> list[WaitingMessages]:
    """The messages that wait in a file with bricks (n, 3). Raises MapFileError if they are of others."""
    if "waiting_stamps" not in file:
        return []
    stamps = file.array("waiting_stamps", "f", (None,)).tolist()
    content = file.integers("waiting_content", (len(stamps), None), 0, 255).astype(np.uint8)
    span = SparseTopology.HALF_SPAN
    places = file.integers("waiting_bricks", (None, 3), -span, span - 1).astype(np.int32)
    messages = file.array("waiting_messages", "f", (len(places), VOXELS))
    counts = file.integers("waiting_counts", (len(stamps),), 0, len(places))
    if counts.sum() != len(places) or not np.isin(grid_keys(places), grid_keys(bricks)).all():
        raise MapFileError(
            f"{path}: damaged: waiting_bricks are not of its bricks, or not waiting_counts many"
        )
    ends = np.cumsum(counts)
    parts = [slice(end - count, end) for count, end in zip(counts.tolist(), ends.tolist(), strict=True)]
    rows = zip(stamps, content, parts, strict=True)
    return [WaitingMessages(s, key.tobytes(), places[part], messages[part]) for s, key, part in rows]


def share_arrays(shares: Mapping[str, VoxelShare]) -> dict[str, NDArray]:
    """Arrays of a file: what frozen keyframes gave to layers that pixels feed; none for a layer without
    any."""
    arrays: dict[str, NDArray] = {}
    for name, made in pixel_layers().items():
        share = shares.get(name)
        if share is not None and len(share.numbers):
            arrays |= {f"{made.stored}_bricks": share.bricks, f"{made.stored}_numbers": share.numbers}
            arrays |= {f"{made.stored}_{w}": share.sums[:, i] for i, w in enumerate(made.words)}
    return arrays


def read_shares(path: Path, file: NpzFile, bricks: NDArray[np.int32]) -> dict[str, VoxelShare]:
    """The frozen keyframes' shares in each layer that pixels feed, from a file with bricks (n, 3). Raises
    MapFileError if it names others."""
    return {name: _read_share(path, file, bricks, made) for name, made in pixel_layers().items()}


def _read_share(path: Path, file: NpzFile, bricks: NDArray[np.int32], made: FromPixels) -> VoxelShare:
    stored = made.stored
    if f"{stored}_numbers" not in file:
        return VoxelShare.nothing(len(made.words))
    numbers = file.integers(f"{stored}_numbers", (None,), 0, VOXELS - 1).astype(np.int32)
    n, span = len(numbers), SparseTopology.HALF_SPAN
    places = file.integers(f"{stored}_bricks", (n, 3), -span, span - 1).astype(np.int32)
    words = [file.array(f"{stored}_{word}", "i", (n,)) for word in made.words]
    sums = np.stack(words, axis=1).astype(np.int64)
    known = np.isin(grid_keys(places), grid_keys(bricks)).all()
    if not known or (sums < 0).any() or not sums.any(axis=1).all():
        raise MapFileError(f"{path}: damaged: {stored}_bricks or its sums are not of its voxels")
    return VoxelShare(places, numbers, sums)


def ray_arrays(share: RayShare) -> dict[str, NDArray]:
    """Arrays of a file: rays of frozen keyframes; none without any."""
    arrays: dict[str, NDArray] = {}
    for name, found in (("distance", share.distances), ("vote", share.votes)):
        if len(found.bricks):
            arrays |= {f"frozen_{name}_bricks": found.bricks, f"frozen_{name}_sums": found.sums}
    return arrays


def read_rays(path: Path, file: NpzFile) -> RayShare:
    """Rays of frozen keyframes in a file. Raises MapFileError for sums that no keyframes have left."""
    return RayShare(_read_sums(path, file, "distance", VALUES), _read_sums(path, file, "vote", VOTES))


def _read_sums(path: Path, file: NpzFile, name: str, values: int) -> BrickSums:
    if f"frozen_{name}_bricks" not in file:
        return BrickSums.nothing(values)
    bricks = read_places(path, file, f"frozen_{name}_bricks")
    of_before = name == "vote" and file.header(f"frozen_{name}_sums")[0][-1:] == (1,)  # 1.0.0 kept no scores
    sums = file.integers(
        f"frozen_{name}_sums", (len(bricks), VOXELS, 1 if of_before else values), -LARGEST, LARGEST
    )
    if of_before:
        sums = np.concatenate([sums, np.zeros_like(sums)], axis=2)
    if (values == VALUES and (sums[..., 0] < 0).any()) or (np.diff(grid_keys(bricks)) <= 0).any():
        raise MapFileError(f"{path}: damaged: frozen_{name}_bricks or _sums are not in order")
    return BrickSums(bricks, sums.astype(np.int32))
