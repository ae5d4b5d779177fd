"""A map's messages in ROS 2's types, as nodes over Zenoh get them: two sessions and a router between them."""

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from console import assert_refused, taichi_mrf
from live_program import DEADLINE_S, PROGRAM
from queried_maps import room_map

import taichi_mrf as tm
from taichi_mrf.datasets.wires import rmw_zenoh
from taichi_mrf.datasets.wires.client import Raw, wait_until
from taichi_mrf.datasets.wires.rmw_zenoh import ZenohClient
from taichi_mrf.errors import ConfigError
from taichi_mrf.methods.mrf.map import MRFMap

pytest.importorskip("zenoh", reason="needs eclipse-zenoh")

import zenoh
from zenoh_robot import config, dds_name, free_port

typesys = pytest.importorskip("rosbags.typesys", reason="messages of ROS need the extra robot")
mcap = pytest.importorskip("mcap.reader", reason="MCAP files are read by its own library: pip install mcap")

pytestmark = pytest.mark.usefixtures("one_backend")
BAND = tm.ExportOptions(z_min=-0.9, z_max=0.3)
TYPES = {
    "/map/costmap": "nav_msgs/msg/OccupancyGrid",
    "/map/octomap": "octomap_msgs/msg/Octomap",
    "/map/path": "nav_msgs/msg/Path",
    "/map/surface": "visualization_msgs/msg/Marker",
    "/map/voxels": "sensor_msgs/msg/PointCloud2",
    "/tf": "tf2_msgs/msg/TFMessage",
}
COSTMAP = "/map/costmap"


@pytest.fixture
def address() -> Iterator[str]:
    """A router, as a robot runs one."""
    where = f"tcp/127.0.0.1:{free_port()}"
    router = zenoh.open(config(mode="router", listen__endpoints=[where], scouting__multicast__enabled=False))
    yield where
    router.close()


@contextmanager
def client_of(address: str, *topics: str, domain: int = 0) -> Iterator[ZenohClient]:
    client = ZenohClient(address, domain)
    try:
        assert {topic: each.type for topic, each in client.channels.items()} == TYPES
        client.subscribe(topics)
        yield client
    finally:
        client.close()


def received(client: ZenohClient, count: int, update: Callable[[], None] = lambda: None) -> dict[str, Raw]:
    """The newest message of each topic, once ``count`` topics have one, while there are updates."""
    found: dict[str, Raw] = {}

    def has_come() -> bool:
        update()
        found.update({raw.channel.topic: raw for raw in client.take()})
        return len(found) >= count

    assert wait_until(has_come, DEADLINE_S), found.keys()
    return found


def decoded(raw: Raw) -> Any:
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    return store.deserialize_cdr(raw.data, raw.channel.type)


def in_file(m: Any, folder: Path) -> dict[str, bytes]:
    """The messages of a map in an .mcap, by topic."""
    tm.export_map(m, folder / "map.mcap", BAND)
    with open(folder / "map.mcap", "rb") as file:
        return {channel.topic: each.data for _, channel, each in mcap.make_reader(file).iter_messages()}


def test_nodes_get_what_files_have(address: str, tmp_path: Path) -> None:
    m = room_map("mrf")
    with tm.publish(m, BAND, zenoh=address, every_s=0.0) as served:
        assert served.address == f"zenoh:{address}"
        with client_of(address, *TYPES) as client:
            got = received(client, len(TYPES), served.update)
    assert got["/map/octomap"].data == in_file(m, tmp_path)["/map/octomap"]

    tm.export_map(m, tmp_path / "floor.pgm", BAND)
    image = cv2.imread(str(tmp_path / "floor.pgm"), cv2.IMREAD_UNCHANGED)
    grid = decoded(got[COSTMAP])
    cells = np.flipud(grid.data.reshape(grid.info.height, grid.info.width))
    for cell, grey in ((100, 0), (0, 254), (-1, 205)):
        np.testing.assert_array_equal(cells == cell, image == grey)
    assert grid.header.frame_id == "map"

    cloud = decoded(got["/map/voxels"])
    kinds = {7: "<f4"}
    layout = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    points = np.frombuffer(cloud.data.tobytes(), layout)
    assert len(points) == cloud.width
    assert cloud.row_step == len(cloud.data)
    voxels = points[points["size"] == np.float32(m.voxel_size)]
    centres_m, p = m.voxels()
    np.testing.assert_allclose(np.stack([voxels[axis] for axis in "xyz"], 1), centres_m, atol=1e-5)
    np.testing.assert_array_equal(voxels["probability"], p)

    in_time = sorted(m.keyframes.values(), key=lambda k: k.stamp_s)
    path, (newest,) = decoded(got["/map/path"]), decoded(got["/tf"]).transforms
    places_m = [(each.pose.position.x, each.pose.position.y, each.pose.position.z) for each in path.poses]
    np.testing.assert_allclose(places_m, [k.T_world_camera[:3, 3] for k in in_time], atol=1e-9)
    stamps_s = [each.header.stamp.sec + 1e-9 * each.header.stamp.nanosec for each in path.poses]
    np.testing.assert_allclose(stamps_s, [k.stamp_s for k in in_time])
    assert (newest.header.frame_id, newest.child_frame_id) == ("map", "taichi_mrf_camera")
    x, y, z, w = (getattr(newest.transform.rotation, name) for name in "xyzw")
    forwards = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    np.testing.assert_allclose(forwards, in_time[-1].T_world_camera[:3, 2], atol=1e-9)

    tm.export_map(m, tmp_path / "map.ply", tm.ExportOptions(mesh=True))
    marker = decoded(got["/map/surface"])
    header = (tmp_path / "map.ply").read_bytes().split(b"end_header")[0].decode()
    assert f"element face {len(marker.points) // 3}\n" in header
    assert (marker.type, len(marker.colors)) == (11, len(marker.points))


def test_colours_are_packed_as_rviz_reads_them() -> None:
    from taichi_mrf.export.map_sink import Points
    from taichi_mrf.export.ros_messages import RosMessages

    sent: list[bytes] = []
    one = np.ones(1, np.float32)
    points = Points(np.zeros((1, 3)), one, one.astype(np.float64), np.array([[10, 20, 30]], np.uint8))
    RosMessages(lambda topic, content, time_ns: sent.append(content)).voxels(points, 0.0)
    cloud = typesys.get_typestore(typesys.Stores.ROS2_JAZZY).deserialize_cdr(sent[0], TYPES["/map/voxels"])
    (offset,) = (field.offset for field in cloud.fields if field.name == "rgb")
    packed = int.from_bytes(cloud.data[offset : offset + 4].tobytes(), "little")
    assert packed == 255 << 24 | 10 << 16 | 20 << 8 | 30


def test_who_comes_later_gets_the_newest_without_another_update(address: str, tmp_path: Path) -> None:
    m = room_map("log_odds")
    with tm.publish(m, BAND, zenoh=address, every_s=0.0) as served:
        server = served._server
        with client_of(address, COSTMAP) as first:
            (raw,) = received(first, 1, served.update).values()
            assert not server._wire.are_wanted("/map/octomap")
        assert wait_until(lambda: not server._wire.are_wanted(COSTMAP), DEADLINE_S)
        assert server.due_in(m, True) is None  # nothing is made for nobody
        with client_of(address, COSTMAP) as second:
            assert received(second, 1)[COSTMAP].data == raw.data


def test_keys_tokens_and_attachments_are_those_of_rmw_zenoh(address: str) -> None:
    m, heard, tokens = room_map("log_odds"), [], []
    where = {"mode": "client", "connect__endpoints": [address], "scouting__multicast__enabled": False}
    session = zenoh.open(config(**where))
    session.liveliness().declare_subscriber("@ros2_lv/**", lambda each: tokens.append(str(each.key_expr)))
    session.declare_subscriber("5/map/costmap/**", heard.append)
    with tm.publish(m, BAND, zenoh=address, domain=5, every_s=0.0) as served:
        assert served.address == f"zenoh:{address}?domain=5"
        with client_of(address, COSTMAP, domain=5):
            assert wait_until(lambda: [served.update(), len(heard) == 1][1], DEADLINE_S)
            served._server.start_over()
            assert wait_until(lambda: [served.update(), len(heard) == 2][1], DEADLINE_S)
        session.close()  # before the tokens go
    type_hash = typesys.get_typestore(typesys.Stores.ROS2_JAZZY).hash_rihs01(TYPES[COSTMAP])
    kind = dds_name(TYPES[COSTMAP])
    assert {str(each.key_expr) for each in heard} == {f"5/map/costmap/{kind}/{type_hash}"}
    first, second = (each.attachment.to_bytes() for each in heard)
    assert [int.from_bytes(each[:8], "little") for each in (first, second)] == [1, 2]
    assert 1.7e18 < int.from_bytes(first[8:16], "little") < int.from_bytes(second[8:16], "little")
    assert len(first) == 33
    assert first[16] == 16
    assert first[17:] == second[17:]
    mine = [each.split("/") for each in tokens if "/MP/" in each]
    assert sorted(each[9].replace("%", "/") for each in mine) == sorted(TYPES)
    (token,) = (each for each in mine if each[9] == "%map%costmap")
    assert token[:2] + token[3:4] + token[5:] == [
        *("@ros2_lv", "5", "0", "MP", "%", "%", "taichi_mrf"),
        *("%map%costmap", kind, type_hash, ":1:,1:,:,:,,"),
    ]
    assert any(re.fullmatch(r"@ros2_lv/5/\w+/0/0/NN/%/%/taichi_mrf", each) for each in tokens)


def test_a_live_run_publishes_the_map_that_it_saves(address: str, tmp_path: Path) -> None:
    publishing = ("--publish", f"zenoh:{address}?domain=3", "--publish-every", "0", "--publish-band", "-0.9")
    room = ("synthetic:room?frames=6&width=80&height=60", "--voxel-size", "0.1", "--runtime.arch", "cpu")
    arguments = ("live", *room, "--port", "0", *publishing, "0.3", "--out", str(tmp_path / "run"))
    with subprocess.Popen(
        [sys.executable, *PROGRAM, *arguments, "--exit-when-done"],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert f"ROS 2 nodes get the map at zenoh:{address}?domain=3" in process.stdout.readline()
        with client_of(address, COSTMAP, "/map/octomap", domain=3) as client:
            process.stdout.read()
            assert process.wait(DEADLINE_S) == 0
            got = received(client, 2)
    wanted = in_file(tm.load_map(tmp_path / "run" / "map.npz"), tmp_path)
    for topic, raw in got.items():
        assert raw.data == wanted[topic], topic


def test_what_cannot_be_reached_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rmw_zenoh, "CONNECT_S", 0.3)
    nobody = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(ConfigError, match=rf"zenoh:{nobody}: no answer within 0.3 s.*rmw_zenohd"):
        tm.publish(MRFMap(0.1), zenoh=nobody)
    for written in (f"zenoh:{nobody}?domain=x", "zenoh:?qos=1"):
        refused = taichi_mrf("live", "synthetic:room", "--publish", written)
        assert_refused(refused, "must be foxglove, ")
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(ConfigError, match=r"taichi-mrf\[robot\]"):
        tm.publish(MRFMap(0.1), zenoh=nobody)
