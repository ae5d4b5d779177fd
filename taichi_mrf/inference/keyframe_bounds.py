"""The keyframes that may see a part of space: a quick test of their bounding boxes."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.voxels.window import Window


class KeyframeBounds:
    """The boxes of bricks that keyframes look at, all in one array, so that one comparison tests them all."""

    def __init__(self) -> None:
        self._row_of: dict[int, int] = {}
        self._boxes = np.zeros((0, 2, 3), np.int64)
        self._ids = np.zeros(0, np.int64)

    def put(self, id: int, window: Window) -> None:
        """Enter a keyframe, or where it looks now."""
        row = self._row_of.setdefault(id, len(self._row_of))
        if row >= len(self._ids):
            more = max(64, len(self._ids))
            self._boxes = np.concatenate([self._boxes, np.zeros((more, 2, 3), np.int64)])
            self._ids = np.concatenate([self._ids, np.full(more, -1, np.int64)])
        self._boxes[row] = window.lowest, np.add(window.lowest, window.shape)
        self._ids[row] = id

    def drop(self, id: int) -> None:
        """Take a keyframe out."""
        row, last = self._row_of.pop(id), len(self._row_of)
        if row != last:
            self._boxes[row], self._ids[row] = self._boxes[last], self._ids[last]
            self._row_of[int(self._ids[row])] = row

    def near(self, bricks: NDArray[np.int32]) -> set[int]:
        """The keyframes whose boxes meet the box around some bricks (n, 3)."""
        count = len(self._row_of)
        if len(bricks) == 0 or count == 0:
            return set()
        lower, upper = bricks.min(axis=0), bricks.max(axis=0) + 1
        boxes = self._boxes[:count]
        meets = ((boxes[:, 0] < upper) & (boxes[:, 1] > lower)).all(axis=1)
        return set(self._ids[:count][meets].tolist())
