"""Loops of a tracked camera: once around the built-in room with drift, and a camera that is carried away."""

from dataclasses import replace

import numpy as np
import pytest
from tracked_room import CONFIG, errors, nowhere, walk

from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.se3 import moved
from taichi_mrf.alignment.seen_through import looked_through
from taichi_mrf.alignment.surfels import Planes
from taichi_mrf.config.schema import Config, PoseConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import CapacityError
from taichi_mrf.geometry.pose_edge import PoseEdge
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.mapping.loops import Closure, LoopCloser
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.mapping.tracking import Tracker
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import PolynomialNoise

pytestmark = pytest.mark.usefixtures("one_backend")

VIEWS, MORE = 32, 4
DRIFT = np.array([0.003, -0.004, 0.004, 0.0015, -0.002, 0.001])
"""Of each step, metres and radians: 15 cm and 5 degrees once around."""


class Drifting:
    """The views around the room as a tracker with drift would add them."""

    def __init__(self, fixed: set[int]) -> None:
        dataset = open_dataset(f"synthetic:room?width=160&height=120&frames={VIEWS}", color=False)
        self.frames = [dataset.read(i % VIEWS) for i in range(VIEWS + MORE)]
        config = Config(voxel_size=0.1)
        self.map = MRFMap(config.voxel_size)
        self.tracker = Tracker(self.map, config.poses)
        self.loops = LoopCloser(self.tracker, config.poses, lambda: fixed)
        self.closures: list[Closure] = []
        self.before: dict[int, Pose] = {}

    def take(self, index: int) -> None:
        frame = self.frames[index]
        T = frame.T_world_camera
        if index > 0:
            step = inverse(self.frames[index - 1].T_world_camera) @ T
            T = self.map.keyframes[index - 1].T_world_camera @ moved(step, DRIFT)
        self.before = {id: k.T_world_camera for id, k in self.map.keyframes.items()} | {index: T}
        tracked = replace(frame, T_world_camera=T)
        self.tracker.follow(tracked) if index == 0 else self._found(tracked)
        assert self.map.add_keyframe(frame.depth_m, T, frame.camera, f"{index}") == index
        self.tracker.took(index)
        closure = self.loops.took(index)
        if closure is not None:
            self.closures.append(closure)

    def _found(self, frame: Frame) -> None:
        self.tracker._found(frame, frame.T_world_camera, 6)

    def off_m(self) -> float:
        """RMS distance of the keyframes from the truth."""
        off = [
            tangent_norms(self.frames[id].T_world_camera, k.T_world_camera)[1]
            for id, k in self.map.keyframes.items()
        ]
        return float(np.sqrt(np.mean(np.square(off))))


def test_a_closed_loop_takes_the_drift_out_of_the_map_and_leaves_what_is_fixed() -> None:
    run = Drifting(fixed={0, 1})
    for index in range(VIEWS - 2):
        run.take(index)
    assert run.closures == []
    drifted = run.off_m()
    for index in range(VIEWS - 2, VIEWS + MORE):
        run.take(index)
    assert run.closures
    assert all(c.keyframe >= VIEWS - 2 and c.older < 8 for c in run.closures)
    assert run.closures[0].off_m > 0.05
    assert not {0, 1} & {id for c in run.closures for id in c.moved}
    assert run.off_m() < 0.5 * drifted


def test_where_images_tell_nothing_a_step_counts_as_tracked_once() -> None:
    """A flat wall straight ahead says nothing of a motion across it."""
    camera = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)
    m = MRFMap(0.1)
    tracker = Tracker(m, PoseConfig())
    loops = LoopCloser(tracker, PoseConfig())
    for index in range(3):
        T = moved(np.eye(4), [0.1 * index, 0.0, 0.0, 0.0, 0.0, 0.0])
        frame = Frame(np.full(camera.shape, 2.0, np.float32), T, camera, float(index), f"{index}")
        tracker._found(frame, T, 3)
        tracker.took(m.add_keyframe(frame.depth_m, T, camera))
        assert loops.took(index) is None
    across = {(edge.first, edge.second): edge.information[0, 0] for edge in loops._edges}
    assert across.keys() == {(0, 1), (1, 2), (0, 2)}
    for step in ((0, 1), (1, 2)):
        assert across[step] == pytest.approx(RULES.tracked_m**-2, rel=0.3)
    assert across[0, 2] < 0.1 * RULES.tracked_m**-2


def test_a_loop_that_is_not_believed_says_nothing_of_how_far_the_camera_was_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, random, wrong = LoopCloser._loop, np.random.default_rng(0), 0

    def or_wrong(self: LoopCloser, id: int, older: int, points: OrientedPoints) -> PoseEdge | None:
        nonlocal wrong
        edge = found(self, id, older, points)
        if edge is None or random.random() < 0.5:
            return edge
        wrong += 1
        xi = [*random.normal(0, 2.0, 3), *random.normal(0, 0.5, 3)]
        return replace(edge, T_first_second=moved(edge.T_first_second, xi))

    monkeypatch.setattr(LoopCloser, "_loop", or_wrong)
    run = Drifting(fixed=set())
    for index in range(VIEWS + MORE):
        run.take(index)
    assert wrong > 0
    assert run.closures
    assert all(0.005 < c.off_m < 0.3 for c in run.closures)


def test_a_loop_that_does_not_fit_into_memory_leaves_the_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: LoopCloser, id: int) -> None:
        raise CapacityError("no room")

    monkeypatch.setattr(LoopCloser, "took", full)
    with pytest.warns(UserWarning, match="a loop was not closed: no room"):
        result = map_sequence(walk(), CONFIG, limit=3)
    assert result.loops_closed == 0
    assert len(result.map.keyframes) >= 1


def test_loops_are_left_open_on_request() -> None:
    config = replace(CONFIG, poses=PoseConfig(close_loops=False))
    result = map_sequence(walk(), config, limit=6)
    assert "closing loops" not in result.seconds
    assert "refining" not in result.seconds


def test_a_camera_that_was_carried_away_is_found_where_it_had_been() -> None:
    order = (*range(20), 0, 0, 0, *range(8, 12))
    shown = {i: nowhere() for i in (20, 21, 22)}
    result = map_sequence(walk(order, shown), replace(CONFIG, poses=PoseConfig(close_loops=False)))
    assert result.track is not None
    assert list(result.skipped) == [f"walk-{i:03d}" for i in range(20, 25)]  # the last two confirm the place
    found = {i: T for i, T in result.track.poses(result.map).items() if i > 22}
    assert list(found) == [25, 26]
    assert errors(found, order).max(axis=0)[1] < 0.06


def test_what_stands_in_the_way_of_rays_is_looked_through() -> None:
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    image = DepthImage.upload(np.full(camera.shape, 2.0, np.float32), camera, PolynomialNoise((0.01,)))
    u, v = np.meshgrid(np.arange(4, 60, 4), np.arange(4, 44, 4))
    towards = camera.directions(u, v).reshape(-1, 3)
    turn = moved(np.eye(4), [0.3, -0.2, 0.5, 0.1, 0.2, -0.3])

    def through(depths_m: np.ndarray, normal: tuple[float, float, float]) -> float:
        points = towards * depths_m[:, None]
        normals = np.tile(normal, (len(points), 1)) @ turn[:3, :3].T
        world = points @ turn[:3, :3].T + turn[:3, 3]
        planes = Planes(np.zeros((len(points), 3), np.int32), np.ones(len(points)), world, normals)
        return looked_through(planes, image, turn)

    half = np.where(np.arange(len(towards)) % 2, 2.0, 1.0)
    assert through(np.full(len(towards), 2.0), (0, 0, -1)) == 0.0
    assert through(np.full(len(towards), 1.0), (0, 0, -1)) == 1.0
    assert through(half, (0, 0, -1)) == pytest.approx(0.5)
    assert through(np.full(len(towards), 3.0), (0, 0, -1)) == 0.0  # behind what was measured
    assert through(np.full(len(towards), 1.0), (0, 0, 1)) == 0.0  # seen from behind
