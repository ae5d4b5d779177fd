"""The poses of a bag as they were known at a time: paths that are sent again, and transforms that jump."""

from functools import partial

import numpy as np
import pytest
from inputs_bags import (
    COUNT,
    FRAME,
    START,
    Bag,
    Kind,
    Make,
    T_body_camera,
    images,
    mounted,
    moving_tf,
    plain,
    stamp,
    world_body,
)

from taichi_mrf.datasets.pose_sources.base import ChangedPoses, open_pose_source
from taichi_mrf.datasets.pose_sources.posed import PosedFrames, open_posed
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose


def offset(*metres: float) -> Pose:
    T = np.eye(4)
    T[:3, 3] = metres
    return T


def way(T_fixed_odom: Pose) -> dict[float, Pose]:
    """The camera's poses by their stamps."""
    return {stamp(i): T_fixed_odom @ world_body(i) @ T_body_camera for i in range(COUNT)}


def assert_poses(found: ChangedPoses | None, wanted: dict[float, Pose]) -> None:
    np.testing.assert_allclose(list(found), [START + stamp for stamp in wanted])
    for T, expected in zip(found.values(), wanted.values(), strict=True):
        np.testing.assert_allclose(np.asarray(T), expected, atol=1e-9)


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_a_path_that_is_sent_again_corrects_earlier_poses(make: Make, kind: Kind) -> None:
    first = {stamp(i): world_body(i) for i in range(2)}
    last = {stamp(i): offset(0.0, 0.3, 0.1 * i) @ world_body(i) for i in range(4)}

    def paths(bag: Bag) -> None:
        bag.path("/slam/path", stamp(0) - 0.5, "map", {})  # nothing known yet
        bag.path("/slam/path", stamp(1), "map", first)
        bag.path("/slam/path", stamp(3), "map", last)

    path = make(plain, paths, kind=kind)
    source = open_pose_source(path)
    assert source.name == f"{path}: /slam/path"
    assert source.poll(float("-inf")) is None
    assert source.poll(START + stamp(0)) is None
    assert_poses(source.poll(START + stamp(1)), {s: T @ T_body_camera for s, T in first.items()})
    assert source.poll(START + stamp(2)) is None
    assert_poses(source.poll(float("inf")), {s: T @ T_body_camera for s, T in last.items()})
    assert source.poll(float("inf")) is None

    # Frames that the last message does not name move with the last one that it does.
    last |= {stamp(i): offset(0.0, 0.3, 0.3) @ world_body(i) for i in range(4, COUNT)}
    followed = open_posed(path, path, follow=True)
    assert isinstance(followed, PosedFrames)
    for now, known in ((stamp(0), {}), (stamp(2), first), (stamp(3), last)):
        followed.poses.renew(START + now)
        for i in range(COUNT):
            T = known.get(stamp(i), world_body(i)) @ T_body_camera
            np.testing.assert_allclose(followed.read(i).T_world_camera, T, atol=1e-9)
    posed = open_posed(path, path)  # the last message, for the recording itself
    for i in range(COUNT):
        T = last.get(stamp(i), world_body(i)) @ T_body_camera
        np.testing.assert_allclose(posed.read(i).T_world_camera, T, atol=1e-9)


def test_a_transform_that_jumps_moves_all_earlier_poses(make: Make) -> None:
    before, jump = offset(0.0, 0.0, 0.5), offset(0.2, -0.1, 0.0)

    def corrected(bag: Bag) -> None:
        for i in range(COUNT):
            bag.tf("/tf", stamp(i), "map", "odom", jump if i >= 3 else before)

    in_earth = partial(mounted, parent="earth", child="map", T=offset(0.0, 0.0, 7.0))
    path = make(images, mounted, moving_tf, corrected, in_earth, kind="sqlite")
    source = open_pose_source(f"{path}?pose=tf&frame=map")
    for now, T_map_odom in ((stamp(1), before), (stamp(4), jump)):
        assert_poses(source.poll(START + now), way(T_map_odom))
    assert source.poll(float("inf")) is None
    earth = open_pose_source(f"{path}?pose=tf").poll(float("inf"))
    assert_poses(earth, way(offset(0.2, -0.1, 7.0)))


def test_a_topic_of_single_poses_does_not_change(make: Make) -> None:
    source = open_pose_source(make(plain))
    assert_poses(source.poll(float("-inf")), way(np.eye(4)))
    assert source.poll(float("inf")) is None


def test_what_a_bag_cannot_tell_is_refused(make: Make) -> None:
    def paths(bag: Bag) -> None:
        bag.path("/a", 1.0, "map", {1.0: world_body(0)})
        bag.path("/b", 1.0, "map", {})

    path = make(images, mounted, partial(moving_tf, numbers=(0, 1)), paths, kind="mcap")
    for query, words in (
        ("", r"choose one with \?pose=/a or \?pose=/b or \?pose=tf"),
        ("?pose=/c", "there is no topic /c"),
        ("?pose=/b", "topic /b: no message contains a pose"),
        ("?pose=tf", f"tf corrects nothing between odom and {FRAME}"),
        ("?pose=/a&body=wheel", "tf has no frame 'wheel'"),
        ("?poses=x.txt", "does not go with --poses"),
        ("?pose=/camera/depth/image_raw", "is of type sensor_msgs/msg/Image"),
    ):
        with pytest.raises(DatasetError, match=words):
            open_pose_source(f"{path}{query}").poll(float("inf"))
