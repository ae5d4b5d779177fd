"""A map as plain arrays in one .npz file, which NumPy alone can read.

``voxels`` (n, 3) int32: coordinates of all known voxels; voxel i covers [i, i + 1) times ``voxel_size``, in
metres, along each axis. ``probability`` (n,) float32: of being occupied. ``state`` (n,) int8: 1 free, 2
occupied. ``free_bricks`` (k, 3) int32: free cubes of 8 voxels a side, whose voxels are not listed; brick i
covers [8 i, 8 i + 8) voxels. ``prior``: the probability of unknown voxels. ``origin`` (3,): where
the map's origin is in the recorded world, unless that is 0.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.queries.known_bricks import BrickReader, QueriedMap, seen_free_bricks
from taichi_mrf.queries.points import UNKNOWN, probability
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layout import BRICK, VOXELS, offsets_in_brick

_BYTES_PER_VOXEL = 40


def write_arrays(path: str | Path, m: QueriedMap) -> None:
    """Write the arrays described at the top of this file. Raises MapFileError, CapacityError."""
    reader, deciding = BrickReader(m), BrickReader(m.decided)
    count = len(reader.bricks) * VOXELS
    check_memory(_BYTES_PER_VOXEL * count, f"{count / 1e6:.3g} million voxels as arrays")
    voxels, probabilities, states = (
        [np.zeros((0, 3), np.int32)],
        [np.zeros(0, np.float32)],
        [np.zeros(0, np.int8)],
    )
    for bricks, log_odds, _ in reader.batches(reader.bricks):
        state = deciding.state(deciding.log_odds(bricks))
        row, number = np.nonzero(state != UNKNOWN)
        voxels.append(bricks[row] * BRICK + offsets_in_brick()[number])
        probabilities.append(probability(log_odds[row, number]))
        states.append(state[row, number])
    arrays: dict[str, NDArray[Any]] = {
        "voxels": np.concatenate(voxels),
        "probability": np.concatenate(probabilities),
        "state": np.concatenate(states),
        "free_bricks": seen_free_bricks(m),
        "voxel_size": np.asarray(m.voxel_size),
        "prior": probability(np.array([reader.pool.prior_log_odds], np.float32)).reshape(()),
    }
    if any(m.config.volume.origin):
        arrays["origin"] = np.array(m.config.volume.origin)
    write_npz(path, arrays)
