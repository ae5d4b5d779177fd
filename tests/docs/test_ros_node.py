"""examples/ros_node.py, run with stand-ins of the ROS modules, which send it a few images."""

import sys
from array import array
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import taichi_mrf as tm

pytestmark = pytest.mark.usefixtures("one_backend")
NODE = Path(__file__).resolve().parents[2] / "examples" / "ros_node.py"
PADDING = 12
"""Bytes at the end of each row."""


class TransformError(Exception):
    """tf2_ros.TransformException."""


def quaternion(R: np.ndarray) -> SimpleNamespace:
    """Of a rotation whose w is not small."""
    w = 0.5 * np.sqrt(1 + np.trace(R))
    x, y, z = (R[2, 1] - R[1, 2]) / (4 * w), (R[0, 2] - R[2, 0]) / (4 * w), (R[1, 0] - R[0, 1]) / (4 * w)
    return SimpleNamespace(x=x, y=y, z=z, w=w)


def turned(seconds: float) -> np.ndarray:
    """A pose (4, 4) that goes sideways and turns."""
    c, s, T = np.cos(0.3 * seconds), np.sin(0.3 * seconds), np.eye(4)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = [0.1 * seconds, 0.0, 0.2]
    return T


class Buffer:
    """Knows poses but at 2 s."""

    def lookup_transform(self, target: str, source: str, time: Any, timeout: Any) -> SimpleNamespace:
        assert (target, source, timeout.seconds) == ("odom", "optical", 0.1)
        if time.stamp.sec == 2:
            raise TransformError("odom is not known then")
        T = turned(time.stamp.sec)
        x, y, z = T[:3, 3]
        translation = SimpleNamespace(x=x, y=y, z=z)
        return SimpleNamespace(
            transform=SimpleNamespace(rotation=quaternion(T[:3, :3]), translation=translation)
        )


class Node:
    def __init__(self, name: str) -> None:
        self.heard: dict[str, Callable[[Any], object]] = {}
        self.warned: list[str] = []

    def create_subscription(self, kind: type, topic: str, call: Callable[[Any], object], qos: object) -> None:
        self.heard[topic] = call

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(warning=self.warned.append)


def image(seconds: int, encoding: str, depth_m: np.ndarray) -> SimpleNamespace:
    rows = np.rint(1000 * depth_m).astype(np.uint16) if encoding == "16UC1" else depth_m.astype(np.float32)
    data = np.pad(np.ascontiguousarray(rows).view(np.uint8), ((0, 0), (0, PADDING)))
    header = SimpleNamespace(frame_id="optical", stamp=SimpleNamespace(sec=seconds, nanosec=500_000_000))
    height, width = depth_m.shape
    return SimpleNamespace(
        header=header,
        encoding=encoding,
        height=height,
        width=width,
        step=data.shape[1],
        is_bigendian=0,
        data=array("B", data.tobytes()),
    )


def ros(monkeypatch: pytest.MonkeyPatch, spin: Callable[[Any], None]) -> None:
    """Put the stand-ins where the program imports them."""
    time = SimpleNamespace(Time=SimpleNamespace(from_msg=lambda stamp: SimpleNamespace(stamp=stamp)))
    duration = SimpleNamespace(Duration=lambda seconds: SimpleNamespace(seconds=seconds))
    msg = {"Image": type("Image", (), {}), "CameraInfo": type("CameraInfo", (), {})}
    tf2 = {"Buffer": Buffer, "TransformException": TransformError}
    tf2["TransformListener"] = lambda buffer, node, spin_thread: (buffer, node, spin_thread)
    modules = {
        "rclpy": {"init": lambda: None, "create_node": Node, "spin": spin},
        "rclpy.duration": vars(duration),
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": "best effort"},
        "rclpy.time": vars(time),
        "sensor_msgs": {},
        "sensor_msgs.msg": msg,
        "tf2_ros": tf2,
    }
    for name, names in modules.items():
        module = ModuleType(name)
        vars(module).update(names)
        monkeypatch.setitem(sys.modules, name, module)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_a_node_maps_what_it_hears(encoding: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    depth_m = np.full((30, 40), 2.0)
    depth_m[:, 25:] = 1.5
    nodes = []

    def spin(node: Any) -> None:
        nodes.append(node)
        info = SimpleNamespace(width=40, height=30, k=[35.0, 0, 19.5, 0, 35.5, 14.5, 0, 0, 1])
        node.heard["depth"](image(0, encoding, depth_m))  # no camera is known yet
        node.heard["info"](info)
        for seconds in (1, 1, 2, 3):
            node.heard["depth"](image(seconds, encoding, depth_m))
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    live = tm.live
    monkeypatch.setattr(tm, "live", lambda m: live(m, port=0))
    ros(monkeypatch, spin)
    names: dict[str, Any] = {"__name__": "ros_node"}
    exec(compile(NODE.read_text(encoding="utf-8"), str(NODE), "exec"), names)
    names["main"]()
    m = tm.load_map(tmp_path / "map.npz")
    assert [keyframe.stamp_s for keyframe in m.keyframes.values()] == [1.5, 3.5]
    for keyframe, seconds in zip(m.keyframes.values(), (1, 3), strict=True):
        np.testing.assert_allclose(keyframe.T_world_camera, turned(seconds), atol=1e-9)
        np.testing.assert_allclose(keyframe.depth_m, depth_m, atol=1e-6)
        assert keyframe.camera == tm.PinholeCamera(40, 30, 35.0, 35.5, 19.5, 14.5)
    assert len(m.voxels()[0]) > 100
    assert nodes[0].warned == ["no pose: odom is not known then"]


def test_it_is_short_and_says_that_it_was_not_run() -> None:
    text = NODE.read_text(encoding="utf-8")
    assert len(text.split("\nclass Mapper")[1].splitlines()) <= 42
    assert "python3 examples/ros_node.py" in text
    assert "was not run with it" in text
