"""A map's messages while it is made, as a client of Foxglove's protocol gets them: those of the saved map."""

import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_room
from console import assert_refused, taichi_mrf
from live_program import DEADLINE_S, PROGRAM
from queried_maps import room_map

import taichi_mrf as tm
from taichi_mrf.config.arguments import ArgumentTypeError
from taichi_mrf.datasets.wires.client import wait_until
from taichi_mrf.datasets.wires.foxglove import FoxgloveClient
from taichi_mrf.errors import ConfigError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

mcap = pytest.importorskip("mcap.reader", reason="MCAP files are read by its own library: pip install mcap")
pytest.importorskip("foxglove", reason="messages need the extra robot")
pytest.importorskip("rosbags", reason="messages of ROS need the extra robot")

ROOM = "synthetic:room?frames=6&width=80&height=60"
FLAGS = ("--voxel-size", "0.1", "--runtime.arch", "cpu", "--port", "0")
BAND = {"z_min": -0.9, "z_max": 0.3}
PLACES = ("/map/costmap", "/map/octomap", "/map/voxels")
OTHERS = ("/map/path", "/map/surface", "/tf")


def exported(m: Any, folder: Path) -> dict[str, list[bytes]]:
    """The messages of a map in a file, by topic, in order."""
    tm.export_map(m, folder / "map.mcap", tm.ExportOptions(**BAND))
    found: dict[str, list[bytes]] = {}
    with open(folder / "map.mcap", "rb") as file:
        for _, channel, message in mcap.make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append(message.data)
    return found


@contextmanager
def client_of(address: str, *topics: str) -> Iterator[FoxgloveClient]:
    client = FoxgloveClient(address)
    try:
        client.subscribe(topics)
        yield client
    finally:
        client.close()


def received(
    client: FoxgloveClient, count: int = 0, update: Callable[[], None] = lambda: None
) -> dict[str, list[bytes]]:
    """What has come by topic, in order: once it has ``count`` topics, while there are updates."""
    found: dict[str, list[bytes]] = {}

    def has_come() -> bool:
        update()
        for raw in client.take():
            found.setdefault(raw.channel.topic, []).append(raw.data)
        return len(found) >= count

    assert wait_until(has_come, DEADLINE_S), found.keys()
    return found


@pytest.mark.usefixtures("one_backend")
def test_a_live_run_sends_the_messages_of_the_map_that_it_saves(tmp_path: Path) -> None:
    publishing = ("--publish", "foxglove:0", "--publish-every", "0.1", "--publish-band", "-0.9", "0.3")
    arguments = ("live", ROOM, *FLAGS, *publishing, "--out", str(tmp_path / "run"), "--exit-when-done")
    with subprocess.Popen(
        [sys.executable, *PROGRAM, *arguments], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[-1]
        with client_of(address, *PLACES, *OTHERS) as client:
            process.stdout.read()
            assert process.wait(DEADLINE_S) == 0
            got = received(client)
    wanted = exported(tm.load_map(tmp_path / "run" / "map.npz"), tmp_path)
    for topic in (*PLACES, *OTHERS):
        assert got[topic][-1] == wanted[topic][-1], topic
    assert len(got["/map/voxels"]) > 1  # while it maps, too


@pytest.mark.usefixtures("one_backend")
def test_only_what_has_changed_is_sent_and_only_to_who_subscribes(monkeypatch: pytest.MonkeyPatch) -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    with tm.publish(m, port=0, every_s=0.0) as served:
        made: list[str] = []
        log = served._server._channels.voxels
        monkeypatch.setattr(
            served._server._channels, "voxels", lambda *parts: [made.append("voxels"), log(*parts)]
        )
        frames = small_room.frames()
        m.renew([small_room.add(m, frames[0])])
        served.update()
        assert made == []
        with client_of(served.address, "/map/voxels") as first:
            channels = served._server._channels
            assert wait_until(lambda: channels.are_wanted("/map/voxels"), DEADLINE_S)
            m.renew([small_room.add(m, frames[1])])
            for _ in range(4):
                served.update()
            assert len(made) == 2  # while frames come, and as the map rests
            assert set(received(first, 1)) == {"/map/voxels"}
            with client_of(served.address, "/map/voxels") as second:
                assert received(second, 1, served.update)
            m.infer()
            served.update()
            assert len(made) == 4
        assert wait_until(lambda: not channels.are_wanted("/map/voxels"), DEADLINE_S)
        m.renew([small_room.add(m, frames[2])])
        served.update()
        assert len(made) == 4


@pytest.mark.usefixtures("one_backend")
def test_a_post_thinner_than_a_voxel_is_sent_while_frames_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """Marginals call it free: rays that pass beside it outvote those that end on it."""
    camera, post_m = PinholeCamera(96, 72, 80.0, 80.0, 47.5, 35.5), np.array([0.02, 0.02, 1.02])
    m, sent = MRFMap(0.05, PolynomialNoise(sigma=(0.004,))), []
    with tm.publish(m, port=0, every_s=0.0) as served:
        channels = served._server._channels
        monkeypatch.setattr(channels, "voxels", lambda points, _: sent.append(points.centres_m))
        with client_of(served.address, "/map/voxels"):
            assert wait_until(lambda: channels.are_wanted("/map/voxels"), DEADLINE_S)
            for x_m in np.linspace(-0.4, 0.4, 10):
                across_m = x_m + (np.arange(camera.width) - camera.cx) / camera.fx * post_m[2]
                depth_m = np.where(np.abs(across_m - post_m[0]) < 0.012, post_m[2], 2.02)
                T_world_camera = np.eye(4)
                T_world_camera[0, 3] = x_m
                image = np.tile(depth_m.astype(np.float32), (camera.height, 1))
                m.infer(sweeps=1, keyframes=[m.add_keyframe(image, T_world_camera, camera)])
            assert not m.settled
            assert served._server.send(m, False, {})
    assert m.marginals.occupancy([post_m])[0] < 0.05
    assert (np.abs(sent[0] - post_m).max(axis=1) < 0.5 * m.voxel_size + 1e-6).any()


@pytest.mark.usefixtures("one_backend")
def test_who_comes_later_gets_the_whole(tmp_path: Path) -> None:
    m = room_map("mrf")
    wanted = exported(m, tmp_path)
    with tm.publish(m, tm.ExportOptions(**BAND), port=0, every_s=0.0) as served:
        served.update()
        for _ in range(2):
            with client_of(served.address, *PLACES, *OTHERS) as client:
                got = received(client, len(PLACES + OTHERS), served.update)
            assert {topic: messages[-1] for topic, messages in got.items()} == {
                topic: messages[-1] for topic, messages in wanted.items()
            }


def test_what_cannot_be_served_is_said_before_work_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(word: str, *arguments: str) -> None:
        assert_refused(taichi_mrf("live", ROOM, *FLAGS, *arguments), word)

    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        refused(f"127.0.0.1:{port}", "--publish", f"foxglove:{port}")
        with pytest.raises(ConfigError, match="another port"):
            tm.publish(MRFMap(0.1), port=port)
    refused("foxglove:PORT", "--publish", "rviz")
    refused("65535", "--publish", "foxglove:70000")
    refused("--publish-every", "--publish", "foxglove", "--publish-every", "-1")
    refused("--publish foxglove", "--publish-band", "0", "1")
    refused("rising", "--publish", "foxglove", "--publish-band", "1", "0")
    monkeypatch.setitem(sys.modules, "foxglove", None)
    refused("taichi-mrf[robot]", "--publish", "foxglove:0")
    with pytest.raises(ArgumentTypeError):
        tm.publish("map.npz")  # type: ignore[arg-type]
