"""Cells of 2, 4 and 8 voxels a side: how likely each holds something, and those that stand in for voxels.

The rule is in voxels/cells.py; here it is applied to maps.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.arguments import real
from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.known_bricks import BrickReader, Bricks
from taichi_mrf.queries.points import probability
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.voxels import cells as rule
from taichi_mrf.voxels.cells import SIDES, SUREST, lowest_voxels, voxels_of_cells
from taichi_mrf.voxels.layout import BRICK


@dataclass(frozen=True)
class Cells:
    """Cells of one size: ``lowest`` (n, 3) int32 the coordinates of each cell's lowest voxel, ``side`` in
    voxels, ``probability`` (n,) float32 that something in the cell is occupied."""

    lowest: NDArray[np.int32]
    side: int
    probability: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.lowest)

    def centres(self, voxel_size: float) -> NDArray[np.float64]:
        """The cells' centres, (n, 3) in metres."""
        return (self.lowest.astype(np.float64) + 0.5 * self.side) * voxel_size


def all_cells(m: VoxelMap, side: int) -> Cells:
    """All cells of 2, 4 or 8 voxels a side in the bricks of a map that have voxels, unknown voxels at the
    map's prior. Raises ConfigError for another side."""
    if side not in SIDES:
        raise ConfigError(f"cells have a side of 2, 4 or 8 voxels, not {side}")
    reader = BrickReader(m)
    parts = [_cells(np.zeros((0, 3), np.int32), np.zeros((0, (BRICK // side) ** 3), np.float32), side)]
    for bricks, log_odds, _ in reader.batches(reader.bricks):
        parts.append(_cells(bricks, cell_probabilities(log_odds, reader.pool.prior_log_odds)[side], side))
    return _joined(parts)


def standing_cells(m: VoxelMap, threshold: float = 0.5) -> list[Cells]:
    """The cells that stand in for voxels where none reaches a probability of ``threshold``, by size: a cell
    reaches it, and no voxel and no smaller cell in it does.

    Only voxels with evidence of a surface count, those likelier than the prior. Maps that integrate scan by
    scan, whose prior is one half, have no such cells for a threshold up to that. Raises ConfigError for a
    threshold that is not between 0 and 1.
    """
    reader = BrickReader(m)
    by_side: dict[int, list[Cells]] = {side: [] for side in SIDES}
    for bricks, log_odds, _ in reader.batches(reader.bricks):
        for side, standing, likely in standing_in(reader, log_odds, threshold):
            cells = _cells(bricks, likely, side)
            kept = np.flatnonzero(standing.reshape(-1))
            by_side[side].append(Cells(cells.lowest[kept], side, cells.probability[kept]))
    return [_joined(parts) for parts in by_side.values() if parts]


class CellReader(BrickReader):
    """Reads voxels as those of the cells that stand in for them: their log-odds are the cell's."""

    def __init__(self, m: VoxelMap, threshold: float) -> None:
        super().__init__(m)
        self._threshold = threshold

    def log_odds(self, bricks: Bricks) -> NDArray[np.float32]:
        """(n, 512) log-odds; bricks without voxels as they are."""
        filled = super().log_odds(bricks)
        here = np.flatnonzero(self.slots(bricks) >= 0)
        voxels = filled[here]
        for side, standing, likely in standing_in(self, voxels, self._threshold):
            p = np.minimum(likely[standing].astype(np.float64), SUREST)
            rows, cells = np.nonzero(standing)
            voxels[rows[:, None], voxels_of_cells(side)[cells]] = np.log(p / (1 - p))[:, None]
        filled[here] = voxels
        return filled


def standing_in(
    reader: BrickReader, log_odds: NDArray[np.float32], threshold: float
) -> Iterator[tuple[int, NDArray[np.bool_], NDArray[np.float32]]]:
    """For some bricks of a map, (n, 512) log-odds, and each side: which cells stand in for voxels, and the
    probability of all cells, (n, cells) in row-major order each."""
    if not 0 < real(threshold, "threshold") < 1:
        raise ConfigError(f"threshold must lie between 0 and 1, not {threshold}")
    evidence = log_odds > reader.pool.prior_log_odds + reader.map.view.volume.min_evidence
    return rule.standing_in(probability(log_odds), evidence, threshold)


def cell_probabilities(
    log_odds: NDArray[np.float32], prior_log_odds: float
) -> dict[int, NDArray[np.float32]]:
    """The probability of each cell of some bricks by side, (n, 512) log-odds -> (n, (8 / side)^3),
    row-major."""
    return rule.cell_probabilities(probability(log_odds), log_odds > prior_log_odds)


def _cells(bricks: Bricks, likely: NDArray[np.float32], side: int) -> Cells:
    """The cells of bricks (n, 3) with their probabilities (n, cells)."""
    lowest = bricks[:, None].astype(np.int32) * BRICK + lowest_voxels(side)
    return Cells(lowest.reshape(-1, 3), side, likely.reshape(-1))


def _joined(parts: list[Cells]) -> Cells:
    return Cells(
        np.concatenate([part.lowest for part in parts]),
        parts[0].side,
        np.concatenate([part.probability for part in parts]),
    )
