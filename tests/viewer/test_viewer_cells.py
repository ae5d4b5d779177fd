"""The cells that an exported page shows where no voxel is likely."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from taichi_mrf.export.page import add_cells
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.viewer.scene.voxel_layer import look_of
from taichi_mrf.viewer.scene.voxel_store import VoxelStore

PRIOR, VOXEL = -2.2, 0.1
BRICK = np.array([[-1, 0, 9]], np.int32)
CORNER = BRICK[0] * 8


class Clouds:
    """Takes what is added to a scene."""

    def __init__(self) -> None:
        self.added: dict[str, SimpleNamespace] = {}

    def add_point_cloud(self, name: str, **props: object) -> None:
        self.added[name] = SimpleNamespace(**props)


def store_of(log_odds: np.ndarray) -> VoxelStore:
    """One brick, by the log-odds of its voxels, (8, 8, 8)."""
    store = VoxelStore()
    packed = m.pack_log_odds(log_odds.reshape(1, 512).astype(np.float32))
    store.put(BRICK, log_odds=packed, seen=np.full((1, 512), 3, np.uint8))
    return store


def boxes(store: VoxelStore, **options: object) -> dict[tuple[float, ...], tuple[int, ...]]:
    """The cells that are drawn, by side in voxels and lowest voxel in the brick, and their colours."""
    chosen = replace(ViewOptions(shade=False), **options)  # type: ignore[arg-type]
    scene = Clouds()
    add_cells(scene, store, look_of(chosen, store, (2, 1), VOXEL), VOXEL, PRIOR + 0.1)  # type: ignore[arg-type]
    found = {}
    for name, props in scene.added.items():
        side = int(name.rpartition("_")[2])
        assert props.point_size == side * chosen.size
        centres_m = props.points.astype(float) * props.scale + np.array(props.position)
        for centre, color in zip(centres_m, props.colors, strict=True):
            lowest = np.rint(centre / VOXEL - side / 2 - CORNER).astype(int)
            found[(side, *lowest.tolist())] = tuple(color.tolist())
    return found


def wall(layers: int, each: float) -> np.ndarray:
    """Log-odds of a brick whose last layers along x are alike, and free space before."""
    log_odds = np.full((8, 8, 8), -9.0)
    log_odds[8 - layers :] = each
    return log_odds


@pytest.mark.parametrize(
    ("log_odds", "threshold", "expected"),
    [
        (wall(1, 2.0), 0.5, set()),
        (wall(2, -0.5), 0.5, {(2, 6, y, z) for y in range(0, 8, 2) for z in range(0, 8, 2)}),  # 2 * .38 = .76
        (wall(4, -1.5), 0.5, {(4, 4, y, z) for y in (0, 4) for z in (0, 4)}),  # 4 * .18 = .73
        (wall(4, -1.5), 0.8, set()),
        (wall(8, -2.15), 0.5, set()),  # 8 * .10 = .83, but hardly more than the prior
        (wall(8, -2.0), 0.5, {(8, 0, 0, 0)}),
    ],
)
def test_a_cell_is_as_large_as_the_surface_is_uncertain(
    log_odds: np.ndarray, threshold: float, expected: set[tuple[int, ...]]
) -> None:
    assert set(boxes(store_of(log_odds), threshold=threshold)) == expected


def test_a_cell_has_the_colour_of_its_own_probability() -> None:
    store = store_of(wall(2, -0.5))
    (color,) = set(boxes(store, color_by="marginal probability").values())
    p = 2 / (1 + np.exp(0.5))
    scale = look_of(ViewOptions(color_by="marginal probability"), store, (2, 1), VOXEL).scale
    expected = scale.colors[round(255 * np.log(p / (1 - p)) / np.log(999))]
    assert np.abs(np.array(color, int) - expected).max() <= 3


def test_a_cell_has_the_mean_of_the_colours_that_were_seen_in_it() -> None:
    store = store_of(wall(8, -2.0))
    colors = np.full((1, 512, 3), 128, np.uint8)
    colors[0, :10], colors[0, 10:20] = (10, 20, 30), (30, 20, 50)
    store.put(BRICK, colors=colors)
    assert set(boxes(store, color_by="photo").values()) == {(20, 20, 40)}
