"""A live run of a robot: its map is that of the bag of what it sent, and it outlives the connection."""

import re
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from threading import Event, Thread

import bag_clouds
import numpy as np
import pytest
import small_room
from inputs_bags import Bag, write_bag
from live_scene import CONFIG, FakeLink, last_status, marginals, never

from taichi_mrf.cli.main import main
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.datasets.wires import foxglove, stream
from taichi_mrf.datasets.wires import robot as wired
from taichi_mrf.datasets.wires.client import wait_until
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.session.session import Session
from taichi_mrf.session.session_core import Policy
from taichi_mrf.session.source import open_source
from taichi_mrf.viewer.messages import Notice, Request, Status, Update

pytest.importorskip("foxglove", reason="needs foxglove-sdk")

from foxglove_robot import Robot

pytestmark = pytest.mark.usefixtures("one_backend")

SECONDS = 20
COUNT = 5
BEFORE = 3
"""Messages before the first image: CameraInfo, a fixed transform, a pose."""


def walk(bag: Bag) -> None:
    """Frames of the small room, whose poses come half a step before and after each image."""
    frames = small_room.frames()[:COUNT]
    bag.camera_info("/camera/camera_info", "optical", frames[0].camera)
    bag.tf("/tf_static", 0.0, "camera", "optical", np.eye(4))
    bag.tf("/tf", 0.95, "map", "camera", frames[0].T_world_camera)
    for i, frame in enumerate(frames):
        bag.image("/camera/depth", 1 + 0.1 * i, "optical", frame.depth_m.astype(np.float32), "32FC1")
        bag.tf("/tf", 1.05 + 0.1 * i, "map", "camera", frame.T_world_camera)


@pytest.fixture
def sender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    """A robot that has sent its first image when it is opened."""
    monkeypatch.setattr(wired, "LISTEN_S", 0.5)
    monkeypatch.setenv("COLUMNS", "200")
    bag, topics = write_bag(tmp_path, walk, kind="mcap"), ("/camera/depth", "/tf", "/tf_static")
    with Robot(bag) as found, found.sending(BEFORE + 1, *topics):
        yield found


def live(sender: Robot, link: FakeLink, limit: int) -> Session:
    source, _ = open_source(sender.source, CONFIG, every=1, limit=limit, speed=0.0, loop=False)
    return Session(source, link, Policy(leave_when_done=True))


def waiting(doing: Callable[[], object], what: str = "image") -> Callable[[Update], Iterable[Request]]:
    """Does something whenever the session waits for an image, until one is there."""

    def react(update: Update) -> Iterable[Request]:
        if isinstance(update, Status) and update.activity.startswith(f"waiting for the next {what}"):
            doing()
        return []

    return react


def run_and_compare(sender: Robot, session: Session, link: FakeLink, what: str = "image") -> None:
    """Map what a robot sends, the pose after an image or a cloud before the next one: the bag's map."""

    def send() -> None:
        sender.send_next(1)
        assert wait_until(lambda: not session.state.replay.awaiting, SECONDS)
        sender.send_next(1)

    link._react = waiting(send, what)
    session.run(never)
    bag = open_dataset(sender.bag)
    recorded = map_sequence(bag, with_recorded_noise(CONFIG, bag)).map
    m = session.state.mapper.map
    assert [k.name for k in m.keyframes.values()] == [k.name for k in recorded.keyframes.values()]
    assert len(m.keyframes) == COUNT
    assert marginals(m) == marginals(recorded)
    assert link.errors() == []


def test_a_robot_s_map_is_that_of_its_bag_bit_for_bit(sender: Robot) -> None:
    link = FakeLink()
    session = live(sender, link, COUNT)

    run_and_compare(sender, session, link)


def spin(bag: Bag) -> None:
    """A spinning lidar in a sphere of 3 m, whose poses come half a scan before and after each cloud."""
    bag.tf("/tf_static", 0.0, bag_clouds.BODY, bag_clouds.LIDAR, np.eye(4))
    times = np.tile(np.arange(24, dtype=np.uint32) * 2_000_000, (4, 1))
    bag.tf("/tf", 0.95, "map", bag_clouds.BODY, bag_clouds.pose(0.95))
    for i in range(COUNT):
        at = 1 + 0.1 * i
        centre = bag_clouds.pose(at)[:3, 3]
        rays = bag_clouds.CAMERA.rays()
        along = rays @ (bag_clouds.pose(at)[:3, :3].T @ centre)
        range_m = -along + np.sqrt(along**2 + 9.0 - centre @ centre)
        bag_clouds.send(bag, at, rays * range_m[..., None], t=times)
        bag.tf("/tf", at + 0.05, "map", bag_clouds.BODY, bag_clouds.pose(at + 0.05))


def test_a_lidar_s_map_is_that_of_its_bag_bit_for_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wired, "LISTEN_S", 0.5)
    with Robot(write_bag(tmp_path, spin, kind="mcap")) as sender:
        link = FakeLink()
        with sender.sending(3, "/points", "/tf", "/tf_static"):
            session = live(sender, link, COUNT)
        run_and_compare(sender, session, link, "cloud")


def test_a_run_goes_on_after_the_connection_was_lost(sender: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foxglove, "RETRY_S", 0.05)
    link, said = FakeLink(), []
    session = live(sender, link, 2)
    sender.send_next(1)
    assert wait_until(lambda: not session.state.replay.awaiting, SECONDS)

    def lose_and_find() -> None:
        sender.stop()
        assert wait_until(lambda: "trying again" in session.state.replay.awaiting, SECONDS)
        said.append(session.state._idle_activity)
        sender.start()
        sender.wait_for("/camera/depth", "/tf")
        sender.send_next(2)
        assert wait_until(lambda: not session.state.replay.awaiting, SECONDS)

    link._react = waiting(lose_and_find)
    session.run(never)
    assert f"waiting for the robot: ws://127.0.0.1:{sender.port}: " in said[0]
    assert len(session.state.mapper.map.keyframes) == 2
    assert last_status(link).finished
    assert link.errors() == []


def around(bag: Bag) -> None:
    """A walk longer than messages are ever out of order, with poses just before and after each image."""
    frames = small_room.frames()[:COUNT]
    bag.camera_info("/camera/camera_info", "optical", frames[0].camera)
    bag.tf("/tf_static", 0.0, "camera", "optical", np.eye(4))
    bag.tf("/tf", 0.95, "map", "camera", frames[0].T_world_camera)
    for i, frame in enumerate(frames):
        at = 1 + 0.3 * i
        bag.tf("/tf", at - 0.04, "map", "camera", frame.T_world_camera)
        bag.image("/camera/depth", at, "optical", frame.depth_m.astype(np.float32), "32FC1")
        bag.tf("/tf", at + 0.04, "map", "camera", frame.T_world_camera)


def test_under_load_the_newest_image_is_mapped_at_its_own_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A walk that is sent again and again at three times its pace, to a session that takes its time."""
    monkeypatch.setattr(wired, "LISTEN_S", 0.5)
    done, most = Event(), list[int]()

    def slow(update: Update) -> Iterable[Request]:
        if isinstance(update, Status) and update.activity.startswith("reading frame"):
            done.wait(0.3)
        return []

    def send(sender: Robot) -> None:
        sender.wait_for("/camera/depth", "/tf", "/tf_static")
        while not done.is_set():
            sender.sent = 0
            for (_, time, _), (_, later, _) in pairwise([*sender.messages, sender.messages[-1]]):
                sender.send_next(1)
                done.wait((later - time) / 1e9 / 3)

    link = FakeLink(slow)
    with Robot(write_bag(tmp_path, around, kind="mcap")) as sender:
        thread = Thread(target=send, args=[sender])
        thread.start()
        try:
            session = live(sender, link, 12)
            session.run(lambda: most.append(len(robots(session)._waiting)) or False)
        finally:
            done.set()
            thread.join()
    keyframes, frames = session.state.mapper.map.keyframes.values(), small_room.frames()
    numbers = [int(keyframe.name) for keyframe in keyframes]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] >= COUNT  # of a later round
    for number, keyframe in zip(numbers, keyframes, strict=True):
        np.testing.assert_array_equal(keyframe.depth_m, frames[number % COUNT].depth_m.astype(np.float32))
        np.testing.assert_allclose(keyframe.T_world_camera, frames[number % COUNT].T_world_camera, atol=1e-6)
    stamps = [keyframe.stamp_s for keyframe in keyframes]
    assert stamps == sorted(stamps)
    assert robots(session).skipped > 0
    assert max(most) <= 2 * COUNT
    said = [update.arrivals for update in link.of_type(Status)]
    assert re.fullmatch(r"\d+\.\d/s come, \d+\.\d/s are looked at, the newest \d+\.\d s ago", said[-1])
    warned = [notice.text for notice in link.of_type(Notice)]
    assert sum("jumped back by" in text for text in warned) == 1
    assert sum("before this machine's clock" in text for text in warned) == 1
    assert link.errors() == []


def robots(session: Session) -> stream.Robot:
    """The robot behind what mends its frames."""
    dataset = session.state.source.dataset
    while hasattr(dataset, "source"):
        dataset = dataset.source
    return dataset


def test_info_lists_topics_and_prints_the_command(sender: Robot, capsys: pytest.CaptureFixture[str]) -> None:
    def send_all() -> None:
        sender.wait_for("/camera/depth", "/tf", "/tf_static")
        while not done.is_set():
            sender.send()
            done.wait(0.2)

    done = Event()
    thread = Thread(target=send_all)
    thread.start()
    try:
        assert main(["info", sender.source]) == 0
    finally:
        done.set()
        thread.join()
    out = capsys.readouterr().out
    for words in (
        r"/camera/depth .* sensor_msgs/msg/Image .* depth, 32FC1, frame optical",
        r"tf camera -> optical \(fixed\)",
        r"tf map -> camera \(moving",
        r"frames .* without end",
    ):
        assert re.search(words, out), words
    assert out.strip().splitlines()[-1] == f"taichi-mrf live {sender.source}"
