"""The tuning page without a tuning process and without a browser: what updates and users' actions do."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from handled_page import HandledPage
from live_program import wait_for
from raw_viewer_client import camera_message, raw_client

from taichi_mrf.config.schema import Config
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.viewer.messages import KeyframeInfo
from taichi_mrf.viewer.scene.base_panel import AGREE, DECLINE, Used
from taichi_mrf.viewer.tune import messages as t
from taichi_mrf.viewer.tune.messages import Scores
from taichi_mrf.viewer.tune.page import TunePage
from taichi_mrf.viewer.tune.panel import KnobMoved

FIRST = Config(voxel_size=0.1)
OTHER = replace(FIRST, voxel_size=0.15)
SCORES = Scores(0.5, 0.5, 0.5, 0.1, 0.1, 0.1, 1.0, 0.1, float("nan"), 1.0, 10, 2)
TUNING = t.Tuning("a recording", "cpu", "", FIRST, t.FrameChoice(), 9, ("a", "b"), ("c", "d"), ())


class HandledTunePage(HandledPage):
    """The tuning page with its first try."""

    def __init__(self) -> None:
        super().__init__(TunePage, TUNING, t.Tried(0, FIRST, SCORES, "start"))

    def take(self, *items: Any) -> None:
        """Handle items that came together."""
        super().take(*items)
        self.page.batch_done()

    def slider(self, name: str) -> Any:
        return self.page.panel.knobs._handles[name]

    def move(self, name: str, value: float) -> KnobMoved:
        self.slider(name).value = value
        return KnobMoved(name)


@pytest.fixture
def handled() -> Iterator[HandledTunePage]:
    running = HandledTunePage()
    yield running
    running.server.stop()


def test_sliders_that_moved_together_make_one_try(handled: HandledTunePage) -> None:
    moves = [handled.move("voxel_size", 0.15), handled.move("inference.surface_density", 5.0)]
    handled.take(*moves, moves[0])
    wanted = replace(OTHER, inference=replace(FIRST.inference, surface_density=5.0))
    assert handled.asked == [t.Try(wanted)]
    handled.take(moves[0])
    assert handled.asked == [t.Try(wanted)]


def test_the_sliders_follow_the_shown_try_unless_another_is_coming(handled: HandledTunePage) -> None:
    handled.take(t.Chosen(1, OTHER))
    assert handled.slider("voxel_size").value == 0.15
    handled.take(handled.move("voxel_size", 0.05))
    handled.take(t.Chosen(2, replace(FIRST, voxel_size=0.2)))
    assert handled.slider("voxel_size").value == 0.05
    handled.take(t.Activity("waiting", 1.0, busy=False), t.Chosen(3, OTHER))
    assert handled.slider("voxel_size").value == 0.15


def test_buttons_act_on_the_selected_try(handled: HandledTunePage) -> None:
    handled.take(t.Tried(1, OTHER, SCORES, "hand"))
    assert handled.page.panel.chosen_try() == 1
    actions = ("Pin", "Save YAML", "Save CSV", "Restore")
    handled.take(*[Used(action, 7) for action in actions])
    saves = [t.SaveTries("yaml", 1, 7), t.SaveTries("csv", 1, 7)]
    assert handled.asked == [t.Pin(1), *saves, t.Try(OTHER)]
    assert handled.slider("voxel_size").value == 0.15


def test_without_a_try_there_is_a_notice(handled: HandledTunePage) -> None:
    handled.take(TUNING)  # another working set
    handled.take(Used("Restore", 0))
    assert handled.asked == []
    assert [notice.text for notice in handled.page.panel._notices] == ["There is no try yet."]


def test_held_out_views_and_frames_are_asked_for(handled: HandledTunePage) -> None:
    handled.page.panel.view.value = "d"
    handled.page.panel.frames.handles["count"].value = 20
    handled.take(Used("Held-out view", 0), Used("Use these frames", 0), Used("Stop the search", 0))
    assert handled.asked == [t.LookAt(1), t.ChooseFrames(t.FrameChoice(count=20)), t.StopSearch()]


def test_home_is_inside_where_the_page_opens(handled: HandledTunePage) -> None:
    T, no_bricks = np.eye(4), np.zeros((0, 3), np.int32)
    camera, picture = PinholeCamera(8, 6, 5.0, 5.0, 3.5, 2.5), np.zeros((2, 2, 3), np.uint8)
    handled.take(KeyframeInfo(0, "a", T, camera, 1, "on", picture, no_bricks, T))
    handled.page.viewpoint.map_grew(np.full(3, -4.0), np.full(3, 4.0))
    opening = handled.server.initial_camera.position
    assert np.linalg.norm(opening) < 2
    with raw_client(handled.server.get_port()) as browser:
        browser.say(camera_message(position=[9, 9, 9]))
        wait_for(lambda: len(handled.server.get_clients()) == 1, "the client")
        client = next(iter(handled.server.get_clients()))
        handled.take(Used("Home", client))
        eye = handled.server.get_clients()[client].camera.position
    np.testing.assert_allclose(eye, opening, atol=1e-6)


def test_the_panel_names_the_recording_before_the_first_map(handled: HandledTunePage) -> None:
    with raw_client(handled.server.get_port()) as browser:
        browser.say(camera_message())
        browser.hear_type("SetGuiPanelLabelMessage", label="taichi_mrf: a recording")


@pytest.mark.parametrize("action", ["Start a search", "Use these frames"])
def test_tries_are_not_discarded_unasked(handled: HandledTunePage, action: str) -> None:
    handled.take(t.Tried(1, OTHER, SCORES, "hand"))
    with raw_client(handled.server.get_port()) as browser:
        browser.say(camera_message())
        wait_for(lambda: len(handled.server.get_clients()) == 1, "the client")
        client = next(iter(handled.server.get_clients()))
        for answer, asked in ((DECLINE, 0), (AGREE, 1)):
            handled.take(Used(action, client))
            assert handled.asked == []
            handled.take(Used(answer, client))
            assert len(handled.asked) == asked


def test_other_frames_of_the_recording_keep_the_view(handled: HandledTunePage) -> None:
    T, no_bricks = np.eye(4), np.zeros((0, 3), np.int32)
    camera, picture = PinholeCamera(8, 6, 5.0, 5.0, 3.5, 2.5), np.zeros((2, 2, 3), np.uint8)
    first = KeyframeInfo(0, "a", T, camera, 1, "on", picture, no_bricks, T)
    handled.take(first)
    start = handled.server.initial_camera
    opening = np.array(start.position)
    T = np.eye(4)
    T[0, 3] = 5.0
    handled.take(replace(TUNING, held_out=("e",)), replace(first, T_world_camera=T))
    np.testing.assert_array_equal(start.position, opening)
    handled.take(replace(TUNING, source="another"), replace(first, T_world_camera=T))
    np.testing.assert_allclose(start.position - opening, [5.0, 0.0, 0.0])


def test_differences_have_units_and_the_table_the_names_of_scores(handled: HandledTunePage) -> None:
    worse = replace(SCORES, accuracy_sigma=0.4, median_abs_m=0.12)
    handled.take(t.Pinned(0), t.Tried(1, FIRST, worse, "hand"))
    board, table = handled.page.panel._scores.content, handled.page.panel._table.content
    assert "worse ▼ -10.0 %" in board
    assert "worse ▲ +20.0 mm" in board
    for name in ("right, 1.5 voxels", "median depth error", "fit, log-likelihood"):
        assert f">{name}</th>" in table
