"""Parts that tests of live runs share: a line to a viewer that is only a list, and what a viewer knows."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
import small_room
from inputs_frames import Frames, of_frames

from taichi_mrf.config.schema import Config, EvaluationConfig
from taichi_mrf.datasets import Dataset
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.session.replay import Replay
from taichi_mrf.session.session import Session
from taichi_mrf.session.session_core import Policy
from taichi_mrf.session.source import Source
from taichi_mrf.viewer.messages import (
    LOG_ODDS_STEP,
    Bricks,
    Hello,
    KeyframeInfo,
    Notice,
    Request,
    Status,
    Update,
)
from taichi_mrf.voxels.layout import BRICK, grid_keys, offsets_in_brick

CONFIG = Config(voxel_size=small_room.VOXEL_SIZE, evaluation=EvaluationConfig(hold_out=0))


class FakeLink:
    """A line whose other end is the test. ``react`` is called with each update and may ask for something."""

    def __init__(self, react: Callable[[Update], Iterable[Request]] = lambda update: ()) -> None:
        self.sent: list[Update] = []
        self.lost: str | None = None
        self.waits = 0
        self._react = react
        self._asked: list[Request] = []

    def ask(self, *requests: Request) -> None:
        self._asked += requests

    def send(self, update: Update) -> None:
        self.sent.append(update)
        self._asked += self._react(update)

    def requests(self) -> list[Request]:
        asked, self._asked = self._asked, []
        return asked

    def wait(self, timeout: float) -> None:
        self.waits += 1

    def of_type(self, kind: type) -> list:
        return [update for update in self.sent if isinstance(update, kind)]

    def errors(self) -> list[str]:
        return [notice.text for notice in self.of_type(Notice) if notice.severity == "error"]


@dataclass
class Shown:
    """Knowledge of a viewer after some updates: the bricks of each layer, and the keyframes."""

    bricks: dict[str, dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)
    keyframes: dict[int, KeyframeInfo] = field(default_factory=dict)

    def hear(self, update: Update) -> None:
        if isinstance(update, Hello):
            self.bricks.clear()
            self.keyframes.clear()
        elif isinstance(update, KeyframeInfo):
            self.keyframes[update.id] = update
        elif isinstance(update, Bricks):
            layer = self.bricks.setdefault(update.layer, {})
            for brick in update.removed.tolist():
                layer.pop(tuple(brick), None)
            for brick, log_odds, seen in zip(
                update.bricks.tolist(), update.log_odds, update.seen, strict=True
            ):
                layer[tuple(brick)] = log_odds, seen

    def voxels(self, layer: str = "map", min_probability: float = 0.5) -> set[tuple[int, int, int]]:
        """The voxels of at least a probability."""
        least = np.log(min_probability / (1 - min_probability))
        found = set()
        for brick, (log_odds, _) in self.bricks.get(layer, {}).items():
            inside = offsets_in_brick()[log_odds * LOG_ODDS_STEP >= least] + np.array(brick) * BRICK
            found |= set(map(tuple, inside.tolist()))
        return found


def shown(updates: Iterable[Update]) -> Shown:
    view = Shown()
    for update in updates:
        view.hear(update)
    return view


def map_voxels(m: OccupancyMap, min_probability: float = 0.5) -> set[tuple[int, int, int]]:
    """The occupied voxels as the page shows them, or those of another probability."""
    centres, _ = m.decided.voxels(min_probability)
    return set(map(tuple, np.floor(centres / m.voxel_size).astype(int).tolist()))


def room(count: int = 4, broken: tuple[int, ...] = ()) -> Frames:
    """The first frames of the small room; those in ``broken`` cannot be read."""
    return of_frames(small_room.frames()[:count], "small room", broken=broken)


def source(dataset: Dataset, config: Config = CONFIG, loop: bool = False, speed: float = 0.0) -> Source:
    def new_replay() -> Replay:
        return Replay(dataset, loop=loop, speed=speed, hold_out=config.evaluation.hold_out)

    return Source("small room", config, lambda: create_map(config, dataset.camera), new_replay)


def session_of(
    link: FakeLink,
    dataset: Dataset | None = None,
    config: Config = CONFIG,
    keep_live: int | None = None,
    loop: bool = False,
) -> Session:
    policy = Policy(keep_live=keep_live, leave_when_done=True)
    return Session(source(dataset or room(), config, loop), link, policy)


def last_status(link: FakeLink) -> Status:
    return link.of_type(Status)[-1]


def marginals(m: OccupancyMap) -> dict[int, bytes]:
    """All beliefs by brick, bit for bit."""
    pool = m.view.pool
    slots = pool.in_use
    keys = grid_keys(pool.bricks[slots]).tolist()
    return {key: row.tobytes() for key, row in zip(keys, pool.read("belief", slots), strict=True)}


def never() -> bool:
    return False


def finished(session: Session) -> MRFMap:
    """Run to the end; the map."""
    session.run(never)
    m = session.state.mapper.map
    assert isinstance(m, MRFMap)
    return m


def assert_shown_is(session: Session, link: FakeLink, decided: bool = True) -> None:
    """The viewer knows the very voxels of the map, or, until the rays' votes are counted, those of
    its marginals."""
    m = session.state.mapper.map
    view = shown(link.sent)
    assert view.voxels(min_probability=0.5) == map_voxels(m if decided else m.layer())
    assert len(view.bricks["map"]) == m.statistics().bricks


def asking(activity: str, request: Request) -> Callable[[Update], list[Request]]:
    """Asks for something once, as soon as a status begins with some words."""
    left = [request]

    def react(update: Update) -> list[Request]:
        if isinstance(update, Status) and update.activity.startswith(activity) and left:
            return [left.pop()]
        return []

    return react


def during_settling(request: Request) -> Callable[[Update], list[Request]]:
    """Asks for something once, in the middle of the first full inference."""
    return asking("sweeping keyframe 2 ", request)
