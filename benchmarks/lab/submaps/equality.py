"""Does a map made of submaps equal the one that a single machine makes of the same keyframes?"""

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import UNKNOWN, ChunkedMap
from taichi_mrf.cluster.submaps.round_files import SubmapReport
from taichi_mrf.cluster.submaps.task import SubmapTask, infer_submap
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.queries.known_bricks import BrickReader, known_bricks
from taichi_mrf.queries.points import probability
from taichi_mrf.voxels.layout import BRICK, CHUNK, VOXELS

NEAR = 0.02
"""Probabilities that differ by no more than this count as equal."""


@dataclass(frozen=True)
class Equality:
    """Shares of voxels: ``within`` NEAR, of all that have a brick in either map; ``known_within``, of those
    that are known in the single map; ``same_state``, of all voxels of all chunks that either map has.
    ``largest`` is the largest difference, ``voxels`` how many have a brick, ``known`` how many are known."""

    voxels: int
    known: int
    within: float
    known_within: float
    same_state: float
    largest: float


def compare(single: OccupancyMap, merged: ChunkedMap) -> Equality:
    """Compare all voxels, chunk by chunk. What has no brick in one of the maps counts as the prior there."""
    reader = BrickReader(single)
    voxels = known = within = known_within = same = looked_at = 0
    largest = 0.0
    for bricks, theirs in _bricks_of(single, merged):
        ours = reader.log_odds(bricks)
        states = reader.state(ours), reader.state(theirs)
        same += int((states[0] == states[1]).sum())
        looked_at += states[0].size
        near_surface = _has_voxels(reader, bricks, theirs, merged)
        off = np.abs(probability(ours) - probability(theirs))[near_surface]
        known_here = (states[0] != UNKNOWN)[near_surface]
        voxels, known = voxels + off.size, known + int(known_here.sum())
        within += int((off <= NEAR).sum())
        known_within += int((off <= NEAR)[known_here].sum())
        largest = max(largest, float(off.max(initial=0.0)))
    return Equality(
        voxels=voxels,
        known=known,
        within=within / max(1, voxels),
        known_within=known_within / max(1, known),
        same_state=same / max(1, looked_at),
        largest=largest,
    )


def _bricks_of(
    single: OccupancyMap, merged: ChunkedMap
) -> Iterator[tuple[NDArray[np.int32], NDArray[np.float32]]]:
    """All bricks of either map, a chunk at a time, with the merged map's log-odds, (n, 512)."""
    chunks = np.unique(np.concatenate([known_bricks(single) // CHUNK, merged.chunks]), axis=0)
    for chunk in chunks:
        side = BRICK * CHUNK * single.voxel_size
        block = merged.marginals.box(chunk * side, (chunk + 1) * side).log_odds
        values = block.reshape((CHUNK, BRICK) * 3).transpose(0, 2, 4, 1, 3, 5).reshape(-1, VOXELS)
        yield (np.indices((CHUNK,) * 3).reshape(3, -1).T + chunk * CHUNK).astype(np.int32), values


def _has_voxels(
    reader: BrickReader, bricks: NDArray[np.int32], theirs: NDArray[np.float32], merged: ChunkedMap
) -> NDArray[np.bool_]:
    """Which bricks have voxels of their own in either map, (n,); the others are unknown or seen-free."""
    empty = (merged.header.prior_log_odds, merged.header.seen_free_log_odds)
    uniform = (theirs == theirs[:, :1]).all(axis=1) & np.isin(theirs[:, 0], np.array(empty, np.float32))
    has_voxels: NDArray[np.bool_] = (reader.slots(bricks) >= 0) | ~uniform
    return has_voxels


@dataclass(frozen=True)
class KilledOnce:
    """Place of the fault: the first task of ``round`` to have sent half of its first sweep's messages is
    killed, and leaves a note of it."""

    folder: Path
    round: int = 1

    @property
    def note(self) -> Path:
        """Note that is left behind."""
        return self.folder / "killed"


def infer_or_be_killed(task: SubmapTask) -> SubmapReport:
    """infer_submap, but the first process to get half through a task of round 1 kills itself, as the system
    does with a process for which there is no memory."""
    fault = KilledOnce(Path(task.folder))

    def strike(step: InferProgress) -> None:
        if task.round == fault.round and step.keyframe > step.keyframes // 2:
            try:
                fault.note.touch(exist_ok=False)
            except FileExistsError:
                return
            fault.note.write_text(f"{task}\n", encoding="utf-8")
            os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(60)

    return infer_submap(task, strike)
