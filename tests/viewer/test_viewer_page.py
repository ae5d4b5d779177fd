"""The live page without a mapping process and without a browser: what updates and users' actions do."""

import itertools
import threading
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import viser
from handled_page import HandledPage
from live_program import wait_for
from numpy.typing import NDArray
from raw_viewer_client import RawClient, camera_message, raw_client, widget_message

from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.spherical import SphericalCamera
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.live.answer import SWITCHES, beside
from taichi_mrf.viewer.live.page import Page
from taichi_mrf.viewer.live.panel import COMMANDS, Clicked, Dragged
from taichi_mrf.viewer.scene.base_panel import AGREE, DECLINE, Joined, Used
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.viewer.transport import downloads
from taichi_mrf.voxels.layers import COLORS

CAMERA = PinholeCamera(8, 6, 5.0, 5.0, 3.5, 2.5)
HELLO = m.Hello("a recording", "cpu", "a device", "mrf", 0.1, -2.0, 0.1, "voxel_size: 0.1")
DONE = m.Status("", 1.0, 1, 1, 1, 0, 0.0, 512, 1, 1.0, paused=False, finished=True, pending=False)


def keyframe(id: int, x: float = 0.0, state: m.KeyframeState = "on") -> m.KeyframeInfo:
    T = np.eye(4)
    T[0, 3] = x
    picture, crossed = np.zeros((2, 2, 3), np.uint8), np.zeros((0, 3), np.int32)
    return m.KeyframeInfo(id, f"frame {id}", T, CAMERA, 1, state, picture, crossed, T)


class LivePage(HandledPage):
    """The live page with two keyframes."""

    def __init__(self) -> None:
        super().__init__(Page, HELLO, keyframe(0), keyframe(1, 1.0))

    def act(self, action: str, client: int = 0) -> None:
        self.page.actions[action](client)

    def client_id(self) -> int:
        """The number of the only client, once it counts."""
        wait_for(lambda: len(self.server.get_clients()) == 1, "the client")
        return next(iter(self.server.get_clients()))


@pytest.fixture
def handled() -> Iterator[LivePage]:
    running = LivePage()
    yield running
    running.server.stop()


@pytest.fixture
def browser(handled: LivePage) -> Iterator[RawClient]:
    with raw_client(handled.server.get_port()) as client:
        client.say(camera_message())
        yield client


def test_each_button_has_an_action(handled: LivePage) -> None:
    page = handled.page
    widgets = page.server.gui._gui_input_handle_from_uuid.values()
    names = {each.label for each in widgets if isinstance(each, viser.GuiButtonHandle)} - {""}
    names |= {
        name for each in widgets if isinstance(each, viser.GuiButtonGroupHandle) for name in each.options
    }
    assert {"Play", "Freeze", "Close", "Show the ray"} <= names
    assert names | {action for action, *_ in COMMANDS.values()} | {*SWITCHES} <= page.actions.keys()


def gizmo_x(handled: LivePage) -> float:
    gizmo = handled.page.keyframes.gizmo
    assert gizmo is not None
    return float(gizmo.position[0])


def test_the_gizmo_goes_where_its_keyframe_is_put(handled: LivePage) -> None:
    handled.act("Move")
    assert gizmo_x(handled) == 0.0
    handled.take(keyframe(0, 3.0))
    assert gizmo_x(handled) == 3.0
    handled.take(keyframe(1, 5.0))
    assert gizmo_x(handled) == 3.0


def test_the_gizmo_does_not_jump_out_of_a_users_hand(handled: LivePage) -> None:
    handled.act("Move")
    handled.take(Dragged(True), keyframe(0, 3.0))
    assert gizmo_x(handled) == 0.0
    handled.take(Dragged(False), keyframe(0, 4.0))
    assert gizmo_x(handled) == 4.0
    assert [type(request) for request in handled.asked] == [m.Move]


def test_a_frozen_keyframe_cannot_be_changed(handled: LivePage) -> None:
    page = handled.page
    handled.act("Move")
    handled.take(keyframe(0, state="frozen"))
    assert page.keyframes.gizmo is None
    widgets = (page.panel.position, page.panel.pixel)
    assert [widget.disabled for widget in widgets] == [True, True]
    edits = (
        "On/off", "Freeze", "Move", "Put back", "Position (m)",
        "Show the ray",
    )  # fmt: skip
    for action in edits:  # a press may have been on its way
        handled.act(action)
    assert handled.asked == []
    handled.take(keyframe(0, state="on"))
    assert [widget.disabled for widget in widgets] == [False, False]
    handled.act("On/off")
    assert handled.asked == [m.Switch(0, on=None)]


def test_what_a_press_does_is_left_to_the_process_that_has_the_map(handled: LivePage) -> None:
    """The page may not know yet what earlier presses have done, its own or another client's."""
    for action in ("On/off", "Undo", "On/off", "Undo", "Redo"):
        handled.act(action)
    off = m.Switch(0, on=None)
    assert handled.asked == [off, m.Undo(), off, m.Undo(), m.Undo(again=True)]
    handled.take(keyframe(2, 2.0), keyframe(3, state="off"), keyframe(5))
    handled.page.panel.range.value = (1.0, 4.0)
    handled.act("All off")
    assert handled.asked[5:] == [m.Switch(1, on=False, last=3)]


def test_undo_and_redo_are_offered_where_they_do_something(handled: LivePage) -> None:
    status = m.Status("", 1.0, 1, 1, 1, 0, 0.0, 512, 1, 1.0, paused=False, finished=True, pending=False)
    history = handled.page.panel._history
    assert not history.visible
    handled.take(replace(status, can_undo=True))
    assert (history.visible, list(history.options)) == (True, ["Undo"])
    handled.take(replace(status, can_redo=True))
    assert (history.visible, list(history.options)) == (True, ["Redo"])
    handled.take(status)
    assert not history.visible


def test_at_first_all_keyframes_are_switched_and_a_chosen_range_stays(handled: LivePage) -> None:
    handled.take(keyframe(2, 2.0))
    handled.act("All off")
    assert handled.asked == [m.Switch(0, on=False, last=2)]
    handled.page.panel.range.value = (1.0, 2.0)
    handled.take(keyframe(3, 3.0))
    handled.act("All off")
    assert handled.asked[1:] == [m.Switch(1, on=False, last=2)]


def test_what_the_mapping_process_gives_up_is_not_ticked_any_more(handled: LivePage) -> None:
    handled.page.panel.view_options.handles["baseline"].value = True
    handled.page._take_options()
    handled.take(m.Notice("baseline: out of memory", "error"))
    assert handled.page.options.baseline
    handled.take(m.Notice("baseline: out of memory", "error", gives_up="baseline"))
    assert not handled.page.options.baseline
    assert not handled.page.panel.view_options.handles["baseline"].value
    assert [each.baseline for each in handled.asked if isinstance(each, m.Watch)] == [True, False]


def test_the_chosen_keyframe_has_a_thumbnail(handled: LivePage) -> None:
    picture = np.full((2, 2, 3), 77, np.uint8)
    handled.take(replace(keyframe(1), picture=picture))
    assert handled.page.panel._thumbnail.visible
    handled.page._choose(1)
    np.testing.assert_array_equal(handled.page.panel._thumbnail.image, picture)


def test_a_method_that_cannot_freeze_has_no_button_for_it(handled: LivePage) -> None:
    assert "Freeze" in handled.page.panel._edits.options
    handled.take(replace(HELLO, can_freeze=False))
    assert list(handled.page.panel._edits.options) == ["On/off", "Move", "Put back"]


def test_controls_of_a_replay_are_there_while_frames_are_to_come(handled: LivePage) -> None:
    panel, status = handled.page.panel, replace(DONE, finished=False)
    for done in (False, True, False):
        for paused in (True, False):
            handled.take(replace(status, finished=done, paused=paused))
            first = "Play" if paused else "Pause"
            assert list(panel._run.options) == (["Reset"] if done else [first, "Step", "Reset"])
    handled.take(replace(HELLO, has_frames=False), DONE)
    assert list(panel._run.options) == ["Reset"]
    assert (list(panel.view.options), panel.view.value) == (["chosen keyframe"], "chosen keyframe")
    assert not panel.view_options.handles["follow"].visible


def test_a_speed_is_offered_for_frames_that_have_a_pace(handled: LivePage) -> None:
    speed, status = handled.page.panel.speed, DONE  # of the next replay, too
    for factor, name in ((None, None), (2.0, "2x"), (3.0, "3x")):
        handled.take(replace(status, speed=factor))
        assert (speed.value if speed.visible else None) == name


def test_an_empty_map_says_what_it_waits_for(handled: LivePage) -> None:
    handled.take(HELLO)  # without the keyframes

    def waiting() -> Any:
        return handled.server.scene.get_handle_by_name("/waiting")

    for finished, said in ((False, "waits; it is empty until the first"), (True, "waits; no frame became")):
        handled.take(replace(DONE, activity="waits", voxels=0, finished=finished))
        assert said in handled.page.panel._activity.content
        assert waiting() is not None
    handled.take(keyframe(0), replace(DONE, activity="waits"))
    assert ">waits<" in handled.page.panel._activity.content
    assert waiting() is None


def test_the_sizes_of_files_are_said_before_they_are_written(handled: LivePage) -> None:
    panel = handled.page.panel
    handled.take(replace(keyframe(0), rays=20_000_000), replace(DONE, voxels=1_000_000))
    panel.show_counts({"map": 9, "voxels": 50_000}, None, False)
    assert panel._size.content == "About: Map 13 MB, Voxels 1.3 MB."
    handled.take(replace(DONE, voxels=1_000_000, layers=(COLORS,)))
    panel.show_counts({"map": 0, "voxels": 50_000, "triangles": 100_000}, None, False)
    assert panel._size.content == "About: Map 21 MB, Voxels 1.3 MB, Mesh 2.9 MB."


def test_the_button_of_a_recording_says_what_it_does_next(handled: LivePage) -> None:
    button = handled.page.panel._save["Recording (.viser)"]
    for press in ("Stop and save: Recording (.viser)", "Recording (.viser)"):
        handled.act("Recording (.viser)")
        assert button.label == press


def test_the_page_says_how_sure_free_space_is(handled: LivePage) -> None:
    status, numbers = DONE, handled.page.panel._numbers
    handled.take(status)
    assert "not calibrated" in numbers.content
    handled.take(replace(status, free_space="promised at 99%: 98.9 to 99.3% held"))
    assert "promised at 99%: 98.9 to 99.3% held" in numbers.content


def test_a_method_that_counts_no_keyframes_is_not_coloured_by_them(handled: LivePage) -> None:
    offered = handled.page.panel.view_options.handles["color_by"]
    assert "keyframes that see it" in offered.options
    assert "photo" not in offered.options
    handled.take(replace(HELLO, counts_keyframes=False), replace(DONE, layers=(COLORS,)))
    assert "keyframes that see it" not in offered.options
    assert "photo" in offered.options


def test_measured_points_lie_where_their_keyframe_is(handled: LivePage) -> None:
    page = handled.page
    page.panel.view_options.handles["points"].value = True
    page._take_options()
    assert handled.asked == [m.Watch(False, None, False, points=0)]
    points, colors = np.array([[0, 0, 1], [0, 0, 2]], np.float32), np.zeros((2, 3), np.uint8)
    handled.take(m.MeasuredPoints(1, points, colors))
    assert handled.server.scene.get_handle_by_name("/measured") is None  # another one has been chosen
    handled.take(m.MeasuredPoints(0, points, colors))
    page._flush()
    node = handled.server.scene.get_handle_by_name("/measured")
    assert isinstance(node, viser.PointCloudHandle)
    assert node.visible
    assert page.panel._shown.content.startswith("0 voxels shown, 2 measured points")
    handled.take(keyframe(0, 3.0))
    np.testing.assert_array_equal(node.position, [3.0, 0.0, 0.0])
    page._choose(1)
    assert handled.asked[-1] == m.Watch(False, None, False, points=1)
    page.panel.view_options.handles["points"].value = False
    page._take_options()
    page._flush()
    assert not node.visible


def test_voxels_of_an_earlier_map_are_pale_until_todays_keyframes_change_them(
    handled: LivePage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("taichi_mrf.viewer.scene.map_scene.UPDATES_PER_SECOND", 1e9)
    bricks, nothing = np.array([[0, 0, 0], [0, 0, 1]], np.int32), np.zeros((0, 3), np.int32)

    def put(these: NDArray[np.int32], log_odds: int) -> None:
        values = np.full((len(these), 512), log_odds, np.int16), np.zeros((len(these), 512), np.uint8)
        handled.take(m.Bricks("map", these, *values, nothing))

    def colors() -> NDArray[np.uint8]:
        """Of the voxels of both bricks, by brick: the colours that were sent last."""
        handled.page._flush()
        sent = handled.page.map.layers["map"]._sent[0, 0, 0]
        upper = sent.cells[:, 2] >= 8
        return np.stack([sent.colors[~upper], sent.colors[upper]]).astype(int)

    handled.take(replace(HELLO, located="3 cm, 0.8 degrees, 91% of what is seen agrees"))
    put(bricks, 100)
    handled.take(replace(keyframe(0), earlier=True))
    usual = colors()
    handled.take(keyframe(1))
    assert (colors() == usual // 2 + 128).all()  # nothing of today is in the map yet
    put(bricks[1:], 101)
    first, second = colors()
    assert (first == usual[0] // 2 + 128).all()
    assert (second == usual[1]).all()
    put(bricks[1:], 100)  # today's keyframe is taken back
    assert (colors() == usual // 2 + 128).all()


def test_voxels_of_a_map_of_its_own_are_never_pale(handled: LivePage) -> None:
    bricks, nothing = np.array([[0, 0, 0]], np.int32), np.zeros((0, 3), np.int32)
    handled.take(HELLO)
    values = np.full((1, 512), 100, np.int16), np.ones((1, 512), np.uint8)
    handled.take(m.Bricks("map", bricks, *values, nothing))
    handled.take(keyframe(0))
    handled.page._flush()
    assert not handled.page.map.store.shown((0, 0, 0), 0.0, None).is_earlier.any()


def test_free_space_is_seen_in_a_cut_that_goes_with_it_unless_it_was_chosen(handled: LivePage) -> None:
    page, handles = handled.page, handled.page.panel.view_options.handles

    def use(**values: object) -> tuple[bool, str]:
        """Free space and the axis of the cut after a use of these widgets."""
        for name, value in values.items():
            handles[name].value = value
        page._take_options()
        assert page.options == page.panel.view_options.value()
        return page.options.free_space, page.options.cut_axis

    assert use(free_space=True) == (True, "y")
    assert use(free_space=False) == (False, "none")
    assert use(cut_axis="x") == (False, "x")
    assert use(free_space=True) == (True, "x")
    assert use(free_space=False) == (False, "x")
    use(free_space=True)
    assert use(cut_axis="none") == (False, "none")


def test_a_level_cut_keeps_the_lower_half_where_y_points_down(handled: LivePage) -> None:
    take_both_maps(handled)
    page, handles = handled.page, handled.page.panel.view_options.handles
    page._flush()
    handles["free_space"].value = True
    page._take_options()
    slider, size = handles["cut_at_m"], HELLO.voxel_size
    assert (page.options.cut_axis, slider.min, slider.max) == ("y", pytest.approx(-8 * size), 0.0)
    assert page.options.cut_at_m == pytest.approx(-4 * size)
    page._flush()
    y = page.map.layers["map"].points()[:, 1] / size
    np.testing.assert_array_equal(np.unique(np.round(y - 0.5)), np.arange(4, 8))


def test_reset_asks_before_it_deletes_a_map(handled: LivePage, browser: RawClient) -> None:
    client = handled.client_id()
    handled.act("Reset", client)
    question = browser.hear_type("GuiModalMessage")["uuid"]
    browser.hear_type("GuiButtonMessage", container_uuid=question)
    handled.act("Reset", client)
    browser.hear_type("GuiCloseModalMessage", uuid=question)
    question = browser.hear_type("GuiModalMessage")["uuid"]
    assert handled.asked == []
    handled.act(DECLINE, client)
    browser.hear_type("GuiCloseModalMessage", uuid=question)
    assert handled.asked == []
    handled.act("Reset", client)
    handled.act(AGREE, client)
    assert handled.asked == [m.Reset()]


def test_freeze_asks_before_it_acts(handled: LivePage, browser: RawClient) -> None:
    client = handled.client_id()
    handled.act("Freeze", client)
    question = browser.hear_type("GuiModalMessage")["uuid"]
    handled.act(DECLINE, client)
    browser.hear_type("GuiCloseModalMessage", uuid=question)
    handled.act(AGREE, client + 1)  # of one that was not asked
    assert handled.asked == []
    handled.act("Freeze", client)
    handled.take(keyframe(1))
    handled.page._choose(1)  # another browser chooses another one meanwhile
    handled.act(AGREE, client)
    assert handled.asked == [m.Freeze(0)]


def test_an_empty_map_is_reset_at_once(handled: LivePage, browser: RawClient) -> None:
    handled.take(HELLO)
    handled.act("Reset", handled.client_id())
    assert handled.asked == [m.Reset()]


SEVERAL = replace(HELLO, recordings=("a", "b/map.npz"), recording=1)


def test_recordings_are_offered_if_there_are_several(handled: LivePage) -> None:
    recording = handled.page.panel.recording
    assert not recording.visible
    handled.take(SEVERAL)
    assert (recording.visible, recording.options, recording.value) == (True, ("a", "b/map.npz"), "b/map.npz")


def test_another_recording_is_mapped_after_a_question_if_something_is_unsaved(
    handled: LivePage, browser: RawClient
) -> None:
    client, recording = handled.client_id(), handled.page.panel.recording
    handled.take(SEVERAL)

    def choose() -> None:
        recording.value = "a"
        handled.act("Recording", client)
        assert recording.value == "b/map.npz", "it is mapped still"

    handled.act("Recording", client)
    assert handled.asked == [], "it is mapped already"
    choose()
    assert handled.asked == [m.Reset(0)]
    handled.take(keyframe(2))
    choose()
    question = browser.hear_type("GuiModalMessage")["uuid"]
    handled.act(DECLINE, client)
    browser.hear_type("GuiCloseModalMessage", uuid=question)
    assert handled.asked == [m.Reset(0)]
    choose()
    handled.act(AGREE, client)
    assert handled.asked == [m.Reset(0), m.Reset(0)]
    handled.take(replace(SEVERAL, recording=0))
    assert recording.value == "a"


def test_no_client_can_name_a_recording_that_is_not_offered(handled: LivePage, browser: RawClient) -> None:
    recording, inbox = handled.page.panel.recording, handled.page.inbox
    handled.client_id()
    browser.say(widget_message(recording._impl.uuid, ""))  # it is hidden
    handled.take(SEVERAL)
    for value in ("", "/etc", "../a", "a/../../..", "A", "b", 0, -1, 7, None, ["a"], {"a": 0}, True):
        browser.say(widget_message(recording._impl.uuid, value))
    browser.say({"type": "GuiUpdateMessage", "uuid": recording._impl.uuid, "updates": {"options": ["/etc"]}})
    browser.say(widget_message(recording._impl.uuid, "a"))
    wait_for(lambda: recording.value == "a", "the one that is offered")
    handled.server._thread_executor.submit(lambda: None).result()
    wait_for(lambda: inbox.qsize() > 0, "its event")
    used = [item for item in inbox.wait(0.0) if isinstance(item, Used)]
    assert [each.action for each in used] == ["Recording"]
    assert recording.options == ("a", "b/map.npz")


def places(width: int, height: int, x: float, y: float) -> tuple[float, float]:
    camera: Any = SimpleNamespace(image_width=width, image_height=height)
    return beside(camera, (x / width, y / height))


@pytest.mark.parametrize("width", [1280, 1920])
def test_the_answer_covers_neither_the_click_nor_the_middle_nor_the_panel(width: int) -> None:
    free = 0.73 * width
    for x in np.arange(10.0, free, 25.0):
        left, top = places(width, 720, x, 360.0)
        right = left + 290
        assert left >= 0
        assert right <= free
        assert not left < x < right
        assert not left < free / 2 < right
        assert 0 <= top <= 290


def test_what_is_selected_is_told_to_the_map_until_the_answer_is_closed(handled: LivePage) -> None:
    log_odds = np.full((1, 512), -900, np.int16)
    log_odds[0, 0] = 900  # the voxel at the origin
    none = np.zeros((0, 3), np.int32)
    handled.take(m.Bricks("map", np.zeros((1, 3), np.int32), log_odds, np.ones((1, 512), np.uint8), none))
    handled.page.options = replace(handled.page.options, draw_as="voxels", keyframes=False)
    handled.page.map.look_changed()
    handled.page._flush()
    handled.take(Clicked((0.05, 0.05, -3.0), (0.0, 0.0, 1.0), (0.0, 0.0)))
    selected = [each.points_m for each in handled.asked if isinstance(each, m.Select)]
    np.testing.assert_allclose(selected, [[[0.05, 0.05, 0.05]]])
    assert "as of" not in handled.page.answer._text.content
    handled.take(m.TimeSpan(0.0, 0.0, 9.0, 2.5))
    handled.page._show_votes(m.Votes(handled.page.answer.point, ((0, 2.0),)))
    assert "2.5 s; what keyframes say is of now" in handled.page.answer._text.content
    assert "one keyframe sees this; it says:" in handled.page.answer._text.content
    assert handled.page.answer._switches[0].label == "frame 0: occupied, 88% · switch off"
    handled.page.panel.show_images(m.Images("frame 0", *[np.zeros((2, 2, 3), np.uint8)] * 3, "97% right"))
    assert "of the map as it is now" in handled.page.panel._score.content
    handled.act("Close")
    assert len(handled.asked[-1].points_m) == 0


def answer(keyframe: int | None, pixel: tuple[int, int] | None) -> m.RayAnswer:
    some = np.ones(1, np.float32)
    return m.RayAnswer(
        "a ray", (0, 0, 0), (1, 0, 0), some, some, some, some, some, 1.0, 0.0, 0.01, keyframe, pixel
    )


def test_a_ray_fills_in_its_pixel(handled: LivePage) -> None:
    handled.take(answer(0, (3, 4)))
    assert handled.page.panel.pixel.value == (3.0, 4.0)
    handled.act("Show the ray")
    assert handled.asked == [m.PixelRay(0, 3.0, 4.0)]
    handled.take(answer(None, None), answer(77, (1, 1)))
    assert handled.page.panel.pixel.value == (3.0, 4.0)


def test_closing_the_answer_takes_its_ray_out_of_the_scene(handled: LivePage) -> None:
    handled.take(answer(None, None))
    assert "/ray" in handled.server.scene._handle_from_node_name
    handled.act("Close")
    assert "/ray" not in handled.server.scene._handle_from_node_name
    assert handled.page.panel.ray._plot.visible


def test_a_ray_of_another_keyframe_leaves_the_choice_as_it_is(handled: LivePage) -> None:
    handled.act("Move")
    handled.take(answer(1, (3, 4)))
    assert handled.page.keyframes.chosen == 0
    assert handled.page.keyframes.gizmo is not None
    assert handled.page.panel.pixel.value == (0.0, 0.0)


def follow(handled: LivePage, on: bool = True) -> None:
    handled.page.panel.view_options.handles["follow"].value = on
    before, handled.page.options = handled.page.options, handled.page.panel.view_options.value()
    handled.page.options_changed(before)


def test_a_browser_that_connects_while_the_view_follows_follows_too(
    handled: LivePage, browser: RawClient
) -> None:
    handled.take(m.CurrentCamera("frame 1", keyframe(1, 1.0).T_world_camera, CAMERA))
    follow(handled)
    client = handled.client_id()
    handled.take(Joined(client))
    target = browser.hear_type("SetCameraLookAtMessage")["look_at"]
    np.testing.assert_allclose(target, [1.0, 0.0, 2.0])
    handled.page.viewpoint.map_grew(np.zeros(3), np.full(3, 9.0))
    np.testing.assert_allclose(handled.server.get_clients()[client].camera.look_at, [1.0, 0.0, 2.0])


def camera_of_a_user(handled: LivePage, browser: RawClient) -> viser.CameraHandle:
    """The camera of a browser whose user has moved the view to (7, 7, 7)."""
    client = handled.client_id()
    handled.take(Joined(client))
    handled.page.viewpoint.map_grew(np.zeros(3), np.ones(3))
    browser.say(camera_message(position=[7, 7, 7]))
    camera = handled.server.get_clients()[client].camera
    wait_for(lambda: camera.position[0] == 7.0, "the user's viewpoint")
    return camera


def test_a_browser_that_tells_late_where_it_was_sent_has_not_been_moved_by_its_user(
    handled: LivePage, browser: RawClient
) -> None:
    client = handled.client_id()
    handled.take(Joined(client))
    camera, viewpoint = handled.server.get_clients()[client].camera, handled.page.viewpoint
    viewpoint.map_grew(np.zeros(3), np.ones(3))
    first = camera.position.copy()
    viewpoint.map_grew(np.zeros(3), np.full(3, 3.0))
    browser.say(camera_message(position=first.tolist()))  # it has not heard of the second place yet
    wait_for(lambda: np.allclose(camera.position, first), "the first place")
    viewpoint.map_grew(np.zeros(3), np.full(3, 9.0))
    assert np.linalg.norm(camera.position) > 2.0 * np.linalg.norm(first)


def take_both_maps(handled: LivePage) -> None:
    """Give the map and the baseline's one occupied brick each."""
    for layer in ("map", "baseline"):
        one = (np.zeros((1, 3), np.int32), np.full((1, 512), 900, np.int16), np.ones((1, 512), np.uint8))
        handled.take(m.Bricks(layer, *one, np.zeros((0, 3), np.int32)))


def test_the_baseline_does_not_discard_the_viewpoint(handled: LivePage, browser: RawClient) -> None:
    camera = camera_of_a_user(handled, browser)
    handled.page.options = replace(ViewOptions(), baseline=True)
    take_both_maps(handled)
    handled.page._flush()
    assert handled.page._with_baseline
    np.testing.assert_array_equal(camera.position, [7.0, 7.0, 7.0])


@pytest.mark.parametrize("place", [0, 1])
def test_the_map_of_another_recording_is_looked_at_anew(
    handled: LivePage, browser: RawClient, place: int
) -> None:
    camera = camera_of_a_user(handled, browser)
    handled.take(replace(HELLO, source="/data/desk", recordings=("a recording", "desk"), recording=place))
    browser.hear_type("SetGuiPanelLabelMessage", label="taichi_mrf: desk")
    handled.page.viewpoint.look_at_everything()
    handled.page.viewpoint.map_grew(np.full(3, 40.0), np.full(3, 41.0))
    kept = np.array_equal(camera.position, [7.0, 7.0, 7.0])
    assert kept == (place == HELLO.recording)


@pytest.mark.parametrize("flipped", [False, True])
def test_a_cut_parts_the_map_from_the_baseline(handled: LivePage, flipped: bool) -> None:
    take_both_maps(handled)
    at_m = -3.5 * HELLO.voxel_size  # its height: y points down
    cut = ViewOptions(baseline=True, cut_axis="y", cut_at_m=at_m, flip_cut=flipped)
    for options, many in ((ViewOptions(baseline=True), (8, 8)), (cut, (4, 4) if flipped else (5, 3))):
        handled.page.options = options
        handled.page.map.look_changed()
        handled.page._flush()
        layers = [handled.page.map.layers[name] for name in ("map", "baseline")]
        rows = [np.unique(np.round(layer.points()[:, 1] / HELLO.voxel_size - 0.5)) for layer in layers]
        assert tuple(map(len, rows)) == many
    # Without a cut the baseline lies aside, with one in its own place: no voxel of both, and none of neither.
    np.testing.assert_array_equal(np.sort(np.concatenate(rows)), np.arange(8))
    assert not layers[1].origin_m.any()


def test_a_browser_that_sends_no_picture_keeps_nobody_waiting(
    handled: LivePage, browser: RawClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the other browsers, nor its own other downloads; and it is asked once."""
    monkeypatch.setattr(downloads, "PICTURE_TIMEOUT_S", 3600.0)
    silent = handled.client_id()
    for _ in range(6):
        handled.act("Picture (.png)", silent)
    browser.hear_type("GetRenderRequestMessage")
    with raw_client(handled.server.get_port()) as other:
        other.say(camera_message(image_width=40, image_height=30))
        wait_for(lambda: len(handled.server.get_clients()) == 2, "the other client")
        handled.act("Picture (.png)", max(handled.server.get_clients()))
        request = other.hear_type("GetRenderRequestMessage")
        picture = {"type": "GetRenderResponseMessage", "payload": png(30, 40)}
        other.say({**picture, "render_uuid": request["render_uuid"]})
        assert other.hear_type("FileTransferStartDownload")["filename"] == "view.png"
    handled.act("Page (.html)", silent)
    assert browser.hear(in_turn("FileTransferStartDownload", "GetRenderRequestMessage"))["type"].startswith(
        "File"
    )
    assert [notice for notice in drained(handled) if isinstance(notice, m.Notice)] == []


def png(height: int, width: int) -> bytes:
    return cv2.imencode(".png", np.zeros((height, width, 4), np.uint8))[1].tobytes()


def in_turn(*kinds: str) -> Any:
    """Matches the first message of any of these kinds."""
    return lambda message: message["type"] in kinds


def drained(handled: LivePage) -> list[Any]:
    return handled.page.inbox.wait(0.0)


def test_so_many_pictures_are_awaited_and_no_more(
    handled: LivePage, browser: RawClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(downloads, "PICTURE_TIMEOUT_S", 3600.0)
    monkeypatch.setattr(downloads, "PICTURES_AT_ONCE", 1)
    handled.act("Picture (.png)", handled.client_id())
    handled.act("Picture (.png)", 1234)
    notices = [item for item in drained(handled) if isinstance(item, m.Notice)]
    assert ["try again" in notice.text for notice in notices] == [True]


def test_a_page_is_made_once_however_often_it_is_asked_for(
    handled: LivePage, browser: RawClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, held, made = handled.client_id(), threading.Event(), []

    class Scene:
        def as_html(self) -> str:
            made.append(1)
            held.wait()
            return '<head><script>e.type="module"</script></head>'

    monkeypatch.setattr(handled.server, "get_scene_serializer", Scene)
    for _ in range(20):
        handled.act("Page (.html)", client)
    held.set()
    assert browser.hear_type("FileTransferStartDownload")["filename"] == "map.html"
    wait_for(lambda: not handled.page.downloads._begun, "the end of the work")
    assert len(made) == 1
    handled.act("Page (.html)", client)
    browser.hear_type("FileTransferStartDownload")


def nodes(handled: LivePage) -> set[str]:
    return {name for name in handled.server.scene._handle_from_node_name if name.startswith("/keyframes/")}


def test_a_lidars_keyframe_is_drawn_as_rings_with_its_picture(handled: LivePage) -> None:
    lidar = SphericalCamera(np.linspace(0.5, -0.5, 6), np.linspace(3.0, -3.0, 20))
    ring = replace(keyframe(1, 1.0), camera=lidar, picture=np.full((6, 20, 3), 90, np.uint8))
    handled.take(ring)
    assert nodes(handled) == {"/keyframes/0", "/keyframes/1", "/keyframes/1/picture"}
    handled.take(replace(ring, state="off"))
    assert nodes(handled) == {"/keyframes/0", "/keyframes/1"}
    handled.take(ring)
    handled.page.keyframes.show(True, False, True)
    assert nodes(handled) == {"/keyframes/0", "/keyframes/1"}
    handled.page.keyframes.show(True, True, True)
    handled.take(m.CurrentCamera("a scan", np.eye(4), lidar))
    handled.page.keyframes.clear()
    assert nodes(handled) == set()


def test_the_view_is_fitted_again_when_more_of_the_same_box_is_seen(handled: LivePage) -> None:
    viewpoint, start = handled.page.viewpoint, handled.server.initial_camera
    corners = np.array(list(itertools.product((0.0, 9.0), repeat=3)))
    few = np.concatenate([np.full((1000, 3), 4.5), corners])  # nearly all of them in the middle
    viewpoint.map_grew(np.zeros(3), np.full(3, 9.0), lambda: few, 1000)
    near = np.linalg.norm(start.position - 4.5)
    viewpoint.map_grew(np.zeros(3), np.full(3, 9.0), lambda: corners, 1240)
    assert np.linalg.norm(start.position - 4.5) == near
    viewpoint.map_grew(np.zeros(3), np.full(3, 9.0), lambda: corners, 1250)
    assert np.linalg.norm(start.position - 4.5) > 1.5 * near


def test_a_browser_begins_behind_the_camera_that_is_followed(handled: LivePage) -> None:
    viewpoint, start = handled.page.viewpoint, handled.server.initial_camera
    viewpoint.map_grew(np.zeros(3), np.ones(3))
    whole = start.position, start.look_at

    viewpoint.set_following(True)
    for x in (2.0, 3.0):
        T = np.eye(4)
        T[0, 3] = x
        handled.take(m.CurrentCamera("a frame", T, CAMERA))
        assert start.position[0] == start.look_at[0] == x
        assert start.position[2] < 0 < start.look_at[2]  # z is forwards
    viewpoint.map_grew(np.zeros(3), np.full(3, 9.0))
    assert start.position[0] == 3.0

    viewpoint.set_following(False)
    assert not np.allclose(start.position, whole[0])
    viewpoint.look_at_everything()
    viewpoint.map_grew(np.zeros(3), np.ones(3))
    np.testing.assert_array_equal((start.position, start.look_at), whole)
