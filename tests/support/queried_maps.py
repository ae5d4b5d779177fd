"""Maps for tests of queries over space and of exports: one written by hand, which an oracle knows voxel by
voxel, and small ones of the built-in room, of every method."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from hand_made import PRIOR, VOXEL, HandMade, made
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.schema import Config, VolumeConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.geometry.up import Up, up_of
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.visibility.map import VisibilityMap
from taichi_mrf.methods.visibility.plug import TABLE_I
from taichi_mrf.queries.extract import extract_voxels
from taichi_mrf.queries.points import classify, point_log_odds, probability
from taichi_mrf.queries.view import View
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.voxels.layout import BRICK

SEEN_FREE = PRIOR - 6.9
MIN_EVIDENCE = 0.1


@dataclass
class HandMap:
    """Bricks written by hand as a map, with the bricks that rays have crossed."""

    hand: HandMade
    crossed: NDArray[np.int32]
    voxel_size: float = VOXEL
    keyframes: dict[int, Any] = field(default_factory=dict)
    config: Config = field(default_factory=lambda: Config(method="log_odds"))
    has_colors: bool = False
    has_surface: bool = False

    @property
    def up(self) -> Up | None:
        return next((up_of(keyframe.T_world_camera) for keyframe in self.keyframes.values()), None)

    @property
    def decided(self) -> "HandMap":
        return self

    @property
    def marginals(self) -> "HandMap":
        return self

    def __post_init__(self) -> None:
        self.view = View(self.hand.pool, self.voxel_size, VolumeConfig(min_evidence=MIN_EVIDENCE))
        self.hand.topology.add_crossings(self.crossed, 1)

    def _log_odds(self, points: ArrayLike) -> NDArray[np.float32]:
        return point_log_odds(points, self.voxel_size, self.hand.topology, self.hand.pool, SEEN_FREE)

    def occupancy(self, points: ArrayLike) -> NDArray[np.float32]:
        return probability(self._log_odds(points))

    def state(self, points: ArrayLike) -> NDArray[np.int8]:
        return classify(self._log_odds(points), PRIOR, MIN_EVIDENCE)

    def voxels(self, min_probability: float = 0.5) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        return extract_voxels(self.hand.pool, self.voxel_size, min_probability)

    def true_log_odds(self, voxels: NDArray[np.integer]) -> NDArray[np.float64]:
        """The oracle: log-odds of voxels (n, 3), brick by brick from what was written."""
        here = self.hand.at(np.asarray(voxels, np.int64))
        crossed = {tuple(brick) for brick in self.crossed.tolist()}
        without = [SEEN_FREE if tuple(b) in crossed else PRIOR for b in (voxels // BRICK).tolist()]
        return np.where(np.isnan(here), without, here)

    def true_state(self, voxels: NDArray[np.integer]) -> NDArray[np.int8]:
        """The oracle: 0 unknown, 1 free, 2 occupied."""
        log_odds = self.true_log_odds(voxels)
        return np.where(
            (log_odds > 0) & (np.abs(log_odds - PRIOR) > MIN_EVIDENCE),
            2,
            np.where(log_odds < PRIOR - MIN_EVIDENCE, 1, 0),
        ).astype(np.int8)


def hand_map(backend: str, seed: int = 0, occupied: float = 0.03) -> HandMap:
    """Bricks around (-1, 2, 0) m with free, unknown and occupied voxels, beside bricks that are seen free."""
    random = np.random.default_rng(seed)
    cells = np.stack(np.unravel_index(random.permutation(216), (6, 6, 6)), axis=1) + np.array([-6, 2, -4])
    log_odds = random.normal(-5, 1.2, (70, BRICK, BRICK, BRICK))
    draw = random.random(log_odds.shape)
    log_odds[draw < 0.06] = PRIOR
    log_odds[draw < occupied] = 2.0
    bricks = cells.astype(np.int32)
    hand = made(backend, bricks[:70], log_odds.astype(np.float32))
    return HandMap(hand, bricks[60:180])


def map_of(
    backend: str, lower: tuple[int, int, int], log_odds: NDArray[np.floating], **options: Any
) -> HandMap:
    """The bricks of a block of voxels (8 a, 8 b, 8 c), whose first voxel is ``lower``, a corner of bricks."""
    shape = np.array(log_odds.shape) // BRICK
    parts = log_odds.reshape(shape[0], BRICK, shape[1], BRICK, shape[2], BRICK).transpose(0, 2, 4, 1, 3, 5)
    bricks = (np.indices(tuple(shape)).reshape(3, -1).T + np.array(lower) // BRICK).astype(np.int32)
    values = np.ascontiguousarray(parts.reshape(-1, BRICK, BRICK, BRICK), np.float32)
    return HandMap(made(backend, bricks, values), np.zeros((0, 3), np.int32), **options)


@cache
def frames() -> list[Frame]:
    """Six frames around the room."""
    return list(open_dataset("synthetic:room?width=80&height=60&frames=6"))


def room(make: Callable[[float], Any], chosen: Sequence[int] = range(6)) -> Any:
    """The room in voxels of 10 cm, from some frames."""
    m = make(0.1)
    for frame in (frames()[i] for i in chosen):
        m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, frame.name)
    m.infer()
    return m


@cache
def room_map(method: str) -> Any:
    """The room by one of the methods; nobody changes it."""
    if method == "visibility":
        # It gets a few voxels further with each scan, and has to come to the walls.
        return room(lambda size: VisibilityMap(size, visibility=TABLE_I), [*range(len(frames()))] * 20)
    return room({"mrf": MRFMap, "log_odds": LogOddsMap}[method])
