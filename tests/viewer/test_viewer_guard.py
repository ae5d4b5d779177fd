"""The hostile client: whatever a raw websocket says, only what the page could have said takes effect."""

from __future__ import annotations

import contextlib
import math
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import imageio.v3
import msgspec
import numpy as np
import pytest
import viser
import viser._viser
from hypothesis import given
from hypothesis import strategies as st
from live_program import wait_for
from raw_viewer_client import RawClient, camera_message, raw_client, widget_message
from viser._messages import FileTransferStartUpload, Message, ShareUrlDisconnect, ShareUrlRequest
from websockets.exceptions import ConnectionClosedError
from websockets.protocol import State

from taichi_mrf.viewer.transport.client_messages import Undecodable, decode
from taichi_mrf.viewer.transport.connection import (
    CAMERA_INTERVAL_S,
    LARGEST_MESSAGE,
    LARGEST_PICTURE,
    MESSAGES_PER_SECOND,
    TYPING_REST_S,
    Budget,
    GuardedConnection,
)

if TYPE_CHECKING:
    from guarded_page import GuardedPage

pytest_plugins = ["guarded_page"]


def test_unknown_widgets_and_properties_change_nothing(guarded: GuardedPage, stranger: RawClient) -> None:
    before = guarded.state()
    slider = guarded.uuid("slider")
    for uuid in ("", "nobody", slider.upper(), guarded.gizmo.name, "root", "x" * 5000):
        stranger.say(widget_message(uuid, 0.9))
    for updates in (
        {"max": 1e9},
        {"value": 0.9, "max": 1e9},
        {"props": {}},
        {"update_cb": []},
        {"__class__": 1},
        {"sync_cb": None},
        {"gui_api": 0},
        {},
        [],
        "value",
        None,
        {0: 0.9},
        {"_impl": {"value": 0.9}},
    ):
        stranger.say({"type": "GuiUpdateMessage", "uuid": slider, "updates": updates})
    stranger.say(
        {"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": 0.9}, "excluded_self_client": 0}
    )
    stranger.say({"type": "GuiUpdateMessage", "uuid": [slider], "updates": {"value": 0.9}})
    stranger.say({"type": "GuiUpdateMessage"})
    guarded.settle(stranger)
    assert guarded.state() == before
    assert guarded.widgets["slider"].max == 1.0
    assert guarded.events == []


def test_the_share_tunnel_cannot_be_asked_for(
    guarded: GuardedPage, stranger: RawClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    tunnels: list[Any] = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *args: tunnels.append(args))
    for message in ("ShareUrlRequest", "ShareUrlDisconnect", "ShareUrlUpdated"):
        stranger.say({"type": message})
        stranger.say({"type": message, "share_url": "http://evil.example"})
    guarded.settle(stranger)
    assert tunnels == []
    assert not {ShareUrlRequest, ShareUrlDisconnect} & set(guarded.server._websock_server._incoming_handlers)


def test_nothing_can_be_uploaded(guarded: GuardedPage, stranger: RawClient) -> None:
    start = {
        "type": "FileTransferStartUpload",
        "source_component_uuid": guarded.uuid("upload"),
        "transfer_uuid": "transfer",
        "filename": "../../etc/passwd",
        "mime_type": "text/plain",
        "part_count": 1,
        "size_bytes": 4,
    }
    assert FileTransferStartUpload(**{key: value for key, value in start.items() if key != "type"})
    stranger.say(start)
    stranger.say(
        {
            "type": "FileTransferPart",
            "source_component_uuid": guarded.uuid("upload"),
            "transfer_uuid": "transfer",
            "part_index": 0,
            "content": b"evil",
        }
    )
    stranger.say({**start, "transfer_uuid": "empty", "part_count": 0, "size_bytes": 0})
    guarded.settle(stranger)
    assert guarded.server.gui._current_file_upload_states == {}
    assert guarded.events == []


def test_messages_that_only_a_server_sends_go_nowhere(guarded: GuardedPage, stranger: RawClient) -> None:
    before = guarded.state()
    for message in (
        {"type": "RunJavascriptMessage", "source": "alert(1)"},
        {"type": "RemoveSceneNodeMessage", "name": "/cloud"},
        {"type": "SceneNodeUpdateMessage", "name": "/cloud", "updates": {"visible": False}},
        {"type": "ResetGuiMessage"},
        {"type": "GuiRemoveMessage", "uuid": guarded.uuid("slider")},
        {"type": "GuiFormSubmitMessage", "uuid": "root"},
        {"type": "GuiFormDirtyMessage", "uuid": "root"},
        {"type": "GuiButtonHoldMessage", "uuid": guarded.uuid("button"), "frequency": 10.0},
        {"type": "LocalStorageGetItemResponseMessage", "value": "v", "error": None, "request_uuid": "r"},
        {"type": "GetRenderResponseMessage", "payload": b"unasked", "render_uuid": "r"},
        {"type": "CommandTriggerMessage", "uuid": "unknown"},
        {"type": "_CreateGuiComponentMessage"},
        {"type": "Message"},
        {"type": "SceneNodeDragMessage", "name": "/cloud", "phase": "start"},
        {"type": 7},
        {"type": None},
        {},
        {"no": "type"},
    ):
        stranger.say(message)
    guarded.settle(stranger)
    assert guarded.state() == before
    assert guarded.events == []
    assert guarded.server.scene.get_handle_by_name("/cloud") is not None


def click(name: str, **changes: Any) -> dict[str, Any]:
    return {
        "type": "SceneNodeClickMessage",
        "name": name,
        "instance_index": None,
        "ray_origin": [0.0, 0.0, 0.0],
        "ray_direction": [0.0, 0.0, 2.0],
        "screen_pos": [0.5, 0.5],
        "modifier": None,
        "owner": "",
        **changes,
    }


def scene_click(**changes: Any) -> dict[str, Any]:
    return {
        "type": "ScenePointerMessage",
        "event_type": "click",
        "ray_origin": [0.0, 0.0, 0.0],
        "ray_direction": [0.0, 3.0, 0.0],
        "screen_pos": [[0.5, 0.5]],
        "modifier": None,
        **changes,
    }


def gizmo_move(name: str, **changes: Any) -> dict[str, Any]:
    return {
        "type": "TransformControlsUpdateMessage",
        "name": name,
        "wxyz": [2.0, 0.0, 0.0, 0.0],
        "position": [1, 2, 3],
        "owner": "",
        **changes,
    }


def test_clicks_arrive_with_unit_directions(guarded: GuardedPage, stranger: RawClient) -> None:
    stranger.say(click("/box"))
    stranger.say(scene_click())
    wait_for(lambda: len(guarded.events) == 2, "the clicks")
    assert sorted(guarded.events) == [("box", (0.0, 0.0, 1.0)), ("scene", (0.0, 1.0, 0.0))]


@pytest.mark.parametrize(
    "message",
    [
        click("/nobody"),
        click("box"),
        click(""),
        click("/box", owner="99"),
        click("/box", ray_origin=[math.nan, 0, 0]),
        click("/box", ray_direction=[math.inf, 0, 0]),
        click("/box", ray_direction=[0, 0, 0]),
        click("/box", ray_direction=[0, 1]),
        click("/box", screen_pos=["a", "b"]),
        click("/box", instance_index=-1),
        click("/box", modifier="meta"),
        scene_click(event_type="rect-select", screen_pos=[[0, 0], [1, 1.1]]),
        scene_click(event_type="rect-select", screen_pos=[[0, 0]]),
        scene_click(ray_direction=None),
        scene_click(screen_pos=[]),
        scene_click(ray_origin=[1e300, 0, 0]),
        gizmo_move("/nobody"),
        gizmo_move("/cloud"),
        gizmo_move("/hidden"),
        gizmo_move("/gizmo", owner="99"),
        gizmo_move("/gizmo", wxyz=[0, 0, 0, 0]),
        gizmo_move("/gizmo", wxyz=[math.nan, 0, 0, 0]),
        gizmo_move("/gizmo", wxyz=[1, 0, 0]),
        gizmo_move("/gizmo", position=[math.inf, 0, 0]),
        gizmo_move("/gizmo", position=[1e300, 0, 0]),
        gizmo_move("/gizmo", position="far"),
        {"type": "TransformControlsDragStartMessage", "name": "/hidden", "owner": ""},
        {"type": "TransformControlsDragStartMessage", "name": "/nobody", "owner": ""},
        {"type": "TransformControlsDragEndMessage", "name": "/nobody", "owner": ""},
    ],
    ids=lambda message: str({key: value for key, value in message.items() if key != "owner"})[:100],
)
def test_impossible_clicks_and_drags_change_nothing(
    guarded: GuardedPage, stranger: RawClient, message: dict[str, Any]
) -> None:
    before = guarded.state()
    stranger.say(message)
    guarded.settle(stranger)
    assert guarded.state() == before
    assert guarded.events == []
    assert guarded.server.scene._active_transform_drag_handles == {}


def test_a_gizmo_is_dragged_with_unit_quaternions(guarded: GuardedPage, stranger: RawClient) -> None:
    stranger.say({"type": "TransformControlsDragStartMessage", "name": "/gizmo", "owner": ""})
    stranger.say(gizmo_move("/gizmo", wxyz=[0.0, 0.0, -3.0, 0.0]))
    stranger.say({"type": "TransformControlsDragEndMessage", "name": "/gizmo", "owner": ""})
    wait_for(lambda: len(guarded.events) == 3, "the drag")
    assert sorted(guarded.events) == [("gizmo", phase) for phase in ("end", "start", "update")]
    assert tuple(guarded.gizmo.wxyz) == (0.0, 0.0, -1.0, 0.0)
    assert tuple(guarded.gizmo.position) == (1.0, 2.0, 3.0)
    assert guarded.server.scene._active_transform_drag_handles == {}


def test_a_gizmo_that_vanishes_in_the_hand_can_be_let_go(guarded: GuardedPage, stranger: RawClient) -> None:
    stranger.say({"type": "TransformControlsDragStartMessage", "name": "/gizmo", "owner": ""})
    wait_for(lambda: len(guarded.events) == 1, "the grab")
    guarded.gizmo.visible = False
    try:
        stranger.say({"type": "TransformControlsDragEndMessage", "name": "/gizmo", "owner": ""})
        wait_for(lambda: ("gizmo", "end") in guarded.events, "the release")
    finally:
        guarded.gizmo.visible = True


def the_camera(guarded: GuardedPage, stranger: RawClient) -> viser.CameraHandle:
    guarded.settle(stranger)
    return guarded.server.get_clients()[max(guarded.server.get_clients())].camera


@pytest.mark.parametrize(
    "changes",
    [
        {"position": [math.nan, 0, 0]},
        {"position": [1e300, 0, 0]},
        {"wxyz": [0, 0, 0, 0]},
        {"wxyz": [math.inf, 0, 0, 0]},
        {"fov": 0},
        {"fov": 4.0},
        {"fov": "wide"},
        {"near": -1},
        {"near": 10, "far": 1},
        {"up_direction": [0, 0, 0]},
        {"image_width": -5},
        {"image_height": 1e300},
        {"look_at": None},
        {"extra": 1},
    ],
    ids=str,
)
def test_an_impossible_camera_is_not_taken(
    guarded: GuardedPage, stranger: RawClient, changes: dict[str, Any]
) -> None:
    stranger.say(camera_message(position=[1, 2, 3]))
    camera = the_camera(guarded, stranger)
    wait_for(lambda: tuple(camera.position) == (1.0, 2.0, 3.0), "the good camera")
    stranger.say(camera_message(position=[9, 9, 9]) | changes)
    guarded.settle(stranger)
    time.sleep(5 * CAMERA_INTERVAL_S)
    assert tuple(camera.position) == (1.0, 2.0, 3.0)
    assert camera.fov == 1.2


def test_a_folded_canvas_still_has_an_aspect(guarded: GuardedPage, stranger: RawClient) -> None:
    stranger.say(camera_message(image_height=0, image_width=0, wxyz=[0, 2, 0, 0]))
    camera = the_camera(guarded, stranger)
    wait_for(lambda: tuple(camera.wxyz) == (0.0, 1.0, 0.0, 0.0), "the camera")
    assert camera.aspect == 1.0


def test_cameras_replace_each_other(guarded: GuardedPage, stranger: RawClient) -> None:
    camera = the_camera(guarded, stranger)
    seen: list[float] = []
    camera.on_update(lambda moved: seen.append(float(moved.position[0])))
    started = time.monotonic()
    for x in range(1, 501):
        stranger.say(camera_message(position=[x, 0, 0]))
    wait_for(lambda: camera.position[0] == 500.0, "the last camera")
    assert len(seen) <= (time.monotonic() - started) / CAMERA_INTERVAL_S + 2


def test_a_flood_is_thinned(guarded: GuardedPage, stranger: RawClient) -> None:
    started = time.monotonic()
    for _ in range(3000):
        stranger.say(widget_message(guarded.uuid("button"), True))
    guarded.settle(stranger)
    passed = (1.0 + time.monotonic() - started) * MESSAGES_PER_SECOND
    assert MESSAGES_PER_SECOND / 2 < len(guarded.events) <= passed


def test_the_budget_fills_with_time() -> None:
    budget = Budget(rate=10.0, tokens=10.0, filled_at=0.0)
    assert [budget.spend(0.0) for _ in range(11)] == [True] * 10 + [False]
    assert [budget.spend(0.25) for _ in range(3)] == [True, True, False]
    assert sum(budget.spend(100.0) for _ in range(20)) == 10


@pytest.mark.parametrize(
    ("said", "code"), [("text", 1003), ("", 1003), (b"", 1007), (b"\xc1", 1007), (b"\x82\xa4type", 1007)]
)
def test_what_is_no_message_ends_the_connection(guarded: GuardedPage, said: str | bytes, code: int) -> None:
    with raw_client(guarded.server.get_port()) as stranger:
        stranger.say(camera_message())
        stranger.say(said)
        with pytest.raises(ConnectionClosedError) as closed:
            stranger.hear_type("never")
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == code


def unasked_picture(size: int) -> dict[str, Any]:
    return {"type": "GetRenderResponseMessage", "payload": b"x" * size, "render_uuid": "r"}


@pytest.mark.parametrize("kind", ["text", "no message", "picture", "fragments", "just too large"])
def test_a_large_message_ends_the_connection_before_it_is_complete(
    guarded: GuardedPage, stranger: RawClient, kind: str
) -> None:
    before = guarded.state()
    whole = {
        "text": widget_message(guarded.uuid("text"), "x" * 2_000_000),
        "no message": b"\x91" * 2_000_000,
        "picture": unasked_picture(2_000_000),
        "fragments": [bytes(60_000)] * 40,
        "just too large": unasked_picture(LARGEST_MESSAGE),
    }[kind]
    assert stranger.end_after(whole) in (1009, None)
    assert guarded.state() == before


def test_an_incomplete_message_takes_no_memory(guarded: GuardedPage, stranger: RawClient) -> None:
    """The header says 30 MB; the rest would never come."""
    connection = next(reversed(guarded.server._websock_server._live_connections.values()))
    header = b"\x82\xff" + (30 * 2**20).to_bytes(8, "big") + bytes(4)
    with contextlib.suppress(OSError):
        stranger.connection.socket.sendall(header + bytes(2 * 2**20))
    wait_for(lambda: connection.protocol.state is not State.OPEN, "the end of the connection")
    assert len(connection.protocol.reader.buffer) == 0


def test_a_picture_that_was_asked_for_arrives(guarded: GuardedPage, stranger: RawClient) -> None:
    picture = np.full((100, 200, 4), 255, np.uint8)
    handle = guarded.server.get_clients()[max(guarded.server.get_clients())]
    asked = guarded.server._thread_executor.submit(
        handle.get_render, height=100, width=200, transport_format="png", timeout=60.0
    )
    uuid = stranger.hear_type("GetRenderRequestMessage")["render_uuid"]
    before = guarded.state()
    payload = imageio.v3.imwrite("<bytes>", picture, extension=".png")
    stranger.say({"type": "GetRenderResponseMessage", "payload": payload, "render_uuid": uuid})
    np.testing.assert_array_equal(asked.result(), picture)
    assert guarded.state() == before


def test_a_large_picture_arrives_once(guarded: GuardedPage, stranger: RawClient) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (300, 300, 4), np.uint8)
    payload = imageio.v3.imwrite("<bytes>", noise, extension=".png")
    assert len(payload) > 3 * LARGEST_MESSAGE
    handle = guarded.server.get_clients()[max(guarded.server.get_clients())]
    for _ in range(2):
        asked = guarded.server._thread_executor.submit(
            handle.get_render, height=300, width=300, transport_format="png", timeout=60.0
        )
        uuid = stranger.hear_type("GetRenderRequestMessage")["render_uuid"]
        stranger.say({"type": "GetRenderResponseMessage", "payload": payload, "render_uuid": uuid})
        np.testing.assert_array_equal(asked.result(), noise)
        guarded.settle(stranger)
    assert stranger.end_after(unasked_picture(len(payload))) in (1009, None)


def test_only_one_picture_comes_for_one_request(guarded: GuardedPage, stranger: RawClient) -> None:
    handle = guarded.server.get_clients()[max(guarded.server.get_clients())]
    asked = guarded.server._thread_executor.submit(
        handle.get_render, height=100, width=200, transport_format="png", timeout=60.0
    )
    stranger.hear_type("GetRenderRequestMessage")
    assert stranger.end_after(*[unasked_picture(4 * 2**20)] * 20) in (1009, None)
    assert asked.exception() is not None


def test_a_number_that_is_being_typed_is_not_clamped(guarded: GuardedPage, stranger: RawClient) -> None:
    """0.8 is typed as 0, then 0., then 0.8; the slider begins at 0.1."""
    for typed in (0, 0, 0.8):
        stranger.say(widget_message(guarded.uuid("slider"), typed))
    guarded.settle(stranger)
    time.sleep(1.5 * TYPING_REST_S)
    guarded.settle(stranger)
    assert guarded.events == [("slider", 0.8)]


def test_a_typed_position_is_taken_once(guarded: GuardedPage, stranger: RawClient) -> None:
    """The browser sends a message for each key."""
    for typed in (0, 0.2, 0.9):
        stranger.say(widget_message(guarded.uuid("vector"), [typed, 0, 0]))
        time.sleep(0.1 * TYPING_REST_S)
    assert guarded.events == []
    wait_for(lambda: guarded.events != [], "the position")
    assert guarded.events == [("vector", (0.9, 0.0, 0.0))]


def test_a_button_comes_after_what_was_typed_before_it(guarded: GuardedPage, stranger: RawClient) -> None:
    stranger.say(widget_message(guarded.uuid("vector"), [0.5, 0, 0]))
    stranger.say(widget_message(guarded.uuid("button"), True))
    wait_for(lambda: len(guarded.events) == 2, "both")
    assert [name for name, _ in guarded.events] == ["vector", "button"]


def test_a_known_command_runs(guarded: GuardedPage, stranger: RawClient) -> None:
    command = guarded.server.gui.add_command("pause", description="")
    command.on_trigger(lambda event: guarded.events.append(("command", None)))
    try:
        stranger.say({"type": "CommandTriggerMessage", "uuid": command._impl.uuid})
        wait_for(lambda: guarded.events == [("command", None)], "the command")
    finally:
        command.remove()


def test_a_late_joiner_sees_what_the_others_set(guarded: GuardedPage, stranger: RawClient) -> None:
    stranger.say(widget_message(guarded.uuid("slider"), 1e9))
    guarded.settle(stranger)
    with raw_client(guarded.server.get_port()) as late:
        late.hear_type("PointCloudMessage", name="/cloud")
        late.hear_type("GuiUpdateMessage", uuid=guarded.uuid("slider"), updates={"value": 1.0})


@given(st.binary(max_size=200))
def test_decoding_either_reads_refuses_or_says_undecodable(encoded: bytes) -> None:
    try:
        message = decode(encoded)
    except Undecodable:
        return
    assert message is None or isinstance(message, Message)


def test_a_message_of_deep_lists_is_refused_and_the_client_stays() -> None:
    deep: list[Any] = []
    for _ in range(600):
        deep = [deep]
    for message in (
        {"type": "ViewerCameraMessage", "wxyz": deep},
        {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": deep}},
        {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": {"x": deep}}},
    ):
        assert decode(msgspec.msgpack.encode(message)) is None
    plain = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": [[1.0]]}}
    assert decode(msgspec.msgpack.encode(plain)) is not None


def test_pictures_that_end_within_a_read_count_together() -> None:
    """Each read ends a picture of 4 MiB and begins the next, so no read ends between two of them."""
    read, picture = 2**18, 2**22
    connection = GuardedConnection.__new__(GuardedConnection)
    connection.gate = SimpleNamespace(client_id=lambda _: 0, awaits_picture=lambda _: True)  # type: ignore[assignment]
    connection._picture_bytes = 0
    taken = 0
    for arrived in range(read - 1000, 20 * picture, read):
        unfinished = SimpleNamespace(buffer=bytes(arrived % picture))
        connection.protocol = SimpleNamespace(reader=unfinished, current_size=None)  # type: ignore[assignment]
        assert arrived % picture > LARGEST_MESSAGE
        if not connection._is_within_size(read):
            break
        taken = arrived
    assert picture < taken <= LARGEST_PICTURE
