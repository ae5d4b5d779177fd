"""Foxglove's own messages, as its library encodes them, read as those of ROS that say the same."""

import sys
from pathlib import Path

import bag_clouds
import numpy as np
import pytest
from heard import SECONDS, assert_same_frame, begun
from inputs_bags import (
    BETWEEN,
    COUNT,
    FRAME,
    IMAGES,
    TOPIC,
    WAYS,
    Bag,
    images,
    mounted,
    stamp,
    steps,
    write_bag,
)

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.wires import robot as wired
from taichi_mrf.datasets.wires.client import wait_until
from taichi_mrf.datasets.wires.schemas import protobuf_decoder
from taichi_mrf.errors import DatasetError, TaichiMRFError

pytest.importorskip("foxglove", reason="needs foxglove-sdk")

from foxglove import messages as m
from foxglove_robot import Robot
from google.protobuf.message import DecodeError


def packed(bag: Bag) -> None:
    images(bag, numbers=())
    for i in range(COUNT):
        bag.compressed(TOPIC, stamp(i), FRAME, steps(i), "png")


def clouds(bag: Bag) -> None:
    ring = np.repeat(np.arange(4, dtype=np.uint16), bag_clouds.CAMERA.shape[1])[None]
    for scan in range(bag_clouds.SCANS):
        bag_clouds.send(bag, bag_clouds.stamp(scan), bag_clouds.points(scan).reshape(1, -1, 3), ring=ring)
    for i in range(12):
        at = 0.9 + 0.05 * i
        bag.tf("/tf", at, "odom", bag_clouds.BODY, bag_clouds.pose(at))
    bag.tf("/tf_static", 0.0, bag_clouds.BODY, bag_clouds.LIDAR, bag_clouds.T_BODY_LIDAR)


def posed(bag: Bag) -> None:
    for i in BETWEEN:
        T = np.eye(4)
        T[:3, 3] = [i, 0.5 * i, 0.1]
        bag.pose_stamped("/camera/pose", stamp(i), "map", T)


PARTS = {
    "whole numbers": [images, mounted, WAYS["tf"]],
    "floats": [IMAGES["32FC1"], mounted, WAYS["tf"]],
    "PNG": [packed, mounted, WAYS["tf"]],
    "poses": [images, posed],
    "clouds": [clouds],
}


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
@pytest.mark.parametrize("kind", PARTS)
def test_frames_are_those_of_ros_bit_for_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, encoding: str
) -> None:
    monkeypatch.setattr(wired, "LISTEN_S", 0.5)
    bag = write_bag(tmp_path, *PARTS[kind], kind="mcap")
    pose = "/camera/pose" if kind == "poses" else "/tf"
    with Robot(bag, own=encoding) as sender:
        live = begun(sender, 1000, listen_to=pose)
        recorded = open_dataset(bag, color=False)
        assert wait_until(lambda: not live.awaiting(), SECONDS)
        ours = live.read(0)
        theirs = next(frame for frame in recorded if frame.name == ours.name)
    assert live.camera.shape == recorded.camera.shape
    assert_same_frame(ours, theirs)


def test_protobuf_is_decoded_by_its_descriptors() -> None:
    message = m.CameraCalibration(
        timestamp=m.Timestamp(1_700_000_000, 7), frame_id="eye", width=640, height=480, D=[], K=[1.5] * 9
    )
    decode = protobuf_decoder("foxglove.CameraCalibration", m.CameraCalibration.get_schema().data)
    found = decode(message.encode())
    assert found["timestamp"] == {"seconds": 1_700_000_000, "nanos": 7}
    assert (found["frame_id"], found["width"], found["K"]) == ("eye", 640, [1.5] * 9)
    assert "D" not in found


@pytest.mark.parametrize("cut", range(1, 40))
def test_a_damaged_message_is_an_error(cut: int) -> None:
    decode = protobuf_decoder("foxglove.RawImage", m.RawImage.get_schema().data)
    data = m.RawImage(frame_id="camera", width=2, height=2, encoding="16UC1", step=4, data=bytes(8)).encode()
    try:
        found = decode(data[:-cut])
    except DecodeError:
        return
    assert set(found) <= {"frame_id", "width", "height", "encoding", "step", "data"}


def test_without_protobufs_library_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "google.protobuf.descriptor_pb2", None)
    with pytest.raises(TaichiMRFError, match=r"need protobuf, .*: pip install 'taichi-mrf\[ros\]'"):
        protobuf_decoder("foxglove.RawImage", m.RawImage.get_schema().data)


def test_points_with_a_pose_of_their_own_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wired, "LISTEN_S", 0.5)
    monkeypatch.setattr(wired, "DECIDE_S", 0.3)
    at = m.Pose(position=m.Vector3(x=1.0, y=0.0, z=0.0), orientation=m.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))
    with Robot(write_bag(tmp_path, clouds, kind="mcap"), own="protobuf") as sender:
        moved = m.PointCloud(frame_id="lidar", pose=at, point_stride=12, fields=[], data=bytes(12)).encode()
        sender.messages = [(t, s, moved if t == "/points" else data) for t, s, data in sender.messages]
        with pytest.raises(DatasetError, match="points have a pose in their frame"):
            begun(sender, 1000, listen_to="/tf", color=True)
