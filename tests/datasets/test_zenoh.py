"""A robot whose ROS 2 runs over Zenoh: layouts as documented, frames as those of the bag, what is said."""

import re
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from heard import SECONDS, begun, came, follow_bag, heard
from inputs_bags import (
    COUNT,
    IMAGES,
    IMU,
    INFO,
    TOPIC,
    WAYS,
    confidence,
    images,
    imu,
    mounted,
    plain,
    write_bag,
)

from taichi_mrf.cli.main import main
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.wires import rmw_zenoh
from taichi_mrf.datasets.wires import robot as wired
from taichi_mrf.datasets.wires.client import wait_until
from taichi_mrf.datasets.wires.rmw_zenoh import ZenohClient, published_ns, publisher_of
from taichi_mrf.errors import DatasetError

pytest.importorskip("zenoh", reason="needs eclipse-zenoh")

from zenoh_robot import Robot, free_port

TOKEN = (
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MP/%/%arm/camera_node/%camera%depth/"
    "sensor_msgs::msg::dds_::Image_/RIHS01_df8b99{}/::,10:,:,:,,"
)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Little is waited for what does not come."""
    monkeypatch.setattr(wired, "LISTEN_S", 0.5)
    monkeypatch.setattr(wired, "DECIDE_S", 0.3)


def test_a_token_tells_topic_type_and_durability() -> None:
    found = publisher_of(TOKEN.format("a" * 58))
    assert found is not None
    assert not found.transient_local
    channel = found.channel
    assert (channel.topic, channel.type) == ("/camera/depth", "sensor_msgs/msg/Image")
    assert (channel.encoding, channel.language) == ("cdr", "NONE")
    kept = publisher_of(TOKEN.replace("/::,10", "/:1:,10"))
    assert kept is not None
    assert kept.transient_local


def test_who_listens_declares_a_token_as_a_subscriber_of_that_topic(walk: Robot, client: ZenohClient) -> None:
    client.subscribe([TOPIC])
    walk.wait_for(TOPIC)
    (token,) = walk.listeners
    parts = token.split("/")
    assert parts[:2] == ["@ros2_lv", "0"]
    assert parts[2] != str(walk.session.info.zid())
    assert parts[3:9] == ["0", "1", "MS", "%", "%", "taichi_mrf"]
    assert parts[9:] == walk.token(TOPIC, 0).split("/")[9:]


@pytest.mark.parametrize(
    "token",
    [
        TOKEN.replace("/MP/", "/MS/"),
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%arm/camera_node",
        "@another/" + TOKEN.partition("/")[2],
        "",
    ],
    ids=["a subscriber", "a node", "another prefix", "nothing"],
)
def test_other_tokens_are_no_publishers(token: str) -> None:
    assert publisher_of(token) is None


def test_the_attachment_tells_when_a_message_was_published() -> None:
    time_ns = 1_600_000_000_123_456_789
    data = (7).to_bytes(8, "little") + time_ns.to_bytes(8, "little") + b"\x10" + bytes(16)
    assert published_ns(data) == time_ns
    assert published_ns(data[:-1]) is None
    assert published_ns(struct.pack("<qqB16s", 7, time_ns, 15, b"")) is None


@pytest.mark.parametrize(
    ("address", "whole"),
    [
        ("", ""),
        ("robot", "tcp/robot:7447"),
        ("robot:1", "tcp/robot:1"),
        ("udp/robot", "udp/robot:7447"),
        ("tcp/[::1]", "tcp/[::1]:7447"),
        ("tcp/[::1]:8", "tcp/[::1]:8"),
    ],
)
def test_protocol_and_port_may_be_missing(address: str, whole: str) -> None:
    assert rmw_zenoh._whole(address) == whole


@pytest.fixture(params=["node", "router", "peer"])
def walk(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Robot]:
    with Robot(write_bag(tmp_path, plain, kind="mcap"), mode=request.param) as found:
        yield found


@pytest.fixture
def client(walk: Robot) -> Iterator[ZenohClient]:
    found = ZenohClient(f"127.0.0.1:{walk.port}")
    yield found
    found.close()


def test_messages_are_those_that_are_sent(walk: Robot, client: ZenohClient) -> None:
    assert {topic: each.type for topic, each in client.channels.items()} == walk.types
    client.subscribe(list(client.channels))
    walk.wait_for(*client.channels)
    walk.send_next(1000)
    found = heard(client, len(walk.messages))
    assert sorted((each.channel.topic, each.logged_ns, each.data) for each in found) == sorted(walk.messages)


def test_a_transient_local_topic_is_heard_by_who_comes_later(walk: Robot, client: ZenohClient) -> None:
    walk.send_next(1000)
    client.subscribe(list(client.channels))
    (only,) = heard(client, 1)
    assert only.channel.topic == "/tf_static"
    assert only.data == next(data for topic, _, data in walk.messages if topic == "/tf_static")


def test_only_wanted_topics_are_sent(walk: Robot, client: ZenohClient) -> None:
    client.subscribe([TOPIC, "/odom"])
    walk.wait_for(TOPIC, "/odom")
    client.subscribe([INFO, "/odom"])
    assert wait_until(lambda: walk.listened() == {INFO, "/odom"}, SECONDS)
    walk.send_next(1000)
    wanted = [each for each in walk.messages if each[0] in (INFO, "/odom")]
    assert len(heard(client, len(wanted))) == len(wanted)


def test_a_lost_connection_is_made_again_with_its_topics(walk: Robot, client: ZenohClient) -> None:
    client.subscribe(["/odom", "/tf_static"])
    walk.wait_for("/odom")
    walk.stop()
    assert wait_until(lambda: "nobody is publishing any more; trying again" in client.problem, SECONDS)
    assert walk.source in client.problem
    walk.start()
    walk.wait_for("/odom")
    assert wait_until(lambda: client.problem == "", SECONDS)
    walk.send_next(1000)
    wanted = [each for each in walk.messages if each[0] in ("/odom", "/tf_static")]
    assert len(heard(client, len(wanted))) == len(wanted)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", IMAGES)
def test_frames_are_those_of_the_bag_bit_for_bit(tmp_path: Path, kind: str, way: str) -> None:
    bag = write_bag(tmp_path, IMAGES[kind], mounted, WAYS[way], kind="mcap")
    with Robot(bag) as sender:
        live = begun(sender, 4, listen_to="/odom" if way == "odometry" else "/tf")
        follow_bag(sender, live, bag, COUNT)


def test_confidence_and_turns_are_those_of_the_bag(tmp_path: Path) -> None:
    bag = write_bag(tmp_path, images, imu, confidence, kind="mcap")
    with Robot(bag) as sender:
        live = begun(sender, 60, query="?poses=track", listen_to=IMU)
        assert live.read(0).sigma_m is not None
        sender.send_next(1000)
        assert wait_until(lambda: came(live) == COUNT and not live.awaiting(), SECONDS)
        ours, theirs = live.read(1), open_dataset(f"{bag}?poses=track", color=False).read(COUNT - 1)
    assert (ours.name, ours.stamp) == (theirs.name, theirs.stamp)
    np.testing.assert_array_equal(ours.sigma_m, theirs.sigma_m)
    span = ours.stamp - 0.1, ours.stamp
    np.testing.assert_array_equal(ours.gyro.turn(*span), theirs.gyro.turn(*span))


def test_a_robot_that_has_fixed_transforms_before_is_listened_to_is_mapped(tmp_path: Path) -> None:
    bag = write_bag(tmp_path, plain, kind="mcap")
    with Robot(bag) as sender:
        sender.messages.sort(key=lambda each: each[0] != "/tf_static")
        fixed = sum(topic == "/tf_static" for topic, _, _ in sender.messages)
        sender.send_next(fixed)
        live = begun(sender, 1000)
        assert wait_until(lambda: came(live) == COUNT, SECONDS)
        np.testing.assert_array_equal(
            live.read(0).T_world_camera, open_dataset(bag, color=False).read(COUNT - 1).T_world_camera
        )


def test_types_of_the_robots_own_are_listed_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    bag = write_bag(tmp_path, plain, kind="mcap")
    with Robot(bag, foreign=("/arm/own",), domain=3) as sender, sender.sending(1000, TOPIC):
        main(["info", f"{sender.source}?domain=3"])
    printed = capsys.readouterr().out
    assert "robot_msgs/msg/Own (its definition was not sent, and it is none of ROS's own types)" in printed
    assert re.search(rf"{TOPIC} +│ sensor_msgs/msg/Image +│ {COUNT}", printed), printed


def test_another_domain_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rmw_zenoh, "FIND_S", 0.5)
    with Robot(write_bag(tmp_path, plain, kind="mcap"), domain=7) as sender:
        with pytest.raises(DatasetError, match=r"zenoh:tcp/127.0.0.1:\d+: connected, but .*\?domain=7"):
            open_dataset(sender.source)
        with pytest.raises(DatasetError, match="a domain is a number from 0 on"):
            open_dataset(f"{sender.source}?domain=-1")


def test_an_address_that_does_not_answer_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rmw_zenoh, "CONNECT_S", 0.3)
    with pytest.raises(DatasetError, match=r"zenoh:tcp/127.0.0.1:\d+: no answer within 0.3 s.*rmw_zenohd"):
        ZenohClient(f"127.0.0.1:{free_port()}")


def test_what_is_no_address_is_told_so() -> None:
    with pytest.raises(DatasetError, match=r"zenoh:/:7447: is not a Zenoh address.*tcp/HOST:7447"):
        ZenohClient("/")


def test_without_zenoh_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(DatasetError, match=r"zenoh:tcp/robot:7447 needs zenoh, .*taichi-mrf\[robot\]"):
        open_dataset("zenoh:robot")


def test_an_option_that_there_is_not_is_told() -> None:
    with pytest.raises(DatasetError, match=r"zenoh:robot.*'?dept'?.*depth"):
        open_dataset("zenoh:robot?dept=/camera")


def test_without_an_address_nodes_on_this_machine_are_found(tmp_path: Path) -> None:
    with Robot(write_bag(tmp_path, plain, kind="mcap"), domain=231, mode="peer", scouting=True) as sender:
        try:
            client = ZenohClient("", 231)
        except DatasetError as error:
            pytest.skip(f"no multicast here: {error}")
        try:
            assert set(client.channels) == set(sender.types)
            assert client.source == "zenoh:?domain=231"
        finally:
            client.close()


def test_where_nobody_is_found_the_error_says_what_to_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rmw_zenoh, "FIND_S", 0.2)
    with pytest.raises(DatasetError, match=r"zenoh:\?domain=232: (nobody answers within|connected, but)"):
        ZenohClient("", 232)
