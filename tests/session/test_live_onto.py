"""A live run that goes on in the map of an earlier recording: located, joined, taken back; on disk and on the
page as in a batch run."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from console import as_process, assert_refused, complaints, taichi_mrf
from inputs_bags import Bag, write_bag
from inputs_frames import write_frames
from live_scene import FakeLink, assert_shown_is, finished, last_status, marginals, never, shown
from numpy.typing import NDArray

from taichi_mrf.alignment.rules import RULES
from taichi_mrf.config.schema import Config, EvaluationConfig
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.base import EndlessNames
from taichi_mrf.datasets.wires import robot as wired
from taichi_mrf.datasets.wires.client import wait_until
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.mapping.onto import MOST_KEPT, Placed, placed_in
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.methods.registry import load_map
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.replay import Replay
from taichi_mrf.session.session import Session
from taichi_mrf.session.session_core import Policy
from taichi_mrf.session.source import Source, open_source
from taichi_mrf.viewer.messages import (
    Hello,
    KeyframeInfo,
    Notice,
    Request,
    Reset,
    Status,
    Switch,
    Undo,
    Update,
)

pytestmark = pytest.mark.usefixtures("one_backend")

CONFIG = Config(voxel_size=0.1, evaluation=EvaluationConfig(hold_out=0))
COUNT = 24
AT_ONCE: dict[str, Any] = {"every": 1, "limit": None, "speed": 0.0, "loop": False}


def away() -> Pose:
    """T_today_yesterday (4, 4): turned about all axes, and metres away."""
    T = look_at((0.3, 0.7, 0.5), (1.0, 2.0, -0.4))
    T[:3, 3] = (3.0, -4.0, 1.5)
    return T


@cache
def frames(room: str = "synthetic:room") -> list[Frame]:
    dataset = open_dataset(f"{room}?frames={COUNT}&width=160&height=120", color=False)
    return [dataset.read(index) for index in range(COUNT)]


def write(folder: Path, chosen: Sequence[Frame], T: NDArray[np.float64]) -> Path:
    """A recording of some frames in a world of its own."""
    there = [replace(frame, T_world_camera=T @ frame.T_world_camera) for frame in chosen]
    return write_frames(folder / "frames.npz", there, stamped=True).parent


@dataclass(frozen=True)
class Days:
    """Files of two days in one room: the map of the first, and the recording of the second."""

    map: Path
    today: Path


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> Days:
    folder = tmp_path_factory.mktemp("days")
    yesterday = open_dataset(str(write(folder / "yesterday", frames()[::2], np.eye(4))))
    map_sequence(yesterday, CONFIG).map.save(folder / "map.npz")
    return Days(folder / "map.npz", write(folder / "today", frames()[1::2], away()))


def opened(days: Days, **more: Any) -> tuple[Source, list[str]]:
    return open_source(str(days.today), CONFIG, onto=days.map, **AT_ONCE, **more)


def session_onto(days: Days, link: FakeLink, **more: Any) -> Session:
    return Session(opened(days, **more)[0], link, Policy(leave_when_done=True))


def in_one_run(days: Days) -> dict[int, bytes]:
    """The map as a batch run makes it of both days."""
    m = load_map(days.map)
    placed = placed_in(m, "yesterday", open_dataset(str(days.today)))
    return marginals(map_sequence(placed, CONFIG, onto=m).map)


def test_the_map_is_that_of_a_batch_run_and_the_page_tells_the_days_apart(days: Days) -> None:
    link = FakeLink()
    session = session_onto(days, link)
    m = finished(session)
    assert marginals(m) == in_one_run(days)
    assert len(m.keyframes) == COUNT
    known = shown(link.sent).keyframes
    assert [known[id].earlier for id in sorted(known)] == COUNT // 2 * [True] + COUNT // 2 * [False]
    (hello,) = link.of_type(Hello)
    assert hello.located.endswith("% of what is seen agrees")
    for frame, keyframe in zip(frames()[1::2], list(known.values())[COUNT // 2 :], strict=True):
        off = np.linalg.inv(frame.T_world_camera) @ keyframe.T_world_camera
        assert np.linalg.norm(off[:3, 3]) < 0.05
    assert_shown_is(session, link)
    assert link.errors() == []


def test_the_page_tells_once_that_what_is_mapped_does_not_fit_the_place(days: Days) -> None:
    link = FakeLink()
    source, _ = opened(days)
    assert isinstance(source.dataset, Placed)
    source.dataset.most_through = -1.0
    session = Session(source, link, Policy(leave_when_done=True))
    finished(session)
    (doubt,) = [notice.text for notice in link.of_type(Notice) if "wrong place" in notice.text]
    assert "its first 10 keyframes" in doubt
    assert session.state.result().doubt == doubt


def test_the_earlier_map_is_shown_and_inferred_before_frames_join_it(days: Days) -> None:
    link = FakeLink()
    session_onto(days, link).run(never)
    first = next(i for i, u in enumerate(link.sent) if isinstance(u, KeyframeInfo) and not u.earlier)
    before = shown(link.sent[:first])
    assert len(before.bricks["map"]) == load_map(days.map).statistics().bricks
    doing = [update.activity for update in link.sent[:first] if isinstance(update, Status)]
    assert any(activity.startswith("sweeping keyframe") for activity in doing)


def test_one_undo_takes_all_of_today_out_and_redo_brings_it_back(days: Days) -> None:
    link = FakeLink()
    session = session_onto(days, link)
    both = marginals(finished(session))
    assert last_status(link).can_undo
    link.ask(Switch(0, on=False), Undo(), Undo())
    yesterday = load_map(days.map)
    yesterday.infer()
    assert marginals(finished(session)) == marginals(yesterday)
    assert not last_status(link).can_undo
    states = [keyframe.state for keyframe in shown(link.sent).keyframes.values()]
    assert states == COUNT // 2 * ["on"] + COUNT // 2 * ["off"]
    link.ask(Undo(again=True))
    assert marginals(finished(session)) == both
    assert last_status(link).can_undo


def test_what_joins_after_an_undo_is_taken_back_by_another(days: Days) -> None:
    half, asked = COUNT // 2, [Undo()]

    def react(update: Update) -> list[Request]:
        fourth = isinstance(update, KeyframeInfo) and update.id == half + 3
        return [asked.pop()] if fourth and asked else []

    link = FakeLink(react)
    session = session_onto(days, link)
    m = finished(session)
    assert len(m.keyframes) == COUNT - 4
    link.ask(Undo())
    assert len(finished(session).keyframes) == half
    assert not last_status(link).can_undo


def test_a_reset_begins_with_the_earlier_map_again(days: Days) -> None:
    link = FakeLink()
    session = session_onto(days, link)
    before = marginals(finished(session))
    link.ask(Reset())
    assert marginals(finished(session)) == before
    assert len(link.of_type(Hello)) == 2
    assert session.state.result().before == COUNT // 2


def test_frozen_keyframes_of_the_earlier_map_are_evidence_only(days: Days) -> None:
    link = FakeLink()
    session = session_onto(days, link, frozen=True)
    m = finished(session)
    assert (len(m.frozen), len(m.keyframes)) == (COUNT // 2, COUNT // 2)
    assert session.state.result().before == COUNT // 2
    assert session.state.facts.choice["frozen_before"] is True
    assert not any(keyframe.earlier for keyframe in shown(link.sent).keyframes.values())


def test_a_tracked_recording_goes_on_from_where_it_was_located(days: Days, tmp_path: Path) -> None:
    link = FakeLink()
    recording = write(tmp_path / "carried", carried(), away())
    source, _ = open_source(str(recording), CONFIG, onto=days.map, track=True, **AT_ONCE)
    session = Session(source, link, Policy(tmp_path / "out", leave_when_done=True))
    m = finished(session)
    result = session.state.result()
    assert result.track is not None
    assert len(result.track.frames) == len(carried())
    named = {round(frame.stamp, 3): frame for frame in carried()}
    for stamp, T in result.track.trajectory(m):
        off = np.linalg.inv(named[round(stamp - later_s(session), 3)].T_world_camera) @ T
        assert np.linalg.norm(off[:3, 3]) < CONFIG.voxel_size


def later_s(session: Session) -> float:
    dataset: Any = session.state.source.dataset
    return dataset.later_s


def test_another_room_and_a_saved_map_are_refused(days: Days, tmp_path: Path) -> None:
    other = write(tmp_path / "other", frames("synthetic:corridor")[:8], np.eye(4))
    with pytest.raises(DatasetError, match=f"other: not found in {days.map}: "):
        open_source(str(other), CONFIG, onto=days.map, **AT_ONCE)
    with pytest.raises(ConfigError, match="is a saved map: --onto is for a recording"):
        open_source(str(days.map), CONFIG, onto=days.map, **AT_ONCE)


@dataclass
class Sensor(Dataset):
    """A sensor that runs: each frame can be read once, whatever the index. ``came`` counts them."""

    frames: Sequence[Frame] = ()
    came: int = 0

    @property
    def endless(self) -> bool:
        return True

    def awaiting(self) -> str:
        return "" if self.came < len(self.frames) else "the next image"

    @property
    def frame_names(self) -> Sequence[str]:
        return EndlessNames()

    def read(self, index: int) -> Frame:
        if self.awaiting():
            raise DatasetError(f"{self.name}: no image comes any more")
        self.came += 1
        return self.frames[self.came - 1]


def sensor(chosen: Sequence[Frame]) -> Sensor:
    moved = [replace(frame, T_world_camera=away() @ frame.T_world_camera) for frame in chosen]
    return Sensor("robot", moved[0].camera, frames=moved)


def test_the_frames_that_locate_a_robot_are_mapped_too_and_once(days: Days) -> None:
    m = load_map(days.map)
    robot = sensor(frames()[1::2])
    placed = placed_in(m, "yesterday", robot)
    located_by = robot.came
    assert 1 < located_by < COUNT // 2
    names = []
    while not placed.awaiting():
        frame = placed.read(len(names))
        names.append(frame.name)
        assert frame.stamp > max(keyframe.stamp_s for keyframe in m.keyframes.values())
    assert names == [f"2:{frame.name}" for frame in frames()[1::2]]
    assert list(placed.located.frames) == [frame.name for frame in frames()[1::2][:located_by]]


def walk(bag: Bag) -> None:
    """Today's frames as a robot sends them, each between two poses."""
    today = frames()[1::2]
    bag.camera_info("/camera/camera_info", "optical", today[0].camera)
    bag.tf("/tf_static", 0.0, "camera", "optical", np.eye(4))
    for i, frame in enumerate(today):
        T = away() @ frame.T_world_camera
        bag.tf("/tf", 0.97 + 0.1 * i, "map", "camera", T)
        bag.image("/camera/depth", 1 + 0.1 * i, "optical", frame.depth_m.astype(np.float32), "32FC1")
        bag.tf("/tf", 1.03 + 0.1 * i, "map", "camera", T)


def test_a_robot_goes_on_in_the_map_once_it_is_located(
    days: Days, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("foxglove", reason="needs foxglove-sdk")
    from foxglove_robot import Robot

    monkeypatch.setattr(wired, "LISTEN_S", 0.5)
    said: list[str] = []
    with Robot(write_bag(tmp_path, walk, kind="mcap")) as sender:

        def send() -> None:
            sender.wait_for("/camera/depth", "/tf", "/tf_static")
            sender.send_next(5)
            assert wait_until(lambda: said, 60)
            while sender.sent < len(sender.messages):
                sender.send_next(3)
                time.sleep(0.2)

        thread = Thread(target=send)
        thread.start()
        few = AT_ONCE | {"limit": 3}
        source, notes = open_source(sender.source, CONFIG, onto=days.map, wait_for=said.append, **few)
        thread.join()
    waiting = f"waiting for views by which {sender.source} is located in {days.map}"
    assert said == [waiting, *(f"move the camera: {n} of 10 views seen" for n in range(1, len(said)))]
    assert any(note.startswith(f"Located in {days.map}: ") for note in notes)
    session = Session(source, FakeLink(), Policy(leave_when_done=True))
    joined = list(finished(session).keyframes.values())[COUNT // 2 :]
    dataset: Any = source.dataset
    first = dataset.located.frames[:3]
    assert [keyframe.name for keyframe in joined] == [f"2:{name}" for name in first]
    truth = np.stack([frame.T_world_camera for frame in frames()[1::2]])
    for keyframe in joined:
        off_m = np.linalg.norm(truth[:, :3, 3] - keyframe.T_world_camera[:3, 3], axis=1)
        assert off_m.min() < 0.05


def test_a_robot_that_stands_still_is_located_by_five_views(days: Days) -> None:
    still = [replace(frames()[9], stamp=100 + 0.5 * i) for i in range(100)]
    robot = sensor([*frames()[1:10:2], *still])
    placed = placed_in(load_map(days.map), "yesterday", robot)
    assert 5 < robot.came < 40
    assert len(placed.located.frames) == 5
    assert placed.read(0).name == f"2:{frames()[1].name}"


def test_a_robot_that_has_never_moved_is_not_located_by_one_view(days: Days) -> None:
    still = [replace(frames()[1], stamp=0.5 * i) for i in range(100)]
    with pytest.raises(DatasetError, match="no image comes any more"):
        placed_in(load_map(days.map), "yesterday", sensor(still))


@dataclass
class Camera(Sensor):
    """A camera without poses that runs: names are those of the index."""

    def read(self, index: int) -> Frame:
        frame = super().read(index)
        return replace(frame, T_world_camera=START, name=self.frame_names[index])


START = away() @ np.eye(4)
"""Pose that a camera without poses gives all its frames."""

BETWEEN = 4
"""Images of a camera from one of ``frames`` to the next."""


@cache
def carried() -> list[Frame]:
    """The path of ``frames``, as a camera that is carried along sees it, from the second of them on."""
    count = BETWEEN * COUNT
    dataset = open_dataset(f"synthetic:room?frames={count}&width=160&height=120", color=False)
    return [dataset.read(index) for index in range(BETWEEN, count // 2)]


def camera(chosen: Sequence[Frame]) -> Camera:
    return Camera("camera", chosen[0].camera, frames=chosen, tracked=True)


def live(days: Days, placed: Placed, out: Path) -> tuple[Session, FakeLink]:
    """A session that maps a camera which has been placed in yesterday's map, as long as images come."""
    m, link, running = load_map(days.map), FakeLink(), placed.source
    assert isinstance(running, Camera)
    left = len(running.frames) - running.came
    replay = partial(Replay, placed, limit=len(placed.kept) + left)
    source = Source("camera", m.config, lambda: load_map(days.map), replay, True, placed)
    return Session(source, link, Policy(out, leave_when_done=True)), link


def test_a_camera_without_poses_is_followed_from_where_it_was_located(days: Days, tmp_path: Path) -> None:
    said: list[str] = []
    still = [replace(carried()[0], stamp=-1.0 - i) for i in range(30, 0, -1)]
    path = [*still, *carried()]
    running = camera(path)
    placed = placed_in(load_map(days.map), "yesterday", running, said.append)
    located_by = running.came
    assert len(still) < located_by < len(path)
    assert said[:-1] == [f"move the camera: {n} of 10 views seen" for n in range(11)]
    assert said[-1].startswith("hold the camera still")
    assert len(placed.kept) < located_by - len(still) + 2  # while it stands, one is enough
    session, link = live(days, placed, tmp_path)
    m = finished(session)
    track = session.state.result().track
    assert track is not None
    assert track.lost == 0
    assert len(track.frames) == len(placed.kept) + len(path) - located_by
    truth = {round(frame.stamp, 6): frame.T_world_camera for frame in path}
    for stamp, T in track.trajectory(m):
        off = np.linalg.inv(truth[round(stamp - placed.later_s, 6)]) @ T
        assert np.linalg.norm(off[:3, 3]) < CONFIG.voxel_size
    named = [keyframe.name for keyframe in list(m.keyframes.values())[COUNT // 2 :]]
    assert len(set(named)) == len(named)
    assert_shown_is(session, link)
    # After a reset the camera begins where it began, although its next image is from where it went.
    kept = len(placed.kept)
    running.frames = [*path, path[-1]]
    link.ask(Reset())
    session.run(lambda: running.came == len(path) + 1)
    again = session.state.result().track
    assert again is not None
    assert set(range(kept)) <= set(again.frames)
    for index in range(kept):
        off = np.linalg.inv(track.frames[index].T_world_camera) @ again.frames[index].T_world_camera
        assert np.linalg.norm(off[:3, 3]) < CONFIG.voxel_size


def test_a_camera_that_is_lost_while_it_is_located_begins_again(days: Days) -> None:
    said: list[str] = []
    elsewhere = frames("synthetic:corridor")[:1] * 12
    path = [*carried()[:12], *elsewhere, *carried()]
    running = camera([replace(frame, stamp=0.1 * i) for i, frame in enumerate(path)])
    placed = placed_in(load_map(days.map), "yesterday", running, said.append)
    lost = next(i for i, text in enumerate(said) if "begins again" in text)
    assert said[lost + 1] == "move the camera: 0 of 10 views seen"
    first = placed.read(0)
    assert first.stamp - placed.later_s >= 0.1 * 12
    there = path[round(10 * (first.stamp - placed.later_s))]
    off = np.linalg.inv(there.T_world_camera) @ first.T_world_camera
    assert np.linalg.norm(off[:3, 3]) < CONFIG.voxel_size


def test_a_camera_in_another_place_is_refused_in_a_line(days: Days) -> None:
    larger = [replace(frame, depth_m=1.5 * frame.depth_m) for frame in carried()]
    running = camera([*larger, *larger[::-1]] * 4)
    said: list[str] = []
    with pytest.raises(DatasetError, match="camera: not found in yesterday: "):
        placed_in(load_map(days.map), "yesterday", running, said.append)
    assert sum(text.startswith("hold the camera still") for text in said) == RULES.whole_stretches


def test_a_camera_that_ends_before_it_has_seen_enough_is_not_located(days: Days) -> None:
    with pytest.raises(DatasetError, match="no image comes any more"):
        placed_in(load_map(days.map), "yesterday", camera(carried()[:8]))


def test_a_camera_that_is_moved_to_and_fro_keeps_few_frames(days: Days) -> None:
    path = [*(carried()[:2] * 90), *carried()[2:]]
    running = camera([replace(frame, stamp=0.1 * i) for i, frame in enumerate(path)])
    placed = placed_in(load_map(days.map), "yesterday", running)
    assert running.came > 180
    assert 10 <= len(placed.kept) <= MOST_KEPT
    assert next(iter(placed.kept)) == 0


def test_the_command_writes_the_files_of_both_days(days: Days, tmp_path: Path) -> None:
    out = tmp_path / "out"
    flags = ("--onto", days.map, "--out", out, "--exit-when-done", "--port", "0")
    done = as_process("live", days.today, *flags, "--runtime.arch", "cpu")
    assert done.returncode == 0, done.stderr
    assert complaints(done.stderr) == ""
    assert f"Located in {days.map}: " in done.stdout
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["onto"] == str(days.map)
    assert report["keyframes_before"] == COUNT // 2
    assert report["keyframes"] == len(load_map(out / "map.npz").keyframes) > COUNT // 2
    assert report["located"]["agreement"] > 0.75
    # The parameters are those of the map, whose world does not change.
    assert load_map(out / "map.npz").config.time.half_life_s == 0


def test_the_command_refuses_in_one_line(days: Days, tmp_path: Path) -> None:
    other = write(tmp_path / "other", frames("synthetic:corridor")[:8], np.eye(4))
    flags = ("--onto", days.map, "--exit-when-done", "--port", "0", "--runtime.arch", "cpu")
    assert_refused(as_process("live", other, *flags), f"other: not found in {days.map}")
    refused = taichi_mrf("live", days.today, *flags, "--voxel-size", "0.2")
    assert_refused(refused, "was made with another voxel_size")
    assert_refused(taichi_mrf("live", days.today, *flags, "--refine-poses"), "does not work with --onto")
    assert_refused(taichi_mrf("live", days.today, "--frozen"), "add --onto MAP")
