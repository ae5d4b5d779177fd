"""The cells that the page shows where no voxel is likely, computed from its copy of the map."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.live.actions import Clicked
from taichi_mrf.viewer.live.page import Page
from taichi_mrf.viewer.scene.options import ViewOptions
from taichi_mrf.viewer.transport.server import start_server

PRIOR, VOXEL = -2.2, 0.1
HELLO = m.Hello("a recording", "cpu", "a device", "mrf", VOXEL, PRIOR, 0.1, "voxel_size: 0.1")
BRICK = np.array([[-1, 0, 9]], np.int32)
CORNER = BRICK[0] * 8
NOTHING = np.zeros((0, 3), np.int32)


class DrawnPage:
    """A page without a mapping process; ``asked`` is what it asked of it."""

    def __init__(self) -> None:
        self.server = start_server("127.0.0.1", 0, "Cells")
        self.asked: list[m.Request] = []
        self.page = Page(self.server, self.asked.append)
        self.take(HELLO)

    def take(self, update: m.Update | Clicked) -> None:
        self.page.handlers[type(update)](update)

    def put(self, log_odds: np.ndarray, seen: int = 3) -> None:
        """One brick, by the log-odds of its voxels, (8, 8, 8)."""
        packed = m.pack_log_odds(log_odds.reshape(1, 512).astype(np.float32))
        self.take(m.Bricks("map", BRICK, packed, np.full((1, 512), seen, np.uint8), NOTHING))

    def boxes(self, **options: object) -> dict[tuple[float, ...], tuple[int, ...]]:
        """The cells that are drawn, by side in voxels and lowest voxel in the brick, and their colours."""
        self.page.options = replace(ViewOptions(shade=False), **options)  # type: ignore[arg-type]
        assert self.page.map is not None
        self.page.map.look_changed()
        self.page.map._news_at = 0.0  # long at rest
        self.page._flush()
        found = {}
        for name, node in self.server.scene._handle_from_node_name.items():
            if not name.startswith("/cells/"):
                continue
            props, side = node, int(name.rpartition("_")[2])  # type: ignore[assignment]
            assert props.point_size == side * self.page.options.size
            centres_m = props.points.astype(float) * props.scale + np.array(props.position)
            for centre, color in zip(centres_m, props.colors, strict=True):
                lowest = np.rint(centre / VOXEL - side / 2 - CORNER).astype(int)
                found[(side, *lowest.tolist())] = tuple(color.tolist())
        return found


@pytest.fixture(scope="module")
def drawn() -> Iterator[DrawnPage]:
    running = DrawnPage()
    yield running
    running.server.stop()


def wall(layers: int, each: float) -> np.ndarray:
    """Log-odds of a brick whose last layers along x are alike, and free space before."""
    log_odds = np.full((8, 8, 8), -9.0)
    log_odds[8 - layers :] = each
    return log_odds


def test_a_cell_is_as_large_as_the_surface_is_uncertain(drawn: DrawnPage) -> None:
    drawn.put(wall(1, 2.0))
    assert drawn.boxes() == {}
    drawn.put(wall(2, -0.5))  # 2 * .38 = .76
    assert set(drawn.boxes()) == {(2, 6, y, z) for y in range(0, 8, 2) for z in range(0, 8, 2)}
    drawn.put(wall(4, -1.5))  # 4 * .18 = .73
    assert set(drawn.boxes()) == {(4, 4, y, z) for y in (0, 4) for z in (0, 4)}
    assert set(drawn.boxes(threshold=0.8)) == set()
    drawn.put(wall(8, -2.15))  # 8 * .10 = .83, but hardly more than the prior
    assert drawn.boxes() == {}
    drawn.put(wall(8, -2.0))
    assert set(drawn.boxes()) == {(8, 0, 0, 0)}
    assert drawn.boxes(cells=False) == {}
    drawn.take(m.Bricks("map", NOTHING, np.zeros((0, 512), np.int16), np.zeros((0, 512), np.uint8), BRICK))
    assert drawn.boxes() == {}


def test_a_cell_has_the_colour_of_its_own_probability(drawn: DrawnPage) -> None:
    drawn.put(wall(2, -0.5))
    (color,) = set(drawn.boxes().values())
    assert drawn.page.map is not None
    assert drawn.page.map.scale is not None
    p = 2 / (1 + np.exp(0.5))
    expected = drawn.page.map.scale.colors[round(255 * (p - 0.5) / 0.5)]
    assert np.abs(np.array(color, int) - expected).max() <= 3


def test_a_cell_has_the_mean_of_the_colours_that_were_seen_in_it(drawn: DrawnPage) -> None:
    drawn.put(wall(8, -2.0))
    colors = np.full((1, 512, 3), 128, np.uint8)
    colors[0, :10], colors[0, 10:20] = (10, 20, 30), (30, 20, 50)
    drawn.take(m.BrickColors((-1, 0, 1), BRICK, colors))
    assert set(drawn.boxes(color_by="photo").values()) == {(20, 20, 40)}


def test_cells_are_counted_and_cut_as_a_whole(drawn: DrawnPage) -> None:
    drawn.put(wall(4, -1.5))
    drawn.boxes()
    assert "0 voxels shown, 4 cells" in drawn.page.panel._shown.content
    assert set(drawn.boxes(cut_axis="z", cut_at=0.6)) == {(4, 4, y, 0) for y in (0, 4)}


def test_a_click_on_a_cell_asks_for_the_ray_to_its_middle(drawn: DrawnPage) -> None:
    drawn.put(wall(8, -2.0))
    drawn.boxes()
    middle = (CORNER + 4.0) * VOXEL
    eye = middle + np.array([5.0, 0.35, 0.0])
    drawn.take(Clicked(tuple(eye), (-1.0, 0.0, 0.0)))
    asked = drawn.asked[-1]
    assert isinstance(asked, m.RayThrough)
    assert asked.point == pytest.approx(tuple(middle), abs=1e-6)
