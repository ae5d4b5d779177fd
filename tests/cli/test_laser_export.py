"""Maps for map_server, read back by parsers that know nothing of the writer."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.export.map_server import grey_image, write_map_server

# No subnormal numbers: Taichi, once started, rounds them to 0 in all of the process.
COORDINATE = st.floats(-1e3, 1e3, allow_subnormal=False)


def as_map_server_reads(folder: Path) -> tuple[NDArray[np.int8], dict]:
    """The occupancy grid (rows from the lowest y up; 100 occupied, 0 free, -1 unknown) that map_server's
    documentation says a file means, and the values of the YAML file."""
    values = yaml.safe_load((folder / "map.yaml").read_text())
    image = cv2.imread(str(folder / values["image"]), cv2.IMREAD_UNCHANGED)
    occupancy = (image if values["negate"] else 255 - image.astype(float)) / 255.0
    grid = np.full(image.shape, -1, dtype=np.int8)
    grid[occupancy > values["occupied_thresh"]] = 100
    grid[occupancy < values["free_thresh"]] = 0
    return grid[::-1], values


@given(
    seed=st.integers(0, 99),
    rows=st.integers(1, 20),
    columns=st.integers(1, 20),
    cell_size=st.floats(0.01, 1.0),
    lower=st.tuples(COORDINATE, COORDINATE),
)
def test_a_map_is_read_back(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    rows: int,
    columns: int,
    cell_size: float,
    lower: tuple[float, float],
) -> None:
    folder = tmp_path_factory.mktemp("map")
    occupied, seen = np.random.default_rng(seed).random((2, rows, columns)) < 0.5
    paths = write_map_server(folder, grey_image(occupied, seen), cell_size, lower)
    assert [path.name for path in paths] == ["map.pgm", "map.yaml"]
    grid, values = as_map_server_reads(folder)
    assert np.array_equal(grid, np.where(seen, np.where(occupied, 100, 0), -1))
    assert values["resolution"] == cell_size
    assert values["origin"] == [*lower, 0.0]
    assert set(values) == {"image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"}


def test_the_pixels_are_those_that_map_server_saves() -> None:
    image = grey_image(np.array([[True, False, True]]), np.array([[True, True, False]]))
    assert image.tolist() == [[0, 254, 205]]
    two_rows = grey_image(np.array([[True], [False]]), np.ones((2, 1), bool))
    assert two_rows.tolist() == [[254], [0]]  # the lowest y is the image's last row


def test_the_pgm_is_binary_and_plain(tmp_path: Path) -> None:
    write_map_server(tmp_path, np.arange(6, dtype=np.uint8).reshape(2, 3), 0.5, (0.0, 0.0))
    assert (tmp_path / "map.pgm").read_bytes() == b"P5\n3 2\n255\n" + bytes(range(6))
