"""Bags of several robots, publishers, runs and sensors: told apart, or refused with what tells them apart."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from bag_clouds import LIDAR, points, send
from inputs_bags import (
    BODY,
    CAMERA,
    COUNT,
    FRAME,
    INFO,
    Bag,
    Kind,
    Make,
    T_body_camera,
    check_poses,
    data_file,
    images,
    mounted,
    moving_tf,
    odometry,
    plain,
    stamp,
    stamped_poses,
    steps,
    world_body,
)
from refusals import refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.ros.reader import RosReader
from taichi_mrf.datasets.ros.runs import starts_of_runs
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera

Write = Callable[[Bag], None]
AWAY = look_at([9.0, 3.0, 1.0], [2.0, 1.0, 0.0])
"""Pose of the second robot's world in the first one's."""


def moving(topic: str = "/tf", T: Pose = AWAY, parent: str = "odom", node: str = "") -> Write:
    """The transforms of a robot that moves from T, sent by a node."""

    def write(bag: Bag) -> None:
        bag.node = node
        moving_tf(bag, parent, T, topic=topic, late=0.001 * bool(node))
        bag.node = ""

    return write


def placed(robot: str) -> Write:
    """Place of the camera on a robot, in the tree of its namespace."""
    return partial(mounted, topic=f"{robot}/tf_static")


def test_each_robot_has_the_tree_of_its_namespace(make: Make) -> None:
    ways = moving("/robot1/tf", np.eye(4)), moving("/robot2/tf")
    sights = [partial(images, topic=f"/robot{i}/depth/image_raw") for i in (1, 2)]
    both = make(*sights, placed("/robot1"), placed("/robot2"), *ways)
    check_poses(open_dataset(f"{both}?depth=/robot1/depth/image_raw"))
    check_poses(open_dataset(f"{both}?depth=/robot2/depth/image_raw"), AWAY)
    check_poses(open_dataset(f"{both}?depth=/robot1/depth/image_raw&tf=/robot2"), AWAY)
    shared = make(images, mounted, *ways)
    refused(f"{shared}?tf=/robot3", "names no namespace or publisher", "/robot1/", "/robot2/")
    refused(shared, f"several trees of frames contain {BODY}", "?tf=/robot1 or ?tf=/robot2")
    check_poses(open_dataset(f"{shared}?tf=/robot2"), AWAY)
    check_poses(open_dataset(make(sights[0], mounted, *ways)))
    others = make(sights[0], mounted, ways[1], partial(odometry, topic="/robot2/odom"))
    refused(others, "contains no poses", "Those of other robots: ?pose=/robot2/odom")
    unplaced = make(images, placed("/robot1"), placed("/robot2"), *ways)
    refused(unplaced, f"several trees of frames contain {FRAME}", "?tf=/robot1 or ?tf=/robot2")
    check_poses(open_dataset(f"{unplaced}?tf=/robot2"), AWAY)


def test_publishers_that_disagree_are_chosen_among(make: Make) -> None:
    here = moving(T=np.eye(4))
    path = make(images, mounted, here, moving(node="/other"))
    refused(path, f"transforms of {BODY} in odom contradict each other", "?poses=FILE")
    named = make(images, mounted, moving(T=np.eye(4), node="/one"), moving(node="/two"))
    refused(named, "from /one, /two", "?tf=/one or ?tf=/two")
    chosen = open_dataset(f"{named}?tf=/two")
    expected = [(AWAY @ world_body(i) @ T_body_camera)[:3, 3] for i in range(1, COUNT)]
    np.testing.assert_allclose([frame.T_world_camera[:3, 3] for frame in chosen], expected, atol=0.01)
    check_poses(open_dataset(make(images, mounted, here, here)))
    check_poses(open_dataset(make(images, mounted, here, moving(node="/other"), odometry)))


def test_parents_that_differ_are_chosen_among_by_the_fixed_frame(make: Make) -> None:
    path = make(images, mounted, moving(T=np.eye(4)), moving(parent="vicon"))
    refused(path, f"{BODY} has several parents, odom, vicon", "?frame=odom or ?frame=vicon")
    check_poses(open_dataset(f"{path}?frame=vicon"), AWAY)
    check_poses(open_dataset(f"{path}?frame=odom"))


def test_mountings_that_contradict_each_other_are_refused(make: Make) -> None:
    again = partial(mounted, T=AWAY)
    masted = partial(mounted, child="mast", T=AWAY), partial(mounted, parent="mast", T=AWAY)
    refused(make(odometry, images, mounted, *masted), f"{FRAME} has several parents, {BODY}, mast")
    path = make(odometry, images, again, mounted)
    refused(path, f"transforms of {FRAME} in {BODY} contradict each other", "?tf=last")
    check_poses(open_dataset(f"{path}?tf=last"))


def test_a_topic_of_poses_of_two_bodies_is_refused_or_chosen(make: Make) -> None:
    path = make(images, mounted, odometry, partial(odometry, child="trailer", T=AWAY))
    refused(path, "topic /odom: poses are of several frames", f"?body={BODY} or ?body=trailer")
    check_poses(open_dataset(f"{path}?body={BODY}"))
    same = partial(odometry, T=AWAY, late=0.01)
    refused(make(images, mounted, odometry, same), "topic /odom: its poses jump back and forth")


@pytest.mark.parametrize(
    ("stamps", "starts"),
    [
        ([], []),
        ([5.0], [0]),
        ([0, 1, 2, 3], [0]),
        ([0, 2, 4, 0, 2, 4], [0, 3]),
        ([7, 8, 9, 1, 2, 0, 1], [0, 3, 5]),
        ([5, 5.1, 4.5, 5.2], [0]),  # out of order
        ([1, 2, 900, 3, 4], [0]),  # a stamp that is off
        ([10, 11, 0, 12, 13], [0]),
        ([1600000000, 1, 2, 3], [0, 1]),
    ],
)
def test_runs_begin_where_the_clock_goes_back(stamps: list[float], starts: list[int]) -> None:
    assert starts_of_runs(stamps) == starts


uninformed = partial(images, info=False)
"""Images without a CameraInfo."""

LONG = 16
"""Images of a run that lasts more than a second."""


@pytest.mark.parametrize("by_tf", [True, False], ids=["tf", "topic"])
@pytest.mark.parametrize(
    ("kind", "is_recorders"), [("ros1", False), ("ros1", True), ("sqlite", True), ("mcap", True)]
)
def test_a_clock_that_starts_again_begins_a_run(
    make: Make, kind: Kind, is_recorders: bool, by_tf: bool
) -> None:
    """The second run is shorter and elsewhere. Late transforms of the first arrive in it, or the recorder has
    the same clock."""
    quarters = [0.25 * k - 1 for k in range(4 * LONG + 8)]

    def write(bag: Bag) -> None:
        for run, T in enumerate((np.eye(4), AWAY)):
            bag.latency = 0.05 if is_recorders else 10.0 * run + 0.05
            numbers = range(LONG - run)
            images(bag, info=not run, image=lambda i, run=run: steps(i + 7 * run), numbers=numbers)
            bag.latency = 0.05 if is_recorders else 10.0 * run + (0.5 if run else 3.0)
            (moving_tf if by_tf else odometry)(bag, T=T, numbers=quarters)

    path = make(mounted, write, kind=kind)
    first = open_dataset(path)
    check_poses(first, count=LONG)
    (note,) = (note for note in first.notes if "clock restarts" in note)
    assert "run 1 (" in note
    assert f"{LONG - 1} images" in note
    second = open_dataset(f"{path}?run=2")
    check_poses(second, AWAY, count=LONG - 1)
    np.testing.assert_array_equal(second.read(2).depth_m, steps(9) / np.float32(1000))
    refused(f"{path}?run=3", "there is no run 3; it has run 1 (")


T_body_rear = look_at([-0.3, 0.1, 0.2], [-2.0, 0.0, 0.0])
WIDE = PinholeCamera(16, 12, 9.0, 9.0, 7.5, 5.5)


def two_cameras(bag: Bag) -> None:
    odometry(bag)
    odometry(bag, late=0.02)
    for i in range(COUNT):
        bag.camera_info(INFO, "rear", WIDE, stamp=stamp(i) + 0.02)
        bag.camera_info(INFO, FRAME, CAMERA, stamp=stamp(i))
        images(bag, info=False, numbers=[i])
        images(bag, info=False, frame="rear", late=0.02, numbers=[i])


def test_sensors_that_share_a_topic_have_mountings_and_cameras_of_their_own(make: Make) -> None:
    path = make(two_cameras, mounted, partial(mounted, child="rear", T=T_body_rear))
    dataset = open_dataset(path)
    assert len(dataset) == 2 * COUNT
    for k, frame in enumerate(dataset):
        T_body_own, camera = ((T_body_camera, CAMERA), (T_body_rear, WIDE))[k % 2]
        np.testing.assert_allclose(frame.T_world_camera, world_body(k // 2) @ T_body_own, atol=1e-9)
        assert frame.camera == camera
    one = make(two_cameras, mounted)
    refused(one, f"images of several frames, {FRAME} ({COUNT}), rear ({COUNT})", "?optical=FRAME", "rear")
    check_poses(open_dataset(f"{one}?optical={FRAME}"))


def test_lidars_that_share_a_topic_have_mountings_of_their_own(make: Make) -> None:
    def scans(bag: Bag) -> None:
        for k in range(4):
            send(bag, stamp(k), points(k), frame=(LIDAR, "rear")[k % 2])

    places = [partial(mounted, child=LIDAR), partial(mounted, child="rear", T=T_body_rear)]
    for k, frame in enumerate(open_dataset(make(scans, *places, odometry))):
        T_body_own = (T_body_camera, T_body_rear)[k % 2]
        np.testing.assert_allclose(frame.T_world_camera, world_body(k) @ T_body_own, atol=1e-9)


HALF = PinholeCamera(32, 24, 28.0, 30.0, 15.0, 11.0)


@pytest.mark.parametrize(
    ("camera", "more", "expected"),
    [
        (HALF, {"binning": (2, 2)}, PinholeCamera(16, 12, 14.0, 15.0, 7.5, 5.5)),
        (HALF, {"part": (4, 6, 16, 12)}, PinholeCamera(16, 12, 28.0, 30.0, 11.0, 5.0)),
        (
            PinholeCamera(64, 48, 56.0, 60.0, 31.0, 23.0),
            {"part": (8, 4, 32, 24), "binning": (2, 2)},
            PinholeCamera(16, 12, 28.0, 30.0, 11.5, 9.5),
        ),
        (CAMERA, {"binning": (2, 2)}, CAMERA),  # a driver that states the camera of the binned images
        (HALF, {}, HALF.scaled(0.5)),
    ],
)
def test_a_camera_info_is_fitted_to_its_images(
    make: Make, camera: PinholeCamera, more: dict, expected: PinholeCamera
) -> None:
    informed = partial(Bag.camera_info, topic=INFO, frame=FRAME, camera=camera, **more)
    dataset = open_dataset(make(uninformed, informed, odometry, mounted))
    assert dataset.camera == dataset.read(1).camera == expected
    is_fitted = camera == CAMERA or not more
    assert any("is fitted to them" in note for note in dataset.notes) == is_fitted


def test_a_camera_info_of_another_view_is_refused(make: Make) -> None:
    other = PinholeCamera(20, 12, 14.0, 15.0, 9.5, 5.5)
    informed = partial(Bag.camera_info, topic=INFO, frame=FRAME, camera=other)
    path = make(uninformed, informed, odometry, mounted)
    refused(path, "have 16 x 12 pixels", "20 x 12", "--camera fx,fy,cx,cy")


def test_a_camera_info_a_moment_later_is_the_images(make: Make) -> None:
    def informed(bag: Bag) -> None:
        for i in range(COUNT):
            bag.camera_info(INFO, FRAME, CAMERA if i < 2 else WIDE, stamp=stamp(i) + 0.04)

    dataset = open_dataset(make(uninformed, informed, odometry, mounted))
    assert [frame.camera for frame in dataset] == [CAMERA, CAMERA, WIDE, WIDE, WIDE]


@pytest.mark.parametrize("topic", ["/mavros/local_position/pose", "/robot_pose", "/amcl_pose", "/pose"])
def test_poses_of_an_unknown_body_are_not_the_cameras(make: Make, topic: str) -> None:
    path = make(images, partial(stamped_poses, topic=topic, T_body_own=T_body_camera))
    refused(path, f"topic {topic}", "name no child frame", f"?body={FRAME}")
    check_poses(open_dataset(f"{path}?body={FRAME}"))


def test_a_mounting_on_tf_below_a_topic_of_poses_is_used(make: Make) -> None:
    def mounting(bag: Bag) -> None:
        for i in range(COUNT):
            bag.tf("/tf", stamp(i), BODY, FRAME, T_body_camera)

    check_poses(open_dataset(make(images, partial(stamped_poses, topic="/pose"), mounting)))


def black(bag: Bag, frame: str) -> None:
    images(bag, "/camera/color/image_raw", False, frame, lambda i: np.zeros((12, 16, 3), np.uint8), "rgb8")


def test_a_colour_camera_that_tf_places_again_and_again_is_used(make: Make) -> None:
    def beside(bag: Bag) -> None:
        bag.camera_info("/camera/color/camera_info", "color", CAMERA)
        for i in range(COUNT):
            bag.tf("/tf", stamp(i), FRAME, "color", T_body_rear)

    dataset = open_dataset(make(plain, beside, partial(black, frame="color")))
    assert any("brought to the depth camera's pixels" in note for note in dataset.notes)


def test_colours_and_depth_without_frames_are_not_taken_for_one_camera(make: Make) -> None:
    def beside(bag: Bag) -> None:
        bag.camera_info("/camera/color/camera_info", "", WIDE)
        black(bag, "")

    path = make(partial(images, frame=""), beside, partial(stamped_poses, topic="/pose", frame=""))
    refused(path, "name no child frame", "?optical=camera&body=camera")
    dataset = open_dataset(f"{path}?optical=camera&body=camera")
    check_poses(dataset, mount=np.eye(4))
    assert any("neither it nor depth names a frame" in note for note in dataset.notes)


def text(bag: Bag) -> None:
    bag.send("/notes", "std_msgs/msg/String", stamp(0), data="hello")


@pytest.mark.parametrize(
    ("kind", "before", "after", "why"),
    [
        ("mcap", b"std_msgs/msg/String\x07\0\0\0ros2msg", b"std_msgs/msg/String\x07\0\0\0foreign", ""),
        ("mcap", b"string data", b"str\xffng\xfe dat", ""),
        ("mcap", b"/notes\x03\0\0\0cdr", b"/notes\x03\0\0\0bin", "are bin"),
        ("ros1", b"string data", b"str{ng data", "Could not parse"),
        ("ros1", b"string data", b"string date", "another definition"),
    ],
)
def test_a_topic_that_cannot_be_read_does_not_matter_to_others(
    make: Make, kind: Kind, before: bytes, after: bytes, why: str
) -> None:
    file = data_file(make(text, plain, kind=kind))
    data = file.read_bytes()
    assert before in data
    file.write_bytes(data.replace(before, after))
    check_poses(open_dataset(file))
    assert why in RosReader(file).topics["/notes"].type
