"""Measurements of the rays of frozen keyframes, kept for the surface and for what is occupied.

A keyframe's weights and distances (inference/surface_rays.py) and its votes (inference/surface_votes.py) are
taken with the marginals as they are when it is frozen, and rounded to integers. So what is kept is a sum over
keyframes: their order does not matter.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.brick_sums import VOTES, BrickSums
from taichi_mrf.voxels.distance_field import VALUES, DistanceField
from taichi_mrf.voxels.layers import FIRST, SURFACE, BrickValues
from taichi_mrf.voxels.layout import VOXELS, grid_keys

STEPS = 1024.0
"""Steps of the kept sums for a weight of 1: a voxel with the least weight that counts has 20."""


@dataclass(frozen=True)
class RayShare:
    """``distances``: the sums of DistanceField in 1 / STEPS; ``votes``: VOTES of a voxel."""

    distances: BrickSums
    votes: BrickSums

    @staticmethod
    def nothing() -> "RayShare":
        """That of no keyframe."""
        return RayShare(BrickSums.nothing(VALUES), BrickSums.nothing(VOTES))

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return self.distances.nbytes + self.votes.nbytes

    def plus(self, other: "RayShare") -> "RayShare":
        """Both together."""
        return RayShare(self.distances.plus(other.distances), self.votes.plus(other.votes))

    def in_chunks(self, chunks: NDArray[np.int32], inside: bool = True) -> "RayShare":
        """The part of it in some chunks (n, 3), or the part outside of them."""
        both = (self.distances, self.votes)
        return RayShare(*(sums.chosen(sums.inside(chunks) == inside) for sums in both))

    @property
    def layers(self) -> dict[str, BrickValues]:
        """The distances and the votes as layers."""
        won = (self.votes.sums[..., 0] > 0).astype(np.uint8)
        return {SURFACE: self.field.values, FIRST: BrickValues(self.votes.bricks, won)}

    @property
    def field(self) -> DistanceField:
        """The distances as signed distances."""
        sums = self.distances.sums.astype(np.float32) / np.float32(STEPS)
        return DistanceField.of(self.distances.bricks, sums)


class KeptRays:
    """Distances and votes of the frozen keyframes of one map."""

    def __init__(self, wanted: bool) -> None:
        """Unless it is ``wanted``, nothing is kept."""
        self.wanted, self.share = wanted, RayShare.nothing()

    def restore(self, share: RayShare) -> None:
        """Add what keyframes left."""
        self.share = self.share.plus(share)

    def release(self, chunks: NDArray[np.int32]) -> None:
        """Remove what lies in some chunks, (n, 3)."""
        self.share = self.share.in_chunks(chunks, inside=False)

    def added_to(self, field: DistanceField) -> DistanceField:
        """The signed distances of other keyframes, and what is kept."""
        return _sum_of((field, self.share.field)) if len(self.share.distances.bricks) else field


def _sum_of(fields: Iterable[DistanceField]) -> DistanceField:
    fields = list(fields)
    bricks = np.concatenate([field.bricks for field in fields])
    _, first = np.unique(grid_keys(bricks), return_index=True)
    keys = grid_keys(bricks[first])
    sums = np.zeros((len(first), VOXELS, VALUES), np.float32)
    for field in fields:
        rows = np.searchsorted(keys, grid_keys(field.bricks))
        sums[rows] += field.sums
    return DistanceField.of(bricks[first], sums)
