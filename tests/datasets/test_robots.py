"""Robots that run, mapped as the bag of what they send would be: frames, poses, choices, and what is said."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import bag_clouds
import inputs_bags
import numpy as np
import pytest
from datasets_recordings import CAMERA
from heard import SECONDS, assert_same_frame, came, follow_bag, one_by_one, whole
from inputs_bags import (
    BETWEEN,
    COUNT,
    EYE,
    EYES,
    FRAME,
    IMAGES,
    INFO,
    T_LINK_CAMERA,
    TOPIC,
    WAYS,
    Bag,
    images,
    metres,
    mounted,
    moving_tf,
    odometry,
    plain,
    seen,
    stamp,
    stamped_poses,
    steps,
    write_bag,
)

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.datasets.wires import stream
from taichi_mrf.datasets.wires.client import wait_until
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.camera import PinholeCamera

pytest.importorskip("foxglove", reason="needs foxglove-sdk")

from foxglove_robot import Robot

Part = Callable[[Bag], object]
Begin = Callable[..., Any]


def compressed(bag: Bag, kind: str = "16UC1") -> None:
    images(bag, numbers=())
    for i in range(COUNT):
        image = steps(i) if kind == "16UC1" else metres(i)
        bag.compressed_depth(f"{TOPIC}/compressedDepth", stamp(i), FRAME, image, kind)


DEPTH: dict[str, Part] = {
    **IMAGES,
    "compressedDepth of 16UC1": compressed,
    "compressedDepth of 32FC1": partial(compressed, kind="32FC1"),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", DEPTH)
def test_frames_are_those_of_the_bag_bit_for_bit(begin: Begin, kind: str, way: str) -> None:
    follow_bag(*begin(DEPTH[kind], mounted, WAYS[way], first=4), COUNT)


def test_ros_1_is_read_too(begin: Begin) -> None:
    _, live, bag = begin(plain, kind="ros1")
    assert wait_until(lambda: came(live) == COUNT, SECONDS)
    ours, theirs = live.read(0), open_dataset(bag, color=False).read(COUNT - 1)
    assert_same_frame(ours, theirs, named=False)


@pytest.mark.parametrize("way", [odometry, moving_tf])
def test_an_image_waits_for_no_more_than_the_pose_of_its_own_stamp(
    begin: Begin, monkeypatch: pytest.MonkeyPatch, way: Part
) -> None:
    whole_ns = inputs_bags.nanoseconds
    newest_ns = whole_ns(stamp(COUNT - 1))
    odd_ns = next(ns for ns in range(10**6) if (newest_ns + ns) / 1e9 < (newest_ns + ns) / 10**9)
    monkeypatch.setattr(inputs_bags, "nanoseconds", lambda stamp: whole_ns(stamp) + odd_ns)
    _, live, bag = begin(images, mounted, way)
    assert len(open_dataset(bag)) == COUNT
    assert wait_until(lambda: came(live) == COUNT, SECONDS)
    assert live.read(0).name == f"{COUNT - 1:06d}"


def test_the_newest_image_is_taken_and_the_others_are_counted(begin: Begin) -> None:
    _, live, _ = begin(plain)
    assert wait_until(lambda: came(live) == COUNT, SECONDS)
    assert live.read(0).name == f"{COUNT - 1:06d}"
    assert f"{COUNT - 1} skipped, as mapping is slower" in live.awaiting()


def test_an_image_whose_pose_does_not_come_is_left_out(begin: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    sender, live, _ = begin(images, mounted, partial(odometry, numbers=range(COUNT - 1)))
    assert wait_until(lambda: came(live) == COUNT, SECONDS)
    assert live.read(0).name == f"{COUNT - 2:06d}"
    assert "left out" not in live.awaiting()
    monkeypatch.setattr(stream, "LATE_S", 0.1)

    def is_left_out() -> bool:
        sender.send_again("/tf_static")
        return "1 left out: no poses within 0.1 s" in live.awaiting()

    assert wait_until(is_left_out, SECONDS)


LONG = range(20)
"""Images of a walk that is longer than messages are ever out of order."""


def long_walk(bag: Bag, T: np.ndarray = EYE) -> None:
    images(bag, numbers=LONG)
    mounted(bag)
    odometry(bag, numbers=np.arange(-0.5, LONG.stop).tolist(), T=T)


def test_where_time_jumps_back_poses_of_before_are_dropped(begin: Begin, tmp_path: Path) -> None:
    sender, live, _ = begin(long_walk)
    assert wait_until(lambda: came(live) == LONG.stop, SECONDS)
    first = live.read(0)
    assert live.arrivals().news == () or "jumped" not in " ".join(live.arrivals().news)
    elsewhere = np.array([[1.0, 0, 0, 5], [0, 1, 0, -2], [0, 0, 1, 1], [0, 0, 0, 1]])
    again = write_bag(tmp_path, partial(long_walk, T=elsewhere), kind="mcap")
    with Robot(again) as other:
        sender.messages = other.messages
    sender.send()
    assert wait_until(lambda: came(live) == 2 * LONG.stop, SECONDS)
    frame, recorded = live.read(1), open_dataset(again, color=False).read(LONG.stop - 1)
    assert frame.name == f"{2 * LONG.stop - 1:06d}"
    np.testing.assert_array_equal(frame.T_world_camera, recorded.T_world_camera)
    np.testing.assert_array_equal(frame.depth_m, recorded.depth_m)
    assert frame.stamp >= first.stamp  # the map's time never goes back
    (said,) = [each for each in live.arrivals().news if "jumped back by 2.0 s" in each]
    assert "earlier poses are dropped, and mapping goes on" in said


def test_stamps_of_another_clock_are_told_once_and_ages_count_from_arrival(begin: Begin) -> None:
    def simulated(bag: Bag) -> None:
        bag.send("/clock", "rosgraph_msgs/msg/Clock", 0.0, clock=bag.header(0.0, "").stamp)

    _, live, _ = begin(plain, simulated)
    assert live.arrivals().age_s is None
    assert wait_until(lambda: came(live) == COUNT, SECONDS)
    live.read(0)
    found = live.arrivals()
    assert len(found.news) == 1
    assert f"stamps of {TOPIC} are " in found.news[0]
    assert "days before this machine's clock: time is simulated or a bag's, by /clock" in found.news[0]
    assert 0 <= found.age_s < 86400  # the stamps are of 2020


def test_ages_are_those_of_stamps_where_clocks_agree(begin: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    began = time.time()
    monkeypatch.setattr(inputs_bags, "START", began - 2.0)
    monkeypatch.setattr(stream, "CLOCKS_S", 600.0)
    _, live, _ = begin(plain)
    assert wait_until(lambda: came(live) == COUNT, SECONDS)
    frame = live.read(0)
    least = time.time() - frame.stamp
    assert least - 0.01 <= live.arrivals().age_s <= time.time() - frame.stamp + 0.01
    assert live.arrivals().news == ()


def test_images_that_wait_for_poses_are_bounded(begin: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "MOST_IMAGES", 2)
    _, live, _ = begin(images, mounted, partial(odometry, numbers=[-2, -1]))
    assert wait_until(lambda: came(live) == COUNT, SECONDS)
    live = whole(live)
    assert [image.number for image in live._waiting] == [COUNT - 2, COUNT - 1]
    assert live.dropped == COUNT - 2


def of_lidar(**more: np.ndarray) -> Part:
    """Clouds, in which each point may have a ring and a time, of a lidar that drives and turns."""

    def scans(bag: Bag) -> None:
        for scan in range(bag_clouds.SCANS):
            xyz = bag_clouds.points(scan)
            if "ring" in more:
                xyz = xyz.reshape(1, -1, 3)
            bag_clouds.send(bag, bag_clouds.stamp(scan), xyz, **more)
        bag_clouds.drive(bag)

    return scans


def in_the_world(bag: Bag, by_tf: bool) -> None:
    """Clouds that an odometry has moved to the world's frame."""
    for scan in range(bag_clouds.SCANS):
        at = bag_clouds.stamp(scan)
        T, xyz = bag_clouds.pose(at), bag_clouds.points(scan)
        bag_clouds.send(bag, at, xyz @ T[:3, :3].T + T[:3, 3], frame="odom")
    bag.tf("/tf_static", 0.0, "body", "lidar", EYE)
    for i in range(8):
        at = bag_clouds.stamp(0) - 0.05 + 0.05 * i
        if by_tf:
            bag.tf("/tf", at, "odom", "body", bag_clouds.pose(at))
        else:
            bag.odometry("/odom", at, "odom", "body", bag_clouds.pose(at))


WIDTH = bag_clouds.CAMERA.shape[1]
LIDARS: dict[str, Part] = {
    "rows": of_lidar(),
    "rows with times": of_lidar(t=np.tile(np.arange(WIDTH, dtype=np.uint32) * 3_400_000, (4, 1))),
    "rings": of_lidar(ring=np.repeat(np.arange(4, dtype=np.uint16), WIDTH)[None]),
    "free rays with times": of_lidar(
        ring=np.zeros((1, 4 * WIDTH), np.uint16),
        time=np.tile(np.linspace(-0.04, 0.04, WIDTH, dtype=np.float32), 4)[None],
    ),
    "moved to the world by odometry": partial(in_the_world, by_tf=False),
    "moved to the world by tf": partial(in_the_world, by_tf=True),
}


@pytest.mark.parametrize("kind", LIDARS)
def test_clouds_are_those_of_the_bag_bit_for_bit(begin: Begin, kind: str) -> None:
    sender, live, bag = begin(LIDARS[kind], first=5)
    recorded = open_dataset(bag)
    assert live.camera.shape == recorded.camera.shape
    assert live.stated == replace(recorded.stated, swept_m=0.0)  # which is a note of reports
    assert set(recorded.notes) <= set(live.notes)
    found = one_by_one(sender, live)
    assert len(found) == len(recorded) == bag_clouds.SCANS
    for ours, theirs in zip(found, recorded, strict=True):
        assert_same_frame(ours, theirs)


def test_a_cloud_waits_for_the_pose_of_its_last_point_through_a_pause(
    begin: Begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "LATE_S", 0.0)
    sender, live, bag = begin(LIDARS["rows with times"], first=5)
    recorded = open_dataset(bag)
    found = one_by_one(sender, live, pause_s=live.gap + 0.05)
    assert len(found) == bag_clouds.SCANS
    for ours, theirs in zip(found, recorded, strict=True):
        assert_same_frame(ours, theirs)


def test_a_cloud_is_left_out_where_poses_end_before_its_last_point(
    begin: Begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = np.tile(np.linspace(0.0, 0.08, WIDTH, dtype=np.float32), (4, 1))

    def scans(bag: Bag) -> None:
        for at in (1.0, 3.0):
            bag_clouds.send(bag, at, bag_clouds.points(0), time=seconds)
        for at in (0.9, 0.95, 1.0, 1.05):
            bag.odometry("/odom", at, "odom", "body", bag_clouds.pose(at))
        bag.tf("/tf_static", 0.0, "body", bag_clouds.LIDAR, bag_clouds.T_BODY_LIDAR)

    sender, live, _ = begin(scans)
    assert wait_until(lambda: came(live) == 2, SECONDS)
    monkeypatch.setattr(stream, "LATE_S", 0.1)

    def is_decided() -> bool:
        sender.send_again("/tf_static")
        return not live.awaiting() or "2 left out" in live.awaiting()

    assert wait_until(is_decided, SECONDS)
    assert "2 left out: no poses within 0.1 s" in live.awaiting()


@pytest.mark.parametrize("kind", bag_clouds.SWEEPS_WITHOUT_POSES)
def test_a_cloud_with_points_that_have_no_pose_is_left_out_as_of_a_bag(
    begin: Begin, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(stream, "LATE_S", 0.0)
    first_s, last_s, posed, kept = bag_clouds.SWEEPS_WITHOUT_POSES[kind]
    parts = partial(bag_clouds.sweeps, first_s=first_s, last_s=last_s, posed=posed)
    sender, live, bag = begin(parts, first=3 + int((posed < 2.0).sum()))
    found = one_by_one(sender, live)
    if kind == "poses end at the last stamp":
        assert came(live) == 3  # and the last waits
    else:
        assert "1 left out: no poses within 0.1 s on both sides" in live.awaiting()
    for ours, theirs in zip(found, open_dataset(bag), strict=True):
        assert_same_frame(ours, theirs)
    assert [frame.name for frame in found] == kept


def test_clouds_of_a_robot_with_poses_at_their_stamps_alone_stay_as_those_of_a_bag(begin: Begin) -> None:
    at = tuple(np.arange(8) / 2 + 2.0)
    parts = partial(bag_clouds.sweeps, first_s=0.0, last_s=0.08, posed=at, at=at)
    sender, live, bag = begin(parts, first=8)
    (note,) = (note for note in live.notes if "do not undo" in note)
    assert note.startswith(
        "/points: times of points do not undo the lidar's motion: most poses are more than 0.2"
    )
    found = one_by_one(sender, live)
    recorded = {frame.name: frame for frame in open_dataset(bag)}
    assert len(recorded) == 8
    assert len(found) == 8 - 4 + 1  # of those heard at first the newest
    for ours in found:
        np.testing.assert_array_equal(ours.points_m, recorded[ours.name].points_m)


def test_each_image_has_the_camera_of_its_time(begin: Begin) -> None:
    other, small = PinholeCamera(16, 12, 21.0, 22.0, 7.5, 5.5), PinholeCamera(8, 6, 7.0, 7.5, 3.5, 2.5)
    cameras = [CAMERA, CAMERA, other, small, small]

    def zoomed(bag: Bag) -> None:
        for i, camera in enumerate(cameras):
            bag.camera_info(INFO, FRAME, camera, stamp=stamp(i))
            bag.image(TOPIC, stamp(i), FRAME, steps(i)[: camera.height, : camera.width], "16UC1")

    sender, live, bag = begin(zoomed, mounted, partial(odometry, numbers=BETWEEN), first=4)
    assert whole(live).mapped.cameras.early == 0.0
    found = one_by_one(sender, live)
    assert [frame.camera for frame in found] == [frame.camera for frame in open_dataset(bag)] == cameras
    (said,) = [each for each in live.arrivals().news if "camera changes" in each]
    assert f"from frame 000002 on fx is {other.fx:g}, before {CAMERA.fx:g}; later changes are taken" in said


def test_the_camera_of_a_distorted_lens_stays(begin: Begin) -> None:
    other, lens = PinholeCamera(16, 12, 21.0, 22.0, 7.5, 5.5), (0.1, 0.0, 0.0, 0.0, 0.0)

    def zoomed(bag: Bag) -> None:
        for i, camera in enumerate([CAMERA] * 2 + [other] * 3):
            bag.camera_info(INFO, FRAME, camera, distortion=lens, stamp=stamp(i))
            bag.image(TOPIC, stamp(i), FRAME, steps(i), "16UC1")

    sender, live, _ = begin(zoomed, mounted, partial(odometry, numbers=BETWEEN), first=4)
    assert {frame.camera for frame in one_by_one(sender, live)} == {CAMERA}
    (said,) = [each for each in live.arrivals().news if "camera changes" in each]
    assert "the lens is distorted: the previous one is kept" in said


def test_float_depth_in_millimetres_is_refused(begin: Begin) -> None:
    def millimetres(i: int) -> np.ndarray:
        return steps(i).astype(np.float32)

    with pytest.raises(DatasetError, match=r"too much for metres: pass --depth-scale 1000"):
        begin(partial(images, image=millimetres, encoding="32FC1"), mounted, odometry)


@pytest.mark.parametrize("is_body", [True, False])
def test_poses_of_a_camera_link_are_turned_if_images_agree_so(begin: Begin, is_body: bool) -> None:
    def poses(bag: Bag) -> None:
        for i, T in enumerate(EYES):
            bag.tf("/tf", stamp(i), "odom", "camera_link", T @ T_LINK_CAMERA.T if is_body else T)

    _, live, _ = begin(partial(images, frame="camera_link", image=seen), poses, listen_to="/tf")
    assert wait_until(lambda: came(live) == COUNT, SECONDS)
    np.testing.assert_allclose(live.read(0).T_world_camera, EYES[-1], atol=1e-6)
    assert any("of a body, x ahead and z up" in note for note in live.notes) == is_body


def test_points_are_chosen_beside_images(begin: Begin) -> None:
    def clouds(bag: Bag) -> None:
        for scan in range(bag_clouds.SCANS):
            bag_clouds.send(bag, stamp(scan), bag_clouds.points(scan))

    parts = (plain, clouds, partial(mounted, child=bag_clouds.LIDAR, T=bag_clouds.T_BODY_LIDAR))
    _, live, _ = begin(*parts, query="?points=/points")
    assert "/points: images of 24 x 4 rays" in live.notes
    assert live.camera.shape == bag_clouds.CAMERA.shape
    _, live, _ = begin(*parts)
    assert live.camera.shape == (12, 16)


def test_a_robot_that_falls_silent_ends_what_waits_for_it(
    begin: Begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    sender, live, _ = begin(plain)
    live.read(0)
    sender.stop()
    monkeypatch.setattr(stream, "SILENCE_S", 0.5)
    with pytest.raises(DatasetError, match=r"foxglove:ws://127.0.0.1:\d+: nothing to map for 0.5 s"):
        live.read(1)
    assert wait_until(lambda: "trying again" in live.awaiting(), SECONDS)


def test_of_several_sources_of_poses_the_user_chooses(begin: Begin) -> None:
    parts = (images, mounted, odometry, partial(stamped_poses, topic="/slam/pose"))
    with pytest.raises(DatasetError, match=r"\?pose=/odom or \?pose=/slam/pose"):
        begin(*parts)
    _, live, _ = begin(*parts, query="?pose=/odom")
    assert "poses in odom from /odom" in " ".join(live.notes)


def test_without_camera_info_the_error_says_what_to_pass(begin: Begin) -> None:
    with pytest.raises(DatasetError, match=r"contains no CameraInfo; pass --camera fx,fy,cx,cy"):
        begin(partial(images, info=False), mounted, odometry)


def test_topics_that_send_nothing_are_named(begin: Begin) -> None:
    with pytest.raises(DatasetError, match=r"nothing came on .*/odom.* in \d+ s"):
        begin(plain, first=0)


def test_images_are_tracked_without_poses(begin: Begin) -> None:
    _, live, _ = begin(images, mounted, query="?poses=track")
    assert live.tracked
    assert wait_until(lambda: not live.awaiting(), SECONDS)
    live.read(0)


def test_an_option_that_there_is_not_is_told() -> None:
    with pytest.raises(DatasetError, match=r"foxglove:robot.*'?dept'?.*depth"):
        open_dataset("foxglove:robot?dept=/camera")


def test_poses_that_come_one_by_one_are_those_of_all() -> None:
    rng = np.random.default_rng(0)
    stamps = np.concatenate([rng.permutation(part) for part in np.split(np.arange(0.0, 5.0, 0.1), 10)])
    poses = [look_at(rng.normal(size=3), rng.normal(size=3)) for _ in stamps]
    grown = TimedPoses([], [])
    for s, T in zip(stamps, poses, strict=True):
        grown.add(s, T, 30.0)
    whole = TimedPoses(stamps, poses)
    np.testing.assert_array_equal(grown.stamps, whole.stamps)
    np.testing.assert_array_equal(grown.poses, whole.poses)


def test_old_poses_are_forgotten_and_a_clock_may_start_again() -> None:
    grown = TimedPoses([], [])
    for s in range(10):
        grown.add(100.0 + s, np.eye(4), 3.0)
    assert grown.stamps.tolist() == [106.0, 107.0, 108.0, 109.0]
    grown.add(0.5, np.eye(4), 3.0)
    assert grown.stamps.tolist() == [0.5]
