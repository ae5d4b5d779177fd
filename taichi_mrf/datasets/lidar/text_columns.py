"""Columns of numbers in text, as ASCII point clouds have them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import DatasetError


def text_columns(
    path: Path, text: bytes, rows: int, wanted: Sequence[int], columns: int
) -> NDArray[np.float64]:
    """The ``wanted`` columns, (rows, len(wanted)), of the first ``rows`` lines that are not empty, each of
    which has ``columns`` numbers. Raises DatasetError, which names the file and the row."""
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) < rows:
        raise DatasetError(f"{path}: is cut short: {rows} points are expected, it has {len(lines)}")
    found = np.empty((rows, len(wanted)))
    for row, line in enumerate(lines[:rows]):
        words = line.split()
        if len(words) != columns:
            raise DatasetError(f"{path}: point {row} has {len(words)} values, expected {columns}")
        try:
            found[row] = [float(words[column]) for column in wanted]
        except ValueError:
            raise DatasetError(f"{path}: point {row} contains something that is not a number") from None
    return found
