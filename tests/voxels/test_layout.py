"""Numbers of bricks and voxels, and what stands beside them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from taichi_mrf.voxels.layout import grid_keys, rows_around

CELLS = arrays(np.int32, st.tuples(st.integers(0, 60), st.just(3)), elements=st.integers(-3, 3))


@given(CELLS, CELLS, st.integers(1, 3))
def test_rows_around_are_those_of_a_table(known: np.ndarray, asked: np.ndarray, reach: int) -> None:
    keys = np.unique(grid_keys(known))
    row_of = {key: row for row, key in enumerate(keys.tolist())}
    steps = [np.array(step) - reach for step in np.ndindex((2 * reach + 1,) * 3)]
    table = [[row_of.get(int(grid_keys((cell + step)[None])[0]), -1) for step in steps] for cell in asked]
    wanted = np.array(table, np.int32).reshape(len(asked), len(steps))
    np.testing.assert_array_equal(rows_around(asked, keys, reach), wanted)
