"""A robot that runs, heard by Foxglove's protocol from a real server; and what is said where none listens."""

import socket
from collections import Counter
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread

import pytest
from heard import SECONDS, heard
from inputs_bags import INFO, TOPIC, plain, write_bag

from taichi_mrf.datasets.wires import client as clients
from taichi_mrf.datasets.wires import foxglove
from taichi_mrf.datasets.wires.client import wait_until
from taichi_mrf.datasets.wires.foxglove import FoxgloveClient
from taichi_mrf.errors import DatasetError

pytest.importorskip("foxglove", reason="needs foxglove-sdk")

import foxglove as library
from foxglove_robot import Robot


@pytest.fixture
def walk(tmp_path: Path) -> Iterator[Robot]:
    with Robot(write_bag(tmp_path, plain, kind="mcap")) as found:
        yield found


@pytest.fixture
def client(walk: Robot) -> Iterator[FoxgloveClient]:
    found = FoxgloveClient(f"127.0.0.1:{walk.port}")
    yield found
    found.close()


def test_channels_and_messages_are_those_of_the_bag(walk: Robot, client: FoxgloveClient) -> None:
    assert set(client.channels) == set(walk.channels)
    channel = client.channels[INFO]
    assert (channel.type, channel.encoding, channel.language) == ("sensor_msgs/msg/CameraInfo", "cdr", "MSG")
    assert "distortion_model" in channel.definition
    client.subscribe(list(client.channels))
    walk.wait_for(*client.channels)
    walk.send()
    found = heard(client, len(walk.messages))
    assert sorted((each.channel.topic, each.logged_ns, each.data) for each in found) == sorted(walk.messages)


def test_only_wanted_topics_are_sent(walk: Robot, client: FoxgloveClient) -> None:
    client.subscribe([TOPIC, "/odom"])
    walk.wait_for(TOPIC, "/odom")
    client.subscribe([INFO, "/odom"])
    assert wait_until(lambda: sorted(walk.listener.topics) == [INFO, "/odom"], SECONDS)
    walk.send()
    wanted = [each for each in walk.messages if each[0] in (INFO, "/odom")]
    assert len(heard(client, len(wanted))) == len(wanted)


def test_the_oldest_images_are_dropped_and_nothing_else(
    walk: Robot, client: FoxgloveClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clients, "MOST_IMAGES", 2)
    client.subscribe(list(client.channels))
    walk.wait_for(*client.channels)
    walk.send()
    walk.send("/tf_static")
    sent = Counter(topic for topic, _, _ in walk.messages)
    assert wait_until(lambda: len(client._others) == len(walk.messages) - sent[TOPIC] + 1, SECONDS)
    found = client.take()
    images = [each.logged_ns for each in found if each.channel.topic == TOPIC]
    assert images == [time for topic, time, _ in walk.messages if topic == TOPIC][-2:]
    assert client.dropped == {TOPIC: sent[TOPIC] - 2}
    assert len(found) == len(walk.messages) - client.dropped[TOPIC] + 1


def test_a_lost_connection_is_made_again_with_its_topics(
    walk: Robot, client: FoxgloveClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(foxglove, "RETRY_S", 0.05)
    client.subscribe(["/odom"])
    walk.wait_for("/odom")
    walk.stop()
    assert wait_until(lambda: "trying again" in client.problem, SECONDS)
    assert f"ws://127.0.0.1:{walk.port}" in client.problem
    walk.start()
    walk.wait_for("/odom")
    assert client.problem == ""
    walk.send("/odom")
    assert len(heard(client, 5)) == 5


def test_a_topic_that_is_advertised_again_is_heard_again(walk: Robot, client: FoxgloveClient) -> None:
    """A publisher that starts again has another number; without one the topic is not there."""
    client.subscribe(["/odom"])
    walk.wait_for("/odom")
    old, known = walk.channels["/odom"], client.channels["/odom"]
    old.close()
    assert wait_until(lambda: "/odom" not in client.channels, SECONDS)
    walk.listener.topics.clear()
    schema = library.Schema(name=known.type, encoding="ros2msg", data=known.definition.encode())
    walk.channels["/odom"] = library.Channel(
        "/odom", schema=schema, message_encoding="cdr", context=walk.context
    )
    assert walk.channels["/odom"].id() != old.id()
    walk.wait_for("/odom")
    assert client.channels["/odom"] == known
    walk.send("/odom")
    assert len(heard(client, 5)) == 5


def test_where_nobody_listens_the_error_says_what_to_start() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(DatasetError, match=rf"ws://127.0.0.1:{port}: nobody listens.*foxglove_bridge"):
        FoxgloveClient(f"ws://127.0.0.1:{port}")


def test_what_does_not_answer_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foxglove, "CONNECT_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(DatasetError, match=rf"ws://127.0.0.1:{port}: no answer within 0.1 s"):
            FoxgloveClient(f"127.0.0.1:{port}")


class Page(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self.send_response(404)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *words: object) -> None:
        pass


def test_another_program_is_told_so() -> None:
    server = HTTPServer(("127.0.0.1", 0), Page)
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        with pytest.raises(DatasetError, match=r"not a Foxglove server \(.*404"):
            FoxgloveClient(f"127.0.0.1:{server.server_port}")
    finally:
        server.shutdown()
        server.server_close()


def test_a_websocket_of_another_protocol_is_told_so() -> None:
    from websockets.sync.server import serve

    with serve(lambda connection: None, "127.0.0.1", 0) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        with pytest.raises(DatasetError, match=r"not a Foxglove server"):
            FoxgloveClient(f"127.0.0.1:{server.socket.getsockname()[1]}")
        server.shutdown()


@pytest.mark.parametrize(
    ("address", "whole"),
    [
        ("", "ws://localhost:8765"),
        ("robot", "ws://robot:8765"),
        ("robot:9000", "ws://robot:9000"),
        ("wss://robot", "wss://robot:8765"),
        ("ws://10.0.0.7:8765", "ws://10.0.0.7:8765"),
    ],
)
def test_addresses_are_completed(address: str, whole: str) -> None:
    assert foxglove._whole(address) == whole


@pytest.mark.parametrize("address", ["http://robot", "ws://", "ws://robot:eight"])
def test_what_is_no_address_is_told_so(address: str) -> None:
    with pytest.raises(DatasetError, match=f"foxglove:{address}: .*ws://HOST:8765"):
        FoxgloveClient(address)
