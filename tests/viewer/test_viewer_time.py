"""The strip of time along the live page's foot, without a mapping process; dynamic voxels."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import viser
from handled_page import HandledPage
from numpy.typing import NDArray

from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.live.page import Page
from taichi_mrf.viewer.live.time_strip import PLAY_TIME
from taichi_mrf.viewer.scene.coloring import DYNAMIC_COLOR
from taichi_mrf.viewer.scene.view_options import ViewOptions

HELLO = m.Hello("a recording", "cpu", "a device", "mrf", 0.1, -2.0, 0.1, "voxel_size: 0.1", has_dates=True)
DONE = m.Status("", 1.0, 1, 1, 1, 0, 0.0, 512, 1, 1.0, paused=False, finished=True, pending=False)
START_S = 1.7e9
NOTHING = np.zeros((0, 3), np.int32)


class TimePage(HandledPage):
    """The live page of a dated map."""

    def __init__(self) -> None:
        super().__init__(Page, HELLO)
        self.time = self.page.panel.time

    def span(self, now_s: float, first_s: float = 0.0, shown_s: float | None = None) -> None:
        shown = None if shown_s is None else START_S + shown_s
        self.take(m.TimeSpan(START_S, START_S + first_s, START_S + now_s, shown))

    def move_to(self, seconds: float) -> m.Request:
        """Move the slider as a user does; returns what is then asked."""
        self.time.slider.value = seconds
        self.page.actions["Time (s)"](0)
        return self.asked[-1]


@pytest.fixture
def running() -> Iterator[TimePage]:
    page = TimePage()
    yield page
    page.server.stop()


def test_the_right_end_is_now_and_follows(running: TimePage) -> None:
    slider = running.time.slider
    running.span(0.0)
    assert slider.disabled
    for now_s in (1.0, 7.26):
        running.span(now_s)
        assert (slider.min, slider.max, slider.value) == (0.0, round(now_s, 1), round(now_s, 1))
        assert not slider.disabled
    assert running.move_to(7.3) == m.ShowTime(None)
    assert running.move_to(2.5) == m.ShowTime(START_S + 2.5)
    running.span(9.0, shown_s=2.5)
    assert (slider.max, slider.value) == (9.0, 2.5)
    running.span(9.0)
    assert slider.value == 9.0


def test_at_an_earlier_time_the_voxels_of_then_are_drawn_and_not_the_surface_of_now() -> None:
    page = TimePage()
    page.take(replace(HELLO, has_surface=True))
    drawn, colors = (page.page.panel.view_options.handles[name] for name in ("draw_as", "color_by"))
    for chosen, then in (("height", "marginal probability"), ("uncertainty", "uncertainty")):
        drawn.value, colors.value = "surface", chosen
        page.span(9.0, shown_s=2.5)
        page.take(DONE)
        assert (drawn.value, drawn.options, colors.value) == ("voxels", ("voxels",), then)
        assert "this is an earlier time" in drawn.hint
        assert "showing the map as of 2.5 s" in page.page.panel._activity.content
        page.take(replace(DONE, share=0.5, activity="aligning"))
        assert "aligning" in page.page.panel._activity.content
        page.span(9.0)
        page.take(DONE)
        assert "as of" not in page.page.panel._activity.content
        assert (drawn.value, colors.value) == ("surface", chosen)
    page.server.stop()


def test_the_past_begins_at_the_newest_frozen_keyframe(running: TimePage) -> None:
    running.span(9.0, first_s=4.04)
    assert (running.time.slider.min, running.time.slider.max) == (4.0, 9.0)
    assert running.move_to(4.0) == m.ShowTime(START_S + 4.04)


def test_time_is_played_from_the_slider_or_from_the_first_keyframe(running: TimePage) -> None:
    running.span(9.0, first_s=4.04)
    for chosen_s, begin_s in ((9.0, 4.04), (6.5, 6.5)):
        running.move_to(chosen_s)
        running.page.actions[PLAY_TIME](0)
        assert running.asked[-1] == m.ShowTime(START_S + begin_s, play=True)


def test_the_list_says_what_happened_and_when(running: TimePage) -> None:
    running.span(20.0)
    chair = m.SceneChange(START_S + 12.4, "appeared", (0.5, 0.5, 0.52), (1.0, 2.0, 0.4))
    assert not running.time._list.visible
    running.take(m.SceneChanges((chair,)))
    assert running.time._list.visible
    assert "12.4 s: something of 0.5 x 0.5 x 0.5 m appeared at (1.0, 2.0, 0.4)" in running.time._list.content
    running.take(HELLO)
    assert "appeared at" not in running.time._list.content
    assert not running.time._list.visible


def test_a_static_map_has_no_strip(running: TimePage) -> None:
    assert running.time.strip.visible
    running.take(replace(HELLO, has_dates=False))
    assert not running.time.strip.visible


def test_dynamic_voxels_have_their_colour_and_are_counted(running: TimePage) -> None:
    brick, seen = np.zeros((1, 3), np.int32), np.zeros((1, 512), np.uint8)
    occupied, dynamic = np.full((1, 512), -2000, np.int16), np.full((1, 512), -512, np.int16)
    occupied[0, :40] = 900
    dynamic[0, :7] = 900
    running.take(m.Bricks("map", brick, occupied, seen, NOTHING))
    assert (len(colors(running)), red(running)) == (40, 0)
    running.take(m.Bricks("dynamic", brick, dynamic, seen, NOTHING))
    assert (len(colors(running)), red(running)) == (40, 7)
    assert not greys(running)
    running.page.options = ViewOptions(color_by="plain grey")
    running.page.map.look_changed()
    assert (greys(running), red(running)) == (33, 7)
    running.page.show_counts()
    shown = running.page.panel._shown.content
    assert shown == "40 voxels shown, 7 that move · ground: 0.1 m squares"
    chair = m.SceneChange(START_S, "left", (0.5, 0.6, 0.7), (1.0, 2.0, 0.4))
    running.take(m.SceneChanges((chair,)))
    assert red(running) == 7
    box = running.server.scene.get_handle_by_name("/changes")
    assert isinstance(box, viser.LineSegmentsHandle)
    np.testing.assert_allclose(box.points.reshape(-1, 3).min(axis=0), [0.75, 1.7, 0.05], atol=1e-6)
    np.testing.assert_allclose(box.points.reshape(-1, 3).max(axis=0), [1.25, 2.3, 0.75], atol=1e-6)
    assert "left" in running.page.panel._legend.content
    assert "appeared" not in running.page.panel._legend.content  # nothing has
    running.page.options = ViewOptions(changes=False)
    running.page.map.look_changed()
    assert red(running) == 0
    assert "left" not in running.page.panel._legend.content
    assert running.server.scene.get_handle_by_name("/changes") is None
    running.page.options = ViewOptions()
    running.page.map.look_changed()
    assert red(running) == 7
    running.take(m.Bricks("dynamic", brick[:0], dynamic[:0], seen[:0], brick))
    assert (len(colors(running)), red(running)) == (40, 0)


def greys(running: TimePage) -> int:
    return int((np.ptp(colors(running).astype(int), axis=1) == 0).sum())


def colors(running: TimePage) -> np.ndarray:
    """The colours of the points in the scene, once all has been drawn."""
    scene = running.page.map
    assert scene is not None
    scene._sent_at = 0.0
    running.page._flush()
    (node,) = scene.layers["map"]._nodes.values()
    return np.asarray(node.colors)


def red(running: TimePage) -> int:
    return int((colors(running) == DYNAMIC_COLOR).all(axis=1).sum())


def test_scrubbing_shows_how_far_the_camera_had_come_and_what_it_saw(running: TimePage) -> None:
    camera = PinholeCamera(8, 6, 5.0, 5.0, 3.5, 2.5)
    for id, second in enumerate((0.0, 3.0, 6.0)):
        T = np.eye(4)
        T[0, 3] = id
        picture = np.full((2, 2, 3), 40 * id, np.uint8)
        stamp_s = START_S + second
        running.take(
            m.KeyframeInfo(id, f"view {id}", T, camera, 1, "on", picture, NOTHING, T, False, stamp_s)
        )
    running.span(6.0)
    assert [mark.value for mark in running.time.slider._marks if mark.label is None] == [0.0, 3.0, 6.0]

    def steps() -> NDArray[np.uint8]:
        """The colours of the two steps of the camera's path."""
        path = running.server.scene.get_handle_by_name("/path")
        assert isinstance(path, viser.LineSegmentsHandle)
        assert (path.colors[:, 0] == path.colors[:, 1]).all()
        return path.colors[:, 0]

    def seen() -> list[bool]:
        """True for each keyframe that is drawn."""
        frusta = (running.server.scene.get_handle_by_name(f"/keyframes/{id}") for id in range(3))
        return [frustum.visible for frustum in frusta if frustum is not None]

    assert (steps()[0] == steps()[1]).all()
    assert seen() == [True, True, True]
    past = steps()[0]
    running.move_to(4.0)
    assert seen() == [True, True, False]
    running.page.keyframes.choose(2)  # which draws it anew
    assert seen() == [True, True, False]
    assert (steps()[0] == past).all()
    assert (steps()[1] != past).any()
    assert ">nearest keyframe: view 1, at 3.0 s<" in running.time._list.content
    assert "width:160px" in running.time._list.content
    running.move_to(4.9)
    assert "view 2, at 6.0 s" in running.time._list.content
    running.span(6.0)
    assert seen() == [True, True, True]
    assert (steps() == past).all()
    assert not running.time._list.visible
